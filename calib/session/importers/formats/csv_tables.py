"""Tables of numbers as text (CSV), as loggers, pandas, Excel and NumPy write them."""

import argparse
import csv
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ...errors import printable, problem
from ..base import StatedFacts
from ..limits import check_size
from ..reports import ImportReport
from ..tables.columns import FileSpec
from ..tables.importer import AbstractTableImporter
from ..tables.session import import_tables
from ..tables.table import AbstractTableFile, CountedSteps, Progress, Table
from .text_dates import date_columns, seconds_of
from .text_files import count_lines, lines_of
from .text_layout import FIRST_LINES, layout_of, wrong_sign

if TYPE_CHECKING:  # a second to import, and only wanted with --skin
    import jaxeit as je

BLOCK_CELLS = 1 << 18
MAX_CELL_LINES = 1000
"""Largest number of lines in a quoted cell; a longer cell means that its quote is not closed."""


class CsvFile(AbstractTableFile):
    """A table of text; ``decimal`` is "point", "comma" or "" (to be found from the first lines)."""

    counted = "line"

    def __init__(self, path: Path, decimal: str = ""):
        self.path = path
        self._lines = count_lines(path)
        first = [line for _, line in itertools.islice(lines_of(path), FIRST_LINES)]
        self._dialect = layout_of(path, first, decimal)
        self.header, self.columns = self._dialect.header, self._dialect.columns
        rows = [cells for line, cells in self._dialect.rows(first, strict=False) if line > self._dialect.header_lines]
        self.dates = date_columns(rows)

    def read(self, columns: Sequence[int], used: int, progress: Progress) -> Table:
        """See `AbstractTableFile.read`."""
        check_size(self.path, self._lines, len(columns), used)
        data = itertools.islice(lines_of(self.path), self._dialect.header_lines, None)
        lines = iter(progress(CountedSteps(data, self._lines)))
        values, numbers = [np.empty((0, len(columns)))], [np.empty(0, np.int64)]
        for block in _blocks(lines, max(1, BLOCK_CELLS // self.columns)):
            cells, line = self._parse(block, columns)
            values.append(cells)
            numbers.append(line)
        table = np.concatenate(values)
        return Table(table, np.concatenate(numbers), np.isnan(table))

    def _parse(self, block: list[tuple[int, str]], columns: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (rows, columns), NaN for a cell without a number, and the line of each row (rows,)."""
        if self._is_plain(block):
            try:
                delimiter, lines = self._dialect.delimiter, [text for _, text in block]
                values = np.loadtxt(lines, delimiter=delimiter, usecols=columns, ndmin=2, comments=None)
            except ValueError:
                pass
            else:
                return np.where(np.isfinite(values), values, np.nan), np.array([line for line, _ in block], np.int64)
        rows = self._rows(block)
        values = np.array([self._row(line, cells, columns) for line, cells in rows])
        return values.reshape(len(rows), len(columns)), np.array([line for line, _ in rows], np.int64)

    def _is_plain(self, block: list[tuple[int, str]]) -> bool:
        """Whether the rows are full and free of quotes and decimal commas, so that the quick reader may be used."""
        delimiter, between = self._dialect.delimiter, self.columns - 1
        if self._dialect.decimal_comma or delimiter == " ":
            return False
        return all('"' not in text and text.count(delimiter) == between for _, text in block)

    def _rows(self, block: list[tuple[int, str]]) -> list[tuple[int, list[str]]]:
        """Line and cells of each row."""
        rows = []
        try:
            for number, cells in self._dialect.rows(text for _, text in block):
                rows.append((block[number - 1][0], cells))
        except csv.Error as error:
            line = rows[-1][0] + 1 if rows else block[0][0]
            what = f"quotes do not match ({printable(error)})"
            raise problem(self.path, f"line {line}", what, "close each quote before the next delimiter") from error
        return rows

    def _row(self, line: int, cells: list[str], columns: Sequence[int]) -> list[float]:
        """Numbers of one row; all NaN if it has more cells than the table has columns, because cells may be shifted."""
        if any(cells[self.columns :]):
            return [np.nan] * len(columns)
        return [self._value(line, cells[c] if c < len(cells) else "", c) for c in columns]

    def _value(self, line: int, cell: str, column: int) -> float:
        if column in self.dates:
            return seconds_of(cell, self.dates[column])
        if self._dialect.contradicted_by(cell):
            raise wrong_sign(self.path, line, cell, self._dialect)
        return self._dialect.number(cell)


def _blocks(lines: Iterator[tuple[int, str]], rows: int) -> Iterator[list[tuple[int, str]]]:
    """Lines in blocks that do not end within a quoted cell."""
    while block := list(itertools.islice(lines, rows)):
        quotes = sum(text.count('"') for _, text in block)
        for number, text in itertools.islice(lines, MAX_CELL_LINES if quotes % 2 else 0):
            block.append((number, text))
            if text.count('"') % 2:
                break
        yield block


def import_csv(
    files: Sequence[FileSpec],
    output: str | os.PathLike[str],
    *,
    title: str = "",
    epoch: datetime | None = None,
    sort: bool = False,
    license: str = "",
    skin: "je.Skin | None" = None,
    progress: Progress = iter,
) -> ImportReport:
    """Write the described columns of text files as one session file; see `import_tables` and `StatedFacts`.

    ``sort`` allows rows that go back in time. Raises `SessionError`, and then writes nothing.
    """
    return import_tables(CsvFile, files, output, StatedFacts(title, license, epoch, skin, progress), sort=sort)


class CsvImporter(AbstractTableImporter):
    """Tables of numbers as text."""

    name: ClassVar[str] = "csv"
    summary: ClassVar[str] = "tables of numbers as text (pandas, Excel, loggers), .gz allowed"

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Add ``--decimal`` to the arguments of all tables."""
        super().add_arguments(parser)
        text = "the decimal sign, if the first lines do not determine it"
        parser.add_argument("--decimal", choices=("point", "comma"), default="", help=text)

    @classmethod
    def opener(cls, args: argparse.Namespace) -> Callable[[Path], AbstractTableFile]:
        """See `AbstractTableImporter.opener`."""
        return partial(CsvFile, decimal=args.decimal)
