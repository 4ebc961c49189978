"""The checksum of the summary of an MCAP file, which finds damage to its topics, types and index of chunks.

The messages have checksums of their own, one for each chunk, which every reader compares. The summary says where the
chunks lie and which topics they hold, and readers believe it. See <https://mcap.dev/spec>.
"""

import os
from binascii import crc32
from pathlib import Path
from typing import BinaryIO

from ...errors import problem
from ..child import DAMAGED

FOOTER = 37
"""Bytes at the end of a file: opcode, length of the record, start of the summary and of its offsets, CRC, magic."""

SUMMARY_START, CRC, MAGIC = 28, 12, 8
"""Places of fields of the footer, bytes before the end of the file."""

END = b"\x89MCAP0\r\n"
BLOCK = 1 << 20


def require_summary(path: Path) -> None:
    """Refuse an MCAP file that is too short, or whose summary differs from its checksum; one without it passes.

    Raises:
        SessionError: for a file that is damaged.
    """
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        if size < FOOTER:
            raise problem(path, "file", f"ends after {size} bytes", DAMAGED)
        stated = _stated(file)
        if stated and stated != _computed(file):
            raise problem(path, "summary", "differs from its checksum", DAMAGED)


def write_summary_checksum(path: Path) -> None:
    """Put the checksum of the summary of a complete MCAP file into its footer."""
    with open(path, "r+b") as file:
        checksum = _computed(file)
        file.seek(-CRC, os.SEEK_END)
        file.write(checksum.to_bytes(4, "little"))


def _stated(file: BinaryIO) -> int:
    """The checksum in the footer; 0: none, or no footer."""
    file.seek(-CRC, os.SEEK_END)
    checksum, magic = file.read(CRC - MAGIC), file.read(MAGIC)
    return int.from_bytes(checksum, "little") if magic == END else 0


def _computed(file: BinaryIO) -> int:
    """CRC-32 from the start of the summary to the field of the checksum in the footer."""
    stop = file.seek(-CRC, os.SEEK_END)
    file.seek(-SUMMARY_START, os.SEEK_END)
    start = int.from_bytes(file.read(8), "little")
    checksum, place = 0, file.seek(start or stop + CRC - FOOTER)  # without a summary: the footer alone
    while block := file.read(min(BLOCK, max(stop - place, 0))):
        checksum, place = crc32(block, checksum), place + len(block)
    return checksum
