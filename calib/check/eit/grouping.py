"""What a set of readings has in common: electrodes, or a pair of electrodes that drives or senses."""

import numpy as np

from ..report import ChannelTable

MIN_SHARE = 0.8  # of the readings of an electrode, that are in the set


def readings_of_electrodes(table: ChannelTable) -> np.ndarray:
    """Which readings each electrode takes part in, (electrodes, readings).

    Where readings are sums of rows, those that sense with the electrode: all of them are driven through nearly all
    electrodes, which tells none from another.
    """
    electrodes = np.arange(table.pattern.max() + 1)
    if table.mixing is None:
        return np.asarray((table.pattern == electrodes[:, None, None]).any(2))
    senses = (table.pattern[:, 2:] == electrodes[:, None, None]).any(2)
    return np.asarray((abs(table.mixing) @ senses.T.astype(float)).T > 0)


def common_electrodes(flag: np.ndarray, uses: np.ndarray, among: np.ndarray | None = None) -> list[int]:
    """One or two electrodes that occur in all flagged readings and in few others; found greedily.

    Args:
        flag: (readings,).
        uses: from `readings_of_electrodes`.
        among: the readings that may be flagged (readings,); default: all.
    """
    left = flag.copy()
    found: list[int] = []
    uses = uses if among is None else uses & among
    while left.sum() >= 3 and len(found) < 2:
        share = (uses & flag).sum(1) / np.maximum(uses.sum(1), 1)
        hits = np.where(share > MIN_SHARE, (uses & left).sum(1), 0)
        if not hits.any():
            return []
        found.append(int(hits.argmax()))
        left &= ~uses[found[-1]]
    return [] if left.any() else found


def common_part(flag: np.ndarray, partner: np.ndarray, pattern: np.ndarray) -> tuple[np.ndarray, str] | None:
    """The readings of one drive, or of one electrode that drives, that are the flagged ones with their reciprocals.

    Args:
        flag: (readings,), true for a reading if it is for its reciprocal one.
        partner: row of the reciprocal reading (readings,).
        pattern: drive+, drive-, sense+, sense- (readings, 4).

    Returns:
        The readings (readings,) and words such as "drive with 3-4"; None if nothing is common to all.
    """
    for row in np.flatnonzero(flag):
        a, b = pattern[row, :2]
        for what, uses in (
            (f"drive with {a}-{b}", (pattern[:, :2] == [a, b]).all(1)),
            (f"drive through electrode {a}", (pattern[:, :2] == a).any(1)),
            (f"drive through electrode {b}", (pattern[:, :2] == b).any(1)),
        ):
            some = flag & uses
            whole = some.copy()
            whole[partner[some]] = True
            if (whole == flag).all() and some.sum() > 2:
                return some, what
    return None
