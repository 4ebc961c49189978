"""Apache Parquet, as pandas, polars and data sets for learning write it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ...errors import problem
from ..arrays import AbstractArrayImporter, ArrayShape
from ..child import library
from ..limits import check_size
from ..tables import first_bytes

EXTRA = "tables"


class ParquetImporter(AbstractArrayImporter):
    """Columns of numbers and times; lists of a fixed length are several columns. Text is left out."""

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
        return {name: shape for name, shape in shapes.items() if shape is not None}

    @classmethod
    def arrays(cls, path: Path, names: Sequence[str]) -> list[np.ndarray]:
        """See `AbstractArrayImporter.arrays`."""
        arrow, parquet = library("pyarrow", EXTRA), library("pyarrow.parquet", EXTRA)
        with parquet.ParquetFile(path) as file:
            return [_values(arrow, path, name, file.read(columns=[name], use_threads=False)[name]) for name in names]


def _shape(arrow: Any, kind: Any, rows: int) -> ArrayShape | None:
    if arrow.types.is_timestamp(kind):
        return ArrayShape(rows, 1, "s")
    if arrow.types.is_fixed_size_list(kind):
        return ArrayShape(rows, kind.list_size) if _is_number(arrow, kind.value_type) else None
    return ArrayShape(rows, 1) if _is_number(arrow, kind) else None


def _is_number(arrow: Any, kind: Any) -> bool:
    types = arrow.types
    return any(test(kind) for test in (types.is_integer, types.is_floating, types.is_decimal, types.is_boolean))


def _values(arrow: Any, path: Path, name: str, column: Any) -> np.ndarray:
    """A column (rows, columns); NaN where it is null."""
    width, factor = 1, 1.0
    if arrow.types.is_timestamp(column.type):
        column, factor = column.cast(arrow.timestamp("ns"), safe=True).cast(arrow.int64()), 1e-9
    elif arrow.types.is_fixed_size_list(column.type):
        if column.null_count:
            raise problem(path, name, f"{column.null_count:,} rows hold no list", "fill them with NaN")
        width, column = column.type.list_size, column.combine_chunks().flatten()
    numbers = column.cast(arrow.float64(), safe=False).to_numpy(zero_copy_only=False)
    return np.asarray(numbers, np.float64).reshape(-1, width) * factor
