"""Find sentinels: numbers that recorders write in place of a missing reading."""

import numpy as np

SENTINELS = (-1.0, -99.0, -999.0, -9999.0, 999.0, 9999.0, 99999.0)
"""Numbers that recorders write where they have no reading."""
SENTINEL_SHARE = 0.05
"""Smallest fraction of the samples of a channel at which a sentinel is reported."""


def sentinel_warnings(name: str, values: np.ndarray) -> tuple[str, ...]:
    """Lines about numbers that look like "no reading" in ``values`` (rows, channels)."""
    found = []
    for channel, column in enumerate(values.T):
        label = name if values.shape[1] == 1 else f"{name}[{channel}]"
        finite = column[np.isfinite(column)]
        for value in SENTINELS:
            count = int((finite == value).sum())
            if count > SENTINEL_SHARE * len(finite) and _out_of_line(finite, value):
                number = f"{value:g}"
                what = f"{count:,} of {len(column):,} rows of {label} are exactly {number}"
                found.append(f"{what}: missing? give --missing {number}")
    return tuple(found)


def _out_of_line(column: np.ndarray, value: float) -> bool:
    """Whether `value` lies outside the other numbers, or is reached by jumps they do not make."""
    hit = column == value
    others = column[~hit]
    if len(others) < 2:
        return True
    if value < others.min() or value > others.max():
        return True
    into = np.abs(np.diff(column))[hit[1:] & ~hit[:-1]]
    usual = np.median(np.abs(np.diff(others)))
    return bool(len(into) and np.median(into) > 10 * usual)
