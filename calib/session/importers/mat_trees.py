"""Whole MATLAB files as trees: structures, arrays of structures, cells, texts, sparse and complex arrays.

Version 5 is read through SciPy, version 7.3 through HDF5, both in a process of its own (`child`), since a file may
claim anything. The child writes every array into one NumPy archive, and prints the rest as JSON.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import scipy.sparse as sp
from scipy import io
from scipy.io.matlab import mat_struct

from ..errors import problem
from .child import in_child
from .formats.hdf5_arrays import MAX_DEPTH, data_inside, members
from .formats.mat_files import is_hdf5

MAX_NODES = 100_000
ARRAYS = "arrays.npz"


def read_mat_tree(path: Path) -> dict[str, Any]:
    """The variables of a MATLAB file by name.

    A structure is a `SimpleNamespace`, an array of structures or a cell a list, a sparse matrix a `scipy.sparse`
    array, a text a `str`; arrays have no axes of length one. Functions and objects are None.

    Raises:
        SessionError, OSError: for a file that cannot be read.
    """
    with TemporaryDirectory() as folder:
        tree = in_child(MatTree, "tree", path, folder=Path(folder))
        with np.load(Path(folder) / ARRAYS, allow_pickle=False) as arrays:
            return {name: _built(node, arrays) for name, node in tree.items()}


def _built(node: Any, arrays: Any) -> Any:
    """The value that a node of the child's tree stands for."""
    match node:
        case {"array": name}:
            return arrays[name]
        case {"sparse": name, "shape": shape}:
            parts = (arrays[f"{name}.{part}"] for part in ("data", "indices", "indptr"))
            return sp.csc_array(tuple(parts), shape)
        case {"fields": fields}:
            return SimpleNamespace(**{name: _built(value, arrays) for name, value in fields.items()})
        case list():
            return [_built(value, arrays) for value in node]
    return node


class MatTree:
    """The reader, in the child process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.arrays: dict[str, np.ndarray] = {}
        self.nodes = 0

    @classmethod
    def tree(cls, path: Path, folder: Path) -> dict[str, Any]:
        """The tree of the file as JSON; arrays go into the folder."""
        reader = cls(path)
        if is_hdf5(path):
            with h5py.File(path, "r") as file:
                found = {n: reader.hdf5(m, file) for n, m in members(path, file) if not n.startswith("#")}
        else:
            loaded = io.loadmat(path, squeeze_me=True, struct_as_record=False, appendmat=False)
            found = {name: reader.value(value) for name, value in loaded.items() if not name.startswith("__")}
        np.savez(folder / ARRAYS, **reader.arrays)  # type: ignore[arg-type]  # names cannot be that of an option
        return found

    def _count(self) -> None:
        self.nodes += 1
        if self.nodes > MAX_NODES:
            raise problem(self.path, "file", f"holds more than {MAX_NODES:,} values", "save fewer variables")

    def _array(self, values: np.ndarray) -> dict[str, str]:
        name = f"a{len(self.arrays)}"
        self.arrays[name] = values
        return {"array": name}

    def _sparse(self, matrix: Any) -> dict[str, Any]:
        name, matrix = f"s{len(self.arrays)}", sp.csc_array(matrix)
        for part in ("data", "indices", "indptr"):
            self.arrays[f"{name}.{part}"] = getattr(matrix, part)
        return {"sparse": name, "shape": list(matrix.shape)}

    def value(self, value: Any, depth: int = 0) -> Any:
        """A value that SciPy read."""
        self._count()
        if depth > MAX_DEPTH:
            return None
        if isinstance(value, mat_struct):
            names = value._fieldnames
            return {"fields": {name: self.value(getattr(value, name), depth + 1) for name in names}}
        if sp.issparse(value):
            return self._sparse(value)
        if isinstance(value, str):
            return value
        array = np.asarray(value)
        if array.dtype == object:
            return [self.value(one, depth + 1) for one in array.ravel("F")] if type(value) is np.ndarray else None
        return self._array(array) if array.dtype.kind in "biufc" else None

    def hdf5(self, node: Any, file: h5py.File, depth: int = 0) -> Any:
        """A member of a file of version 7.3, whose axes MATLAB stores in reverse."""
        self._count()
        if depth > MAX_DEPTH:
            return None
        if isinstance(node, h5py.Group):
            if "MATLAB_sparse" in node.attrs:
                return self._hdf5_sparse(node)
            parts = dict(members(self.path, node))
            if parts and all(_is_list(part) for part in parts.values()):  # an array of structures
                count = min(part.size for part in parts.values())
                columns = {name: part[()].ravel() for name, part in parts.items()}
                return [
                    {"fields": {name: self.hdf5(file[column[k]], file, depth + 1) for name, column in columns.items()}}
                    for k in range(count)
                ]
            return {"fields": {name: self.hdf5(part, file, depth + 1) for name, part in parts.items()}}
        if not isinstance(node, h5py.Dataset) or not data_inside(node):
            return None
        kind = node.attrs.get("MATLAB_class", b"")
        if "MATLAB_empty" in node.attrs:
            return "" if kind == b"char" else self._array(np.zeros(0))
        if node.dtype == h5py.ref_dtype:
            return [self.hdf5(file[one], file, depth + 1) for one in node[()].ravel()]
        values = np.asarray(node[()]).T
        if kind == b"char":
            return "".join(map(chr, values.ravel("F"))) if values.dtype.kind == "u" else None
        if values.dtype.names == ("real", "imag"):
            values = values["real"] + 1j * values["imag"]
        return self._array(values.squeeze()) if values.dtype.kind in "biufc" else None

    def _hdf5_sparse(self, group: h5py.Group) -> dict[str, Any]:
        rows, ends = int(group.attrs["MATLAB_sparse"]), np.asarray(group["jc"][()]).astype(np.int64)
        data, places = (np.asarray(group[n][()]) if n in group else np.zeros(0) for n in ("data", "ir"))
        return self._sparse(sp.csc_array((data.astype(float), places.astype(np.int64), ends), (rows, len(ends) - 1)))


def _is_list(part: Any) -> bool:
    """Whether a field of a structure holds one reference for each structure of an array, and is no cell."""
    return isinstance(part, h5py.Dataset) and part.dtype == h5py.ref_dtype and "MATLAB_class" not in part.attrs
