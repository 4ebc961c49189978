"""Compare the times of the table of presses with the force."""

import numpy as np

from ...presses.streams import index_ranges
from ...presses.timing.onsets import ramp_delay
from ...presses.timing.windows import PressWindows
from ...session import PressTable
from ...session.units import SECOND
from ..evidence import PressEvidence
from ..report import Finding, Severity
from .clocks import (
    ALLOWED_SHIFT,
    DELAY_SPREADS,
    MIN_ALLOWED_SHIFT,
    MIN_CHANGE_SHARE,
    MIN_CORRELATION,
    MIN_GAIN,
    beside,
    stream_lag,
)
from .statistics import StreamStatistics

MIN_RAMP_SHARE = 0.05  # of the force of a press, over its ramp: the force has begun to rise
LARGE, LOADED = 0.9, 0.2  # quantile of the force that a press reaches, and the share of it from which it is loaded
REMEDY = "the clocks disagree: move the times of the table, or leave it out so that presses are detected"


def table_clock_finding(force: StreamStatistics, evidence: PressEvidence) -> Finding | None:
    """How the times of the table of presses disagree with the force, if they do."""
    table = evidence.presses
    if not isinstance(table, PressTable) or force.dead.all():
        return None
    presses, windows = evidence.compared()
    onset = ramp_delay(force.stream, presses, windows)
    ramp = float(np.median(presses.t_hold0 - presses.t_press)) / SECOND
    allowed = max(ALLOWED_SHIFT * ramp, MIN_ALLOWED_SHIFT) + 2 / force.row.nominal_rate
    lag, clear = _table_lag(force, table)
    # A second contact raises the force again: only what the whole rise shares is a matter of clocks.
    begun = _ramp_share(force, windows) > MIN_RAMP_SHARE
    late = (
        onset.presses
        and abs(onset.shift) > max(allowed, DELAY_SPREADS * onset.spread)
        and not (onset.shift > 0 and begun)
    )
    length = float(np.median(presses.t_release - presses.t_press)) / SECOND
    clear = clear and abs(lag) > allowed and not (0 < lag < length and begun)
    if late or clear:
        delay = lag if clear and (not late or abs(lag - onset.delay) > 2 * allowed) else onset.delay
        what = f"the force rises {beside(delay)} the presses of the table; their ramps take {ramp:.2f} s"
        return Finding(Severity.ERROR, "/presses", what, REMEDY)
    growth = _lag_growth(force, table)
    if abs(onset.change) > allowed and MIN_CHANGE_SHARE < growth / onset.change < 1:
        sense = "late" if onset.change < 0 else "early"
        what = (
            f"the presses of the table come more and more {sense}, by {abs(onset.change):.3f} s from the first to the "
            "last ones, compared with the force: a clock runs at another rate, or has jumped"
        )
        return Finding(Severity.ERROR, "/presses", what, REMEDY)
    return None


def _ramp_share(force: StreamStatistics, windows: PressWindows) -> float:
    """Mean force over the ramps of the table, of the largest force of each press; median over the presses.

    It is a half for an even ramp, less for the first of two contacts, and nothing where the force comes later.
    """
    values, shares = force.stream.read()[:, 0], []
    for before, ramp, hold in zip(windows.rest_before, windows.ramp, windows.hold, strict=True):
        rest, rise, press = (
            values[slice(*index_ranges(force.time, np.array([w]))[0])] for w in (before, ramp, [ramp[0], hold[1]])
        )
        if all(np.isfinite(part).any() for part in (rest, rise, press)):
            level = np.nanmedian(rest)
            top = float(np.nanmax(press - level))
            shares.append(float(np.nanmean(rise - level)) / top if top > 0 else 0.0)
    return float(np.nanmedian(shares)) if shares else 1.0


def _lag_growth(force: StreamStatistics, presses: PressTable) -> float:
    """Lag of the force after the table in the second half of the recording, less that in the first one, s."""
    middle = float(force.time[0] + force.time[-1]) / 2
    (first, _), (second, _) = (_table_lag(force, presses, *half) for half in ((-np.inf, middle), (middle, np.inf)))
    return second - first


def _table_lag(
    force: StreamStatistics, presses: PressTable, start: float = -np.inf, stop: float = np.inf
) -> tuple[float, bool]:
    """The lag (s) that makes the force resemble the table most, and whether it resembles it only so.

    By the samples from ``start`` to ``stop``, ns.
    """
    edges = np.stack([presses.t_press, presses.t_hold0, presses.t_hold1, presses.t_release], 1).ravel()
    some = (force.time >= start) & (force.time <= stop)
    if some.sum() < 2 or (np.diff(edges) < 0).any():
        return 0.0, False
    time = force.time[some]
    profile = np.interp(time, edges, np.tile([0.0, 1.0, 1.0, 0.0], len(presses)))
    # Whether there is a press counts here, not its force, which may be wrong by itself.
    above = np.nan_to_num(force.stream.read()[some, 0], nan=0.0)
    above -= np.quantile(above, 1 - LARGE)
    values = np.clip(above, 0.0, LOADED * float(np.quantile(above, LARGE)))
    lag, moved, unmoved = stream_lag((time, profile), (time, values))
    return lag, moved > MIN_CORRELATION and moved - unmoved > MIN_GAIN
