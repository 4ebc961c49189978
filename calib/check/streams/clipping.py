"""Find channels that clip below the end of their stated span: flat tops that equal the largest value."""

from collections.abc import Iterator

import numpy as np

import jaxeit as je

from ...presses.channel_faults import MIN_ARRAY_CHANNELS
from ...presses.streams import true_runs
from ..report import Finding, Severity, counted
from .statistics import MIN_FRAME_CHANNELS, StreamStatistics, full_scale

CLIPPING = ("force", "pressure")  # variables of which the largest value counts
MIN_TOP = 5  # samples of one flat top; noise seldom repeats its largest value at all
MIN_SAMPLES = 20  # at the largest value
TIMES_OTHER = 5.0  # longer than any other run of equal values


def clipping_findings(stats: StreamStatistics, skin: je.Skin | None) -> Iterator[Finding]:
    """Channels whose largest value is that of many samples in a row, as no other value is."""
    row = stats.row
    # Arrays that no skin describes have a check of their own: `check_pads`.
    most = MIN_ARRAY_CHANNELS if skin is None else MIN_FRAME_CHANNELS
    if row.variable not in CLIPPING or row.channels >= most or (stats.at_high < MIN_SAMPLES).all():
        return
    limit = full_scale(skin.pressure_sensor) if skin is not None and row.variable == "pressure" else np.inf
    values = stats.stream.read()
    for channel in np.flatnonzero((stats.at_high >= MIN_SAMPLES) & ~stats.dead & (stats.high < limit)):
        column, high = values[:, channel], float(stats.high[channel])
        tops = _flat_tops(column, float(np.nanmedian(column)), high)
        if tops:
            name = f"column {channel} " if row.channels > 1 else ""
            what = (
                f"{name}clips at {high:.4g} {row.unit}: {stats.at_high[channel]} samples have this largest value, in "
                f"{counted(tops, 'flat top')}"
            )
            remedy = "choose a larger range or a lower gain of the sensor's amplifier, or press less"
            yield Finding(Severity.WARNING, f"/streams/{row.name}", what, remedy)


def _flat_tops(column: np.ndarray, rest: float, high: float) -> int:
    """Number of flat tops of a channel (samples,); 0 if it stands still at other values too, or rests at its largest.

    A coarse converter stands still at many values, and one that tracks zero does at rest.
    """
    held = np.diff(column, prepend=np.nan) == 0
    runs = true_runs(held)
    if not high > rest or not len(runs):
        return 0
    length, at_high = np.diff(runs, axis=1)[:, 0] + 1, column[runs[:, 0]] == high
    if length[at_high].max(initial=0) < TIMES_OTHER * length[~at_high].max(initial=1):
        return 0
    return int((length[at_high] >= MIN_TOP).sum())
