"""Find the part of a log in which force and channels have another ratio, or another sign, than in the remaining part.

A unit or a sign that changes half way leaves the levels of the other stream as they were. Where both streams have other
levels, as in light presses after heavy ones, a curved response is as likely, and nothing is said.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..parts import RowRange, flagged_part, stepped_part
from ..report import Finding, Severity
from .blocks import LOG_BLOCKS, LogBlocks, usual
from .following import RELATED_CORRELATION, has_usual_variation

MIN_RATIO = 4.0  # of a change of gain: friction, creep and wear change it by less
MIN_STEP_SCATTERS = 5.0  # of the gains of the blocks in both parts
MIN_COMPARED, MIN_SHARE = 6, 0.75  # blocks in which a channel follows the force, and their share of those with force
MIN_OVERLAP = 0.5  # of the wider range of both parts, in which levels are compared
NORMAL = 0.3  # of the usual spread, from which the sign of a block counts
MIN_AGREEING, MIN_SHOWING = 0.8, 0.6  # of the channels that follow the force, and of all, that change together


class _Change(NamedTuple):
    """A part of the log in which a channel is otherwise.

    `of_force`: whether the levels of the channel are the same throughout, so that the force is wrong; `ratio`: of the
    gains of the wrong stream, that of the part over that of the rest; below zero: the sign is another one.
    """

    part: RowRange
    times: np.ndarray
    of_force: bool
    ratio: float


def gain_findings(log: LogBlocks) -> Iterator[Finding]:
    """Changes of the gain or the sign that most channels show, of the force or of all channels; signs also of one."""
    channels = range(len(log.column))
    changes = {k: found for k in channels if (found := _sign_change(log, k) or _gain_change(log, k))}
    follow = sum(bool(_related(log, k).any()) for k in channels)
    sure = Severity.WARNING if log.placed else Severity.ERROR  # at other places a channel may have another gain
    for of_force, subject in ((True, "force"), (False, log.signal)):
        alike = _agreeing([change for change in changes.values() if change.of_force == of_force])
        if len(alike) >= max(MIN_AGREEING * follow, MIN_SHOWING * len(channels)):
            yield _finding(log, alike[0], f"the {subject}", f"/streams/{subject}", sure)
            return
    for k, change in changes.items():
        if change.ratio < 0:  # a gain may be one of pads that are pressed in turn
            yield _finding(log, change, f"column {log.column[k]}", f"/streams/{log.signal}", Severity.WARNING)


def _agreeing(changes: list[_Change]) -> list[_Change]:
    """Those of the usual ratio, at the usual time or a block beside it."""
    if not changes:
        return []
    ratios, begins = np.array([(change.ratio, change.times[change.part.row]) for change in changes]).T
    near = np.abs(begins - np.median(begins)) <= np.ptp(changes[0].times) / (LOG_BLOCKS - 2)
    usual_ratio = float(np.median(ratios))
    near &= (ratios / usual_ratio > 1 / MIN_RATIO) & (ratios / usual_ratio < MIN_RATIO)
    return [change for change, is_near in zip(changes, near, strict=True) if is_near]


def _finding(log: LogBlocks, change: _Change, subject: str, where: str, severity: Severity) -> Finding:
    when, other = change.part.text(change.times, 0), log.signal if where == "/streams/force" else "force"
    if change.ratio < 0:
        what = f"{subject} has the opposite sign {when}: rising {other} lets it fall, or the reverse"
        return Finding(severity, where, what, "look for a change of the sign or the wiring at that time")
    what = f"{subject} changes {change.ratio:.3g} times as much with the {other} as before, {when}"
    return Finding(severity, where, what, "look for a change of the unit or the gain at that time")


def _related(log: LogBlocks, channel: int) -> np.ndarray:
    """Flags (blocks,) of those in which a channel follows the force; none of a channel that often does not."""
    used = np.abs(log.correlations[channel]) >= RELATED_CORRELATION
    loaded = log.force_spread > NORMAL * usual(log.force_spread)
    enough = used.sum() >= MIN_COMPARED and used[loaded].mean() >= MIN_SHARE
    return used if enough else np.zeros(len(used), bool)


def _sign_change(log: LogBlocks, channel: int) -> _Change | None:
    spreads = log.spreads[channel]
    used = _related(log, channel)
    used &= (spreads > NORMAL * usual(spreads)) & (log.force_spread > NORMAL * usual(log.force_spread))
    falls = log.correlations[channel][used] < 0
    part = flagged_part(falls) or flagged_part(~falls) if 0 < falls.sum() < len(falls) else None
    if part is None:
        return None
    sides = _sides(log, int(np.flatnonzero(used)[part.row]))
    if not all(has_usual_variation(log.force[side], log.force_spread) for side in sides):
        return None
    before, after = (np.median(log.force[side]) for side in sides)
    late = part._replace(first=False)  # the sign at the start counts as the right one
    return _Change(late, log.starts[used], bool(before * after < 0), -1.0)


def _gain_change(log: LogBlocks, channel: int) -> _Change | None:
    used = _related(log, channel)
    gain = log.spreads[channel][used] / log.force_spread[used]
    stepped = stepped_part(np.log(gain)) if used.any() else None
    if stepped is None or abs(stepped[1]) < MIN_STEP_SCATTERS:
        return None
    row = stepped[0]
    sides = _sides(log, int(np.flatnonzero(used)[row]))
    streams = (log.values[:, channel], log.spreads[channel]), (log.force, log.force_spread)
    for of_force, ((kept, spreads), (moved, _)) in ((True, streams), (False, streams[::-1])):
        ratio = _ratio_at_levels(kept, moved, sides)
        if ratio is None or abs(np.log(ratio)) <= np.log(MIN_RATIO):
            continue
        if all(has_usual_variation(kept[side], spreads) for side in sides):
            return _Change(RowRange(row, False), log.starts[used], of_force, ratio)
    return None


def _sides(log: LogBlocks, block: int) -> tuple[slice, slice]:
    """Rows before a block, and from it on."""
    row = int(log.rows[block][0])
    return slice(row), slice(row, None)


def _ratio_at_levels(kept: np.ndarray, moved: np.ndarray, sides: tuple[slice, slice]) -> float | None:
    """How much more one stream changes in the second part where the other one changes alike; None: it does not.

    Levels count that both parts have: the rise of the median from the lower to the upper third of them.
    """
    ranges = np.array([np.percentile(kept[side], (5, 95)) for side in sides])
    low, high = ranges[:, 0].max(), ranges[:, 1].min()
    if high - low < MIN_OVERLAP * np.diff(ranges, axis=1).max():
        return None
    third = (high - low) / 3
    rises = []
    for side in sides:
        level, other = kept[side], moved[side]
        lower, upper = other[(level >= low) & (level <= low + third)], other[(level >= high - third) & (level <= high)]
        if not len(lower) or not len(upper):
            return None
        rises.append(float(np.median(upper) - np.median(lower)))
    return rises[1] / rises[0] if rises[0] * rises[1] > 0 else None
