"""Binary files of instruments for the chest: GOE-MF II, its successor of CareFusion, and those of Draeger.

None of the formats has a public description. Facts are those that the reader of EIDORS (``eidors_readdata``) tells, and
what real files show. All have 16 electrodes; neighbours drive, and the other pairs of neighbours are read in rotating
order: `je.skin.adjacent`, of the opposite polarity.

| format               | little-endian | where the 208 readings of a frame are                                  |
|----------------------|---------------|------------------------------------------------------------------------|
| ``.get``, GOE-MF II  | float32       | the first of 256; then 16 currents over 5.12 mA, 16 voltages over 12 V |
| ``.get``, Draeger    | float32       | the same, behind a text that ends in two empty lines                   |
| ``.eit``, CareFusion | float32       | 48 to 255 of the 256 of a record of kind 3                             |
| ``.eit``, Draeger    | float64       | two sets, 1 to 208 and 323 to 530 behind the time of a frame           |

GOE-MF II can leave out each reading whose reciprocal came before; zeros stand in its place.
"""

import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

import jaxeit as je
from jaxeit.budget import require
from jaxeit.files import open_regular
from jaxeit.geometry import Domain
from jaxeit.skin import AbstractElectrode

from .recording import Tank, TankError, tank_of

ELECTRODES, READINGS = 16, 208
NOMINAL_CURRENT = 5e-3  # A

GET_VALUES, GET_CURRENTS, GET_CURRENT_UNIT = 256, slice(208, 224), 5.12e-3  # A
MAX_CURRENT = 0.1  # A; numbers beyond are those of another format

DRAEGER = b"---Draeger EIT-Software"
DRAEGER_TEXT_END = b"\r\n\r\n\r\n"  # of the old .get
DRAEGER_FRAME = {32: 5200, 51: 5495}
"""Bytes of a frame of an .eit, by the version of the format. EIDORS reads version 31 too, of 4112 bytes, where its
second set would reach into the next frame."""
DRAEGER_SETS, DRAEGER_FACTORS = (0, 322), (9.8242e-4, 1.9607e-4)
"""First readings of the two sets, and their factors, by which the difference is that of an old .get: an estimate of
EIDORS (2016), of no known unit."""

CAREFUSION_HEADER = re.compile(r"<Header>(\d{1,9}) bytes</Header>")
FRAME_KIND, IMAGE_KIND, RECORD_HEAD = 3, 7, 6  # heads of 6 int32: kind, channel, number, bytes of a value, values, ?
RECORD_WORDS = {FRAME_KIND: 256, IMAGE_KIND: 912}
CAREFUSION_READINGS = slice(47, 47 + READINGS)


class _Frames(NamedTuple):
    readings: np.ndarray  # (frames, 208), of the instrument's polarity
    current: float = NOMINAL_CURRENT  # A
    frequency: float = 0.0  # Hz


def instrument_tank(path: Path, domain: Domain | None, rim: Sequence[AbstractElectrode] | None) -> Tank:
    """The frames of a file of any of these formats, told by its content."""
    raw = _bytes_of(path)
    if path.suffix.lower() == ".get":
        frames = _draeger_get(path.name, raw) if raw.startswith(DRAEGER) else _goe_get(path.name, raw)
    else:
        frames = _carefusion(path.name, raw) if is_carefusion(raw) else _draeger_eit(path.name, raw)
    protocol = je.Protocol(je.skin.adjacent(ELECTRODES), frames.current, frames.frequency)
    skin = tank_of(path.stem, protocol, ELECTRODES, domain, rim)
    readings = -np.where(np.isfinite(frames.readings), frames.readings, np.nan).astype(float)
    return Tank(skin, readings, tuple(f"frame {k}" for k in range(len(readings))))


def _bytes_of(path: Path) -> bytes:
    require("array_bytes", path.stat().st_size, path.name, TankError)
    with open_regular(path) as file:
        return file.read()


def is_instrument(path: Path) -> bool:
    """Whether an .eit is one of these formats, by its first bytes.

    Raises:
        TankError: for one of Swisstom, which is not read.
    """
    with open_regular(path) as file:
        start = file.read(128)
    if start[:4] in (b"\0\0\0\2", b"\0\0\0\3", b"\0\0\0\4", b"\4\0\0\0"):
        raise TankError(
            f"{path.name}: is a file of a Swisstom instrument by its first bytes, which is not read; save its frames "
            "as .mat or .npz"
        )
    return DRAEGER in start or is_carefusion(start)


def is_carefusion(start: bytes) -> bool:
    """Whether a file begins as XML of two bytes a letter, as those of CareFusion do."""
    return start.startswith(b"\xff\xfe" + "<?xml".encode("utf-16-le"))


def _whole(where: str, size: int, frame: int, start: int) -> int:
    """The number of frames behind ``start`` bytes; raises TankError where that is none or no whole one."""
    count, rest = divmod(max(size - start, 0), frame)
    if not count:
        raise TankError(f"{where}: has no frame of {frame} bytes; it is empty or was cut short")
    if rest:
        raise TankError(
            f"{where}: has {rest} bytes more than {count} frames of {frame}; if it was cut short, keep its first "
            f"{start + count * frame} bytes"
        )
    return count


# --- .get


def _goe_get(where: str, raw: bytes) -> _Frames:
    table = _get_table(where, raw, 0)
    current = GET_CURRENT_UNIT * float(np.median(table[0, GET_CURRENTS]))
    if not 0 < current < MAX_CURRENT:
        raise TankError(f"{where}: currents of its first frame are {current:.3g} A; is no .get of a GOE-MF II")
    return _Frames(_with_reciprocals(table[:, :READINGS]), current)


def _draeger_get(where: str, raw: bytes) -> _Frames:
    end = raw.find(DRAEGER_TEXT_END)
    if end < 0:
        raise TankError(f"{where}: the text at its begin has no end, two empty lines; it was cut short")
    frequency = _number(raw[:end], b"Frequency [Hz]:")
    table = _get_table(where, raw, end + len(DRAEGER_TEXT_END))
    return _Frames(_with_reciprocals(table[:, :READINGS]), frequency=frequency)


def _get_table(where: str, raw: bytes, start: int) -> np.ndarray:
    count = _whole(where, len(raw), 4 * GET_VALUES, start)
    return np.frombuffer(raw, "<f4", count * GET_VALUES, start).reshape(count, GET_VALUES)


def _with_reciprocals(readings: np.ndarray) -> np.ndarray:
    """Readings that were left out, of pairs which drove before, as those of drive and sense exchanged."""
    pattern = je.skin.adjacent(ELECTRODES)
    place = {(row[0], row[2]): number for number, row in enumerate(pattern.tolist())}
    later = np.flatnonzero(pattern[:, 2] < pattern[:, 0])
    if readings[:, later].any():
        return readings
    filled = readings.copy()
    filled[:, later] = readings[:, [place[sense, drive] for drive, sense in pattern[later][:, [0, 2]].tolist()]]
    return filled


def _number(text: bytes, label: bytes) -> float:
    """The number behind a label, or zero."""
    found = re.search(re.escape(label) + rb"\s*(\d{1,9}(?:\.\d{0,9})?)", text)
    return float(found[1]) if found else 0.0


# --- .eit


def _draeger_eit(where: str, raw: bytes) -> _Frames:
    """The version and the bytes of the text are the first two uint32; a mark of 8 bytes stands before the frames."""
    version, text = struct.unpack_from("<2I", raw)
    if version not in DRAEGER_FRAME:
        known = " or ".join(map(str, DRAEGER_FRAME))
        raise TankError(f"{where}: is of version {version} of Draeger's format; version {known} can be read")
    size = DRAEGER_FRAME[version]
    count = _whole(where, len(raw), size, text + 8)
    rows = np.frombuffer(raw, np.uint8, count * size, text + 8).reshape(count, size)
    one, two = (_column(rows, 8 + 8 * first) for first in DRAEGER_SETS)  # behind the time
    frequency = 1e3 * _number(raw[:text], b"Frequency [kHz]:")
    with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers: `instrument_tank` makes them NaN
        return _Frames(DRAEGER_FACTORS[0] * one - DRAEGER_FACTORS[1] * two, frequency=frequency)


def _column(rows: np.ndarray, start: int) -> np.ndarray:
    return np.ascontiguousarray(rows[:, start : start + 8 * READINGS]).view("<f8")


def _carefusion(where: str, raw: bytes) -> _Frames:
    """Records of int32 and float32 behind a text in XML, which tells where they begin."""
    told = CAREFUSION_HEADER.search(raw[2:1026].decode("utf-16-le", "replace"))
    if told is None or int(told[1]) >= len(raw):
        raise TankError(f"{where}: its XML does not tell where the records begin, or was cut short")
    start = int(told[1])
    words = np.frombuffer(raw, "<i4", (len(raw) - start) // 4, start)
    found, place = [], 0
    while place < len(words):
        head = words[place : place + RECORD_HEAD].tolist()
        length = RECORD_WORDS.get(head[0], head[3] // 4 * head[4]) if len(head) == RECORD_HEAD else -1
        place += RECORD_HEAD
        if not 0 <= length <= len(words) - place:
            raise TankError(
                f"{where}: the record at byte {start + 4 * (place - RECORD_HEAD)} has no end; it was cut short"
            )
        if head[0] == FRAME_KIND:
            found.append(words[place : place + length][CAREFUSION_READINGS])
        place += length
    if not found:
        raise TankError(f"{where}: has no frames")
    return _Frames(np.array(found).view("<f4"))
