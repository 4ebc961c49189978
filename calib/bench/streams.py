"""What each instrument of a simulated bench records, block by block of samples.

A block is a function of its number and of the state that the block before left: memory is bounded, and a run that was
cut off goes on where it was.
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
from jaxtyping import Bool, Float, Int

import jaxeit as je
from jaxeit import effects as fx

from .frames import Box, Interpolant, boxes, solver
from .motion import Motion, barometer, moments, phases, planned, temperature
from .plan import Bench

_ROWS = 1024  # samples of a block
_PLACES = 65  # along a slide, where the pads' response is taken


class Samples(NamedTuple):
    """A block as it reaches the host.

    | meaning                                 | shape            | unit           |
    |-----------------------------------------|------------------|----------------|
    | device: when taken, by the device       | (rows,)          | s              |
    | host: when received                     | (rows,)          | s              |
    | values                                  | (rows, channels) | of the stream  |
    | gap: samples were lost before this one  | (rows,)          |                |
    """

    device: Float[np.ndarray, " rows"]
    host: Float[np.ndarray, " rows"]
    values: Float[np.ndarray, "rows channels"]
    gap: Bool[np.ndarray, " rows"]


class AbstractRecording(ABC):
    """One stream of a bench."""

    kind: fx.Stream
    rate: float

    def __init__(self, bench: Bench, motion: Motion, key: Any):
        self.bench, self.motion, self._key = bench, motion, key
        self._readouts = fx.chosen(bench.scene.effects, fx.AbstractReadoutEffect, self.kind)
        self._clocks = fx.chosen(bench.scene.effects, fx.AbstractClockEffect, self.kind)

    @property
    def samples(self) -> int:
        """In the whole recording."""
        return int(self.bench.duration * self.rate)

    @property
    def blocks(self) -> int:
        """In the whole recording."""
        return -(-self.samples // _ROWS)

    @property
    def has_clock(self) -> bool:
        """Whether device and host tell different times."""
        return bool(self._clocks)

    @cached_property
    def resting(self) -> Float[np.ndarray, " channels"]:
        """A sample without contact."""
        return self._resting()

    def start(self) -> Any:
        """The state before the first block."""
        return self._before(), fx.history_start(self._readouts, jnp.asarray(self.resting))

    def block(self, number: int, state: Any) -> tuple[Samples, Any]:
        """Block ``number``, and the state for the next."""
        times, line = self.times(number), self.line(number, 0)
        values, before = self.quantity(number, times, state[0])
        after = state[1]
        if self._readouts:
            recorded, after = history(self._readouts, jnp.asarray(values), after, line)
            values = np.asarray(recorded)
        return self._received(number, times, values), (before, after)

    def times(self, number: int) -> Float[np.ndarray, " rows"]:
        """Of the samples of a block, s; those of the last block go on beyond the end."""
        return (number * _ROWS + np.arange(_ROWS)) / self.rate

    def line(self, number: int, purpose: int) -> fx.Line:
        """What history effects know of a block; each purpose has a key of its own."""
        times = self.times(number)
        key = jax.random.fold_in(jax.random.fold_in(self._key, purpose), number)
        warmth, air = jnp.asarray(temperature(self.bench, times)), jnp.asarray(barometer(self.bench, times))
        pattern = jnp.asarray(self.bench.scene.skin.protocol.pattern, jnp.int32)
        pattern = pattern if self.kind is fx.Stream.EIT else pattern[:0]
        return fx.Line(key, jnp.asarray(1 / self.rate), warmth, air, pattern)

    def _received(self, number: int, times: np.ndarray, values: np.ndarray) -> Samples:
        used = min(_ROWS, self.samples - number * _ROWS)
        lost, device, host = np.zeros(_ROWS, bool), times, times
        if self._clocks:
            packets = fx.Packets(jnp.asarray(times), jnp.asarray(times), jnp.asarray(lost))
            key = jax.random.fold_in(jax.random.fold_in(self._key, 2), number)
            device, host, lost = (np.asarray(a) for a in _clocked(self._clocks, packets, key))
        kept = ~lost[:used]
        gap = np.concatenate([[False], lost[: used - 1]])
        return Samples(*(a[:used][kept] for a in (device, host, values, gap)))

    def _before(self) -> Any:
        return ()

    @abstractmethod
    def _resting(self) -> Float[np.ndarray, " channels"]: ...

    @abstractmethod
    def quantity(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        """What the instrument is to record, (rows, channels), and the state for the next block."""


@eqx.filter_jit
def history(effects, series, states, line):
    """`jaxeit.effects.history`, compiled."""
    return fx.history(effects, series, states, line)


@eqx.filter_jit
def _clocked(effects, packets, key):
    for effect, own in zip(effects, fx.keys(effects, key), strict=True):
        packets = fx.fold([effect], fx.AbstractClockEffect, packets, own)
    return packets


class ForceRecording(AbstractRecording):
    """The load cell under the skin: the sum of all loads, N."""

    kind = fx.Stream.FORCE

    @property
    def rate(self) -> float:  # type: ignore[override]
        return self.bench.pad_rate

    def _resting(self):
        return np.zeros(1)

    def quantity(self, number, times, state):
        return moments(self.motion, times).load.sum(1, keepdims=True), state


class PressureRecording(AbstractRecording):
    """The pads' gage pressures, Pa."""

    kind = fx.Stream.PRESSURE

    def __init__(self, bench: Bench, motion: Motion, key: Any, model: je.Model):
        super().__init__(bench, motion, key)
        self._effects = fx.chosen(bench.scene.effects, fx.AbstractPneumaticEffect)
        self._response = pad_pressures(bench, motion, model)

    @property
    def rate(self) -> float:  # type: ignore[override]
        return self.bench.pad_rate

    def _resting(self):
        return np.zeros(len(self.bench.scene.skin.pads))

    def _before(self):
        return fx.history_start(self._effects, jnp.asarray(self.resting))

    def quantity(self, number, times, state):
        now = moments(self.motion, times)
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


def pad_pressures(bench: Bench, motion: Motion, model: je.Model) -> Float[np.ndarray, "presses contacts places pads"]:
    """Pressure in each pad per newton of each tip, Pa/N, at places along its slide (one if it does not)."""
    response = je.pad_response(bench.scene.skin, model)
    steps = np.linspace(0, 1, _PLACES if any(bench.slide) else 1)
    places = motion.places[:, :, None] + steps[:, None] * np.array(bench.slide)
    tip = jnp.asarray(bench.tip_diameter, model.dtype)
    flat = jnp.asarray(places.reshape(-1, 2), model.dtype)
    return np.asarray(_responses(model, response, flat, tip)).reshape(*places.shape[:-1], -1)


@eqx.filter_jit
def _responses(model, response, places, tip):
    return jax.lax.map(lambda place: response @ je.load_spread(model, place, tip), places)


class EitRecording(AbstractRecording):
    """The voltages of the frames, V."""

    kind = fx.Stream.EIT

    def __init__(self, bench: Bench, motion: Motion, key: Any, model: je.Model, tolerance: float):
        super().__init__(bench, motion, key)
        self.model, self._tolerance = model, tolerance
        self._solver = solver(model, bench.tip_diameter)
        self._memory = fx.chosen(bench.scene.effects, fx.AbstractMemoryEffect)
        self._offsets = _offsets(bench)
        self._ready: dict[int, list[Interpolant]] = {}
        self.solves = 0

    @property
    def rate(self) -> float:  # type: ignore[override]
        return self.bench.eit_rate

    def _resting(self):
        return np.asarray(je.forward(self.model))

    def _before(self):
        return fx.history_start(self._memory, jnp.zeros(self.motion.forces.shape[1]))

    def quantity(self, number, times, state):
        lag, after = self._lag(number, times, state)
        press, phase, points = self._points(times, self._offsets, lag)
        out = np.empty((len(times), len(self.resting)))
        box = self._owners[press, phase]
        for this in np.unique(press):
            for which in np.unique(box[press == this]):
                mine = (press == this) & (box == which)
                rows = mine.any(1)
                out[rows] = np.where(mine[rows], self._frames(this, which, points[rows]), out[rows])
        return out, after

    def _frames(self, press: int, which: int, points: np.ndarray) -> np.ndarray:
        if self._tolerance > 0:
            return self._interpolants(press)[which](points)
        flat, back = np.unique(points.reshape(-1, points.shape[-1]), axis=0, return_inverse=True)
        self.solves += len(flat)
        solved = self._solver(self.motion.places[press], np.array(self.bench.slide))(flat)
        return solved[back.reshape(points.shape[:2]), np.arange(solved.shape[1])]

    def _lag(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        """How far the load that the sheet feels is from the one that acts, at each frame and at the one after the
        last, (rows + 1, contacts) N; and the state after these frames."""
        if not self._memory:
            return np.zeros((len(times) + 1, self.motion.forces.shape[1])), state
        lag, state = self._felt(number, times, state)
        following, _ = self._felt(number + 1, times[-1:] + 1 / self.rate, state)
        return np.concatenate([lag, following]), state

    def _felt(self, number: int, times: np.ndarray, state: Any) -> tuple[np.ndarray, Any]:
        load, line = moments(self.motion, times).load, self.line(number, 1)
        line = line._replace(temperature=line.temperature[: len(times)], barometer=line.barometer[: len(times)])
        felt, state = history(self._memory, jnp.asarray(load), state, line)
        return np.asarray(felt) - load, state

    def _points(self, times: np.ndarray, offsets: np.ndarray, lag: np.ndarray) -> tuple[np.ndarray, ...]:
        """Press, phase, and what the sheet is a function of, (rows, offsets, d), at times ``offsets`` after those of
        the frames; the lag is taken as linear from frame to frame."""
        when = times[:, None] + offsets
        now = moments(self.motion, when.ravel())
        share = (offsets * self.rate)[:, None]
        shape = (*when.shape, -1)
        load = now.load.reshape(shape) + lag[:-1, None] + share * np.diff(lag, axis=0)[:, None]
        warmer = temperature(self.bench, when) if self._feels_warmth else np.zeros_like(when)
        points = np.concatenate([load, now.progress.reshape(shape), warmer[..., None]], -1)
        return now.press.reshape(when.shape), now.phase.reshape(when.shape), points

    def solves_expected(self) -> int:
        """In the whole session, if all presses take as many as the first."""
        if self._tolerance == 0:
            return self.samples
        return sum(made.solves for made in self._interpolants(0)) * len(self.motion.start)

    @cached_property
    def _feels_warmth(self) -> bool:
        """Whether the scene's sheet changes with the temperature of this bench."""
        if not self.bench.temperature_rate:
            return False
        cold, warm = (je.conductivity(self.model, None, t) for t in (0.0, 1.0))
        return bool(jnp.any(cold != warm))

    @cached_property
    def _extents(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and largest point of each phase of each press, (presses, phases, d): a run through the loads alone."""
        shape = (len(self.motion.start), phases(self.bench), 2 * self.motion.forces.shape[1] + 1)
        low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
        state = self._before()
        between = np.unique(np.quantile(self._offsets, [0, 0.5, 1]))
        for number in range(self.blocks):
            times = self.times(number)
            lag, state = self._lag(number, times, state)
            press, phase, points = self._points(times, between, lag)
            np.minimum.at(low, (press, phase), points)
            np.maximum.at(high, (press, phase), points)
        # The temperature moves in all phases: one range for the press, so that the phases can share their points.
        low[..., -1], high[..., -1] = low[..., -1].min(1, keepdims=True), high[..., -1].max(1, keepdims=True)
        return low, high

    @cached_property
    def _boxes(self) -> tuple[list[list[Box]], Int[np.ndarray, "presses phases"]]:
        low, high = self._extents
        seen = np.isfinite(low) & np.isfinite(high)
        scale = np.where(seen, high, 0).max((0, 1)) - np.where(seen, low, 0).min((0, 1))
        parts = [boxes(a, b, scale) for a, b in zip(low, high, strict=True)]
        return [part[0] for part in parts], np.array([part[1] for part in parts])

    @property
    def _owners(self) -> Int[np.ndarray, "presses phases"]:
        return self._boxes[1]

    def _interpolants(self, press: int) -> list[Interpolant]:
        if press not in self._ready:
            self._ready = {p: made for p, made in self._ready.items() if p >= press - 1}
            solve = self._solver(self.motion.places[press], np.array(self.bench.slide))
            made = [Interpolant(box, solve, self.resting, self._tolerance) for box in self._boxes[0][press]]
            self.solves += sum(m.solves for m in made)
            self._ready[press] = made
        return self._ready[press]


def _offsets(bench: Bench) -> Float[np.ndarray, " readings_or_one"]:
    """When each reading is taken, s after its frame; one number if all are taken at once."""
    effects = fx.chosen(bench.scene.effects, fx.AbstractScanEffect)
    if not effects:
        return np.zeros(1)
    protocol = bench.scene.skin.protocol
    nominal = jnp.arange(protocol.readings) * protocol.reading_time
    return np.asarray(fx.fold(effects, fx.AbstractScanEffect, jnp.zeros_like(nominal), nominal))


@dataclass(frozen=True, eq=False)
class Recordings:
    """All that a bench records."""

    bench: Bench
    motion: Motion
    eit: EitRecording
    pressure: PressureRecording
    force: ForceRecording

    def __iter__(self) -> Iterator[tuple[str, AbstractRecording]]:
        yield from (("eit", self.eit), ("pressure", self.pressure), ("force", self.force))


def recordings(bench: Bench, fidelity: je.Fidelity) -> Recordings:
    """Discretise the scene, move the stage, and make the streams ready."""
    model = je.discretise(bench.scene, fidelity)
    laid = fx.laid(model.effects, model.centroids)
    model = eqx.tree_at(lambda m: m.effects, model, laid, is_leaf=lambda x: x is model.effects)
    key = jax.random.key(bench.seed)
    motion = _moved(bench, jax.random.fold_in(key, 0))
    one, two, three = jax.random.split(key, 3)
    return Recordings(
        bench,
        motion,
        EitRecording(bench, motion, one, model, fidelity.interpolation),
        PressureRecording(bench, motion, two, model),
        ForceRecording(bench, motion, three),
    )


def _moved(bench: Bench, key: Any) -> Motion:
    """The plan as the stage follows it; companions move with the first tip."""
    plan = planned(bench)
    effects = fx.chosen(bench.scene.effects, fx.AbstractStageEffect)
    path = fx.Path(*(jnp.asarray(a) for a in (bench.sites, np.zeros(len(plan.start)), plan.pace)))
    for effect, own in zip(effects, fx.keys(effects, key), strict=True):
        path = fx.fold([effect], fx.AbstractStageEffect, path, own)
    places, delay, pace = (np.asarray(a) for a in path)
    return plan._replace(places=plan.places + (places - bench.sites)[:, None], start=plan.start + delay, pace=pace)
