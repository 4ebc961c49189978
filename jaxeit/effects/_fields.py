"""Smooth random fields that are functions of place, so that every mesh sees the same one."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

_WAVES = 256  # the sum is Gaussian to within 1/256 in kurtosis


def gaussian_field(
    seed: Int[Array, ""], length: Float[Array, ""], places: Float[Array, "places 2"]
) -> Float[Array, " places"]:
    """A zero-mean, unit-variance field with covariance exp(-r^2 / (2 length^2)).

    Random Fourier features (Rahimi and Recht 2007): a sum of plane waves whose wave vectors have
    the covariance's spectrum.  Drawn in float32 whatever the precision, so that float32 and float64
    models see the same sheet.
    """
    waves, phases = jax.random.split(jax.random.key(seed))
    k = jax.random.normal(waves, (_WAVES, 2), jnp.float32).astype(places.dtype) / length
    phase = jax.random.uniform(phases, (_WAVES,), jnp.float32).astype(places.dtype)
    return jnp.sqrt(2.0 / _WAVES) * jnp.cos(places @ k.T + 2 * jnp.pi * phase).sum(1)
