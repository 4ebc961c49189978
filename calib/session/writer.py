"""Write a session file, streams row by row; the file appears whole or not at all."""

import os
import re
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from calib.session.errors import SessionError, printable, problem
from calib.session.facts import SessionFacts, StreamFacts
from calib.session.hdf5.datasets import (
    AttributeValue,
    GrowingArray,
    attach,
    make_array,
    make_group,
    make_index,
    put_attributes,
    text_array,
)
from calib.session.hdf5.new_files import FileWriter
from calib.session.mixing import checked_mixing, count_readings, terms_of_mixing
from calib.session.outputs import require_no_session
from calib.session.tables import (
    CLOCK_ATTRIBUTES,
    MIXED_VERSION,
    PRESS_COLUMNS,
    SESSION_FORMAT,
    SESSION_VERSION,
    STREAM_EXTRAS,
    ClockTable,
    Column,
    Events,
    PressTable,
    Status,
)
from calib.session.units import UNITS, VARIABLE_UNIT

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
RESERVED = {"time", "status", "channel", *STREAM_EXTRAS}
STREAM_TYPES = {"f4", "f8", "i2", "i4"}


def program() -> str:
    """Name and version of this program, as files state their creator."""
    try:
        return f"jaxeit {metadata.version('jaxeit')}"
    except metadata.PackageNotFoundError:
        return "jaxeit"


@dataclass
class _Stream:
    """One stream while it is written."""

    group: h5py.Group
    variable: str
    channels: int
    dtype: np.dtype
    scale: float
    offset: float
    attrs: dict[str, AttributeValue]
    columns: dict[str, GrowingArray]
    last: int | None = None


class SessionWriter(FileWriter):
    """Write a session file; use it as a context manager.

    The file appears only when the block ends without an error, complete and synced to disk. After an error no file is
    left, and an existing file is unchanged. Two sessions of equal content, `session_id` and `epoch` are equal byte by
    byte.

    Raises:
        SessionError: for data that the format cannot hold, and where a recording lies at the path, which would be lost;
            an imported session, which can be made again, only gives way to one that is not simulated.
    """

    session = True

    def __init__(self, path: str | os.PathLike[str], facts: SessionFacts):
        super().__init__(Path(path))
        require_no_session(self.path, simulated_too=False, imported_too=facts.simulated)
        self._epoch = _utc(self.path, facts.epoch)
        if facts.simulated and (facts.scene is None or facts.seed is None):
            raise self._problem("scene", "a simulated session does not say how", "give scene, seed")
        self._facts = facts
        self._protocol = _protocol(self.path, facts)
        self._streams: dict[str, _Stream] = {}
        self._presses: PressTable | None = None
        self._truth: dict[str, tuple[np.ndarray, str]] = {}
        self._events: list[Events] = []
        self._clocks: dict[str, ClockTable] = {}

    def _root(self) -> dict[str, AttributeValue]:
        facts = self._facts
        out: dict[str, AttributeValue] = {
            "format": SESSION_FORMAT,
            "format_version": SESSION_VERSION if facts.mixing is None else MIXED_VERSION,
            "Conventions": "CF-1.11",
            "NX_class": "NXroot",
            "session_id": facts.session_id or str(uuid.uuid4()),
            "title": facts.title,
            "created_utc": self._epoch,
            "time_epoch_utc": self._epoch,
            "creator": facts.creator or program(),
            "license": facts.license,
            "recovered": bool(facts.recovered),
            "simulated": bool(facts.simulated),
        }
        out |= {} if facts.scene is None else {"scene": facts.scene}
        return out | ({} if facts.seed is None else {"seed": facts.seed})

    def _problem(self, where: str, what: str, todo: str) -> SessionError:
        return problem(self.path, where, what, todo)

    # --- the file's life -----------------------------------------------------------------------

    def _start(self, file: h5py.File) -> None:
        put_attributes(file, self._root())
        self._write_device(file)
        make_group(file, "streams", {"NX_class": "NXcollection"})

    def _finish(self, file: h5py.File) -> None:
        if not self._streams:
            raise self._problem("/streams", "the session has no stream", "add at least one")
        for stream in self._streams.values():
            self._finish_stream(stream)
        self._write_presses(file)
        self._write_events(file)
        self._write_truth(file)
        self._write_clocks(file)
        put_attributes(file, {"complete": bool(self._facts.complete)})

    # --- what the session is about -------------------------------------------------------------

    def _write_device(self, file: h5py.File) -> None:
        about = {"NX_class": "NXinstrument", "skin": self._facts.skin_name, "skin_toml": self._facts.skin_toml}
        device = make_group(file, "device", about)
        if not self._protocol:
            return
        numbers = {k: v for k, v in self._protocol.items() if isinstance(v, float)}
        group = make_group(device, "eit_protocol", {"NX_class": "NXcollection", **numbers})
        pattern = self._protocol["pattern"]
        mixing = self._protocol.get("mixing")
        rows = make_index(group, "measurement" if mixing is None else "row", len(pattern))
        readings = rows if mixing is None else make_index(group, "measurement", mixing.shape[0])
        terminals = make_index(group, "terminal", 4)
        meaning = "electrodes (zero-based): drive+, drive-, sense+, sense-"
        attrs = {"units": "1", "long_name": meaning}
        attach(make_array(group, "pattern" if mixing is None else "row_pattern", pattern, attrs), rows, terminals)
        if "offset" in self._protocol:
            attrs = {"units": "s", "long_name": "when in the scan each reading is taken"}
            attach(make_array(group, "offset", self._protocol["offset"], attrs), readings)
        if mixing is not None:
            _write_mixing(group, mixing)

    def _time_attrs(self, meaning: str) -> dict[str, str]:
        units = f"nanoseconds since {self._epoch}"
        return {"units": units, "long_name": meaning, "calendar": "standard"}

    # --- streams -------------------------------------------------------------------------------

    def add_stream(self, name: str, facts: StreamFacts) -> None:
        """Declare a stream.

        Values are in SI units. Integer types are packed as ``stored = (value - add_offset) / scale_factor`` (CF), their
        lowest number meaning missing.
        """
        where, dtype = f"/streams/{name}", np.dtype(facts.dtype)
        variable, channels = facts.variable, facts.channels
        for text in (name, variable):
            if not NAME.fullmatch(text) or text in RESERVED or name in self._streams:
                raise self._problem(where, f"name {text!r} cannot be used", "use a new plain name")
        self._check_units(where, variable, facts.units)
        kind = f"{dtype.kind}{dtype.itemsize}"
        if kind not in STREAM_TYPES or channels < 1 or not np.isfinite(facts.rate_hz) or facts.rate_hz <= 0:
            what = f"{channels} channels of {kind} at {facts.rate_hz} Hz cannot be stored"
            raise self._problem(where, what, f"use {sorted(STREAM_TYPES)}, >= 1 channel, a rate > 0")
        scale, offset = self._packing(where, dtype, facts)
        attrs: dict[str, AttributeValue] = {"NX_class": "NXdata", "signal": variable}
        attrs["axes"] = ["time", "channel"]
        attrs |= {"nominal_rate_hz": float(facts.rate_hz), "clock": facts.clock, "transport": facts.transport}
        group = make_group(self._open()["streams"], name, attrs)
        columns = {
            "time": GrowingArray(group, "time", (), np.dtype("i8")),
            variable: GrowingArray(group, variable, (channels,), dtype),
            "status": GrowingArray(group, "status", (), np.dtype("u2")),
        }
        about: dict[str, AttributeValue] = {"units": facts.units}
        about["long_name"] = facts.long_name or f"{name} {variable}"
        self._streams[name] = _Stream(group, variable, channels, dtype, scale, offset, about, columns)

    def _check_units(self, where: str, variable: str, units: str) -> None:
        expected = VARIABLE_UNIT.get(variable, units)
        if units not in UNITS or UNITS[units].si != units or units != expected:
            wanted = VARIABLE_UNIT.get(variable) or (UNITS[units].si if units in UNITS else "an SI unit")
            raise self._problem(where, f"{variable} is given in {units!r}", f"convert it to {wanted} before writing")

    def _packing(self, where: str, dtype: np.dtype, facts: StreamFacts) -> tuple[float, float]:
        units, scale, offset = facts.units, facts.scale_factor, facts.add_offset
        if dtype.kind == "f" and (scale is not None or offset is not None):
            raise self._problem(where, "floats are not packed", "leave scale_factor, add_offset out")
        if dtype.kind == "i" and scale is None and units != "1":
            raise self._problem(where, f"whole {units} are too coarse", "give scale_factor")
        scale, offset = 1.0 if scale is None else float(scale), float(offset or 0.0)
        if not np.isfinite([scale, offset]).all() or scale == 0:
            raise self._problem(where, "scale_factor or add_offset is unusable", "give numbers")
        return scale, offset

    def append(
        self,
        name: str,
        time_ns: ArrayLike,
        values: ArrayLike,
        status: ArrayLike | None = None,
        *,
        time_device: ArrayLike | None = None,
        time_host: ArrayLike | None = None,
        seq: ArrayLike | None = None,
    ) -> None:
        """Add rows: ``time_ns`` (n,) integers since the epoch, ``values`` (n, channels) in SI.

        ``status`` (n,) holds `Status` flags. NaN and infinite values are stored as missing and
        flagged ``nonfinite``; packed values out of range are clipped and flagged ``saturated``.
        ``time_device``, ``time_host`` and ``seq`` (n,) are given with every call or with none.
        """
        if name not in self._streams:
            known = ", ".join(self._streams) or "none yet"
            raise self._problem(f"/streams/{name}", "unknown stream", f"add_stream first ({known})")
        stream = self._streams[name]
        times = self._checked_times(name, stream, time_ns)
        stored, flags = self._stored(name, stream, times, values)
        if status is not None:
            flags = flags | self._column(name, "status", status, len(times), "u2")
        extras = {"time_device": time_device, "time_host": time_host, "seq": seq}
        rows = self._extras(name, stream, extras, len(times))
        rows |= {"time": times, stream.variable: stored, "status": flags}
        for column, block in rows.items():
            stream.columns[column].append(block)
        self._check_disk()
        stream.last = int(times[-1]) if len(times) else stream.last

    def _column(self, name: str, column: str, data: ArrayLike, rows: int, kind: str) -> np.ndarray:
        array = np.asarray(data)
        if array.shape != (rows,) or array.dtype.kind not in "iu":
            what = f"{column} has shape {array.shape} and type {array.dtype}"
            raise self._problem(f"/streams/{name}", what, f"give {rows} integers")
        limits = np.iinfo(kind)
        if array.size and (int(array.min()) < limits.min or int(array.max()) > limits.max):
            what = f"{column} does not fit {np.dtype(kind)}"
            raise self._problem(f"/streams/{name}", what, "check the numbers")
        return array.astype(kind)

    def _extras(
        self, name: str, stream: _Stream, extras: Mapping[str, ArrayLike | None], rows: int
    ) -> dict[str, np.ndarray]:
        given = {k: v for k, v in extras.items() if v is not None}
        if stream.last is None:
            for key in given:
                dtype = np.dtype(STREAM_EXTRAS[key])
                stream.columns.setdefault(key, GrowingArray(stream.group, key, (), dtype))
        expected = set(stream.columns) & set(STREAM_EXTRAS)
        if set(given) != expected:
            what = f"{sorted(given)} given where {sorted(expected)} belong"
            raise self._problem(f"/streams/{name}", what, "give the same columns with every call")
        return {k: self._column(name, k, v, rows, STREAM_EXTRAS[k]) for k, v in given.items()}

    def _checked_times(self, name: str, stream: _Stream, time_ns: ArrayLike) -> np.ndarray:
        times = np.atleast_1d(np.asarray(time_ns))
        rows = len(times) if times.ndim == 1 else 0
        times = self._column(name, "time_ns", times, rows, "i8")
        before = times[:1] - 1 if stream.last is None else np.array([stream.last])
        steps = np.diff(np.concatenate([before[: rows and None], times])) if rows else times[:0]
        if (steps <= 0).any():
            row = int(np.argmax(steps <= 0)) + stream.columns["time"].rows
            what = f"time does not increase at row {row}"
            raise self._problem(f"/streams/{name}", what, "sort the rows, drop equal times")
        return times

    def _stored(
        self, name: str, stream: _Stream, times: np.ndarray, values: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values as stored (n, channels), and the flags that storing them gave rise to (n,)."""
        if np.ma.isMaskedArray(values):
            what = "values of a masked array, whose mask would be lost"
            raise self._problem(f"/streams/{name}", what, "give values.filled(numpy.nan): NaN counts as missing")
        values = np.asarray(values, np.float64)
        if values.ndim == 1:
            values = values.reshape(len(times), -1) if len(times) else values.reshape(0, 1)
        if values.shape != (len(times), stream.channels):
            what = f"values of shape {values.shape}"
            todo = f"give ({len(times)}, {stream.channels}): rows, channels"
            raise self._problem(f"/streams/{name}", what, todo)
        stored, clipped = _packed(values, stream)
        missing = ~np.isfinite(stored) if stored.dtype.kind == "f" else ~np.isfinite(values)
        flags = np.where(missing.any(axis=1), int(Status.nonfinite), 0)
        flags = flags | np.where(clipped.any(axis=1), int(Status.saturated), 0)
        return stored, flags.astype("u2")

    def _finish_stream(self, stream: _Stream) -> None:
        time = stream.columns["time"].finish(self._time_attrs("time of the sample"))
        time.make_scale("time")
        channel = make_index(stream.group, "channel", stream.channels)
        about = stream.attrs
        packed = stream.dtype.kind == "i"
        if packed:
            about = about | {"scale_factor": stream.scale, "add_offset": stream.offset}
        values = stream.columns[stream.variable].finish(about)
        fill = np.iinfo(stream.dtype).min if packed else np.nan
        values.attrs.create("_FillValue", fill, dtype=stream.dtype)
        attach(values, time, channel)
        masks = np.array([int(s) for s in Status], "u2")
        flags = {"units": "1", "flag_meanings": " ".join(str(s.name) for s in Status)}
        status = stream.columns["status"].finish(flags)
        status.attrs.create("flag_masks", masks, dtype="u2")
        attach(status, time)
        for key in (k for k in STREAM_EXTRAS if k in stream.columns):
            attach(stream.columns[key].finish({"units": "1" if key != "time_host" else "ns"}), time)

    # --- tables --------------------------------------------------------------------------------

    def set_presses(self, table: PressTable) -> None:
        """Write the table of presses, one row per press."""
        self._presses = table

    def set_truth(self, truth: Mapping[str, tuple[ArrayLike, str]]) -> None:
        """Write the simulated quantities: name to (numbers, units). Only a simulated session has them."""
        if not self._facts.simulated:
            raise self._problem("/truth", "is for simulated sessions", "give simulated=True")
        for name, (values, units) in truth.items():
            array = np.asarray(values)
            if not NAME.fullmatch(name) or array.dtype.kind not in "biuf" or array.ndim > 3:
                what = f"{printable(name)} of type {array.dtype} and rank {array.ndim}"
                raise self._problem("/truth", what, "give numbers under a plain name")
            array = array.astype("u1") if array.dtype.kind == "b" else array
            self._truth[name] = (array, units)

    def add_events(self, time_ns: ArrayLike, code: ArrayLike, label: Sequence[str]) -> None:
        """Add marks: times (n,) in ns since the epoch, codes (n,) 0..65535, n short texts."""
        times, label = np.atleast_1d(np.asarray(time_ns, "i8")), tuple(label)
        codes = np.atleast_1d(np.asarray(code, "u2"))
        if not times.shape == codes.shape == (len(label),):
            raise self._problem("/events", "columns of unequal length", "give one row per event")
        self._events.append(Events(times, codes, label))

    def set_clock(self, name: str, table: ClockTable) -> None:
        """Write how the clock of the device of the stream `name` was aligned with the clock of the session."""
        if name not in self._streams:
            raise self._problem(f"/clocks/{printable(name)}", "no such stream", "add_stream first")
        self._clocks[name] = table

    def _write_clocks(self, file: h5py.File) -> None:
        parent = make_group(file, "clocks", {"NX_class": "NXcollection"}) if self._clocks else None
        for name, table in self._clocks.items():
            columns = {
                "host_ns": (Column("i8", "time", "when the device counted that"), table.host_ns),
                "device_ticks": (Column("u8", "1", "the device's count, unwrapped"), table.device_ticks),
            }
            group = self._write_table(parent, name, "knot", columns)
            keys = CLOCK_ATTRIBUTES if table.rtt_ns else CLOCK_ATTRIBUTES[:-2]
            put_attributes(group, {key: getattr(table, key) for key in keys})

    def _write_table(
        self, file: h5py.Group, name: str, row: str, columns: Mapping[str, tuple[Column, np.ndarray]]
    ) -> h5py.Group:
        group = make_group(file, name, {"NX_class": "NXcollection"})
        rows = make_index(group, row, len(next(iter(columns.values()))[1]))
        for key, (column, values) in columns.items():
            attrs = {"units": column.units, "long_name": column.meaning}
            if column.units == "time":
                attrs = self._time_attrs(column.meaning)
            attach(make_array(group, key, values, attrs), rows)
        return group

    def _write_presses(self, file: h5py.File) -> None:
        table = self._presses
        if table is None:
            return
        columns = {}
        for name, column in PRESS_COLUMNS.items():
            value = getattr(table, name)
            array = text_array(value) if column.dtype == "S" else value.astype(column.dtype)
            columns[name] = (column, array)
        self._write_table(file, "presses", "press", columns)

    def _write_events(self, file: h5py.File) -> None:
        if not self._events:
            return
        label = [text for e in self._events for text in e.label]
        columns = {
            "time": (Column("i8", "time", "when"), np.concatenate([e.time for e in self._events])),
            "code": (Column("u2", "1", "kind"), np.concatenate([e.code for e in self._events])),
            "label": (Column("S", "", "in words"), text_array(label)),
        }
        self._write_table(file, "events", "event", columns)

    def _write_truth(self, file: h5py.File) -> None:
        if not self._truth:
            return
        group = make_group(file, "truth", {"NX_class": "NXcollection"})
        for name, (values, units) in self._truth.items():
            dataset = make_array(group, name, values, {"units": units})
            scales = [_truth_axis(group, name, axis, n) for axis, n in enumerate(values.shape)]
            attach(dataset, *scales)


def _truth_axis(group: h5py.Group, name: str, axis: int, size: int) -> h5py.Dataset:
    """The index along one axis of a truth array; no two arrays share an axis."""
    return make_index(group, f"{name}.{axis}", size)


def _packed(values: np.ndarray, stream: _Stream) -> tuple[np.ndarray, np.ndarray]:
    """Values in the stream's type, and where they had to be clipped."""
    if stream.dtype.kind == "f":
        largest = np.finfo(stream.dtype).max
        stored = np.where(np.abs(values) <= largest, values, np.nan).astype(stream.dtype)
        return stored, np.zeros(values.shape, bool)
    limits = np.iinfo(stream.dtype)
    finite = np.isfinite(values)
    counts = np.rint((np.where(finite, values, stream.offset) - stream.offset) / stream.scale)
    clipped = (counts < limits.min + 1) | (counts > limits.max)
    counts = np.clip(counts, limits.min + 1, limits.max)
    return np.where(finite, counts, limits.min).astype(stream.dtype), clipped


def _utc(path: Path, epoch: datetime) -> str:
    """ISO text in UTC with microseconds; refuses a time without zone."""
    if epoch.tzinfo is None:
        raise problem(path, "epoch", "has no time zone", "give datetime(..., tzinfo=UTC)")
    try:
        moment = epoch.astimezone(UTC)
    except OverflowError:
        raise problem(path, "epoch", "lies outside of the years 1 to 9999 of UTC", "correct the epoch") from None
    return moment.replace(tzinfo=None).isoformat(timespec="microseconds") + "Z"  # strftime drops zeros of the year


def _write_mixing(group: h5py.Group, mixing: sp.csr_array) -> None:
    """The terms of which readings are sums: reading, row of the pattern, and share of that row."""
    term = make_index(group, "term", mixing.nnz)
    reading, row, share = terms_of_mixing(mixing)
    columns = {
        "term_reading": (reading.astype("i4"), "reading that the term belongs to"),
        "term_row": (row.astype("i4"), "row of the pattern"),
        "term_share": (share.astype("f8"), "share of that row in the reading"),
    }
    for name, (values, meaning) in columns.items():
        attach(make_array(group, name, values, {"units": "1", "long_name": meaning}), term)


def _protocol(path: Path, facts: SessionFacts) -> dict[str, Any]:
    """The protocol's arrays and numbers, checked; empty without a pattern."""
    if facts.pattern is None:
        if any(value is not None for value in (facts.current, facts.frequency, facts.offset, facts.mixing)):
            raise problem(path, "eit_protocol", "has no pattern", "give pattern as well")
        return {}
    array = np.asarray(facts.pattern)
    if array.ndim != 2 or array.shape[1] != 4 or array.dtype.kind not in "iu" or not len(array):
        raise problem(path, "pattern", f"has shape {array.shape}", "give (M, 4) integers")
    if array.min() < 0 or array.max() > np.iinfo("i2").max:
        raise problem(path, "pattern", "names impossible electrodes", "count electrodes from 0")
    found: dict[str, Any] = {"pattern": array.astype("i2")}
    for name, value, least in (("current", facts.current, np.nextafter(0, 1)), ("frequency", facts.frequency, 0.0)):
        if value is not None:
            found[name] = float(value)
            if not least <= found[name] < np.inf:
                raise problem(path, name, f"is {value}", "give a current above zero, a frequency of zero or more")
    if facts.mixing is not None:
        try:
            found["mixing"] = checked_mixing(facts.mixing, len(array))
        except ValueError as error:
            raise problem(path, "mixing", str(error), "give that of jaxeit.Protocol") from None
    if facts.offset is not None:
        found["offset"] = np.asarray(facts.offset, np.float64)
        if (
            found["offset"].shape != (count_readings(array, found.get("mixing")),)
            or not np.isfinite(found["offset"]).all()
        ):
            raise problem(path, "offset", "does not fit the pattern", "give one time per reading")
    return found
