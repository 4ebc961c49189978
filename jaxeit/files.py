"""Files that may be anything: only regular files are read, since a pipe or a device may never end.

Arrays are read from a NumPy .npz with limits, and written whole or not at all.
"""

import errno
import io
import math
import os
import stat
import struct
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from .budget import require

DAMAGE = (
    *(ValueError, KeyError, TypeError, AttributeError, ArithmeticError),
    *(EOFError, RuntimeError, MemoryError, struct.error, zipfile.BadZipFile),  # RuntimeError: a password, a recursion
)

_KINDS = {
    stat.S_IFDIR: (errno.EISDIR, "is a folder"),
    stat.S_IFIFO: (errno.EINVAL, "is a pipe, not a regular file"),
    stat.S_IFSOCK: (errno.EINVAL, "is a socket, not a regular file"),
    stat.S_IFCHR: (errno.EINVAL, "is a device, not a regular file"),
    stat.S_IFBLK: (errno.EINVAL, "is a device, not a regular file"),
}


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file for reading, without waiting for the other end of a pipe.

    Raises:
        OSError: if the file cannot be opened or is of another kind; ``strerror`` says which.
    """
    _require_regular(os.stat(path).st_mode, path)  # before it is opened: to open a device can be an action
    # Another file may have taken the name since, so that the opened one is examined too.
    file = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _require_regular(os.fstat(file).st_mode, path)
        return os.fdopen(file, "rb")
    except BaseException:
        os.close(file)
        raise


def _require_regular(mode: int, path: str | os.PathLike[str]) -> None:
    if not stat.S_ISREG(mode):
        number, words = _KINDS.get(stat.S_IFMT(mode), (errno.EINVAL, "is not a regular file"))
        raise OSError(number, words, str(Path(path)))


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays as a NumPy .npz, whole or not at all; equal arrays give equal bytes."""
    path = Path(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, allow_pickle=False, **dict(arrays))
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def read_arrays(path: str | os.PathLike[str], error: type[ValueError], what: str, mend: str) -> dict[str, np.ndarray]:
    """The arrays of a .npz that `write_arrays` wrote; none is taken to be larger than the file that holds it.

    Args:
        error: type of what is raised.
        what, mend: what the file should be, and how it is made again, for messages.

    Raises:
        ValueError: of the type given, if the file cannot be read or is damaged.
    """
    name = Path(path).name
    try:
        return _read(path, error, mend)
    except error as known:
        raise error(f"{name}: {known}") from None
    except OSError as known:
        raise error(f"{name}: {known.strerror or f'is no {what}'}") from None
    except DAMAGE as known:
        why = " ".join(str(known).split())[:120]
        raise error(f"{name}: is damaged or no {what} ({why}); {mend}") from None


def _read(path: str | os.PathLike[str], error: type[ValueError], mend: str) -> dict[str, np.ndarray]:
    with open_regular(path) as raw, zipfile.ZipFile(raw) as file:
        for member in file.infolist():
            if member.compress_type != zipfile.ZIP_STORED:
                raise error(f"{member.filename[:80]!r} is compressed; {mend}")
        require("array_bytes", sum(member.file_size for member in file.infolist()), "numbers", error)
        return {m.filename.removesuffix(".npy"): _read_array(file, m, error) for m in file.infolist()}


def _read_array(file: zipfile.ZipFile, member: zipfile.ZipInfo, error: type[ValueError]) -> np.ndarray:
    """One member, read whole before its own claims are looked at."""
    stream = io.BytesIO(file.read(member))
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    if dtype.hasobject:
        raise error(f"{member.filename[:80]!r} holds Python objects, which could run any code; it is not read")
    if math.prod(shape) * dtype.itemsize != len(stream.getbuffer()) - stream.tell():
        raise error(f"{member.filename[:80]!r} claims another size than it has")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)
