"""Find streams, or channels of them, that stand still: a device that sends its last values for ever."""

from collections.abc import Iterator

import numpy as np

from ...presses.streams import true_runs
from ...session.units import SECOND
from ..report import Finding, Severity
from .statistics import MAX_COPIED_FRAMES, MIN_FRAME_CHANNELS, StreamStatistics

EXAMINED_VARIABLES = ("force", "pressure", "voltage", "counts")  # a stage or a thermometer may stand still
MAX_EQUAL = 0.3  # of the frames beside the run: above it the noise is less than a step of the converter
CHANCE = 1e-9  # that a run as long comes from noise
MIN_FRAMES, MIN_SECONDS = 20, 0.3  # of a run
BESIDE = 4096  # frames before or after a run that tell whether there is a signal
NOISE_SPREAD = 1.5  # standard deviation over that of white noise with the same differences; above it there is a signal
NEAR_STEPS = 10  # steps of a usual difference of two values, within which values are at the same level
TIMES_LONGER = 10  # than the second longest run, because an honest stream rests more than once


def stuck_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """One run of equal frames, or of equal values of one channel, that the noise of the stream does not explain.

    Frames of many channels have a stricter check, `copy_findings`, which looks for copies throughout the recording. A
    run at the ends of the range is that of a sensor that clips, if beside the run there is more than noise that could
    have driven it there.
    """
    row = stats.row
    if row.variable not in EXAMINED_VARIABLES:
        return
    held = np.diff(stats.fingerprint, prepend=np.nan) == 0
    if row.variable == "voltage" and row.channels >= MIN_FRAME_CHANNELS and held.mean() > MAX_COPIED_FRAMES:
        return
    run = _run(held, stats.time)
    if run is not None and not _clips(stats, *run):
        yield _finding(stats, *run, "equal frames")
    elif 1 < row.channels < MIN_FRAME_CHANNELS:
        yield from _channel_findings(stats)


def _channel_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """Single channels that stand still while they did not at the same level before or after."""
    values = stats.stream.read()
    for channel, column in enumerate(values.T):
        held = np.diff(column, prepend=np.nan) == 0
        run = None if stats.dead[channel] else _run(held, stats.time)
        if run is None:
            continue
        first, end = run
        level, inside = column[first], np.zeros(len(column), bool)
        inside[first:end] = True
        step = np.median(np.abs(np.diff(column[~inside])))
        near = ~inside & (np.abs(column - level) <= NEAR_STEPS * step)
        # A coarse converter stands still at some levels, such as that of rest, and a sensor that clips at its end.
        if level in (stats.low[channel], stats.high[channel]) or (near.any() and held[near].mean() > MAX_EQUAL):
            continue
        yield _finding(stats, first, end, "equal values", f"column {channel} ")


def _run(held: np.ndarray, time: np.ndarray) -> tuple[int, int] | None:
    """First frame and end of the one run of frames that equal the one before, if it is no work of chance."""
    runs = true_runs(held)
    if not len(runs):
        return None
    lengths = np.diff(runs, axis=1)[:, 0]
    longest = int(lengths.argmax())
    first, last = int(runs[longest, 0]) - 1, int(runs[longest, 1]) - 1
    size, seconds = int(lengths[longest]), float(time[last] - time[first]) / SECOND
    if size < MIN_FRAMES or seconds < MIN_SECONDS or size <= TIMES_LONGER * np.delete(lengths, longest).max(initial=1):
        return None
    equal = (held.sum() - size + 1) / (len(held) - size + 1)
    if equal > MAX_EQUAL or len(held) * equal**size > CHANCE:
        return None
    return first, last + 1


def _finding(stats: StreamStatistics, first: int, end: int, what: str, subject: str = "") -> Finding:
    start, seconds = ((stats.time[b] - stats.time[a]) / SECOND for a, b in ((0, first), (first, end - 1)))
    text = f"{subject}stands still for {seconds:.3g} s, {start:.2f} s after its start: {end - first} {what}"
    return Finding(
        Severity.WARNING, f"/streams/{stats.row.name}", text, "check the device and its link, and record again"
    )


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
