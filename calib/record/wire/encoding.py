"""Encode messages in both directions, and parse what a device receives."""

import json
from collections.abc import Mapping
from typing import SupportsInt

import numpy as np

from .framing import cobs_decode, crc_holds, seal
from .messages import (
    ECHO,
    HEADS,
    LONG_TICKS,
    MAX_CHANNELS,
    MAX_FRAME_BYTES,
    NOTE,
    PARTIAL,
    PING,
    PONG,
    READ,
    VALUE_TYPES,
    WIRE_VERSION,
    WireError,
)

MAX_NOTE_BYTES = MAX_FRAME_BYTES - 1024


def encode_frame(stream: int, seq: SupportsInt, ticks: SupportsInt, values: np.ndarray, bits: int = 32) -> bytes:
    """One binary frame with its closing zero; `values` (channels,) f4 or i2.

    Raises:
        WireError: for other types or more than 16,000 channels.
    """
    values = np.asarray(values)
    kinds = [number for number, dtype in VALUE_TYPES.items() if values.dtype == dtype]
    if not kinds or values.ndim != 1 or not 1 <= len(values) <= MAX_CHANNELS or bits not in HEADS:
        what = f"values of {values.dtype} and shape {values.shape}, ticks of {bits} bits"
        raise WireError(f"frame: {what}; give f4 or i2, one row, 32 or 64 bits")
    kind = WIRE_VERSION << 4 | (LONG_TICKS if bits == 64 else 0) | kinds[0]
    head = HEADS[bits].pack(kind, stream, int(seq) % 2**32, int(ticks) % 2**bits)
    return seal(head + values.astype(VALUE_TYPES[kinds[0]]).tobytes())


def encode_note(stream: int, about: Mapping[str, object]) -> bytes:
    """A note of a device about a stream, sent once a second: ``simulated``, ``scene``, ``seed``.

    Raises:
        WireError: if the note is longer than a frame may be.
    """
    body = bytes([NOTE, stream]) + json.dumps(about).encode()
    if len(body) > MAX_NOTE_BYTES:
        raise WireError(f"note: {len(body):,} bytes; keep below {MAX_NOTE_BYTES:,}")
    return seal(body)


def encode_read(stream: int, readings: np.ndarray) -> bytes:
    """Request of a host: from the next frame on, send only these `readings` (channels,) bool of the stream."""
    return seal(bytes([READ, stream]) + _packed_flags(readings))


def encode_ping(stream: int, sent: int) -> bytes:
    """Ping that a host sends at `sent` (ns), which a device answers at once."""
    return seal(bytes([PING, stream]) + ECHO.pack(sent, 0)[:8])


def encode_pong(stream: int, sent: int, ticks: int) -> bytes:
    """Answer to a ping, with the ticks of the clock that stamps the frames of the stream."""
    return seal(bytes([PONG, stream]) + ECHO.pack(sent, ticks % 2**64))


def _packed_flags(readings: np.ndarray) -> bytes:
    return np.packbits(np.asarray(readings, bool), bitorder="little").tobytes()


def parse_requests(tail: bytes, data: bytes) -> tuple[bytes, dict[int, np.ndarray], list[tuple[int, int]]]:
    """Parse what a device receives, given the `tail` of the bytes before.

    Returns:
        The new tail; the readings last requested of each stream, (n,) bool with n rounded up to a multiple of eight;
        and the pings, as number of the stream and host ns to send back.
    """
    *pieces, tail = (tail + data).split(b"\0")
    found: dict[int, np.ndarray] = {}
    pings = []
    for piece in pieces:
        body = cobs_decode(piece) or b""
        if len(body) < 5 or not crc_holds(body):
            continue
        if body[0] == READ:
            found[body[1]] = np.unpackbits(np.frombuffer(body[2:-2], np.uint8), bitorder="little").astype(bool)
        elif body[0] == PING and len(body) == 12:
            pings.append((body[1], int.from_bytes(body[2:10], "little", signed=True)))
    return tail[-MAX_FRAME_BYTES:], found, pings


def select_readings(packet: bytes, readings: np.ndarray) -> bytes:
    """Reduce a frame to some `readings`, as a device does on request. A message that is no frame stays as it is."""
    body = cobs_decode(packet[:-1]) or b"\xff"
    dtype = VALUE_TYPES.get(body[0] & ~LONG_TICKS & 0x0F)
    if body[0] >> 4 != WIRE_VERSION or dtype is None:
        return packet
    head = HEADS[64 if body[0] & LONG_TICKS else 32].size
    values = np.frombuffer(body[head:-2], dtype)
    chosen = readings[: len(values)]
    if len(chosen) < len(values):
        return packet
    return seal(bytes([body[0] | PARTIAL]) + body[1:head] + _packed_flags(chosen) + values[chosen].tobytes())
