"""Corrections: objects that remove a physical effect from a recording, applied to a stream in order.

    values = correct([LowPass(50.0)], time, values, "pressure")

The values of a stream are (time, channels). A missing sample is NaN before and after, and never affects others.
A baseline is no correction of a stream but a rule: it weights the two rest means around a press (`AbstractBaseline`).
"""

import abc
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise

import numpy as np
import scipy

from jaxeit.registry import Registry, limited, require_limits

from .streams import finite_mean


class CorrectionError(ValueError):
    """The correction cannot be applied to this stream.

    Example:
        try:
            presses.LowPass(cutoff=50.0).sections(rate=100.0)  # Hz
        except presses.CorrectionError as error:
            print(error)
    """


class AbstractCorrection(abc.ABC):
    """Maps the values of a stream to corrected values of the same shape."""

    @abc.abstractmethod
    def apply(self, time: np.ndarray, values: np.ndarray, name: str) -> np.ndarray:
        """Correct `values` (n, channels) recorded at `time` (n,) ns; `name` is the stream's, for error messages."""


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

    Raises: `CorrectionError` for fewer than two samples, or if most time stamps repeat or go back.
    """
    if len(time) < 2:
        raise CorrectionError("a stream of fewer than two samples has no sample rate: record a longer stream.")
    period = float(np.median(np.diff(time)))
    if not period > 0:
        raise CorrectionError("times repeat or go back more often than they rise; check the clock, sort the samples.")
    return 1e9 / period


def interpolate_missing(column: np.ndarray) -> np.ndarray:
    """Interpolate missing samples of one channel and hold its ends. A channel of missing samples only is unchanged."""
    good = np.isfinite(column)
    if good.all() or not good.any():
        return column
    index = np.arange(len(column))
    return np.asarray(np.interp(index, index[good], column[good]))


def _continuous_runs(time: np.ndarray, rate: float) -> list[slice]:
    """Runs of samples without a gap of more than five periods and without a backward step of the clock.

    Each run is filtered on its own, because a filter across a gap would invent the samples within it.
    """
    steps = np.diff(time)
    breaks = np.flatnonzero((steps > 5e9 / rate) | (steps < 0)) + 1
    edges = [0, *breaks.tolist(), len(time)]
    return [slice(a, b) for a, b in pairwise(edges)]


@dataclass(frozen=True)
class LowPass(AbstractCorrection):
    """Butterworth low-pass of `cutoff` Hz, per channel.

    With `causal=False` (offline) the filter runs forwards and backwards: no delay, half the amplitude (-6 dB) at the
    cutoff. With `causal=True` (online) it has -3 dB at the cutoff and a delay; it starts at rest at the first sample.
    The default of 50 Hz is that of the paper which this bench reproduces. ``order`` is that of the filter in one
    direction.

    Raises:
        CorrectionError: if the cutoff is not below half the sample rate. At 50 Hz this refuses a stream of 100 Hz,
            where the paper's filter would be exactly at the Nyquist frequency.
    """

    cutoff: float = limited(50.0, above=0)
    order: int = limited(2, least=1, most=20)
    causal: bool = False

    def __post_init__(self) -> None:
        require_limits(self, CorrectionError)

    def sections(self, rate: float, name: str = "stream") -> np.ndarray:
        """Second-order sections for a stream of `rate` Hz."""
        if self.cutoff >= rate / 2:
            raise CorrectionError(
                f"{name}: a low-pass of {self.cutoff:g} Hz needs samples faster than {2 * self.cutoff:g} Hz, "
                f"and these come at {rate:.4g} Hz; choose a cutoff below {rate / 2:.4g} Hz, or leave the low-pass out."
            )
        return np.asarray(scipy.signal.butter(self.order, self.cutoff, fs=rate, output="sos"))

    def apply(self, time: np.ndarray, values: np.ndarray, name: str = "stream") -> np.ndarray:
        if len(time) < 2:
            return values
        rate = sample_rate(time)
        sections = self.sections(rate, name)
        filled = np.apply_along_axis(interpolate_missing, 0, values)
        smooth = np.concatenate([self._filter(sections, filled[s]) for s in _continuous_runs(time, rate)])
        return np.where(np.isfinite(values), smooth, np.nan)

    def _filter(self, sections: np.ndarray, values: np.ndarray) -> np.ndarray:
        if self.causal:
            start = scipy.signal.sosfilt_zi(sections)[:, :, None] * values[0]
            return np.asarray(scipy.signal.sosfilt(sections, values, axis=0, zi=start)[0])
        pad = min(3 * (2 * len(sections) + 1), len(values) - 1)
        return np.asarray(scipy.signal.sosfiltfilt(sections, values, axis=0, padlen=pad))


@dataclass(frozen=True)
class WindowMeans:
    """Means over windows, their standard errors, and counts of finite samples, each (windows, channels).

    A channel without a finite sample in a window has NaN and a count of zero there.
    """

    mean: np.ndarray
    standard_error: np.ndarray
    count: np.ndarray


class AbstractBaseline(abc.ABC):
    """The baseline of a press, as weights of the mean before it and the mean after it."""

    @abc.abstractmethod
    def weights(
        self, time: np.ndarray | float, before: np.ndarray | float, after: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weights of both rest means at `time`; `before` and `after` are the centres of the rest windows (all ns)."""

    def remove(
        self, held: WindowMeans, before: WindowMeans, after: WindowMeans, centres: tuple[np.ndarray, ...]
    ) -> WindowMeans:
        """Subtract the baseline from the hold means. Errors of the three windows are independent and add in squares.

        `centres`: centres (windows,) ns of the held, before and after windows.
        """
        at, t0, t1 = centres
        w0, w1 = (w[:, None] for w in self.weights(at, t0, t1))
        mean = held.mean - masked_product(w0, before.mean) - masked_product(w1, after.mean)
        variance = held.standard_error**2
        variance = variance + masked_product(w0, before.standard_error) ** 2
        variance = variance + masked_product(w1, after.standard_error) ** 2
        return WindowMeans(mean, np.sqrt(variance), held.count)


def masked_product(weight: np.ndarray, value: np.ndarray) -> np.ndarray:
    """weight * value, where a weight of zero gives zero even for NaN."""
    return np.where(weight == 0, 0.0, weight * value)


@dataclass(frozen=True)
class TwoSided(AbstractBaseline):
    """Linear between the rest means before and after the press. Removes drift; slow recovery of the pad biases it."""

    def weights(
        self, time: np.ndarray | float, before: np.ndarray | float, after: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray]:
        share = (time - before) / np.maximum(after - before, 1)
        return np.asarray(1 - share), np.asarray(share)


@dataclass(frozen=True)
class PreOnly(AbstractBaseline):
    """The rest mean before the press: the only baseline available in real time. Drift during the press stays.

    Example:
        as_in_real_time = presses.Processing(baseline=presses.PreOnly())
    """

    def weights(
        self, time: np.ndarray | float, before: np.ndarray | float, after: np.ndarray | float
    ) -> tuple[np.ndarray, np.ndarray]:
        return np.ones(np.shape(time)), np.zeros(np.shape(time))


CORRECTIONS = Registry(AbstractCorrection, "correction", "calib.corrections")
"""Corrections by the names that recipes use."""
BASELINES = Registry(AbstractBaseline, "baseline", "calib.baselines")
"""Baselines by the names that recipes use."""


# Samples within a window are correlated (filters, drift); means over this many blocks are nearly independent.
BLOCKS_PER_WINDOW = 8


def _window_mean(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, standard error and count of finite samples per channel of one window (n, channels)."""
    good = np.isfinite(values)
    count = good.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = finite_mean(values)
        return mean, _standard_error(np.where(good, values - mean, 0.0), good, count), count


def _standard_error(residual: np.ndarray, good: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Standard error of a mean from the scatter of block sums (batch means); NaN with fewer than two blocks."""
    rows, blocks = len(residual), min(BLOCKS_PER_WINDOW, len(residual))
    if not blocks:
        return np.full(count.shape, np.nan)
    edges = np.arange(blocks) * rows // blocks
    sums = np.add.reduceat(residual, edges, axis=0)
    used = (np.add.reduceat(good.astype(int), edges, axis=0) > 0).sum(axis=0)
    scatter = (sums**2).sum(axis=0) * used / np.where(used > 1, used - 1, np.nan)
    return np.asarray(np.sqrt(scatter) / count)


def _finite_window_means(values: np.ndarray, ranges: np.ndarray, blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard errors (windows, channels) of windows of finite samples, each cut into so many blocks."""
    rows = ranges[:, 1] - ranges[:, 0]
    ends = np.cumsum(rows)
    index = np.repeat(ranges[:, 1] - ends, rows) + np.arange(ends[-1])
    level = values[ranges[:, 0]]  # levels are large, noise is small; and a constant window has no error at all
    deviation = values[index] - np.repeat(level, rows, axis=0)
    edges = np.arange(blocks + 1) * rows[:, None] // blocks
    first = (edges + (ends - rows)[:, None])[:, :-1]
    sums = np.add.reduceat(deviation, first.ravel(), axis=0).reshape(*first.shape, -1)
    shift = sums.sum(axis=1) / rows[:, None]
    sums -= np.diff(edges)[:, :, None] * shift[:, None]
    scatter = np.einsum("wbc,wbc->wc", sums, sums) * (blocks / (blocks - 1) if blocks > 1 else np.nan)
    return level + shift, np.sqrt(scatter) / rows[:, None]


def window_means(values: np.ndarray, ranges: np.ndarray) -> WindowMeans:
    """Means of `values` (n, channels) over half-open index `ranges` (windows, 2)."""
    shape, rows = (len(ranges), values.shape[1]), ranges[:, 1] - ranges[:, 0]
    mean, error, count = np.empty(shape), np.empty(shape), np.empty(shape, int)
    missing = np.append(0, np.cumsum(~np.isfinite(values).all(axis=1)))
    blocks = np.where(missing[ranges[:, 1]] == missing[ranges[:, 0]], np.minimum(rows, BLOCKS_PER_WINDOW), 0)
    for number in np.unique(blocks[blocks > 0]):  # complete windows, the usual case, are fastest together
        same = blocks == number
        mean[same], error[same] = _finite_window_means(values, ranges[same], int(number))
        count[same] = rows[same, None]
    for i in np.flatnonzero(blocks == 0):
        mean[i], error[i], count[i] = _window_mean(values[slice(*ranges[i])])
    return WindowMeans(mean, error, count)
