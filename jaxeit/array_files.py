"""Arrays in NumPy .npz files: read with limits, and written whole or not at all."""

import io
import math
import os
import struct
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from .budget import require
from .files import open_regular

DAMAGE = (
    *(ValueError, KeyError, TypeError, AttributeError, ArithmeticError),
    *(EOFError, RuntimeError, MemoryError, struct.error, zipfile.BadZipFile),  # RuntimeError: a password, a recursion
)


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray], error: type[ValueError]) -> None:
    """Write arrays as a NumPy .npz, whole or not at all; equal arrays give equal bytes.

    Raises:
        ValueError: of the type given, if a file of another kind is there, which would be lost.
    """
    path = Path(path)
    if path.is_file() and path.stat().st_size and not zipfile.is_zipfile(path):
        raise error(f"{path.name}: holds something else than arrays, which would be lost; give another name")
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}.part")
    file = temporary.open("xb")
    try:
        with file:
            np.savez(file, allow_pickle=False, **dict(arrays))
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink()
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
