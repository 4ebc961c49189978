"""A simulated skin as a device: it streams a recording, or any frames, over TCP and pseudo-terminals.

Like real devices, it uses the wire format, sends whether or not anyone listens, and drops whole frames for a listener
that is too slow.
"""

import contextlib
import heapq
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from .broadcast import Broadcaster, Listener, host_and_port, send_to_all
from .sources import session_packets
from .wire.encoding import encode_frame, encode_pong, parse_requests, select_readings

try:
    import tty
except ImportError:  # Windows has no pseudo-terminals
    tty = None  # type: ignore[assignment]

Packets = Iterator[tuple[int, bytes]]
TERMINAL_BACKLOG = 1 << 12  # bytes held for a terminal, which is always connected
MAX_SLEEP = 0.02  # s
REQUEST_LIFETIME = 1.0  # s without a new request, after which the host is assumed to be gone


def frame_packets(number: int, times: Iterable[int], values: Iterable[np.ndarray], *, tick: float = 1e-6) -> Packets:
    """Frames of the stream `number` from rows of `values` (f4 or i2) that are due at `times` (ns)."""
    for seq, (at, row) in enumerate(zip(times, values, strict=True)):
        yield int(at), encode_frame(number, seq, round(at / (1e9 * tick)), row)


def recording_packets(path: str | Path, names: Sequence[str], rounds: int = 1) -> Packets:
    """Frames of several streams of a session file in order of time, played `rounds` times."""
    return heapq.merge(*(session_packets(path, name, rounds=rounds) for name in names), key=lambda packet: packet[0])


class _RequestedReadings:
    """Readings of a stream that its listeners request: all of them without a recent request."""

    def __init__(self) -> None:
        self._readings: np.ndarray | None = None
        self._until = 0.0

    def update(self, listeners: Sequence[Listener], ticks: Callable[[], int]) -> None:
        """Read the requests of the listeners, and answer their pings with the present `ticks`."""
        for listener in listeners:
            listener.tail, found, pings = parse_requests(listener.tail, listener.receive())
            for readings in found.values():
                self._readings, self._until = readings, time.monotonic() + REQUEST_LIFETIME
            if pings:
                send_to_all([listener], [encode_pong(number, sent, ticks()) for number, sent in pings])

    def reduce(self, packet: bytes) -> bytes:
        """Reduce a frame to the requested readings."""
        if self._readings is None or time.monotonic() > self._until:
            return packet
        return select_readings(packet, self._readings)


class SimulatedDevice:
    """Sends packets in real time while its context is entered.

    ``streams`` are iterators of (due time in ns, bytes). Each has its own TCP port on `host` (0 lets the system
    choose), or a pseudo-terminal where ``ports`` holds None. ``speed`` may be above 1.

    After entering, ``urls`` holds the addresses and ``begin`` the start (ns of `time.monotonic_ns`). ``unplug``
    disconnects all listeners until ``plug``; ``done`` is set when everything was sent. A listener may request some
    readings of the frames (`encode_read`); the device then sends only these to all listeners, until a second has
    passed without a request. The clock that answers pings has ticks of 1 us, as recordings and `frame_packets` have.
    """

    def __init__(
        self,
        streams: Sequence[Packets],
        ports: Sequence[int | None] | None = None,
        *,
        host: str = "127.0.0.1",
        speed: float = 1.0,
        wait_for: int = 0,
    ):
        self._streams = streams
        self._ports = [0] * len(streams) if ports is None else ports
        self._host, self._speed, self._wait_for = host, speed, wait_for
        self._stop, self.done = threading.Event(), threading.Event()
        self._unplugged = threading.Event()
        self._threads: list[threading.Thread] = []
        self._stack = contextlib.ExitStack()
        self.urls: list[str] = []
        self.begin = 0
        self.sent = [0] * len(streams)
        self._left = len(streams)
        self._lock = threading.Lock()

    def __enter__(self) -> "SimulatedDevice":
        with contextlib.ExitStack() as stack:
            for number, (stream, port) in enumerate(zip(self._streams, self._ports, strict=True)):
                run = self._terminal(stack) if port is None else self._server(stack, port)
                name = f"device {number}"
                self._threads.append(threading.Thread(target=run, args=(number, stream), name=name, daemon=True))
            self._stack = stack.pop_all()
        self.begin = time.monotonic_ns()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._stack.close()

    def unplug(self) -> None:
        """Disconnect all listeners, and accept none."""
        self._unplugged.set()

    def plug(self) -> None:
        """Accept listeners again."""
        self._unplugged.clear()

    def _server(self, stack: contextlib.ExitStack, port: int) -> Callable[[int, Packets], None]:
        server = stack.enter_context(Broadcaster(self._host, port))
        host, port = server.address
        self.urls.append(f"tcp://{host_and_port(host, port)}")
        return lambda number, stream: self._stream(
            number, stream, server.listeners, lambda: server.accept(self._unplugged.is_set())
        )

    def _terminal(self, stack: contextlib.ExitStack) -> Callable[[int, Packets], None]:
        if tty is None:
            raise OSError("pseudo-terminals need Linux or macOS; give a TCP port")
        ours, theirs = os.openpty()
        stack.callback(os.close, ours)
        stack.callback(os.close, theirs)
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        self.urls.append(f"serial://{os.ttyname(theirs)}")

        def run(number: int, stream: Packets) -> None:
            listener = Listener(
                lambda data: os.write(ours, data[:2048]),
                lambda: None,
                TERMINAL_BACKLOG,
                lambda size: os.read(ours, size),
            )
            self._stream(number, stream, [listener], lambda: None)

        return run

    def _stream(self, number: int, stream: Packets, listeners: list[Listener], accept: Callable[[], None]) -> None:
        while len(listeners) < self._wait_for and not self._stop.wait(0.005):
            accept()
        begin = time.monotonic_ns() if self._wait_for else self.begin
        ahead, requested = next(stream, None), _RequestedReadings()
        while ahead is not None and not self._stop.is_set():
            accept()
            requested.update(listeners, lambda: round((time.monotonic_ns() - begin) * self._speed / 1000))
            due: list[bytes] = []
            now = (time.monotonic_ns() - begin) * self._speed
            while ahead is not None and ahead[0] <= now and len(due) < 1000:
                due.append(requested.reduce(ahead[1]))
                ahead = next(stream, None)
            self.sent[number] += len(due)
            send_to_all(listeners, due)
            if ahead is not None and not due:
                wait = (ahead[0] - now) / self._speed / 1e9
                self._stop.wait(min(max(wait, 0.0), MAX_SLEEP))
        with self._lock:
            self._left -= 1
            if self._left == 0:
                self.done.set()
        while not self._stop.wait(MAX_SLEEP):  # listeners may still take packets that wait for them
            accept()
            send_to_all(listeners, [])
