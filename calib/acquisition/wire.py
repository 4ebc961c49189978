"""What a device sends, and what is made of it: bytes in, frames out, everything dropped counted.

Two formats, described for firmware writers in ``docs/wire-format.md``: a binary frame (COBS, CRC-16)
and lines of text for quick starts, which carry no checksum. Decoders are pure functions of the bytes so
far, however they were cut, and hold at most one frame's worth of them.
"""

import binascii
import enum
import json
import operator
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

VERSION = 1
MAX_CHANNELS = 16_000
LONGEST = 1 << 16  # bytes of a frame of that many channels, as sent
_HEADS = {32: struct.Struct("<BBII"), 64: struct.Struct("<BBIQ")}
_TYPES: dict[int, np.dtype] = {0: np.dtype("<f4"), 1: np.dtype("<i2")}
_LONG_TICKS, _PART = 2, 4
_NOTE, _READ, _PING, _PONG = (VERSION << 4 | kind for kind in (8, 9, 10, 11))  # messages, not samples
_ECHO = struct.Struct("<qQ")
_CRC = struct.Struct("<H")
_CRC_START = 0xFFFF
_TEXT_BYTES = 32  # what one number in a line may take
_FULL = 255  # a COBS block of 254 bytes, after which no zero is implied


class WireError(ValueError):
    """A frame that cannot be described or sent."""


@dataclass(frozen=True)
class Layout:
    """What frames of one stream must look like to be believed.

    ``stream`` is its number on the wire (0 to 255), ``channels`` the values per frame, ``scale`` the SI
    unit of one count (or of 1.0), ``limit`` the largest magnitude in SI that is possible at all.
    """

    stream: int
    channels: int
    scale: float = 1.0
    limit: float = np.inf

    def __post_init__(self) -> None:
        if not 0 <= self.stream <= 255 or not 1 <= self.channels <= MAX_CHANNELS:
            what = f"stream {self.stream} of {self.channels} channels"
            raise WireError(f"layout: {what}; use a stream of 0..255 and 1..{MAX_CHANNELS} channels")
        if not np.isfinite(self.scale) or self.scale == 0 or not self.limit > 0:
            raise WireError(f"layout: scale {self.scale}, limit {self.limit}; use numbers, limit above zero")


class Frame(NamedTuple):
    """One sample of all channels, as sent: ``values`` are f4, f8 or i2 counts, not yet scaled.

    ``seq`` (modulo 2**32) and ``ticks`` (a counter of ``bits`` bits) are None where a line of text left
    them out; ``checked`` says whether a checksum held; ``resync`` that damaged bytes came before it.
    """

    stream: int
    seq: int | None
    ticks: int | None
    bits: int
    values: np.ndarray
    checked: bool = True
    resync: bool = False


class Pong(NamedTuple):
    """A device's answer to a ping: the host's ns in it, and the device's ticks when it answered."""

    sent: int
    ticks: int


class Counts(NamedTuple):
    """How many frames were good, and how many pieces were dropped for which reason."""

    good: int = 0
    framing: int = 0  # not COBS, or text that is not numbers
    checksum: int = 0
    version: int = 0  # of another version or type
    length: int = 0  # another number of channels
    overlong: int = 0  # no end within the longest frame
    other: int = 0  # sound, but of a stream not asked for
    range: int = 0  # values that cannot be

    def __add__(self, more: tuple[int, ...]) -> "Counts":  # type: ignore[override]
        return Counts(*map(operator.add, self, more))

    @property
    def dropped(self) -> dict[str, int]:
        """Reasons that occurred, with their numbers; frames of other streams are no loss."""
        return {name: n for name, n in zip(self._fields, self, strict=True) if n and name not in ("good", "other")}


class State(NamedTuple):
    """A decoder between two pieces of input.

    ``tail`` has begun but not ended; ``joining`` until a first end is seen, as one joins a device in
    mid-frame; ``skipping`` to the next end after an overlong piece; ``damaged`` since the last frame;
    ``note`` is the last thing that the device said about the stream, ``pong`` its last answer to a ping.
    """

    tail: bytes = b""
    joining: bool = True
    skipping: bool = False
    damaged: bool = False
    counts: Counts = Counts()
    note: str = ""
    pong: Pong | None = None


Layouts = Mapping[int, Layout]


# --- the binary frame ----------------------------------------------------------------------------


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, nothing reflected; of "123456789" 0x29B1."""
    return binascii.crc_hqx(data, _CRC_START)


def cobs_encode(data: bytes) -> bytes:
    """Consistent overhead byte stuffing: `data` without zeros, at most one byte in 254 longer, plus one.

    Cheshire and Baker, IEEE/ACM Transactions on Networking 7 (1999).
    """
    out = bytearray()
    for piece in data.split(b"\0"):
        while len(piece) >= _FULL - 1:
            out += bytes([_FULL]) + piece[: _FULL - 1]
            piece = piece[_FULL - 1 :]
        out.append(len(piece) + 1)
        out += piece
    return bytes(out)


def cobs_decode(packet: bytes) -> bytes | None:
    """What `cobs_encode` was given; None if `packet`, which holds no zero, cannot be its result."""
    out, at, size = bytearray(packet), 0, len(packet)
    stuffed = [0]  # code bytes that stand for no zero
    while at < size:
        code = packet[at]
        out[at] = 0
        at += code
        if code == _FULL:
            stuffed.append(at)
    if at != size or not size:
        return None
    for at in reversed(stuffed):
        del out[at : at + 1]
    return bytes(out)


def encode(stream: int, seq: int, ticks: int, values: np.ndarray, bits: int = 32) -> bytes:
    """One binary frame with its closing zero; `values` (channels,) f4 or i2.

    Raises:
        WireError: for other types or more than 16,000 channels.
    """
    values = np.asarray(values)
    kinds = [number for number, dtype in _TYPES.items() if values.dtype == dtype]
    if not kinds or values.ndim != 1 or not 1 <= len(values) <= MAX_CHANNELS or bits not in _HEADS:
        what = f"values of {values.dtype} and shape {values.shape}, ticks of {bits} bits"
        raise WireError(f"frame: {what}; give f4 or i2, one row, 32 or 64 bits")
    kind = VERSION << 4 | (_LONG_TICKS if bits == 64 else 0) | kinds[0]
    head = _HEADS[bits].pack(kind, stream, int(seq) % 2**32, int(ticks) % 2**bits)
    body = head + values.astype(_TYPES[kinds[0]]).tobytes()
    return _sealed(body)


def encode_note(stream: int, about: Mapping[str, object]) -> bytes:
    """What a device says about a stream, once a second, as one message: ``simulated``, ``scene``, ``seed``.

    Raises:
        WireError: if it is longer than a frame may be.
    """
    body = bytes([_NOTE, stream]) + json.dumps(about).encode()
    if len(body) > LONGEST - 1024:
        raise WireError(f"note: {len(body):,} bytes; keep below {LONGEST - 1024:,}")
    return _sealed(body)


def encode_read(stream: int, readings: np.ndarray) -> bytes:
    """What a host asks of a device: from the next frame on, of this stream, only these readings, (channels,) bool."""
    return _sealed(bytes([_READ, stream]) + _bits(readings))


def encode_ping(stream: int, sent: int) -> bytes:
    """What a host sends at `sent`, ns, for a device to answer at once."""
    return _sealed(bytes([_PING, stream]) + _ECHO.pack(sent, 0)[:8])


def encode_pong(stream: int, sent: int, ticks: int) -> bytes:
    """The answer to a ping, with the count of the clock that stamps this stream's frames."""
    return _sealed(bytes([_PONG, stream]) + _ECHO.pack(sent, ticks % 2**64))


def _sealed(body: bytes) -> bytes:
    return cobs_encode(body + _CRC.pack(crc16(body))) + b"\0"


def _bits(readings: np.ndarray) -> bytes:
    return np.packbits(np.asarray(readings, bool), bitorder="little").tobytes()


def asked(tail: bytes, data: bytes) -> tuple[bytes, dict[int, np.ndarray], list[tuple[int, int]]]:
    """What a device hears: the rest that has not ended, the readings last asked of each stream, and the pings.

    Flags come in whole bytes: (n,) bool with n the number of readings, rounded up to eight; a ping is the number of
    the stream and what is to be sent back.
    """
    *pieces, tail = (tail + data).split(b"\0")
    found: dict[int, np.ndarray] = {}
    pings = []
    for piece in pieces:
        body = cobs_decode(piece) or b""
        if len(body) < 5 or crc16(body[:-2]) != _CRC.unpack(body[-2:])[0]:
            continue
        if body[0] == _READ:
            found[body[1]] = np.unpackbits(np.frombuffer(body[2:-2], np.uint8), bitorder="little").astype(bool)
        elif body[0] == _PING and len(body) == 12:
            pings.append((body[1], int.from_bytes(body[2:10], "little", signed=True)))
    return tail[-LONGEST:], found, pings


def part_of_scan(packet: bytes, readings: np.ndarray) -> bytes:
    """A frame as a device sends it that was asked for some readings only; what is no frame stays as it is."""
    body = cobs_decode(packet[:-1]) or b"\xff"
    dtype = _TYPES.get(body[0] & ~_LONG_TICKS & 0x0F)
    if body[0] >> 4 != VERSION or dtype is None:
        return packet
    head = _HEADS[64 if body[0] & _LONG_TICKS else 32].size
    values = np.frombuffer(body[head:-2], dtype)
    chosen = readings[: len(values)]
    if len(chosen) < len(values):
        return packet
    return _sealed(bytes([body[0] | _PART]) + body[1:head] + _bits(chosen) + values[chosen].tobytes())


def decode(layouts: Layouts, state: State, data: bytes) -> tuple[State, list[Frame]]:
    """The frames that end within `data`, given what came before; binary format."""
    return _decode(layouts, state, data, b"\0", _binary, LONGEST)


def decode_lines(layouts: Layouts, state: State, data: bytes) -> tuple[State, list[Frame]]:
    """The frames that end within `data`; lines of text of the only layout.

    A line holds the values, or ticks and values, or sequence number, ticks and values, separated by
    comma, semicolon, tab or space. Frames are marked as not checked: nothing protects them.
    """
    if len(layouts) != 1:
        raise WireError("lines of text carry no stream number; give one layout")
    if state.joining:  # the first line may be the end of one, and still look whole
        _, end, data = data.partition(b"\n")
        state = state._replace(joining=not end)
    (layout,) = layouts.values()
    return _decode(layouts, state, data, b"\n", _line, _TEXT_BYTES * (layout.channels + 2))


def _decode(layouts, state, data, end, parse, limit) -> tuple[State, list[Frame]]:
    *pieces, tail = (state.tail + data).split(end)
    frames, counts, note, pong = [], state.counts, state.note, state.pong
    joining, skipping, damaged = state.joining, state.skipping, state.damaged
    for piece in pieces:
        if piece and not skipping:  # else it is the rest of an overlong piece, which was counted
            frame, dropped = (None, Counts(overlong=1)) if len(piece) > limit else parse(layouts, piece)
            if isinstance(frame, str):
                note = frame
            elif isinstance(frame, Pong):
                pong = frame
            elif frame is not None:
                frames.append(frame._replace(resync=damaged))
                damaged = False
            elif not joining:
                counts += dropped
                damaged = damaged or bool(dropped.dropped)
        joining = skipping = False
    if len(tail) > limit and not skipping:
        counts += Counts(overlong=0 if joining else 1)
        skipping, damaged = True, damaged or not joining
    counts = counts._replace(good=counts.good + len(frames))
    return State(b"" if skipping else tail, joining, skipping, damaged, counts, note, pong), frames


_NOTHING = Counts()
_Parsed = tuple[Frame | str | Pong | None, Counts]  # a sample, a note, or an answer


def _binary(layouts: Layouts, packet: bytes) -> _Parsed:
    body = cobs_decode(packet)
    if body is None:
        return None, Counts(framing=1)
    if len(body) < 2 + _CRC.size or crc16(body[:-2]) != _CRC.unpack(body[-2:])[0]:
        return None, Counts(checksum=1)
    kind, stream = body[0], body[1]
    dtype = _TYPES.get(kind & ~(_LONG_TICKS | _PART) & 0x0F)
    if kind not in (_NOTE, _PONG) and (kind >> 4 != VERSION or dtype is None):
        return None, Counts(version=1)
    if stream not in layouts:
        return None, Counts(other=1)
    if kind == _PONG:
        return _answered(body)
    return _noted(body) if dtype is None else _sample(layouts[stream], body, dtype)


def _answered(body: bytes) -> _Parsed:
    if len(body) != 2 + _ECHO.size + _CRC.size:
        return None, Counts(length=1)
    return Pong(*_ECHO.unpack_from(body, 2)), _NOTHING


def _noted(body: bytes) -> _Parsed:
    try:
        text = body[2:-2].decode()
        if isinstance(json.loads(text), dict):
            return text, _NOTHING
    except (ValueError, RecursionError):  # of too many brackets
        pass
    return None, Counts(framing=1)


def _sample(layout: Layout, body: bytes, dtype: np.dtype) -> _Parsed:
    kind, bits = body[0], 64 if body[0] & _LONG_TICKS else 32
    head, mask = _HEADS[bits].size, -(-layout.channels // 8) if kind & _PART else 0
    flags = body[head : head + mask]
    read = np.unpackbits(np.frombuffer(flags, np.uint8), bitorder="little").astype(bool)[: layout.channels]
    count = int(read.sum()) if mask else layout.channels
    if len(flags) < mask or len(body) != head + mask + count * dtype.itemsize + _CRC.size:
        return None, Counts(length=1)
    _, _, seq, ticks = _HEADS[bits].unpack_from(body)
    values = np.frombuffer(body, dtype, count, head + mask)
    if mask:
        whole = np.full(layout.channels, np.nan if dtype.kind == "f" else np.iinfo(dtype).min, dtype)
        whole[read] = values
        values = whole
    return _in_range(layout, Frame(layout.stream, seq, ticks, bits, values))


def _in_range(layout: Layout, frame: Frame) -> _Parsed:
    """Values that are finite and too large were never measured; those not finite are missing."""
    if frame.values.dtype.kind == "f":
        size, limit = np.abs(frame.values), layout.limit / abs(layout.scale)
        if not (size <= limit).all() and ((size > limit) & (size < np.inf)).any():
            return None, Counts(range=1)
    return frame, _NOTHING


def _line(layouts: Layouts, line: bytes) -> _Parsed:
    (layout,) = layouts.values()
    words = line.translate(_SEPARATORS).split()
    if not words:
        return None, _NOTHING
    extra = len(words) - layout.channels
    try:
        numbers = np.array([float(word) for word in words[max(extra, 0) :]])
        heads = [int(word) for word in words[: max(extra, 0)][:2]]
    except ValueError:
        return None, Counts(framing=1)
    if not 0 <= extra <= 2:
        return None, Counts(length=1)
    if any(number < 0 or number >= 2**64 for number in heads) or (extra == 2 and heads[0] >= 2**32):
        return None, Counts(range=1)
    ticks = heads[-1] if heads else None
    bits = 64 if ticks is not None and ticks >= 2**32 else 32
    return _in_range(layout, Frame(layout.stream, heads[0] if extra == 2 else None, ticks, bits, numbers, False))


_SEPARATORS = bytes.maketrans(b",;\t\r", b"    ")


# --- the order of frames -------------------------------------------------------------------------

WINDOW = 64  # so far behind, a frame was repeated or overtaken on its way
_FARTHEST = 1 << 20  # more frames than this are not lost at once: the device has begun anew


class Place(enum.Enum):
    """Where a frame belongs: the first three are kept."""

    NEXT = "next"
    GAP = "after a gap"
    RESTART = "after a restart of the device"
    REPEATED = "repeated"
    LATE = "late"
    SUSPECT = "out of sequence"  # believed if the next one follows it

    @property
    def kept(self) -> bool:
        """Whether the frame belongs in the recording."""
        return self in (Place.NEXT, Place.GAP, Place.RESTART)


class Order(NamedTuple):
    """The last number kept, and one far from it that waits to be confirmed."""

    last: int | None = None
    suspect: int | None = None


def follow(order: Order, seq: int) -> tuple[Order, Place, int]:
    """Where the frame `seq` belongs, and how many are missing before it."""
    if order.last is None:
        return Order(seq), Place.NEXT, 0
    ahead = (seq - order.last) % 2**32
    if 1 <= ahead <= _FARTHEST:
        return Order(seq), Place.NEXT if ahead == 1 else Place.GAP, ahead - 1
    if ahead == 0:
        return order, Place.REPEATED, 0
    if ahead >= 2**32 - WINDOW:
        return order, Place.LATE, 0
    if order.suspect is not None and 1 <= (seq - order.suspect) % 2**32 <= WINDOW:
        return Order(seq), Place.RESTART, (seq - order.suspect) % 2**32
    return Order(order.last, seq), Place.SUSPECT, 0
