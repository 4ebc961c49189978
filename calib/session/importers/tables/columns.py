"""Texts that assign the columns of a table to clock and streams: ``0:ms``, ``force=4:N``, ``signal=s0-s3:V``."""

import csv
import itertools
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxeit.messages.spelling import did_you_mean

from ...argument_checks import paths_of
from ...errors import SessionError, printable, problem
from ...units import KNOWN_UNITS, UNITS
from ..limits import MAX_COLUMNS


@dataclass(frozen=True)
class StreamSpec:
    """A stream to import: its name, its columns (numbers, header names or ranges of names), and their unit.

    An empty unit means that the header states the unit.
    """

    name: str
    columns: tuple[str, ...]
    unit: str


@dataclass(frozen=True)
class FileSpec:
    """A file to read, or several of one layout that follow each other.

    | field           | meaning                                                                     | unit |
    |-----------------|-----------------------------------------------------------------------------|------|
    | path            | the file                                                                    |      |
    | time, time_unit | column of the clock and its unit; an empty unit: that of the header         |      |
    | streams         | streams to import from the columns                                          |      |
    | missing         | numbers that stand for missing readings                                     |      |
    | following       | files of the same layout that continue this one, in order                   |      |
    | rate_hz         | rate of a table without a clock; ``time`` is empty then                     | Hz   |
    | start           | time of the first row of a table without a clock                            | s    |
    | gap             | pause before each following file; None: all files are of one clock          | s    |
    """

    path: str | os.PathLike[str]
    time: str
    time_unit: str
    streams: tuple[StreamSpec, ...]
    missing: tuple[float, ...] = ()
    following: Sequence[str | os.PathLike[str]] = ()
    rate_hz: float | None = None
    start: float = 0.0
    gap: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))
        object.__setattr__(self, "following", tuple(paths_of(self.following, "FileSpec: following")))

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files, in order."""
        return tuple(map(Path, (self.path, *self.following)))


def parse_time(text: str) -> tuple[str, str]:
    """``COLUMN:UNIT`` of the clock, as ``0:ms``; ``COLUMN`` where the header says the unit. Raises `SessionError`."""
    column, unit = _column_and_unit(text)
    if not column or (unit and UNITS.get(unit, UNITS["m"]).si != "s"):
        raise SessionError(f"--time {printable(text)}: not COLUMN:UNIT; write it as 0:ms (s, us, ns)")
    return column.strip(), unit


def _column_and_unit(text: str) -> tuple[str, str]:
    """Split a text at its last colon into column and unit; the unit is empty without a colon."""
    column, colon, unit = text.rpartition(":")
    return (column, unit.strip() or "?") if colon else (text, "")


def parse_stream(text: str) -> StreamSpec:
    """``NAME=COLUMNS:UNIT``, as ``force=4:g``, ``sensor=1-15:counts`` or ``signal=s0-s3:V``.

    A header name that holds a comma stands in quotes: ``p="p, left":kPa``. Without a unit, ``NAME=COLUMNS``, the header
    must say it. Raises `SessionError`.
    """
    name, equals, rest = text.partition("=")
    columns, unit = _column_and_unit(rest)
    where = f"--stream {printable(text)}"
    if not (equals and name and columns) or unit == "?":
        raise SessionError(f"{where}: not NAME=COLUMNS:UNIT; write it as force=4:N")
    if unit and unit not in UNITS:
        raise SessionError(f"{where}: unit {printable(unit)!r} not known; use one of: {KNOWN_UNITS}")
    try:
        (cells,) = csv.reader([columns], skipinitialspace=True, strict=True)
    except (ValueError, csv.Error):
        raise SessionError(f"{where}: quotes do not match; write it as force=4:N") from None
    return StreamSpec(name, tuple(itertools.chain(*(_column_range(c.strip()) for c in cells))), unit)


def _column_range(text: str) -> list[str]:
    """``3`` -> 3; ``1-15`` -> 1..15; anything else is a header name or a range of header names."""
    first, dash, last = text.partition("-")
    if not (dash and first.isdecimal() and last.isdecimal()):
        return [text]
    return [str(i) for i in _numbers_from_to(text, first, last)]


def _numbers_from_to(text: str, first: str, last: str) -> range:
    low, high = int(first), int(last)
    if low > high or high - low > MAX_COLUMNS:
        raise SessionError(f"columns {printable(text)}: not a range; write it as 1-15")
    return range(low, high + 1)


# --- names in the header -------------------------------------------------------------------------

_NAME_AND_UNIT = re.compile(r"(.*?)\s*(?:[(\[]\s*(.*?)\s*[)\]]|[/_,]\s*(\w+))")
_NUMBERED = re.compile(r"(.*?)(\d+)(\D*)")


def name_and_unit(head: str) -> tuple[str, str]:
    """``load (N)``, ``load [N]``, ``load/N``, ``load_N`` -> load and N; the whole name where no known unit ends it.

    A digit is no unit: ``s_1`` is the name of a channel.
    """
    found = _NAME_AND_UNIT.fullmatch(head)
    unit = (found[2] or found[3]) if found else ""
    return (found[1], unit) if found and unit in UNITS and unit != "1" else (head, "")


def column_indices(path: Path, column: str, header: Sequence[str], columns: int) -> list[int]:
    """The columns that one text names; raises `SessionError`.

    A text is a header name, in which unit and case may be left out, the name of an array of several columns
    (``C`` for ``C[0]``, ``C[1]``), a number counted from zero, or a range of header names. A header name goes first.
    """
    found = _named(path, column, header)
    if found is not None:
        return [found]
    elements = [i for i, head in enumerate(header) if re.fullmatch(re.escape(column) + r"\[\d+\]", head)]
    if elements:
        return elements
    if column.isdecimal():
        if int(column) < columns:
            return [int(column)]
        what = f"not there; the file has columns 0 to {columns - 1}"
        raise problem(path, f"column {column}", what, "count columns from zero")
    names = _range_of_names(path, column, header)
    if names is not None:
        return names
    if near := did_you_mean(column, header):
        raise problem(path, f"column {column!r}", "not there", near)
    what = f"not there; header names: {_listed(header) or 'none, it has no header'}"
    raise problem(path, f"column {column!r}", what, "use one of them, or count from zero")


def _listed(header: Sequence[str]) -> str:
    """Names in the header as a user writes them: numbered columns as a range, a name with a comma in quotes."""
    written = [f'"{head}"' if "," in head else head for head in header]
    groups = itertools.groupby(written, key=_unnumbered)
    ends = [(names[0], names[-1]) for names in (list(group) for _, group in groups)]
    return ", ".join(first if first == last else f"{first}-{last}" for first, last in ends)


def _unnumbered(head: str) -> str:
    """What the names of numbered columns have in common: ``U# [mV]`` of ``U7 [mV]``; other names as they are."""
    found = _NUMBERED.fullmatch(head)
    return f"{found[1]}#{found[3]}" if found else head


def _named(path: Path, column: str, header: Sequence[str]) -> int | None:
    """The column of this header name, or None. A name that several columns have is refused."""
    exact = [i for i, head in enumerate(header) if head == column]
    bare = [i for i, head in enumerate(header) if name_and_unit(head)[0].lower() == column.lower()]
    found = exact or bare
    if len(found) > 1:
        what = f"is the name of columns {', '.join(map(str, found[:8]))}"
        raise problem(path, f"column {column!r}", what, "give the column's number, counted from zero")
    return found[0] if found else None


def _range_of_names(path: Path, text: str, header: Sequence[str]) -> list[int] | None:
    """``s0-s3`` -> s0, s1, s2, s3, by number; ``x-z`` -> the columns from x to z, as the header has them."""
    for dash in (match.start() for match in re.finditer("-", text)):
        first, last = text[:dash].strip(), text[dash + 1 :].strip()
        low, high = _NUMBERED.fullmatch(first), _NUMBERED.fullmatch(last)
        if low and high and (low[1], low[3]) == (high[1], high[3]):
            numbers = _numbers_from_to(text, low[2], high[2])
            names = [f"{low[1]}{number:0{len(low[2])}}{low[3]}" for number in numbers]
            indices = [_named(path, name, header) for name in names]
            if indices[0] is not None:
                return _all_there(path, text, names, indices)
        start, end = _named(path, first, header), _named(path, last, header)
        if start is not None and end is not None and start <= end:
            return list(range(start, end + 1))
    return None


def _all_there(path: Path, text: str, names: Sequence[str], indices: Sequence[int | None]) -> list[int]:
    for name, index in zip(names, indices, strict=True):
        if index is None:
            remedy = "end the range before it, or name each column"
            raise problem(path, f"columns {text!r}", f"no column is called {printable(name)}", remedy)
    return [index for index in indices if index is not None]
