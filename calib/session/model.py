"""The nouns of a session file: status flags, the table of presses, events, and the errors.

Nothing here touches a file. The format itself is described in ``data/schema/README.md``.
"""

import enum
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

FORMAT = "skin-session"
VERSION = "1.0"
STREAM_EXTRAS = {"time_device": "u8", "time_host": "i8", "seq": "u4"}
"""Optional per-sample arrays of a stream and their types (device ticks, monotonic ns, number)."""

_PINGED = ("latency_ns", "rtt_ns")  # only of devices that answer
CLOCK_ATTRIBUTES = ("tick_s", "offset_ns", "drift_ppm", "residual_p95_ns", "valid", "method", *_PINGED)


class SessionError(ValueError):
    """A file or a value cannot be used: ``<file name>: <where>: <what>; <what to do>``."""


def printable(text: object, limit: int = 80) -> str:
    """`text` as one line without control characters: names in a file are not to be trusted."""
    line = "".join(c if c.isprintable() else "?" for c in str(text))
    return line if len(line) <= limit else line[: limit - 3] + "..."


def problem(path: object, where: str, what: str, todo: str) -> SessionError:
    """A `SessionError` in the one form that all of them have."""
    name = printable(Path(str(path)).name or path)
    return SessionError(f"{name}: {printable(where)}: {printable(what, 300)}; {todo}")


class Status(enum.IntFlag):
    """What is known to be wrong with one sample (CF flag masks; 0 is a good sample)."""

    gap_before = 1
    crc_resync = 2
    saturated = 4
    clock_step = 8
    disconnected = 16
    nonfinite = 32
    unchecked = 64


@dataclass(frozen=True)
class Column:
    """One column of a table: its HDF5 type, its units ("time" is ns since the epoch), meaning."""

    dtype: str
    units: str
    meaning: str


PRESS_COLUMNS = {
    "x": Column("f8", "m", "tip position along x, skin frame"),
    "y": Column("f8", "m", "tip position along y, skin frame"),
    "tip_diameter": Column("f8", "m", "diameter of the indenter tip"),
    "target_force": Column("f8", "N", "force asked of the stage, pressing is positive"),
    "t_press": Column("i8", "time", "first contact"),
    "t_hold0": Column("i8", "time", "start of the hold"),
    "t_hold1": Column("i8", "time", "end of the hold"),
    "t_release": Column("i8", "time", "contact lost"),
    "pad": Column("i2", "1", "pad under the tip, -1 unknown"),
    "accepted": Column("u1", "1", "1 if the press may be used"),
    "reason": Column("S", "", "why the press was set aside"),
}


@dataclass(frozen=True)
class PressTable:
    """One row per indentation; every field has one entry per press.

    ``x, y, tip_diameter`` in m, ``target_force`` in N, ``t_*`` in ns since the session's epoch
    (``t_press <= t_hold0 <= t_hold1 <= t_release``), ``pad`` an index (-1 unknown), ``accepted``
    a bool, ``reason`` a text (empty for accepted presses). Raises `SessionError` for columns of
    unequal length, times out of order, or numbers that are not finite.
    """

    x: np.ndarray
    y: np.ndarray
    tip_diameter: np.ndarray
    target_force: np.ndarray
    t_press: np.ndarray
    t_hold0: np.ndarray
    t_hold1: np.ndarray
    t_release: np.ndarray
    pad: np.ndarray
    accepted: np.ndarray
    reason: tuple[str, ...]

    def __post_init__(self) -> None:
        for name, column in PRESS_COLUMNS.items():
            self._set(name, _as_column(name, getattr(self, name), column))
        self._set("accepted", self.accepted.astype(bool))
        self._check()

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check(self) -> None:
        sizes = {f.name: len(getattr(self, f.name)) for f in fields(self)}
        if len(set(sizes.values())) > 1:
            raise SessionError(f"presses: columns of unequal length {sizes}; give one row per press")
        for name in ("x", "y", "tip_diameter", "target_force"):
            bad = ~np.isfinite(getattr(self, name))
            if bad.any():
                row = int(np.argmax(bad))
                raise SessionError(f"presses: {name} of row {row} is not finite; correct that row")
        times = np.stack([self.t_press, self.t_hold0, self.t_hold1, self.t_release])
        bad = (np.diff(times, axis=0) < 0).any(axis=0)
        if bad.any():
            row = int(np.argmax(bad))
            raise SessionError(f"presses: times of row {row} are out of order; correct that row")

    def __len__(self) -> int:
        return len(self.reason)


def _as_column(name: str, value: object, column: Column) -> object:
    """`value` in the column's type, one-dimensional."""
    if column.dtype == "S":
        return tuple(str(v) for v in value)  # type: ignore[attr-defined]
    array = np.asarray(value)
    if array.ndim != 1 or array.dtype.kind not in "biuf":
        raise SessionError(f"presses: {name} is not a one-dimensional array of numbers; give one")
    if column.dtype[0] != "f" and array.dtype.kind == "f":
        raise SessionError(f"presses: {name} must hold integers; round it to {column.dtype}")
    return array.astype(column.dtype)


@dataclass(frozen=True)
class Events:
    """Marks in a recording: ``time`` (n,) int64 ns, ``code`` (n,) uint16, ``label`` n texts."""

    time: np.ndarray
    code: np.ndarray
    label: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.label)


@dataclass(frozen=True)
class ClockTable:
    """How one device's clock lies against the session's: knots to draw straight lines through.

    ``host_ns`` (n,) int64 ns since the session's epoch at ``device_ticks`` (n,) uint64, unwrapped; ``tick_s``
    the nominal length of a tick (s), ``offset_ns`` the time of tick zero by the first knot, ``drift_ppm`` how
    much slower than nominal the device counts, ``residual_p95_ns`` what the lines leave, ``valid`` whether
    the stream's times were made from them; ``latency_ns`` what was taken off as the smallest latency, known to half
    of ``rtt_ns``, the shortest round trip (both 0: not measured). Raises `SessionError` for knots of unequal number.
    """

    host_ns: np.ndarray
    device_ticks: np.ndarray
    tick_s: float
    offset_ns: float
    drift_ppm: float
    residual_p95_ns: float
    valid: bool
    method: str
    latency_ns: float = 0.0
    rtt_ns: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "host_ns", np.atleast_1d(np.asarray(self.host_ns, np.int64)))
        object.__setattr__(self, "device_ticks", np.atleast_1d(np.asarray(self.device_ticks, np.uint64)))
        if self.host_ns.ndim != 1 or self.host_ns.shape != self.device_ticks.shape:
            raise SessionError("clocks: knots of unequal number; give one tick for each time")
        numbers = (self.tick_s, self.offset_ns, self.drift_ppm, self.residual_p95_ns, self.latency_ns, self.rtt_ns)
        if not np.isfinite(numbers).all():
            raise SessionError("clocks: a number is not finite; leave a clock out that was not found")
