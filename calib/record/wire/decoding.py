"""Decode what a device sends: bytes in, frames out, everything that was dropped counted.

Two formats: binary frames, and lines of text for quick starts, which carry no checksum. Decoders are pure functions
of the bytes so far, however these were cut, and hold at most one frame of them.
"""

import json
import operator
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .framing import CRC, cobs_decode, crc_holds
from .messages import (
    ECHO,
    HEADS,
    LONG_TICKS,
    MAX_FRAME_BYTES,
    NOTE,
    PARTIAL,
    PONG,
    VALUE_TYPES,
    WIRE_VERSION,
    Frame,
    Layout,
    Layouts,
    Pong,
    WireError,
)

MAX_NUMBER_BYTES = 32  # length of one number in a line of text
SEPARATORS = bytes.maketrans(b",;\t\r", b"    ")


class DecoderCounts(NamedTuple):
    """Numbers of good frames and of dropped pieces, by reason."""

    good: int = 0
    framing: int = 0  # not COBS, or text that is not numbers
    checksum: int = 0
    version: int = 0  # another version or type
    length: int = 0  # another number of channels
    overlong: int = 0  # no end within the longest frame
    other: int = 0  # good, but of another stream
    range: int = 0  # impossible values

    def __add__(self, more: tuple[int, ...]) -> "DecoderCounts":  # type: ignore[override]
        return DecoderCounts(*map(operator.add, self, more))

    @property
    def dropped(self) -> dict[str, int]:
        """Numbers of dropped pieces by reason, without zeros. Frames of other streams are no loss."""
        return {name: n for name, n in zip(self._fields, self, strict=True) if n and name not in ("good", "other")}


class DecoderState(NamedTuple):
    """State of a decoder between two pieces of input.

    | field    | meaning                                                                                     |
    |----------|---------------------------------------------------------------------------------------------|
    | tail     | bytes of a message that has not ended                                                       |
    | joining  | no end was seen yet: the connection may have begun in the middle of a message               |
    | skipping | after an overlong piece, until the next end                                                 |
    | damaged  | damaged bytes were dropped since the last frame                                             |
    | counts   | since the connection began                                                                  |
    | note     | last note of the device about the stream                                                    |
    | pong     | last answer of the device to a ping                                                         |
    """

    tail: bytes = b""
    joining: bool = True
    skipping: bool = False
    damaged: bool = False
    counts: DecoderCounts = DecoderCounts()
    note: str = ""
    pong: Pong | None = None


def decode(layouts: Layouts, state: DecoderState, data: bytes) -> tuple[DecoderState, list[Frame]]:
    """Decode the binary frames that end within `data`, given the state after the bytes before."""
    return _decode_pieces(layouts, state, data, b"\0", _parse_packet, MAX_FRAME_BYTES)


def decode_lines(layouts: Layouts, state: DecoderState, data: bytes) -> tuple[DecoderState, list[Frame]]:
    """Decode the lines of text that end within `data`; there must be exactly one layout.

    A line holds the values, or ticks and values, or sequence number, ticks and values, separated by comma,
    semicolon, tab or space. Frames are marked as not checked, because lines carry no checksum.
    """
    if len(layouts) != 1:
        raise WireError("lines of text carry no stream number; give one layout")
    if state.joining:  # the first line may be the end of a longer one, and still look whole
        _, end, data = data.partition(b"\n")
        state = state._replace(joining=not end)
    (layout,) = layouts.values()
    return _decode_pieces(layouts, state, data, b"\n", _parse_line, MAX_NUMBER_BYTES * (layout.channels + 2))


def _decode_pieces(
    layouts: Layouts,
    state: DecoderState,
    data: bytes,
    end: bytes,
    parse: Callable[[Layouts, bytes], "Parsed"],
    limit: int,
) -> tuple[DecoderState, list[Frame]]:
    *pieces, tail = (state.tail + data).split(end)
    frames: list[Frame] = []
    counts, note, pong = state.counts, state.note, state.pong
    joining, skipping, damaged = state.joining, state.skipping, state.damaged
    for piece in pieces:
        if piece and not skipping:  # otherwise it is the rest of an overlong piece, which was counted already
            frame, dropped = (None, DecoderCounts(overlong=1)) if len(piece) > limit else parse(layouts, piece)
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
        counts += DecoderCounts(overlong=0 if joining else 1)
        skipping, damaged = True, damaged or not joining
    counts = counts._replace(good=counts.good + len(frames))
    return DecoderState(b"" if skipping else tail, joining, skipping, damaged, counts, note, pong), frames


NO_DROPS = DecoderCounts()
Parsed = tuple[Frame | str | Pong | None, DecoderCounts]  # a frame, a note, or an answer to a ping; what was dropped


def _parse_packet(layouts: Layouts, packet: bytes) -> Parsed:
    body = cobs_decode(packet)
    if body is None:
        return None, DecoderCounts(framing=1)
    if len(body) < 2 + CRC.size or not crc_holds(body):
        return None, DecoderCounts(checksum=1)
    kind, stream = body[0], body[1]
    dtype = VALUE_TYPES.get(kind & ~(LONG_TICKS | PARTIAL) & 0x0F)
    if kind not in (NOTE, PONG) and (kind >> 4 != WIRE_VERSION or dtype is None):
        return None, DecoderCounts(version=1)
    if stream not in layouts:
        return None, DecoderCounts(other=1)
    if kind == PONG:
        return _parse_pong(body)
    return _parse_note(body) if dtype is None else _parse_frame(layouts[stream], body, dtype)


def _parse_pong(body: bytes) -> Parsed:
    if len(body) != 2 + ECHO.size + CRC.size:
        return None, DecoderCounts(length=1)
    return Pong(*ECHO.unpack_from(body, 2)), NO_DROPS


def _parse_note(body: bytes) -> Parsed:
    try:
        text = body[2:-2].decode()
        if isinstance(json.loads(text), dict):
            return text, NO_DROPS
    except (ValueError, RecursionError):  # RecursionError: too many nested brackets
        pass
    return None, DecoderCounts(framing=1)


def _parse_frame(layout: Layout, body: bytes, dtype: np.dtype) -> Parsed:
    kind, bits = body[0], 64 if body[0] & LONG_TICKS else 32
    head, mask = HEADS[bits].size, -(-layout.channels // 8) if kind & PARTIAL else 0
    flags = body[head : head + mask]
    read = np.unpackbits(np.frombuffer(flags, np.uint8), bitorder="little").astype(bool)[: layout.channels]
    count = int(read.sum()) if mask else layout.channels
    if len(flags) < mask or len(body) != head + mask + count * dtype.itemsize + CRC.size:
        return None, DecoderCounts(length=1)
    _, _, seq, ticks = HEADS[bits].unpack_from(body)
    values = np.frombuffer(body, dtype, count, head + mask)
    if mask:
        whole = np.full(layout.channels, np.nan if dtype.kind == "f" else np.iinfo(dtype).min, dtype)
        whole[read] = values
        values = whole
    return _check_range(layout, Frame(layout.stream, seq, ticks, bits, values))


def _check_range(layout: Layout, frame: Frame) -> Parsed:
    """Drop frames with finite values that are too large to be measured. Values that are not finite are missing."""
    if frame.values.dtype.kind == "f":
        size, limit = np.abs(frame.values), layout.limit / abs(layout.scale)
        if not (size <= limit).all() and ((size > limit) & (size < np.inf)).any():
            return None, DecoderCounts(range=1)
    return frame, NO_DROPS


def _parse_line(layouts: Layouts, line: bytes) -> Parsed:
    (layout,) = layouts.values()
    words = line.translate(SEPARATORS).split()
    if not words:
        return None, NO_DROPS
    extra = len(words) - layout.channels
    try:
        numbers = np.array([float(word) for word in words[max(extra, 0) :]])
        heads = [int(word) for word in words[: max(extra, 0)][:2]]
    except ValueError:
        return None, DecoderCounts(framing=1)
    if not 0 <= extra <= 2:
        return None, DecoderCounts(length=1)
    if any(number < 0 or number >= 2**64 for number in heads) or (extra == 2 and heads[0] >= 2**32):
        return None, DecoderCounts(range=1)
    ticks = heads[-1] if heads else None
    bits = 64 if ticks is not None and ticks >= 2**32 else 32
    return _check_range(layout, Frame(layout.stream, heads[0] if extra == 2 else None, ticks, bits, numbers, False))
