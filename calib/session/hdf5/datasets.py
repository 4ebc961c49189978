"""Write groups, attributes and datasets; those of all session and result files are written by these functions.

Every dataset has chunks of about 256 kB with gzip 1, shuffle and fletcher32; a long array that gzip would hardly
shorten has only the checksum. Texts are fixed-length UTF-8. There are no time stamps, so that equal input gives equal
bytes. Dimension scales let netCDF4, h5netcdf and xarray open the file.
"""

import zlib
from collections.abc import Mapping, Sequence

import h5py
import numpy as np
from h5py import h5d, h5g, h5p, h5s, h5t

from ..errors import problem
from .guard import MAX_ATTRIBUTE_BYTES

CHUNK_BYTES = 256 << 10
PACKED_UNTRIED, TRIED_BYTES = 512 << 10, 32 << 10  # sizes of arrays that are packed untried, and of the part tried
DIMENSION_NAME = "This is a netCDF dimension but not a netCDF variable. %9d"
"""Name that netCDF-4 gives to a dimension scale without values."""

AttributeValue = str | bool | int | float | Sequence[str]


def make_group(parent: h5py.Group, name: str, attrs: Mapping[str, AttributeValue]) -> h5py.Group:
    """Create a group with attributes and without time stamps."""
    creation = h5p.create(h5p.GROUP_CREATE)
    creation.set_obj_track_times(False)
    group = h5py.Group(h5g.create(parent.id, name.encode(), None, creation))
    put_attributes(group, attrs)
    return group


def put_attributes(obj: h5py.Group | h5py.Dataset, attrs: Mapping[str, AttributeValue]) -> None:
    """Write attributes as fixed-length UTF-8, u1 (bool), i8, f8, or a list of texts."""
    for name, value in attrs.items():
        if isinstance(value, str | list | tuple):
            _put_text(obj, name, value)
        elif isinstance(value, bool | np.bool_):
            obj.attrs.create(name, int(value), dtype="u1")
        elif isinstance(value, int | np.integer):
            obj.attrs.create(name, int(value), dtype="i8")
        elif isinstance(value, float | np.floating):
            obj.attrs.create(name, float(value), dtype="f8")
        else:
            kind = type(value).__name__
            raise problem(obj.file.filename, name, f"is a {kind}", "give a text or a number")


def _put_text(obj: h5py.Group | h5py.Dataset, name: str, value: str | Sequence[str]) -> None:
    texts = [value] if isinstance(value, str) else list(value)
    raw = [text.encode() for text in texts]
    size = max(1, *(len(r) for r in raw)) if raw else 1
    if size * len(raw) > MAX_ATTRIBUTE_BYTES or any(b"\0" in r for r in raw):
        limit = f"at most {MAX_ATTRIBUTE_BYTES:,} bytes, none of them zero"
        raise problem(obj.file.filename, name, "is a text that cannot be stored", f"use {limit}")
    kind = h5py.string_dtype("utf-8", size)
    data = raw[0] if isinstance(value, str) else raw
    obj.attrs.create(name, np.array(data, kind), dtype=kind)


def chunk_shape(shape: Sequence[int], itemsize: int) -> tuple[int, ...]:
    """Shape of chunks of at most about 256 kB; the first axes are split first."""
    chunk = [max(1, n) for n in shape]
    for axis in range(len(chunk)):
        rest = int(np.prod(chunk[axis + 1 :], dtype=np.int64)) * itemsize
        chunk[axis] = min(chunk[axis], max(1, CHUNK_BYTES // rest))
        if rest <= CHUNK_BYTES:
            break
    return tuple(chunk)


def _creation(chunk: tuple[int, ...] | None, itemsize: int, packed: bool) -> h5p.PropDCID:
    """Creation properties without time stamps: chunks with filters, or compact storage for a scalar."""
    plist = h5p.create(h5p.DATASET_CREATE)
    plist.set_obj_track_times(False)
    if chunk is None:
        plist.set_layout(h5d.COMPACT)  # stored in the object header, which has a checksum
        return plist
    plist.set_chunk(chunk)
    if packed and itemsize > 1:
        plist.set_shuffle()
    if packed:
        plist.set_deflate(1)
    plist.set_fletcher32()
    return plist


def _packs(values: np.ndarray) -> bool:
    """Whether gzip shortens an array by a fifth; short arrays are not tried."""
    if values.nbytes < PACKED_UNTRIED:
        return True
    middle = values.size // 2
    tried = values.reshape(-1)[middle : middle + TRIED_BYTES // values.itemsize].view(np.uint8)
    shuffled = tried.reshape(-1, values.itemsize).T.tobytes()
    return len(zlib.compress(shuffled, 1)) < 0.8 * len(shuffled)


def _file_type(dtype: np.dtype) -> h5t.TypeID:
    """HDF5 type: little-endian numbers, or fixed-length UTF-8."""
    if dtype.kind == "S":
        return h5t.py_create(h5py.string_dtype("utf-8", dtype.itemsize), logical=True)
    return h5t.py_create(dtype.newbyteorder("<"))


def make_dataset(
    parent: h5py.Group,
    name: str,
    shape: tuple[int, ...],
    dtype: np.dtype,
    *,
    growing: bool = False,
    packed: bool = True,
) -> h5py.Dataset:
    """Create a dataset; with `growing`, its first axis can be extended later; `packed` with gzip."""
    dtype = np.dtype(dtype)
    maximum = (h5s.UNLIMITED, *shape[1:]) if growing else shape
    space = h5s.create_simple(shape, maximum) if shape else h5s.create(h5s.SCALAR)
    plist = _creation(chunk_shape(shape, dtype.itemsize) if shape else None, dtype.itemsize, packed)
    kind = _file_type(dtype)
    return h5py.Dataset(h5d.create(parent.id, name.encode(), kind, space, plist))


def make_array(parent: h5py.Group, name: str, values: np.ndarray, attrs: Mapping[str, AttributeValue]) -> h5py.Dataset:
    """Create a dataset that holds `values`."""
    values = np.ascontiguousarray(values).reshape(np.shape(values))
    dataset = make_dataset(parent, name, values.shape, values.dtype, packed=_packs(values))
    if values.size:
        dataset[...] = values.astype(dataset.dtype)  # the library takes the type S of texts in memory for ASCII
    put_attributes(dataset, attrs)
    return dataset


def make_index(parent: h5py.Group, name: str, size: int) -> h5py.Dataset:
    """Create the dimension scale `name` with the numbers 0..size-1."""
    index = make_array(parent, name, np.arange(size, dtype="i4"), {"units": "1"})
    index.make_scale(name)
    return index


def attach(dataset: h5py.Dataset, *scales: h5py.Dataset) -> None:
    """Attach dimension scales to the axes of `dataset`, in order."""
    for axis, scale in enumerate(scales):
        dataset.dims[axis].attach_scale(scale)


def text_array(texts: Sequence[str]) -> np.ndarray:
    """Texts as fixed-length UTF-8 bytes; the longest text determines the length."""
    raw = [text.encode() for text in texts]
    return np.array(raw, dtype=f"S{max([1, *map(len, raw)])}")


class GrowingArray:
    """Dataset to which rows are appended in whole chunks; at most one chunk is kept in memory."""

    def __init__(self, parent: h5py.Group, name: str, tail: tuple[int, ...], dtype: np.dtype):
        self._parent, self._name, self._tail = parent, name, tail
        self._dtype = np.dtype(dtype)
        row = self._dtype.itemsize * int(np.prod(tail, dtype=np.int64))
        self._chunk_rows = max(1, CHUNK_BYTES // max(1, row))
        self._waiting: list[np.ndarray] = []
        self._rows_waiting = 0
        self.rows = 0
        self.dataset: h5py.Dataset | None = None

    def append(self, rows: np.ndarray) -> None:
        """Append rows; the caller has checked their shape and range."""
        self._waiting.append(np.array(rows, self._dtype))
        self._rows_waiting += len(rows)
        self.rows += len(rows)
        if self._rows_waiting >= self._chunk_rows:
            self._write(self._rows_waiting - self._rows_waiting % self._chunk_rows)

    def finish(self, attrs: Mapping[str, AttributeValue]) -> h5py.Dataset:
        """Write the remaining rows and the attributes."""
        self._write(self._rows_waiting)
        assert self.dataset is not None
        put_attributes(self.dataset, attrs)
        return self.dataset

    def _write(self, count: int) -> None:
        block = np.concatenate([np.empty((0, *self._tail), self._dtype), *self._waiting])
        if self.dataset is None:
            # A first write of less than a chunk is also the last one: a small file gets small chunks.
            rows = count if count < self._chunk_rows else self._chunk_rows
            shape = (rows, *self._tail)
            self.dataset = make_dataset(self._parent, self._name, shape, self._dtype, growing=True)
            self.dataset.resize(0, axis=0)
        start = self.dataset.shape[0]
        self.dataset.resize(start + count, axis=0)
        if count:
            self.dataset[start:] = block[:count]
        self._waiting = [block[count:]]
        self._rows_waiting -= count
