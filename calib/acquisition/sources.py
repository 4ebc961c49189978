"""Where bytes come from: TCP, serial, a recorded session; each opened by its URL.

```
tcp://HOST:PORT                     native sockets
serial:///dev/ttyACM0?baud=115200   pyserial, exclusively; also its loop:// and socket://HOST:PORT
replay://session.h5?speed=2         a recorded session, as if it came over the wire
```

Options after ``?`` describe the stream: ``format`` (binary or csv), ``rate`` (Hz), ``tick`` (s), ``scale``, ``offset``,
``id`` (its number on the wire), ``channels``, ``ping`` (s between pings of a device that answers them). A link waits at
most `POLL` seconds, so that whoever reads from it can be told to stop, and raises OSError when it is lost; opening
it again is up to the reader.
"""

import abc
import re
import select
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from urllib.parse import parse_qsl, unquote, urlsplit

import numpy as np
import serial

from calib.session import Session, Stream, open_session

from .plan import KINDS, StreamPlan
from .wire import Layouts, State, decode, decode_lines, encode, encode_note

POLL = 0.1
CONNECT = 1.0
PIECE = 1 << 16  # bytes of a read at most: what a recorder that is killed may have read and not written
_TOLD = 1_000_000_000  # ns between notes
_NUMBERS = {"rate", "tick", "scale", "offset", "baud", "speed", "ping"}
_WHOLE = {"id", "channels"}
_OPTIONS = _NUMBERS | _WHOLE | {"format"}
_DECODERS = {"binary": decode, "csv": decode_lines}
_PYSERIAL = ("loop", "socket")


class SourceError(ValueError):
    """A URL that names no source."""


class Link(abc.ABC):
    """A connection to a device; ``steady`` if silence means that it must be opened again."""

    steady = False

    @abc.abstractmethod
    def open(self) -> None:
        """Connect; raises OSError."""

    @abc.abstractmethod
    def read(self) -> bytes:
        """What has come, after waiting for at most `POLL` s; EOFError when there will be no more."""

    @abc.abstractmethod
    def close(self) -> None:
        """Disconnect; no error if it is not connected."""

    def write(self, data: bytes) -> None:
        """Send to the device without waiting, as far as it takes it; OSError if it is gone, or cannot hear."""
        raise OSError(None, f"{type(self).__name__} only talks")


class TcpLink(Link):
    """A client of a device that listens. TCP alone may not notice for minutes that its peer is gone."""

    steady = True

    def __init__(self, host: str, port: int):
        self._address = (host, port)
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Connect; raises OSError."""
        found = socket.create_connection(self._address, timeout=CONNECT)
        found.settimeout(POLL)
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self._socket = found

    def read(self) -> bytes:
        """What has come, after waiting for at most `POLL` s."""
        assert self._socket is not None
        try:
            data = self._socket.recv(PIECE)
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
    """A serial port, for us alone. Silence is no reason to open it anew: that resets many boards."""

    def __init__(self, port: str, baud: int = 115200):
        self._name, self._baud = port, baud
        self._port: serial.SerialBase | None = None

    def open(self) -> None:
        """Open the port; raises OSError."""
        native = "://" not in self._name
        try:
            exclusive = True if native else None
            self._port = serial.serial_for_url(
                self._name, self._baud, timeout=POLL, write_timeout=POLL, exclusive=exclusive
            )
        except serial.serialutil.SerialException as error:
            raise OSError(error.errno, f"{self._name}: {error.strerror or error}") from error
        except ValueError as error:
            raise OSError(None, f"{self._name}: {error}") from error

    def read(self) -> bytes:
        """What has come, after waiting for at most `POLL` s."""
        assert self._port is not None
        try:
            data = self._port.read(1)
            return data + self._port.read(min(self._port.in_waiting, PIECE)) if data else data
        except TypeError as error:  # pyserial, when the port is closed by another thread
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
    """A stream of a recorded session as the bytes a device would send, `speed` times as fast."""

    def __init__(self, path: str | Path, plan: StreamPlan, speed: float = 1.0):
        self._path, self._plan, self._speed = Path(path), plan, speed
        self._packets: Iterator[tuple[int, bytes]] = iter(())
        self._start = 0
        self._next: tuple[int, bytes] | None = None

    def open(self) -> None:
        """Begin at the beginning; raises SessionError for what is no session."""
        self._packets = packets(self._path, self._plan.name, self._plan.number)
        self._next = next(self._packets, None)
        first = self._next[0] if self._next is not None else 0
        self._start = time.monotonic_ns() - int(first / self._speed)

    def read(self) -> bytes:
        """The frames that are due, after waiting for at most `POLL` s for the first."""
        if self._next is None:
            raise EOFError("the end of the recording")
        wait = self._start + self._next[0] / self._speed - time.monotonic_ns()
        time.sleep(min(max(wait / 1e9, 0.0), POLL))
        now, out, size = (time.monotonic_ns() - self._start) * self._speed, [], 0
        while self._next is not None and self._next[0] <= now and size < PIECE:
            out.append(self._next[1])
            size += len(out[-1])
            self._next = next(self._packets, None)
        return b"".join(out)

    def close(self) -> None:
        """Stop."""
        self._packets, self._next = iter(()), None


def packets(path: str | Path, name: str, number: int | None = None, rounds: int = 1) -> Iterator[tuple[int, bytes]]:
    """A session's stream as binary frames in SI (f4): when each is due, ns since the epoch, and its bytes.

    After the end it begins again, ``rounds`` times in all, with numbers and ticks going on. Of a simulated session
    a note that says so comes first, and every second.
    """
    with open_session(path) as session:
        stream = session.stream(name)
        number = KINDS[name].number if number is None else number
        turn, told = _duration(session), -_TOLD
        note = encode_note(number, _about(session)) if session.simulated else b""
        for again in range(rounds):
            seq = _seq(stream) + again * (int(_seq(stream)[-1]) + 1 if len(stream) else 0)
            times = stream.time + again * turn
            for start, stop, values in stream.blocks(1 << 20):
                for row, block in zip(range(start, stop), values.astype("<f4"), strict=True):
                    at = int(times[row])
                    if note and at - told >= _TOLD:
                        told = at
                        yield at, note
                    yield at, encode(number, seq[row], at // 1000, block)


def _about(session: Session) -> dict[str, object]:
    """What a device that plays a simulated session says of it: short, as it is said again and again."""
    scene = f"# played by a device from {session.name}, session {session.session_id}"
    return {"simulated": True, "scene": scene, "seed": session.seed}


def _duration(session: Session) -> int:
    """Of a whole session, ns, and a period more: the same for all of its streams."""
    ends = [int(s.time[-1] + np.median(np.diff(s.time))) for s in session.streams.values() if len(s) > 1]
    return max(ends, default=0)


def _seq(stream: Stream) -> np.ndarray:
    return np.arange(len(stream)) if stream.seq is None else stream.seq.astype(np.int64)


@dataclass(frozen=True)
class Source:
    """A stream and where it comes from."""

    plan: StreamPlan
    url: str
    format: str = "binary"
    baud: int = 115200
    speed: float = 1.0
    ping: float = 0.0  # s; 0: the device is sent nothing

    def link(self) -> Link:
        """A connection, not yet open."""
        parts = urlsplit(self.url)
        if parts.scheme == "tcp":
            assert parts.hostname is not None
            assert parts.port is not None
            return TcpLink(parts.hostname, parts.port)
        if parts.scheme == "replay":
            return ReplayLink(unquote(parts.netloc + parts.path), self.plan, self.speed)
        if parts.scheme in _PYSERIAL:
            return SerialLink(f"{parts.scheme}://{parts.netloc}{parts.path}", self.baud)
        return SerialLink(unquote(parts.netloc + parts.path), self.baud)

    @cached_property
    def _layouts(self) -> Layouts:
        return {self.plan.number: self.plan.layout}

    def decode(self, state: State, data: bytes):
        """The frames that end within `data`."""
        return _DECODERS[self.format](self._layouts, state, data)


def source(name: str, url: str, channels: int) -> Source:
    """The stream `name` (a key of `KINDS`) that comes from `url`, of `channels` unless the URL says so.

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
    if format not in _DECODERS:
        raise SourceError(f"{name}: format {format!r} is not known; there are {', '.join(_DECODERS)}")
    speed, baud = float(options.get("speed", 1.0)), int(options.get("baud", 115200))
    ping = float(options.get("ping", 0.0))
    if not speed > 0 or not baud > 0 or not ping >= 0:
        raise SourceError(f"{name}: speed {speed}, baud {baud}, ping {ping}; give numbers above zero")
    return Source(plan, url, format, baud, speed, ping)


def _options(name: str, url: str, query: str) -> dict[str, str | float]:
    found: dict[str, str | float] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):
        if key not in _OPTIONS:
            raise SourceError(f"{name}: {key}= in {url!r} is not known; there are {', '.join(sorted(_OPTIONS))}")
        try:
            found[key] = float(text) if key in _NUMBERS else int(text) if key in _WHOLE else text
        except ValueError:
            raise SourceError(f"{name}: {key}={text} in {url!r} is not a number") from None
    return found


def _check_address(name: str, url: str, parts) -> None:
    try:
        port = parts.port
    except ValueError:
        port = None
    known = ("tcp", "serial", "replay", *_PYSERIAL)
    if parts.scheme not in known:
        raise SourceError(f"{name}: {url!r} names no source; use {', '.join(s + '://' for s in known)}")
    if parts.scheme in ("tcp", "socket") and (not parts.hostname or port is None):
        raise SourceError(f"{name}: {url!r} lacks host or port; use {parts.scheme}://HOST:PORT")
    if parts.scheme in ("serial", "replay") and not parts.netloc + parts.path:
        raise SourceError(f"{name}: {url!r} names no {'port' if parts.scheme == 'serial' else 'file'}")
