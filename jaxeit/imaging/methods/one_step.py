"""Linear reconstruction with a quadratic prior, in one regularised Gauss-Newton step."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._compile import usually
from ...linalg.lapack import cho_factor, cho_solve, qr, solve_triangular
from ..priors import AbstractPrecision
from .base import AbstractLinearMethod, Problem


class OneStep(AbstractLinearMethod):
    """One regularised Gauss-Newton step, ``Q = (J^T J + l^2 R)^-1 J^T``  (the paper's equation 2).

    Solved by an orthogonal factor in the smaller of the two spaces, which agree to rounding:
    ``Q = R^-1 J^T (J R^-1 J^T + l^2 I)^-1``.
    """

    def image(self, problem: Problem, y: Float[Array, "k ..."]) -> Float[Array, "basis ..."]:
        return one_step_image(problem, problem.precision(), y)[0]

    def variance(self, problem: Problem) -> Float[Array, " basis"]:
        """The diagonal of ``(J^T J + l^2 R)^-1``, the posterior of a Gaussian image; (basis,) S^2."""
        precision = problem.precision()
        b = precision.seen(problem.jacobian)
        (k, n), level = b.shape, problem.level(b)
        q, r = _stacked_factor(b, level)
        if k > n:
            return jnp.sum(precision.image(solve_triangular(r, jnp.eye(n, dtype=b.dtype))) ** 2, 1)
        # Woodbury: with Q_n the rows of Q that are those of b^T, b^T (b b^T + l^2)^-1 b is Q_n Q_n^T.
        return (precision.variance() - jnp.sum(precision.image(q[:n]) ** 2, 1)) / level**2


def one_step_image(
    problem: Problem, precision: AbstractPrecision, y: Float[Array, "k ..."]
) -> tuple[Float[Array, "basis ..."], Float[Array, "k ..."]]:
    """``x = Q y`` of `OneStep`, and ``J x``, what the image predicts for the readings."""
    b = precision.seen(problem.jacobian)
    z, left = damped_solution(b, problem.level(b), y)
    return precision.image(z), y - left


def damped_solution(b: Float[Array, "k n"], level: Float[Array, ""], y: Float[Array, "k ..."]) -> tuple[Array, Array]:
    """``z = argmin |b z - y|^2 + level^2 |z|^2``, and ``y - b z``.

    From the Cholesky factor of ``b b^T + level^2 I``, in the smaller space, while that keeps three quarters of the
    digits: its errors grow as one over level squared.  Below that from Q and R of b stacked on level I,
    which takes four times as long and whose errors grow as one over level.
    """
    least = jnp.finfo(b.dtype).eps ** 0.25 * jnp.max(jnp.sum(b**2, 0))
    found: tuple[Array, Array] = usually(
        level**2 > least, _by_normal_equations, lambda _, *of: _by_orthogonal_factor(*of), least, b, level, y
    )
    return found


def _by_normal_equations(
    least: Float[Array, ""], b: Float[Array, "k n"], level: Float[Array, ""], y: Float[Array, "k ..."]
) -> tuple[Array, Array]:
    k, n = b.shape
    level = jnp.where(level**2 > least, level, jnp.sqrt(least))  # a vmap computes this where it is not used too
    eye = jnp.eye(min(k, n), dtype=b.dtype)
    if k > n:
        z = cho_solve(cho_factor(b.T @ b + level**2 * eye), b.T @ y)
        return z, y - b @ z
    solved = cho_solve(cho_factor(b @ b.T + level**2 * eye), y)
    return b.T @ solved, level**2 * solved  # y - b z, without a difference of nearly equal numbers


def _by_orthogonal_factor(
    b: Float[Array, "k n"], level: Float[Array, ""], y: Float[Array, "k ..."]
) -> tuple[Array, Array]:
    k, n = b.shape
    q, r = _stacked_factor(b, level)
    if k > n:
        z = solve_triangular(r, q[:k].T @ y)
        return z, y - b @ z
    z = q @ solve_triangular(r, y, trans=1)
    return z[:n], level * z[n:]  # the lower rows of Q are level R^-1


def _stacked_factor(b: Float[Array, "k n"], level: Float[Array, ""]) -> tuple[Array, Array]:
    """Q and R of ``[b; level I]``, of ``[b^T; level I]`` where b is wide."""
    tall = b if len(b) > b.shape[1] else b.T
    return qr(jnp.concatenate([tall, level * jnp.eye(tall.shape[1], dtype=b.dtype)]))
