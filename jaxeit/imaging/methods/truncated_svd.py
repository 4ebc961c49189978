"""Linear reconstruction from the singular values that stand out of the noise."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._compile import full_precision
from ...linalg.lapack import qr, svd
from .base import AbstractLinearMethod, Problem


class TruncatedSvd(AbstractLinearMethod):
    """The pseudo-inverse on the singular values of ``J R^-1/2`` above l, the others left out.

    l as for `OneStep`, which halves the contribution of a singular value of l; values that are only rounding are left
    out in any case. The image jumps where the hyperparameter passes a singular value and is constant between: its
    derivative with respect to the hyperparameter is zero.
    """

    def image(self, problem: Problem, y: Float[Array, "k ..."]) -> Float[Array, "basis ..."]:
        precision = problem.precision()
        b = precision.seen(problem.jacobian)
        return precision.image(_truncated_inverse(b, problem.level(b), y))


@jax.custom_jvp
def _truncated_inverse(
    b: Float[Array, "k n"], level: Float[Array, ""], y: Float[Array, "k ..."]
) -> Float[Array, "n ..."]:
    """``V f(S) U^T y`` with ``f(s) = 1/s`` for the singular values of b above ``level``, else 0."""
    u, s, v = _thin_svd(b)
    return v @ (_inverse_above(level, b, s) * (u.T @ y).T).T


@_truncated_inverse.defjvp
@full_precision
def _(
    primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]
) -> tuple[Float[Array, "n ..."], Float[Array, "n ..."]]:
    """The derivative of a generalised matrix function (Noferini 2017), which no pair of equal singular values upsets.

    Which values are kept is constant but for jumps, so the level has no derivative.
    """
    (b, level, y), (db, _, dy) = primals, tangents
    u, s, v = _thin_svd(b)
    f = _inverse_above(level, b, s)
    kept = f > 0
    both, sums, apart = kept[:, None] & kept, s[:, None] + s, s[:, None] - s
    mixed = kept[:, None] != kept  # one is kept, the other not: their values differ
    safe = jnp.where(sums > 0, sums, 1)
    plus = jnp.where(sums > 0, (f[:, None] + f) / safe, 0)
    # The divided difference of 1/s is -1 / (s_i s_j), finite where the values are equal.
    minus = jnp.where(both, -f[:, None] * f, jnp.where(mixed, (f[:, None] - f) / jnp.where(mixed, apart, 1), 0))
    turned, data, slopes = u.T @ db @ v, u.T @ y, db.T @ y
    inside = 0.5 * (minus * (turned + turned.T) + plus * (turned.T - turned)) @ data
    beyond_data = v.T @ slopes - turned.T @ data  # V^T dB^T (1 - U U^T) y
    beyond_image = db.T @ (u @ (f**2 * data.T).T)
    beyond_image = beyond_image - v @ (v.T @ beyond_image)
    change = v @ (inside + (f**2 * beyond_data.T + f * (u.T @ dy).T).T) + beyond_image
    return v @ (f * data.T).T, change


def _inverse_above(level: Float[Array, ""], b: Float[Array, "k n"], s: Float[Array, " r"]) -> Float[Array, " r"]:
    """``1/s`` above the level and above rounding, else 0."""
    kept = s > jnp.maximum(level, max(b.shape) * jnp.finfo(b.dtype).eps * s[0])
    return jnp.where(kept, 1 / jnp.where(kept, s, 1), 0)


def _thin_svd(b: Float[Array, "k n"]) -> tuple[Float[Array, "k r"], Float[Array, " r"], Float[Array, "n r"]]:
    """U, S and V of ``b = U S V^T``, through Q and R, as `svd` is for square matrices."""
    wide = b.shape[0] < b.shape[1]
    q, r = qr(b.T if wide else b)
    u, s, vt = svd(r)
    return (vt.T, s, q @ u) if wide else (q @ u, s, vt.T)
