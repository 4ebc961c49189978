"""Dense factors and solves that are safe under `jax.vmap`.

jaxlib 0.10 spreads a stack of matrices that is given to LAPACK over the threads of XLA's pool, while the caller, one of
those threads, waits for them. A program that comes to as many such stacks at once as there are threads waits for ever:
on two cores two chains of a Cholesky factor and a product, each of two matrices of 156 rows, do in most runs. (Builds
after July 2026 no longer spread any.) A `jax.vmap` makes such stacks of single matrices. Here it makes one, however
many vmaps there are, and on a CPU gives it to LAPACK in portions too small to be spread. On other devices it stays
whole.

The functions are named and mean as those of `jax.scipy.linalg` and `jax.numpy.linalg`, for one real matrix, and have
derivatives of any order in both directions.
"""

from collections.abc import Callable
from functools import cache, partial
from math import gcd
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float

# Operations up to which jaxlib does a stack of LAPACK calls in place, as it counts them.
_IN_PLACE = 200_000


def portioned(function: Callable[..., Any], operations: int = 1) -> Callable[..., Any]:
    """For stacks of matrices, in portions that jaxlib does in place.

    Args:
        function: of stacks (m, ...) of matrices; its results take the places of its last arguments.
        operations: how many it takes for each matrix, per product of its rows squared and its columns.
    """

    def in_portions(stacks, portion):
        def step(i, stacks):
            part = [lax.dynamic_slice_in_dim(stack, i * portion, portion) for stack in stacks]
            done = function(*part)
            kept, changed = stacks[: -len(done)], stacks[-len(done) :]
            pairs = zip(changed, done, strict=True)
            return *kept, *(lax.dynamic_update_slice_in_dim(old, new, i * portion, 0) for old, new in pairs)

        return lax.fori_loop(0, stacks[0].shape[0] // portion, step, stacks)

    @custom_vmap
    def stacked(*stacks):
        count, rows, _ = stacks[0].shape
        columns = max(stack.shape[2] for stack in stacks)
        portion = portion_of(count, rows, columns, operations)
        return lax.platform_dependent(
            stacks,
            cpu=partial(in_portions, portion=portion),
            default=lambda stacks: in_portions(stacks, count),
        )

    @stacked.def_vmap
    def _(size, batched, *stacks):
        whole = (s.reshape(-1, *s.shape[2:]) for s in _spread(size, batched, stacks))
        apart = jax.tree.map(lambda a: a.reshape(size, -1, *a.shape[1:]), stacked(*whole))
        return apart, jax.tree.map(lambda _: True, apart)

    return stacked


def portion_of(count: int, rows: int, columns: int, operations: int = 1) -> int:
    """How many of so many matrices are done at once, see `portioned`."""
    work = max(1, operations * rows**2 * max(rows, columns))
    return gcd(count, 1 << int(np.log2(max(1, _IN_PLACE // work))))


def _spread(size: int, batched: Any, arrays: Any) -> list[Array]:
    """All with the new axis in front."""
    return [a if b else jnp.broadcast_to(a, (size, *a.shape)) for a, b in zip(arrays, batched, strict=True)]


def cholesky(a: Float[Array, "n n"], lower: bool = False) -> Float[Array, "n n"]:
    """The factor of a positive matrix, of which only the triangle named is read; not finite where it is not positive.

    Args:
        lower: L with L L^T = a, else U with U^T U = a.
    """
    return _lower(a) if lower else _lower(a.T).T


def cho_factor(a: Float[Array, "n n"], lower: bool = False) -> tuple[Float[Array, "n n"], bool]:
    """`cholesky`, for `cho_solve`."""
    return cholesky(a, lower), lower


def cho_solve(c_and_lower: tuple[Float[Array, "n n"], bool], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """x with a x = b, from `cho_factor`."""
    c, lower = c_and_lower
    return solve_triangular(c, solve_triangular(c, b, not lower, lower), lower, lower)


def solve_triangular(
    a: Float[Array, "n n"], b: Float[Array, "n ..."], trans: int = 0, lower: bool = False
) -> Float[Array, "n ..."]:
    """x with a x = b, or with a^T x = b where ``trans`` is 1, of which only the triangle named is read."""

    def product(x):
        part = jnp.tril(a) if lower else jnp.triu(a)
        return (part.T if trans else part) @ x

    return _linear(product, partial(_solved(bool(trans), lower), a), partial(_solved(not trans, lower), a), b)


def solve(a: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """x with a x = b, by LU; not finite where a is singular."""
    return _linear(lambda x: a @ x, partial(_general, a), partial(_general, a.T), b)


def eigh(a: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues from the smallest on, and their vectors as columns, of a symmetric matrix."""
    return _eigh(0.5 * (a + a.T))


def svd(a: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"], Float[Array, "n n"]]:
    """U, singular values from the largest on, and V^T, of a square matrix."""
    return _svd(a)


def _linear(product, solve, transposed, b):
    many = b if b.ndim == 2 else b[:, None]
    found = lax.custom_linear_solve(product, many, lambda _, b: solve(b), lambda _, b: transposed(b))
    return found.reshape(b.shape)


@jax.custom_jvp
def _lower(a):
    return _factored(a)[0]


@_lower.defjvp
def _(primals, tangents):
    """Murray, Differentiation of the Cholesky decomposition (arXiv 1602.07527), forward mode."""
    lower = _lower(*primals)
    half = solve_triangular(lower, tangents[0], lower=True)
    whole = solve_triangular(lower, half.T, lower=True).T
    return lower, lower @ (jnp.tril(whole) / (1 + jnp.eye(len(lower), dtype=lower.dtype)))


@jax.custom_jvp
def _eigh(a):
    left, vectors = _eigen(a)
    return left[:, 0], vectors


@_eigh.defjvp
def _(primals, tangents):
    left, vectors = _eigh(*primals)
    turned = vectors.T @ tangents[0] @ vectors
    return (left, vectors), (jnp.diagonal(turned), vectors @ (_one_over(left - left[:, None]) * turned))


@jax.custom_jvp
def _svd(a):
    u, s, vt = _singular(a)
    return u, s[:, 0], vt


@_svd.defjvp
def _(primals, tangents):
    """Townsend (2016), Differentiating the singular value decomposition, of a square matrix."""
    u, s, vt = _svd(*primals)
    turned = u.T @ tangents[0] @ vt.T
    apart = _one_over((s - s[:, None]) * (s + s[:, None]))
    du = u @ (apart * (turned * s + s[:, None] * turned.T))
    dv = vt.T @ (apart * (s[:, None] * turned + turned.T * s))
    return (u, s, vt), (du, jnp.diagonal(turned), dv.T)


def _one_over(apart):
    """With zeros on the diagonal."""
    eye = jnp.eye(len(apart), dtype=apart.dtype)
    return 1 / (apart + eye) - eye


def _of_one(function: Callable[..., Any], operations: int = 1) -> Callable[..., Any]:
    """``function`` of a matrix (n, n), safe under `jax.vmap`.

    Its results have n rows each, and as many columns, the last of them n.
    """
    one = custom_vmap(function)

    @one.def_vmap
    def _(size, batched, a):
        *others, _ = jax.eval_shape(function, jax.ShapeDtypeStruct(a.shape[1:], a.dtype))
        room = (jnp.zeros((size, *other.shape), other.dtype) for other in others)
        many = portioned(lambda *stacks: jax.vmap(function)(stacks[-1]), operations)
        return many(*room, a), (True,) * (len(others) + 1)

    return one


def _with_vectors(a):
    vectors, left = lax.linalg.eigh(a, symmetrize_input=False)
    return left[:, None], vectors


def _with_both(a):
    u, s, vt = lax.linalg.svd(a)
    return u, s[:, None], vt


_factored = _of_one(lambda a: (lax.linalg.cholesky(a, symmetrize_input=False),))
_eigen = _of_one(_with_vectors, operations=5)
_singular = _of_one(_with_both, operations=10)


def _beside(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` of a matrix and right-hand sides, (n, n) and (n, k), safe under `jax.vmap`."""
    one, many = custom_vmap(function), portioned(lambda *stacks: (jax.vmap(function)(*stacks),))

    @one.def_vmap
    def _(size, batched, a, b):
        if batched[0]:
            return many(*_spread(size, batched, (a, b)))[-1], True
        beside = jnp.moveaxis(b, 0, 2)  # one matrix for all: all are its right-hand sides
        return jnp.moveaxis(one(a, beside.reshape(len(a), -1)).reshape(beside.shape), 2, 0), True

    return one


@cache
def _solved(trans: bool, lower: bool):
    """One triangular solve."""
    return _beside(partial(lax.linalg.triangular_solve, left_side=True, lower=lower, transpose_a=trans))


_general = _beside(jnp.linalg.solve)
