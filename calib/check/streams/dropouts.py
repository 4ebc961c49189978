"""Find devices that send one fixed value, mostly zero, when they have no reading."""

from collections.abc import Iterator

import numpy as np

from ..report import Finding, Severity
from .statistics import StreamStatistics
from .stuck import EXAMINED_VARIABLES

MIN_FRAMES = 5  # with the value
TIMES_AWAY = 10  # from both neighbours, over what the neighbours differ by and a usual step of the stream
MIN_AWAY = 0.02  # of the range of the stream, from both neighbours
TIMES_OTHERS = 3  # as often as the third most frequent of such values
MAX_COLUMNS, MAX_ROWS = 64, 1 << 20  # of a stream whose columns are looked at one by one
READ = 16  # frames that are read to see whether they hold numbers


def dropout_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """Single frames, or single values of a column of pressures, of one and the same value, far from those before and
    after, which are alike."""
    row = stats.row
    if row.variable not in EXAMINED_VARIABLES:
        return
    frames = _away(stats.fingerprint)
    held = [stats.stream.read(int(k), int(k) + 1)[0] for k in frames[:READ]]
    sound = [one for one in held if np.isfinite(one).all()]
    if sound:  # missing values have a finding of their own
        shown = f"all {sound[0][0]:.4g}" if np.ptp(sound[0]) == 0 else f"{sound[0][0]:.4g} and so on"
        yield _finding(row.name, f"{len(frames)} single frames are one and the same, {shown}, between frames that are")
    elif row.variable == "pressure" and 1 < row.channels <= MAX_COLUMNS:
        yield from _cell_findings(stats)


def _cell_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """Dropouts of single columns, which devices have that read each sensor by itself."""
    first = stats.stream.read(0, min(len(stats.time), MAX_ROWS))
    found = {
        column: (first[rows[0], column], len(rows))
        for column in range(first.shape[1])
        if len(rows := _away(first[:, column]))
    }
    if found:
        said = ", ".join(f"{value:.4g} in column {column} ({count})" for column, (value, count) in found.items())
        yield _finding(stats.row.name, f"single values are one and the same, {said}, between values that are")


def _away(values: np.ndarray) -> np.ndarray:
    """Rows of the value that stands most often far from those before and after; empty if none stands often."""
    none = np.zeros(0, int)
    if len(values) < 3 or not np.isfinite(values).any():
        return none
    before, here, after = values[:-2], values[1:-1], values[2:]
    apart = np.abs(after - before)
    usual = np.quantile(apart[apart > 0], 0.25) if (apart > 0).any() else np.inf  # many steps may be to it and back
    least = np.maximum(TIMES_AWAY * (apart + usual), MIN_AWAY * np.ptp(values[np.isfinite(values)]))  # noise may vary
    away = np.flatnonzero((np.abs(here - before) > least) & (np.abs(here - after) > least)) + 1
    value, number = np.unique(values[away], return_counts=True)
    often = np.sort(number)[::-1]
    # A device may send one value for no reading and one for an overflow; a hum repeats many values.
    if not len(value) or often[0] < MIN_FRAMES or (len(often) > 2 and often[2] > often[0] / TIMES_OTHERS):
        return none
    return np.asarray(away[values[away] == value[number.argmax()]])


def _finding(name: str, what: str) -> Finding:
    text = f"{what} far from it: the device sends it when it has no reading"
    return Finding(Severity.WARNING, f"/streams/{name}", text, "mark these values as missing, or mend the device")
