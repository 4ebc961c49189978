"""Quantiles of the valid samples, in a form that compiles and differentiates."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int


def quantiles(
    values: Float[Array, " n"], valid: Bool[Array, " n"], parts: tuple[float, ...]
) -> tuple[Float[Array, ""], ...]:
    """Quantiles of the valid values, linear between neighbours; NaN where no value is valid.

    Args:
        parts: fraction of the values below each quantile, 0 to 1.
    """
    ordered, count = _ascending(jnp.where(valid, values, jnp.inf)), jnp.sum(valid, dtype=jnp.int32)
    last = jnp.maximum(count - 1, 0)
    place = jnp.asarray(parts, ordered.dtype) * last.astype(ordered.dtype)
    below = jnp.floor(place)
    part, index = place - below, below.astype(jnp.int32)
    low, high = ordered[index], ordered[jnp.minimum(index + 1, last)]
    found = jnp.where(part > 0, low * (1 - part) + high * part, low)
    return tuple(jnp.where(count > 0, found, jnp.nan))


def median(values: Float[Array, " n"], valid: Bool[Array, " n"]) -> Float[Array, ""]:
    """Median of the valid values; NaN where no value is valid."""
    return quantiles(values, valid, (0.5,))[0]


@jax.custom_jvp
def _ascending(values: Float[Array, " n"]) -> Float[Array, " n"]:
    """Sorted values; sorted as bit patterns, because XLA on a CPU sorts integers four times as fast as floats."""
    return _number(jax.lax.sort(_pattern(values), is_stable=False), values.dtype)


@_ascending.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    order = jnp.argsort(_pattern(primals[0]))
    return primals[0][order], tangents[0][order]


def _pattern(values: Float[Array, " n"]) -> Int[Array, " n"]:
    """Bit patterns as integers that have the order of the numbers."""
    integer = jnp.dtype(f"int{8 * values.dtype.itemsize}")
    bits = jax.lax.bitcast_convert_type(values, integer)
    return jnp.where(bits < 0, bits ^ np.iinfo(integer).max, bits)


def _number(pattern: Int[Array, " n"], dtype: DTypeLike) -> Float[Array, " n"]:
    bits = jnp.where(pattern < 0, pattern ^ np.iinfo(pattern.dtype).max, pattern)
    return jax.lax.bitcast_convert_type(bits, dtype)
