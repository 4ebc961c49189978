"""Check the force of a recording: its sign, its unit, and whether it agrees with the presses and the pressures."""

from collections.abc import Iterator, Mapping

import numpy as np

import jaxeit as je

from ...presses.streams import finite_mean, index_ranges, resample, true_runs
from ...presses.timing.times import PressColumns
from ...session import PressTable
from ...session.units import SECOND
from ..evidence import PressEvidence
from ..parts import flagged_part
from ..report import Finding, Severity, counted, listed
from ..streams.statistics import StreamStatistics
from .targets import target_findings

WHERE = "/streams/force"
# Force over pressure times area of the pads: 1 for a pad that carries the press alone, more where walls bear a part.
BORNE_RATIO_RANGE = 0.03, 30.0
MIN_PRESS_FRACTION = 0.1  # of the median force: a press below it is none
UNLISTED_FRACTION = 0.3  # of the usual force, from which a contact should have been listed
MIN_UNLISTED_SECONDS = 0.2  # a shorter contact is a knock
MEDIAN_STEP = 0.954  # median size of a difference of two values of white noise, of their standard deviation
SILENT = 3.0  # standard deviations of a sample
MOSTLY = 0.85  # of the presses: so many negative ones are all of them
MIN_FOLLOWING = 0.3  # correlation, without sign, of pressure and force, from which its sign counts


def is_negative(statistics: Mapping[str, StreamStatistics], inverse: PressColumns) -> bool:
    """Whether the presses found in the negated force are real.

    A recording that begins in mid-press has a rest below its first force, and so looks inverted. The force must be
    below zero in those presses, and where pads rise, they must rise as it falls.
    """
    force = statistics["force"].stream
    values, time = force.read()[:, 0], force.time
    holds = index_ranges(time, np.stack([inverse.t_hold0, inverse.t_hold1], 1)[inverse.accepted])
    level = np.array([finite_mean(values[a:b]) for a, b in holds])
    if not np.nanmedian(level) < 0:
        return False
    follows = _correlation_with_pressure(statistics, time, values)
    return follows < 0 if abs(follows) > MIN_FOLLOWING else True


def _correlation_with_pressure(
    statistics: Mapping[str, StreamStatistics], time: np.ndarray, force: np.ndarray
) -> float:
    pressure = statistics.get("pressure")
    if pressure is None or pressure.row.variable != "pressure":
        return 0.0
    total = resample(pressure.time, pressure.stream.read().sum(1, keepdims=True), time)[:, 0]
    good = np.isfinite(total) & np.isfinite(force)
    if good.sum() < 2 or np.ptp(total[good]) == 0 or np.ptp(force[good]) == 0:
        return 0.0
    return float(np.corrcoef(total[good], force[good])[0, 1])


def negative_force(when: str = "") -> Finding:
    """The finding that the sign of the force is reversed, always or ``when``."""
    remedy = "pressing is positive: negate the column at import, or turn the load cell over"
    return Finding(Severity.ERROR, WHERE, f"the force is negative while pressing{when}", remedy)


def is_silent(evidence: PressEvidence, stats: StreamStatistics) -> bool:
    """Whether the force stays within its noise in nearly all presses."""
    if evidence.force is None or not np.isfinite(evidence.force).any():
        return False
    steps = np.diff(stats.stream.read()[:, 0])
    noise = float(np.nanmedian(np.abs(steps))) / MEDIAN_STEP if np.isfinite(steps).any() else 0.0
    return bool(stats.dead.all() or np.nanquantile(np.abs(evidence.force), 0.9) < SILENT * noise)


def force_findings(evidence: PressEvidence, skin: je.Skin | None, stats: StreamStatistics) -> Iterator[Finding]:
    """Sign, target, pressures and completeness of the forces of the presses."""
    force = evidence.force
    if force is None or not stats.finite.any():
        return
    if not np.isfinite(force).any():
        yield Finding(Severity.ERROR, WHERE, "no press has a force", "check the load cell, and record again")
        return
    if is_silent(evidence, stats):
        what = (
            f"always reads {stats.low[0]:.4g} N" if stats.dead.all() else "no press changes the force beyond its noise"
        )
        yield Finding(Severity.ERROR, WHERE, what, "check the load cell and its cable, and record again")
        return
    start = int(stats.time[0])
    negative = [*_negative_findings(evidence, force, start)]
    yield from negative
    if negative:
        return
    off_target = [*target_findings(evidence, force, start)]
    yield from off_target
    if not off_target:
        yield from _borne_findings(evidence, force, skin)
    yield from _empty_findings(evidence, force)
    if isinstance(evidence.presses, PressTable):
        yield from _unlisted_findings(evidence, force, stats)


def _negative_findings(evidence: PressEvidence, force: np.ndarray, start: int) -> Iterator[Finding]:
    """Presses whose force falls; `force` (presses,) N."""
    falls = force < -MIN_PRESS_FRACTION * np.nanmedian(np.abs(force))
    if np.nanmedian(force) < 0 and falls.mean() > MOSTLY:
        yield negative_force()
        return
    part = flagged_part(falls)
    if part is not None:
        yield negative_force(when=f" {part.text(evidence.times, start)}")
    elif np.nanmedian(force) < 0:
        yield negative_force(when=f", in {falls.sum()} of {len(force)} presses")


def _borne_findings(evidence: PressEvidence, force: np.ndarray, skin: je.Skin | None) -> Iterator[Finding]:
    """A press changes the pressure of sealed pads by about its force over their area."""
    pressure = evidence.pressure
    if skin is None or pressure is None or pressure.shape[1] != len(skin.pads):
        return
    borne = np.nan_to_num(pressure) @ np.array([pad.area for pad in skin.pads])
    good = np.isfinite(force) & (force > 0) & (borne > 0)
    if good.sum() < len(force) / 2:
        return
    ratios, (low, high) = force[good] / borne[good], BORNE_RATIO_RANGE
    ratio = float(np.median(ratios))
    # Some pads or a part of the recording may be wrong, which other checks name.
    if max(np.mean(ratios <= low), np.mean(ratios >= high)) > MOSTLY:
        what = f"the force is {ratio:.3g} times what the pressures of the pads bear: a unit of one of the two is wrong"
        yield Finding(Severity.WARNING, WHERE, what, "compare the units of force (N) and pressure (Pa) at import")


def _empty_findings(evidence: PressEvidence, force: np.ndarray) -> Iterator[Finding]:
    """Presses of the list in which nothing was pressed."""
    idle = force < MIN_PRESS_FRACTION * np.nanmedian(force)
    if idle.any():
        rows = evidence.number[idle]
        what = f"{len(rows)} of {len(force)} presses are without force: {listed(rows)}"
        remedy = "compare the times of the table with the force, and press those places again"
        yield Finding(Severity.WARNING, "/presses", what, remedy)


def _unlisted_findings(evidence: PressEvidence, force: np.ndarray, stats: StreamStatistics) -> Iterator[Finding]:
    """Contacts with a good part of the usual force outside of all listed presses."""
    presses, time, values = evidence.presses, stats.time, stats.stream.read()[:, 0]
    listed_time = np.zeros(len(time), bool)
    for start, stop in index_ranges(time, np.stack([presses.t_press - SECOND // 2, presses.t_release + SECOND], 1)):
        listed_time[start:stop] = True
    rest = np.nanmedian(values[~listed_time]) if np.isfinite(values[~listed_time]).any() else np.nan
    loaded = ~listed_time & (values - rest > UNLISTED_FRACTION * np.nanmedian(force))
    runs = true_runs(loaded)
    seconds = (time[runs[:, 1] - 1] - time[runs[:, 0]]) / SECOND if len(runs) else np.empty(0)
    count = int((seconds > MIN_UNLISTED_SECONDS).sum())
    if count:
        first = (time[runs[seconds > MIN_UNLISTED_SECONDS][0, 0]] - time[0]) / SECOND
        what = f"{counted(count, 'contact')} outside the listed presses, the first {first:.2f} s after the start"
        remedy = "complete the table of presses, or leave it out so that presses are detected"
        yield Finding(Severity.WARNING, WHERE, what, remedy)
