"""Corrections: physics removed from recordings, as objects that are folded over a stream in order.

    values = correct([LowPass(50.0)], time, values, "pressure")

A stream is (time, channels). Missing samples are NaN before and after, and never spread. Baselines are not streams
but a rule for what to take off between two rest windows, so they are asked for weights (see `AbstractBaseline`).
"""

import abc
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise

import numpy as np
from scipy import signal


class CorrectionError(ValueError):
    """A correction that this stream cannot be given."""


class AbstractCorrection(abc.ABC):
    """Maps a stream's values to corrected values of the same shape."""

    @abc.abstractmethod
    def apply(self, time: np.ndarray, values: np.ndarray, name: str) -> np.ndarray:
        """`time` (n,) ns, `values` (n, channels), `name` for messages -> (n, channels)."""


def correct(
    corrections: Iterable[AbstractCorrection],
    time: np.ndarray,
    values: np.ndarray,
    name: str = "stream",
) -> np.ndarray:
    """Apply corrections in order; `values` is not changed."""
    return reduce(lambda v, c: c.apply(time, v, name), corrections, values)


def sample_rate(time: np.ndarray) -> float:
    """Median rate in Hz of time stamps in ns.

    Raises: `CorrectionError` for fewer than two samples, or times of which most repeat or go back.
    """
    if len(time) < 2:
        raise CorrectionError("a stream of fewer than two samples has no sample rate.")
    period = float(np.median(np.diff(time)))
    if not period > 0:
        raise CorrectionError("times repeat or go back more often than they rise; check the clock, sort the samples.")
    return 1e9 / period


def bridge(column: np.ndarray) -> np.ndarray:
    """One channel with its missing samples interpolated (ends held); all missing stays so."""
    good = np.isfinite(column)
    if good.all() or not good.any():
        return column
    index = np.arange(len(column))
    return np.interp(index, index[good], column[good])


def _pieces(time: np.ndarray, rate: float) -> list[slice]:
    """Runs of samples without a gap of more than five periods, or a step back of the clock.

    A filter knows nothing of what was not sampled.
    """
    steps = np.diff(time)
    breaks = np.flatnonzero((steps > 5e9 / rate) | (steps < 0)) + 1
    edges = [0, *breaks.tolist(), len(time)]
    return [slice(a, b) for a, b in pairwise(edges)]


@dataclass(frozen=True)
class LowPass(AbstractCorrection):
    """Butterworth low-pass of `cutoff` Hz, per channel.

    Offline (`causal=False`) it is run forwards and backwards: no delay, half the amplitude (-6 dB) at the cutoff.
    Causal, as a robot must: -3 dB at the cutoff and a delay, starting from rest at the first sample's value.
    The seed paper low-passes at 50 Hz before everything else.

    Raises: `CorrectionError` if the cutoff is not below half the sample rate. At 50 Hz this refuses a stream of
    100 Hz, where the paper's filter would be exactly at the Nyquist frequency.
    """

    cutoff: float = 50.0
    order: int = 2
    causal: bool = False

    def __post_init__(self) -> None:
        if not self.cutoff > 0 or self.order < 1:
            raise CorrectionError(
                f"a low-pass needs a cutoff above 0 Hz and an order of at least 1, not {self.cutoff} and {self.order}."
            )

    def sections(self, rate: float, name: str = "stream") -> np.ndarray:
        """Second-order sections for a stream of `rate` Hz."""
        if self.cutoff >= rate / 2:
            raise CorrectionError(
                f"{name}: a low-pass of {self.cutoff:g} Hz needs samples faster than {2 * self.cutoff:g} Hz, "
                f"and these come at {rate:.4g} Hz; choose a cutoff below {rate / 2:.4g} Hz, or leave the low-pass out."
            )
        return signal.butter(self.order, self.cutoff, fs=rate, output="sos")

    def apply(self, time: np.ndarray, values: np.ndarray, name: str = "stream") -> np.ndarray:
        if len(time) < 2:
            return values
        rate = sample_rate(time)
        sections = self.sections(rate, name)
        filled = np.apply_along_axis(bridge, 0, values)
        smooth = np.concatenate([self._filter(sections, filled[s]) for s in _pieces(time, rate)])
        return np.where(np.isfinite(values), smooth, np.nan)

    def _filter(self, sections: np.ndarray, values: np.ndarray) -> np.ndarray:
        if self.causal:
            start = signal.sosfilt_zi(sections)[:, :, None] * values[0]
            return signal.sosfilt(sections, values, axis=0, zi=start)[0]
        pad = min(3 * (2 * len(sections) + 1), len(values) - 1)
        return signal.sosfiltfilt(sections, values, axis=0, padlen=pad)


@dataclass(frozen=True)
class Estimate:
    """Means over windows: `mean` and `standard_error` (windows, channels), `count` of finite samples likewise.

    A channel with no finite sample in a window has NaN and a count of zero.
    """

    mean: np.ndarray
    standard_error: np.ndarray
    count: np.ndarray


class AbstractBaseline(abc.ABC):
    """What to take off a press, as weights of the mean before it and the mean after it."""

    @abc.abstractmethod
    def weights(self, time: np.ndarray, before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weights of both rest means at `time`; `before` and `after` are the windows' centres (all ns)."""

    def remove(self, held: Estimate, before: Estimate, after: Estimate, centres: tuple[np.ndarray, ...]) -> Estimate:
        """Held means with the baseline off; the three windows' errors are independent and add in squares.

        `centres`: (windows,) ns of the held, before and after windows.
        """
        at, t0, t1 = centres
        w0, w1 = (w[:, None] for w in self.weights(at, t0, t1))
        mean = held.mean - _weighted(w0, before.mean) - _weighted(w1, after.mean)
        variance = held.standard_error**2
        variance = variance + _weighted(w0, before.standard_error) ** 2
        variance = variance + _weighted(w1, after.standard_error) ** 2
        return Estimate(mean, np.sqrt(variance), held.count)


def _weighted(weight: np.ndarray, value: np.ndarray) -> np.ndarray:
    """weight * value, where a weight of zero silences even NaN."""
    return np.where(weight == 0, 0.0, weight * value)


@dataclass(frozen=True)
class TwoSided(AbstractBaseline):
    """Linear between the rest means before and after the press: removes drift, but is biased by slow recovery."""

    def weights(self, time, before, after):
        share = (time - before) / np.maximum(after - before, 1)
        return 1 - share, share


@dataclass(frozen=True)
class PreOnly(AbstractBaseline):
    """The rest mean before the press: all that a robot can do, and blind to drift during the press."""

    def weights(self, time, before, after):
        return np.ones(np.shape(time)), np.zeros(np.shape(time))


# Samples within a window are correlated (filters, drift); means over this many blocks are nearly not.
_BLOCKS = 8


def _one_estimate(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, standard error and count per channel of one window (n, channels), NaN aware."""
    good = np.isfinite(values)
    count = good.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(good, values, 0.0).sum(axis=0) / np.where(count > 0, count, np.nan)
        return mean, _standard_error(np.where(good, values - mean, 0.0), good, count), count


def _standard_error(residual: np.ndarray, good: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Of a mean: from the scatter of block sums (batch means), NaN with fewer than two blocks."""
    edges = np.linspace(0, len(residual), min(_BLOCKS, len(residual)) + 1).astype(int)[:-1]
    if not len(edges):
        return np.full(count.shape, np.nan)
    sums = np.add.reduceat(residual, edges, axis=0)
    used = (np.add.reduceat(good.astype(int), edges, axis=0) > 0).sum(axis=0)
    scatter = (sums**2).sum(axis=0) * used / np.where(used > 1, used - 1, np.nan)
    return np.sqrt(scatter) / count


def window_estimate(values: np.ndarray, ranges: np.ndarray) -> Estimate:
    """Means of `values` (n, channels) over half-open index `ranges` (windows, 2)."""
    parts = [_one_estimate(values[a:b]) for a, b in ranges]
    if not parts:
        empty = np.empty((0, values.shape[1]))
        return Estimate(empty, empty, empty.astype(int))
    return Estimate(*(np.stack(column) for column in zip(*parts, strict=True)))
