"""Result files (calibrations, force maps): named arrays with units, checked like session files.

An archive is an HDF5 file with ``format`` and ``format_version``, attributes that are single numbers or texts, and
arrays, possibly in groups (``pads/0/covariance``). An array larger than memory is written row by row with
`ArchiveWriter` and read in slices with `open_archive`.
"""

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import h5py
import numpy as np
from h5py import h5g
from numpy.typing import ArrayLike, DTypeLike

from jaxeit.budget import OR_RAISE, current_budget

from .errors import printable, problem
from .hdf5.chunks import MAX_RANK, GuardedArray
from .hdf5.datasets import (
    DIMENSION_NAME,
    AttributeValue,
    GrowingArray,
    attach,
    make_array,
    make_dataset,
    make_group,
    put_attributes,
    text_array,
)
from .hdf5.guard import Node, open_guarded, root_node, translated
from .hdf5.new_files import FileWriter
from .reader import check_version
from .tables import SESSION_FORMAT

ARCHIVE_VERSION = "1.0"
MAX_DEPTH = 4
MAX_ARRAYS = 4096
PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9_\-]{0,63}")
DIMENSION = re.compile(r"dim_\d+[a-d]?")
OWN_ATTRIBUTES = {"format", "format_version", "Conventions", "complete"}
Dims = tuple[str, ...]


@dataclass(frozen=True)
class Archive:
    """A result file in memory.

    ``attrs`` maps names to texts or numbers; ``arrays`` maps names to arrays of numbers, bools or texts (``U``).
    ``units`` and ``long_names`` describe the arrays under the same names.
    """

    attrs: Mapping[str, str | int | float]
    arrays: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    long_names: Mapping[str, str]


def write_archive(
    path: str | os.PathLike[str],
    format: str,
    attrs: Mapping[str, AttributeValue],
    arrays: Mapping[str, tuple[ArrayLike, str, str]],
    dims: Mapping[str, Dims] = MappingProxyType({}),
) -> None:
    """Write a result file, whole or not at all. Equal input gives equal bytes.

    ``arrays`` maps a name, which may be nested (``pads/0/covariance``), to (values, units, long name). Values are
    numbers, bools or texts of rank 0 to 4. ``dims`` names axes, as for `ArchiveWriter`.
    Raises `SessionError` for names, types and attributes that the format cannot hold.

    Example:
        from calib.session import open_archive, read_archive, write_archive

        arrays = {"force": (np.array([1.0, 2.0]), "N", "force on each pad")}
        write_archive("result.h5", "my-result", {"sensor": "left hand"}, arrays)
        again = read_archive("result.h5", "my-result")
        print(again.attrs["sensor"], again.arrays["force"], again.units["force"])
        with open_archive("result.h5", "my-result") as large:
            print(large.arrays["force"].read(0, 1))  # rows
    """
    with ArchiveWriter(path, format, attrs) as writer:
        for name, (values, units, long_name) in arrays.items():
            writer.add(name, values, units, long_name, dims.get(name, ()))


def read_archive(path: str | os.PathLike[str], format: str) -> Archive:
    """Read a whole result file of the given ``format``; raises `SessionError`.

    Files whose arrays are more bytes than the budget allows at once are refused: read them in slices with
    `open_archive`.
    """
    with open_archive(path, format) as reader:
        total = sum(array.nbytes for array in reader.arrays.values())
        if beyond := current_budget().excess("array_bytes", total):
            raise problem(reader.path, "file", beyond[0], f"read it in slices with open_archive, {OR_RAISE}")
        arrays = {name: array.read() for name, array in reader.arrays.items()}
        units = {name: array.units for name, array in reader.arrays.items()}
        long_names = {name: array.long_name for name, array in reader.arrays.items()}
        return Archive(
            reader.attrs,
            MappingProxyType(arrays),
            MappingProxyType(units),
            MappingProxyType(long_names),
        )


class ArchiveWriter(FileWriter):
    """Write a result file piece by piece; use it as a context manager.

    ``add`` writes a whole array. ``add_rows`` declares an array that ``append`` extends, so that it may be larger
    than memory. ``dims`` names the axes of an array after arrays of the file's root that were added before, its
    coordinates; an array with the name of its only axis is such a coordinate. Axes without names are numbered. The
    file appears under its name only after a successful end.

    Example:
        with calib.session.ArchiveWriter("long.h5", "my-result", {}) as writer:  # larger than memory
            writer.add_rows("force", (2,), "N", "force on each pad")
            for _ in range(10):
                writer.append("force", np.ones((1000, 2)))
    """

    def __init__(self, path: str | os.PathLike[str], format: str, attrs: Mapping[str, AttributeValue]):
        super().__init__(Path(path))
        clash = OWN_ATTRIBUTES & set(attrs)
        if clash or format == SESSION_FORMAT or not PART.fullmatch(format):
            what = f"format {format!r} or attributes {sorted(clash)} are reserved"
            raise problem(self.path, "attributes", what, "use other names")
        own = {"format": format, "format_version": ARCHIVE_VERSION, "Conventions": "CF-1.11"}
        self._attrs = {**own, **attrs}
        self._growing: dict[str, tuple[GrowingArray, tuple[int, ...], dict[str, AttributeValue]]] = {}
        self._dims: dict[str, Dims] = {}  # of each array

    def _start(self, file: h5py.File) -> None:
        put_attributes(file, self._attrs)

    def _finish(self, file: h5py.File) -> None:
        for name, (growing, _, attrs) in self._growing.items():
            self._name_axes(growing.finish(attrs), name)
        put_attributes(file, {"complete": True})

    def add(self, name: str, values: ArrayLike, units: str, long_name: str = "", dims: Dims = ()) -> None:
        """Write one array of numbers, bools or texts."""
        array, kind = _storable(self.path, name, np.asarray(values))
        group, leaf = self._place(name, dims)
        attrs = {"units": units, "long_name": long_name, **kind}
        dataset = make_array(group, leaf, array, attrs)
        self._name_axes(dataset, name)
        dataset.flush()  # else its place in the file depends on who else holds it, such as a profiler
        self._check_disk()

    def add_rows(
        self,
        name: str,
        tail: tuple[int, ...],
        units: str,
        long_name: str = "",
        dtype: DTypeLike = "f8",
        dims: Dims = (),
    ) -> None:
        """Declare an array of shape (rows, *tail) that ``append`` fills."""
        dtype = np.dtype(dtype)
        _storable(self.path, name, np.empty((0, *tail), dtype))
        if dtype.kind == "b":
            raise problem(self.path, name, "bool rows", "use dtype u1")
        group, leaf = self._place(name, dims)
        attrs: dict[str, AttributeValue] = {"units": units, "long_name": long_name}
        self._growing[name] = (GrowingArray(group, leaf, tail, dtype), tail, attrs)

    def append(self, name: str, rows: ArrayLike) -> None:
        """Add rows (n, *tail) to an array declared with ``add_rows``."""
        if name not in self._growing:
            raise problem(self.path, name, "was not declared", "call add_rows first")
        growing, tail, _ = self._growing[name]
        array = np.asarray(rows)
        if array.shape[1:] != tail or array.ndim != len(tail) + 1 or array.dtype.kind not in "biuf":
            raise problem(self.path, name, f"rows of shape {array.shape}", f"give (n, *{tail})")
        growing.append(array)
        self._check_disk()

    def _place(self, name: str, dims: Dims) -> tuple[h5py.Group, str]:
        """The group of an array, created if it does not exist, and the name of the array in it."""
        parts = name.split("/")
        bad = [p for p in parts if not PART.fullmatch(p) or DIMENSION.fullmatch(p)]
        taken = any(name == n or name.startswith(n + "/") or n.startswith(name + "/")
                    for n in self._dims)  # fmt: skip
        if bad or taken or len(parts) > MAX_DEPTH:
            raise problem(self.path, name, "cannot be used as a name", "use letters, digits, _ and -")
        if unknown := set(dims) - self._dims.keys() - {name}:
            raise problem(self.path, name, f"has axes {sorted(unknown)}", "add arrays of these names before")
        self._dims[name] = dims
        group = self._open()
        for part in parts[:-1]:
            group = group[part] if part in group else make_group(group, part, {})
        return group, parts[-1]

    def _name_axes(self, dataset: h5py.Dataset, name: str) -> None:
        """Attach a dimension to every axis; without names, axes of equal length in one array get different ones."""
        if dims := self._dims[name]:
            return self._attach(dataset, name, dims)
        seen: list[int] = []
        for axis, size in enumerate(dataset.shape):
            repeats = seen.count(size)
            seen.append(size)
            scale = self._dimension(f"dim_{size}" + ("" if not repeats else "abcd"[repeats]), size)
            dataset.dims[axis].attach_scale(scale)

    def _attach(self, dataset: h5py.Dataset, name: str, dims: Dims) -> None:
        if dims == (name,):
            dataset.make_scale(name)
        else:
            attach(dataset, *(self._open()[dim] for dim in dims))

    def _dimension(self, name: str, size: int) -> h5py.Dataset:
        """A dimension without values, in the form that netCDF-4 writes."""
        file = self._open()
        if name in file:
            return file[name]
        scale = make_dataset(file, name, (size,), np.dtype("i1"))
        scale.make_scale(DIMENSION_NAME % size)
        return scale


def _storable(path: Path, name: str, values: np.ndarray) -> tuple[np.ndarray, dict[str, AttributeValue]]:
    """Values in a type that the format has, and an attribute if that type replaces another one (u1 for bool)."""
    plain = values.dtype.kind == "U" or (values.dtype.kind in "biuf" and values.itemsize <= 8)
    if values.ndim > MAX_RANK or not plain:
        what = f"has type {values.dtype} and rank {values.ndim}"
        raise problem(path, name, what, f"give numbers or texts of rank 0 to {MAX_RANK}")
    if values.dtype.kind == "b":
        return values.astype("u1"), {"kind": "bool"}
    if values.dtype.kind == "U":
        return text_array(values.ravel().tolist()).reshape(values.shape), {}
    return values, {}


class ArchiveArray:
    """One array of an open archive: ``shape``, ``units`` and ``long_name``; ``read`` returns rows."""

    def __init__(self, node: Node):
        self._array = GuardedArray(node)
        self.shape, self.nbytes = self._array.shape, self._array.nbytes
        self.units, self.long_name = node.text("units", ""), node.text("long_name", "")
        self._bool = node.text("kind", "") == "bool"

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows ``start:stop``, all by default; texts have the NumPy kind ``U``."""
        values = self._array.read(start, stop)
        if values.dtype.kind == "S":
            with translated(self._array.node.path, self._array.node.where):
                return np.char.decode(values, "utf-8")
        return values.astype(bool) if self._bool else values


class ArchiveReader:
    """An open archive: ``attrs``, and ``arrays`` by name, which are read on request."""

    def __init__(self, path: Path, file: h5py.File, format: str):
        self.path, self._file = path, file
        root = root_node(file, path)
        _check_archive(root, format)
        self.attrs = MappingProxyType(root.plain_attributes())
        self.arrays = MappingProxyType({n: ArchiveArray(node) for n, node in [*_walk(root)]})

    def __enter__(self) -> "ArchiveReader":
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()


def open_archive(path: str | os.PathLike[str], format: str) -> ArchiveReader:
    """Open a result file for reading in slices; raises `SessionError`."""
    where = Path(path)
    file = open_guarded(where)
    try:
        return ArchiveReader(where, file, format)
    except BaseException:
        file.close()
        raise


def archive_format(path: str | os.PathLike[str]) -> str:
    """The format that a result file names, empty without one; raises `SessionError` if it cannot be opened."""
    where = Path(path)
    file = open_guarded(where)
    try:
        return root_node(file, where).text("format", "")
    finally:
        file.close()


def _check_archive(root: Node, format: str) -> None:
    found = root.text("format", "")
    if found != format:
        what = f"is {printable(found)!r}, not {format!r}" if found else "has no format"
        raise problem(root.path, "file", what, f"name a {format} file")
    check_version(root)
    if root.number("complete", 0) != 1:
        raise problem(root.path, "file", "is not complete", "create it again")


def _walk(root: Node) -> Iterator[tuple[str, Node]]:
    """All arrays with their names, within limits of depth and number."""
    waiting, found = [("", root, 0)], 0
    while waiting:
        prefix, node, depth = waiting.pop(0)
        for name in node.members():
            found += 1
            if found > MAX_ARRAYS or depth >= MAX_DEPTH:
                raise node.error("holds too many or too deeply nested arrays", "not a result file")
            member = node.child(name)
            if depth == 0 and DIMENSION.fullmatch(name):
                continue
            assert member is not None
            if isinstance(member.id, h5g.GroupID):
                waiting.append((f"{prefix}{name}/", member, depth + 1))
            else:
                yield prefix + name, member
