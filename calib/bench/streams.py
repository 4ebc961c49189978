"""Simulated streams of a bench: what each instrument records, block by block of samples.

A block is a function of its number and of the state after the previous block. Memory is therefore bounded, and a run
that was interrupted can resume.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxeit as je
from jaxeit import effects as fx

from .bench import Bench
from .interpolation import frame_solver
from .motion import BenchMotion, barometer_rise, loads_at, phase_count, planned_motion, temperature_rise
from .press_frames import PressFrames
from .resolution import require_resolved

BLOCK_ROWS = 1024  # samples of a block
SLIDE_PLACES = 65  # places along a slide at which the response of the pads is computed


class SampleBlock(NamedTuple):
    """A block of samples as it reaches the host.

    | field  | meaning                                           | shape            | unit          |
    |--------|---------------------------------------------------|------------------|---------------|
    | device | time of the sample by the clock of the device     | (rows,)          | s             |
    | host   | time of arrival                                   | (rows,)          | s             |
    | values |                                                   | (rows, channels) | of the stream |
    | gap    | whether samples were lost before this one         | (rows,)          |               |
    """

    device: Float[np.ndarray, " rows"]
    host: Float[np.ndarray, " rows"]
    values: Float[np.ndarray, "rows channels"]
    gap: Bool[np.ndarray, " rows"]


class AbstractSimulatedStream(ABC):
    """One simulated stream of a bench; `rate` is its number of samples per second, Hz."""

    kind: fx.StreamKind
    rate: float

    def __init__(self, bench: Bench, motion: BenchMotion, key: Any):
        self.bench, self.motion, self._key = bench, motion, key
        self._readouts = fx.chosen(bench.scene.effects, fx.AbstractReadoutEffect, self.kind)
        self._clocks = fx.chosen(bench.scene.effects, fx.AbstractClockEffect, self.kind)

    @property
    def samples(self) -> int:
        """Number of samples in the whole recording."""
        return int(self.bench.duration * self.rate)

    @property
    def blocks(self) -> int:
        """Number of blocks in the whole recording."""
        return -(-self.samples // BLOCK_ROWS)

    @property
    def has_clock(self) -> bool:
        """Whether the clock of the device is simulated, so that device and host times differ."""
        return bool(self._clocks)

    @cached_property
    def resting(self) -> Float[np.ndarray, " channels"]:
        """A sample without contact."""
        return self._resting()

    def start(self) -> Any:
        """The state before the first block."""
        return self._before(), fx.history_start(self._readouts, jnp.asarray(self.resting))

    def block(self, number: int, state: Any) -> tuple[SampleBlock, Any]:
        """Simulate block ``number``; returns its samples and the state for the next block."""
        times, line = self.times(number), self.line(number, 0)
        values, before = self.quantity(number, times, state[0])
        after = state[1]
        if self._readouts:
            recorded, after = history(self._readouts, jnp.asarray(values), after, line)
            values = np.asarray(recorded)
        return self._received(number, times, values), (before, after)

    def times(self, number: int) -> Float[np.ndarray, " rows"]:
        """Times (s) of the samples of a block; those of the last block continue beyond the end of the recording."""
        return (number * BLOCK_ROWS + np.arange(BLOCK_ROWS)) / self.rate

    def line(self, number: int, purpose: int) -> fx.HistoryInputs:
        """Inputs of history effects for a block; each ``purpose`` has its own random key."""
        times = self.times(number)
        key = jax.random.fold_in(jax.random.fold_in(self._key, purpose), number)
        warmth, air = jnp.asarray(temperature_rise(self.bench, times)), jnp.asarray(barometer_rise(self.bench, times))
        pattern = jnp.asarray(self.bench.scene.skin.protocol.pairs, jnp.int32)
        pattern = pattern if self.kind is fx.StreamKind.EIT else pattern[:0]
        return fx.HistoryInputs(key, jnp.asarray(1 / self.rate), warmth, air, pattern)

    def _received(self, number: int, times: np.ndarray, values: np.ndarray) -> SampleBlock:
        used = min(BLOCK_ROWS, self.samples - number * BLOCK_ROWS)
        lost, device, host = np.zeros(BLOCK_ROWS, bool), times, times
        if self._clocks:
            packets = fx.Packets(jnp.asarray(times), jnp.asarray(times), jnp.asarray(lost))
            key = jax.random.fold_in(jax.random.fold_in(self._key, 2), number)
            device, host, lost = (np.asarray(a) for a in _clocked(self._clocks, packets, key))
        kept = ~lost[:used]
        gap = np.concatenate([[False], lost[: used - 1]])
        return SampleBlock(*(a[:used][kept] for a in (device, host, values, gap)))

    def _before(self) -> Any:
        return ()

    @abstractmethod
    def _resting(self) -> Float[np.ndarray, " channels"]: ...

    @abstractmethod
    def quantity(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        """Physical quantity that the instrument records (rows, channels), and the state for the next block."""


@eqx.filter_jit
def history(
    effects: tuple[fx.AbstractHistoryEffect, ...],
    series: Float[Array, "time channels"],
    states: Any,
    line: fx.HistoryInputs,
) -> tuple[Float[Array, "time channels"], tuple[Any, ...]]:
    """Compiled form of `jaxeit.effects.history`."""
    return fx.history(effects, series, states, line)


@eqx.filter_jit
def _clocked(effects: tuple[fx.AbstractClockEffect, ...], packets: fx.Packets, key: Array) -> fx.Packets:
    for effect, own in zip(effects, fx.keys(effects, key), strict=True):
        packets = fx.fold([effect], fx.AbstractClockEffect, packets, own)
    return packets


class SimulatedForce(AbstractSimulatedStream):
    """Force of the load cell under the skin: the sum of all loads, N."""

    kind = fx.StreamKind.FORCE

    @property
    def rate(self) -> float:  # type: ignore[override]
        return self.bench.pad_rate

    def _resting(self) -> np.ndarray:
        return np.zeros(1)

    def quantity(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        return loads_at(self.motion, times).load.sum(1, keepdims=True), state


class SimulatedPressure(AbstractSimulatedStream):
    """Gage pressures of the pads, Pa."""

    kind = fx.StreamKind.PRESSURE

    def __init__(self, bench: Bench, motion: BenchMotion, key: Any, model: je.Model):
        super().__init__(bench, motion, key)
        self._effects = fx.chosen(bench.scene.effects, fx.AbstractPneumaticEffect)
        self._response = pad_pressures(bench, motion, model)

    @property
    def rate(self) -> float:  # type: ignore[override]
        return self.bench.pad_rate

    def _resting(self) -> np.ndarray:
        return np.zeros(len(self.bench.scene.skin.pads))

    def _before(self) -> Any:
        return fx.history_start(self._effects, jnp.asarray(self.resting))

    def quantity(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        now = loads_at(self.motion, times)
        table = self._response[now.press]  # (rows, contacts, places, pads)
        at = now.progress * (table.shape[2] - 1)
        left = np.clip(at.astype(int), 0, max(table.shape[2] - 2, 0))
        right = np.minimum(left + 1, table.shape[2] - 1)
        row, contact = np.ogrid[: len(times), : at.shape[1]]
        share = (at - left)[..., None]
        felt = (1 - share) * table[row, contact, left] + share * table[row, contact, right]
        pads = np.einsum("tc,tcp->tp", now.load, felt)
        if not self._effects:
            return pads, state
        out, state = history(self._effects, jnp.asarray(pads), state, self.line(number, 1))
        return np.asarray(out), state


def pad_pressures(
    bench: Bench, motion: BenchMotion, model: je.Model
) -> Float[np.ndarray, "presses contacts places pads"]:
    """Pressure in each pad per newton of each tip (Pa/N) at places along its slide; one place without a slide."""
    response = je.pad_response(bench.scene.skin, model)
    steps = np.linspace(0, 1, SLIDE_PLACES if any(bench.slide) else 1)
    places = motion.places[:, :, None] + steps[:, None] * np.array(bench.slide)
    tip = jnp.asarray(bench.tip_diameter, model.dtype)
    flat = jnp.asarray(places.reshape(-1, 2), model.dtype)
    return np.asarray(_responses(model, response, flat, tip)).reshape(*places.shape[:-1], -1)


@eqx.filter_jit
def _responses(
    model: je.Model, response: Float[Array, "pads elements"], places: Float[Array, "places 2"], tip: Float[Array, ""]
) -> Float[Array, "places pads"]:
    found: Float[Array, "places pads"] = jax.lax.map(
        lambda place: response @ je.model.load_spread(model, place, tip), places
    )
    return found


class SimulatedEit(AbstractSimulatedStream):
    """Voltages of the EIT frames, V."""

    kind = fx.StreamKind.EIT

    def __init__(self, bench: Bench, motion: BenchMotion, key: Any, model: je.Model, tolerance: float):
        super().__init__(bench, motion, key)
        self.model, self._tolerance = model, tolerance
        self._solver = frame_solver(model, bench.tip_diameter)
        self._memory = fx.chosen(bench.scene.effects, fx.AbstractMemoryEffect)
        self._offsets = _offsets(bench)

    @property
    def rate(self) -> float:  # type: ignore[override]
        return self.bench.eit_rate

    def _resting(self) -> np.ndarray:
        untouched = np.zeros((1, self._parameters))
        return np.asarray(self._solver(self.motion.places[0], np.array(self.bench.slide), untouched)[0])

    @property
    def _parameters(self) -> int:
        """Number of parameters of the sheet: load and progress of each tip, and the temperature."""
        return 1 + 2 * int(self.motion.places.shape[1])

    def _solve(self, press: int, points: Float[np.ndarray, "points d"]) -> Float[np.ndarray, "points readings"]:
        """Frames of a press at parameters of the sheet; those without a load and a change of temperature are alike."""
        places = self.motion.places[press]
        changed = points[:, : len(places)].any(1) | (points[:, -1] != 0)
        frames = np.tile(self.resting, (len(points), 1))
        if changed.any():
            frames[changed] = self._solver(places, np.array(self.bench.slide), points[changed])
        return frames

    def _before(self) -> Any:
        return fx.history_start(self._memory, jnp.zeros(self.motion.forces.shape[1]))

    def quantity(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        lag, after = self._lag(number, times, state)
        return self._frames(*self._points(times, self._offsets, lag)), after

    def _lag(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        """Difference of the load that the sheet feels, with memory, from the acting load (rows + 1, contacts) N.

        The last row is for the frame after the block. Returns also the state after the block.
        """
        if not self._memory:
            return np.zeros((len(times) + 1, self.motion.forces.shape[1])), state
        lag, state = self._felt(number, times, state)
        following, _ = self._felt(number + 1, times[-1:] + 1 / self.rate, state)
        return np.concatenate([lag, following]), state

    def _felt(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        load, line = loads_at(self.motion, times).load, self.line(number, 1)
        line = line._replace(temperature=line.temperature[: len(times)], barometer=line.barometer[: len(times)])
        felt, state = history(self._memory, jnp.asarray(load), state, line)
        return np.asarray(felt) - load, state

    def _points(self, times: np.ndarray, offsets: np.ndarray, lag: np.ndarray) -> tuple[np.ndarray, ...]:
        """Press, phase, and parameters of the sheet (rows, offsets, d), ``offsets`` (s) after the times of the frames.

        The lag is interpolated linearly from frame to frame.
        """
        when = times[:, None] + offsets
        now = loads_at(self.motion, when.ravel())
        share = (offsets * self.rate)[:, None]
        shape = (*when.shape, -1)
        load = now.load.reshape(shape) + lag[:-1, None] + share * np.diff(lag, axis=0)[:, None]
        warmer = temperature_rise(self.bench, when) if self._feels_warmth else np.zeros_like(when)
        points = np.concatenate([load, now.progress.reshape(shape), warmer[..., None]], -1)
        return now.press.reshape(when.shape), now.phase.reshape(when.shape), points

    @property
    def solves(self) -> int:
        """Number of solves so far."""
        return self._frames.solves

    def solves_expected(self) -> int:
        """Number of solves in the whole session, if all presses need as many as the first."""
        if self._tolerance == 0:
            return self.samples
        return sum(made.solves for made in self._frames.polynomials(0)) * len(self.motion.start)

    @cached_property
    def _frames(self) -> PressFrames:
        return PressFrames(self._solve, self.resting, self._tolerance, self._extents())

    @cached_property
    def _feels_warmth(self) -> bool:
        """Whether the sheet depends on temperature, and the temperature of this bench changes."""
        if not self.bench.temperature_rate:
            return False
        cold, warm = (je.conductivity(self.model, None, t) for t in (0.0, 1.0))
        return bool(jnp.any(cold != warm))

    def _extents(self) -> tuple[np.ndarray, np.ndarray]:
        """Ranges of the parameters in each phase of each press (presses, phases, d), from the loads without a solve."""
        shape = (len(self.motion.start), phase_count(self.bench), self._parameters)
        low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
        state = self._before()
        between = np.unique(np.quantile(self._offsets, [0, 0.5, 1]))
        for number in range(self.blocks):
            times = self.times(number)
            lag, state = self._lag(number, times, state)
            press, phase, points = self._points(times, between, lag)
            np.minimum.at(low, (press, phase), points)
            np.maximum.at(high, (press, phase), points)
        # The temperature changes in all phases. One range for the whole press lets the phases share their points.
        low[..., -1], high[..., -1] = low[..., -1].min(1, keepdims=True), high[..., -1].max(1, keepdims=True)
        return low, high


def _offsets(bench: Bench) -> Float[np.ndarray, " readings_or_one"]:
    """Time of each reading (s) after its frame; a single number if all readings are simultaneous."""
    effects = fx.chosen(bench.scene.effects, fx.AbstractScanEffect)
    if not effects:
        return np.zeros(1)
    protocol = bench.scene.skin.protocol
    nominal = jnp.asarray(protocol.reading_offsets)
    return np.asarray(fx.fold(effects, fx.AbstractScanEffect, jnp.zeros_like(nominal), nominal))


@dataclass(frozen=True, eq=False)
class SimulatedStreams:
    """All simulated streams of a bench."""

    bench: Bench
    motion: BenchMotion
    eit: SimulatedEit
    pressure: SimulatedPressure
    force: SimulatedForce

    def __iter__(self) -> Iterator[tuple[str, AbstractSimulatedStream]]:
        yield from (("eit", self.eit), ("pressure", self.pressure), ("force", self.force))


def simulated_streams(bench: Bench, fidelity: je.Fidelity) -> SimulatedStreams:
    """Discretise the scene, apply the effects of the stage to its motion, and set up the streams."""
    model = je.discretise(bench.scene, fidelity)
    require_resolved(bench, model)
    laid = fx.laid(model.effects, model.centroids)
    model = eqx.tree_at(lambda m: m.effects, model, laid, is_leaf=lambda x: x is model.effects)
    key = jax.random.key(bench.seed)
    motion = _moved(bench, jax.random.fold_in(key, 0))
    one, two, three = jax.random.split(key, 3)
    return SimulatedStreams(
        bench,
        motion,
        SimulatedEit(bench, motion, one, model, fidelity.interpolation),
        SimulatedPressure(bench, motion, two, model),
        SimulatedForce(bench, motion, three),
    )


def _moved(bench: Bench, key: Any) -> BenchMotion:
    """The planned motion with the errors of the stage; companions move with the first tip."""
    plan = planned_motion(bench)
    effects = fx.chosen(bench.scene.effects, fx.AbstractStageEffect)
    path = fx.Path(*(jnp.asarray(a) for a in (bench.sites, np.zeros(len(plan.start)), plan.pace)))
    for effect, own in zip(effects, fx.keys(effects, key), strict=True):
        path = fx.fold([effect], fx.AbstractStageEffect, path, own)
    places, delay, pace = (np.asarray(a) for a in path)
    return plan._replace(places=plan.places + (places - bench.sites)[:, None], start=plan.start + delay, pace=pace)
