"""Write a session file, streams row by row; the file appears whole or not at all."""

import os
import uuid
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike

from .errors import SessionError, printable, problem
from .facts import SessionFacts, StreamFacts
from .hdf5.datasets import (
    AttributeValue,
    attach,
    make_array,
    make_group,
    make_index,
    put_attributes,
    text_array,
)
from .hdf5.new_files import FileWriter
from .hdf5.protocols import checked_protocol, write_protocol
from .hdf5.stream_writer import NAME, StreamWriter
from .outputs import require_no_session
from .tables import (
    CLOCK_ATTRIBUTES,
    MIXED_VERSION,
    PRESS_COLUMNS,
    SESSION_FORMAT,
    SESSION_VERSION,
    ClockTable,
    Column,
    Events,
    PressTable,
)


def program() -> str:
    """Name and version of this program, as files state their creator."""
    try:
        return f"jaxeit {metadata.version('jaxeit')}"
    except metadata.PackageNotFoundError:
        return "jaxeit"


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
        self._protocol = checked_protocol(self.path, facts)
        self._streams: dict[str, StreamWriter] = {}
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
            stream.finish(self._time_attrs("time of the sample"))
        self._write_presses(file)
        self._write_events(file)
        self._write_truth(file)
        self._write_clocks(file)
        put_attributes(file, {"complete": bool(self._facts.complete)})

    # --- what the session is about -------------------------------------------------------------

    def _write_device(self, file: h5py.File) -> None:
        about = {"NX_class": "NXinstrument", "skin": self._facts.skin_name, "skin_toml": self._facts.skin_toml}
        device = make_group(file, "device", about)
        if self._protocol:
            write_protocol(device, self._protocol)

    def _time_attrs(self, meaning: str) -> dict[str, str]:
        units = f"nanoseconds since {self._epoch}"
        return {"units": units, "long_name": meaning, "calendar": "standard"}

    # --- streams -------------------------------------------------------------------------------

    def add_stream(self, name: str, facts: StreamFacts) -> None:
        """Declare a stream.

        Values are in SI units. Integer types are packed as ``stored = (value - add_offset) / scale_factor`` (CF), their
        lowest number meaning missing.
        """
        if name in self._streams:
            raise self._problem(f"/streams/{name}", f"name {name!r} cannot be used", "use a new plain name")
        self._streams[name] = StreamWriter(self.path, self._open()["streams"], name, facts)

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
        extras = {"time_device": time_device, "time_host": time_host, "seq": seq}
        self._streams[name].append(time_ns, values, status, extras)
        self._check_disk()

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


def _utc(path: Path, epoch: datetime) -> str:
    """ISO text in UTC with microseconds; refuses a time without zone."""
    if epoch.tzinfo is None:
        raise problem(path, "epoch", "has no time zone", "give datetime(..., tzinfo=UTC)")
    try:
        moment = epoch.astimezone(UTC)
    except OverflowError:
        raise problem(path, "epoch", "lies outside of the years 1 to 9999 of UTC", "correct the epoch") from None
    return moment.replace(tzinfo=None).isoformat(timespec="microseconds") + "Z"  # strftime drops zeros of the year
