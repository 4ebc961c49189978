"""Ask whether the channels of a log follow its force, and whether both go on throughout the log."""

from collections.abc import Iterator

import numpy as np
import scipy

from ...presses.channel_faults import MIN_ARRAY_CHANNELS, rank_correlation
from ...presses.streams import true_runs
from ..report import Finding, Severity
from .blocks import SPREAD_PERCENTILES, LogBlocks, usual

NO_RELATION = 0.2  # correlation, in the whole log and in its blocks, below which a channel tells nothing of the force
LAGGED = 0.3  # the same where the channel may come early or late by up to a quarter of the log
RELATED_CORRELATION = 0.6  # rank correlation in a block in which a channel follows the force
CHANGES = 3.0  # times the noise: what varies more is no noise
STILL, GOES_ON = 0.02, 0.7  # of the usual spread: of a stream that stands still, and of one that goes on
MIN_STILL = 2  # blocks in turn
MIN_TURNS = 3  # of the stream that goes on, from end to end of its range


def unrelated_finding(log: LogBlocks) -> Iterator[Finding]:
    """No channel has to do with the force; of an array, other checks name the channels that have not."""
    if len(log.column) >= MIN_ARRAY_CHANNELS or not _changes(log.force):
        return
    columns = np.column_stack([log.values, log.values.sum(1)])
    whole = max(abs(rank_correlation(column, log.force)) for column in columns.T)
    parts = float(np.median(np.abs(log.correlations), axis=1).max())
    if max(whole, parts) >= NO_RELATION or max(_lagged(column, log.force) for column in columns.T) >= LAGGED:
        return
    what = f"no channel follows the force: their largest rank correlation is {whole:.2f}"
    remedy = "check the sensor, its tube and its cable, and which columns were imported"
    yield Finding(Severity.ERROR, f"/streams/{log.signal}", what, remedy)


def _changes(values: np.ndarray) -> bool:
    """Whether values (n,) vary by more than their differences from sample to sample explain (von Neumann 1941)."""
    noise = np.sqrt((np.diff(values) ** 2).mean() / 2)
    return bool(values.std() > CHANGES * noise)


def _lagged(a: np.ndarray, b: np.ndarray) -> float:
    """Largest correlation, without sign, at any lag up to a quarter of the length."""
    a, b = ((v - v.mean()) / max(float(v.std()), np.finfo(float).tiny) for v in (a, b))
    middle, most = len(a) - 1, len(a) // 4
    return float(np.abs(scipy.signal.correlate(a, b)[middle - most : middle + most + 1]).max()) / len(a)


def standstill_findings(log: LogBlocks) -> Iterator[Finding]:
    """The force stands still while the channels go on (a load cell that was unplugged), or the channels do."""
    unrelated = (np.abs(log.correlations) < RELATED_CORRELATION).all(0)
    best = int(np.median(np.abs(log.correlations), axis=1).argmax())
    for rows in _standstills(log, unrelated & _still(log.force_spread)):
        if has_usual_variation(log.values[rows, best], log.spreads[best]):
            what = f"the force stays at {np.median(log.force[rows]):.4g} N {_when(log, rows)} while "
            what += f"column {log.column[best]} of {log.signal} goes on changing"
            yield Finding(Severity.ERROR, "/streams/force", what, "check the load cell and its cable, and record again")
    still = np.all([_still(spreads) for spreads in log.spreads], axis=0)
    for rows in _standstills(log, unrelated & still):
        if has_usual_variation(log.force[rows], log.force_spread):
            what = f"no channel changes {_when(log, rows)} while the force goes on changing"
            remedy = "check the sensor, its tube and its cable, and whether it was pressed"
            yield Finding(Severity.WARNING, f"/streams/{log.signal}", what, remedy)


def _still(spreads: np.ndarray) -> np.ndarray:
    return np.asarray(spreads < STILL * usual(spreads))


def _standstills(log: LogBlocks, flag: np.ndarray) -> list[slice]:
    """Rows of the runs of flagged blocks (blocks,)."""
    runs = [(int(a), int(b)) for a, b in true_runs(flag) if b - a >= MIN_STILL]
    return [slice(int(log.rows[a][0]), int(log.rows[b - 1][-1]) + 1) for a, b in runs]


def has_usual_variation(part: np.ndarray, spreads: np.ndarray) -> bool:
    """Whether values of a part go up and down as they usually do: creep and the filling of a pad go one way."""
    low, high = np.percentile(part, SPREAD_PERCENTILES)
    if not _changes(part) or high - low < GOES_ON * usual(spreads):
        return False
    quarter = (high - low) / 4
    ends = np.sign((part > high - quarter).astype(int) - (part < low + quarter))
    return bool((np.diff(ends[ends != 0]) != 0).sum() >= MIN_TURNS)


def _when(log: LogBlocks, rows: slice) -> str:
    ends = log.time[rows][[0, -1]]
    return f"from {ends[0]:.1f} s to {ends[1]:.1f} s after the start"
