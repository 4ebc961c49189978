"""Clocks and links: the time stamps of samples, their arrival at the host, and losses on the way."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from .base import AbstractClockEffect, parameter
from .quantities import Packets, StreamKind

# Limits of `ClockError`: times since 1970 and their sums with delays fit nanoseconds in 64 bits.
MOST_SKEW, LARGEST_TIME, LONGEST_DELAY = 1.0, 4e9, 3600.0  # 1, s, s


class ClockError(AbstractClockEffect):
    """The device's clock runs independently of the host's, and samples arrive late.

    ``device <- (1 + skew) device + offset``; ``host <- host + latency + x``, x exponential with mean ``jitter``,
    no earlier in a block than the sample before; if ``batch`` is not 0, at the next whole multiple of ``batch``.

    | meaning                                  | default | range            | unit | source                     |
    |------------------------------------------|---------|------------------|------|----------------------------|
    | skew                                     | 50e-6   | -50e-6 to 50e-6  | 1    | assumption                 |
    | offset of the device's clock             | 0       |                  | s    |                            |
    | latency, the smallest                    | 1e-3    | 0 to 0.02        | s    | assumption                 |
    | jitter: mean of what comes on top        | 5e-4    | 0 to 0.005       | s    | assumption: TCP            |
    | batch: period of the adapter, 0 for none | 0       | 1e-3 to 16e-3    | s    | assumption: USB serial     |
    """

    skew: Float[Array, ""] = parameter(50e-6, above=-1.0, most=MOST_SKEW)
    offset: Float[Array, ""] = parameter(0.0, least=-LARGEST_TIME, most=LARGEST_TIME, unit="s")
    latency: Float[Array, ""] = parameter(1e-3, most=LONGEST_DELAY, unit="s")
    jitter: Float[Array, ""] = parameter(5e-4, most=LONGEST_DELAY, unit="s")
    batch: Float[Array, ""] = parameter(0.0, most=LONGEST_DELAY, unit="s")
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def __call__(self, packets: Packets, key: Key[Array, ""]) -> Packets:
        late = jax.random.exponential(key, packets.host.shape, jnp.float32).astype(packets.host.dtype)
        sent = jax.lax.cummax(packets.host + self.latency + self.jitter * late)
        period = jnp.where(self.batch > 0, self.batch, 1)
        host = jnp.where(self.batch > 0, jnp.ceil(sent / period) * period, sent)
        return packets._replace(device=packets.device * (1 + self.skew) + self.offset, host=host)


class DropOut(AbstractClockEffect):
    """Samples are lost on the way to the host, independently and with the same probability.

    | meaning       | default | range     | unit | source     |
    |---------------|---------|-----------|------|------------|
    | probability   | 1e-3    | 0 to 0.05 | 1    | assumption |
    """

    probability: Float[Array, ""] = parameter(1e-3, most=1.0)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def __call__(self, packets: Packets, key: Key[Array, ""]) -> Packets:
        lost = jax.random.uniform(key, packets.lost.shape, jnp.float32) < self.probability.astype(jnp.float32)
        return packets._replace(lost=packets.lost | lost)
