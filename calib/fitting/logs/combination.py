"""Fitted combinations of the channels of a sensor into one signal, as arrays that files can keep."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class AbstractCombination(abc.ABC):
    """One signal of all channels. Subclasses are frozen dataclasses whose fields are arrays."""

    name: ClassVar[str]

    @abc.abstractmethod
    def signal(self, time: np.ndarray, values: Float[np.ndarray, "n channels"]) -> Float[np.ndarray, " n"]:
        """Signal (n,) of readings in order of time (n,) ns; NaN where a channel that it needs is NaN."""

    def possible_signals(
        self, time: np.ndarray, values: Float[np.ndarray, "n channels"]
    ) -> Float[np.ndarray, "histories n"]:
        """Signals (n,) after each of several histories before the first reading; one if the history does not matter."""
        return self.signal(time, values)[None]

    def tracker(self) -> "SignalTracker":
        """The same signals for one reading after the other."""
        return SignalTracker(self)

    @property
    @abc.abstractmethod
    def words(self) -> str:
        """What the signal is made of."""

    @property
    @abc.abstractmethod
    def channels(self) -> int | None:
        """Number of channels it takes; None: any number above the one that it reads."""

    @property
    def in_newtons(self) -> bool:
        """Whether the signal is in N already; otherwise it has the unit of the sensor."""
        return True

    def arrays(self) -> dict[str, np.ndarray]:
        """All fields by name."""
        return {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}


class SignalTracker:
    """`AbstractCombination.possible_signals` for one reading after the other; this one needs no reading before."""

    def __init__(self, combination: AbstractCombination):
        self._combination = combination

    def step(self, seconds: float, values: Float[np.ndarray, " channels"]) -> Float[np.ndarray, " histories"]:
        """Signals of the reading at this time, which rises, after each history; NaN where a channel is NaN."""
        del seconds
        return self._combination.signal(np.zeros(1), values[None])


@dataclass(frozen=True, eq=False)
class OneChannel(AbstractCombination):
    """A single channel, times -1 if it falls with the force.

    | field | meaning               | shape | unit |
    |-------|-----------------------|-------|------|
    | index | of the channel        | ()    |      |
    | sign  | 1 or -1               | ()    | 1    |
    """

    name: ClassVar[str] = "channel"

    index: np.ndarray
    sign: np.ndarray

    def signal(self, time: np.ndarray, values: Float[np.ndarray, "n channels"]) -> Float[np.ndarray, " n"]:
        del time
        return np.asarray(values[:, int(self.index)] * float(self.sign))

    @property
    def words(self) -> str:
        return f"channel {int(self.index)}"

    @property
    def channels(self) -> int | None:
        return None

    @property
    def in_newtons(self) -> bool:
        return False


def one_channel(index: int, sign: float = 1.0) -> OneChannel:
    """The channel of this number."""
    return OneChannel(np.asarray(index), np.asarray(sign))


@dataclass(frozen=True, eq=False)
class Blend(AbstractCombination):
    """One signal in N of many channels: a ridge regression on channels, their squares and products.

    It makes a sensor whose channels are not pads (magnetometers, taxels) into one virtual pressure, to which a curve
    is fitted as to any other. It does not model the place of contact, and needs contacts at one or a few places.

    | field   | meaning                                         | shape       | unit     |
    |---------|-------------------------------------------------|-------------|----------|
    | scale   | largest absolute value of a channel in training | (channels,) | sensor's |
    | mean    | of the features in training                     | (features,) | 1        |
    | weights | of the centred features                         | (features,) | N        |
    | offset  | mean force in training                          | ()          | N        |
    | ridge   | penalty chosen, relative to the samples         | ()          | 1        |
    """

    name: ClassVar[str] = "blend"

    scale: np.ndarray
    mean: np.ndarray
    weights: np.ndarray
    offset: np.ndarray
    ridge: np.ndarray

    def signal(self, time: np.ndarray, values: Float[np.ndarray, "n channels"]) -> Float[np.ndarray, " n"]:
        del time
        return np.asarray((quadratic_features(values / self.scale) - self.mean) @ self.weights + self.offset)

    @property
    def words(self) -> str:
        return f"all {len(self.scale)} channels blended (ridge {float(self.ridge):g})"

    @property
    def channels(self) -> int | None:
        return len(self.scale)


def quadratic_features(z: np.ndarray) -> np.ndarray:
    """Channels and all products of two of them, (n, features)."""
    i, j = np.triu_indices(z.shape[1])
    return np.concatenate([z, z[:, i] * z[:, j]], axis=1)


HISTORY_STRETCHES = 32  # of the calibrated log, with one history each, so that they differ
MAX_HISTORIES = 16  # of a new log
DECAY_TIMES = 6.0  # time constants after which a history no longer matters
BLOCK_ROWS = 4096  # of the kernel matrix that are computed together, so that memory does not grow with the log


@dataclass(frozen=True, eq=False)
class SmoothSignal(AbstractCombination):
    """One signal in N by a Gaussian process over principal components of the channels and their lags.

    | field   | meaning                                                        | shape         | unit     |
    |---------|----------------------------------------------------------------|---------------|----------|
    | axes    | principal components, divided by their size in training        | (d, channels) | 1/sensor |
    | lags    | time constants of the first component's first-order lags       | (l,)          | s        |
    | hyper   | logs of l + d lengths, linear and smooth variance, noise       | (l + d + 3,)  |          |
    | inputs  | differences from the lags, then components, of the centres     | (m, l + d)    | 1        |
    | weights | of the kernel at the centres                                   | (m,)          | N        |
    """

    name: ClassVar[str] = "gaussian-process"

    axes: np.ndarray
    lags: np.ndarray
    hyper: np.ndarray
    inputs: np.ndarray
    weights: np.ndarray

    def signal(self, time: np.ndarray, values: Float[np.ndarray, "n channels"]) -> Float[np.ndarray, " n"]:
        return self.forces(lag_inputs(time, values, self.axes, self.lags))

    def possible_signals(
        self, time: np.ndarray, values: Float[np.ndarray, "n channels"]
    ) -> Float[np.ndarray, "histories n"]:
        """As if the sensor had been through what it had when the calibrated log was nearest to the first reading.

        A difference from a lag that is wrong at first decays with the time constant of the lag.
        """
        whole = self.signal(time, values)
        at, lags = lag_inputs(time, values, self.axes, self.lags), len(self.lags)
        known = np.flatnonzero(np.isfinite(at).all(1))
        if not lags or not len(known):
            return whole[None]
        since = np.maximum(np.asarray(time, float) - float(time[known[0]]), 0) / 1e9
        early = since < DECAY_TIMES * self.lags.max()
        starts = self.histories(at[known[0]])
        out = np.repeat(whole[None], len(starts), 0)
        for signal, start in zip(out, starts, strict=True):
            past = start * np.exp(-since[early, None] / self.lags)
            signal[early] = self.forces(at[early] + np.pad(past, ((0, 0), (0, at.shape[1] - lags))))
        return out

    def histories(self, first: Float[np.ndarray, " inputs"]) -> Float[np.ndarray, "histories lags"]:
        """Differences from the lags that the calibrated log had, in several stretches, nearest to the first inputs."""
        lags = len(self.lags)
        distance = ((self.inputs[:, lags:] - first[lags:]) ** 2).sum(1)
        parts = np.array_split(np.arange(len(distance)), min(HISTORY_STRETCHES, len(distance)))
        nearest = np.array([part[np.argmin(distance[part])] for part in parts])
        rows = nearest[np.argsort(distance[nearest], kind="stable")[:MAX_HISTORIES]]
        return np.asarray(self.inputs[rows, :lags])

    def tracker(self) -> "LagTracker":
        return LagTracker(self)

    def forces(self, at: Float[np.ndarray, "n inputs"]) -> Float[np.ndarray, " n"]:
        """Force (n,) N at inputs of `lag_inputs`, in blocks of rows; NaN where an input is NaN."""
        return np.concatenate(
            [self._force(at[k : k + BLOCK_ROWS]) for k in range(0, len(at), BLOCK_ROWS)] or [np.empty(0)]
        )

    def _force(self, at: np.ndarray) -> np.ndarray:
        complete = np.isfinite(at).all(1)
        out = np.full(len(at), np.nan)
        out[complete] = kernel(self.hyper, at[complete], self.inputs) @ self.weights
        return out

    @property
    def words(self) -> str:
        lags = f", lags of {' and '.join(f'{lag:g}' for lag in self.lags)} s" if len(self.lags) else ""
        return f"{self.axes.shape[1]} channels along {len(self.axes)} directions{lags}"

    @property
    def channels(self) -> int | None:
        return int(self.axes.shape[1])


class LagTracker(SignalTracker):
    """The signals of a `SmoothSignal`, with the states of its lags."""

    def __init__(self, combination: SmoothSignal):
        self._combination: SmoothSignal = combination
        self._state: np.ndarray | None = None
        self._starts = np.zeros((1, len(combination.lags)))
        self._first = self._before = 0.0

    def step(self, seconds: float, values: Float[np.ndarray, " channels"]) -> Float[np.ndarray, " histories"]:
        c, along = self._combination, self._combination.axes @ values
        if not np.isfinite(along).all():
            return np.full(len(self._starts), np.nan)
        if self._state is None:
            self._state, self._first = np.full(len(c.lags), along[0]), seconds
            self._starts = c.histories(np.r_[along[0] - self._state, along]) if len(c.lags) else self._starts
        self._state = self._state - (along[0] - self._state) * np.expm1((self._before - seconds) / c.lags)
        self._before = seconds
        since = seconds - self._first
        decay = np.exp(-since / c.lags) if since < DECAY_TIMES * c.lags.max(initial=0.0) else np.zeros(len(c.lags))
        lags = along[0] - self._state + self._starts * decay
        return c.forces(np.column_stack([lags, np.repeat(along[None], len(lags), 0)]))


def kernel(hyper: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Covariance (n, m) of a linear function plus a smooth one at inputs (n, d) and (m, d)."""
    lengths, plane, bend = np.exp(hyper[:-3]), np.exp(hyper[-3]), np.exp(hyper[-2])
    a, b = p / lengths, q / lengths
    square = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
    return np.asarray(plane * (1 + p @ q.T) + bend * np.exp(-0.5 * np.maximum(square, 0)))


def lag_inputs(time: np.ndarray, values: np.ndarray, axes: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Differences of the first component from its lags, then all components, (n, l + d); `time` (n,) in ns."""
    along = values @ axes.T
    seconds = np.asarray(time, float) / 1e9
    return np.column_stack([*(along[:, 0] - first_order_lag(seconds, along[:, 0], float(lag)) for lag in lags), along])


def first_order_lag(time: np.ndarray, signal: np.ndarray, lag: float) -> np.ndarray:
    """First-order lag of a signal (n,) by `lag`, in the unit of time; missing samples do not change its state."""
    out, state, before = np.empty(len(signal)), np.nan, time[0] if len(time) else 0.0
    for k, (now, value) in enumerate(zip(time, signal, strict=True)):
        if np.isfinite(value):
            state = value if np.isnan(state) else state + (value - state) * -np.expm1((before - now) / lag)
            before = now
        out[k] = state
    return np.where(np.isfinite(signal), out, np.nan)


COMBINATIONS: Mapping[str, type[AbstractCombination]] = {kind.name: kind for kind in (OneChannel, Blend, SmoothSignal)}
"""Kinds of combinations by the names that files use."""
