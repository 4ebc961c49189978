"""Find copies in a log: stretches of samples that come twice, and one column that was imported as two streams."""

from collections.abc import Iterator, Mapping

import numpy as np

from ...presses.streams import true_runs
from ...session.units import SECOND, UNITS
from ..report import Finding, Severity
from ..streams.statistics import StreamStatistics
from .blocks import MAX_CELLS, LogBlocks

MIN_LENGTH, MIN_SHARE = 100, 0.05  # samples of a copy, and their share of the log
MIN_DISTINCT = 0.25  # of the samples of a copy: channels at rest repeat few values
SAME = 2e-7  # of the largest value: rounding of single precision; sensors differ by more
# One column imported as two streams: what their units make of it. Another ratio may be that of an ideal sensor.
RATIOS = np.unique([unit.factor / load.factor for unit in UNITS.values() for load in UNITS.values() if load.si == "N"])


def log_copy_finding(statistics: Mapping[str, StreamStatistics], signal: str) -> Iterator[Finding]:
    """A stretch of samples of force and channels that comes twice, which no noise allows."""
    streams = [statistics[name] for name in ("force", signal)]
    time = streams[1].time
    if not np.array_equal(streams[0].time, time):
        streams = streams[1:]
    if streams[-1].stream.channels * len(time) > MAX_CELLS or len(time) < 2 * MIN_LENGTH:
        return
    prints = np.stack([stats.fingerprint for stats in streams], 1)
    found = repeated_stretch(np.unique(prints, axis=0, return_inverse=True)[1].ravel())
    if found is None:
        return
    first, count, shift = found
    if len(np.unique(prints[first : first + count, -1])) < MIN_DISTINCT * count:
        return
    start, seconds, back = (
        float(time[b] - time[a]) / SECOND for a, b in ((0, first), (first, first + count - 1), (first - shift, first))
    )
    what = (
        f"the samples from {start:.1f} s after the start on are exact copies of those {back:.1f} s earlier, for "
        f"{seconds:.1f} s: what is held out of a fit would be what was fitted"
    )
    yield Finding(Severity.ERROR, f"/streams/{signal}", what, "keep one copy of what was recorded")


def repeated_stretch(number: np.ndarray) -> tuple[int, int, int] | None:
    """The longest stretch that was there before: first row, length, and rows back to the original; None: there is none.

    Args:
        number: (samples,) integers from 0 on that equal samples share.
    """
    length = max(MIN_LENGTH, int(MIN_SHARE * len(number)))
    if len(number) < 2 * length:
        return None
    drawn = np.random.default_rng(0).integers(0, 1 << 63, number.max() + 1, dtype=np.uint64)
    total = np.concatenate([np.zeros(1, np.uint64), np.cumsum(drawn[number], dtype=np.uint64)])
    window = total[length:] - total[:-length]  # equal for equal windows, whatever wraps
    order = np.argsort(window, kind="stable")
    shifts = np.diff(order)[np.diff(window[order]) == 0]
    shifts = shifts[shifts >= length]
    if not len(shifts):
        return None
    shift = int(np.bincount(shifts).argmax())
    runs = true_runs(number[shift:] == number[:-shift])
    counts = np.diff(runs, axis=1)[:, 0]
    if counts.max(initial=0) < length:
        return None
    longest = int(counts.argmax())
    return int(runs[longest, 0]) + shift, int(counts[longest]), shift


def same_column_finding(log: LogBlocks) -> Iterator[Finding]:
    """A channel that is the force itself, perhaps in another unit."""
    largest = int(np.abs(log.force).argmax())
    if np.ptp(log.force) == 0:
        return
    ratio = log.values[largest] / log.force[largest]
    away = np.abs(log.values - ratio * log.force[:, None]).max(0)
    of_unit = np.isclose(ratio[:, None], RATIOS, rtol=SAME, atol=0).any(1)
    same = np.flatnonzero((away <= SAME * np.abs(log.values[largest])) & of_unit)
    if len(same):
        column = log.column[same[0]]
        what = f"column {column} is the force times {ratio[same[0]]:.6g} in every sample: one column for two streams"
        yield Finding(Severity.ERROR, f"/streams/{log.signal}", what, "import each stream from a column of its own")
