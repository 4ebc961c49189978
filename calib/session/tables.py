"""Tables and flags of a session file: status flags, presses, events and clocks.

Nothing in this module touches a file. The format itself is described in ``data/schema/README.md``.
"""

import enum
from dataclasses import dataclass, fields

import numpy as np

from .errors import SessionError

SESSION_FORMAT = "skin-session"
SESSION_VERSION = "1.0"
MIXED_VERSION = "1.1"  # of files whose readings are sums of rows of the pattern
STREAM_EXTRAS = {"time_device": "u8", "time_host": "i8", "seq": "u4"}
"""Optional arrays of a stream with one entry per sample, and their types: device ticks, host time, sequence number."""

LATENCY_ATTRIBUTES = ("latency_ns", "rtt_ns")  # only of devices that answer pings
CLOCK_ATTRIBUTES = ("tick_s", "offset_ns", "drift_ppm", "residual_p95_ns", "valid", "method", *LATENCY_ATTRIBUTES)


class Status(enum.IntFlag):
    """Known faults of one sample, as CF flag masks; 0 is a good sample."""

    gap_before = 1  # samples were lost before this one
    crc_resync = 2  # the first sample after a damaged frame
    saturated = 4  # out of range, clipped
    clock_step = 8  # the clock was set
    disconnected = 16  # the device was not there
    nonfinite = 32  # missing
    unchecked = 64  # came over a link without checksum


@dataclass(frozen=True)
class Column:
    """One column of a table: HDF5 type, units ("time" means ns since the epoch) and meaning."""

    dtype: str
    units: str
    meaning: str


PRESS_COLUMNS = {
    "x": Column("f8", "m", "tip position along x, skin frame"),
    "y": Column("f8", "m", "tip position along y, skin frame"),
    "tip_diameter": Column("f8", "m", "diameter of the indenter tip"),
    "target_force": Column("f8", "N", "target force of the stage, pressing is positive"),
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

    | field                                | meaning                                            | unit |
    |--------------------------------------|----------------------------------------------------|------|
    | x, y                                 | position of the tip                                | m    |
    | tip_diameter                         | diameter of the indenter tip                       | m    |
    | target_force                         | target force of the stage                          | N    |
    | t_press, t_hold0, t_hold1, t_release | in this order, since the session's epoch           | ns   |
    | pad                                  | index of the pad under the tip, -1 unknown         |      |
    | accepted, reason                     | whether the press may be used; if not, why         |      |

    Raises:
        SessionError: for columns of unequal length, times out of order, or numbers that are not finite.

    Example:
        column = np.array([0.06, 0.14])  # m
        table = calib.session.PressTable(
            x=column,
            y=column,
            tip_diameter=np.full(2, 0.02),
            target_force=np.full(2, 10.0),
            t_press=np.array([1, 6]) * 10**9,
            t_hold0=np.array([2, 7]) * 10**9,
            t_hold1=np.array([4, 9]) * 10**9,
            t_release=np.array([5, 10]) * 10**9,
            pad=np.array([0, 3]),
            accepted=np.ones(2, bool),
            reason=("", ""),
        )  # for SessionWriter.set_presses
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
        bad = self.tip_diameter < 0
        if bad.any():
            row = int(np.argmax(bad))
            found = self.tip_diameter[row]
            raise SessionError(f"presses: tip_diameter of row {row} is {found:g} m; give 0, not known, or more")
        times = np.stack([self.t_press, self.t_hold0, self.t_hold1, self.t_release])
        bad = (np.diff(times, axis=0) < 0).any(axis=0)
        if bad.any():
            row = int(np.argmax(bad))
            raise SessionError(f"presses: times of row {row} are out of order; correct that row")

    def __len__(self) -> int:
        return len(self.reason)


def _as_column(name: str, value: object, column: Column) -> object:
    """`value` as a one-dimensional array of the column's type, or as a tuple of texts."""
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
    """Marks in a recording: ``time`` (n,) int64 ns, ``code`` (n,) uint16, ``label`` (n texts)."""

    time: np.ndarray
    code: np.ndarray
    label: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.label)


@dataclass(frozen=True)
class ClockTable:
    """Clock of one device against the clock of the session, as knots of a piecewise linear function.

    | field           | meaning                                                                  | unit |
    |-----------------|--------------------------------------------------------------------------|------|
    | host_ns         | times of the knots (n,) int64, since the session's epoch                 | ns   |
    | device_ticks    | device counter at the knots (n,) uint64, unwrapped                       |      |
    | tick_s          | nominal length of a tick                                                 | s    |
    | offset_ns       | time of tick zero, extrapolated from the first knot                      | ns   |
    | drift_ppm       | how much slower than nominal the device counts                           | ppm  |
    | residual_p95_ns | 95 % quantile of the residuals of the fit                                | ns   |
    | valid           | whether the time stamps of the stream were computed from these knots     |      |
    | method          | how the knots were found                                                 |      |
    | latency_ns      | smallest latency, which was subtracted; accurate to half of ``rtt_ns``   | ns   |
    | rtt_ns          | shortest round trip; both are 0 if they were not measured                | ns   |

    Raises:
        SessionError: if the numbers of times and ticks differ, or a number is not finite.
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
            raise SessionError("clocks: a number is not finite; leave out a clock that was not determined")
