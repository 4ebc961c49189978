"""Check the forces of the presses against the targets of their table."""

from collections.abc import Iterator

import numpy as np

from ...session import PressTable
from ..evidence import PressEvidence
from ..parts import RowRange, stepped_part
from ..report import Finding, Severity

FORCE, PRESSES = "/streams/force", "/presses"
TARGET_RATIO_RANGE = 0.5, 2.0
MIN_STEP, MIN_STEP_SCATTERS = 1.4, 5.0  # factor at which the force over the target steps, and its clearness
STEADY = 0.85  # share of the presses that follow the step
MAX_SCATTER, AGREEING = 1.3, 0.75  # factor by which forces may be off their targets, and in which share of the presses
SUFFICIENT_CORRELATION, NO_CORRELATION = 0.95, 0.5  # of forces and targets
LEAST_RATIO = 1e-9  # for the logarithm of a press without force
MAX_ROLL = 3  # presses by which the targets are tried early and late
MIN_COMPARED = 6  # presses with a target


def target_findings(evidence: PressEvidence, force: np.ndarray, start: int) -> Iterator[Finding]:
    """Targets that are negative, those of other presses, and forces in another unit, always or from some time on.

    ``force`` is that of the presses (rows,) in N, ``start`` the time at which the recording starts, ns.
    """
    if not isinstance(evidence.presses, PressTable):
        return
    target = evidence.presses.target_force[evidence.number]
    if (target < 0).any():
        what = f"target_force is negative in {(target < 0).sum()} of {len(target)} presses"
        yield Finding(Severity.WARNING, PRESSES, what, "pressing is positive: give the sizes of the targets")
        target = np.abs(target)
    good = np.isfinite(force) & (target > 0)
    if not good.any():
        return
    ratio = np.maximum(force[good] / target[good], LEAST_RATIO)
    step = _step_finding(ratio, evidence.times[good], start)
    order = None if step is not None else _order_finding(force[good], target[good])
    yield from (found for found in (step, order) if found is not None)
    usual, (low, high) = float(np.median(ratio)), TARGET_RATIO_RANGE
    if step is None and not low < usual < high:
        what = f"the force reads {usual:.3g} times the target of the presses"
        yield Finding(Severity.WARNING, FORCE, what, "check the unit (N, g, kg, V), the tare and the gain")


def _step_finding(ratio: np.ndarray, times: np.ndarray, start: int) -> Finding | None:
    """A step of the force over the target (presses,)."""
    stepped = stepped_part(np.log(ratio)) if len(ratio) >= MIN_COMPARED else None
    if stepped is None:
        return None
    row, clearness = stepped
    before, after = (float(np.median(part)) for part in (ratio[:row], ratio[row:]))
    if abs(np.log(after / before)) < np.log(MIN_STEP) or abs(clearness) < MIN_STEP_SCATTERS:
        return None
    level = np.where(np.arange(len(ratio)) < row, before, after)
    if np.quantile(np.abs(np.log(ratio / level)), STEADY) > np.log(MIN_STEP):
        return None
    first = bool(abs(np.log(before)) > abs(np.log(after)))
    wrong, right = (before, after) if first else (after, before)
    when = RowRange(row, first).text(times, start)
    what = f"the force reads {wrong:.3g} times the target of the presses {when}, {right:.3g} times in the others"
    return Finding(Severity.WARNING, FORCE, what, "look for a change of the unit, the gain or the tare at that time")


def _order_finding(force: np.ndarray, target: np.ndarray) -> Finding | None:
    """Targets that belong to other presses."""
    if len(force) < MIN_COMPARED or min(np.ptp(np.log(v)) for v in (np.maximum(force, LEAST_RATIO), target)) < np.log(
        MAX_SCATTER
    ):
        return None
    as_listed = _correlation(force, target)
    ratio = np.maximum(force / target, LEAST_RATIO)
    off = np.abs(np.log(ratio / np.median(ratio)))
    if as_listed > NO_CORRELATION or np.quantile(off, AGREEING) < np.log(MAX_SCATTER):
        return None
    rolls = [k for k in range(-MAX_ROLL, MAX_ROLL + 1) if k]
    fits = [_correlation(*_rolled(force, target, k)) for k in rolls]
    best = int(np.argmax(fits))
    what = f"the targets are not those of the presses: they correlate with the forces by {as_listed:.2f}"
    if fits[best] > SUFFICIENT_CORRELATION and len(force) > MIN_COMPARED + MAX_ROLL:
        presses = f"{abs(rolls[best])} press{'es' if abs(rolls[best]) > 1 else ''}"
        what += f", and by {fits[best]:.2f} if they come {presses} too {'late' if rolls[best] > 0 else 'early'}"
    return Finding(Severity.WARNING, PRESSES, what, "correct the column target_force of the table")


def _rolled(force: np.ndarray, target: np.ndarray, by: int) -> tuple[np.ndarray, np.ndarray]:
    """Forces and targets of the presses, if the targets come so many rows late."""
    return (force[:-by], target[by:]) if by > 0 else (force[-by:], target[:by])


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0 and np.ptp(b) > 0 else 0.0
