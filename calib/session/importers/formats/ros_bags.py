"""Recordings of ROS: MCAP files, rosbag2 folders and SQLite files, and bags of ROS 1. ROS itself is not needed."""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from jaxeit.budget import current_budget
from jaxeit.messages.spelling import did_you_mean

from ...errors import printable, problem
from ..arrays import AbstractArrayImporter, ArrayFile, ArrayShape
from ..child import library
from ..limits import MAX_NAMES, check_size
from ..tables.columns import FileSpec
from ..tables.table import first_bytes
from .mcap_checksums import require_summary

EXTRA = "tables"
LOG_TIME = "log_time"
METADATA = "metadata.yaml"
FILES = (".mcap", ".db3")
MAX_DEPTH = 8


class BagFile(ArrayFile):
    """A recording of ROS as a table. A column of no topic, or of one without numbers, names the topic."""

    def indices(self, column: str) -> list[int]:
        """See `AbstractTableFile.indices`."""
        topic, where = column.split(".")[0], f"topic {column.split('.')[0]!r}"
        own = [name for name in self._shapes if name.split(".")[0] == topic]
        if not own and not column.isdecimal():
            topics = list(dict.fromkeys(name.split(".")[0] for name in self._shapes))
            what = f"not there; topics are {', '.join(topics)}"
            raise problem(self.path, where, what, did_you_mean(topic, topics, "name one of them"))
        if own and not self._shapes[own[0]].rows:
            raise problem(self.path, where, "holds no message", "name another topic, or record again")
        if len(own) == 1 and column not in own:
            what = "holds no number that can be read"
            raise problem(self.path, where, what, "name another topic, or take another copy of a damaged file")
        return super().indices(column)


class McapImporter(AbstractArrayImporter):
    """Each number in the messages of a topic is a column ``/topic.field.field``, an array one of several columns.

    The clock of a stream is by default the time at which the messages of its topic were logged; ``--time header.stamp``
    takes that field of its messages.
    """

    name: ClassVar[str] = "mcap"
    summary: ClassVar[str] = "ROS 2 and ROS 1 recordings (.mcap, .db3, .bag, rosbag2 folders), with jaxeit[tables]"

    @classmethod
    def file_specs(cls, args: argparse.Namespace) -> list[FileSpec]:
        """One description for each stream, because each topic has its own times."""
        for group in args.groups:
            group.time = group.time or ("" if group.rate is not None else f"{LOG_TIME}:s")
        specs = super().file_specs(args)
        return [_with_clock(spec, index) for spec in specs for index in range(len(spec.streams))] or list(specs)

    @classmethod
    def opener(cls, args: argparse.Namespace) -> Callable[[Path], ArrayFile]:
        """See `AbstractTableImporter.opener`."""
        return partial(BagFile, cls)

    @classmethod
    def outline(cls, path: Path) -> dict[str, ArrayShape]:
        """See `AbstractArrayImporter.outline`; of each topic the first message is read."""
        shapes = {}
        with _opened(path) as bag:
            for topic, connections in _topics(path, bag).items():
                rows = sum(connection.msgcount for connection in connections)
                check_size(path, rows, 0)
                shapes[f"{topic}.{LOG_TIME}"] = ArrayShape(rows, 1, "s")
                for connection, _, raw in bag.messages(connections=connections):
                    fields = _fields(bag.deserialize(raw, connection.msgtype))
                    shapes |= {f"{topic}.{name}": ArrayShape(rows, *more) for name, more in fields}
                    break
                if len(shapes) > MAX_NAMES:
                    raise problem(path, "file", f"holds more than {MAX_NAMES:,} columns", "record fewer topics")
        return shapes

    @classmethod
    def arrays(cls, path: Path, names: Sequence[str]) -> list[np.ndarray]:
        """See `AbstractArrayImporter.arrays`."""
        found: dict[str, np.ndarray] = {}
        with _opened(path) as bag:
            topics = _topics(path, bag)
            for topic in dict.fromkeys(name.split(".")[0] for name in names):
                fields = [name.partition(".")[2] for name in names if name.split(".")[0] == topic]
                for field, values in zip(fields, _columns(path, bag, topics[topic], fields), strict=True):
                    found[f"{topic}.{field}"] = values
        return [found[name] for name in names]


def _with_clock(spec: FileSpec, index: int) -> FileSpec:
    """The description reduced to one of its streams, with the clock of the topic of that stream."""
    stream = spec.streams[index]
    topics = {column.split(".")[0] for column in stream.columns}
    if len(topics) > 1:
        where = f"--stream {printable(stream.name)}"
        raise problem(spec.path, where, "has columns of several topics", "make one stream of each topic")
    topic = topics.pop()
    time = spec.time if not spec.time or spec.time.startswith("/") else f"{topic}.{spec.time}"
    return replace(spec, time=time, streams=(stream,))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The recording; bags without definitions of their messages are read as those of the latest ROS 2."""
    if not path.is_dir():
        first_bytes(path)
    elif not (path / METADATA).exists():
        inside = [file.name for file in sorted(path.iterdir()) if file.suffix in FILES]
        todo = f"name the file in it, {printable(path / inside[0], 300)}" if inside else "name the folder of a bag"
        raise problem(path, METADATA, "is not in the folder", todo)
    highlevel, typesys = library("rosbags.highlevel", EXTRA), library("rosbags.typesys", EXTRA)
    store = typesys.get_typestore(typesys.Stores.LATEST)
    for file in _mcap_files(path):
        require_summary(file)
    with highlevel.AnyReader([path], default_typestore=store) as bag:
        yield bag


def _mcap_files(path: Path) -> list[Path]:
    """The MCAP files of a recording: those in its folder, or the file itself."""
    return [file for file in (sorted(path.iterdir()) if path.is_dir() else [path]) if file.suffix == ".mcap"]


def _topics(path: Path, bag: Any) -> dict[str, list[Any]]:
    """Connections by topic; a topic with two types of messages is refused."""
    topics: dict[str, list[Any]] = {}
    for connection in bag.connections:
        topics.setdefault(connection.topic, []).append(connection)
    for topic, connections in topics.items():
        if len({connection.msgtype for connection in connections}) > 1:
            raise problem(path, topic, "has messages of several types", "record each type under a topic of its own")
    return topics


def _fields(message: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, tuple[int, str]]]:
    """Names of the numbers in a message, each with its number of columns and its unit if it is a time."""
    for name in getattr(message, "__dataclass_fields__", ()):
        value, path = getattr(message, name), f"{prefix}{name}"
        if _is_time(value):
            yield path, (1, "s")
        elif isinstance(value, bool | int | float):
            yield path, (1, "")
        elif isinstance(value, np.ndarray) and value.ndim == 1 and value.size and value.dtype.kind in "biuf":
            yield path, (len(value), "")
        elif depth < MAX_DEPTH:
            yield from _fields(value, f"{path}.", depth + 1)


def _is_time(value: Any) -> bool:
    return set(getattr(value, "__dataclass_fields__", ())) - {"__msgtype__"} == {"sec", "nanosec"}


def _columns(path: Path, bag: Any, connections: list[Any], fields: Sequence[str]) -> list[np.ndarray]:
    """Values (messages, columns) of each field of a topic."""
    getters = [None if field == LOG_TIME else attrgetter(field) for field in fields]
    rows: list[list[np.ndarray]] = [[] for _ in fields]
    only_time, most = all(getter is None for getter in getters), current_budget().import_rows
    for number, (connection, time, raw) in enumerate(bag.messages(connections=connections)):
        if number >= most:
            check_size(path, number + 1, 0)
        message = None if only_time else bag.deserialize(raw, connection.msgtype)
        for values, getter in zip(rows, getters, strict=True):
            values.append(_row(time * 1e-9 if getter is None else getter(message)))
    return [_stacked(path, f"{connections[0].topic}.{field}", one) for field, one in zip(fields, rows, strict=True)]


def _row(value: Any) -> np.ndarray:
    seconds = value.sec + value.nanosec * 1e-9 if _is_time(value) else value
    return np.atleast_1d(np.asarray(seconds, np.float64))


def _stacked(path: Path, name: str, rows: list[np.ndarray]) -> np.ndarray:
    odd = next((number for number, row in enumerate(rows, 1) if len(row) != len(rows[0])), None)
    if odd is not None:
        what = f"has {len(rows[0])} values in the first message and {len(rows[odd - 1])} in message {odd}"
        raise problem(path, name, what, "record messages of one length")
    return np.stack(rows) if rows else np.empty((0, 1))
