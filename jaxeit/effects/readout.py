"""Readout: from the quantity at a terminal to the numbers in a recording."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._base import AbstractReadoutEffect, Stream, parameter


class BaselineDrift(AbstractReadoutEffect):
    """Each channel wanders as a random walk, in proportion to its own root mean square.

    | meaning                            | default | range        | unit      | source     |
    |------------------------------------|---------|--------------|-----------|------------|
    | rate: relative std after 1 s       | 1e-4    | 0 to 1e-3    | 1/sqrt(s) | assumption |
    """

    rank: ClassVar[int] = -1

    rate: Float[Array, ""] = parameter(1e-4)
    stream: Stream = eqx.field(static=True, default=Stream.EIT)

    def __call__(self, series, key, interval):
        steps = jax.random.normal(key, series.shape, jnp.float32).astype(series.dtype)
        size = self.rate * jnp.sqrt(interval) * _rms(series)
        return series + jnp.cumsum(steps, 0) * size


class Noise(AbstractReadoutEffect):
    """White noise with the same standard deviation in every channel and frame.

    | meaning                               | default | unit                 | source          |
    |---------------------------------------|---------|----------------------|-----------------|
    | std                                   | 1       | that of the stream   | set it          |
    """

    std: Float[Array, ""] = parameter(1.0)
    stream: Stream = eqx.field(static=True, default=Stream.EIT)

    def __call__(self, series, key, interval):
        noise = jax.random.normal(key, series.shape, jnp.float32).astype(series.dtype)
        return series + self.std * noise


class Quantisation(AbstractReadoutEffect):
    """The converter rounds to steps and clips at the ends of its range.

    | meaning                       | unit               | source |
    |-------------------------------|--------------------|--------|
    | step                          | that of the stream | set it |
    | lowest, highest value it has  | that of the stream | set it |
    """

    rank: ClassVar[int] = 1  # after everything that adds to the signal

    step: Float[Array, ""] = parameter(1.0)
    lowest: Float[Array, ""] = parameter(-jnp.inf)
    highest: Float[Array, ""] = parameter(jnp.inf)
    stream: Stream = eqx.field(static=True, default=Stream.EIT)

    def __call__(self, series, key, interval):
        return jnp.clip(jnp.round(series / self.step) * self.step, self.lowest, self.highest)


def _rms(series: Float[Array, "time channels"]) -> Float[Array, " channels"]:
    return jnp.sqrt(jnp.mean(series**2, 0))
