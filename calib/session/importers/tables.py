"""Tables of numbers as text: their layout is found out, and single columns are read."""

import gzip
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import problem
from ..units import UNITS

Progress = Callable[[Iterable[Any]], Iterable[Any]]

MAX_LINE = 1 << 20
BLOCK_LINES = 1 << 15
FIRST_LINES = 20
"""Lines from which the layout is found out."""
LAYOUTS = (
    (",", False),
    ("\t", False),
    (";", False),
    (None, False),
    ("\t", True),
    (";", True),
    (None, True),
)
"""Delimiter (None is white space) and whether a comma is the decimal point; likelier ones first."""


@dataclass(frozen=True)
class Dialect:
    """How a text file is laid out: delimiter (None is white space), header names, columns."""

    delimiter: str | None
    decimal_comma: bool
    header: tuple[str, ...] = ()
    columns: int = 0

    def plain(self, line: str) -> str:
        """The line with decimal points."""
        return line.replace(",", ".") if self.decimal_comma else line

    def cells(self, line: str) -> list[str]:
        """The cells of a line, stripped."""
        return [cell.strip().strip('"') for cell in line.split(self.delimiter)]


@dataclass
class Table:
    """Selected columns of a file: ``values`` (rows, columns) NaN where a cell is no number."""

    values: np.ndarray
    line: np.ndarray
    bad: np.ndarray = field(repr=False)


def _open_text(path: Path) -> TextIOWrapper:
    try:
        with path.open("rb") as stream:
            packed = stream.read(2) == b"\x1f\x8b"
        opener: Any = gzip.open if packed else open
        found: TextIOWrapper = opener(path, "rt", encoding="utf-8-sig", errors="replace", newline=None)
        return found
    except FileNotFoundError:
        raise problem(path, "file", "does not exist", "check the name and the folder") from None
    except IsADirectoryError:
        raise problem(path, "file", "is a folder", "name the file in it") from None
    except OSError as error:
        raise problem(path, "file", f"cannot be read ({error.strerror})", "check access") from error


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers from 1 and lines that are neither blank nor comments."""
    with _open_text(path) as stream:
        number = 0
        try:
            while line := stream.readline(MAX_LINE):
                number += 1
                if len(line) >= MAX_LINE or "\0" in line:
                    raise problem(path, f"line {number}", "is not text", "give a CSV file")
                if line.strip() and not line.startswith("#"):
                    yield number, line.rstrip("\r\n")
        except (EOFError, gzip.BadGzipFile, OSError) as error:
            what = f"the gzip file is damaged ({error})"
            raise problem(path, f"line {number + 1}", what, "take another copy") from error


def _number(cell: str) -> float:
    """The number in a cell; NaN if there is none (an infinite one counts as none)."""
    try:
        value = float(cell)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and "_" not in cell else math.nan


def layout_of(path: Path, first: list[str]) -> Dialect:
    """The layout under which most cells of the first lines are numbers."""
    if not first:
        raise problem(path, "file", "holds no rows", "give a table of numbers")
    best = max(LAYOUTS, key=lambda layout: _numbers_found(first, Dialect(*layout)))
    dialect = Dialect(*best)
    widths = [len(dialect.cells(line)) for line in first]
    columns = max(widths, key=widths.count)
    head = dialect.cells(first[0])
    named = any(head) and all(math.isnan(_number(cell)) for cell in head)
    return Dialect(*best, tuple(head) if named else (), columns)


def _numbers_found(lines: list[str], dialect: Dialect) -> int:
    cells = itertools.chain(*(dialect.cells(dialect.plain(line)) for line in lines))
    return sum(not math.isnan(_number(cell)) for cell in cells)


_NAME_AND_UNIT = re.compile(r"(.*?)\s*(?:[(\[]\s*(.*?)\s*[)\]]|[/_,]\s*(\w+))")


def name_and_unit(head: str) -> tuple[str, str]:
    """``load (N)``, ``load [N]``, ``load/N``, ``load_N`` -> load and N; the whole name where no known unit ends it."""
    found = _NAME_AND_UNIT.fullmatch(head)
    unit = (found[2] or found[3]) if found else ""
    return (found[1], unit) if found and unit in UNITS else (head, "")


def column_index(path: Path, column: str, dialect: Dialect) -> int:
    """A column's index from its number or its header name, the unit and the case of which may be left out."""
    if column in dialect.header:
        return dialect.header.index(column)
    bare = [name_and_unit(head)[0].lower() for head in dialect.header]
    if bare.count(column.lower()) == 1:
        return bare.index(column.lower())
    if column.isdecimal():
        if int(column) < dialect.columns:
            return int(column)
        what = f"not there; the file has columns 0 to {dialect.columns - 1}"
        raise problem(path, f"column {column}", what, "count columns from zero")
    what = f"not there; header names: {', '.join(dialect.header) or 'none, it has no header'}"
    raise problem(path, f"column {column!r}", what, "use one of them, or count from zero")


def read_table(path: Path, dialect: Dialect, columns: Sequence[int], progress: Progress) -> Table:
    """The given columns of every row."""
    lines = iter(progress(itertools.islice(lines_of(path), 1 if dialect.header else 0, None)))
    values, numbers, bad = [np.empty((0, len(columns)))], [np.empty(0, np.int64)], []
    bad.append(np.empty((0, len(columns)), bool))
    while block := list(itertools.islice(lines, BLOCK_LINES)):
        texts = [dialect.plain(text) for _, text in block]
        cells, wrong = _parse_block(texts, dialect, columns)
        values.append(cells)
        bad.append(wrong)
        numbers.append(np.array([n for n, _ in block], np.int64))
    return Table(np.concatenate(values), np.concatenate(numbers), np.concatenate(bad))


def _parse_block(lines: list[str], dialect: Dialect, columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (rows, columns), and where a cell held none."""
    try:
        options: dict[str, Any] = {"delimiter": dialect.delimiter, "usecols": columns}
        values = np.loadtxt(lines, ndmin=2, comments=None, **options)
    except (ValueError, IndexError):
        values = np.array([_row(dialect.cells(line), columns) for line in lines])
    values = values.reshape(len(lines), len(columns))
    bad = ~np.isfinite(values)
    return np.where(bad, np.nan, values), bad


def _row(cells: list[str], columns: Sequence[int]) -> list[float]:
    return [_number(cells[c]) if c < len(cells) else math.nan for c in columns]
