"""Patterns by name, and the set of all four-terminal readings, from which a design chooses."""

from itertools import combinations

import numpy as np
from jaxtyping import Float

from .protocol import Protocol, ProtocolError

ROW_NAMES = '"adjacent", "eidors-adjacent", "opposite" or "skip-1", "skip-2", ...'
"""What `named_pattern` knows, in words."""

NAMES = f'"trigonometric", {ROW_NAMES}'
"""What `named_protocol` knows, in words."""


def named_protocol(
    name: str, electrodes: int, current: float = 1e-3, frequency: float = 0.0, reading_time: float = 1e-5
) -> Protocol:
    """The protocol of a pattern's name: "trigonometric", or one of `named_pattern`.

    In the "trigonometric" protocol all electrodes drive at once, with the currents of `trigonometric`, and each drive
    has a reading of every pair of neighbours, electrode n less electrode n + 1, the last pair (last, 0):
    ``electrodes * (electrodes - 1)`` readings, all of the first drive first. ``current`` is that of the electrode which
    carries most. Electrodes are meant to lie around a rim at equal angles in the order of their numbers.

    Args:
        name, electrodes: as in `named_pattern`.
        current, frequency, reading_time: as in `Protocol`.

    Raises:
        ProtocolError: for another name, too few electrodes, or a current that is not positive.

    Example:
        scan = je.skin.named_protocol("trigonometric", 16, current=1e-3)
        rim = je.skin.rim_electrodes(je.Disc(0.1), 16)
        tank = je.Skin("tank", je.Disc(0.1), 1.0, rim, scan)
        print(f"{scan.readings} readings of drives through all electrodes")
    """
    if name != "trigonometric":
        return Protocol(_named_rows(name, electrodes, NAMES), current, frequency, reading_time)
    if not (np.isfinite(current) and current > 0):
        raise ProtocolError(f"the current is {current} A; give a positive number")
    senses = np.eye(electrodes) - np.roll(np.eye(electrodes), 1, 0)
    return Protocol.from_matrices(
        current * trigonometric(electrodes), senses, frequency=frequency, reading_time=reading_time
    )


def trigonometric(electrodes: int) -> Float[np.ndarray, "electrodes drives"]:
    """Currents cos(k theta), then sin(k theta), at electrodes theta = 2 pi n / electrodes around a rim.

    k runs from 1 to ``electrodes / 2``; the sine that is zero at all electrodes is left out, so that there are
    ``electrodes - 1`` drives. They are the currents that tell a round tank's interior best from an even one (Isaacson
    1986, doi:10.1109/TMI.1986.4307752).

    Returns:
        (electrodes, electrodes - 1), of amplitude 1; each column sums to zero.

    Raises:
        ProtocolError: for fewer than four electrodes.

    Example:
        current = 1e-3 * je.skin.trigonometric(16)  # A, (16, 15)
        voltmeter = np.eye(16) - np.roll(np.eye(16), -1, axis=1)  # each electrode less the next one
        scan = je.Protocol.from_matrices(current, voltmeter)
    """
    if electrodes < 4:
        raise ProtocolError(f"the trigonometric pattern needs four electrodes; got {electrodes}")
    angle = 2 * np.pi / electrodes * np.outer(np.arange(electrodes), np.arange(1, electrodes // 2 + 1))
    sines = (electrodes - 1) // 2
    return np.concatenate([np.cos(angle), np.sin(angle[:, :sines])], 1)


def named_pattern(name: str, electrodes: int) -> np.ndarray:
    """The pattern of a name: "adjacent", "eidors-adjacent", "opposite", or "skip-n" with a whole number n.

    Returns:
        Electrodes drive+, drive-, sense+ and sense- of each reading, (readings, 4) int32.

    Raises:
        ProtocolError: for another name, or too few electrodes.

    Example:
        for name in ("adjacent", "opposite", "skip-3"):
            print(name, len(je.skin.named_pattern(name, 16)), "readings")
    """
    if name == "trigonometric":
        raise ProtocolError("the trigonometric pattern has no rows of four electrodes; use named_protocol")
    return _named_rows(name, electrodes, ROW_NAMES)


def _named_rows(name: str, electrodes: int, names: str) -> np.ndarray:
    """The rows of `named_pattern`; ``names`` is what the error for another name lists."""
    kind, _, number = name.partition("-")
    if name == "adjacent":
        return adjacent(electrodes)
    if name == "eidors-adjacent":
        return eidors_adjacent(electrodes)
    if name == "opposite":
        return opposite(electrodes)
    if kind == "skip" and number.isascii() and number.isdecimal() and len(number) < 6:
        return skip(electrodes, int(number))
    raise ProtocolError(f"{name!r} is no pattern; give {names}")


def adjacent(electrodes: int) -> np.ndarray:
    """Adjacent drive, adjacent four-terminal measurement, in rotating order.

    Drive ``s`` joins electrodes ``s`` and ``s + 1``; its readings sense ``(m, m + 1)`` for
    ``m = s + 2, ..., s + electrodes - 2``, all modulo the number of electrodes, so that no reading
    shares an electrode with its drive: ``electrodes * (electrodes - 3)`` rows (550 for 25).

    Returns:
        Electrodes drive+, drive-, sense+ and sense- of each reading, (readings, 4) int32.

    Raises:
        ProtocolError: for fewer than four electrodes.
    """
    return skip(electrodes, 0)


def eidors_adjacent(electrodes: int) -> np.ndarray:
    """The readings of `adjacent` in the order and the polarity of EIDORS, ``mk_stim_patterns(n, 1, '{ad}', '{ad}')``.

    Drive ``s`` leads the current from electrode ``s + 1`` to ``s``, and its readings sense ``(m, m + 1)`` from the
    lowest ``m`` on ('no_rotate_meas'), without the pairs that share an electrode with it ('no_meas_current'). Readings
    of an even disc are above zero.

    Returns:
        Electrodes drive+, drive-, sense+ and sense- of each reading, (readings, 4) int32.

    Raises:
        ProtocolError: for fewer than four electrodes.
    """
    rows = adjacent(electrodes)[:, [1, 0, 2, 3]]
    return rows[np.lexsort([rows[:, 2], rows[:, 1]])]


def skip(electrodes: int, skipped: int) -> np.ndarray:
    """Drive and sense pairs that skip electrodes, in rotating order: `adjacent` with ``s + skipped + 1`` for ``s + 1``.

    It has as many rows as `adjacent`: ``electrodes * (electrodes - 3)``.

    Returns:
        Electrodes drive+, drive-, sense+ and sense- of each reading, (readings, 4) int32.

    Raises:
        ProtocolError: for fewer than four electrodes, or if a pair reaches half way round or farther.

    Example:
        print(je.skin.skip(16, 3)[0])  # drives and senses pairs (s, s + 4)
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
        Electrodes drive+, drive-, sense+ and sense- of each reading, (readings, 4) int32.

    Raises:
        ProtocolError: for fewer than six electrodes, where no pair of neighbours is left to sense.

    Example:
        print(je.skin.opposite(16)[0])  # drive+, drive-, sense+, sense- of the first reading
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
        Electrodes drive+, drive-, sense+ and sense- of each reading, (readings, 4) int32.

    Raises:
        ProtocolError: for fewer than four electrodes.
    """
    if electrodes < 4:
        raise ProtocolError(f"four-terminal readings need four electrodes; got {electrodes}")
    four = np.array(list(combinations(range(electrodes), 4)), np.int32)
    return four[:, [[0, 1, 2, 3], [0, 2, 1, 3], [0, 3, 1, 2]]].reshape(-1, 4)
