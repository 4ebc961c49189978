"""Force maps and sessions as bags of ROS 2 in MCAP files, for `ros2 bag play` and Foxglove."""

import heapq
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.application.frame_blocks import Progress
from ..calibration.application.map_files import FORCE_MAP_FORMAT, TRACKS
from ..session import ArchiveReader, Session, Stream, open_archive, open_session
from ..session.archive import archive_format
from ..session.errors import printable, problem
from ..session.reader import epoch_nanoseconds
from ..session.tables import SESSION_FORMAT
from . import mcap_messages as ros
from .force_map_topics import PAD_COLUMNS, PICTURES, PLACE_COLUMNS, TRACK_COLUMNS, ForceMapTopics, SkinLayout
from .mcap_writer import Bag, require_frame, require_stamps, topic_names, topic_prefix, writing_bag

BLOCK = 256
"""Frames of a force map that are read at once."""

BLOCK_BYTES = 4 << 20
"""Bytes of a stream of a session that are read at once."""


@dataclass(frozen=True)
class BagSummary:
    """What a bag holds.

    | meaning                                             | unit |
    |-----------------------------------------------------|------|
    | topics: type and number of the messages, by topic   |      |
    | seconds from the first message to the last          | s    |
    """

    topics: dict[str, tuple[str, int]]
    seconds: float

    def __str__(self) -> str:
        count = sum(number for _, number in self.topics.values())
        lines = [f"{len(self.topics)} topics, {count:,} messages, {self.seconds:.2f} s"]
        return "\n".join([*lines, *(f"  {name}  {kind}  {number:,}" for name, (kind, number) in self.topics.items())])


def export_mcap(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    prefix: str = "/skin",
    frame_id: str = "skin",
    progress: Progress = iter,
) -> BagSummary:
    """Write a force map of `calib.apply`, or a session, as a bag of ROS 2; it appears only when complete.

    ``docs/ros.md`` lists the topics. Missing values are NaN in the file and stay NaN in the messages.

    Args:
        output: a name that ends in ``.mcap`` is one MCAP file; another is a folder of rosbag2, with its metadata.
        prefix: the topics' first part.
        frame_id: the frame of coordinates in which the skin lies.
        progress: wraps what is written piece by piece, as `tqdm.tqdm` does.

    Raises:
        SessionError: for another kind of file, a file without frames, times that ROS cannot state, or an output that
            exists.
        ValueError: for a prefix or a frame that ROS does not take.
        ImportError: without the library `rosbags`, of the extra ``tables``.
    """
    source, output = Path(source), Path(output)
    prefix, frame_id = topic_prefix(prefix), require_frame(frame_id)
    kind = archive_format(source)
    if kind == FORCE_MAP_FORMAT:
        with open_archive(source, FORCE_MAP_FORMAT) as archive, writing_bag(output) as bag:
            times = _ForceMapBag(bag, archive, prefix, frame_id).write(progress)
            return _summary(bag, times)
    if kind == SESSION_FORMAT:
        with open_session(source) as session, writing_bag(output) as bag:
            return _summary(bag, _write_session(bag, session, prefix, progress))
    what = f"is {printable(kind)!r}" if kind else "has no format"
    raise problem(source, "file", what, "name a force map of `jaxeit apply`, or a session")


def _summary(bag: Bag, times: tuple[int, int]) -> BagSummary:
    topics = {name: (bag.kind(name), count) for name, count in bag.counts.items()}
    return BagSummary(topics, (times[1] - times[0]) / 1e9)


class _ForceMapBag:
    """The topics of a force map. Its arrays are checked before the first message is written."""

    def __init__(self, bag: Bag, archive: ArchiveReader, prefix: str, frame: str):
        self._archive = archive
        self._rows, self._columns = (self._whole(name) for name in ("image_rows", "image_columns"))
        pixels, frames = self._rows * self._columns, self._frames()
        self._require({"areas": (pixels,), "points": (pixels, 3)})
        pads = self._pads()
        self._require(dict.fromkeys(PICTURES, (frames, pixels)))
        self._require(dict.fromkeys(PAD_COLUMNS, (frames, len(pads))))
        self._contacts = self._contact_arrays(frames)
        self._tracks = self._track_times()
        areas, *places = (archive.arrays[name].read() for name in ("areas", "points", "pad_points", "pad_normals"))
        layout = SkinLayout(self._rows, self._columns, areas, places[0], pads, *places[1:])
        self._topics = ForceMapTopics(bag, layout, prefix, frame)

    def _whole(self, name: str) -> int:
        value = self._archive.attrs.get(name)
        if not isinstance(value, int) or value < 1:
            raise problem(self._archive.path, name, f"is {printable(value)!r}", "write the force map again")
        return value

    def _frames(self) -> int:
        self._require({"time": None})
        shape = self._archive.arrays["time"].shape
        if len(shape) != 1 or not shape[0]:
            raise problem(self._archive.path, "time", "holds no frame", "apply the calibration to a longer session")
        return int(shape[0])

    def _pads(self) -> list[str]:
        """Names of the pads."""
        self._require({"pad_names": None})
        count = self._archive.arrays["pad_names"].shape[0]
        self._require({"pad_points": (count, 3), "pad_normals": (count, 3)})
        return [str(name) for name in self._archive.arrays["pad_names"].read().tolist()]

    def _contact_arrays(self, frames: int) -> list[str]:
        """Arrays of the contacts that were found in each frame alone; none if they were not looked for."""
        names = [name for name in PLACE_COLUMNS if name in self._archive.arrays]
        if names:
            self._require(dict.fromkeys(PLACE_COLUMNS))
            count = (*self._archive.arrays["contact_force"].shape, 0)[1]
            self._require({name: (frames, count, *tail) for name, (_, tail) in PLACE_COLUMNS.items()})
        return names

    def _track_times(self) -> np.ndarray | None:
        """Times of the rows of contacts that were followed, ns; None if they were not."""
        if TRACKS + "time" not in self._archive.arrays:
            return None
        times = self._archive.arrays[TRACKS + "time"].read()
        self._require({TRACKS + name: (len(times), *tail) for name, (_, tail) in TRACK_COLUMNS.items()})
        if times.ndim != 1 or (np.diff(times) < 0).any():
            raise problem(self._archive.path, TRACKS + "time", "is not in order", "write the force map again")
        return times

    def _require(self, shapes: dict[str, tuple[int, ...] | None]) -> None:
        """Refuse a file without these arrays, or with arrays of other shapes."""
        todo = "write the force map again with `jaxeit apply`"
        for name, shape in shapes.items():
            if name not in self._archive.arrays:
                raise problem(self._archive.path, name, "missing", todo)
            if shape is not None and self._archive.arrays[name].shape != shape:
                what = f"has the shape {self._archive.arrays[name].shape}, not {shape}"
                raise problem(self._archive.path, name, what, todo)

    def write(self, progress: Progress) -> tuple[int, int]:
        """Write all messages; returns the times of the first and the last, ns since 1970."""
        arrays, path = self._archive.arrays, self._archive.path
        epoch = _epoch(self._archive)
        first, last = (epoch + int(arrays["time"].read(*rows)[0]) for rows in ((0, 1), (self._frames() - 1, None)))
        require_stamps(path, first, last)
        self._topics.declare(contacts=bool(self._contacts), tracks=self._tracks is not None)
        self._topics.write_places(first)
        for start in progress(range(0, self._frames(), BLOCK)):
            block = {
                name: arrays[name].read(start, start + BLOCK) for name in (*PICTURES, *PAD_COLUMNS, *self._contacts)
            }
            for row, since in enumerate(arrays["time"].read(start, start + BLOCK).tolist()):
                time = epoch + since
                require_stamps(path, min(first, time), max(last, time))
                self._write_frame(time, {name: values[row] for name, values in block.items()})
                self._write_tracks(time, since)
        return first, last

    def _write_frame(self, time: int, values: dict[str, np.ndarray]) -> None:
        self._topics.write_pictures(time, values)
        self._topics.write_pads(time, values)
        if self._contacts:
            self._topics.write_contacts(time, values)

    def _write_tracks(self, time: int, since: int) -> None:
        """Write the contacts of a frame that were followed; a table without rows says that there is none."""
        if self._tracks is None:
            return
        first, stop = (int(np.searchsorted(self._tracks, since, side)) for side in ("left", "right"))
        arrays = self._archive.arrays
        self._topics.write_tracks(time, {name: arrays[TRACKS + name].read(first, stop) for name in TRACK_COLUMNS})


def _epoch(archive: ArchiveReader) -> int:
    """Zero of the times of an archive, ns since 1970."""
    try:
        return epoch_nanoseconds(str(archive.attrs.get("time_epoch_utc", "")))
    except ValueError as error:
        raise problem(archive.path, "file", str(error), "write the force map again with `jaxeit apply`") from None


def _write_session(bag: Bag, session: Session, prefix: str, progress: Progress) -> tuple[int, int]:
    """Write the streams of a session in the order of time; returns the first and the last time, ns since 1970."""
    streams = [stream for stream in session.streams.values() if len(stream)]
    if not streams:
        raise problem(session.path, "/streams", "hold no sample", "record a longer session")
    first = session.epoch_ns + min(int(stream.time[0]) for stream in streams)
    last = session.epoch_ns + max(int(stream.time[-1]) for stream in streams)
    require_stamps(session.path, first, last)
    parts = []
    for stream, name in zip(streams, topic_names([stream.name for stream in streams], "stream"), strict=True):
        topic = bag.topic(f"{prefix}/{name}", ros.NUMBERS)
        parts.append(_samples(bag, stream, topic))
        status = stream.status()
        if status is not None and status.any():
            flagged = bag.topic(f"{prefix}/{name}/status", ros.FLAGS)
            parts.append(_flagged(bag, stream, flagged, status))
    for time, topic, message in progress(heapq.merge(*parts, key=lambda part: part[0])):
        bag.write(topic, session.epoch_ns + time, message())
    return first, last


Message = tuple[int, str, Callable[[], Any]]


def _samples(bag: Bag, stream: Stream, topic: str) -> Iterator[Message]:
    """Times, ns since the session's epoch, and messages of all samples of a stream."""
    axis = ros.LabelledAxis(f"{stream.variable} [{stream.unit}]", stream.channels)
    for start, stop, values in stream.blocks(BLOCK_BYTES):
        for time, row in zip(stream.time[start:stop].tolist(), values, strict=True):
            yield time, topic, partial(ros.numbers, bag, row, axis)


def _flagged(bag: Bag, stream: Stream, topic: str, status: np.ndarray) -> Iterator[Message]:
    """Times and flags of the samples that have flags."""
    for row in np.flatnonzero(status).tolist():
        yield int(stream.time[row]), topic, partial(ros.flags, bag, int(status[row]))
