"""Live: each frame becomes a force map as it arrives. One thread owns JAX; the others only move bytes.

Frames that come together are worked on one after the other; one that has waited for 10 ms while a newer one is there
is dropped and counted. Levels without contact are the means of the first seconds (`engine`), and again when asked.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.calibration import Calibration

from .direct import Director, prepare_director
from .engine import Arrival, Engine
from .plan import Plan, StreamPlan
from .priority import real_time
from .recorder import Log, Nowhere, Recorder, silence
from .results import Result
from .sources import Source
from .wire import Frame

_LATE = 10_000_000  # ns
_MOST = 16  # frames held
_SMOOTH = 0.1  # of a new interval between frames in their mean


class LiveError(ValueError):
    """Streams that do not fit the calibration, or do not come."""


class Inbox:
    """Where the threads that read put frames, and the one that computes takes them while they are new."""

    def __init__(self, eit: StreamPlan, pressure: StreamPlan):
        self._plans = (eit, pressure)
        self._ready = threading.Condition()
        self._frames: deque[tuple[np.ndarray, int]] = deque()
        self._sum, self._count = np.zeros(pressure.channels), 0
        self._pressure: np.ndarray | None = None
        self._last, self._period = 0, 0.0
        self.dropped = 0

    def put(self, number: int, frame: Frame, host: int) -> None:
        """A frame of stream 0 (eit) or 1 (pressure); returns at once."""
        values = self._plans[number].in_si(frame.values)
        with self._ready:
            if number:
                self._sum, self._count = self._sum + values, self._count + 1
                return
            self._frames.append((values, host))
            self._shorten(host)
            self._period += _SMOOTH * (host - self._last - self._period) if self._last else 0.0
            self._last = host
            self._ready.notify()

    def take(self, timeout: float) -> Arrival | None:
        """The next frame, waited for at most `timeout` s; None without one, or before any pressure."""
        with self._ready:
            if not self._frames:
                self._ready.wait(timeout)
            self._shorten(time.monotonic_ns())
            if self._count:
                self._pressure = self._sum / self._count
                self._sum, self._count = np.zeros_like(self._sum), 0
            if not self._frames or self._pressure is None:
                return None
            voltage, host = self._frames.popleft()
            return Arrival(voltage, self._pressure, host)

    def _shorten(self, now: int) -> None:
        """Drop what has waited too long, but the newest."""
        while len(self._frames) > 1 and (now - self._frames[0][1] > _LATE or len(self._frames) > _MOST):
            self._frames.popleft()
            self.dropped += 1

    def due(self) -> float:
        """Seconds until the next frame is expected; 0 if one waits."""
        with self._ready:
            if self._frames:
                return 0.0
            return max(0.0, (self._last + self._period - time.monotonic_ns()) / 1e9)


@dataclass
class Show:
    """What may be asked of a running show: to stop, or to take the levels anew."""

    stop: threading.Event = field(default_factory=threading.Event)
    tare: threading.Event = field(default_factory=threading.Event)
    state: str = "waiting for the devices"
    lost: int = 0  # frames that were sent and did not arrive
    simulated: bool = False  # as a device says of what it sends


Publish = Callable[[Result], object]


def live(
    calibration: Calibration,
    plan: Plan,
    sources: Sequence[Source],
    publish: Publish,
    show: Show,
    *,
    log: Log | None = None,
    event_driven: bool = False,
    realtime: bool = False,
    rest: float = 2.0,
    wait: float = 10.0,
    begun: Callable[[], object] = lambda: None,
) -> int:
    """Work on frames until told to stop; the number worked on.

    Args:
        plan, sources: of the streams eit and pressure, in this order, from `prepare`.
        publish: told each result; must return at once.
        log: where all frames go as they arrive, such as a journal (`kept`); default: nowhere.
        event_driven: whether to tell the device what to read next (`direct`); it must understand.
        realtime: whether to go before all ordinary processes, from when everything is compiled (`priority`).
        rest: s without contact at the beginning, from which levels are taken.
        wait: s for the devices to begin.
        begun: called when everything is compiled, and the devices are listened to.

    Raises:
        LiveError: if the streams do not fit the calibration, do not begin, or fail.
        PriorityError: if ``realtime`` is refused.
    """
    _check(calibration, sources)
    inbox = Inbox(*(source.plan for source in sources))
    engine = Engine(calibration, rest)
    recorder = Recorder(plan, sources, log or Nowhere(), inbox.put)
    director = None
    if event_driven:
        show.state = "choosing the readings of each place"
        director = prepare_director(calibration, sources[0].plan.number, recorder.intakes[0].send)
    with real_time(realtime), recorder:
        begun()
        count = _work(engine, inbox, recorder, publish, show, wait, director)
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


def _work(
    engine: Engine,
    inbox: Inbox,
    recorder: Recorder,
    publish: Publish,
    show: Show,
    wait: float,
    director: Director | None,
) -> int:
    count, begun, until = 0, False, time.monotonic() + wait
    while not (show.stop.is_set() or recorder.stop.is_set() or recorder.ended):
        if show.tare.is_set():
            show.tare.clear()
            engine.tare()
            if director is not None:
                director.whole()
        arrival = inbox.take(0.1)
        if arrival is None:
            if not begun and time.monotonic() > until:
                raise LiveError("; ".join(map(silence, recorder.silent)))
            continue
        begun = True
        result = engine.step(arrival, inbox.dropped)
        show.lost = sum(intake.tally.lost for intake in recorder.intakes)
        show.simulated = any(intake.tally.simulated for intake in recorder.intakes)
        show.state = "taking the levels without contact: touch nothing" if engine.resting else "running"
        if result is not None:
            count += 1
            publish(result)
            if director is not None:
                director.direct(engine.pressed(arrival), result.centre)
            engine.spare(inbox.due())
    return count
