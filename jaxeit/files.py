"""Files that may be anything: only regular files are read, since a pipe or a device may never end."""

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO

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
