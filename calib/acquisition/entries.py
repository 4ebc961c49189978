"""What the records of a recording's journal hold: frames, events, answers to pings, the plan, the end."""

import enum
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from .journal import JournalError
from .wire import Frame, Pong

PLAN, EVENT, END, PONG = 0xFFFF, 0xFFFE, 0xFFFD, 0xFFFC  # stream numbers of what is not a frame
RESTARTED = 1 << 15  # beside the `Status` flags: the device's numbers began anew before this frame
_HEAD = struct.Struct("<BxxxIQ")
_TYPES = tuple(np.dtype(t) for t in ("<f4", "<i2", "<f8"))
_PONG = struct.Struct("<HqQ")
_SEQ, _TICKS, _LONG = 16, 32, 64
_LABEL = 1000  # letters of what a device or a system said


class Code(enum.IntEnum):
    """What happened to a stream."""

    CONNECTED = 1
    LOST = 2
    CLOCK_STEP = 3
    NOTE = 4
    SIMULATED = 5  # the device says that its values are; the label holds scene and seed


def pack_frame(frame: Frame) -> bytes:
    """A frame as a payload: its stream is the record's."""
    kind = _TYPES.index(frame.values.dtype)
    kind |= (_SEQ if frame.seq is not None else 0) | (_TICKS if frame.ticks is not None else 0)
    kind |= _LONG if frame.bits == 64 else 0
    return _HEAD.pack(kind, frame.seq or 0, frame.ticks or 0) + frame.values.tobytes()


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames of one stream, all sent alike: ``seq`` (n,) u4 and ``ticks`` (n,) u8, or None where the device
    sends none; ``bits`` of its counter; ``values`` (n, channels) as sent."""

    seq: np.ndarray | None
    ticks: np.ndarray | None
    bits: int
    values: np.ndarray


def check_frame(payload: bytes, channels: int) -> None:
    """Raises `JournalError` for what `pack_frame` makes of no frame of so many channels."""
    kind = payload[0] if payload else 0
    size = _TYPES[kind & 15].itemsize if kind & 15 < len(_TYPES) else 0
    if not size or len(payload) != _HEAD.size + channels * size:
        raise JournalError(f"is no frame of {channels} readings")


def check_time(host: int) -> None:
    """Raises `JournalError` for ns so large that two of them may not fit 64 bits."""
    if abs(host) >= 2**62:
        raise JournalError(f"came at an impossible time, {host} ns")


def alike(payload: bytes) -> tuple[int, int]:
    """Frames for which this is equal can be unpacked together."""
    return payload[0], len(payload)


def unpack_frames(payloads: Sequence[bytes]) -> Frames:
    """What `pack_frame` was given, of payloads that are `alike`."""
    kind, size = alike(payloads[0])
    dtype = _TYPES[kind & 15]
    row = np.dtype(
        {
            "names": ["seq", "ticks", "values"],
            "formats": ["<u4", "<u8", (dtype, (size - _HEAD.size) // dtype.itemsize)],
            "offsets": [4, 8, _HEAD.size],
            "itemsize": size,
        }
    )
    rows = np.frombuffer(b"".join(payloads), row)
    return Frames(
        rows["seq"] if kind & _SEQ else None,
        rows["ticks"].astype(np.uint64) if kind & _TICKS else None,
        64 if kind & _LONG else 32,
        rows["values"].reshape(len(rows), -1),
    )


def pack_event(code: Code, label: str) -> bytes:
    """An event as a payload."""
    return json.dumps([int(code), label]).encode()


def unpack_event(payload: bytes) -> tuple[Code, str]:
    """What `pack_event` was given."""
    code, label = _pair(payload, "event")
    try:
        return Code(code), str(label)
    except ValueError as error:
        raise JournalError("is no event that is known") from error


def pack_pong(stream: int, pong: Pong) -> bytes:
    """A device's answer to a ping as a payload."""
    return _PONG.pack(stream, *pong)


def unpack_pong(payload: bytes) -> tuple[int, Pong]:
    """What `pack_pong` was given."""
    if len(payload) != _PONG.size:
        raise JournalError("is no answer to a ping")
    stream, *pong = _PONG.unpack(payload)
    check_time(pong[0])
    return stream, Pong(*pong)


def pack_end(complete: bool, why: str) -> bytes:
    """The end of a recording: as planned, or broken off and why."""
    return json.dumps([bool(complete), why]).encode()


def unpack_end(payload: bytes) -> tuple[bool, str]:
    """What `pack_end` was given."""
    complete, why = _pair(payload, "end")
    return bool(complete), str(why)


def _pair(payload: bytes, what: str) -> list[Any]:
    try:
        pair = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise JournalError(f"is no {what}: not JSON") from error
    if not isinstance(pair, list) or len(pair) != 2:
        raise JournalError(f"is no {what}: not a pair")
    return pair


def storable(text: object) -> str:
    """As a text that fits a session: without what is not Unicode, zeros, or more than a thousand letters."""
    return str(text)[:_LABEL].encode(errors="replace").decode().replace("\0", "?")
