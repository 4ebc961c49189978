"""Clocks of foreign recordings: strictly increasing times in nanoseconds since a known start."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from ...errors import SessionError, problem
from ...units import Unit
from .table import Table

UNIX_TIME_FROM = 1e8
"""Readings in s above this value (1973) are taken as times since 1970, smaller ones as times since an unknown start."""
LAST_TIME = 253_402_300_800.0
"""End of the year 9999 in s since 1970: later times have no date, and are those of another unit."""
COUNTER_BITS = (16, 24, 32)
"""Sizes of the counters of devices: `micros()` of an Arduino, of 32 bits, begins anew every 71.6 minutes."""
MAX_WRAP_STEP = 10.0
"""Largest step over the end of a counter, in median steps: a longer one may be a pause, or a clock that was set."""


@dataclass(frozen=True)
class Clock:
    """Rows that are kept, in order, their times in s, and what was left out.

    ``wraps`` counts how often the counter of the clock began anew. ``remedy`` says what to check if the times cannot be
    kept.
    """

    rows: np.ndarray
    seconds: np.ndarray
    without: np.ndarray
    equal: np.ndarray
    sorted: int
    wraps: int = 0
    remedy: str = "check the unit of --time"

    @property
    def counts_from_1970(self) -> bool:
        """Whether the clock says when the recording was made."""
        return float(self.seconds[0]) >= UNIX_TIME_FROM


def clock_of(path: Path, table: Table, column: str, unit: Unit, sort: bool, counted: str = "line") -> Clock:
    """Make a clock of strictly increasing times.

    Repeated times are left out. A counter that began anew at its end goes on; other backward times are refused or
    sorted.
    """
    counts = table.values[:, 0]
    rows, without = np.flatnonzero(np.isfinite(counts)), np.flatnonzero(~np.isfinite(counts))
    wraps = _wraps(counts[rows])
    seconds = counts * unit.factor
    if wraps is not None:
        seconds[rows] += wraps * unit.factor
    back = np.flatnonzero(np.diff(seconds[rows]) < 0) + 1
    if len(back) and not sort:
        line = table.line[rows[back[0]]]
        what = f"time goes back at {len(back):,} rows, first at {counted} {line}"
        raise problem(path, f"column {column}", what, "check the clock's column, or give --sort")
    if len(back):
        rows = rows[np.argsort(seconds[rows], kind="stable")]
    repeat = np.flatnonzero(np.diff(seconds[rows]) == 0) + 1
    kept = np.delete(rows, repeat)
    if len(kept) < 2 or len(without) > len(seconds) // 2:
        what = f"only {len(kept):,} of {len(seconds):,} rows have a time of their own"
        raise problem(path, f"column {column}", what, "check the clock's column, and the file")
    times = 0 if wraps is None else len(np.unique(wraps)) - 1
    return _dated(path, Clock(kept, seconds[kept], without, np.sort(rows[repeat]), len(back), times))


def _wraps(counts: np.ndarray) -> np.ndarray | None:
    """What to add to the counts of a counter that began anew at its end; None for a clock that did not."""
    steps = np.diff(counts)
    back = steps < 0
    if not back.any() or back.all() or counts.min() < 0 or (counts % 1).any():
        return None
    size = next((2.0**bits for bits in COUNTER_BITS if counts.max() < 2.0**bits), None)
    if size is None or (steps[back] + size).max() > MAX_WRAP_STEP * np.median(steps[~back]):
        return None
    return size * np.concatenate([[0], np.cumsum(back)])


def clock_of_rate(path: Path, rows: int, rate_hz: float, start: float) -> Clock:
    """The clock of a table without one: row k is at ``start + k / rate_hz`` s."""
    if rows < 2:
        raise problem(path, "file", f"holds {rows} rows", "give a table of at least two rows")
    none = np.empty(0, np.int64)
    with np.errstate(over="ignore"):
        seconds = start + np.arange(rows) / rate_hz
    return _dated(path, Clock(np.arange(rows), seconds, none, none, 0, remedy="check --rate, --start"))


def _dated(path: Path, clock: Clock) -> Clock:
    """The clock; raises `SessionError` if one of its times has no date."""
    first, last = float(clock.seconds[0]), float(clock.seconds[-1])
    if not max(abs(first), abs(last)) < LAST_TIME:
        what = f"times from {first:.4g} to {last:.4g} s cannot be kept: the year 9999 ends at {LAST_TIME:.4g} s"
        raise problem(path, "clock", what, clock.remedy)
    return clock


def join_clocks(paths: Sequence[Path], clocks: Sequence[Clock], gap: float | None) -> list[Clock]:
    """The clocks of files that follow each other as one clock.

    With ``gap`` in s each file begins that long after the end of the one before; without it, the clocks must be one.
    """
    joined = [clocks[0]]
    for path, before, clock in zip(paths[1:], paths, clocks[1:], strict=False):
        end, first = float(joined[-1].seconds[-1]), float(clock.seconds[0])
        if gap is not None and clock.counts_from_1970:
            raise problem(path, "--gap", "the clock counts from 1970 and says the pause itself", "leave --gap out")
        if gap is None and first <= end:
            what = f"begins at {first:g} s, and {before.name} ends at {end:g} s"
            raise problem(path, "clock", what, "give the files in order; for clocks that start anew give --gap SECONDS")
        shift = 0.0 if gap is None else end + gap - first
        remedy = clock.remedy if gap is None else f"{clock.remedy}, --gap"
        joined.append(_dated(path, replace(clock, seconds=clock.seconds + shift, remedy=remedy)))
    return joined


def common_start(clocks: Sequence[Clock], epoch: datetime | None) -> tuple[datetime, float, bool]:
    """The epoch, the clock reading in s that belongs to it, and whether it is known."""
    if len({clock.counts_from_1970 for clock in clocks}) > 1:
        raise SessionError(
            "import: one clock counts from 1970 and another from its own start; give --start of the table with a "
            "stated rate, or import into two sessions"
        )
    first = min(float(c.seconds[0]) for c in clocks)
    if first >= UNIX_TIME_FROM:
        whole = math.floor(first)
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=whole), float(whole), True
    if epoch is not None:
        return epoch, 0.0, True
    return datetime(1970, 1, 1, tzinfo=UTC), 0.0, False


def nanoseconds(path: Path, clock: Clock, zero: float) -> np.ndarray:
    """Times in ns since the clock's reading ``zero`` in s; raises `SessionError` where they do not fit int64."""
    times = np.rint((clock.seconds - zero) * 1e9)
    if np.abs(times).max() >= 2.0**62 or (np.diff(times) <= 0).any():
        raise problem(path, "clock", "cannot be kept in nanoseconds", clock.remedy)
    return times.astype(np.int64)
