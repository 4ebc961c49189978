"""Find the row of a table from which on its columns have changed places.

A cell too many and one too few in the same rows shift all columns between them. Each column has a noise of its own, so
that a shift raises the noise of one column and lowers that of another at the same row, for good, to that of other
columns before.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ...session.units import SECOND
from ..report import Finding, Severity
from .statistics import StreamStatistics

MAX_COLUMNS, MAX_CELLS = 64, 1 << 26  # of one table: a wider one holds arrays, whose channels have one noise
MIN_WINDOW, MAX_WINDOWS = 8, 4096  # samples whose noise is one number; windows overlap by half
MIN_CHANGE = 20.0  # times the noise before, in one column up and in another one down
SAME_NOISE = 6.0  # largest ratio of two columns of the same noise


def shift_findings(statistics: Mapping[str, StreamStatistics]) -> Iterator[Finding]:
    """Warn of streams from one table whose columns change places at some row."""
    for names in _tables(statistics):
        streams = [statistics[name] for name in names]
        width = sum(s.row.channels for s in streams)
        if not 2 <= width <= MAX_COLUMNS or width * len(streams[0].time) > MAX_CELLS:
            continue
        found = column_shift(np.concatenate([s.stream.read() for s in streams], 1))
        if found is None:
            continue
        row, up, down = found
        labels = [
            f"{s.row.name}[{i}]" if s.row.channels > 1 else s.row.name for s in streams for i in range(s.row.channels)
        ]
        seconds = (streams[0].time[row] - streams[0].time[0]) / SECOND
        what = (
            f"the columns look exchanged from {seconds:.2f} s after the start on (about sample {row}): the noise of "
            f"{labels[up]} rises and that of {labels[down]} falls, each to that of another column"
        )
        remedy = "look for rows with a cell too many or too few in the table that was imported"
        yield Finding(Severity.WARNING, f"/streams/{names[0]}", what, remedy)


def _tables(statistics: Mapping[str, StreamStatistics]) -> list[list[str]]:
    """Names of the streams that have the same time stamps, and so come from one table."""
    groups: list[list[str]] = []
    for name, stats in statistics.items():
        for group in groups:
            if np.array_equal(statistics[group[0]].time, stats.time):
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def column_shift(values: np.ndarray) -> tuple[int, int, int] | None:
    """The row at which columns change places, and the columns whose noise rises and falls most; None if they do not."""
    if len(values) < 2 * MIN_WINDOW:
        return None
    start, noise = _noise(values)
    for split in _likely_splits(noise):
        before, after = noise[: max(split - 1, 1)], noise[min(split + 1, len(noise) - 1) :]
        rise = np.quantile(after, 0.25, axis=0) - np.quantile(before, 0.75, axis=0)
        fall = np.quantile(before, 0.25, axis=0) - np.quantile(after, 0.75, axis=0)
        up, down = int(rise.argmax()), int(fall.argmax())
        if min(rise[up], fall[down]) < np.log(MIN_CHANGE):
            continue
        old, new = np.median(before, axis=0), np.median(after, axis=0)
        if all(np.abs(np.delete(old, c) - new[c]).min() < np.log(SAME_NOISE) for c in (up, down)):
            return int(start[min(split, len(start) - 1)]), up, down
    return None


def _noise(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First samples of overlapping windows, and the logarithm of the noise in them (windows, columns).

    The noise is the median size of the second differences, which no ramp changes. It is at least half of the smallest
    of them, because a converter's step hides less.
    """
    window = max(MIN_WINDOW, 4 * len(values) // MAX_WINDOWS)
    size = np.abs(np.diff(values, 2, axis=0, prepend=values[:1], append=values[-1:]))
    size[~np.isfinite(size)] = 0.0
    least = np.where(size > 0, size, np.inf).min(0)
    start = np.unique(np.append(np.arange(0, len(values) - window, window // 2), len(values) - window))
    inner = sliding_window_view(size, window - 2, axis=0)
    level = np.stack([np.median(inner[start + 1, column], axis=1) for column in range(size.shape[1])], 1)
    return start, np.log(np.maximum(level, np.where(np.isfinite(least), least / 2, 1.0)))


def _likely_splits(values: np.ndarray) -> list[int]:
    """Lengths of the first of two parts whose means differ most, in units of their scatter: of all columns, of each."""
    count = np.arange(1, len(values))[:, None]
    total = np.cumsum(values, axis=0)
    away = total[:-1] - count / len(values) * total[-1]
    separation = away**2 / (count * (len(values) - count))
    return [int(np.argmax(column)) + 1 for column in (separation.sum(1), *separation.T)]
