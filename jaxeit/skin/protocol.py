"""Stimulation and measurement patterns: which electrodes drive, which sense, and when."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int, Integer

from ..budget import require

UNBALANCED = 1e-6
"""Sum of a current pattern, over its largest current, above which the pattern is refused."""


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
    | mixing: each reading as a sum of rows of the pattern | (readings, rows) |   |
    | sense_channels: readings of one drive taken at once  | ()            |      |

    Without ``mixing``, each row of the pattern is one reading. `from_matrices` makes protocols in which many electrodes
    drive or sense at once, or drives have currents of their own: their pattern has pairs, and ``mixing`` their shares.

    Raises:
        ProtocolError: if a row names an electrode twice in one pair, the current is not one positive number, or
            ``mixing`` does not fit the pattern or is given with several sense channels.
    """

    pattern: np.ndarray
    current: float = 1e-3
    frequency: float = 0.0
    reading_time: float = 1e-5
    mixing: sp.csr_array | None = None
    sense_channels: int = 1

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
        if isinstance(self.current, str) or not (np.isfinite(self.current) and self.current > 0):
            raise ProtocolError(f"the current is {self.current}; give a positive number, A")
        if not (isinstance(self.sense_channels, int | np.integer) and self.sense_channels >= 1):
            raise ProtocolError(f"sense_channels is {self.sense_channels}; give how many readings are taken at once")
        if self.mixing is not None and self.sense_channels > 1:
            raise ProtocolError("a protocol of matrices has no driven pairs; leave sense_channels out")
        object.__setattr__(self, "sense_channels", int(self.sense_channels))
        object.__setattr__(self, "pattern", pattern.astype(np.int32))
        if self.mixing is not None:
            object.__setattr__(self, "mixing", _checked_mixing(self.mixing, len(pattern)))

    @classmethod
    def from_matrices(
        cls,
        current: Float[np.ndarray, "electrodes drives"],
        measurement: Float[np.ndarray, "electrodes senses"] | Sequence[Float[np.ndarray, "electrodes _"]],
        *,
        reference: int | None = None,
        frequency: float = 0.0,
        reading_time: float = 1e-5,
    ) -> "Protocol":
        """Any currents and any voltages: the matrices of EIDORS, of the Kuopio challenge, trigonometric patterns.

        Reading s of drive d is ``measurement[:, s] @ U``, U the potentials of the electrodes under the currents
        ``current[:, d]``. All readings of the first drive come first.

        Args:
            current: of each drive, A; above zero: into the sheet. Each column sums to zero.
            measurement: weight of each electrode in each reading, or one such matrix for each drive.
            reference: the electrode that potentials are relative to, where columns of ``measurement`` do not sum to
                zero, such as those of the identity. Potentials relative to the mean are ``identity - 1 / electrodes``.
            frequency, reading_time: as in the class.

        Raises:
            ProtocolError: naming the column that drives no current, or does not sum to zero.
        """
        current = _matrix("current", current)
        electrodes, drives = current.shape
        one_for_all = isinstance(measurement, np.ndarray) and measurement.ndim == 2
        senses = [measurement] * drives if one_for_all else list(measurement)
        if len(senses) != drives:
            raise ProtocolError(f"measurement has {len(senses)} matrices for {drives} drives; give one for each")
        amplitude = float(np.abs(current).max())
        if not amplitude > 0:
            raise ProtocolError("current is zero in every drive; give currents in A")
        largest = int(np.count_nonzero(current, 0).max()) * sum(int(np.count_nonzero(matrix)) for matrix in senses)
        require("array_bytes", 64.0 * largest, "from_matrices: pairs of driving and sensing electrodes")
        terms = _Terms(electrodes, reference)
        for drive, (column, matrix) in enumerate(zip(current.T, senses, strict=True)):
            terms.add(drive, column / amplitude, _matrix(f"measurement of drive {drive}", matrix, electrodes))
        pattern, mixing = terms.joined()
        return cls(pattern, amplitude, frequency, reading_time, mixing)

    @property
    def readings(self) -> int:
        """Number of readings in one frame."""
        return len(self.pattern) if self.mixing is None else self.mixing.shape[0]

    def only(self, rows: Integer[np.ndarray, " count"] | Bool[np.ndarray, " readings"]) -> "Protocol":
        """The protocol of these readings, by number (count,) or by a flag for each (readings,)."""
        if self.mixing is None:
            return replace(self, pattern=self.pattern[rows])
        mixing = self.mixing[np.flatnonzero(rows) if rows.dtype == bool else rows]
        used = np.flatnonzero(np.bincount(mixing.indices, minlength=len(self.pattern)))
        return replace(self, pattern=self.pattern[used], mixing=mixing[:, used])

    def rows(self, what: str) -> np.ndarray:
        """The pattern, (readings, 4); raises ProtocolError, naming ``what``, unless each row is one reading."""
        if self.mixing is not None:
            raise ProtocolError(
                f"{what} needs one pair that drives and one that senses for each reading, with one current for all; "
                'this protocol of matrices has others; give the skin rows, or a pattern such as "adjacent"'
            )
        return self.pattern

    @property
    def pairs(self) -> Int[np.ndarray, "some 4"]:
        """The pattern, where each row is one reading; no rows for a protocol of matrices, whose readings have none."""
        return self.pattern if self.mixing is None else self.pattern[:0]

    @property
    def slots(self) -> Int[np.ndarray, " readings"]:
        """Number of the slot in which each reading is taken.

        Slots follow each other, each as long as ``reading_time``. With several sense channels, readings that follow
        each other and have the same drive are taken at once, as many as there are channels.
        """
        readings = np.arange(self.readings)
        if self.sense_channels == 1:
            return readings
        switched = np.append(True, np.any(np.diff(self.pattern[:, :2], axis=0), axis=1))
        since = readings - np.maximum.accumulate(np.where(switched, readings, 0))
        return np.cumsum(since % self.sense_channels == 0) - 1

    @property
    def frame_slots(self) -> int:
        """Number of slots in a frame: its duration over that of a reading."""
        return int(self.slots[-1]) + 1

    @property
    def reading_offsets(self) -> Float[np.ndarray, " readings"]:
        """When each reading is taken, (readings,) s after the first."""
        return self.slots * self.reading_time

    @property
    def frame_time(self) -> float:
        """Duration of one scan in seconds."""
        return self.frame_slots * self.reading_time

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


def _matrix(name: str, values: Any, electrodes: int | None = None) -> np.ndarray:
    """A matrix with a row for each electrode, of finite numbers."""
    values = values.toarray() if sp.issparse(values) else np.asarray(values)
    if values.ndim != 2 or not values.size or electrodes not in (None, len(values)):
        raise ProtocolError(
            f"{name} has shape {values.shape}; give a matrix with one row for each of the "
            f"{'' if electrodes is None else f'{electrodes} '}electrodes and a column for each pattern"
        )
    if np.iscomplexobj(values) or not np.isfinite(values).all():
        raise ProtocolError(f"{name} has entries that are no finite real numbers")
    return np.asarray(values, float)


class _Terms:
    """Readings as sums of four-electrode readings, collected drive by drive."""

    def __init__(self, electrodes: int, reference: int | None) -> None:
        if reference is not None and not 0 <= reference < electrodes:
            raise ProtocolError(
                f"reference is electrode {reference}; electrodes are counted from 0 to {electrodes - 1}"
            )
        self.electrodes, self.reference = electrodes, reference
        self.readings = 0
        self.parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def add(self, drive: int, current: np.ndarray, measurement: np.ndarray) -> None:
        """The readings of one drive: each of its pairs with each of the pairs of a reading."""
        sources, shares = _pairs_of(f"current of drive {drive}", current, None)
        for sense, column in enumerate(measurement.T):
            where = f"measurement {sense} of drive {drive}"
            sinks, weights = _pairs_of(where, column, self.reference)
            rows = np.concatenate([np.repeat(sources, len(sinks), 0), np.tile(sinks, (len(sources), 1))], 1)
            self.parts.append((np.full(len(rows), self.readings), rows, np.outer(shares, weights).ravel()))
            self.readings += 1

    def joined(self) -> tuple[np.ndarray, sp.csr_array | None]:
        """The pattern, and the mixing unless it is the identity."""
        reading, rows, share = (np.concatenate(part) for part in zip(*self.parts, strict=True))
        if len(rows) == self.readings and np.allclose(share, 1, rtol=1e-12):
            return rows, None
        code = np.ravel_multi_index(rows.T, (self.electrodes,) * 4)  # sorts faster than rows
        codes, number = np.unique(code, return_inverse=True)
        pattern = np.stack(np.unravel_index(codes, (self.electrodes,) * 4), 1)
        return pattern, sp.csr_array((share, (reading, number.ravel())), (self.readings, len(pattern)))


def _pairs_of(where: str, column: np.ndarray, reference: int | None) -> tuple[np.ndarray, np.ndarray]:
    """A pattern that sums to zero as pairs of electrodes (n, 2) and their shares (n,).

    Two electrodes are one pair. Of more, each but the last (of all, so that patterns share their pairs) is paired with
    the last.
    """
    largest, total = np.abs(column).max(), column.sum()
    if largest == 0:
        raise ProtocolError(f"the {where} is zero; leave it out")
    if abs(total) > UNBALANCED * largest:
        if reference is None:
            raise ProtocolError(
                f"the {where} sums to {total:.6g}, not to zero; "
                + ("subtract its mean" if "current" in where else "give reference=, the electrode it is relative to")
            )
        column = column.copy()
        column[reference] -= total
    used = np.flatnonzero(np.abs(column) > 1e-12 * largest)
    if len(used) == 2:
        ends = used if column[used[0]] > 0 else used[::-1]
        return ends[None], np.abs(column[ends[:1]])
    if not len(used):
        raise ProtocolError(f"the {where} is the reference electrode alone, which is zero by itself; leave it out")
    last = len(column) - 1
    ends = used[used != last]
    return np.stack([ends, np.full(len(ends), last)], 1), column[ends]


def _checked_mixing(mixing: sp.csr_array, rows: int) -> sp.csr_array:
    mixing = sp.csr_array(mixing, dtype=float)
    if mixing.shape[1] != rows or not mixing.shape[0]:
        raise ProtocolError(
            f"mixing has shape {mixing.shape}; give a column for each of the {rows} rows of the pattern"
        )
    mixing.sum_duplicates()
    empty = np.diff(mixing.indptr) == 0
    if empty.any() or not np.isfinite(mixing.data).all():
        raise ProtocolError(f"mixing: reading {int(np.argmax(empty))} has no row, or a weight is not finite")
    return mixing


def reciprocal_rows(pattern: np.ndarray) -> np.ndarray:
    """For each row, the row with drive and sense exchanged, or -1 where there is none: (readings,).

    Only exchanges without a change of sign count; by reciprocity (Z is symmetric) the two readings agree.
    """
    rows = {tuple(row): index for index, row in enumerate(pattern.tolist())}
    swapped = pattern[:, [2, 3, 0, 1]].tolist()
    return np.array([rows.get(tuple(row), -1) for row in swapped])
