"""Readings missing from a frame, seen from its whitened numbers.

With all readings the numbers y have the metric I.  Without some of them (`whitening.Whitening.lost`) what is minimised
over a response f is, up to a constant,

    f^T (I - M) f - 2 f^T t,      M = E G_lost E^T,      t = E P^T W dv of the others:

the squares of ``(I - M)^1/2 f - (I - M)^-1/2 t``.  Nothing is filled in.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .lapack import eigh
from .whitening import Lost


class Gap(NamedTuple):
    """What missing readings do to whitened numbers.

    | meaning                                                        | shape  |
    |----------------------------------------------------------------|--------|
    | root ``(I - M)^1/2``, by which responses are seen              | (r, r) |
    | y: the numbers to be explained                                 | (r,)   |
    | rank: how many numbers the readings at hand still amount to    | ()     |
    """

    root: Float[Array, "r r"]
    y: Float[Array, " r"]
    rank: Float[Array, ""]


def gap_of(compress: Float[Array, "r k"], lost: Lost) -> Gap:
    """The gap, in numbers ``compress @ sums``; directions that only missing readings knew are left out."""
    metric = jnp.eye(len(compress), dtype=lost.sums.dtype) - compress @ lost.gram @ compress.T
    left, vectors = eigh(jax.lax.stop_gradient(metric))  # it does not depend on what was read
    known = left > 1e4 * jnp.finfo(left.dtype).eps
    root = jnp.sqrt(jnp.where(known, left, 0))
    y = vectors @ (jnp.where(known, 1 / jnp.where(known, root, 1), 0) * (vectors.T @ (compress @ lost.sums)))
    return Gap((vectors * root) @ vectors.T, y, jnp.sum(known).astype(left.dtype))
