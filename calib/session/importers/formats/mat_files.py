"""MATLAB's files: version 5 (and 4) through SciPy, version 7.3 through HDF5."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np
from scipy import io

from ...errors import problem
from ..arrays import AbstractArrayImporter, ArrayShape, known, table_shape, table_values
from ..child import DAMAGED
from ..limits import MAX_NAMES
from ..tables.table import first_bytes
from .hdf5_arrays import datasets, values_of

NUMERIC_CLASSES = {
    "double", "single", "logical", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64",
}  # fmt: skip
MAX_DEPTH = 8


class MatImporter(AbstractArrayImporter):
    """Numeric arrays, also those in structures: ``experiment.C``. Cells, texts, objects and functions are left out."""

    name: ClassVar[str] = "mat"
    summary: ClassVar[str] = "MATLAB files, version 5 and 7.3"

    @classmethod
    def outline(cls, path: Path) -> dict[str, ArrayShape]:
        """See `AbstractArrayImporter.outline`."""
        if is_hdf5(path):
            with h5py.File(path, "r") as file:
                return {name: shape for name, _, shape in _matlab_datasets(path, file)}
        shapes = {}
        for name, shape, kind in io.whosmat(path):
            table = table_shape(shape) if kind in NUMERIC_CLASSES else None
            if table is not None:
                shapes[name] = table
            elif kind == "struct" and shape == (1, 1):
                shapes |= {field: one for field, _, one in _members(name, _loaded(path, name))}
            if len(shapes) > MAX_NAMES:
                raise problem(path, "file", f"holds more than {MAX_NAMES:,} arrays", "save fewer variables")
        return shapes

    @classmethod
    def arrays(cls, path: Path, names: Sequence[str]) -> list[np.ndarray]:
        """See `AbstractArrayImporter.arrays`."""
        if is_hdf5(path):
            with h5py.File(path, "r") as file:
                found = {name: (dataset, shape) for name, dataset, shape in _matlab_datasets(path, file)}
                picked = [known(path, found, name) for name in names]
                return [values_of(path, dataset, shape, transposed=True) for dataset, shape in picked]
        fields: dict[str, tuple[np.ndarray, ArrayShape]] = {}
        for variable in dict.fromkeys(name.split(".")[0] for name in names):
            fields |= {field: (array, shape) for field, array, shape in _members(variable, _loaded(path, variable))}
        return [table_values(*known(path, fields, name)) for name in names]


def is_hdf5(path: Path) -> bool:
    """Whether a MATLAB file is of version 7.3; `SessionError` for a file of another program."""
    head = first_bytes(path, 1024)
    if b"\x89HDF\r\n\x1a\n" in (head[512:520], head[:8]):
        return True
    if head.startswith(b"# Created by Octave"):
        raise problem(path, "file", "is in the text format of Octave", "write it by save('-v7', ...)")
    if len(head) < 128:
        raise problem(path, "file", f"is no MATLAB file ({len(head)} bytes)", DAMAGED)
    return False


def _matlab_datasets(path: Path, file: h5py.File) -> Iterator[tuple[str, h5py.Dataset, ArrayShape]]:
    """Numeric arrays of a file of version 7.3, whose axes MATLAB stores in reverse."""
    for name, dataset in datasets(path, file, "."):
        kind = dataset.attrs.get("MATLAB_class", b"")
        table = table_shape(dataset.shape[::-1])
        if table is not None and kind in {numeric.encode() for numeric in NUMERIC_CLASSES}:
            yield name, dataset, table


def _loaded(path: Path, variable: str) -> Any:
    return io.loadmat(path, variable_names=[variable], appendmat=False)[variable]


def _members(name: str, value: Any, depth: int = 0) -> Iterator[tuple[str, np.ndarray, ArrayShape]]:
    """Numeric arrays of a variable: itself, or the fields of a structure."""
    if not isinstance(value, np.ndarray):
        return
    shape = table_shape(value.shape)
    if value.dtype.names and value.size == 1 and depth < MAX_DEPTH:
        for field in value.dtype.names:
            yield from _members(f"{name}.{field}", value.flat[0][field], depth + 1)
    elif value.dtype.kind in "biuf" and shape is not None:
        yield name, value, shape
