"""Random numbers of effects, always drawn in float32, so that float32 and float64 models have the same numbers."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float, Int, Key

from .base import AbstractEffect, keys

PLANE_WAVES = 256
"""Number of plane waves in a random field, whose sum is Gaussian to within 1/256 in kurtosis."""


def normal(key: Key[Array, ""], series: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Standard normal numbers of the series' shape."""
    return jax.random.normal(key, series.shape, jnp.float32).astype(series.dtype)


def own_normal(effect: AbstractEffect, seed: Int[Array, ""], shape: tuple[int, ...], dtype: DTypeLike) -> Array:
    """Standard normal numbers that depend on the kind of effect and on its seed only."""
    (key,) = keys((effect,), jax.random.key(seed))
    return jax.random.normal(key, shape, jnp.float32).astype(dtype)


def own_field(
    effect: AbstractEffect, seed: Int[Array, ""], length: Float[Array, ""], places: Float[Array, "places 2"]
) -> Float[Array, " places"]:
    """A zero-mean, unit-variance field with covariance exp(-r^2 / (2 length^2)), drawn as in `own_normal`.

    Random Fourier features (Rahimi and Recht 2007): a sum of plane waves whose wave vectors have
    the covariance's spectrum; a function of place, so that the field does not depend on the mesh.
    """
    (key,) = keys((effect,), jax.random.key(seed))
    waves, phases = jax.random.split(key)
    k = jax.random.normal(waves, (PLANE_WAVES, 2), jnp.float32).astype(places.dtype) / length
    phase = jax.random.uniform(phases, (PLANE_WAVES,), jnp.float32).astype(places.dtype)
    return jnp.sqrt(2.0 / PLANE_WAVES) * jnp.cos(places @ k.T + 2 * jnp.pi * phase).sum(1)
