"""The journal of a recording: every frame is written as it arrives, so that a crash loses very little.

The file is a sequence of records, each written by one call: marker, size, running number, stream, flags, time of
arrival, payload, CRC-32. The checksum also covers a random number of the file, so that a record of another journal is
rejected. The reader skips damaged parts by searching for the next marker. It accepts only records whose checksum holds
and whose numbers increase.

A killed program loses the frames that it had read but not written. A power cut loses at most the last `SYNC_INTERVAL`
seconds, and the time that the disk takes to sync.
"""

import contextlib
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from jaxeit.files import open_regular

from ...session.outputs import sync

try:
    import fcntl
except ImportError:  # Windows has no locks that mark a journal which is still being written
    fcntl = None  # type: ignore[assignment]

SYNC_INTERVAL = 0.1  # s
MAX_PAYLOAD = 1 << 20
MAGIC = b"jaxeitJ1"
MARKER = b"\xf7jx\xfa"
RECORD_HEAD = struct.Struct("<4sIIHHq")  # marker, size of payload, number, stream, flags, host ns
CHECKSUM = struct.Struct("<I")
FILE_HEAD = struct.Struct("<8s8sI")
READ_BYTES = 4 << 20
MAX_RECORD_BYTES = RECORD_HEAD.size + MAX_PAYLOAD + CHECKSUM.size


class JournalError(ValueError):
    """A journal cannot be written or read."""


class Record(NamedTuple):
    """One record: ``number`` counts all records, ``host`` is the time of arrival, ns of the monotonic clock."""

    number: int
    stream: int
    flags: int
    host: int
    payload: bytes


def _checksum(salt: bytes, head: bytes, payload: bytes | memoryview) -> int:
    return zlib.crc32(payload, zlib.crc32(head, zlib.crc32(salt)))


def _is_locked(file: BinaryIO) -> bool:
    """Whether the journal is still being written. If not, it is locked against that while the file is open."""
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:  # the file system has no locks
            pass
    return False


class Journal:
    """A new journal, to which several threads may append; use it as a context manager, or close it.

    Raises:
        JournalError: if the file exists, because it holds an unfinished recording, or cannot be written. After a
            failed write every further call raises; the records before it stay intact.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self._salt = os.urandom(8)
        self._lock, self._stop = threading.Lock(), threading.Event()
        self._number, self._end, self._synced = 0, 0, 0
        self._failure: OSError | None = None
        self._file = self._create()
        self._write(FILE_HEAD.pack(MAGIC, self._salt, zlib.crc32(MAGIC + self._salt)))
        self._syncing = threading.Thread(target=self._sync_repeatedly, name="journal", daemon=True)
        self._syncing.start()

    def _create(self) -> int:
        try:
            file = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o666)
        except FileExistsError:
            raise JournalError(f"{self.path.name}: {self._occupant()}") from None
        except OSError as error:
            raise self._problem(error) from error
        if fcntl is not None:
            with contextlib.suppress(OSError):  # some file systems have no locks
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with contextlib.suppress(OSError):  # sync the name of the file too; some systems cannot sync a folder
            sync(self.path.parent)
        return file

    def _occupant(self) -> str:
        """What lies at the path, and what to do about it."""
        with contextlib.suppress(OSError), open_regular(self.path) as file:
            if _is_locked(file):
                return "is still being recorded; give another name, or stop that recording first"
        return f"holds an unfinished recording; finish it first: jaxeit recover {self.path}"

    def _problem(self, error: OSError) -> JournalError:
        why = error.strerror or type(error).__name__
        todo = "free space or choose another folder; what was written before is kept"
        return JournalError(f"{self.path.name}: cannot be written ({why}); {todo}")

    @property
    def size(self) -> int:
        """Number of bytes written."""
        return self._end

    def append(self, stream: int, flags: int, host: int, payload: bytes) -> None:
        """Write one record: ``stream`` and ``flags`` 0..65535, ``host`` ns, at most 1 MiB of ``payload``."""
        if len(payload) > MAX_PAYLOAD:
            raise JournalError(f"{self.path.name}: a record of {len(payload):,} bytes; keep below {MAX_PAYLOAD:,}")
        with self._lock:
            head = RECORD_HEAD.pack(MARKER, len(payload), self._number, stream, flags, host)
            self._write(head + payload + CHECKSUM.pack(_checksum(self._salt, head, payload)))
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
            with contextlib.suppress(OSError):  # remove the incomplete record
                os.ftruncate(self._file, self._end)
            raise self._problem(error) from error
        self._end += len(data)

    def _sync_repeatedly(self) -> None:
        while not self._stop.wait(SYNC_INTERVAL):
            self.sync()

    def sync(self) -> None:
        """Flush written records to the disk. The next `append` raises if this fails."""
        end = self._end
        if end == self._synced or self._failure is not None:
            return
        try:
            getattr(os, "fdatasync", os.fsync)(self._file)
            self._synced = end
        except OSError as error:
            self._failure = error

    def close(self) -> None:
        """Sync and close; does not raise if a write has failed already."""
        if self._file < 0:
            return
        self._stop.set()
        self._syncing.join()
        self.sync()
        os.close(self._file)
        self._file = -1

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class JournalReader:
    """Reads the records of a journal in order and in bounded memory; it can be iterated over repeatedly.

    After an iteration these attributes hold:

    | attribute | meaning                                             |
    |-----------|-----------------------------------------------------|
    | records   | number of records                                   |
    | lost      | number of records that are missing between them     |
    | damaged   | bytes between records that belong to none           |
    | torn      | bytes after the last record                         |

    Raises:
        JournalError: if the file is no journal, or is still being written.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self.records = self.lost = self.damaged = self.torn = 0
        with self._open() as file:
            self._salt = self._read_head(file)

    def _open(self) -> BinaryIO:
        try:
            file = open_regular(self.path)
        except OSError as error:
            raise JournalError(f"{self.path.name}: {error.strerror}; name a .part file") from error
        if _is_locked(file):
            file.close()
            raise JournalError(f"{self.path.name}: is still being recorded; stop the recording first")
        return file

    def _read_head(self, file: BinaryIO) -> bytes:
        found = file.read(FILE_HEAD.size)
        if len(found) == FILE_HEAD.size:
            magic, salt, total = FILE_HEAD.unpack(found)
            if magic == MAGIC and total == zlib.crc32(found[:16]):
                return bytes(salt)
        what = "does not begin like a recording" if found else "is empty: nothing was recorded"
        raise JournalError(f"{self.path.name}: {what}; name the .part file that jaxeit record left")

    def __iter__(self) -> Iterator[Record]:
        self.records = self.lost = self.damaged = self.torn = 0
        last, skipped = -1, 0
        with self._open() as file:
            file.seek(FILE_HEAD.size)
            for item in _records_and_gaps(file, self._salt):
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


def _records_and_gaps(file: BinaryIO, salt: bytes) -> Iterator[Record | int]:
    """Records, and between them the numbers of bytes that belong to none."""
    buffer, at, ended = bytearray(), 0, False
    while not ended or at < len(buffer):
        if not ended and len(buffer) - at < MAX_RECORD_BYTES:
            del buffer[:at]
            at = 0
            piece = file.read(READ_BYTES)
            buffer += piece
            ended = not piece
            continue
        record = _parse(buffer, at, salt)
        if record is not None:
            at += RECORD_HEAD.size + len(record.payload) + CHECKSUM.size
            yield record
            continue
        # A marker may straddle two reads, so its possible beginning at the end of the buffer is kept.
        found = buffer.find(MARKER, at + 1)
        stop = found if found >= 0 else len(buffer) if ended else max(len(buffer) - len(MARKER) + 1, at + 1)
        yield stop - at
        at = stop


def _parse(buffer: bytearray, at: int, salt: bytes) -> Record | None:
    """The record that begins at position `at`, or None."""
    start = at + RECORD_HEAD.size
    if start + CHECKSUM.size > len(buffer):
        return None
    marker, size, number, stream, flags, host = RECORD_HEAD.unpack_from(buffer, at)
    stop = start + size
    if marker != MARKER or size > MAX_PAYLOAD or stop + CHECKSUM.size > len(buffer):
        return None
    payload = bytes(memoryview(buffer)[start:stop])
    if CHECKSUM.unpack_from(buffer, stop)[0] != _checksum(salt, bytes(memoryview(buffer)[at:start]), payload):
        return None
    return Record(number, stream, flags, host, payload)
