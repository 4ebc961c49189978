"""The lock beside a result: one process makes it at a time, and what an ended process left of it is removed."""

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ImportError:  # a system without it
    fcntl = None  # type: ignore[assignment]


def lock_of(calibration: str) -> Path:
    """The lock file of a calibration."""
    path = Path(calibration)
    return path.with_name(f".{path.name}.lock")


def remove_unfinished(calibration: str) -> None:
    """Remove what a worker that was killed left of a task, unless another batch does that task now."""
    if lock_of(calibration).exists():
        with contextlib.suppress(BlockingIOError), exclusive(calibration, wait=False):
            pass


@contextlib.contextmanager
def exclusive(calibration: str, *, wait: bool = True) -> Iterator[None]:
    """Hold the lock of a task while others wait, remove their unfinished files, and remove the lock file at the end.

    A worker that dies leaves the file, but not the lock.

    Raises:
        BlockingIOError: another process holds the lock, and it is not to be waited for.
    """
    lock = lock_of(calibration)
    file = _open_locked(lock, wait)
    try:
        own = re.compile(rf"\.{re.escape(Path(calibration).stem)}(\.h5|\.html|_[a-z]+\.png)\.[0-9a-f]+\.tmp")
        for name in filter(own.fullmatch, os.listdir(lock.parent)):
            lock.with_name(name).unlink(missing_ok=True)
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(file)


def _open_locked(path: Path, wait: bool) -> int:
    """Open and lock the lock file; the result is the file of that name, not one that its last owner has removed."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        if fcntl is None:
            return file
        try:
            fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            raise
        except OSError:  # some file systems have no locks
            pass
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file), os.stat(path)):
                return file
        os.close(file)
