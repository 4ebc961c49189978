"""What memory a process takes, and whether that grows."""

import os
from typing import NamedTuple

import numpy as np

_MB, _HOUR = 1e6, 3600.0
MIN_SAMPLES = 10  # samples that tell a slope and its error


class Growth(NamedTuple):
    """MB per hour, and its standard error."""

    slope: float
    error: float

    def __str__(self) -> str:
        return f"{self.slope:.2f} ± {self.error:.2f} MB/h"


def resident(process: int | str = "self") -> float:
    """MB of a process that are in memory, where the system tells (Linux)."""
    with open(f"/proc/{process}/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / _MB


def growth(samples: np.ndarray) -> Growth:
    """Slope of rows (s, MB) over their later half: what start-up takes does not grow on.

    Least squares.  Memory comes in steps, so that what is left of a sample is much like that of the one before it: the
    error counts only so many as are independent, if that likeness falls off as it begins (Bartlett 1935; its estimate
    less its bias).  It is never less than what a page more at the end would make.
    """
    time, used = np.asarray(samples, float)[len(samples) // 2 :].T
    count = len(time)
    if count < MIN_SAMPLES:
        return Growth(0.0, np.inf)
    time = time - time.mean()
    spread = float(time @ time)
    slope = float(time @ used) / spread
    left = used - used.mean() - slope * time
    square = float(left @ left)
    alike = float(left[1:] @ left[:-1]) / square if square > 0 else 0.0
    alike = min(max(alike + (2 + 4 * alike) / count, 0.0), 1 - 1 / count)
    error = np.sqrt(square / (count - 2) / spread * (1 + alike) / (1 - alike))
    page = os.sysconf("SC_PAGE_SIZE") / _MB / np.ptp(time)
    return Growth(_HOUR * slope, _HOUR * max(float(error), page))
