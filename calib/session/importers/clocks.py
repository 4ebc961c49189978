"""Clocks of foreign recordings: strictly increasing times in nanoseconds since a known start."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from ..errors import problem
from ..units import Unit
from .tables import Table

UNIX_TIME_FROM = 1e8
"""A clock beyond this many seconds (1973) counts from 1970; below, from an unknown start."""


@dataclass(frozen=True)
class Clock:
    """Rows that are kept, in order, their times in s, and what was left out."""

    rows: np.ndarray
    seconds: np.ndarray
    without: np.ndarray
    equal: np.ndarray
    sorted: int


def clock_of(path: Path, table: Table, column: str, unit: Unit, sort: bool) -> Clock:
    """Strictly increasing times; repeated ones are left out, backward ones refused or sorted."""
    seconds = table.values[:, 0] * unit.factor
    rows = np.flatnonzero(np.isfinite(seconds))
    without = np.flatnonzero(~np.isfinite(seconds))
    back = np.flatnonzero(np.diff(seconds[rows]) < 0) + 1
    if len(back) and not sort:
        line = table.line[rows[back[0]]]
        what = f"time goes back at {len(back):,} rows, first at line {line}"
        raise problem(path, f"column {column}", what, "check the clock's column, or give --sort")
    if len(back):
        rows = rows[np.argsort(seconds[rows], kind="stable")]
    repeat = np.flatnonzero(np.diff(seconds[rows]) == 0) + 1
    kept = np.delete(rows, repeat)
    if len(kept) < 2 or len(without) > len(seconds) // 2:
        what = f"only {len(kept):,} of {len(seconds):,} rows have a time of their own"
        raise problem(path, f"column {column}", what, "check the clock's column, and the file")
    return Clock(kept, seconds[kept], without, np.sort(rows[repeat]), len(back))


def common_start(clocks: Sequence[Clock], epoch: datetime | None) -> tuple[datetime, float, bool]:
    """The epoch, the clock reading in s that belongs to it, and whether it is known."""
    first = min(float(c.seconds[0]) for c in clocks)
    if first >= UNIX_TIME_FROM:
        whole = math.floor(first)
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=whole), float(whole), True
    if epoch is not None:
        return epoch, 0.0, True
    return datetime(1970, 1, 1, tzinfo=UTC), 0.0, False


def nanoseconds(path: Path, clock: Clock, zero: float) -> np.ndarray:
    times = np.rint((clock.seconds - zero) * 1e9)
    if np.abs(times).max() >= 2.0**62 or (np.diff(times) <= 0).any():
        raise problem(path, "clock", "cannot be kept in nanoseconds", "check the unit of --time")
    return times.astype(np.int64)
