"""Sums and products of many small matrices, as loops that XLA compiles itself."""

from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float

# Terms that one loop sums. XLA unrolls a sum of so many terms; a longer sum is cut into several.
MAX_UNROLLED_TERMS = 16
# Multiplications of a whole stack from which on loops are faster than the library. For fewer, the threads that share
# the loops wait for each other longer than they compute.
MIN_LOOPED_MULTIPLICATIONS = 500_000


# --- sums ------------------------------------------------------------------------------------------------------------

_sum_p = Primitive("sum_by_loop")
_sum_p.def_abstract_eval(lambda terms, *, axis: ShapedArray(_without(terms.shape, axis), terms.dtype))
_sum_p.def_impl(lambda terms, *, axis: jnp.sum(terms, axis))


def summed(terms: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """`jnp.sum` over one axis, as a loop that XLA compiles itself on a CPU.

    Without special compiler options XLA gives each sum of 4,096 numbers or more to its library YNNPACK, whose threads
    take ten to twenty times as long as the loop. XLA recognises a sum by its reducer, and it does not recognise
    ``a - (-b)``, which equals ``a + b`` to the last bit. JAX can neither differentiate nor transpose such a reducer, so
    the sum is a primitive of its own.
    """
    total: Array = _sum_p.bind(terms, axis=axis % terms.ndim)
    return total


def _by_loop(terms: Array, *, axis: int) -> Array:
    total: Array = jax.lax.reduce(terms, np.zeros((), terms.dtype)[()], lambda a, b: a - (-b), (axis,))
    return total


def _without(shape: tuple[int, ...], axis: int) -> tuple[int, ...]:
    return shape[:axis] + shape[axis + 1 :]


def _transpose(cotangent: Array, terms: Any, *, axis: int) -> tuple[Array]:
    shape = terms.aval.shape
    return (jax.lax.broadcast_in_dim(cotangent, shape, tuple(n for n in range(len(shape)) if n != axis)),)


def _batch(args: tuple[Array], dims: tuple[int], *, axis: int) -> tuple[Array, int]:
    (terms,), (batch,) = args, dims
    return summed(terms, axis + (axis >= batch)), batch - (axis < batch)


ad.deflinear2(_sum_p, _transpose)
batching.primitive_batchers[_sum_p] = _batch
mlir.register_lowering(_sum_p, mlir.lower_fun(lambda terms, *, axis: jnp.sum(terms, axis), multiple_results=False))
mlir.register_lowering(_sum_p, mlir.lower_fun(_by_loop, multiple_results=False), platform="cpu")

# --- products --------------------------------------------------------------------------------------------------------


def stacked_product(left: Float[Array, "m k i"], right: Float[Array, "m k j"]) -> Float[Array, "m i j"]:
    """``left^T right`` of each of m pairs of small matrices."""
    by_library = partial(jnp.einsum, "mki,mkj->mij")
    unfused = jax.config.read("jax_disable_most_optimizations")  # without fusion XLA would store each product of a loop
    if unfused or left.size * right.shape[2] < MIN_LOOPED_MULTIPLICATIONS:
        return by_library(left, right)
    product: Array = jax.lax.platform_dependent(left, right, cpu=product_by_loops, default=by_library)
    return product


def product_by_loops(left: Float[Array, "m k i"], right: Float[Array, "m k j"]) -> Float[Array, "m i j"]:
    """`stacked_product` in loops that XLA compiles for this CPU.

    On a CPU jaxlib calls Eigen for one pair after the other, on one core and with the instructions of old CPUs. The
    loops take a third of the time, and the same time as Eigen for larger matrices.
    """
    cuts = np.linspace(0, left.shape[1], -(-left.shape[1] // MAX_UNROLLED_TERMS) + 1).astype(int)
    sums = (summed(left[:, i:j, :, None] * right[:, i:j, None, :], 1) for i, j in pairwise(cuts))
    return sum(sums, start=jnp.zeros((), left.dtype))
