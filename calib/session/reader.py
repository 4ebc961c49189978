"""Read a session file: its description at once, its arrays when they are asked for."""

import functools
import os
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from types import MappingProxyType

import h5py
import numpy as np
import scipy.sparse as sp

from .errors import SessionError, printable, problem
from .hdf5.chunks import GuardedArray
from .hdf5.guard import Node, open_guarded, root_node
from .hdf5.members import SCHEMA, column, declared_unit, required, small_array
from .mixing import TERMS, count_readings, mixing_of_terms
from .outputs import file_hash
from .stream import Stream
from .tables import CLOCK_ATTRIBUTES, PRESS_COLUMNS, SESSION_FORMAT, ClockTable, Events, PressTable
from .units import Unit

MAX_STREAMS = 64


def open_session(path: str | os.PathLike[str]) -> "Session":
    """Open a session file for reading.

    Only descriptions are read and checked here. Samples are read on request and in bounded pieces, so that a
    session may be larger than memory. Use the session as a context manager, or call ``close``.

    Raises:
        SessionError: with one line that says what is wrong with the file, where, and what to do.
    """
    where = Path(path)
    file = open_guarded(where)
    try:
        return Session(where, file)
    except BaseException:
        file.close()
        raise


class Session:
    """An open session file; made by `open_session`.

    | attribute          | meaning                                                                   |
    |--------------------|---------------------------------------------------------------------------|
    | pattern            | drive+, drive-, sense+, sense- of each reading (readings, 4) int, or None |
    | current, frequency | A and Hz, None if not stated                                              |
    | offset             | when in the scan a reading is taken (readings,) s, or None                |
    | streams            | by name                                                                   |
    | presses, events    | tables, or None; see `PressTable` and `Events`                            |
    | clocks             | by name of the stream; see `ClockTable`                                   |
    | truth              | arrays by name; empty unless simulated                                    |
    | complete           | False for a recording that was interrupted, or whose devices failed       |
    | recovered          | whether the session was restored after a crash                            |
    | created, epoch     | ISO texts in UTC                                                          |
    | epoch_ns           | ns since 1970                                                             |

    Example:
        with calib.open_session("session.h5") as session:
            print(session.title, session.epoch, session.pattern.shape, session.current)  # A
            print(len(session.presses.x), "presses;", session.complete)
            for name, stream in session.streams.items():
                print(name, stream.shape, stream.unit, stream.nominal_rate)  # Hz
    """

    def __init__(self, path: Path, file: h5py.File):
        self.path, self.name, self._file = path, path.name, file
        root = self._root = root_node(file, path)
        _check_format(root)
        root.members()  # refuses a root with too many members
        self.attrs: Mapping[str, str | int | float] = MappingProxyType(root.plain_attributes())
        self.session_id = root.text("session_id")
        self.title = root.text("title", "")
        self.creator = root.text("creator", "")
        self.complete = bool(root.number("complete"))
        self.recovered = bool(root.number("recovered", 0))
        self.simulated = bool(root.number("simulated"))
        self.epoch = root.text("time_epoch_utc")
        self.epoch_ns = _nanoseconds(root, self.epoch)
        self.created = root.text("created_utc", self.epoch)
        self.scene = root.text("scene", "") or None
        seed = root.attribute("seed")
        self.seed = None if seed is None else int(root.number("seed"))
        self._read_device()
        self.streams: Mapping[str, Stream] = MappingProxyType(self._read_streams())

    def _read_device(self) -> None:
        device = required(self._root, "device", self._root.group("device"))
        self.skin_name, self.skin_toml = device.text("skin"), device.text("skin_toml")
        protocol = device.group("eit_protocol")
        self.pattern: np.ndarray | None = None
        self.mixing: sp.csr_array | None = None
        self.offset: np.ndarray | None = None
        self.current: float | None = None
        self.frequency: float | None = None
        if protocol is not None:
            self._read_protocol(protocol)

    def _read_protocol(self, protocol: Node) -> None:
        mixed = _mixed(protocol)
        name = "row_pattern" if mixed else "pattern"
        self.pattern = _pattern(required(protocol, name, protocol.dataset(name)))
        self.mixing = _mixing(protocol, len(self.pattern)) if mixed else None
        for name in ("current", "frequency"):
            if protocol.attribute(name) is not None:
                setattr(self, name, float(protocol.number(name)))
        if (self.current is not None and self.current <= 0) or (self.frequency is not None and self.frequency < 0):
            what = f"current {self.current} A at {self.frequency} Hz cannot be"
            raise protocol.error(what, "write an amplitude above zero, and a frequency of zero or more")
        offset = protocol.dataset("offset")
        if offset is not None:
            self.offset = small_array(offset, (self.readings,), "f").astype(float)

    def _read_streams(self) -> "dict[str, Stream]":
        group = required(self._root, "streams", self._root.group("streams"))
        names = group.members(MAX_STREAMS)
        nodes = {name: group.group(name) for name in names}
        streams = {name: Stream(name, node) for name, node in nodes.items() if node is not None}
        if not streams:
            raise group.error("holds no stream", "record at least one")
        if "eit" in streams and self.readings is not None and streams["eit"].channels != self.readings:
            what = f"has {streams['eit'].channels} channels, the pattern has {self.readings} "
            what += "rows" if self.mixing is None else "readings"
            raise problem(self.path, "/streams/eit", what, "give the pattern that was recorded")
        return streams

    @property
    def readings(self) -> int | None:
        """Number of readings of a frame; None without a pattern."""
        return None if self.pattern is None else count_readings(self.pattern, self.mixing)

    def stream(self, name: str) -> "Stream":
        """The stream `name`. If it is missing, the `SessionError` lists the streams of the file."""
        if name not in self.streams:
            there = ", ".join(self.streams)
            raise problem(self.path, f"/streams/{printable(name)}", "missing", f"the file has: {there}")
        return self.streams[name]

    @functools.cached_property
    def presses(self) -> PressTable | None:
        """The table of presses, or None if the file has none."""
        node = self._root.group("presses")
        if node is None:
            return None
        columns = {name: column(node, name, c.dtype) for name, c in PRESS_COLUMNS.items()}
        try:
            return PressTable(**columns)  # type: ignore[arg-type]
        except SessionError as error:
            raise SessionError(f"{printable(self.name)}: /{error}") from None

    @functools.cached_property
    def events(self) -> Events | None:
        """Marks in the recording, or None if the file has none."""
        node = self._root.group("events")
        if node is None:
            return None
        time, code = column(node, "time", "i8"), column(node, "code", "u2")
        label = column(node, "label", "S")
        if not len(time) == len(code) == len(label):
            raise node.error("columns of unequal length", "write one row per event")
        return Events(np.asarray(time), np.asarray(code), tuple(label))

    @functools.cached_property
    def clocks(self) -> Mapping[str, ClockTable]:
        """Clocks of the devices against that of the session, by stream; empty if not stated."""
        node = self._root.group("clocks")
        names = node.members(MAX_STREAMS) if node is not None else []
        groups = {name: node.group(name) for name in names} if node is not None else {}
        return MappingProxyType({name: _clock(group) for name, group in groups.items() if group is not None})

    @functools.cached_property
    def truth(self) -> Mapping[str, np.ndarray]:
        """Simulated quantities in SI, by name; each array is read on request."""
        return _TruthArrays(self._root.group("truth"))

    @functools.cached_property
    def hash(self) -> str:
        """SHA-256 of the file, as hexadecimal digits."""
        return file_hash(self.path)

    def close(self) -> None:
        """Close the file; arrays already read stay valid."""
        self._file.close()

    def __enter__(self) -> "Session":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Session({printable(self.name)!r}, streams={list(self.streams)})"


class _TruthArrays(Mapping[str, np.ndarray]):
    """The group /truth as a mapping; its dimension scales (``name.0``) are left out."""

    def __init__(self, node: Node | None):
        self._node = node
        names = node.members() if node is not None else []
        self._names = [name for name in names if "." not in name]

    def __getitem__(self, name: str) -> np.ndarray:
        if self._node is None or name not in self._names:
            raise KeyError(name)
        node = required(self._node, name, self._node.dataset(name))
        array = GuardedArray(node)
        if array.dtype.kind == "S":
            raise node.error(f"holds {array.dtype}, not numbers", SCHEMA)
        unit = declared_unit(node, "")
        values = array.read()
        return values if unit == Unit(unit.si) else values * unit.factor + unit.offset

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _check_format(root: Node) -> None:
    """Refuse any file but ``format = "skin-session"``, version 1.x."""
    if root.attribute("format") is None:
        what = "is HDF5 but not a session (no attribute `format`)"
        raise problem(root.path, "file", what, "name a file written by jaxeit, or import it")
    found = root.text("format")
    if found != SESSION_FORMAT:
        what = f"is a {printable(found)!r} file, not a {SESSION_FORMAT!r}"
        raise problem(root.path, "file", what, "name a session file")
    check_version(root)


def check_version(root: Node) -> None:
    """Refuse any ``format_version`` but 1.x."""
    version = root.text("format_version")
    if version.split(".")[0] != "1":
        what = f"has format version {printable(version)}, but this program reads 1.x"
        raise problem(root.path, "file", what, "install a newer jaxeit")


def _nanoseconds(root: Node, text: str) -> int:
    """`epoch_nanoseconds` of the time that a file names."""
    try:
        return epoch_nanoseconds(text)
    except ValueError as error:
        raise root.error(str(error), "write an ISO time with zone, as 2025-01-31T12:00:00Z") from None


def epoch_nanoseconds(text: str) -> int:
    """Convert an ISO time with zone to ns since 1970; raises ValueError."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        raise ValueError(f"time_epoch_utc is {printable(text)!r}")
    since = moment - datetime.fromisoformat("1970-01-01T00:00:00Z")
    return ((since.days * 86400 + since.seconds) * 10**6 + since.microseconds) * 1000


def _pattern(node: Node) -> np.ndarray:
    """Electrodes of the readings (readings, 4): no negative number, no pair of an electrode with itself."""
    pattern = small_array(node, (None, 4), "iu").astype(np.int64)
    pairs = (pattern[:, 0] == pattern[:, 1]) | (pattern[:, 2] == pattern[:, 3])
    bad = pairs | (pattern < 0).any(axis=1)
    if not len(pattern) or bad.any():
        row = int(np.argmax(bad)) if len(pattern) else 0
        what = f"row {row} is no measurement" if len(pattern) else "has no rows"
        raise node.error(what, "give drive+, drive-, sense+, sense- as zero-based electrodes")
    return pattern


def _mixed(protocol: Node) -> bool:
    """Whether readings are sums of rows: what such a file holds has other names than `pattern`, so that no reader,
    even of format 1.0, takes a row for a reading."""
    held = [name for name in ("row_pattern", *TERMS) if protocol.dataset(name) is not None]
    if held and protocol.dataset("pattern") is not None:
        raise protocol.error(
            f"holds pattern and {held[0]}", "keep pattern for readings of pairs, or the others for sums"
        )
    return bool(held)


def _mixing(protocol: Node, rows: int) -> sp.csr_array:
    """Readings as sums of rows of the pattern, (readings, rows)."""
    nodes = {name: required(protocol, name, protocol.dataset(name)) for name in TERMS}
    reading = small_array(nodes["term_reading"], (None,), "iu").astype(np.int64)
    row = small_array(nodes["term_row"], (len(reading),), "iu").astype(np.int64)
    share = small_array(nodes["term_share"], (len(reading),), "f")
    try:
        return mixing_of_terms(reading, row, share, rows)
    except ValueError as error:
        raise protocol.error(f"the terms of its readings: {error}", SCHEMA) from None


def _clock(node: Node) -> ClockTable:
    """Read one member of /clocks."""
    host, ticks = column(node, "host_ns", "i8"), column(node, "device_ticks", "u8")
    numbers = {name: float(node.number(name, 0.0)) for name in CLOCK_ATTRIBUTES if name not in ("valid", "method")}
    try:
        return ClockTable(
            host_ns=np.asarray(host),
            device_ticks=np.asarray(ticks),
            valid=bool(node.number("valid", 0)),
            method=node.text("method", ""),
            **numbers,
        )
    except SessionError as error:
        what = str(error).removeprefix("clocks: ")
        raise SessionError(f"{printable(node.path.name)}: {node.where}: {what}") from None
