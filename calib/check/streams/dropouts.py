"""Find devices that send one fixed value, mostly zero, when they have no reading."""

from collections.abc import Iterator

import numpy as np

from ..report import Finding, Severity
from .statistics import StreamStatistics
from .stuck import EXAMINED

MIN_FRAMES = 5  # with the value
TIMES_AWAY = 10  # from both neighbours, over what the neighbours differ by and a usual step of the stream
MIN_AWAY = 0.02  # of the range of the stream, from both neighbours
READ = 16  # frames that are read to see whether they hold numbers


def dropout_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """Single frames of one and the same value, far from the frames before and after, which are alike."""
    row, prints = stats.row, stats.fingerprint
    if row.variable not in EXAMINED or len(prints) < 3:
        return
    before, here, after = prints[:-2], prints[1:-1], prints[2:]
    apart = np.abs(after - before)
    usual = np.quantile(apart[apart > 0], 0.25) if apart.any() else np.inf  # many steps may be to the value and back
    least = np.maximum(TIMES_AWAY * (apart + usual), MIN_AWAY * np.ptp(prints))  # noise may grow and shrink
    away = np.flatnonzero((np.abs(here - before) > least) & (np.abs(here - after) > least)) + 1
    value, number = np.unique(prints[away], return_counts=True)
    if not len(value) or number.max() < MIN_FRAMES:
        return
    frames = away[prints[away] == value[number.argmax()]]
    held = [stats.stream.read(int(k), int(k) + 1)[0] for k in frames[:READ]]
    sound = [one for one in held if np.isfinite(one).all()]
    if not sound:  # missing values, which have a finding of their own
        return
    shown = f"all {sound[0][0]:.4g}" if np.ptp(sound[0]) == 0 else f"{sound[0][0]:.4g} and so on"
    what = (
        f"{len(frames)} single frames are one and the same, {shown}, between frames that are far from it: "
        "the device sends it when it has no reading"
    )
    yield Finding(Severity.WARNING, f"/streams/{row.name}", what, "mark these frames as missing, or mend the device")
