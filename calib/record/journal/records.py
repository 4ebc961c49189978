"""Payloads of the records of a journal: frames, events, answers to pings, the plan, and the end."""

import enum
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..wire.messages import Frame, Pong
from .file import JournalError

PLAN, EVENT, END, PONG = 0xFFFF, 0xFFFE, 0xFFFD, 0xFFFC  # stream numbers of records that are no frames
# Flags beside those of `Status`: the sequence numbers restarted before this frame, or do not count up to it.
RESTARTED, MISCOUNTED = 1 << 15, 1 << 14
FRAME_HEAD = struct.Struct("<BxxxIQ")
VALUE_TYPES = tuple(np.dtype(t) for t in ("<f4", "<i2", "<f8"))
PONG_BODY = struct.Struct("<HqQ")
HAS_SEQ, HAS_TICKS, LONG_TICKS = 16, 32, 64  # bits of the kind of a frame, beside the index of its type
MAX_LABEL = 1000  # characters of a text from a device or the system


class EventCode(enum.IntEnum):
    """Kind of an event."""

    CONNECTED = 1
    LOST = 2
    CLOCK_STEP = 3
    NOTE = 4
    SIMULATED = 5  # the device reports that its values are simulated; the label holds scene and seed
    FAULT = 6  # what makes the recording incomplete or its time stamps doubtful


def pack_frame(frame: Frame) -> bytes:
    """Pack a frame as a payload; the record holds the number of its stream."""
    kind = VALUE_TYPES.index(frame.values.dtype)
    kind |= (HAS_SEQ if frame.seq is not None else 0) | (HAS_TICKS if frame.ticks is not None else 0)
    kind |= LONG_TICKS if frame.bits == 64 else 0
    return FRAME_HEAD.pack(kind, frame.seq or 0, frame.ticks or 0) + frame.values.tobytes()


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """Frames of one stream with equal layout.

    ``seq`` (n,) u4 and ``ticks`` (n,) u8 are None if the device sends none; ``bits`` is the width of its counter;
    ``values`` (n, channels) are as sent.
    """

    seq: np.ndarray | None
    ticks: np.ndarray | None
    bits: int
    values: np.ndarray


def check_frame(payload: bytes, channels: int) -> None:
    """Raise `JournalError` for a payload that is no frame of so many channels."""
    kind = payload[0] if payload else 0
    size = VALUE_TYPES[kind & 15].itemsize if kind & 15 < len(VALUE_TYPES) else 0
    if not size or len(payload) != FRAME_HEAD.size + channels * size:
        raise JournalError(f"is no frame of {channels} readings")


def check_time(host: int) -> None:
    """Raise `JournalError` for a time (ns) so large that sums of two may not fit 64 bits."""
    if abs(host) >= 2**62:
        raise JournalError(f"came at an impossible time, {host} ns")


def layout_key(payload: bytes) -> tuple[int, int]:
    """Type and size of a frame; frames of one stream with equal keys can be unpacked together."""
    return payload[0], len(payload)


def unpack_frames(payloads: Sequence[bytes]) -> FrameBatch:
    """Unpack frames whose `layout_key` is equal; the inverse of `pack_frame`."""
    kind, size = layout_key(payloads[0])
    dtype = VALUE_TYPES[kind & 15]
    row = np.dtype(
        {
            "names": ["seq", "ticks", "values"],
            "formats": ["<u4", "<u8", (dtype, (size - FRAME_HEAD.size) // dtype.itemsize)],
            "offsets": [4, 8, FRAME_HEAD.size],
            "itemsize": size,
        }
    )
    rows = np.frombuffer(b"".join(payloads), row)
    return FrameBatch(
        rows["seq"] if kind & HAS_SEQ else None,
        rows["ticks"].astype(np.uint64) if kind & HAS_TICKS else None,
        64 if kind & LONG_TICKS else 32,
        rows["values"].reshape(len(rows), -1),
    )


def pack_event(code: EventCode, label: str) -> bytes:
    """Pack an event as a payload."""
    return json.dumps([int(code), label]).encode()


def unpack_event(payload: bytes) -> tuple[EventCode, str]:
    """Unpack an event; the inverse of `pack_event`."""
    code, label = _pair(payload, "event")
    try:
        return EventCode(code), str(label)
    except ValueError as error:
        raise JournalError("is no known event") from error


def pack_pong(stream: int, pong: Pong) -> bytes:
    """Pack the answer of a device to a ping as a payload."""
    return PONG_BODY.pack(stream, *pong)


def unpack_pong(payload: bytes) -> tuple[int, Pong]:
    """Unpack an answer to a ping; the inverse of `pack_pong`."""
    if len(payload) != PONG_BODY.size:
        raise JournalError("is no answer to a ping")
    stream, *pong = PONG_BODY.unpack(payload)
    check_time(pong[0])
    return stream, Pong(*pong)


def pack_end(complete: bool, why: str) -> bytes:
    """Pack the end of a recording: whether it ended as planned, and if not, why."""
    return json.dumps([bool(complete), why]).encode()


def unpack_end(payload: bytes) -> tuple[bool, str]:
    """Unpack the end of a recording; the inverse of `pack_end`."""
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


def storable_text(text: object) -> str:
    """`text` in a form that a session file can store: valid Unicode without zeros, at most 1000 characters."""
    return str(text)[:MAX_LABEL].encode(errors="replace").decode().replace("\0", "?")
