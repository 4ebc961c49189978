"""The journal: every frame on its way to the disk as it arrives, so that a crash costs next to nothing.

A file of records behind one another, each written at once by one call: marker, size, running number,
stream, flags, time of arrival, payload, CRC-32. The sum covers a random number of the file too, so that no
record of another journal passes. What is cut off or overwritten later is skipped by looking for the next
marker; nothing is believed that does not fit its sum, and numbers must rise.

A killed program loses what it had not yet written: the frame in work, and those that came with it in one read; a
power cut loses at most the last `SYNC` seconds and what the disk takes to sync.
"""

import contextlib
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from calib.session.storage import sync

try:
    import fcntl
except ImportError:  # Windows: nothing tells a journal that is still being written
    fcntl = None  # type: ignore[assignment]

SYNC = 0.1
MAX_PAYLOAD = 1 << 20
_MAGIC = b"jaxeitJ1"
_MARKER = b"\xf7jx\xfa"
_HEAD = struct.Struct("<4sIIHHq")  # marker, size of payload, number, stream, flags, host ns
_SUM = struct.Struct("<I")
_OPENING = struct.Struct("<8s8sI")
_PIECE = 4 << 20
_LARGEST = _HEAD.size + MAX_PAYLOAD + _SUM.size


class JournalError(ValueError):
    """A journal that cannot be written or read; what to do is said."""


class Record(NamedTuple):
    """One entry: ``number`` counts all of them, ``host`` is ns of the clock that is never set."""

    number: int
    stream: int
    flags: int
    host: int
    payload: bytes


def _sum(salt: bytes, head: bytes, payload: bytes | memoryview) -> int:
    return zlib.crc32(payload, zlib.crc32(head, zlib.crc32(salt)))


class Journal:
    """A new journal, to which several threads may append; use it as a context manager, or close it.

    Raises:
        JournalError: if the file exists (an earlier recording waits in it) or cannot be written; after
            a failed write by every further call, with what was written before still whole.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self._salt = os.urandom(8)
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._number, self._end, self._synced = 0, 0, 0
        self._failure: OSError | None = None
        self._file = self._create()
        self._write(_OPENING.pack(_MAGIC, self._salt, zlib.crc32(_MAGIC + self._salt)))
        self._syncing = threading.Thread(target=self._keep_synced, name="journal", daemon=True)
        self._syncing.start()

    def _create(self) -> int:
        try:
            file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o666)
        except FileExistsError:
            todo = f"finish it first: jaxeit recover {self.path}"
            raise JournalError(f"{self.path.name}: holds an unfinished recording; {todo}") from None
        except OSError as error:
            raise self._problem(error) from error
        if fcntl is not None:
            with contextlib.suppress(OSError):  # some file systems know no locks
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with contextlib.suppress(OSError):  # its name too; some systems cannot sync a folder
            sync(self.path.parent)
        return file

    def _problem(self, error: OSError) -> JournalError:
        why = error.strerror or type(error).__name__
        todo = "free space or choose another folder; what was written before is kept"
        return JournalError(f"{self.path.name}: cannot be written ({why}); {todo}")

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._end

    def append(self, stream: int, flags: int, host: int, payload: bytes) -> None:
        """Write one record: ``stream`` and ``flags`` 0..65535, ``host`` ns, at most 1 MiB of ``payload``."""
        if len(payload) > MAX_PAYLOAD:
            raise JournalError(f"{self.path.name}: a record of {len(payload):,} bytes; keep below {MAX_PAYLOAD:,}")
        with self._lock:
            head = _HEAD.pack(_MARKER, len(payload), self._number, stream, flags, host)
            self._write(head + payload + _SUM.pack(_sum(self._salt, head, payload)))
            self._number += 1

    def _write(self, data: bytes) -> None:
        if self._failure is not None:
            raise self._problem(self._failure)
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._file, view) :]
        except OSError as error:
            self._failure = error
            with contextlib.suppress(OSError):  # not half a record
                os.ftruncate(self._file, self._end)
            raise self._problem(error) from error
        self._end += len(data)

    def _keep_synced(self) -> None:
        while not self._stop.wait(SYNC):
            self.sync()

    def sync(self) -> None:
        """Bring what was written to the disk; a failure is told by the next `append`."""
        end = self._end
        if end == self._synced or self._failure is not None:
            return
        try:
            getattr(os, "fdatasync", os.fsync)(self._file)
            self._synced = end
        except OSError as error:
            self._failure = error

    def close(self) -> None:
        """Sync and close; no error if writing has failed already."""
        if self._file < 0:
            return
        self._stop.set()
        self._syncing.join()
        self.sync()
        os.close(self._file)
        self._file = -1

    def __enter__(self) -> "Journal":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class Scan:
    """The records of a journal, in order, read in bounded memory: iterate over it, as often as needed.

    After an iteration ``records`` counts them, ``lost`` those whose numbers are missing, ``damaged`` the
    bytes between them that fit no record, ``torn`` those after the last one.

    Raises:
        JournalError: if the file is no journal, or is still being written.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self.records = self.lost = self.damaged = self.torn = 0
        with self._opened() as file:
            self._salt = self._read_opening(file)

    def _opened(self):
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise JournalError(f"{self.path.name}: {error.strerror}; name a .part file") from error
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                file.close()
                raise JournalError(f"{self.path.name}: is still being recorded; stop that first") from None
            except OSError:  # a file system without locks
                pass
        return file

    def _read_opening(self, file) -> bytes:
        found = file.read(_OPENING.size)
        if len(found) == _OPENING.size:
            magic, salt, total = _OPENING.unpack(found)
            if magic == _MAGIC and total == zlib.crc32(found[:16]):
                return salt
        what = "does not begin as a recording" if found else "is empty: nothing had been recorded"
        raise JournalError(f"{self.path.name}: {what}; name the .part file that jaxeit record left")

    def __iter__(self) -> Iterator[Record]:
        self.records = self.lost = self.damaged = self.torn = 0
        last, skipped = -1, 0
        with self._opened() as file:
            file.seek(_OPENING.size)
            for item in _pieces(file, self._salt):
                if isinstance(item, int):
                    skipped += item
                    continue
                if item.number <= last:  # a stale copy
                    continue
                self.lost += item.number - last - 1
                self.damaged, skipped = self.damaged + skipped, 0
                self.records, last = self.records + 1, item.number
                yield item
        self.torn = skipped


def _pieces(file, salt: bytes) -> Iterator[Record | int]:
    """Records, and numbers of bytes that are none."""
    buffer, at, ended = bytearray(), 0, False
    while not ended or at < len(buffer):
        if not ended and len(buffer) - at < _LARGEST:
            del buffer[:at]
            at = 0
            piece = file.read(_PIECE)
            buffer += piece
            ended = not piece
            continue
        record = _parse(buffer, at, salt)
        if record is not None:
            at += _HEAD.size + len(record.payload) + _SUM.size
            yield record
            continue
        # the marker itself may straddle what was read: keep its beginning
        found = buffer.find(_MARKER, at + 1)
        stop = found if found >= 0 else len(buffer) if ended else max(len(buffer) - len(_MARKER) + 1, at + 1)
        yield stop - at
        at = stop


def _parse(buffer: bytearray, at: int, salt: bytes) -> Record | None:
    """The record that begins at `at`, or None."""
    start = at + _HEAD.size
    if start + _SUM.size > len(buffer):
        return None
    marker, size, number, stream, flags, host = _HEAD.unpack_from(buffer, at)
    stop = start + size
    if marker != _MARKER or size > MAX_PAYLOAD or stop + _SUM.size > len(buffer):
        return None
    payload = bytes(memoryview(buffer)[start:stop])
    if _SUM.unpack_from(buffer, stop)[0] != _sum(salt, bytes(memoryview(buffer)[at:start]), payload):
        return None
    return Record(number, stream, flags, host, payload)
