"""Four-terminal patterns by name, and the set of all four-terminal readings, from which a design chooses."""

from itertools import combinations

import numpy as np

from .protocol import ProtocolError

NAMES = '"adjacent", "opposite" or "skip-1", "skip-2", ...'
"""What `named_pattern` knows, in words."""


def named_pattern(name: str, electrodes: int) -> np.ndarray:
    """The pattern of a name: "adjacent", "opposite", or "skip-n" with a whole number n.

    Returns:
        (readings, 4) int32: drive+, drive-, sense+, sense-.

    Raises:
        ProtocolError: for another name, or too few electrodes.
    """
    kind, _, number = name.partition("-")
    if name == "adjacent":
        return adjacent(electrodes)
    if name == "opposite":
        return opposite(electrodes)
    if kind == "skip" and number.isascii() and number.isdecimal() and len(number) < 6:
        return skip(electrodes, int(number))
    raise ProtocolError(f"{name!r} is no pattern; give {NAMES}")


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
    return skip(electrodes, 0)


def skip(electrodes: int, skipped: int) -> np.ndarray:
    """Drive and sense pairs that skip electrodes, in rotating order: `adjacent` with ``s + skipped + 1`` for ``s + 1``.

    It has as many rows as `adjacent`: ``electrodes * (electrodes - 3)``.

    Returns:
        (readings, 4) int32: drive+, drive-, sense+, sense-.

    Raises:
        ProtocolError: for fewer than four electrodes, or if a pair reaches half way round or farther.
    """
    if electrodes < 4:
        raise ProtocolError(f"four-terminal readings need four electrodes; got {electrodes}")
    step, most = skipped + 1, (electrodes - 1) // 2 - 1
    if not 0 <= skipped <= most:
        raise ProtocolError(
            f"pairs of {electrodes} electrodes can skip 0 to {most}, got {skipped}; pairs farther apart are those of a "
            'smaller number, or "opposite"'
        )
    drive = np.repeat(np.arange(electrodes), electrodes - 3)
    ahead = np.setdiff1d(np.arange(electrodes), [0, step, electrodes - step])
    sense = drive + np.tile(ahead, electrodes)
    return np.stack([drive, drive + step, sense, sense + step], 1).astype(np.int32) % electrodes


def opposite(electrodes: int) -> np.ndarray:
    """Opposite drive, adjacent four-terminal measurement, in rotating order.

    Drive ``s`` joins electrodes ``s`` and ``s + electrodes // 2``, each pair once, and its readings sense all pairs
    ``(m, m + 1)`` that share no electrode with it: ``electrodes - 4`` for each of the ``electrodes / 2`` drives
    (``electrodes`` drives for an odd number).

    Returns:
        (readings, 4) int32: drive+, drive-, sense+, sense-.

    Raises:
        ProtocolError: for fewer than six electrodes, where no pair of neighbours is left to sense.
    """
    if electrodes < 6:
        raise ProtocolError(f"the opposite pattern needs six electrodes; got {electrodes}")
    half = electrodes // 2
    drive = np.arange(electrodes if electrodes % 2 else half)
    ahead = np.setdiff1d(np.arange(electrodes), [0, half - 1, half, electrodes - 1])
    start, sense = np.repeat(drive, len(ahead)), (drive[:, None] + ahead).ravel()
    return np.stack([start, start + half, sense, sense + 1], 1).astype(np.int32) % electrodes


def all_pairs(electrodes: int) -> np.ndarray:
    """Every four-terminal reading once: all pairs of pairs of electrodes that share none.

    A reading with its drive and sense exchanged is the same by reciprocity, and one with a pair turned round is its
    negative, so that ``3 C(electrodes, 4)`` are left (37,950 for 25).

    Returns:
        (readings, 4) int32: drive+, drive-, sense+, sense-.

    Raises:
        ProtocolError: for fewer than four electrodes.
    """
    if electrodes < 4:
        raise ProtocolError(f"four-terminal readings need four electrodes; got {electrodes}")
    four = np.array(list(combinations(range(electrodes), 4)), np.int32)
    return four[:, [[0, 1, 2, 3], [0, 2, 1, 3], [0, 3, 1, 2]]].reshape(-1, 4)
