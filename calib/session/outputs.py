"""Output files of any format: each appears whole or not at all, and none replaces a recording or an input.

A disk that is full is one error, which names the output and the remedy.
"""

import contextlib
import errno
import hashlib
import os
import re
import shutil
import stat
import tempfile
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path

import h5py
import numpy as np

from jaxeit.files import open_regular

from .errors import SessionError, printable, problem
from .tables import SESSION_FORMAT

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


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
    remove_abandoned(path)
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


def remove_abandoned(path: Path) -> None:
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
