"""How often a log loads and unloads its sensor.

What is calibrated on a rise alone knows nothing of hysteresis, and few cycles tell little of how much cycles differ.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

SWING = 0.25  # of the range of the forces, from which a rise or a fall counts
LEAST = 0.5  # of the larger of rise and fall, above which a direction counts as seen


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
    parts = _logs(force, log)
    rises = [(part - np.minimum.accumulate(part)).max(initial=0.0) for part in parts]
    falls = [(np.maximum.accumulate(part) - part).max(initial=0.0) for part in parts]
    return Travel(float(max(rises, default=0.0)), float(max(falls, default=0.0)))


def cycles_of(force: Float[np.ndarray, " n"], log: Int[np.ndarray, " n"] | None = None) -> int:
    """Number of cycles, each a rise and a fall of at least `SWING` of the range of all forces; at least one."""
    known = force[np.isfinite(force)]
    swing = SWING * float(np.ptp(known)) if len(known) else 0.0
    return max(sum(_strokes(part.tolist(), swing) for part in _logs(force, log)) // 2, 1)


def _logs(force: np.ndarray, log: np.ndarray | None) -> list[np.ndarray]:
    """The forces of each log that are known."""
    number = np.zeros(len(force), int) if log is None else log
    return [force[(number == k) & np.isfinite(force)] for k in np.unique(number)]


def _strokes(force: list[float], swing: float) -> int:
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
    least = LEAST * max(calibrated)
    for name, before, now in zip(("rises", "falls"), calibrated, found, strict=True):
        if before < least <= now:
            return (
                f"the force {name} by {now:.3g} N here, and by {before:.3g} N at most in what was fitted: the "
                "model leaves out the hysteresis between the two directions; calibrate with loads that rise and fall"
            )
    return ""


def missing_direction(calibrated: Travel) -> str:
    """The direction that no calibrated log has, in a sentence; empty: none."""
    least = LEAST * max(calibrated)
    for name, other, size in (("falls", "rises", calibrated.fall), ("rises", "falls", calibrated.rise)):
        if size < least:
            return (
                f"the force {other} and never {name} by more than {size:.3g} N: hysteresis was not seen, and the "
                "model leaves it out; calibrate with loads that rise and fall"
            )
    return ""
