"""Files of named arrays (NumPy, MATLAB, HDF5, Parquet, ROS) as tables.

An array of one column is the column of its name. An array ``p`` of several is the columns ``p[0]``, ``p[1]``; ``p``
alone names all of them. Columns that are used together must have equally many rows; others go after ``--from``, where
the same file may be named again.
"""

import argparse
import tempfile
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..errors import printable, problem
from .child import in_child
from .limits import MAX_COLUMNS, MAX_NAMES, check_size
from .tables.importer import AbstractTableImporter
from .tables.table import AbstractTableFile, Progress, Table


class ArrayShape(NamedTuple):
    """``rows`` and ``columns`` of an array as a table.

    ``unit`` is known of clocks: "s" of times since 1970. ``refused`` says what an array holds that cannot be read as
    numbers, such as "text"; an import that names this array ends with that.
    """

    rows: int
    columns: int
    unit: str = ""
    refused: str = ""


def table_shape(shape: Sequence[int], unit: str = "") -> ArrayShape | None:
    """The table that an array of this shape gives, or None; a single row becomes a column, as in MATLAB's vectors."""
    if len(shape) == 1:
        return ArrayShape(shape[0], 1, unit)
    if len(shape) != 2:
        return None
    return ArrayShape(shape[1], 1, unit) if shape[0] == 1 else ArrayShape(shape[0], shape[1], unit)


def table_values(values: np.ndarray, shape: ArrayShape) -> np.ndarray:
    """Values as (rows, columns) float64; times in s since 1970; NaN for missing values."""
    if values.dtype.kind in "mM":
        nanoseconds = values.astype(f"{values.dtype.kind}8[ns]")
        values = np.where(np.isnat(nanoseconds), np.nan, nanoseconds.astype(np.int64) * 1e-9)
    return np.asarray(values, np.float64).reshape(shape.rows, shape.columns)


class AbstractArrayImporter(AbstractTableImporter):
    """A format whose files hold named arrays.

    ``isolated`` formats are read in a child process of bounded memory and time.

    Example:
        import numpy as np

        from calib.session.importers import AbstractArrayImporter, ArrayShape


        class RawImporter(AbstractArrayImporter):  # jaxeit import my_module:RawImporter FILE ...
            name, summary = "raw", "float32 numbers of two channels, one row after the other"

            @classmethod
            def outline(cls, path):
                return {"channels": ArrayShape(path.stat().st_size // 8, 2)}

            @classmethod
            def arrays(cls, path, names):
                return [np.fromfile(path, "<f4").reshape(-1, 2).astype(float)]
    """

    isolated: ClassVar[bool] = True

    @classmethod
    @abstractmethod
    def outline(cls, path: Path) -> dict[str, ArrayShape]:
        """Shapes, by name, of the arrays that can be columns, without reading their values; raises `SessionError`."""

    @classmethod
    @abstractmethod
    def arrays(cls, path: Path, names: Sequence[str]) -> list[np.ndarray]:
        """Read the named arrays, each (rows, columns) float64; raises `SessionError`."""

    @classmethod
    def opener(cls, args: argparse.Namespace) -> Callable[[Path], AbstractTableFile]:
        """See `AbstractTableImporter.opener`."""
        return partial(ArrayFile, cls)


class ArrayFile(AbstractTableFile):
    """A file of named arrays, read by a format."""

    def __init__(self, kind: type[AbstractArrayImporter], path: Path):
        self.path, self._kind = path, kind
        found = in_child(kind, "outline", path) if kind.isolated else kind.outline(path)
        self._shapes = {name: ArrayShape(*shape) for name, shape in found.items()}
        self.refused = {name: shape.refused for name, shape in self._shapes.items() if shape.refused}
        few = {name: shape.columns for name, shape in self._shapes.items() if shape.columns <= MAX_COLUMNS}
        self._places = [(name, i) for name, count in few.items() if name not in self.refused for i in range(count)]
        if not self._places or len(self._places) > MAX_NAMES:
            what = f"holds {len(self._places):,} columns of numbers"
            raise problem(path, "file", what, f"give a file of 1 to {MAX_NAMES:,} columns")
        self.header = tuple(_head(name, column, self._shapes[name]) for name, column in self._places)
        self.columns = len(self.header)

    def read(self, columns: Sequence[int], used: int, progress: Progress) -> Table:
        """See `AbstractTableFile.read`."""
        wanted = [self._places[index] for index in columns]
        names = list(dict.fromkeys(name for name, _ in wanted))
        rows = self._common_rows(names)
        check_size(self.path, rows, sum(self._shapes[name].columns for name in names), used)
        arrays = dict(zip(names, self._arrays(names), strict=True))
        for name, array in arrays.items():
            if array.shape != self._shapes[name][:2]:
                what = f"has the shape {array.shape}, and {tuple(self._shapes[name][:2])} was declared"
                raise problem(self.path, name, what, "the file is damaged; take another copy")
        values = np.stack([arrays[name][:, column] for name, column in wanted], axis=1)
        bad = ~np.isfinite(values)
        values[bad] = np.nan
        return Table(values, np.arange(1, rows + 1), bad)

    def _common_rows(self, names: Sequence[str]) -> int:
        rows = {name: self._shapes[name].rows for name in names}
        if len(set(rows.values())) > 1:
            said = ", ".join(f"{printable(name)} has {count:,}" for name, count in list(rows.items())[:8])
            todo = "name arrays of equal length together, others after --from with a clock of their own"
            raise problem(self.path, "rows", f"differ: {said}", todo)
        return rows[names[0]]

    def _arrays(self, names: Sequence[str]) -> list[np.ndarray]:
        if not self._kind.isolated:
            return self._kind.arrays(self.path, names)
        with tempfile.TemporaryDirectory() as folder:
            in_child(self._kind, "arrays", self.path, names=names, folder=Path(folder))
            return [np.load(Path(folder) / f"{i}.npy", allow_pickle=False) for i in range(len(names))]


def _head(name: str, column: int, shape: ArrayShape) -> str:
    head = name if shape.columns == 1 else f"{name}[{column}]"
    return f"{head} ({shape.unit})" if shape.unit else head


def known(path: Path, found: dict[str, Any], name: str) -> Any:
    """The array of this name, which the outline of the file contained; `SessionError` if the file has changed since."""
    if name not in found:
        raise problem(path, name, "is no longer there", "leave the file alone while it is imported")
    return found[name]
