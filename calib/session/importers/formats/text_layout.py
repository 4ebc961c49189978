"""How a table of text is laid out: delimiter, decimal sign and header, found from its first lines."""

import csv
import itertools
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ...errors import SessionError, problem
from .text_dates import is_date

FIRST_LINES = 200
"""Number of lines from which the layout is determined."""
DELIMITERS = (",", "\t", ";", " ")
"""Possible delimiters, the more likely first; a space stands for any white space."""
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")


@dataclass(frozen=True)
class Dialect:
    """How a text file is laid out.

    | field         | meaning                                                    |
    |---------------|------------------------------------------------------------|
    | delimiter     | between cells; a space stands for any white space          |
    | decimal_comma | whether a comma is the decimal sign                        |
    | header        | names of the columns; empty if the file has none           |
    | header_lines  | lines that the header takes, as a name may hold line ends  |
    | columns       | cells of a row                                             |
    """

    delimiter: str
    decimal_comma: bool
    header: tuple[str, ...] = ()
    header_lines: int = 0
    columns: int = 0

    def rows(self, lines: Iterable[str], strict: bool = True) -> Iterator[tuple[int, list[str]]]:
        """Number of the last line of each row, counted from 1, and its cells, stripped.

        Raises:
            csv.Error: for quotes that do not match.
        """
        texts = (" ".join(line.split()) if self.delimiter == " " else line for line in lines)
        reader = csv.reader((t + "\n" for t in texts), delimiter=self.delimiter, skipinitialspace=True, strict=strict)
        for cells in reader:
            yield reader.line_num, [" ".join(cell.split()) for cell in cells]

    def number(self, cell: str) -> float:
        """The number in a cell; NaN if there is none (an infinite one counts as none)."""
        if self.decimal_comma:
            cell = "" if "." in cell else cell.replace(",", ".")
        try:
            value = float(cell)
        except ValueError:
            return math.nan
        return value if math.isfinite(value) and "_" not in cell else math.nan

    def contradicted_by(self, cell: str) -> bool:
        """Whether a cell is a number of the other decimal sign."""
        other = replace(self, decimal_comma=not self.decimal_comma)
        if self.decimal_comma:
            return "." in cell and not math.isnan(other.number(cell))
        return _DECIMAL_COMMA.fullmatch(cell) is not None


def layout_of(path: Path, first: Sequence[str], decimal: str = "") -> Dialect:
    """The layout under which most cells of the first lines are numbers.

    ``decimal`` is "point", "comma" or "" (to be found). Raises `SessionError` where the lines fit no layout, or two.
    """
    signs = {"point": (False,), "comma": (True,)}.get(decimal, (False, True))
    found = [Dialect(delimiter, sign) for sign in signs for delimiter in DELIMITERS]
    best = max(found, key=lambda dialect: _score(_first_rows(dialect, first), dialect))
    rows = _first_rows(best, first)
    if not rows:
        raise problem(path, "file", "holds no rows", "give a table of numbers")
    if not _score(rows, best)[0]:
        raise problem(path, "file", "holds no number in its first lines", "give a table of numbers")
    if not decimal:
        _check_thousands(path, best, rows)
    return _with_header(path, best, rows)


def _first_rows(dialect: Dialect, first: Sequence[str]) -> list[tuple[int, list[str]]]:
    found: list[tuple[int, list[str]]] = []
    try:
        found.extend(dialect.rows(first, strict=False))
    except csv.Error:  # a cell of enormous length: no table under this layout
        return []
    return found


def _score(rows: list[tuple[int, list[str]]], dialect: Dialect) -> tuple[int, int]:
    """Score of a layout: the number of cells that are numbers or dates, then minus the number of other cells."""
    cells = [cell for _, row in rows for cell in row if cell]
    numbers = sum(not math.isnan(dialect.number(cell)) or is_date(cell) for cell in cells)
    return numbers, numbers - len(cells)


def _check_thousands(path: Path, dialect: Dialect, rows: list[tuple[int, list[str]]]) -> None:
    """Refuse numbers such as ``1,234`` alone, which may be 1.234 or 1234; semicolons go with decimal commas."""
    if not dialect.decimal_comma or dialect.delimiter == ";":
        return
    commas = [(line, cell) for line, row in rows for cell in row if _DECIMAL_COMMA.fullmatch(cell)]
    if commas and all(_THOUSANDS.fullmatch(cell) for _, cell in commas):
        line, cell = commas[0]
        what = f"{cell!r} may have a decimal comma or separate thousands"
        raise problem(path, f"line {line}", what, "give --decimal comma, or write thousands without a comma")


def _with_header(path: Path, dialect: Dialect, rows: list[tuple[int, list[str]]]) -> Dialect:
    """The layout with the names in its first row, if that holds no number; the names must fit the rows."""
    head_lines, head = rows[0]
    named = any(head) and all(math.isnan(dialect.number(cell)) for cell in head)
    data = [row for _, row in rows[1:]] if named else [row for _, row in rows]
    widths = [len(row) for row in data] or [len(head)]
    columns = max(widths, key=widths.count)
    if not named:
        _check_numbered(path, head_lines, head, len(rows))
        return replace(dialect, columns=columns)
    surplus = itertools.chain(head[columns:], *(row[len(head) : columns] for row in data))
    if any(surplus):
        what = f"the header has {len(head)} names, the rows have {columns} cells"
        raise problem(path, f"line {head_lines}", what, "correct the header, or quote cells that hold the delimiter")
    return replace(dialect, header=tuple(head), header_lines=head_lines, columns=max(columns, len(head)))


def _check_numbered(path: Path, line: int, head: Sequence[str], rows: int) -> None:
    """Refuse a first row 0, 1, 2 of three or more: pandas names columns so, and no reading may be made of names."""
    if rows > 1 and len(head) > 2 and list(head) == [str(number) for number in range(len(head))]:
        what = f"{', '.join(head[:3])}, as far as {head[-1]}, may be names or readings"
        raise problem(path, f"line {line}", what, "give the columns names, or leave out the line")


def wrong_sign(path: Path, line: int, cell: str, dialect: Dialect) -> SessionError:
    """The error about a number of the other decimal sign."""
    there, sign, other = ("comma", "a point", "point") if dialect.decimal_comma else ("point", "a comma", "comma")
    what = f"{cell!r} has {sign} where the table has a decimal {there}"
    return problem(path, f"line {line}", what, f"write all numbers in one way, or give --decimal {other}")
