"""Reweighted least squares, for priors that follow the image, such as total variation."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...linalg.lapack import cho_factor, cho_solve
from ...registry import limited
from ..priors import AbstractPrecision
from .base import AbstractIterativeMethod, Problem


class Reweighted(AbstractIterativeMethod):
    """Iteratively reweighted least squares: `OneStep` repeated with the prior at the last image, for `TotalVariation`.

    The scale of the hyperparameter is computed again in each step.
    """

    follows_prior: ClassVar[bool] = True
    steps: int = limited(8, least=1, static=True)

    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        def again(_: Int[Array, ""], x: Float[Array, " basis"]) -> Float[Array, " basis"]:
            return _by_squares(problem, problem.precision(x), y)

        image: Array = jax.lax.fori_loop(0, self.steps, again, _by_squares(problem, problem.precision(), y))
        return image


def _by_squares(problem: Problem, precision: AbstractPrecision, y: Float[Array, " k"]) -> Float[Array, " basis"]:
    """``Q y`` from the Cholesky factor of normal equations, for a precision that is used for one frame only."""
    j = problem.jacobian
    gained = precision.solve(j.T)
    return gained @ cho_solve(cho_factor(j @ gained + problem.strength(gained) * jnp.eye(len(j), dtype=j.dtype)), y)
