"""Reading a session file, lazily, through the guard."""

import functools
import os
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path
from types import MappingProxyType, TracebackType

import h5py
import numpy as np

from calib.session.chunks import GuardedArray
from calib.session.guard import Node, open_guarded, root_node, translated
from calib.session.model import (
    CLOCK_ATTRIBUTES,
    FORMAT,
    PRESS_COLUMNS,
    STREAM_EXTRAS,
    ClockTable,
    Events,
    PressTable,
    SessionError,
    Status,
    printable,
    problem,
)
from calib.session.storage import file_hash
from calib.session.units import KNOWN_UNITS, UNITS, VARIABLE_UNIT, Unit

MAX_STREAMS = 64
MAX_CHANNELS = 100_000
MAX_TABLE_ROWS = 1 << 20
MAX_TRUTH_BYTES = 1 << 30
TYPES_OF_TIME = "write int64 nanoseconds since the epoch"
SCHEMA = "see data/schema/README.md"


def open_session(path: str | os.PathLike[str]) -> "Session":
    """Open a session file for reading.

    Only descriptions are read and checked here; samples are read when asked for, in bounded pieces,
    so a session larger than memory is fine. Use it as a context manager, or call ``close``. Raises
    `SessionError` with one line that says what is wrong with the file, where, and what to do.
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

    ``pattern`` (M, 4) int: drive+, drive-, sense+, sense-, or None; ``current`` in A and
    ``frequency`` in Hz (None if not stated); ``offset`` (M,) s or None; ``streams`` by name;
    ``presses`` and ``events`` or None; ``clocks`` by stream; ``truth`` by name, empty unless
    simulated; ``complete`` is False for a recording that broke off and ``recovered`` says that it
    was made whole from what a crash left; ``created`` and ``epoch`` are ISO texts in UTC and
    ``epoch_ns`` counts from 1970.
    """

    def __init__(self, path: Path, file: h5py.File):
        self.path, self.name, self._file = path, path.name, file
        root = self._root = root_node(file, path)
        _check_format(root)
        root.members()  # refuses a root too wide to be ours
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
        device = _needed(self._root, "device", self._root.group("device"))
        self.skin_name, self.skin_toml = device.text("skin"), device.text("skin_toml")
        protocol = device.group("eit_protocol")
        self.pattern: np.ndarray | None = None
        self.offset: np.ndarray | None = None
        self.current: float | None = None
        self.frequency: float | None = None
        if protocol is not None:
            self._read_protocol(protocol)

    def _read_protocol(self, protocol: Node) -> None:
        self.pattern = _pattern(_needed(protocol, "pattern", protocol.dataset("pattern")))
        for name in ("current", "frequency"):
            if protocol.attribute(name) is not None:
                setattr(self, name, float(protocol.number(name)))
        offset = protocol.dataset("offset")
        if offset is not None:
            self.offset = _small(offset, (len(self.pattern),), "f").astype(float)

    def _read_streams(self) -> "dict[str, Stream]":
        group = _needed(self._root, "streams", self._root.group("streams"))
        names = group.members(MAX_STREAMS)
        nodes = {name: group.group(name) for name in names}
        streams = {name: Stream(name, node) for name, node in nodes.items() if node is not None}
        if not streams:
            raise group.error("holds no stream", "record at least one")
        rows = None if self.pattern is None else len(self.pattern)
        if "eit" in streams and rows is not None and streams["eit"].channels != rows:
            what = f"has {streams['eit'].channels} channels, the pattern has {rows} rows"
            raise problem(self.path, "/streams/eit", what, "give the pattern that was recorded")
        return streams

    def stream(self, name: str) -> "Stream":
        """The stream `name`; `SessionError` that names those there are."""
        if name not in self.streams:
            there = ", ".join(self.streams)
            raise problem(self.path, f"/streams/{printable(name)}", "missing", f"there are: {there}")
        return self.streams[name]

    @functools.cached_property
    def presses(self) -> PressTable | None:
        """The table of presses, or None if the file has none."""
        node = self._root.group("presses")
        if node is None:
            return None
        columns = {name: _column(node, name, c.dtype) for name, c in PRESS_COLUMNS.items()}
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
        time, code = _column(node, "time", "i8"), _column(node, "code", "u2")
        label = _column(node, "label", "S")
        if not len(time) == len(code) == len(label):
            raise node.error("columns of unequal length", "write one row per event")
        return Events(np.asarray(time), np.asarray(code), tuple(label))

    @functools.cached_property
    def clocks(self) -> Mapping[str, ClockTable]:
        """How each device's clock was laid on the session's, by stream; empty if not stated."""
        node = self._root.group("clocks")
        names = node.members(MAX_STREAMS) if node is not None else []
        groups = {name: node.group(name) for name in names} if node is not None else {}
        return MappingProxyType({name: _clock(group) for name, group in groups.items() if group is not None})

    @functools.cached_property
    def truth(self) -> Mapping[str, np.ndarray]:
        """What was simulated, in SI, by name; each array is read when it is asked for."""
        return _Truth(self._root.group("truth"))

    @functools.cached_property
    def hash(self) -> str:
        """SHA-256 of the file, as hexadecimal digits."""
        return file_hash(self.path)

    def close(self) -> None:
        """Close the file; arrays already read stay valid."""
        self._file.close()

    def __enter__(self) -> "Session":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Session({printable(self.name)!r}, streams={list(self.streams)})"


class Stream:
    """One stream of a session: its own clock, its own rate.

    ``variable`` is the main variable's name, ``unit`` its SI unit, ``channels`` its columns,
    ``shape`` (rows, channels), ``nominal_rate`` in Hz, ``clock`` and ``transport`` as recorded.
    """

    def __init__(self, name: str, node: Node):
        self.name, self._node = name, node
        self.variable = _signal(node)
        self.nominal_rate = float(node.number("nominal_rate_hz"))
        if self.nominal_rate <= 0:
            raise node.error("nominal_rate_hz is not positive", "write samples per second")
        self.clock, self.transport = node.text("clock", ""), node.text("transport", "")
        values = _needed(node, self.variable, node.dataset(self.variable))
        self._values = GuardedArray(values)
        self._time = GuardedArray(_needed(node, "time", node.dataset("time")))
        self._check_shapes()
        self._unit = _unit(values, self.variable)
        self.unit = self._unit.si
        self._scale = float(values.number("scale_factor", 1.0))
        self._shift = float(values.number("add_offset", 0.0))
        fill = values.attribute("_FillValue")
        self._fill = fill if isinstance(fill, int | float) else None

    def _check_shapes(self) -> None:
        values, time = self._values, self._time
        if time.dtype.kind != "i" or time.dtype.itemsize != 8 or len(time.shape) != 1:
            raise time.node.error(f"is {time.dtype} of rank {len(time.shape)}", TYPES_OF_TIME)
        if values.dtype.kind not in "iuf" or len(values.shape) not in (1, 2):
            what = f"is {values.dtype} of rank {len(values.shape)}"
            raise values.node.error(what, "write numbers (time, channel)")
        self.channels = values.shape[1] if len(values.shape) == 2 else 1
        self.shape = (values.shape[0], self.channels)
        if not 1 <= self.channels <= MAX_CHANNELS:
            raise values.node.error(f"has {self.channels:,} channels", "give at least one")
        self._check_rows("time", time)

    def _check_rows(self, name: str, array: GuardedArray) -> None:
        if array.shape != (self.shape[0],):
            what = f"has shape {array.shape} beside {self.shape[0]:,} samples"
            raise array.node.error(what, "write one entry per sample")

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"Stream({self.name!r}, {self.variable!r} in {self.unit}, shape={self.shape})"

    @functools.cached_property
    def time(self) -> np.ndarray:
        """(n,) int64 ns since the session's epoch, checked to be strictly increasing."""
        times = self._time.read().astype(np.int64)
        # compared, not subtracted: a difference of damaged times could overflow
        bad = times[1:] <= times[:-1]
        if bad.any():
            row = int(np.argmax(bad)) + 1
            what = f"does not increase at row {row} ({times[row - 1]} then {times[row]})"
            raise self._time.node.error(what, "sort the rows and drop equal times")
        times.setflags(write=False)
        return times

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Samples ``start:stop`` as float64 (n, channels) in SI; missing ones are NaN."""
        raw = self._values.read(start, stop).reshape(-1, self.channels)
        values = raw.astype(np.float64)
        if self._fill is not None and not np.isnan(self._fill):
            values[raw == self._fill] = np.nan
        scale = self._scale * self._unit.factor
        shift = self._shift * self._unit.factor + self._unit.offset
        with np.errstate(over="ignore", invalid="ignore"):
            # in place, and only if need be: this is where a long session spends its time
            values = np.multiply(values, scale, out=values) if scale != 1.0 else values
            values = np.add(values, shift, out=values) if shift != 0.0 else values
        values[np.isinf(values)] = np.nan
        return values

    def blocks(self, max_bytes: int = 32 << 20) -> Iterator[tuple[int, int, np.ndarray]]:
        """Yield ``(start, stop, values)`` over the stream, each block below `max_bytes`."""
        rows = max(1, max_bytes // (8 * self.channels))
        chunk = self._values.chunk[0] if self._values.chunk else 1
        rows = rows - rows % chunk if rows > chunk > 0 else rows
        for start in range(0, len(self), rows):
            stop = min(start + rows, len(self))
            yield start, stop, self.read(start, stop)

    def status(self) -> np.ndarray | None:
        """(n,) uint16 `Status` flags, or None if the file has none."""
        return self._optional("status", "u2")

    @property
    def time_device(self) -> np.ndarray | None:
        """(n,) uint64 raw device ticks, or None."""
        return self._optional("time_device", STREAM_EXTRAS["time_device"])

    @property
    def time_host(self) -> np.ndarray | None:
        """(n,) int64 monotonic ns at receive, or None."""
        return self._optional("time_host", STREAM_EXTRAS["time_host"])

    @property
    def seq(self) -> np.ndarray | None:
        """(n,) uint32 sequence numbers, or None."""
        return self._optional("seq", STREAM_EXTRAS["seq"])

    def _optional(self, name: str, dtype: str) -> np.ndarray | None:
        node = self._node.dataset(name)
        if node is None:
            return None
        array = GuardedArray(node)
        self._check_rows(name, array)
        if not np.can_cast(array.dtype, dtype, "safe"):
            raise node.error(f"is {array.dtype}", f"write it as {np.dtype(dtype)}")
        return array.read().astype(dtype)


class _Truth(Mapping[str, np.ndarray]):
    """The group /truth as a mapping; axes (``name.0``) are not among its names."""

    def __init__(self, node: Node | None):
        self._node = node
        names = node.members() if node is not None else []
        self._names = [name for name in names if "." not in name]

    def __getitem__(self, name: str) -> np.ndarray:
        if self._node is None or name not in self._names:
            raise KeyError(name)
        node = _needed(self._node, name, self._node.dataset(name))
        array = GuardedArray(node)
        if array.nbytes > MAX_TRUTH_BYTES or array.dtype.kind == "S":
            what = f"holds {array.nbytes:,} bytes of {array.dtype}, not numbers of at most {MAX_TRUTH_BYTES:,} bytes"
            raise node.error(what, SCHEMA)
        unit = _unit(node, "")
        values = array.read()
        return values if unit == Unit(unit.si) else values * unit.factor + unit.offset

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _needed(parent: Node, name: str, node: Node | None) -> Node:
    """`node`, or a `SessionError` that says it is missing."""
    if node is None:
        where = f"{parent.where.rstrip('/')}/{name}"
        raise problem(parent.path, where, "missing", SCHEMA)
    return node


def _check_format(root: Node) -> None:
    """Accept ``format = "skin-session"``, version 1.x."""
    if root.attribute("format") is None:
        what = "is HDF5 but not a session (no attribute `format`)"
        raise problem(root.path, "file", what, "name a file written by jaxeit, or import it")
    found = root.text("format")
    if found != FORMAT:
        what = f"is a {printable(found)!r} file, not a {FORMAT!r}"
        raise problem(root.path, "file", what, "name a session file")
    check_version(root)


def check_version(root: Node) -> None:
    """Accept any ``format_version`` 1.x."""
    version = root.text("format_version")
    if version.split(".")[0] != "1":
        what = f"is of format version {printable(version)}, this program reads 1.x"
        raise problem(root.path, "file", what, "install a newer jaxeit")


def _nanoseconds(root: Node, text: str) -> int:
    """ISO time with zone -> ns since 1970."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or moment.tzinfo is None:
        what = f"time_epoch_utc is {printable(text)!r}"
        raise root.error(what, "write an ISO time with zone, as 2025-01-31T12:00:00Z")
    since = moment - datetime.fromisoformat("1970-01-01T00:00:00Z")
    return ((since.days * 86400 + since.seconds) * 10**6 + since.microseconds) * 1000


def _small(node: Node, shape: tuple[int | None, ...], kinds: str) -> np.ndarray:
    """A whole small array of a given shape (None is any) and kind of numbers."""
    array = GuardedArray(node)
    fits = len(array.shape) == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in kinds or (array.shape or (1,))[0] > MAX_TABLE_ROWS:
        want = "(" + ", ".join("rows" if n is None else str(n) for n in shape) + ")"
        raise node.error(f"is {array.dtype} of shape {array.shape}", f"write shape {want}; {SCHEMA}")
    return array.read()


def _pattern(node: Node) -> np.ndarray:
    """(M, 4) electrodes: no negative number, no pair of one electrode with itself."""
    pattern = _small(node, (None, 4), "iu").astype(np.int64)
    pairs = (pattern[:, 0] == pattern[:, 1]) | (pattern[:, 2] == pattern[:, 3])
    bad = pairs | (pattern < 0).any(axis=1)
    if not len(pattern) or bad.any():
        row = int(np.argmax(bad)) if len(pattern) else 0
        what = f"row {row} is no measurement" if len(pattern) else "has no rows"
        raise node.error(what, "give drive+, drive-, sense+, sense- as zero-based electrodes")
    return pattern


def _signal(node: Node) -> str:
    """The name of a stream's main variable."""
    name = node.text("signal", "")
    if name:
        return name
    known = {"time", "status", "channel", *STREAM_EXTRAS}
    found = [name for name in node.members() if name not in known]
    if len(found) != 1:
        raise node.error("does not say which variable it holds", "write the attribute `signal`")
    return found[0]


def _unit(node: Node, variable: str) -> Unit:
    """The declared unit; refuses unknown ones and those of another quantity."""
    name = node.text("units")
    if name not in UNITS:
        raise node.error(f"units {printable(name)!r} are not known", f"use one of: {KNOWN_UNITS}")
    expected = VARIABLE_UNIT.get(variable, UNITS[name].si)
    if UNITS[name].si != expected:
        what = f"{variable} in {name} is mislabelled"
        raise node.error(what, f"use units of {expected}, or another variable name")
    return UNITS[name]


def _clock(node: Node) -> ClockTable:
    """One member of /clocks."""
    host, ticks = _column(node, "host_ns", "i8"), _column(node, "device_ticks", "u8")
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


def _column(node: Node, name: str, dtype: str) -> np.ndarray | tuple[str, ...]:
    """One column of a table, as numbers of `dtype` or as texts."""
    member = _needed(node, name, node.dataset(name))
    kinds = {"f": "fiu", "S": "S"}.get(dtype[0], "iu")
    values = _small(member, (None,), kinds)
    if dtype == "S":
        with translated(node.path, member.where):
            return tuple(v.decode() for v in values.tolist())
    if name != "reason" and dtype[0] == "f":
        unit = _unit(member, "")
        return values * unit.factor + unit.offset
    return values.astype(dtype)


__all__ = ["Session", "Status", "Stream", "check_version", "open_session"]
