"""Samples of one or several logs as one series, and its parts: halves, blocks of time, folds."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

# Samples of a series that curves are fitted to. Longer series are replaced by means over equal numbers of samples.
MAX_SAMPLES = 8192
# Blocks of time over all logs of a series. Residuals of different blocks count as independent.
BLOCKS = 20
# Seconds between logs on the clock of a series: longer than any memory of a sensor.
PAUSE = 3600.0


@dataclass(frozen=True, eq=False)
class LogSeries:
    """Samples of logs, one log after the other.

    | field  | meaning                                               | shape         | unit     |
    |--------|-------------------------------------------------------|---------------|----------|
    | time   | from the start of the first log                       | (n,)          | ns       |
    | values | of the channels, NaN where missing                    | (n, channels) | sensor's |
    | force  | NaN where missing                                     | (n,)          | N        |
    | log    | number of the log                                     | (n,)          |          |
    """

    time: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n channels"]
    force: Float[np.ndarray, " n"]
    log: Int[np.ndarray, " n"]

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

        Samples that are not used have the number of the used sample before.
        """
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
        """Flags (n,) of the samples in the later half of the blocks of their log."""
        middle = np.array([np.median(np.unique(block[self.log == k])) for k in range(int(self.log.max()) + 1)])
        return np.asarray(block >= middle[self.log])

    def channels(self, kept: np.ndarray) -> "LogSeries":
        """The series with these channels alone."""
        return replace(self, values=self.values[:, kept])


def series_of(logs: list[tuple[np.ndarray, np.ndarray, np.ndarray]], most: int = MAX_SAMPLES) -> LogSeries:
    """One series of the logs (time ns, values, force), each thinned by the same factor to about `most` samples."""
    factor = -(-sum(len(time) for time, _, _ in logs) // most)
    parts, end = [], 0.0
    for number, (time, values, force) in enumerate(logs):
        t, v, f = thinned(np.asarray(time - time[0], float), values, force, factor)
        parts.append((t + end, v, f, np.full(len(t), number)))
        end = parts[-1][0][-1] + 1e9 * PAUSE
    return LogSeries(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def thinned(
    time: np.ndarray, values: np.ndarray, force: np.ndarray, factor: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means over each `factor` samples in turn: of those that are complete or, where none is, of the channels alone."""
    if factor <= 1:
        return time, values, force
    whole = np.isfinite(values).all(1)
    both = whole & np.isfinite(force)
    start = np.arange(0, len(time), factor)
    some = np.repeat(np.logical_or.reduceat(both, start), np.diff(np.append(start, len(time))))
    use = np.where(some, both, whole)
    count = np.add.reduceat(use.astype(float), start)

    def mean(column: np.ndarray) -> np.ndarray:
        total = np.add.reduceat(np.where(use, column, 0.0), start)
        return np.asarray(np.divide(total, count, out=np.full(len(start), np.nan), where=count > 0))

    columns = [mean(column) for column in values.T]
    middle = np.add.reduceat(time, start) / np.add.reduceat(np.ones(len(time)), start)
    return middle, np.stack(columns, 1), mean(force)
