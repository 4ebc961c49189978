"""Find streams of few channels that stand still: a device that sends its last values for ever."""

from collections.abc import Iterator

import numpy as np

from ...presses.streams import true_runs
from ...session.units import SECOND
from ..report import Finding, Severity
from .statistics import MIN_FRAME_CHANNELS, StreamStatistics

EXAMINED = ("force", "pressure", "voltage", "counts")  # a stage or a thermometer may stand still
MAX_EQUAL = 0.3  # of the frames beside the run: above it the noise is less than a step of the converter
CHANCE = 1e-9  # that a run as long comes from noise
MIN_FRAMES, MIN_SECONDS = 20, 0.3  # of a run
BESIDE = 4096  # frames before or after a run that tell whether there is a signal
NOISE_SPREAD = 1.5  # standard deviation over that of white noise with the same differences; above it there is a signal
TIMES_LONGER = 10  # than the second longest run, because an honest stream rests more than once


def stuck_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """One run of equal frames that the noise of the stream does not explain.

    Frames of many channels have a stricter check, `copy_findings`. A run at the ends of the range of all channels is
    that of a sensor that clips, if beside the run there is more than noise that could have driven it there.
    """
    row = stats.row
    if row.variable not in EXAMINED or (row.variable == "voltage" and row.channels >= MIN_FRAME_CHANNELS):
        return
    held = np.diff(stats.fingerprint, prepend=np.nan) == 0
    runs = true_runs(held)
    if not len(runs):
        return
    lengths = np.diff(runs, axis=1)[:, 0]
    longest = int(lengths.argmax())
    first, last = int(runs[longest, 0]) - 1, int(runs[longest, 1]) - 1
    size, seconds = int(lengths[longest]), float(stats.time[last] - stats.time[first]) / SECOND
    if size < MIN_FRAMES or seconds < MIN_SECONDS or size <= TIMES_LONGER * np.delete(lengths, longest).max(initial=1):
        return
    equal = (held.sum() - size + 1) / (len(held) - size + 1)
    if equal > MAX_EQUAL or len(held) * equal**size > CHANCE or _clips(stats, first, last + 1):
        return
    start = (stats.time[first] - stats.time[0]) / SECOND
    what = f"stands still for {seconds:.3g} s, {start:.2f} s after its start: {size + 1} equal frames"
    yield Finding(Severity.WARNING, f"/streams/{row.name}", what, "check the device and its link, and record again")


def _clips(stats: StreamStatistics, first: int, end: int) -> bool:
    """Whether the frames of a run lie at the ends of the range, and the frames beside it do more than scatter."""
    values = stats.stream.read(first, first + 1)[0]
    if not (np.isnan(values) | (values <= stats.low) | (values >= stats.high)).all():
        return False
    after = len(stats.time) - end
    begin = max(first - BESIDE, 0) if first >= after else end
    return not _only_noise(stats.stream.read(begin, first if first >= after else min(end + BESIDE, len(stats.time))))


def _only_noise(values: np.ndarray) -> bool:
    """Whether no channel varies by more than its differences from sample to sample explain (von Neumann 1941)."""
    if len(values) < MIN_FRAMES:
        return False
    scatter = np.sqrt((np.diff(values, axis=0) ** 2).mean(0) / 2)
    return bool((values.std(0) <= NOISE_SPREAD * scatter).all())
