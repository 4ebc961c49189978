"""Readout: errors between the quantity at a terminal and the numbers in a recording."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .base import AbstractReadoutEffect, AbstractScanEffect, parameter, require_relation
from .quantities import HistoryInputs, Series, State, StreamKind
from .random import normal, own_normal

POLE_RATIO = 4.0
"""Ratio of the corner frequencies of neighbouring low passes."""

POLES = 1.08 * POLE_RATIO ** -np.arange(12)
"""Corner frequencies in rad per sample; the first one is fitted to the spectrum near half the sample rate."""


class ScanSkew(AbstractScanEffect):
    """The readings of a frame are taken one after the other, each at its own time: ``when + stretch nominal``.

    | meaning                                        | default | range    | unit | source                            |
    |------------------------------------------------|---------|----------|------|-----------------------------------|
    | stretch: true times over the protocol's        | 1       | 0.5 to 2 | 1    | the skin's protocol               |
    """

    stretch: Float[Array, ""] = parameter(1.0)

    def __call__(
        self, when: Float[Array, " readings"], nominal: Float[Array, " readings"]
    ) -> Float[Array, " readings"]:
        return when + self.stretch * nominal


class IntermittentElectrode(AbstractReadoutEffect):
    """A loose electrode opens and closes at random, frame by frame: a telegraph process with two rates.

    While it is open, readings that drive through it have no current and are 0, and readings that sense with it have
    a floating input: a potential drawn for each frame, equal for all readings that sense with it, with their sign.
    The contact does not change within a frame.  `ElectrodeFault` describes an electrode that is always open.

    | meaning                                | default | range        | unit | source     |
    |----------------------------------------|---------|--------------|------|------------|
    | electrode, counted from 0              | 0       |              |      |            |
    | rate of opening while it is closed     | 0.1     | 0 to 10      | 1/s  | assumption |
    | duration of a gap, its mean            | 0.2     | 0.005 to 10  | s    | assumption |
    | floating: std of the floating input    | 0.01    | 0 to 1       | V    | assumption |
    """

    rank: ClassVar[int] = -3  # a fault of the skin acts before the electronics
    of_pairs: ClassVar[bool] = True
    stream: ClassVar[StreamKind] = StreamKind.EIT  # type: ignore[misc]

    electrode: Int[Array, ""] = parameter(0)
    rate: Float[Array, ""] = parameter(0.1)
    duration: Float[Array, ""] = parameter(0.2, above=0.0)
    floating: Float[Array, ""] = parameter(0.01)

    def start(self, first: Float[Array, " channels"]) -> State:
        return jnp.zeros((), bool)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        chance, floating = jax.random.split(inputs.key)
        # Exact for a two-state process, which relaxes to its mean open share at the sum of both rates.
        both = self.rate + 1 / self.duration
        turned = -jnp.expm1(-both * inputs.interval) / both
        to_open, to_stay = self.rate * turned, 1 - turned / self.duration
        numbers = jax.random.uniform(chance, series.shape[:1], jnp.float32).astype(turned.dtype)

        def step(was_open: Array, number: Array) -> tuple[Array, Array]:
            is_open = number < jnp.where(was_open, to_stay, to_open)
            return is_open, is_open

        state, is_open = jax.lax.scan(step, state, numbers)
        touches = inputs.pattern == self.electrode
        sign = touches[:, 2].astype(series.dtype) - touches[:, 3].astype(series.dtype)
        lost = jnp.outer(self.floating * normal(floating, series[:, 0]), sign)
        lost = jnp.where(touches[:, :2].any(1), 0, lost).astype(series.dtype)
        return jnp.where(is_open[:, None] & touches.any(1), lost, series), state


class MuxSettling(AbstractReadoutEffect):
    """The output has not fully settled from the previous reading: ``v + (v_before - v) exp(-settle / time_constant)``.

    The channels are in the order of the scan; the first of a frame comes after the last of the frame before.

    | meaning                                     | default | range      | unit | source                        |
    |---------------------------------------------|---------|------------|------|-------------------------------|
    | time_constant                               | 0.5     | 0.1 to 3   | us   | assumption                    |
    | settle: time left before the value is taken | 10      | 1 to 10    | us   | at most what a reading takes  |
    """

    rank: ClassVar[int] = -2

    time_constant: Float[Array, ""] = parameter(0.5e-6)
    settle: Float[Array, ""] = parameter(10e-6)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def start(self, first: Float[Array, " channels"]) -> State:
        return first[-1]

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        # All frames start from zero in parallel; each then adds the end of the frame before it. 1024 frames of 550
        # readings take 550 + 1024 steps instead of 563,200.
        times = self.settle / self.time_constant * jnp.arange(1, series.shape[1] + 1, dtype=float)
        left = jnp.exp(-times).astype(series.dtype)
        alone = _decaying_sums(left[0], jnp.zeros_like(series[:, 0]), (1 - left[0]) * series.T).T
        last = _decaying_sums(left[-1], state, alone[:, -1])
        before = jnp.concatenate([state[None], last[:-1]])
        return alone + jnp.outer(before, left), last[-1]


class BaselineDrift(AbstractReadoutEffect):
    """Each channel drifts as a random walk, in proportion to its own value at rest.

    | meaning                            | default | range        | unit      | source     |
    |------------------------------------|---------|--------------|-----------|------------|
    | rate: relative std after 1 s       | 1e-4    | 0 to 1e-3    | 1/sqrt(s) | assumption |
    """

    rank: ClassVar[int] = -1

    rate: Float[Array, ""] = parameter(1e-4)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def start(self, first: Float[Array, " channels"]) -> State:
        return jnp.zeros_like(first), jnp.abs(first)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        walked, size = state
        std = (self.rate * jnp.sqrt(inputs.interval)).astype(series.dtype)
        walk = _decaying_sums(1.0, walked, std * normal(inputs.key, series))
        return series + size * walk, (walk[-1], size)


class GainError(AbstractReadoutEffect):
    """Each channel has a constant error of gain: ``v (1 + g)``, g normal.

    | meaning                     | default | range     | unit | source               |
    |-----------------------------|---------|-----------|------|----------------------|
    | std of g                    | 2e-3    | 0 to 0.02 | 1    | assumption: resistors |
    | seed of the electronics     | 0       |           |      |                      |
    """

    rank: ClassVar[int] = -1

    std: Float[Array, ""] = parameter(2e-3)
    seed: Int[Array, ""] = parameter(0)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        return series * (1 + self.std * own_normal(self, self.seed, series.shape[1:], series.dtype)), state


class LoadCellError(AbstractReadoutEffect):
    """The characteristic of a load cell is curved: ``F + 4 n F_max x (1 - |x|)``, ``x = F / F_max``, largest error n.

    | meaning                                  | default | range     | unit | source                  |
    |------------------------------------------|---------|-----------|------|-------------------------|
    | nonlinearity n, of the full scale        | 1e-3    | 0 to 0.01 | 1    | assumption              |
    | full_scale F_max                         | 50      |           | N    | the paper's load cell   |
    """

    rank: ClassVar[int] = -1
    stream: ClassVar[StreamKind] = StreamKind.FORCE  # type: ignore[misc]

    nonlinearity: Float[Array, ""] = parameter(1e-3, least=-jnp.inf)
    full_scale: Float[Array, ""] = parameter(50.0, above=0.0)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        return series * (1 + 4 * self.nonlinearity * (1 - jnp.abs(series) / self.full_scale)), state


class MultiplicativeNoise(AbstractReadoutEffect):
    """White noise in proportion to the reading: ``v (1 + std n)``.

    | meaning  | default | range     | unit | source                                |
    |----------|---------|-----------|------|---------------------------------------|
    | std      | 1e-3    | 0 to 0.01 | 1    | AD5933 boards: below 0.3 % in all     |
    """

    std: Float[Array, ""] = parameter(1e-3)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        return series * (1 + self.std * normal(inputs.key, series)), state


class Noise(AbstractReadoutEffect):
    """White noise with the same standard deviation in every channel and frame.

    | meaning                               | default | unit                 | source          |
    |---------------------------------------|---------|----------------------|-----------------|
    | std                                   | 1       | that of the stream   | set it          |
    """

    to_be_set: ClassVar[tuple[str, ...]] = ("std",)

    std: Float[Array, ""] = parameter(1.0)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        return series + self.std * normal(inputs.key, series), state


class PinkNoise(AbstractReadoutEffect):
    """1/f noise with the one-sided spectral density ``amplitude^2 / f`` at any rate of the stream.

    White noise passes twelve first-order low passes with corners a factor of four apart (Keshner 1982): the density
    is within 10 % of 1/f from 1e-5 to a half of the rate.  The filters start at rest, so that noise slower than the
    recording is missing.

    | meaning                                  | default | unit               | source |
    |------------------------------------------|---------|--------------------|--------|
    | amplitude: root of the density at 1 Hz   | 1       | that of the stream | set it |
    """

    to_be_set: ClassVar[tuple[str, ...]] = ("amplitude",)

    amplitude: Float[Array, ""] = parameter(1.0)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def start(self, first: Float[Array, " channels"]) -> State:
        return jnp.zeros((len(POLES), first.size), first.dtype)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        keep = jnp.asarray(np.exp(-POLES), series.dtype)[:, None]
        weight = jnp.asarray(np.log(POLE_RATIO) * np.sqrt(POLES / np.pi), series.dtype)[:, None]

        def step(state: Array, white: Array) -> tuple[Array, Array]:
            state = keep * state + white
            return state, (weight * state).sum(0)

        state, pink = jax.lax.scan(step, state, normal(inputs.key, series))
        return series + self.amplitude * pink, state


class Quantisation(AbstractReadoutEffect):
    """The converter rounds to steps and clips at the ends of its range.

    | meaning                       | unit               | source |
    |-------------------------------|--------------------|--------|
    | step                          | that of the stream | set it |
    | lowest, highest value it has  | that of the stream | set it |
    """

    rank: ClassVar[int] = 1  # after all effects that add to the signal
    to_be_set: ClassVar[tuple[str, ...]] = ("step",)

    step: Float[Array, ""] = parameter(1.0, above=0.0)
    lowest: Float[Array, ""] = parameter(-jnp.inf, least=-jnp.inf, finite=False)
    highest: Float[Array, ""] = parameter(jnp.inf, least=-jnp.inf, finite=False)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def __check_init__(self) -> None:
        require_relation(self, ("lowest", "highest"), lambda low, high: bool(low < high), "a range whose ends differ")

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        return jnp.clip(jnp.round(series / self.step) * self.step, self.lowest, self.highest), state


class AdcRanges(AbstractReadoutEffect):
    """A converter after an amplifier with a gain for each channel rounds to ``2 full_scale / 2^bits / gain``.

    The gain is the largest one with ``headroom`` times the value at rest within the range, else the smallest.  The
    converter clips at the ends of its counts, ``-2^(bits-1)`` and ``2^(bits-1) - 1``.

    | meaning                                | default          | range    | unit               | source        |
    |----------------------------------------|------------------|----------|--------------------|---------------|
    | bits                                   | 14               | 12 to 16 | 1                  | assumption    |
    | full_scale: plus and minus, at gain 1  | 2.5              |          | that of the stream | assumption    |
    | gains to choose from                   | 1, 2, 4 .. 128   |          | 1                  | assumption    |
    | headroom                               | 2                | from 1   | 1                  | a 100 % touch |
    """

    rank: ClassVar[int] = 1

    bits: Int[Array, ""] = parameter(14, least=1, most=52)
    full_scale: Float[Array, ""] = parameter(2.5, above=0.0)
    gains: Float[Array, " gains"] = parameter(tuple(2.0**k for k in range(8)), above=0.0)
    headroom: Float[Array, ""] = parameter(2.0, above=0.0)
    stream: StreamKind = eqx.field(static=True, default=StreamKind.EIT)

    def start(self, first: Float[Array, " channels"]) -> State:
        gains = self.gains.astype(first.dtype)
        fits = jnp.abs(first)[:, None] * self.headroom * gains <= self.full_scale
        return jnp.where(fits, gains, gains.min()).max(1)

    def __call__(self, series: Series, state: State, inputs: HistoryInputs) -> tuple[Series, State]:
        half = jnp.exp2(self.bits.astype(float) - 1).astype(series.dtype)
        step = (self.full_scale / half / state).astype(series.dtype)
        return jnp.clip(jnp.round(series / step), -half, half - 1) * step, state


def _decaying_sums(
    keep: Float[Array, ""] | float, start: Float[Array, "*channels"], parts: Float[Array, " n *channels"]
) -> Float[Array, " n *channels"]:
    """``s = keep s + part`` for each of the parts, from ``start``."""

    def step(total: Array, part: Array) -> tuple[Array, Array]:
        total = keep * total + part
        return total, total

    return jax.lax.scan(step, start, parts)[1]
