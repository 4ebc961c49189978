"""Receive one stream: open its link again and again, place its frames, and append them to the journal."""

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from ..session import Status
from .journal.records import EVENT, MISCOUNTED, PONG, RESTARTED, EventCode, pack_event, pack_frame, pack_pong
from .sources import Link, Source
from .wire.decoding import DecoderCounts, DecoderState
from .wire.encoding import encode_ping
from .wire.messages import Frame
from .wire.sequence import SequencePlace, SequenceState, place_frame

RETRY_INTERVAL = 0.25  # s between attempts to connect
TIMEOUT_PERIODS = 3  # periods of silence after which a link is opened again
MIN_TIMEOUT = 0.5  # s; TCP repeats lost packets only after 0.2 s
FIRST_FRAME_TIMEOUT = 5.0  # s for the first frame of a connection, and while the rate is not known
MIN_RATE_FRAMES = 20  # frames from which the rate is known
MIN_SILENCES = 2  # times in a row that a silent link was opened again, from which this is said
MAX_CLOCK_LEAD = 1.0  # s by which a device's clock may run ahead between two frames and still count time
MAX_LOST = 0.01  # tolerated fraction of lost frames
MAX_REJECTED = 0.01  # tolerated fraction of rejected frames: a device may send some frames again

FrameCallback = Callable[[int, Frame, int], None]


@runtime_checkable
class RecordSink(Protocol):
    """Destination of records: a `Journal`, or `NullSink`."""

    @property
    def size(self) -> int:
        """Number of bytes written."""

    def append(self, stream: int, flags: int, host: int, payload: bytes) -> None:
        """Write one record."""


class NullSink:
    """Discards all records, for a live view without a recording."""

    size = 0

    def append(self, stream: int, flags: int, host: int, payload: bytes) -> None:
        """Discard one record."""


@dataclass
class StreamCounters:
    """State and counts of one stream; written by its thread, read by others."""

    connected: bool = False
    problem: str = ""
    frames: int = 0
    lost: int = 0
    rejected: int = 0  # repeated, late, or out of sequence
    miscounted: int = 0  # kept, though their sequence numbers do not count up
    timeout: float = FIRST_FRAME_TIMEOUT  # s of silence after which a frame is overdue
    connections: int = 0
    silences: int = 0  # links that were opened again because of silence, since frames came steadily
    simulated: bool = False
    earlier: DecoderCounts = field(default_factory=DecoderCounts)  # of links before the present one
    present: DecoderCounts = field(default_factory=DecoderCounts)

    def close_connection(self) -> None:
        """Add the counts of the present link to those of earlier links."""
        self.earlier, self.present = self.earlier + self.present, DecoderCounts()

    @property
    def dropped(self) -> dict[str, int]:
        """Number of dropped pieces by reason."""
        return (self.earlier + self.present).dropped


class StreamReceiver:
    """Receives one stream: opens its link whenever it is lost, and appends its frames to the journal."""

    def __init__(self, number: int, source: Source, journal: RecordSink, on_frame: FrameCallback | None = None):
        self.number, self.source, self.counters = number, source, StreamCounters()
        self._journal, self._on_frame, self._sequence = journal, on_frame, SequenceState()
        self._last_frame: tuple[Frame, int] | None = None  # the last one that was kept, and its arrival (ns)
        self._rejoined = False
        self._link: Link | None = None
        self._last_note = ""
        self.ended = False

    def send(self, data: bytes) -> None:
        """Send to the device if it is connected and can receive; another thread may call this."""
        link = self._link
        if link is not None and self.counters.connected:
            with suppress(OSError):
                link.write(data)

    def run(self, stop: threading.Event) -> None:
        """Receive until `stop` is set or the source ends; raises JournalError if a write fails."""
        self._link = link = self.source.link()
        try:
            while not stop.is_set() and not self.ended:
                self._connect(link, stop)
        finally:
            link.close()
            self.counters.connected = False

    def _connect(self, link: Link, stop: threading.Event) -> None:
        try:
            link.open()
        except OSError as error:
            self.counters.problem = _error_text(error)
            stop.wait(RETRY_INTERVAL)
            return
        self.counters.connected, self.counters.connections = True, self.counters.connections + 1
        self._append_event(EventCode.CONNECTED, f"{self.source.plan.name}: connected")
        try:
            self._receive(link, stop)
        except EOFError:
            self.ended = True
        except OSError as error:
            self.counters.problem = _error_text(error)
            self._append_event(EventCode.LOST, f"{self.source.plan.name}: {self.counters.problem}")
        finally:
            link.close()
            self.counters.connected = False
            self.counters.close_connection()
            self._rejoined = self.counters.frames > 0
        if not self.ended:
            stop.wait(RETRY_INTERVAL)

    def _receive(self, link: Link, stop: threading.Event) -> None:
        state, last_frame = DecoderState(), time.monotonic()
        began, count, timeout = last_frame, 0, max(FIRST_FRAME_TIMEOUT, self._timeout(0.0, 0))
        last_ping = last_frame
        while not stop.is_set():
            if self.source.ping and time.monotonic() - last_ping >= self.source.ping:
                last_ping = time.monotonic()
                self.send(encode_ping(self.source.plan.number, time.monotonic_ns()))
            data = link.read()
            host, now = time.monotonic_ns(), time.monotonic()
            if data:
                state, frames = self.source.decode(state, data)
                self.counters.present = state.counts
                if state.note not in ("", self._last_note):  # empty: none since the link was opened
                    self._note_simulation(state.note)
                if state.pong is not None:
                    self._journal.append(PONG, 0, host, pack_pong(self.number, state.pong))
                    state = state._replace(pong=None)
                for frame in frames:
                    self._take(frame, host)
                if frames:
                    last_frame, count = now, count + len(frames)
                    self.counters.timeout = timeout = self._timeout(now - began, count)
                    self.counters.silences *= count < MIN_RATE_FRAMES
            if link.reopens_when_silent and now - last_frame > timeout:
                self.counters.silences += 1
                raise TimeoutError(
                    f"silent for {now - last_frame:.1f} s" if not data else f"no frame for {now - last_frame:.1f} s"
                )

    def _timeout(self, elapsed: float, count: int) -> float:
        """Time to wait for the next frame (s), from the stated rate or from the rate of the frames so far."""
        rate = self.source.plan.rate
        if not rate and count < MIN_RATE_FRAMES:
            return FIRST_FRAME_TIMEOUT
        return max(TIMEOUT_PERIODS * (1 / rate if rate else elapsed / count), MIN_TIMEOUT)

    def _take(self, frame: Frame, host: int) -> None:
        flags = 0 if frame.checked else int(Status.unchecked)
        flags |= int(Status.crc_resync) if frame.resync else 0
        if frame.seq is not None:
            self._sequence, place, lost = place_frame(self._sequence, frame.seq, self._is_newer(frame, host))
            if not place.kept:
                self.counters.rejected += 1
                return
            self.counters.lost += lost
            self.counters.miscounted += place is SequencePlace.MISCOUNTED
            flags |= int(Status.gap_before) if lost or place is SequencePlace.RESTART else 0
            flags |= RESTARTED if place is SequencePlace.RESTART else 0
            flags |= MISCOUNTED if place is SequencePlace.MISCOUNTED else 0
        if self._rejoined:
            flags |= int(Status.disconnected | Status.gap_before)
            self._rejoined = False
        self._journal.append(self.number, flags, host, pack_frame(frame))
        self.counters.frames += 1
        self._last_frame = frame, host
        if self._on_frame is not None:
            self._on_frame(self.number, frame, host)

    def _is_newer(self, frame: Frame, host: int) -> bool:
        """Whether the device took this frame later than the last one: by its clock, or by new values if that stands."""
        last, arrival = self._last_frame or (frame, host)
        if frame.ticks is None or last.ticks is None:
            return False
        passed = (frame.ticks - last.ticks) % (1 << frame.bits) * self.source.plan.tick
        if passed == 0:
            return not np.array_equal(frame.values, last.values, equal_nan=frame.values.dtype.kind == "f")
        return passed <= (host - arrival) / 1e9 + MAX_CLOCK_LEAD

    def shortfalls(self, now: float) -> Iterator[str]:
        """Why the frames of this stream are not all that its device sent up to `now` (time.monotonic(), s)."""
        counters, name = self.counters, self.source.plan.name
        received = counters.frames + counters.rejected
        if counters.rejected > MAX_REJECTED * received:
            what = f"{counters.rejected:,} of {received:,} frames were rejected, because they repeat earlier ones"
            yield f"{name}: {what} or come after later ones; see docs/wire-format.md"
        if counters.miscounted:
            what = f"the sequence numbers of {counters.miscounted:,} of {received:,} frames do not count up"
            yield f"{name}: {what}, so that lost frames cannot be counted; see docs/wire-format.md"
        if counters.lost > MAX_LOST * received:
            yield f"{name}: {counters.lost:,} frames were lost; check the link"
        silence = 0.0 if self._last_frame is None else now - self._last_frame[1] / 1e9
        if not self.ended and silence > counters.timeout:
            yield f"{name}: no frame came in the last {silence:.1f} s; check the device"

    def _note_simulation(self, note: str) -> None:
        """Record once that the values are simulated; the device repeats its note every second."""
        self._last_note = note
        if json.loads(note).get("simulated"):
            self.counters.simulated = True
            self._journal.append(EVENT, 0, time.monotonic_ns(), pack_event(EventCode.SIMULATED, note))

    def _append_event(self, code: EventCode, text: str) -> None:
        self._journal.append(EVENT, 0, time.monotonic_ns(), pack_event(code, text[:200]))


def _error_text(error: OSError) -> str:
    return " ".join(str(error.strerror or error).split()) or type(error).__name__


def explain_silence(receiver: StreamReceiver) -> str:
    """Why a stream has no frames yet, and what to do."""
    name, url, counters = receiver.source.plan.name, receiver.source.url, receiver.counters
    if not counters.connections:
        return f"{name}: nothing answers at {url} ({counters.problem}); check the device and the address"
    counts = counters.earlier + counters.present
    if counts.dropped:
        reasons = ", ".join(f"{n} with wrong {reason}" for reason, n in counts.dropped.items())
        expected = f"{receiver.source.plan.channels} values, format {receiver.source.format}"
        return f"{name}: {url} sends data, but no frames of {expected} ({reasons}); see docs/wire-format.md"
    if counts.other:
        number = receiver.source.plan.number
        return f"{name}: {url} sends frames of other streams, none of stream {number}; give id="
    return f"{name}: {url} sends nothing; check whether the device is running"


def explain_reopening(receiver: StreamReceiver) -> str:
    """What to do about a link that is opened again and again because its device is silent; empty for any other."""
    plan, counters = receiver.source.plan, receiver.counters
    if counters.silences < MIN_SILENCES:
        return ""
    remedy = "check the device" if plan.rate else "if the device is so slow, give its rate in Hz: ?rate=0.1"
    return (
        f"{plan.name}: no frame comes for {counters.timeout:.2g} s again and again, and the link is opened anew each "
        f"time; {remedy}"
    )
