"""Reweighted least squares, for priors that follow the image, such as total variation."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...linalg.lapack import cho_factor, cho_solve
from ..priors import AbstractPrecision
from .base import AbstractIterativeMethod, Problem


class Reweighted(AbstractIterativeMethod):
    """`OneStep` again and again, the prior taken at the last image: for `TotalVariation`.

    Iteratively reweighted least squares; the scale of the hyperparameter is taken anew in each step.
    """

    follows_prior: ClassVar[bool] = True
    steps: int = eqx.field(static=True, default=8)

    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        def again(_: Int[Array, ""], x: Float[Array, " basis"]) -> Float[Array, " basis"]:
            return _by_squares(problem, problem.precision(x), y)

        image: Array = jax.lax.fori_loop(0, self.steps, again, _by_squares(problem, problem.precision(), y))
        return image


def _by_squares(problem: Problem, precision: AbstractPrecision, y: Float[Array, " k"]) -> Float[Array, " basis"]:
    """``Q y`` by Cholesky: for a precision that serves one frame, where a hyperparameter near zero makes no sense."""
    j = problem.jacobian
    gained = precision.solve(j.T)
    return gained @ cho_solve(cho_factor(j @ gained + problem.strength(gained) * jnp.eye(len(j), dtype=j.dtype)), y)
