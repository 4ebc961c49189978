"""Create HDF5 files that appear under their names only when they are whole, also where the disk fails.

Format bounds are v110 (checksums on metadata), and there are no time stamps, so that equal input gives equal bytes.
"""

import abc
import contextlib
import functools
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, Self

import h5py
from h5py import h5f, h5fd, h5p

from ..errors import problem
from ..outputs import replacing, writing


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
