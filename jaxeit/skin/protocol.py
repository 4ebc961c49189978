"""Stimulation and measurement patterns: which electrodes drive, which sense, and when."""

from dataclasses import dataclass

import numpy as np


class ProtocolError(ValueError):
    """A pattern that no hardware could run; the message says which row and why."""


@dataclass(frozen=True, eq=False)
class Protocol:
    """One scan of the skin.

    | meaning                                              | shape         | unit |
    |------------------------------------------------------|---------------|------|
    | pattern: drive+, drive-, sense+, sense-, zero-based  | (readings, 4) |      |
    | current: amplitude driven into drive+                | ()            | A    |
    | frequency of the stimulation (0: direct current)     | ()            | Hz   |
    | reading_time: from one reading to the next           | ()            | s    |

    Raises:
        ProtocolError: if a row names an electrode twice in one pair, or the current is not one positive number.
    """

    pattern: np.ndarray
    current: float = 1e-3
    frequency: float = 0.0
    reading_time: float = 1e-5

    def __post_init__(self) -> None:
        pattern = np.asarray(self.pattern)
        if pattern.ndim != 2 or pattern.shape[1] != 4 or len(pattern) == 0:
            raise ProtocolError(
                f"the pattern has shape {pattern.shape}; give one row of four electrode "
                "numbers (drive+, drive-, sense+, sense-) per reading"
            )
        if not np.issubdtype(pattern.dtype, np.integer):
            raise ProtocolError("the pattern must hold whole electrode numbers, counted from 0")
        short = (pattern[:, 0] == pattern[:, 1]) | (pattern[:, 2] == pattern[:, 3])
        if short.any():
            row = int(np.argmax(short))
            raise ProtocolError(
                f"row {row} of the pattern, {pattern[row].tolist()}, uses one electrode twice in "
                "a pair; drive+ and drive-, and sense+ and sense-, must differ"
            )
        if np.ndim(self.current) != 0:
            raise ProtocolError(f"the current has shape {np.shape(self.current)}; give one number, A, for all readings")
        if not (np.isfinite(self.current) and self.current > 0):
            raise ProtocolError(f"the current is {self.current} A; give a positive number")
        object.__setattr__(self, "pattern", pattern.astype(np.int32))

    @property
    def readings(self) -> int:
        """Number of readings in one frame."""
        return len(self.pattern)

    @property
    def frame_time(self) -> float:
        """Duration of one scan in seconds."""
        return self.readings * self.reading_time

    def check(self, electrodes: int) -> "Protocol":
        """This protocol; raises ProtocolError if a row names an electrode outside 0 to ``electrodes`` - 1."""
        wrong = (self.pattern < 0) | (self.pattern >= electrodes)
        if wrong.any():
            row = int(np.argmax(wrong.any(1)))
            raise ProtocolError(
                f"row {row} of the pattern, {self.pattern[row].tolist()}, names an electrode "
                f"outside 0 to {electrodes - 1}; electrodes are counted from 0"
            )
        return self


def adjacent(electrodes: int) -> np.ndarray:
    """Adjacent drive, adjacent four-terminal measurement, in rotating order.

    Drive ``s`` joins electrodes ``s`` and ``s + 1``; its readings sense ``(m, m + 1)`` for
    ``m = s + 2, ..., s + electrodes - 2``, all modulo the number of electrodes, so that no reading
    shares an electrode with its drive: ``electrodes * (electrodes - 3)`` rows (550 for 25).

    Returns:
        (readings, 4) int32: drive+, drive-, sense+, sense-.

    Raises:
        ProtocolError: for fewer than four electrodes.
    """
    if electrodes < 4:
        raise ProtocolError(f"four-terminal readings need four electrodes; got {electrodes}")
    drive = np.repeat(np.arange(electrodes), electrodes - 3)
    sense = drive + np.tile(np.arange(2, electrodes - 1), electrodes)
    return np.stack([drive, drive + 1, sense, sense + 1], 1).astype(np.int32) % electrodes


def reciprocal_rows(pattern: np.ndarray) -> np.ndarray:
    """For each row, the row with drive and sense exchanged, or -1 where there is none: (readings,).

    Only exchanges without a change of sign count; by reciprocity (Z is symmetric) the two readings agree.
    """
    rows = {tuple(row): index for index, row in enumerate(pattern.tolist())}
    swapped = pattern[:, [2, 3, 0, 1]].tolist()
    return np.array([rows.get(tuple(row), -1) for row in swapped])
