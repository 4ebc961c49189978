"""Streams that presses are cut from. Times are int64 nanoseconds since the session's epoch; one row per sample."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

MAD_TO_SIGMA = 1.4826  # standard deviation of a normal distribution over its median absolute deviation: 1 / Phi^-1(3/4)


def robust_deviation(error: np.ndarray) -> float:
    """Standard deviation about zero by the median of the absolute values, which few outliers do not move; 0 of none."""
    return float(MAD_TO_SIGMA * np.median(np.abs(error))) if len(error) else 0.0


class PressError(ValueError):
    """The streams or the times do not allow a search for presses.

    Example:
        try:
            presses.find_presses(np.arange(3), np.zeros(3))
        except presses.PressError as error:
            print(error)
    """


@runtime_checkable
class ReadableStream(Protocol):
    """The interface of a stream; `calib.session.Stream` and `ArrayStream` implement it."""

    @property
    def name(self) -> str:
        """Name of the stream, such as "eit"."""

    @property
    def channels(self) -> int:
        """Number of channels."""

    @property
    def time(self) -> np.ndarray:
        """Time stamps (n,) int64 ns since the epoch of the session."""

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Values (samples, channels) of the samples from `start` to before `stop`, in SI units, NaN where missing."""


@dataclass(frozen=True, eq=False)
class ArrayStream:
    """A stream held in memory: `time` (n,) ns, `values` (n, channels) in SI units, NaN where a value is missing."""

    name: str
    time: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or len(self.time) != len(self.values):
            raise PressError(
                f"{self.name}: values must be (time, channels) with one row per time stamp, "
                f"not {self.values.shape} for {len(self.time)} time stamps."
            )

    @property
    def channels(self) -> int:
        return int(self.values.shape[1])

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        return self.values[start:stop]


# Of float64 values. A call of `read` takes as long as copying 40 kB; where presses are not listed in the order of time,
# much larger blocks cost more than the calls.
READ_AHEAD_BYTES = 256 << 10


class ReadAhead:
    """A stream whose slices are read in the order of time: one call of its `read` serves many slices that follow."""

    def __init__(self, stream: ReadableStream) -> None:
        self._stream, self._start, self._block = stream, 0, np.empty((0, stream.channels))
        self.name, self.channels, self.time = stream.name, stream.channels, stream.time

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Values (samples, channels) of the samples from `start` to before `stop`, not to be written to."""
        stop = len(self.time) if stop is None else stop
        if not self._start <= start <= stop <= self._start + len(self._block):
            rows = max(stop - start, READ_AHEAD_BYTES // (8 * max(self.channels, 1)))
            self._start, self._block = start, self._stream.read(start, min(start + rows, len(self.time)))
        return self._block[start - self._start : stop - self._start]


def recording_end(streams: Iterable[ReadableStream]) -> int:
    """Earliest end of the streams in ns. A stream ends one ns after its last sample, since windows are half open.

    Raises:
        PressError: without streams, or if one of them holds no sample.
    """
    last = {stream.name: stream.time[-1:] for stream in streams}
    empty = [name for name, time in last.items() if not len(time)]
    if empty or not last:
        where = f"/streams/{empty[0]}" if empty else "/streams"
        raise PressError(f"{where}: no samples, so that no press can be cut out; record again")
    return min(int(time[0]) + 1 for time in last.values())


def index_ranges(time: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """Half-open index ranges (windows, 2) of the samples whose time stamps lie within time `windows` (windows, 2)."""
    return np.searchsorted(time, windows, side="left")


def true_runs(flag: np.ndarray) -> np.ndarray:
    """Half-open index ranges (runs, 2) in which `flag` (n,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flag, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def finite_mean(values: np.ndarray) -> np.ndarray:
    """Mean over the first axis of the finite values; NaN where there is none."""
    good = np.isfinite(values)
    count = good.sum(axis=0)
    return np.asarray(np.where(good, values, 0.0).sum(axis=0) / np.where(count > 0, count, np.nan))


def resample(time: np.ndarray, values: np.ndarray, at: np.ndarray, max_gap: float = 3.0) -> np.ndarray:
    """Interpolate `values` (n, channels) linearly at the times `at`.

    The result (times, channels) is NaN outside the stream, and where the distance between the two nearest finite
    samples exceeds `max_gap` median sample periods.
    """
    limit = max_gap * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    columns = [_resample_one(time, v, at, limit) for v in values.T]
    return np.stack(columns, axis=1) if columns else np.empty((len(at), 0))


def _resample_one(time: np.ndarray, column: np.ndarray, at: np.ndarray, limit: float) -> np.ndarray:
    good = np.isfinite(column)
    if good.sum() < 2:
        return np.full(len(at), np.nan)
    t = time[good]
    right = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    inside = (at >= t[0]) & (at <= t[-1]) & (t[right] - t[right - 1] <= limit)
    return np.where(inside, np.interp(at - t[0], t - t[0], column[good]), np.nan)
