"""Sources of streams, given by URLs: TCP, serial ports and recorded sessions.

```
tcp://HOST:PORT                     native sockets
serial:///dev/ttyACM0?baud=115200   pyserial, exclusively; also its loop:// and socket://HOST:PORT
replay://session.h5?speed=2         a recorded session, converted to the wire format
```

Options after ``?`` describe the stream: ``format`` (binary or csv), ``rate`` (Hz), ``tick`` (s), ``scale``, ``offset``,
``id`` (number on the wire), ``channels``, ``ping`` (s between pings to a device that answers them).

A link waits for data at most `POLL_INTERVAL` seconds, so that its reader can be stopped. It raises OSError when the
connection is lost; the reader opens it again.
"""

import abc
import math
import re
import select
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from urllib.parse import SplitResult, parse_qsl, unquote, urlsplit

import numpy as np
import serial

from ..session import Session, Stream, open_session
from ..session.units import SECOND
from .plan import STREAM_KINDS, StreamPlan
from .wire.decoding import DecoderState, decode, decode_lines
from .wire.encoding import encode_frame, encode_note
from .wire.messages import Frame, Layouts

POLL_INTERVAL = 0.1  # s
CONNECT_TIMEOUT = 1.0  # s
MAX_READ_BYTES = 1 << 16  # of one read; a killed recorder loses at most the bytes that it has read and not written
NOTE_INTERVAL = SECOND  # between notes of a simulated recording
FLOAT_OPTIONS = {"rate", "tick", "scale", "offset", "baud", "speed", "ping"}
INTEGER_OPTIONS = {"id", "channels"}
OPTIONS = FLOAT_OPTIONS | INTEGER_OPTIONS | {"format"}
DECODERS = {"binary": decode, "csv": decode_lines}
PYSERIAL_SCHEMES = ("loop", "socket")


class SourceError(ValueError):
    """A URL does not name a source.

    Example:
        from calib.record import SourceError

        try:
            plan_recording({"pressure": "ftp://192.168.0.7?channels=4"}, skin=None)
        except SourceError as error:
            print(error)
    """


class Link(abc.ABC):
    """A connection to a device. ``reopens_when_silent`` says whether silence means that it must be opened again."""

    reopens_when_silent = False

    @abc.abstractmethod
    def open(self) -> None:
        """Connect; raises OSError."""

    @abc.abstractmethod
    def read(self) -> bytes:
        """Received bytes, after waiting for at most `POLL_INTERVAL` s; EOFError at the end of the source."""

    @abc.abstractmethod
    def close(self) -> None:
        """Disconnect; does not raise if the link is not connected."""

    def write(self, data: bytes) -> None:
        """Send to the device what it takes without waiting; OSError if it is gone, or cannot receive."""
        raise OSError(None, f"{type(self).__name__} cannot send to the device")


class TcpLink(Link):
    """A TCP client of a device. TCP alone may not notice for minutes that the device is gone."""

    reopens_when_silent = True

    def __init__(self, host: str, port: int):
        self._address = (host, port)
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Connect; raises OSError."""
        found = socket.create_connection(self._address, timeout=CONNECT_TIMEOUT)
        found.settimeout(POLL_INTERVAL)
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket = found

    def read(self) -> bytes:
        """Received bytes, after waiting for at most `POLL_INTERVAL` s."""
        assert self._socket is not None
        try:
            data = self._socket.recv(MAX_READ_BYTES)
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError("closed by the device")
        return data

    def write(self, data: bytes) -> None:
        """Send to the device what it takes at once."""
        link = self._socket
        if link is None:
            raise OSError(None, "not connected")
        if select.select([], [link], [], 0)[1]:
            link.send(data)

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class SerialLink(Link):
    """A serial port, opened exclusively. Silence does not reopen it, because that resets many boards."""

    def __init__(self, port: str, baud: int = 115200):
        self._name, self._baud = port, baud
        self._port: serial.SerialBase | None = None

    def open(self) -> None:
        """Open the port; raises OSError."""
        native = "://" not in self._name
        try:
            exclusive = True if native else None
            self._port = serial.serial_for_url(
                self._name, self._baud, timeout=POLL_INTERVAL, write_timeout=POLL_INTERVAL, exclusive=exclusive
            )
        except serial.serialutil.SerialException as error:
            raise OSError(error.errno, f"{self._name}: {error.strerror or error}") from error
        except ValueError as error:
            raise OSError(None, f"{self._name}: {error}") from error

    def read(self) -> bytes:
        """Received bytes, after waiting for at most `POLL_INTERVAL` s."""
        assert self._port is not None
        try:
            data: bytes = self._port.read(1)
            return data + self._port.read(min(self._port.in_waiting, MAX_READ_BYTES)) if data else data
        except TypeError as error:  # raised by pyserial if another thread closes the port
            raise OSError(None, "the port was closed") from error

    def write(self, data: bytes) -> None:
        """Send to the device."""
        if self._port is None:
            raise OSError(None, "not connected")
        self._port.write(data)

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None


class ReplayLink(Link):
    """A stream of a recorded session as the bytes that a device would send, `speed` times as fast."""

    def __init__(self, path: str | Path, plan: StreamPlan, speed: float = 1.0):
        self._path, self._plan, self._speed = Path(path), plan, speed
        self._packets: Iterator[tuple[int, bytes]] = iter(())
        self._start = 0
        self._next: tuple[int, bytes] | None = None

    def open(self) -> None:
        """Start at the beginning of the session; raises SessionError for any other file."""
        self._packets = session_packets(self._path, self._plan.name, self._plan.number)
        self._next = next(self._packets, None)
        first = self._next[0] if self._next is not None else 0
        self._start = time.monotonic_ns() - int(first / self._speed)

    def read(self) -> bytes:
        """Frames that are due, after waiting for the first for at most `POLL_INTERVAL` s."""
        if self._next is None:
            raise EOFError("the end of the recording")
        wait = self._start + self._next[0] / self._speed - time.monotonic_ns()
        time.sleep(min(max(wait / 1e9, 0.0), POLL_INTERVAL))
        now, out, size = (time.monotonic_ns() - self._start) * self._speed, [], 0
        while self._next is not None and self._next[0] <= now and size < MAX_READ_BYTES:
            out.append(self._next[1])
            size += len(out[-1])
            self._next = next(self._packets, None)
        return b"".join(out)

    def close(self) -> None:
        """Stop."""
        self._packets, self._next = iter(()), None


def session_packets(
    path: str | Path, name: str, number: int | None = None, rounds: int = 1
) -> Iterator[tuple[int, bytes]]:
    """A stream of a session as binary frames in SI (f4): due time of each frame (ns since the epoch), and its bytes.

    The stream is played ``rounds`` times with increasing sequence numbers and ticks. A simulated session sends a note
    at the beginning and every second.
    """
    with open_session(path) as session:
        stream = session.stream(name)
        number = STREAM_KINDS[name].number if number is None else number
        turn, noted = _round_length(session), -NOTE_INTERVAL
        note = encode_note(number, _simulation_note(session)) if session.simulated else b""
        numbers = _sequence_numbers(stream)
        for round_number in range(rounds):
            seq = numbers + round_number * (int(numbers[-1]) + 1 if len(numbers) else 0)
            times = stream.time + round_number * turn
            for start, stop, values in stream.blocks(1 << 20):
                for row, block in zip(range(start, stop), values.astype("<f4"), strict=True):
                    at = int(times[row])
                    if note and at - noted >= NOTE_INTERVAL:
                        noted = at
                        yield at, note
                    yield at, encode_frame(number, seq[row], at // 1000, block)


def _simulation_note(session: Session) -> dict[str, object]:
    """Note of a device that plays a simulated session; short, because it is sent every second."""
    scene = f"# played by a device from {session.name}, session {session.session_id}"
    return {"simulated": True, "scene": scene, "seed": session.seed}


def _round_length(session: Session) -> int:
    """Length of one round of a session in ns, the same for all of its streams: its duration and one period."""
    ends = [int(s.time[-1] + np.median(np.diff(s.time))) for s in session.streams.values() if len(s) > 1]
    return max(ends, default=0)


def _sequence_numbers(stream: Stream) -> np.ndarray:
    return np.arange(len(stream)) if stream.seq is None else stream.seq.astype(np.int64)


@dataclass(frozen=True)
class Source:
    """A stream and its origin.

    | field  | meaning                                                                 | unit  |
    |--------|-------------------------------------------------------------------------|-------|
    | plan   | of the stream                                                           |       |
    | url    | address of the device or of the file                                    |       |
    | format | of what is sent: "binary" or "csv"                                      |       |
    | baud   | rate of a serial line                                                   | bit/s |
    | speed  | of a replay, over that of the recording                                 | 1     |
    | ping   | time between two pings; 0: the device does not answer pings             | s     |
    """

    plan: StreamPlan
    url: str
    format: str = "binary"
    baud: int = 115200
    speed: float = 1.0
    ping: float = 0.0

    def link(self) -> Link:
        """A connection, not yet open."""
        parts = urlsplit(self.url)
        if parts.scheme == "tcp":
            assert parts.hostname is not None
            assert parts.port is not None
            return TcpLink(parts.hostname, parts.port)
        if parts.scheme == "replay":
            return ReplayLink(unquote(parts.netloc + parts.path), self.plan, self.speed)
        if parts.scheme in PYSERIAL_SCHEMES:
            return SerialLink(f"{parts.scheme}://{parts.netloc}{parts.path}", self.baud)
        return SerialLink(unquote(parts.netloc + parts.path), self.baud)

    @cached_property
    def _layouts(self) -> Layouts:
        return {self.plan.number: self.plan.layout}

    def decode(self, state: DecoderState, data: bytes) -> tuple[DecoderState, list[Frame]]:
        """Decode the frames that end within `data`, in the format of the source."""
        return DECODERS[self.format](self._layouts, state, data)


def source_from_url(name: str, url: str, channels: int) -> Source:
    """The source of the stream `name` (a key of `STREAM_KINDS`) at `url`; `channels` is used unless the URL sets it.

    Raises:
        SourceError: for URLs and options that are not known.
    """
    parts = urlsplit(url)
    options = _options(name, url, parts.query)
    _check_address(name, url, parts)
    plan = StreamPlan(
        name,
        int(options.get("channels", channels)),
        rate=float(options.get("rate", 0.0)),
        scale=float(options.get("scale", 1.0)),
        offset=float(options.get("offset", 0.0)),
        tick=float(options.get("tick", 1e-6)),
        number=int(options.get("id", -1)),
        transport=re.sub(r"\?.*", "", url),
    )
    format = str(options.get("format", "binary"))
    if format not in DECODERS:
        raise SourceError(f"{name}: format {format!r} is not known; use one of {', '.join(DECODERS)}")
    speed, baud = float(options.get("speed", 1.0)), int(options.get("baud", 115200))
    ping = float(options.get("ping", 0.0))
    if not speed > 0 or not baud > 0 or not ping >= 0:
        raise SourceError(f"{name}: speed {speed}, baud {baud}, ping {ping}; give numbers above zero")
    return Source(plan, url, format, baud, speed, ping)


def _options(name: str, url: str, query: str) -> dict[str, str | float]:
    found: dict[str, str | float] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in OPTIONS:
            raise SourceError(f"{name}: {key}= in {url!r} is not known; use one of {', '.join(sorted(OPTIONS))}")
        try:
            found[key] = float(text) if key in FLOAT_OPTIONS else int(text) if key in INTEGER_OPTIONS else text
        except ValueError:
            raise SourceError(f"{name}: {key}={text} in {url!r} is not a number; give one") from None
        if key in FLOAT_OPTIONS and not math.isfinite(float(found[key])):
            raise SourceError(f"{name}: {key}={text} in {url!r} is not a finite number; give one")
        if key == "rate" and not float(found[key]) > 0:
            raise SourceError(f"{name}: rate={text} in {url!r}; give the rate in Hz, above zero, or leave it out")
    return found


def _check_address(name: str, url: str, parts: SplitResult) -> None:
    try:
        port = parts.port
    except ValueError:
        port = 0
    known = ("tcp", "serial", "replay", *PYSERIAL_SCHEMES)
    if parts.scheme not in known:
        raise SourceError(f"{name}: {url!r} names no source; use {', '.join(s + '://' for s in known)}")
    if parts.scheme in ("tcp", "socket") and (not parts.hostname or port is None):
        raise SourceError(f"{name}: {url!r} lacks host or port; use {parts.scheme}://HOST:PORT")
    if port == 0:
        raise SourceError(f"{name}: the port of {url!r} is none; give a number from 1 to 65535")
    if parts.scheme in ("serial", "replay") and not parts.netloc + parts.path:
        raise SourceError(f"{name}: {url!r} names no {'port' if parts.scheme == 'serial' else 'file'}")
