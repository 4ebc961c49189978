"""A simulated skin as a device: it streams a recording, or any rows, over TCP and pseudo-terminals.

It speaks the wire of real devices, goes on whether or not anyone listens, and drops whole frames, as they
do, for a listener that is too slow.
"""

import contextlib
import heapq
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from .broadcast import Broadcaster, Listener, give
from .sources import packets
from .wire import asked, encode, encode_pong, part_of_scan

try:
    import tty
except ImportError:  # Windows has no pseudo-terminals
    tty = None  # type: ignore[assignment]

Packets = Iterator[tuple[int, bytes]]
_FIFO = 1 << 12  # bytes held for a terminal, which is always there
_TURN = 0.02  # s, the longest sleep
_OBEYED = 1.0  # s, after which a host that says nothing more is taken for gone


def rows(number: int, times: Iterable[int], values: Iterable[np.ndarray], *, tick: float = 1e-6) -> Packets:
    """Frames of the stream `number` from rows of values (f4 or i2) that are due at `times`, ns."""
    for seq, (at, row) in enumerate(zip(times, values, strict=True)):
        yield int(at), encode(number, seq, round(at / (1e9 * tick)), row)


def recording(path: str | Path, names: Sequence[str], rounds: int = 1) -> Packets:
    """Streams of a session file, merged by time; played `rounds` times."""
    return heapq.merge(*(packets(path, name, rounds=rounds) for name in names), key=lambda packet: packet[0])


class _Wanted:
    """Which readings of a stream its listeners want: all of them, unless one has said so of late."""

    def __init__(self) -> None:
        self._readings: np.ndarray | None = None
        self._until = 0.0

    def hear(self, listeners: Sequence[Listener], ticks: Callable[[], int]) -> None:
        """Take in what they ask, and answer their pings with the `ticks` of the moment."""
        for listener in listeners:
            listener.tail, found, pings = asked(listener.tail, listener.heard())
            for readings in found.values():
                self._readings, self._until = readings, time.monotonic() + _OBEYED
            if pings:
                give([listener], [encode_pong(number, sent, ticks()) for number, sent in pings])

    def of(self, packet: bytes) -> bytes:
        """A frame as it is wanted."""
        if self._readings is None or time.monotonic() > self._until:
            return packet
        return part_of_scan(packet, self._readings)


class Device:
    """Streams packets in real time from when it is entered; a context manager.

    ``streams`` are iterators of (due time in ns, bytes), each with a TCP port of its own (0 lets the system
    choose) on `host` or, where ``ports`` holds None, a pseudo-terminal. ``speed`` may be above 1. After
    entering, ``urls`` says where each is to be found, and ``begin`` when it began (ns of `time.monotonic_ns`).
    ``unplug`` disconnects everyone for a while; ``done`` is set when everything was sent. A listener may ask for some
    readings of the frames (`encode_read`), which the device then sends to all, until it has heard nothing for a second;
    pings are answered by the clock of recordings and of `rows` with a tick of 1 us.
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
        self._away = threading.Event()
        self._threads: list[threading.Thread] = []
        self._stack = contextlib.ExitStack()
        self.urls: list[str] = []
        self.begin = 0
        self.sent = [0] * len(streams)
        self._left = len(streams)
        self._lock = threading.Lock()

    def __enter__(self) -> "Device":
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
        """Disconnect everyone, and let no one connect."""
        self._away.set()

    def plug(self) -> None:
        """Be there again."""
        self._away.clear()

    def _server(self, stack: contextlib.ExitStack, port: int) -> Callable[[int, Packets], None]:
        server = stack.enter_context(Broadcaster(self._host, port))
        host, port = server.address
        self.urls.append(f"tcp://{host}:{port}")
        return lambda number, stream: self._stream(
            number, stream, server.listeners, lambda: server.meet(self._away.is_set())
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
                lambda data: os.write(ours, data[:2048]), lambda: None, _FIFO, lambda size: os.read(ours, size)
            )
            self._stream(number, stream, [listener], lambda: None)

        return run

    def _stream(self, number: int, stream: Packets, listeners: list[Listener], meet: Callable[[], None]) -> None:
        while len(listeners) < self._wait_for and not self._stop.wait(0.005):
            meet()
        begin = time.monotonic_ns() if self._wait_for else self.begin
        ahead, wanted = next(stream, None), _Wanted()
        while ahead is not None and not self._stop.is_set():
            meet()
            wanted.hear(listeners, lambda: round((time.monotonic_ns() - begin) * self._speed / 1000))
            due: list[bytes] = []
            now = (time.monotonic_ns() - begin) * self._speed
            while ahead is not None and ahead[0] <= now and len(due) < 1000:
                due.append(wanted.of(ahead[1]))
                ahead = next(stream, None)
            self.sent[number] += len(due)
            give(listeners, due)
            if ahead is not None and not due:
                wait = (ahead[0] - now) / self._speed / 1e9
                self._stop.wait(min(max(wait, 0.0), _TURN))
        with self._lock:
            self._left -= 1
            if self._left == 0:
                self.done.set()
        while not self._stop.wait(_TURN):  # what waits may still be taken
            meet()
            give(listeners, [])
