"""The wire format: layout of the messages between device and host, and the frames that they carry.

``docs/wire-format.md`` describes it for firmware writers. A binary message is framed by COBS and a CRC-16
(`framing`); `encoding` writes messages and `decoding` reads them.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

WIRE_VERSION = 1
MAX_CHANNELS = 16_000
MAX_FRAME_BYTES = 1 << 16  # of a frame of that many channels, as sent
HEADS = {32: struct.Struct("<BBII"), 64: struct.Struct("<BBIQ")}  # by bits of ticks: kind, stream, seq, ticks
VALUE_TYPES: dict[int, np.dtype] = {0: np.dtype("<f4"), 1: np.dtype("<i2")}
LONG_TICKS, PARTIAL = 2, 4  # bits of the kind of a frame: ticks of 64 bits; only some readings
NOTE, READ, PING, PONG = (WIRE_VERSION << 4 | kind for kind in (8, 9, 10, 11))  # kinds of messages that are no frames
ECHO = struct.Struct("<qQ")  # host ns of a ping, ticks of the device


class WireError(ValueError):
    """A frame that cannot be described or sent."""


@dataclass(frozen=True)
class Layout:
    """What frames of one stream must look like; others are dropped.

    | field    | meaning                                                   |
    |----------|-----------------------------------------------------------|
    | stream   | number of the stream on the wire, 0 to 255                |
    | channels | values per frame                                          |
    | scale    | SI value of one count (or of 1.0)                         |
    | limit    | largest possible magnitude in SI                          |
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


Layouts = Mapping[int, Layout]


class Frame(NamedTuple):
    """One sample of all channels as sent: ``values`` are f4, f8 or i2 counts, not yet scaled.

    ``seq`` (modulo 2**32) and ``ticks`` (a counter of ``bits`` bits) are None if a line of text omits them.
    ``checked`` says whether a checksum was verified, ``resync`` whether damaged bytes preceded the frame.
    """

    stream: int
    seq: int | None
    ticks: int | None
    bits: int
    values: np.ndarray
    checked: bool = True
    resync: bool = False


class Pong(NamedTuple):
    """Answer of a device to a ping: the host's ns that the ping carried, and the device's ticks at the answer."""

    sent: int
    ticks: int
