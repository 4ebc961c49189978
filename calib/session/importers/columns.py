"""Which columns of a table are the clock and the streams, as ``0:ms`` and ``force=4:N`` say."""

import itertools
from dataclasses import dataclass
from pathlib import Path

from ..errors import SessionError, printable
from ..units import KNOWN_UNITS, UNITS

MAX_COLUMNS = 100_000
"""More columns in one range are taken for a mistake."""


@dataclass(frozen=True)
class StreamSpec:
    """A stream to make: its name, its columns (numbers or header names), their unit (empty: the header says)."""

    name: str
    columns: tuple[str, ...]
    unit: str


@dataclass(frozen=True)
class FileSpec:
    """A file to read: the clock's column and unit (empty: the header says), streams, numbers that mean missing."""

    path: Path
    time: str
    time_unit: str
    streams: tuple[StreamSpec, ...]
    missing: tuple[float, ...] = ()


def parse_time(text: str) -> tuple[str, str]:
    """``COLUMN:UNIT`` of the clock, as ``0:ms``; ``COLUMN`` where the header says the unit. Raises `SessionError`."""
    column, unit = _column_and_unit(text)
    if not column or (unit and UNITS.get(unit, UNITS["m"]).si != "s"):
        raise SessionError(f"--time {printable(text)}: not COLUMN:UNIT; write it as 0:ms (s, us, ns)")
    return column.strip(), unit


def _column_and_unit(text: str) -> tuple[str, str]:
    """What stands before and after the last colon; without one there is no unit."""
    column, colon, unit = text.rpartition(":")
    return (column, unit.strip() or "?") if colon else (text, "")


def parse_stream(text: str) -> StreamSpec:
    """``NAME=COLUMNS:UNIT``, as ``force=4:g`` or ``sensor=1-15:counts``.

    Without a unit, ``NAME=COLUMNS``, the header must say it. Raises `SessionError`.
    """
    name, equals, rest = text.partition("=")
    columns, unit = _column_and_unit(rest)
    where = f"--stream {printable(text)}"
    if not (equals and name and columns) or unit == "?":
        raise SessionError(f"{where}: not NAME=COLUMNS:UNIT; write it as force=4:N")
    if unit and unit not in UNITS:
        raise SessionError(f"{where}: unit {printable(unit)!r} not known; use one of: {KNOWN_UNITS}")
    parts = tuple(itertools.chain(*(_column_range(c.strip()) for c in columns.split(","))))
    return StreamSpec(name, parts, unit)


def _column_range(text: str) -> list[str]:
    """``3`` -> 3; ``1-15`` -> 1..15; anything else is a header name."""
    first, dash, last = text.partition("-")
    if not (dash and first.isdecimal() and last.isdecimal()):
        return [text]
    low, high = int(first), int(last)
    if low > high or high - low > MAX_COLUMNS:
        raise SessionError(f"columns {text}: not a range; write it as 1-15")
    return [str(i) for i in range(low, high + 1)]
