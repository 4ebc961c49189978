"""ROS 2 bags in MCAP files, written by `rosbags`: whole or not at all. ROS itself is not needed."""

import os
import re
from binascii import crc32
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..session.errors import printable, problem
from ..session.importers.child import library
from ..session.importers.formats.mcap_checksums import write_summary_checksum
from ..session.outputs import folder_beside, sync
from .message_sink import AbstractMessageSink

EXTRA = "tables"
SUFFIX = ".mcap"
METADATA_VERSION = 8  # of rosbag2; the older of the two that `rosbags` writes
END_OF_TIME = 2**31 * 10**9  # ns; a stamp of ROS counts seconds in an int32
CHUNK_CRC = 9 + 24  # bytes from a record of a chunk to its checksum: opcode, length, two times, size
_TOKEN = r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*"
_TOPIC, _FRAME = re.compile(rf"(/{_TOKEN})+"), re.compile(rf"{_TOKEN}(/{_TOKEN})*")


class Bag(AbstractMessageSink):
    """A bag that is being written: `topic` declares a topic and `write` adds a message to it."""

    def __init__(self, writer: Any, rosbag2: Any, interfaces: Any, store: Any):
        self._writer, self._interfaces, self._store = writer, interfaces, store
        self._connections: dict[str, Any] = {}
        self.types = store.types
        self.counts: dict[str, int] = {}

    def topic(self, name: str, kind: str, *, latched: bool = False) -> str:
        profiles = [self._latched()] if latched else []
        connection = self._writer.add_connection(name, kind, typestore=self._store, offered_qos_profiles=profiles)
        self._connections[name], self.counts[name] = connection, 0
        return name

    def write(self, topic: str, time: int, message: Any) -> None:
        connection = self._connections[topic]
        self._writer.write(connection, time, self._store.serialize_cdr(message, connection.msgtype))
        self.counts[topic] += 1

    def kind(self, topic: str) -> str:
        """The type of the messages of a topic."""
        return str(self._connections[topic].msgtype)

    def _latched(self) -> Any:
        known = self._interfaces
        unset = known.QosTime(0, 0)
        return known.Qos(
            known.QosHistory.KEEP_LAST,
            1,
            known.QosReliability.RELIABLE,
            known.QosDurability.TRANSIENT_LOCAL,
            unset,
            unset,
            known.QosLiveliness.SYSTEM_DEFAULT,
            unset,
            False,
        )


@contextmanager
def writing_bag(output: Path) -> Iterator[Bag]:
    """A bag that appears under its name when it is complete: a folder of rosbag2, or one file for a name with `.mcap`.

    Raises:
        SessionError: if the output exists.
        ImportError: without `rosbags`.
    """
    rosbag2, typesys = library("rosbags.rosbag2", EXTRA), library("rosbags.typesys", EXTRA)
    interfaces = library("rosbags.interfaces", EXTRA)
    _require_free(output)
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with folder_beside(output) as temporary:
        folder = temporary / output.name.removesuffix(SUFFIX)  # its own name: the file in it is named after it
        plugin = rosbag2.StoragePlugin.MCAP
        writer = rosbag2.Writer(folder, version=METADATA_VERSION, storage_plugin=plugin)
        writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        with writer:
            _add_chunk_checksums(writer.storage)
            yield Bag(writer, rosbag2, interfaces, store)
        file = folder / f"{folder.name}{SUFFIX}"
        write_summary_checksum(file)
        for path in folder.iterdir():
            sync(path)
        _require_free(output)
        os.rename(file if output.suffix == SUFFIX else folder, output)


def _add_chunk_checksums(storage: Any) -> None:
    """Make an open storage of rosbags, which leaves out checksums, write that of each chunk of messages."""
    close = storage.close_chunk

    def close_chunk() -> None:
        start, checksum = storage.bio.tell(), crc32(storage.chunk.bio.getvalue())
        close()
        end = storage.bio.tell()
        storage.bio.seek(start + CHUNK_CRC)
        storage.bio.write(checksum.to_bytes(4, "little"))
        storage.bio.seek(end)

    storage.close_chunk = close_chunk


def _require_free(output: Path) -> None:
    if output.exists():
        raise problem(output, "output", "exists", "name another, or remove it first")
    if output.name in ("", "..", SUFFIX):
        raise problem(output, "output", "is no name for a bag", "name a folder, or a file that ends in .mcap")


def topic_prefix(text: str) -> str:
    """The prefix of topics, with a leading slash; ValueError for a name that ROS does not take."""
    prefix = "/" + text.strip("/")
    if not _TOPIC.fullmatch(prefix):
        raise ValueError(f"--prefix {printable(text)}: is no topic of ROS; give letters, digits and single _, as /skin")
    return prefix


def require_frame(text: str) -> str:
    """The name of a frame of coordinates; ValueError for a name that ROS does not take."""
    if not _FRAME.fullmatch(text):
        raise ValueError(f"--frame-id {printable(text)}: is no frame of ROS; give letters, digits and single _")
    return text


def topic_names(names: list[str], otherwise: str) -> list[str]:
    """Parts of topics for names: other characters become _, a digit goes after a word, and repeated names get numbers.

    Args:
        otherwise: the word for a name without letters and digits, and before a name that begins with a digit.
    """
    found: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or otherwise
        plain = plain if plain[0].isalpha() else f"{otherwise}_{plain}"
        one, number = plain, 1
        while one in found:
            number += 1
            one = f"{plain}_{number}"
        found.append(one)
    return found


def stamp_of(sink: AbstractMessageSink, time: int) -> Any:
    """A stamp of ROS, from ns since 1970."""
    return sink.types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)


def require_stamps(path: Path, first: int, last: int) -> None:
    """Raise `SessionError` for times, ns since 1970, that a stamp of ROS cannot hold."""
    if first < 0 or last >= END_OF_TIME:
        what = f"lie {first / 1e9:,.0f} to {last / 1e9:,.0f} s after 1970; ROS counts from 1970 to 2038"
        raise problem(path, "time", what, "correct time_epoch_utc")
