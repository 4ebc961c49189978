"""Samples of one or several logs as one series, and its parts: halves, blocks of time, folds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from .location import cluster_sites, loaded_rows

# Samples of a series that curves are fitted to. Longer series are replaced by means over equal numbers of samples.
MAX_SAMPLES = 8192
# Blocks of time over all logs of a series. Residuals of different blocks count as independent.
BLOCKS = 20
# Seconds between logs on the clock of a series: longer than any memory of a sensor.
PAUSE = 3600.0
# Every third place is held out of the fit whose errors are shown.
HOLD_OUT_STRIDE = 3


@dataclass(frozen=True, eq=False)
class LogSeries:
    """Samples of logs, one log after the other.

    | field  | meaning                                               | shape         | unit     |
    |--------|-------------------------------------------------------|---------------|----------|
    | time   | from the start of the first log                       | (n,)          | ns       |
    | values | of the channels, NaN where missing                    | (n, channels) | sensor's |
    | force  | NaN where missing                                     | (n,)          | N        |
    | log    | number of the log                                     | (n,)          |          |
    | place  | of the contact, by the stage; None: not to be used    | (n, 2)        | m        |
    | site   | number of the place of contact; see `cluster_sites`   | (n,)          |          |

    With places, they take the part of the blocks of time: parts that are held out are places.
    """

    time: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n channels"]
    force: Float[np.ndarray, " n"]
    log: Int[np.ndarray, " n"]
    place: Float[np.ndarray, "n 2"] | None = None
    site: Int[np.ndarray, " n"] | None = None

    @property
    def sites(self) -> np.ndarray:
        """Number (n,) of the place of contact of each sample; the series has its places told apart."""
        assert self.site is not None
        return self.site

    def at_places(self) -> "LogSeries":
        """The series with its places told apart."""
        assert self.place is not None
        return replace(self, site=cluster_sites(self.place, self.force))

    @property
    def loaded(self) -> np.ndarray:
        """Flags (n,) of the samples of presses whose place is known; the series has places."""
        assert self.place is not None
        return loaded_rows(self.place, self.force)

    @property
    def fitted_part(self) -> np.ndarray:
        """Flags (n,) of what is fitted to measure errors: the first half in time, or two of three places."""
        return self.first_half if self.site is None else np.asarray(self.site % HOLD_OUT_STRIDE != 0)

    @property
    def complete(self) -> np.ndarray:
        """Flags (n,) of the samples with a force and all channels."""
        return np.asarray(np.isfinite(self.values).all(1) & np.isfinite(self.force))

    @property
    def first_half(self) -> np.ndarray:
        """Flags (n,) of the samples in the first half of the time of each log."""
        out = np.zeros(len(self.time), bool)
        for k in np.unique(self.log):
            rows = self.log == k
            at = self.time[rows]
            out[rows] = (at - at[0]) < 0.5 * (at[-1] - at[0])
        return out

    def blocks(self, use: np.ndarray, count: int = BLOCKS) -> np.ndarray:
        """Number (n,) of the block of each sample: about `count` equal parts of the used samples, none over two logs.

        Samples that are not used have the number of the used sample before. With places: the number of the place.
        """
        if self.site is not None:
            return self.site
        out, first = np.zeros(len(self.time), int), 0
        used = use & self.complete
        total = max(int(used.sum()), 1)
        for k in np.unique(self.log):
            rows = self.log == k
            own = int(used[rows].sum())
            parts = max(round(count * own / total), 1)
            number = np.maximum(np.cumsum(used[rows]) - 1, 0)
            out[rows] = first + np.minimum(number * parts // max(own, 1), parts - 1)
            first += parts
        return out

    def late(self, block: np.ndarray) -> np.ndarray:
        """Flags (n,) of the samples in the later half of the blocks of their log; with places all."""
        if self.site is not None:
            return np.ones(len(self.time), bool)
        middle = np.array([np.median(np.unique(block[self.log == k])) for k in range(int(self.log.max()) + 1)])
        return np.asarray(block >= middle[self.log])

    def channels(self, kept: np.ndarray) -> "LogSeries":
        """The series with these channels alone."""
        return replace(self, values=self.values[:, kept])


def series_of(
    logs: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    most: int = MAX_SAMPLES,
    places: Sequence[Float[np.ndarray, "n 2"]] | None = None,
) -> LogSeries:
    """One series of the logs (time ns, values, force), each averaged by the same factor to about `most` samples.

    Args:
        places: of the contacts of each log, m.
    """
    factor = -(-sum(len(time) for time, _, _ in logs) // most)
    parts, end = [], 0.0
    for number, (time, values, force) in enumerate(logs):
        at = np.asarray(time - time[0], float)
        t, v, f = block_means(at, values, force, factor)
        place = np.full((len(t), 2), np.nan) if places is None else _nearest_places(at, places[number], t)
        parts.append((t + end, v, f, np.full(len(t), number), place))
        end = parts[-1][0][-1] + 1e9 * PAUSE
    at, values, force, log, place = (np.concatenate(column) for column in zip(*parts, strict=True))
    return LogSeries(at, values, force, log, None if places is None else place)


def _nearest_places(time: np.ndarray, place: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The place (m, 2) of the sample that is nearest to each time: a mean would lie between two places."""
    right = np.clip(np.searchsorted(time, at), 1, max(len(time) - 1, 1)) if len(time) > 1 else np.zeros(len(at), int)
    nearest = np.where(at - time[right - 1] < time[right] - at, right - 1, right)
    return np.asarray(place[nearest])


def block_means(
    time: np.ndarray, values: np.ndarray, force: np.ndarray, factor: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means over each `factor` samples in turn: of those that are complete or, where none is, of the channels alone."""
    if factor <= 1:
        return time, values, force
    known = np.isfinite(values).all(1)
    complete = known & np.isfinite(force)
    start = np.arange(0, len(time), factor)
    has_complete = np.repeat(np.logical_or.reduceat(complete, start), np.diff(np.append(start, len(time))))
    use = np.where(has_complete, complete, known)
    count = np.add.reduceat(use.astype(float), start)

    def mean(column: np.ndarray) -> np.ndarray:
        total = np.add.reduceat(np.where(use, column, 0.0), start)
        return np.asarray(np.divide(total, count, out=np.full(len(start), np.nan), where=count > 0))

    columns = [mean(column) for column in values.T]
    middle = np.add.reduceat(time, start) / np.add.reduceat(np.ones(len(time)), start)
    return middle, np.stack(columns, 1), mean(force)
