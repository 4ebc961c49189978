"""The first or the last part of a recording, in which something is otherwise than in the remaining part."""

from typing import NamedTuple

import numpy as np

from ..session.units import SECOND

MIN_ROWS = 2  # presses in either part
MAX_STRAY = 0.15  # of the presses, that may contradict a part
CLEAREST_STEP = 1e9  # scatters: levels without any scatter, such as those of a dead channel, step no clearer


class RowRange(NamedTuple):
    """The rows before ``row`` if ``first``, otherwise those from ``row`` on."""

    row: int
    first: bool

    def mask(self, rows: int) -> np.ndarray:
        """Which of so many rows belong to the part, (rows,)."""
        return np.asarray((np.arange(rows) < self.row) == self.first)

    def text(self, time: np.ndarray, start: int) -> str:
        """When the part is, in words, by the times (rows,) of its rows and of the recording's start, ns.

        The limit lies between two rows; the words name the row that is known to be in the part.
        """
        return time_text(self.first, float(time[self.row - 1 if self.first else self.row] - start) / SECOND)


def time_text(first: bool, seconds: float) -> str:
    """A part in words: "up to 28.4 s after the start" or "from 28.4 s after the start on"."""
    return f"up to {seconds:.1f} s after the start" if first else f"from {seconds:.1f} s after the start on"


def flagged_part(flag: np.ndarray) -> RowRange | None:
    """The part of the rows (rows,) in time order that holds nearly all flagged rows and no other ones, if any does."""
    rows = len(flag)
    best, fewest = None, np.inf
    for row in range(MIN_ROWS, rows - MIN_ROWS + 1):
        for first in (True, False):
            part = RowRange(row, first)
            stray = int((part.mask(rows) != flag).sum())
            if stray < fewest:
                best, fewest = part, stray
    return best if fewest <= MAX_STRAY * min(flag.sum(), (~flag).sum()) else None


def stepped_part(level: np.ndarray) -> tuple[int, float] | None:
    """The first row of the last part of levels (rows,), and their step there in units of their scatter in the parts.

    The split is that of the least sum of absolute deviations from the medians of both parts.
    """
    rows = len(level)
    splits = range(MIN_ROWS, rows - MIN_ROWS + 1)
    if not splits:
        return None
    parts = [(level[:row], level[row:]) for row in splits]
    cost = [sum(float(np.abs(p - np.median(p)).sum()) for p in pair) for pair in parts]
    best = int(np.argmin(cost))
    before, after = parts[best]
    scatter = float(np.median(np.abs(np.concatenate([before - np.median(before), after - np.median(after)]))))
    step = float(np.median(after) - np.median(before))
    clearness = step / scatter if scatter * CLEAREST_STEP > abs(step) else np.sign(step) * CLEAREST_STEP
    return splits[best], float(clearness)
