"""Dense factors and solves that are safe under `jax.vmap`.

jaxlib 0.10 spreads a stack of matrices that is given to LAPACK over the threads of XLA's pool, while the caller, one of
those threads, waits for them. A program that reaches as many such stacks at once as there are threads never ends: on
two cores, two chains of a Cholesky factor and a product, each of two matrices of 156 rows, hang in most runs. A
`jax.vmap` makes such stacks of single matrices. The functions here make one stack for any number of vmaps, and on a CPU
pass it to LAPACK in portions too small to be spread. On other devices the stack stays whole.

The repair upstream (commit 859992407d of 2026-07-21) came after jaxlib 0.10.2. From `FIRST_SAFE_JAXLIB` on,
`jax.vmap` treats these functions like those of JAX, and no stack is cut. Derivatives are the same with any version.

The functions have the names and meanings of those of `jax.scipy.linalg` and `jax.numpy.linalg`, for one real matrix,
and have derivatives of any order in both directions.
"""

import re
from collections.abc import Callable, Sequence
from functools import cache, partial
from importlib.metadata import version
from math import gcd
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._compile import by_platform, full_precision

Stacks = tuple[Array, ...]
Linear = Callable[[Array], Array]

FIRST_SAFE_JAXLIB = (0, 11)  # the first release that is known to have the repair

# Largest work, in jaxlib's count of operations, for which jaxlib runs a stack of LAPACK calls on the calling thread.
SEQUENTIAL_OPERATIONS = 200_000


def spreads_stacks(release: str) -> bool:
    """Whether this release of jaxlib spreads a stack over threads that may all wait for it."""
    numbers = [int(re.match(r"\d*", part).group() or 0) for part in release.split(".")]  # type: ignore[union-attr]
    return tuple(numbers[:2]) < FIRST_SAFE_JAXLIB


CUTS_STACKS = spreads_stacks(version("jaxlib"))


def portioned(function: Callable[..., Any], operations: int = 1) -> Callable[..., Any]:
    """``function`` of stacks of matrices, in portions that jaxlib computes on the calling thread.

    Args:
        function: a function of stacks (m, ...) of matrices; its results replace its last arguments.
        operations: operations for each matrix, divided by its rows squared times its columns.
    """

    def whole(*stacks: Array) -> Stacks:
        done = function(*stacks)
        return *stacks[: -len(done)], *done

    if not CUTS_STACKS:
        return whole
    in_portions = partial(_in_portions, function)

    @custom_vmap
    def stacked(*stacks: Array) -> Stacks:
        count = stacks[0].shape[0]
        if not count:  # a batch without samples
            return stacks
        rows, columns = (max(stack.shape[axis] for stack in stacks) for axis in (1, 2))
        portion = portion_of(count, rows, columns, operations)
        done: Stacks = by_platform(
            stacks,
            cpu=partial(in_portions, portion=portion),
            default=lambda stacks: in_portions(stacks, count),
        )
        return done

    @stacked.def_vmap
    def _(size: int, batched: Sequence[bool], *stacks: Array) -> tuple[Stacks, Any]:
        spread = list(_spread(size, batched, stacks))
        count = spread[0].shape[1]
        whole = stacked(*(s.reshape(size * count, *s.shape[2:]) for s in spread))
        apart = jax.tree.map(lambda a: a.reshape(size, count, *a.shape[1:]), whole)
        return apart, jax.tree.map(lambda _: True, apart)

    return stacked


def _in_portions(function: Callable[..., Any], stacks: Stacks, portion: int) -> Stacks:
    """``function`` of ``portion`` matrices at a time, which divide the stacks; its results replace the last stacks."""

    def step(i: Array, stacks: Stacks) -> Stacks:
        part = [lax.dynamic_slice_in_dim(stack, i * portion, portion) for stack in stacks]
        done = function(*part)
        kept, changed = stacks[: -len(done)], stacks[-len(done) :]
        pairs = zip(changed, done, strict=True)
        return *kept, *(lax.dynamic_update_slice_in_dim(old, new, i * portion, 0) for old, new in pairs)

    done: Stacks = lax.fori_loop(0, stacks[0].shape[0] // portion, step, stacks)
    return done


def portion_of(count: int, rows: int, columns: int, operations: int = 1) -> int:
    """Number of matrices in a portion of `portioned`; it divides ``count``."""
    if not CUTS_STACKS:
        return count
    work = max(1, operations * rows**2 * max(rows, columns))
    return gcd(count, 1 << int(np.log2(max(1, SEQUENTIAL_OPERATIONS // work))))


def _spread(size: int, batched: Sequence[bool], arrays: Sequence[Array]) -> list[Array]:
    """The arrays, all with the batch axis in front."""
    return [a if b else jnp.broadcast_to(a, (size, *a.shape)) for a, b in zip(arrays, batched, strict=True)]


def cholesky(a: Float[Array, "n n"], lower: bool = False) -> Float[Array, "n n"]:
    """Cholesky factor of a matrix, of which only one triangle is read; not finite if it is not positive definite.

    Args:
        lower: L with L L^T = a, from the lower triangle; else U with U^T U = a, from the upper one.
    """
    return _lower(a) if lower else _lower(a.T).T


def cho_factor(a: Float[Array, "n n"], lower: bool = False) -> tuple[Float[Array, "n n"], bool]:
    """`cholesky`, for `cho_solve`."""
    return cholesky(a, lower), lower


def cho_solve(c_and_lower: tuple[Float[Array, "n n"], bool], b: Float[ArrayLike, "n ..."]) -> Float[Array, "n ..."]:
    """x with a x = b, from `cho_factor`."""
    c, lower = c_and_lower
    return solve_triangular(c, solve_triangular(c, b, not lower, lower), lower, lower)


def solve_triangular(
    a: Float[Array, "n n"], b: Float[ArrayLike, "n ..."], trans: int = 0, lower: bool = False
) -> Float[Array, "n ..."]:
    """x with a x = b, or with a^T x = b where ``trans`` is 1, of which only one triangle is read."""

    def product(x: Array) -> Array:
        part = jnp.tril(a) if lower else jnp.triu(a)
        return (part.T if trans else part) @ x

    return _linear(product, partial(_solved(bool(trans), lower), a), partial(_solved(not trans, lower), a), b)


def solve(a: Float[Array, "n n"], b: Float[ArrayLike, "n ..."]) -> Float[Array, "n ..."]:
    """x with a x = b, by LU; not finite where a is singular."""
    return _linear(lambda x: a @ x, partial(_general, a), partial(_general, a.T), b)


def eigh(a: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Eigenvalues, ascending, and eigenvectors as columns, of a symmetric matrix."""
    return _eigh(0.5 * (a + a.T))


def svd(a: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"], Float[Array, "n n"]]:
    """U, singular values, descending, and V^T, of a square matrix."""
    return _svd(a)


def qr(a: Float[Array, "m n"]) -> tuple[Float[Array, "m n"], Float[Array, "n n"]]:
    """Q and R of a matrix with at least as many rows as columns; derivatives need full rank."""
    return _qr(a)


def _linear(product: Linear, solve: Linear, transposed: Linear, b: Float[ArrayLike, "n ..."]) -> Float[Array, "n ..."]:
    # The rule of linear solves: derivatives are further solves, and none goes through the factorisation.
    b = jnp.asarray(b)
    many = b if b.ndim == 2 else b[:, None]
    found: Array = lax.custom_linear_solve(product, many, lambda _, b: solve(b), lambda _, b: transposed(b))
    return found.reshape(b.shape)


@jax.custom_jvp
def _lower(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return _factored(a)[0]


@_lower.defjvp
@full_precision
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    """Murray, Differentiation of the Cholesky decomposition (arXiv 1602.07527), forward mode."""
    lower = _lower(*primals)
    half = solve_triangular(lower, tangents[0], lower=True)
    whole = solve_triangular(lower, half.T, lower=True).T
    # L^-1 dA L^-T is the sum of L^-1 dL, a lower triangle, and its transpose.
    return lower, lower @ (jnp.tril(whole) / (1 + jnp.eye(len(lower), dtype=lower.dtype)))


@jax.custom_jvp
def _eigh(a: Float[Array, "n n"]) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    left, vectors = _eigen(a)
    return left[:, 0], vectors


@_eigh.defjvp
@full_precision
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    left, vectors = _eigh(*primals)
    # First order of perturbation: vectors turn towards each other, without bound where their eigenvalues are equal.
    turned = vectors.T @ tangents[0] @ vectors
    return (left, vectors), (jnp.diagonal(turned), vectors @ (_one_over(left - left[:, None]) * turned))


@jax.custom_jvp
def _svd(a: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, " n"], Float[Array, "n n"]]:
    u, s, vt = _singular(a)
    return u, s[:, 0], vt


@_svd.defjvp
@full_precision
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """Townsend (2016), Differentiating the singular value decomposition, of a square matrix."""
    u, s, vt = _svd(*primals)
    turned = u.T @ tangents[0] @ vt.T
    apart = _one_over((s - s[:, None]) * (s + s[:, None]))
    du = u @ (apart * (turned * s + s[:, None] * turned.T))
    dv = vt.T @ (apart * (s[:, None] * turned + turned.T * s))
    return (u, s, vt), (du, jnp.diagonal(turned), dv.T)


@jax.custom_jvp
def _qr(a: Float[Array, "m n"]) -> tuple[Array, Array]:
    r, q = _orthogonal(a)
    return q, r


@_qr.defjvp
@full_precision
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Walter and Lehmann, Algorithmic differentiation of linear algebra functions (arXiv 1001.1654)."""
    q, r = _qr(*primals)
    change = solve_triangular(r, tangents[0].T, trans=1).T  # da R^-1
    inside = q.T @ change
    # Q^T dQ is skew, and dR R^-1 an upper triangle: below the diagonal their sum is the former alone.
    below = jnp.tril(inside, -1)
    turn = below - below.T
    return (q, r), (change + q @ (turn - inside), (inside - turn) @ r)


def _one_over(apart: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Reciprocals off the diagonal, zeros on it."""
    eye = jnp.eye(len(apart), dtype=apart.dtype)
    return 1 / (apart + eye) - eye


def _safe_factorisation(function: Callable[[Array], Stacks], operations: int = 1) -> Callable[[Array], Stacks]:
    """``function`` of a matrix, safe under `jax.vmap`; its results are matrices, the last one of
    the shape of its argument."""
    if not CUTS_STACKS:
        return function
    one = custom_vmap(function)

    @one.def_vmap
    def _(size: int, batched: Sequence[bool], a: Array) -> tuple[Stacks, tuple[bool, ...]]:
        *others, _ = jax.eval_shape(function, jax.ShapeDtypeStruct(a.shape[1:], a.dtype))
        room = (jnp.zeros((size, *other.shape), other.dtype) for other in others)
        many = portioned(lambda *stacks: jax.vmap(function)(stacks[-1]), operations)
        return many(*room, a), (True,) * (len(others) + 1)

    return one


# The factorisations with all results as matrices, the one of the argument's shape last, as `_safe_factorisation` needs.


def _eigen_matrices(a: Float[Array, "n n"]) -> tuple[Float[Array, "n 1"], Float[Array, "n n"]]:
    vectors, left = lax.linalg.eigh(a, symmetrize_input=False)
    return left[:, None], vectors


def _singular_matrices(a: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, "n 1"], Float[Array, "n n"]]:
    u, s, vt = lax.linalg.svd(a)
    return u, s[:, None], vt


def _orthogonal_matrices(a: Float[Array, "m n"]) -> tuple[Float[Array, "n n"], Float[Array, "m n"]]:
    q, r = lax.linalg.qr(a, full_matrices=False)
    return r, q


_orthogonal = _safe_factorisation(_orthogonal_matrices)
_factored = _safe_factorisation(lambda a: (lax.linalg.cholesky(a, symmetrize_input=False),))
_eigen = _safe_factorisation(_eigen_matrices, operations=5)
_singular = _safe_factorisation(_singular_matrices, operations=10)


def _safe_solve(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` of a matrix and right-hand sides, (n, n) and (n, k), safe under `jax.vmap`."""
    if not CUTS_STACKS:
        return function
    one, many = custom_vmap(function), portioned(lambda *stacks: (jax.vmap(function)(*stacks),))

    @one.def_vmap
    def _(size: int, batched: Sequence[bool], a: Array, b: Array) -> tuple[Array, bool]:
        if batched[0]:
            return many(*_spread(size, batched, (a, b)))[-1], True
        beside = jnp.moveaxis(b, 0, 2)  # one matrix for the whole batch takes the batch as right-hand sides
        return jnp.moveaxis(one(a, beside.reshape(len(a), -1)).reshape(beside.shape), 2, 0), True

    return one


@cache
def _solved(trans: bool, lower: bool) -> Callable[[Array, Array], Array]:
    """The triangular solve with these options, safe under `jax.vmap`."""
    return _safe_solve(partial(lax.linalg.triangular_solve, left_side=True, lower=lower, transpose_a=trans))


_general = _safe_solve(jnp.linalg.solve)
