"""Apache Parquet, as pandas, polars and data sets for learning write it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ...errors import problem
from ..arrays import AbstractArrayImporter, ArrayShape
from ..child import library
from ..limits import check_size
from ..tables.table import first_bytes
from .text_dates import date_columns, seconds_of

EXTRA = "tables"


FIRST_CELLS = 64  # cells of a column of text that tell whether it holds dates
TEXT = "text"


class ParquetImporter(AbstractArrayImporter):
    """Columns of numbers, times and dates, also of dates as text; lists of a fixed length are several columns."""

    name: ClassVar[str] = "parquet"
    summary: ClassVar[str] = "Apache Parquet (pandas, polars), with the extra jaxeit[tables]"

    @classmethod
    def outline(cls, path: Path) -> dict[str, ArrayShape]:
        """See `AbstractArrayImporter.outline`."""
        first_bytes(path)
        arrow, parquet = library("pyarrow", EXTRA), library("pyarrow.parquet", EXTRA)
        with parquet.ParquetFile(path) as file:
            rows = file.metadata.num_rows
            check_size(path, rows, 0)
            shapes = {field.name: _shape(arrow, field.type, rows) for field in file.schema_arrow}
            for name in [name for name, shape in shapes.items() if shape.refused == TEXT]:
                first = next(file.iter_batches(FIRST_CELLS, columns=[name], use_threads=False), None)
                if first is not None and date_columns([[text or ""] for text in first.column(0).to_pylist()]):
                    shapes[name] = ArrayShape(rows, 1, "s")
        return shapes

    @classmethod
    def arrays(cls, path: Path, names: Sequence[str]) -> list[np.ndarray]:
        """See `AbstractArrayImporter.arrays`."""
        arrow, parquet = library("pyarrow", EXTRA), library("pyarrow.parquet", EXTRA)
        with parquet.ParquetFile(path) as file:
            return [_values(arrow, path, name, file.read(columns=[name], use_threads=False)[name]) for name in names]


def _shape(arrow: Any, kind: Any, rows: int) -> ArrayShape:
    if arrow.types.is_dictionary(kind):
        return _shape(arrow, kind.value_type, rows)
    if _time_kind(arrow, kind) is not None:
        return ArrayShape(rows, 1, "s")
    if arrow.types.is_fixed_size_list(kind) and _is_number(arrow, kind.value_type):
        return ArrayShape(rows, kind.list_size)
    if _is_number(arrow, kind):
        return ArrayShape(rows, 1)
    return ArrayShape(rows, 1, "", TEXT if _is_text(arrow, kind) else f"values of the type {kind}")


def _is_number(arrow: Any, kind: Any) -> bool:
    types = arrow.types
    return any(test(kind) for test in (types.is_integer, types.is_floating, types.is_decimal, types.is_boolean))


def _is_text(arrow: Any, kind: Any) -> bool:
    return bool(arrow.types.is_string(kind) or arrow.types.is_large_string(kind))


def _time_kind(arrow: Any, kind: Any) -> Any:
    """The type in ns of dates, times since 1970, times of the day and durations; None for other types."""
    types = arrow.types
    if types.is_timestamp(kind) or types.is_date(kind):
        return arrow.timestamp("ns")
    if types.is_time(kind):
        return arrow.time64("ns")
    return arrow.duration("ns") if types.is_duration(kind) else None


def _values(arrow: Any, path: Path, name: str, column: Any) -> np.ndarray:
    """A column (rows, columns); NaN where it is null."""
    width, factor = 1, 1.0
    if arrow.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if _is_text(arrow, column.type):
        return _seconds(column.to_pylist())[:, None]
    time = _time_kind(arrow, column.type)
    if time is not None:
        column, factor = column.cast(time, safe=True).cast(arrow.int64()), 1e-9
    elif arrow.types.is_fixed_size_list(column.type):
        if column.null_count:
            raise problem(path, name, f"{column.null_count:,} rows hold no list", "fill them with NaN")
        width, column = column.type.list_size, column.combine_chunks().flatten()
    numbers = column.cast(arrow.float64(), safe=False).to_numpy(zero_copy_only=False)
    return np.asarray(numbers, np.float64).reshape(-1, width) * factor


def _seconds(cells: Sequence[str | None]) -> np.ndarray:
    """Dates and times as text in s since 1970; NaN where a cell is null, or no date of the kind of the first ones."""
    zone = date_columns([[cell or ""] for cell in cells[:FIRST_CELLS]]).get(0, False)
    return np.array([seconds_of(cell or "", zone) for cell in cells], np.float64)
