"""Write HDF5 files; all session and result files are written by these functions.

Format bounds are v110 (checksums on metadata). Every dataset has chunks of about 256 kB with gzip 1, shuffle and
fletcher32; a long array that gzip would hardly shorten has only the checksum. Texts are fixed-length UTF-8. There are
no time stamps, so that equal input gives equal bytes. Dimension scales let netCDF4, h5netcdf and xarray open the file.
A file appears under its name only when it is whole.
"""

import abc
import contextlib
import errno
import functools
import hashlib
import io
import os
import re
import shutil
import stat
import tempfile
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import h5py
import numpy as np
from h5py import h5d, h5f, h5fd, h5g, h5p, h5s, h5t

from jaxeit.files import open_regular

from ..errors import SessionError, printable, problem
from ..tables import SESSION_FORMAT
from .guard import MAX_ATTRIBUTE_BYTES

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

CHUNK_BYTES = 256 << 10
PACKED_UNTRIED, TRIED_BYTES = 512 << 10, 32 << 10  # sizes of arrays that are packed untried, and of the part tried
DIMENSION_NAME = "This is a netCDF dimension but not a netCDF variable. %9d"
"""Name that netCDF-4 gives to a dimension scale without values."""

AttributeValue = str | bool | int | float | Sequence[str]


def file_hash(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file as hexadecimal digits. The file is read in bounded pieces."""
    digest = hashlib.sha256()
    with open_regular(path) as stream:
        while piece := stream.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


@contextlib.contextmanager
def folder_beside(output: Path) -> Iterator[Path]:
    """A temporary folder beside an output, so that what is complete in it can be renamed to the output.

    It is closed to other users, and removed in the end.
    """
    output.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{output.name}.", suffix=".tmp", dir=output.parent))
    try:
        with disk_full_named(output):
            yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


IMPORT = "import"
"""Last word of the creator of an imported session."""


def require_no_session(path: Path, *, simulated_too: bool = True, imported_too: bool = True) -> None:
    """Refuse a path at which a session lies: a recording cannot be made again, so that no other file replaces it.

    Args:
        simulated_too: whether simulated sessions are refused too.
        imported_too: whether imported sessions are refused too.

    Raises:
        SessionError: naming the file.
    """
    if not path.is_file():
        return
    with contextlib.suppress(OSError), h5py.File(path) as file:  # of another kind, it is no session
        kind, simulated, creator = (file.attrs.get(name) for name in ("format", "simulated", "creator"))
        if not isinstance(kind, str | bytes) or kind not in (SESSION_FORMAT, SESSION_FORMAT.encode()):
            return
        creator = creator.decode(errors="replace") if isinstance(creator, bytes) else creator
        imported = isinstance(creator, str) and creator.endswith(f" {IMPORT}")
        if (simulated_too or not np.any(simulated)) and (imported_too or not imported):
            what = "session" if simulated_too else "recording"
            raise problem(path, "file", f"holds a {what}, which would be lost", "give another name")


def require_no_input(path: Path, inputs: Iterable[Path]) -> None:
    """Refuse an output that is also one of the inputs.

    Raises:
        SessionError: naming the file.
    """
    for other in inputs:
        if path.exists() and other.exists() and path.samefile(other):
            raise problem(path, "file", "is also an input, which would be lost", "give another name")


@contextlib.contextmanager
def replacing(path: Path, *, session: bool = False) -> Iterator[Path]:
    """Yield an empty temporary file beside `path`. It is synced and renamed to `path`, or removed on failure.

    Only another session, ``session``, takes the place of a session.

    A process that is killed leaves its temporary file; the next one that writes to `path` removes it. A lock on the
    temporary file, which ends with its process, tells whether the process still runs.

    Example:
        from pathlib import Path

        from calib.session import replacing, require_no_session

        require_no_session(Path("loads.csv"))
        with replacing(Path("loads.csv")) as unfinished:  # whole or not at all
            unfinished.write_text("time,force\\n0,1\\n")
    """
    if not path.parent.is_dir():
        raise problem(path, "file", f"the folder {path.parent} does not exist", "create the folder first")
    if path.is_dir():
        raise problem(path, "file", "is a folder", "give a file name")
    if path.exists() and not path.is_file():
        raise problem(path, "file", "is a device or a pipe", "give a file name")
    if not session:
        require_no_session(path)
    _remove_abandoned(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.tmp")
    descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        _lock(descriptor)
        with disk_full_named(path):
            yield temporary
            sync(temporary)
        os.replace(temporary, path)
        with contextlib.suppress(OSError):  # some systems cannot sync a folder
            sync(path.parent)
    finally:
        temporary.unlink(missing_ok=True)
        os.close(descriptor)


def _remove_abandoned(path: Path) -> None:
    """Remove temporary files of `path` whose processes have ended."""
    own = re.compile(rf"\.{re.escape(path.name)}\.[0-9a-f]{{12}}\.tmp")
    with contextlib.suppress(OSError):  # a folder that may not be listed, or another process removes them too
        for name in filter(own.fullmatch, os.listdir(path.parent)):
            left = path.with_name(name)
            if not stat.S_ISREG(left.lstat().st_mode):
                continue
            descriptor = os.open(left, os.O_RDWR)
            try:
                if _lock(descriptor):
                    left.unlink()
            finally:
                os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Lock an open file for this process; False if another one holds the lock, or the system has no locks."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def sync(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk; raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a failed write (disk full, no permission) into one `SessionError`."""
    try:
        yield
    except DiskFullError:  # it names the output already
        raise
    except OSError as error:
        what = f"cannot be written ({error.strerror or printable(error, 120)})"
        raise problem(path, "file", what, FREE_SPACE) from error


class DiskFullError(SessionError, OSError):
    """A disk is full: an `OSError`, as the system raises it, with the output and the remedy in its message."""


FREE_SPACE = "free space on the disk, or write to another folder"
_FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
_NUMBER_IN_TEXT = re.compile(r"\[errno (\d+)\]", re.IGNORECASE)


def disk_full(error: OSError) -> str:
    """What the system says of a disk that is full, or of a file that is too large for it; empty for other errors."""
    said = _NUMBER_IN_TEXT.search(str(error))  # Arrow states the number in its text alone
    number = error.errno or (int(said[1]) if said else 0)
    return os.strerror(number) if number in _FULL else ""


@contextlib.contextmanager
def disk_full_named(path: Path) -> Iterator[None]:
    """Turn the error of a full disk into one `DiskFullError` that names the output; other errors pass."""
    try:
        yield
    except OSError as error:
        if why := disk_full(error):
            raise DiskFullError(str(problem(path, "file", f"cannot be written ({why})", FREE_SPACE))) from error
        raise


class _FailureTolerantFile(io.RawIOBase):
    """File object for the HDF5 library that hides failed writes from it.

    The library crashes at the end of the process if a write has failed. This object therefore keeps the first
    failure in `error` and the data that could not be written in memory; the writer raises the failure by `check`.
    """

    def __init__(self, raw: io.FileIO):
        self._raw, self._size = raw, 0
        self._lost: list[tuple[int, bytes]] = []
        self._at = 0
        self.error: tuple[int, str] | None = None

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to `offset`. The end of the file includes data that could not be written."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        self._at = base + offset
        return self._at

    def tell(self) -> int:
        """Position of the next read or write."""
        return self._at

    def write(self, data: Any) -> int:
        """Write all of `data`, or keep it in memory together with the failure."""
        view = memoryview(data).cast("B")
        if self.error is None:
            try:
                self._write_all(view)
            except OSError as error:
                self._note(error)
        if self.error is not None:
            self._lost.append((self._at, bytes(view)))
        self._at += len(view)
        self._size = max(self._size, self._at)
        return len(view)

    def _note(self, error: OSError) -> None:
        # The exception itself would keep library handles alive, in a cycle with its traceback.
        self.error = (error.errno or 0, error.strerror or "write failed")

    def check(self) -> None:
        """Raise OSError if a write has failed."""
        if self.error is not None:
            raise OSError(*self.error)

    def _write_all(self, view: memoryview) -> None:
        self._raw.seek(self._at)
        done = 0
        while done < len(view):
            done += self._raw.write(view[done:]) or 0

    def readinto(self, buffer: Any) -> int:
        """Read from the file, and from the data that could not be written to it."""
        view = memoryview(buffer).cast("B")
        self._raw.seek(self._at)
        found = self._raw.read(len(view))
        view[:] = found + bytes(len(view) - len(found))
        for start, data in self._lost:
            low, high = max(start, self._at), min(start + len(data), self._at + len(view))
            if low < high:
                view[low - self._at : high - self._at] = data[low - start : high - start]
        self._at += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file, unless a write has failed already."""
        self._size = self._at if size is None else size
        if self.error is None:
            try:
                self._raw.truncate(self._size)
            except OSError as error:
                self._note(error)
        return self._size


def _create(path: Path, sink: _FailureTolerantFile) -> h5py.File:
    """Create an HDF5 file on `sink`, with format bounds v110 and without time stamps."""
    access = h5p.create(h5p.FILE_ACCESS)
    access.set_libver_bounds(h5f.LIBVER_V110, h5f.LIBVER_V110)
    access.set_fclose_degree(h5f.CLOSE_STRONG)
    access.set_fileobj_driver(h5fd.fileobj_driver, sink)
    creation = h5p.create(h5p.FILE_CREATE)
    creation.set_obj_track_times(False)
    return h5py.File(h5f.create(os.fsencode(path), h5f.ACC_TRUNC, creation, access))


def _checked(path: Path, sink: _FailureTolerantFile) -> None:
    with writing(path):
        sink.check()


@contextlib.contextmanager
def new_file(path: Path, *, session: bool = False) -> Iterator[tuple[h5py.File, Callable[[], None]]]:
    """Create an HDF5 file that appears as `path` after a successful end, and not at all after an error.

    Yields the file, and a function that raises `SessionError` if a write has failed. Raises `SessionError` if the
    folder or the disk does not allow the file, or if a session lies there and this is none.
    """
    with writing(path), replacing(path, session=session) as temporary, open(temporary, "rb+", buffering=0) as raw:
        sink = _FailureTolerantFile(raw)
        with _create(path, sink) as file:
            yield file, functools.partial(_checked, path, sink)
        sink.check()


class FileWriter(abc.ABC):
    """Base of writers that are context managers: the file appears only after a successful end."""

    session: ClassVar[bool] = False

    def __init__(self, path: Path):
        self.path = path
        self._stack = contextlib.ExitStack()
        self._file: h5py.File | None = None

    @abc.abstractmethod
    def _start(self, file: h5py.File) -> None:
        """Write what is known at the beginning."""

    @abc.abstractmethod
    def _finish(self, file: h5py.File) -> None:
        """Write what is known only at the end."""

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            self._file, self._check_disk = stack.enter_context(new_file(self.path, session=self.session))
            self._start(self._file)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        with self._stack:
            if error[1] is not None:
                self._stack.__exit__(*error)
            else:
                self._finish(self._open())
        self._file = None

    def _open(self) -> h5py.File:
        if self._file is None:
            use = f"use it as `with {type(self).__name__}(...) as w`"
            raise problem(self.path, "writer", "is not open", use)
        return self._file


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
