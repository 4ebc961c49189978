"""Sparse Bayesian learning: images of few pixels."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...linalg.lapack import cho_solve, cholesky, solve_triangular
from ...registry import limited
from ..inputs import InverseError
from ..priors import Diagonal
from .base import AbstractIterativeMethod, Problem


class SparseBayes(AbstractIterativeMethod):
    """Sparse Bayesian learning (Tipping 2001): each pixel has a variance of its own, found from the frame.

    With ``x ~ N(0, diag g)`` and noise of variance s,

        C = s I + J diag(g) J^T,    x = g J^T C^-1 y,    g_i <- x_i^2 / q_i,    q_i = g_i (J^T C^-1 J)_ii,
        s <- (|y - J x|^2 + s sum(q)) / k.

    The first g follows the prior (a diagonal one), the first s is hyperparameter^2 of the data's variance.  The rule
    for g is MacKay's, which Tipping takes; it needs a fraction of the steps of ``g_i <- x_i^2 + g_i (1 - q_i)``.
    """

    needs_diagonal_prior: ClassVar[bool] = True
    steps: int = limited(15, least=1, static=True)

    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        j, precision = problem.jacobian, problem.precision()
        if not isinstance(precision, Diagonal):
            raise InverseError("SparseBayes needs a diagonal prior: Noser() or Tikhonov()")
        top = jnp.max(jnp.abs(y))
        top = jnp.where(top > 0, top, 1)
        y = y / top
        power = jnp.sum(y**2) / len(j)
        power = jnp.where(power > 0, power, 1)
        g = 1 / precision.values
        g = g * power / (jnp.sum(j**2 * g) / len(j))
        least = max(1e-12, 4 * len(j) * float(jnp.finfo(j.dtype).eps)) * power  # C keeps a Cholesky factor

        def lower(g: Float[Array, " basis"], s: Float[Array, ""]) -> Float[Array, "k k"]:
            return cholesky(s * jnp.eye(len(j), dtype=j.dtype) + (j * g) @ j.T, lower=True)

        def again(
            _: Int[Array, ""], state: tuple[Float[Array, " basis"], Float[Array, ""]]
        ) -> tuple[Float[Array, " basis"], Float[Array, ""]]:
            g, s = state
            factor = lower(g, s)
            half = solve_triangular(factor, j, lower=True)
            seen, own = half.T @ solve_triangular(factor, y, lower=True), jnp.sum(half**2, 0)
            left = jnp.sum((y - j @ (g * seen)) ** 2) + s * jnp.sum(g * own)
            # x_i^2 / q_i, of which one g is cancelled: finite where a variance has become zero.
            return g * seen**2 / jnp.where(own > 0, own, 1), jnp.maximum(left / len(j), least)

        g, s = jax.lax.fori_loop(0, self.steps, again, (g, problem.hyperparameter**2 * power))
        image: Array = top * g * (j.T @ cho_solve((lower(g, s), True), y))
        return image
