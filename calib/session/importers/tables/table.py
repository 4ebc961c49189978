"""A table of numbers in a file, whatever its format: header names, and columns that are read on request."""

import stat
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ...errors import problem
from .columns import column_indices

Progress = Callable[[Iterable[Any]], Iterable[Any]]


@dataclass
class Table:
    """Selected columns: ``values`` (rows, columns), NaN where ``bad``; ``line`` (rows,) is where each row stands."""

    values: np.ndarray
    line: np.ndarray
    bad: np.ndarray = field(repr=False)


class AbstractTableFile(ABC):
    """A file that holds a table.

    | attribute | meaning                                               |
    |-----------|-------------------------------------------------------|
    | path      | of the file                                           |
    | header    | names of the columns; empty if the file has none      |
    | columns   | number of columns                                     |
    | counted   | what ``Table.line`` counts: "line" or "row"           |
    | dates     | columns of text that hold dates and times, read as s  |
    |           | since 1970, and whether these state a time zone       |
    | refused   | names of columns that cannot be read as numbers, and  |
    |           | what they hold; they are not in ``header``            |

    Example:
        from calib.session.importers import AbstractTableFile, AbstractTableImporter, Table


        class Spreadsheet(AbstractTableFile):  # a file of your own that holds one table
            def __init__(self, path):
                self.path, self.header, self.columns, self.counted = path, ["time", "load"], 2, "row"
                self.dates = {}

            def read(self, columns, used, progress):
                values = np.array([[0.0, 1.0], [0.1, 2.0]])[:, list(columns)]
                return Table(values, line=np.arange(1, 3), bad=np.zeros(values.shape, bool))


        class SpreadsheetImporter(AbstractTableImporter):
            name, summary = "spreadsheet", "a table of a program of mine"

            @classmethod
            def opener(cls, args):
                return Spreadsheet
    """

    path: Path
    header: tuple[str, ...]
    columns: int
    counted: str = "row"
    dates: Mapping[int, bool] = MappingProxyType({})
    refused: Mapping[str, str] = MappingProxyType({})

    def indices(self, column: str) -> list[int]:
        """The columns that one text names; raises `SessionError` if they are not there, or hold no numbers."""
        if column in self.refused:
            what = f"holds {self.refused[column]}, which cannot be read as numbers"
            raise problem(self.path, f"column {column!r}", what, "convert it to numbers, or leave it out")
        return column_indices(self.path, column, self.header, self.columns)

    @abstractmethod
    def read(self, columns: Sequence[int], used: int, progress: Progress) -> Table:
        """The given columns of every row; ``used`` counts the cells that earlier files of the import have.

        Raises:
            SessionError: for a damaged file, or one beyond the limits.
        """


class CountedSteps(Iterable[Any], Sized):
    """An iterable whose length is known, so that a progress bar shows how much is left."""

    def __init__(self, steps: Iterable[Any], length: int):
        self._steps, self._length = steps, length

    def __iter__(self) -> Iterator[Any]:
        return iter(self._steps)

    def __len__(self) -> int:
        return self._length


def first_bytes(path: Path, count: int = 512, folder: str = "name the file in it") -> bytes:
    """The first bytes of a file; raises `SessionError` if it is no regular file or cannot be read."""
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            raise problem(path, "file", "is a folder", folder)
        if not stat.S_ISREG(mode):
            raise problem(path, "file", "is not a regular file", "copy its content into a file")
        with path.open("rb") as stream:
            return stream.read(count)
    except FileNotFoundError:
        raise problem(path, "file", "does not exist", "check the name and the folder") from None
    except OSError as error:
        raise problem(path, "file", f"cannot be read ({error.strerror})", "check access") from error
