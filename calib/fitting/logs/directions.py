"""Cycles and directions of load in a log.

A calibration on rising forces alone has no hysteresis, and few cycles do not determine how much cycles differ.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

MIN_STROKE_FRACTION = 0.25  # least rise or fall that counts, over the range of the forces
MIN_DIRECTION_RATIO = 0.5  # least rise or fall of a direction that was loaded, over the larger of both


class Travel(NamedTuple):
    """The largest rise of the force after any earlier sample of the same log, and the largest fall, N."""

    rise: float = float("nan")
    fall: float = float("nan")


def travel_of(force: Float[np.ndarray, " n"], log: Int[np.ndarray, " n"] | None = None) -> Travel:
    """Rise and fall of forces (N); NaN: not known. `log`: number (n,) of the log of each sample; default: one log.

    Example:
        seen, loading = logs.travel_of(force), logs.travel_of(force[:100])  # N, rise and fall
        print(logs.missing_direction(loading))  # a log that only rises tells no unloading branch
        print(logs.unseen_direction(loading, seen))
    """
    parts = _split_logs(force, log)
    rises = [(part - np.minimum.accumulate(part)).max(initial=0.0) for part in parts]
    falls = [(np.maximum.accumulate(part) - part).max(initial=0.0) for part in parts]
    return Travel(float(max(rises, default=0.0)), float(max(falls, default=0.0)))


def count_cycles(force: Float[np.ndarray, " n"], log: Int[np.ndarray, " n"] | None = None) -> int:
    """Number of cycles of a rise and a fall of at least `MIN_STROKE_FRACTION` of the range of forces; at least one."""
    known = force[np.isfinite(force)]
    swing = MIN_STROKE_FRACTION * float(np.ptp(known)) if len(known) else 0.0
    return max(sum(_count_strokes(part.tolist(), swing) for part in _split_logs(force, log)) // 2, 1)


def _split_logs(force: np.ndarray, log: np.ndarray | None) -> list[np.ndarray]:
    """The forces of each log that are known."""
    number = np.zeros(len(force), int) if log is None else log
    return [force[(number == k) & np.isfinite(force)] for k in np.unique(number)]


def _count_strokes(force: list[float], swing: float) -> int:
    """Number of rises and falls of at least `swing`, between turning points."""
    count, way, low, high = 0, 0, np.inf, -np.inf
    for value in force:
        low, high = min(low, value), max(high, value)
        if way <= 0 and value - low >= swing > 0:
            count, way, high = count + 1, 1, value
        elif way >= 0 and high - value >= swing > 0:
            count, way, low = count + 1, -1, value
    return count


def unseen_direction(calibrated: Travel, found: Travel) -> str:
    """What the forces found do that those calibrated did not, in a sentence; empty: nothing."""
    least = MIN_DIRECTION_RATIO * max(calibrated)
    for name, before, now in zip(("rises", "falls"), calibrated, found, strict=True):
        if before < least <= now:
            return (
                f"the force {name} by {now:.3g} N here, and by {before:.3g} N at most in what was fitted: the "
                "model leaves out the hysteresis between the two directions; calibrate with loads that rise and fall"
            )
    return ""


def missing_direction(calibrated: Travel) -> str:
    """The direction that no calibrated log has, in a sentence; empty: none."""
    least = MIN_DIRECTION_RATIO * max(calibrated)
    for name, other, size in (("falls", "rises", calibrated.fall), ("rises", "falls", calibrated.rise)):
        if size < least:
            return (
                f"the force {other} and never {name} by more than {size:.3g} N: hysteresis was not seen, and the "
                "model leaves it out; calibrate with loads that rise and fall"
            )
    return ""
