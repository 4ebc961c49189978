"""Framing of binary messages: consistent overhead byte stuffing (COBS) with a closing zero, and a CRC-16."""

import binascii
import struct

CRC = struct.Struct("<H")
CRC_START = 0xFFFF
FULL_BLOCK = 255  # code of a COBS block of 254 bytes, which no zero follows


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, nothing reflected; 0x29B1 for "123456789"."""
    return binascii.crc_hqx(data, CRC_START)


def crc_holds(body: bytes) -> bool:
    """Whether the last two bytes of a message are the CRC-16 of the others."""
    return bool(crc16(body[:-2]) == CRC.unpack(body[-2:])[0])


def cobs_encode(data: bytes) -> bytes:
    """Encode `data` without zeros by consistent overhead byte stuffing: one byte longer, and one more in 254.

    Cheshire and Baker, IEEE/ACM Transactions on Networking 7 (1999).
    """
    out = bytearray()
    for piece in data.split(b"\0"):
        while len(piece) >= FULL_BLOCK - 1:
            out += bytes([FULL_BLOCK]) + piece[: FULL_BLOCK - 1]
            piece = piece[FULL_BLOCK - 1 :]
        out.append(len(piece) + 1)
        out += piece
    return bytes(out)


def cobs_decode(packet: bytes) -> bytes | None:
    """Invert `cobs_encode`; None if `packet`, which must hold no zero, cannot be its result."""
    out, at, size = bytearray(packet), 0, len(packet)
    stuffed = [0]  # positions of code bytes that stand for no zero
    while at < size:
        code = packet[at]
        out[at] = 0
        at += code
        if code == FULL_BLOCK:
            stuffed.append(at)
    if at != size or not size:
        return None
    for at in reversed(stuffed):
        del out[at : at + 1]
    return bytes(out)


def seal(body: bytes) -> bytes:
    """A message as it is sent: body and CRC, encoded by COBS, and the closing zero."""
    return cobs_encode(body + CRC.pack(crc16(body))) + b"\0"
