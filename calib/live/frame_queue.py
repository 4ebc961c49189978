"""Frames on their way from the threads that receive them to the thread that computes.

Frames that arrive together are processed one after the other. A frame that has waited for 10 ms while a newer one is
there is dropped and counted.
"""

import threading
import time
from collections import deque

import numpy as np

from ..record.plan import StreamPlan
from ..record.wire.messages import Frame
from .engine import ReceivedFrame

MAX_WAIT = 10_000_000  # ns
MAX_QUEUED_FRAMES = 16
PERIOD_SMOOTHING = 0.1  # weight of a new interval in the mean interval between frames


class FrameQueue:
    """Frames on their way from the threads that receive them to the thread that computes; stale ones are dropped."""

    def __init__(self, pace: StreamPlan, beside: StreamPlan | None = None):
        self._plans = (pace,) if beside is None else (pace, beside)
        self._ready = threading.Condition()
        self._frames: deque[tuple[np.ndarray, int]] = deque()
        self._sum, self._count = np.zeros(0 if beside is None else beside.channels), 0
        self._beside: np.ndarray | None = self._sum if beside is None else None
        self._last, self._period = 0, 0.0
        self.dropped = 0

    def put(self, number: int, frame: Frame, host: int) -> None:
        """Add a frame of stream 0, which sets the pace, or 1; returns at once."""
        values = self._plans[number].in_si(frame.values)
        with self._ready:
            if number:
                self._sum, self._count = self._sum + values, self._count + 1
                return
            self._frames.append((values, host))
            self._drop_stale(host)
            self._period += PERIOD_SMOOTHING * (host - self._last - self._period) if self._last else 0.0
            self._last = host
            self._ready.notify()

    def take(self, timeout: float) -> ReceivedFrame | None:
        """The next frame, after waiting for at most `timeout` s.

        None without a frame, or before the first one of the other stream.
        """
        with self._ready:
            if not self._frames:
                self._ready.wait(timeout)
            self._drop_stale(time.monotonic_ns())
            if self._count:
                self._beside = self._sum / self._count
                self._sum, self._count = np.zeros_like(self._sum), 0
            if not self._frames or self._beside is None:
                return None
            values, host = self._frames.popleft()
            return ReceivedFrame(values, self._beside, host)

    def _drop_stale(self, now: int) -> None:
        """Drop frames that have waited too long; the newest frame stays."""
        while len(self._frames) > 1 and (now - self._frames[0][1] > MAX_WAIT or len(self._frames) > MAX_QUEUED_FRAMES):
            self._frames.popleft()
            self.dropped += 1

    def time_to_next(self) -> float:
        """Time in s until the next frame is expected; 0 if a frame waits."""
        with self._ready:
            if self._frames:
                return 0.0
            return max(0.0, (self._last + self._period - time.monotonic_ns()) / 1e9)
