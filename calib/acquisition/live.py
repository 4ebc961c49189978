"""Live: each frame becomes a force map as it arrives. One thread owns JAX; the others only move bytes.

The newest frame is worked on; those that came while the machine was busy are dropped and counted,
never queued. Levels without contact are the means of the first seconds (`Resting`), and again when asked.
"""

import base64
import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from calib.calibration import Calibration
from calib.maps import force_map

from .plan import Plan, StreamPlan
from .recorder import Nowhere, Recorder, silence
from .sources import Source
from .wire import Frame

_TOUCHED = 3.0  # times its standard error: a force that is there


class LiveError(ValueError):
    """Streams that do not fit the calibration, or do not come."""


class Arrival(NamedTuple):
    """The newest frame: its voltages (readings,), the mean pressure since the last (pads,), when it came (ns)."""

    voltage: np.ndarray
    pressure: np.ndarray
    host: int


class Inbox:
    """Where the threads that read put frames, and the one that computes takes the newest."""

    def __init__(self, eit: StreamPlan, pressure: StreamPlan):
        self._plans = (eit, pressure)
        self._ready = threading.Condition()
        self._frame: tuple[np.ndarray, int] | None = None
        self._sum, self._count = np.zeros(pressure.channels), 0
        self._pressure: np.ndarray | None = None
        self.dropped = 0

    def put(self, number: int, frame: Frame, host: int) -> None:
        """A frame of stream 0 (eit) or 1 (pressure); returns at once."""
        values = self._plans[number].in_si(frame.values)
        with self._ready:
            if number:
                self._sum, self._count = self._sum + values, self._count + 1
                return
            self.dropped += self._frame is not None
            self._frame = (values, host)
            self._ready.notify()

    def take(self, timeout: float) -> Arrival | None:
        """The newest frame, waited for at most `timeout` s; None without one, or before any pressure."""
        with self._ready:
            if self._frame is None:
                self._ready.wait(timeout)
            if self._count:
                self._pressure = self._sum / self._count
                self._sum, self._count = np.zeros_like(self._sum), 0
            if self._frame is None or self._pressure is None:
                return None
            (voltage, host), self._frame = self._frame, None
            return Arrival(voltage, self._pressure, host)


class Resting:
    """Levels without contact: means over `seconds` of frames; missing readings do not count."""

    def __init__(self, seconds: float):
        self._seconds = seconds
        self._since: int | None = None
        self._rows: list[tuple[np.ndarray, np.ndarray]] = []
        self.levels: tuple[np.ndarray, np.ndarray] | None = None

    def add(self, arrival: Arrival) -> None:
        """One more frame without contact."""
        self._since = arrival.host if self._since is None else self._since
        self._rows.append((arrival.voltage, arrival.pressure))
        if arrival.host - self._since >= self._seconds * 1e9:
            self.levels = _mean([v for v, _ in self._rows]), _mean([p for _, p in self._rows])
            self._rows = []


def _mean(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Over rows, of what is finite; NaN where nothing is."""
    block = np.stack(rows)
    good = np.isfinite(block)
    count = good.sum(0)
    return np.where(good, block, 0.0).sum(0) / np.where(count > 0, count, np.nan)


@dataclass(frozen=True, eq=False)
class Result:
    """What one frame says.

    | meaning                                                            | shape    | unit |
    |--------------------------------------------------------------------|----------|------|
    | number of the frame among those worked on                          | ()       |      |
    | host: when it arrived, on the clock that is never set              | ()       | ns   |
    | latency from arrival to this result                                | ()       | s    |
    | force on each pad and its standard_error; NaN without pressure     | (pads,)  | N    |
    | valid: pressure within the calibrated range                        | (pads,)  |      |
    | centre of the force on each pad that is touched, else NaN          | (pads, 2)| m    |
    | map: force on each pixel; it sums to the pads' forces              | (pixels,)| N    |
    | missing: readings that were not finite and taken as unchanged      | ()       |      |
    | dropped: frames not worked on so far                               | ()       |      |
    """

    number: int
    host: int
    latency: float
    force: np.ndarray
    standard_error: np.ndarray
    valid: np.ndarray
    centre: np.ndarray
    map: np.ndarray
    missing: int
    dropped: int

    def to_json(self, *, image: bool = False) -> str:
        """One line for other programs; ``image`` adds the map as base64 of little-endian f4."""
        out: dict[str, object] = {
            "number": self.number,
            "host_ns": self.host,
            "latency_ms": round(1e3 * self.latency, 3),
            "force": _plain(self.force),
            "standard_error": _plain(self.standard_error),
            "valid": self.valid.tolist(),
            "centre": [_plain(row) for row in self.centre],
            "missing": self.missing,
            "dropped": self.dropped,
        }
        if image:
            out["map"] = base64.b64encode(self.map.astype("<f4").tobytes()).decode()
        return json.dumps(out, allow_nan=False)


def _plain(values: np.ndarray) -> list[float | None]:
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in values]


class Engine:
    """Frames to results, by one calibration; only the thread that made it may use it."""

    def __init__(self, calibration: Calibration, rest: float = 2.0):
        self.calibration, self._rest = calibration, rest
        self._resting = Resting(rest)
        self._number = 0
        self._centres, self._areas = np.asarray(calibration.recon.centres), np.asarray(calibration.recon.areas)
        self._owner = np.asarray(calibration.masks.weights)
        blank = np.zeros((1, calibration.recon.readings))
        force_map(calibration, blank, np.zeros((1, len(calibration.skin.pads))))  # compiled before the first frame

    @property
    def resting(self) -> bool:
        """Whether levels without contact are still being taken."""
        return self._resting.levels is None

    def tare(self) -> None:
        """Take the levels without contact anew."""
        self._resting = Resting(self._rest)

    def step(self, arrival: Arrival, dropped: int = 0) -> Result | None:
        """What a frame says; None while levels are taken."""
        if self._resting.levels is None:
            self._resting.add(arrival)
            return None
        voltage = arrival.voltage - self._resting.levels[0]
        pressure = arrival.pressure - self._resting.levels[1]
        lost, silent = ~np.isfinite(voltage), ~np.isfinite(pressure)
        found = force_map(self.calibration, np.where(lost, 0.0, voltage), np.where(silent, 0.0, pressure))
        force = np.where(silent, np.nan, found.force[0])
        error = np.where(silent, np.nan, found.standard_error[0])
        image = np.asarray(found.map.force)[0]
        self._number += 1
        return Result(
            number=self._number,
            host=arrival.host,
            latency=(time.monotonic_ns() - arrival.host) / 1e9,
            force=force,
            standard_error=error,
            valid=np.asarray(found.valid)[0] & ~silent,
            centre=self._centre(image, force > _TOUCHED * error),
            map=image,
            missing=int((lost & np.asarray(self.calibration.recon.channels)).sum()),
            dropped=dropped,
        )

    def _centre(self, image: np.ndarray, touched: np.ndarray) -> np.ndarray:
        """Mean position of the force on each pad."""
        each = self._owner * np.maximum(image, 0.0)
        total = each.sum(1)
        ok = touched & (total > 0)
        middle = each @ self._centres / np.where(ok, total, 1.0)[:, None]
        return np.where(ok[:, None], middle, np.nan)


@dataclass
class Show:
    """What may be asked of a running show: to stop, or to take the levels anew."""

    stop: threading.Event = field(default_factory=threading.Event)
    tare: threading.Event = field(default_factory=threading.Event)
    state: str = "waiting for the devices"


Publish = Callable[[Result], object]


def live(
    calibration: Calibration,
    plan: Plan,
    sources: Sequence[Source],
    publish: Publish,
    show: Show,
    *,
    rest: float = 2.0,
    wait: float = 10.0,
) -> int:
    """Work on frames until told to stop; the number worked on.

    Args:
        plan, sources: of the streams eit and pressure, in this order, from `prepare`.
        publish: told each result; must return at once.
        rest: s without contact at the beginning, from which levels are taken.
        wait: s for the devices to begin.

    Raises:
        LiveError: if the streams do not fit the calibration, do not begin, or fail.
    """
    _check(calibration, sources)
    inbox = Inbox(*(source.plan for source in sources))
    engine = Engine(calibration, rest)
    with Recorder(plan, sources, Nowhere(), inbox.put) as recorder:
        count = _work(engine, inbox, recorder, publish, show, wait)
    if recorder.failure is not None:
        raise LiveError(f"live: {recorder.failure}") from recorder.failure
    return count


def _check(calibration: Calibration, sources: Sequence[Source]) -> None:
    eit, pressure = (source.plan for source in sources)
    readings, pads = calibration.recon.readings, len(calibration.skin.pads)
    if (eit.channels, pressure.channels) != (readings, pads):
        what = f"{eit.channels} readings and {pressure.channels} pressures"
        raise LiveError(
            f"live: {what}, but this calibration is for {readings} and {pads}; give that of the skin at hand"
        )


def _work(engine: Engine, inbox: Inbox, recorder: Recorder, publish: Publish, show: Show, wait: float) -> int:
    count, begun, until = 0, False, time.monotonic() + wait
    while not (show.stop.is_set() or recorder.stop.is_set() or recorder.ended):
        if show.tare.is_set():
            show.tare.clear()
            engine.tare()
        arrival = inbox.take(0.1)
        if arrival is None:
            if not begun and time.monotonic() > until:
                raise LiveError("; ".join(map(silence, recorder.silent)))
            continue
        begun = True
        result = engine.step(arrival, inbox.dropped)
        show.state = "taking the levels without contact: touch nothing" if engine.resting else "running"
        if result is not None:
            count += 1
            publish(result)
    return count
