"""Check the streams of a recording: statistics in one pass over every sample, then what is wrong with them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import jaxeit as je

from ...presses.streams import finite_mean, true_runs
from ...session import Session, SessionError, Status, Stream
from ...session.units import SECOND
from ..report import Finding, Severity, StreamRow, counted
from .blocks import block_size, spread_blocks

Progress = Callable[[Iterable[Any]], Iterable[Any]]

MAX_MISSING = 0.001  # tolerated fraction of missing values
MIN_MADE_UP = 0.5  # of the time of gaps that short intervals make up for, where they are jitter
IRREGULAR_FRACTION = 0.1  # of the intervals: more gaps than that are the rule of the stream, not its exception
MAX_RATE_ERROR = 0.02  # tolerated relative difference from the nominal rate
MEDIAN_SAMPLES = 64  # of a block, of which the typical sample is the median
MIN_FRAME_CHANNELS = 16  # so many noisy channels are never all equal twice, unless a frame was copied
MAX_COPIED_FRAMES = 0.1  # of the frames: some devices repeat a frame when they have no new one
RATE_RANGE = 0.2, 1e5  # Hz; a stream outside it has time stamps in another unit
PLAUSIBLE = {  # least and largest SI value of a bench or robot at work, and what is likely when one lies outside
    "temperature": (200.0, 450.0, "import it again in its unit (K, degC)"),
    "position": (-20.0, 20.0, "import it again in its unit (m, mm, um)"),
    "force": (-1e4, 1e4, "import it again in its unit (N, mN, g, kg)"),
}


@dataclass
class StreamStatistics:
    """Statistics of a stream; the arrays have one entry per channel.

    | field           | meaning                                                       |
    |-----------------|---------------------------------------------------------------|
    | row             | what the report says of the stream                            |
    | time            | time stamps (samples,) ns                                     |
    | finite          | number of finite values                                       |
    | low, high       | extreme values                                                |
    | at_low, at_high | number of samples at the extreme values                       |
    | full_scale      | number of values at or above the end of the sensor's span     |
    | activity        | rms difference of each sample from the typical one (samples,) |
    | fingerprint     | a number that equal samples share (samples,)                  |
    """

    stream: Stream
    row: StreamRow
    time: np.ndarray
    finite: np.ndarray
    low: np.ndarray
    high: np.ndarray
    at_low: np.ndarray
    at_high: np.ndarray
    full_scale: np.ndarray
    activity: np.ndarray
    fingerprint: np.ndarray

    @property
    def missing(self) -> np.ndarray:
        """Fraction of missing values per channel."""
        return 1 - self.finite / max(len(self.time), 1)

    @property
    def dead(self) -> np.ndarray:
        """Whether a channel has no finite value, or one and the same value in all samples."""
        return np.asarray((self.finite == 0) | ((self.low == self.high) & (len(self.time) > 1)))

    def flagged(self, flag: Status) -> int:
        """Number of samples with a status flag."""
        return dict(self.row.flags).get(str(flag.name), 0)


def stream_statistics(
    session: Session, skin: je.Skin | None, progress: Progress, findings: list[Finding]
) -> dict[str, StreamStatistics]:
    """Read every stream once. Streams without samples and damaged ones are added to ``findings`` and left out."""
    statistics = {}
    limits = {} if skin is None else {"pressure": full_scale(skin.pressure_sensor)}
    for name, stream in session.streams.items():
        if not len(stream):
            findings.append(Finding(Severity.ERROR, f"/streams/{name}", "holds no sample", "record again"))
            continue
        try:
            statistics[name] = _statistics(stream, limits.get(name, np.inf), progress)
        except SessionError as error:
            what = f"cannot be read: {error}"
            findings.append(Finding(Severity.ERROR, f"/streams/{name}", what, "use the original of the file"))
    return statistics


def full_scale(sensor: je.skin.PressureSensor) -> float:
    """Pressure (Pa) from which a sensor may be at the end of its span."""
    return sensor.maximum - sensor.accuracy


def _statistics(stream: Stream, limit: float, progress: Progress) -> StreamStatistics:
    n = stream.channels
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    finite, at_low, at_high, full = (np.zeros(n, int) for _ in range(4))
    activity, fingerprint = np.zeros(len(stream)), np.zeros(len(stream))
    weights = np.random.default_rng(0).uniform(1.0, 2.0, n)
    for start, stop, values in progress(stream.blocks()):
        good = np.isfinite(values)
        finite += good.sum(0)
        if np.isfinite(limit):
            full += (values >= limit).sum(0)
        low_side, high_side = (values, -values) if good.all() else np.where(np.isnan(values), np.inf, (values, -values))
        at_low, low = _count_extreme(low_side, at_low, low)
        at_high, high = _count_extreme(high_side, at_high, -high)
        high = -high
        activity[start:stop] = _activity(values)
        fingerprint[start:stop] = np.nan_to_num(values) @ weights
    missing = 1 - finite.sum() / (n * len(stream))
    row = _summary_row(stream, missing)
    return StreamStatistics(stream, row, stream.time, finite, low, high, at_low, at_high, full, activity, fingerprint)


def _activity(values: np.ndarray) -> np.ndarray:
    """Rms difference of the samples of a block from its median sample, which is that of rest if rest prevails."""
    some = values[:: max(len(values) // MEDIAN_SAMPLES, 1)]
    good = np.isfinite(some).all(0)
    away = values[:, good] - np.median(some[:, good], axis=0)
    return np.asarray(np.sqrt(finite_mean(away.T**2)) if good.any() else np.zeros(len(values)))


def _count_extreme(values: np.ndarray, count: np.ndarray, lowest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Update the lowest value, and the number of samples that have it, with one more block of values."""
    now = np.minimum(lowest, values.min(0))
    return np.where(now < lowest, 0, count) + (values == now).sum(0), now


def _summary_row(stream: Stream, missing: float) -> StreamRow:
    time, block = stream.time, block_size(stream.time)
    steps = np.diff(spread_blocks(time, block) if block else time) / SECOND
    period = float(np.median(steps)) if len(steps) else np.nan
    long = steps > 1.5 * period
    off = np.abs(steps[~long] - period)
    return StreamRow(
        name=stream.name,
        variable=stream.variable,
        unit=stream.unit,
        channels=stream.channels,
        samples=len(stream),
        seconds=float(time[-1] - time[0]) / SECOND,
        nominal_rate=stream.nominal_rate,
        rate=1 / period,
        gaps=int(long.sum()),
        longest_gap=float(steps[long].max(initial=0.0)),
        dropped=_dropped(stream, steps[long], period),
        jitter=float(np.quantile(off, 0.95)) if len(off) else 0.0,
        missing=float(missing),
        flags=_flags(stream),
    )


def _dropped(stream: Stream, gaps: np.ndarray, period: float) -> int:
    seq = stream.seq
    if seq is None:
        return int((np.rint(gaps / period) - 1).sum())
    steps = np.diff(seq).astype(np.int64)  # differences of unsigned numbers: a wrap is a step of one
    return int(np.maximum(steps - 1, 0).sum())


def _flags(stream: Stream) -> tuple[tuple[str, int], ...]:
    status = stream.status()
    if status is None:
        return ()
    counts = [(str(f.name), int(((status & f.value) != 0).sum())) for f in Status]
    return tuple((name, count) for name, count in counts if count)


FLAG_TEXTS = {
    Status.saturated: ("beyond the converter's range", "lower the gain or the drive current"),
    Status.clock_step: ("after a step of the clock", "compare the onsets of the streams below"),
    Status.disconnected: ("while disconnected", "check plug and cable"),
    Status.crc_resync: ("after damaged frames", "check the cable, or lower the serial speed"),
}


def stream_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """Wrong rates, gaps, lost samples, missing values, copies, impossible values and status flags of one stream."""
    row, where = stats.row, f"/streams/{stats.row.name}"
    yield from _rate_findings(stats)
    yield from _block_findings(stats)
    if row.gaps and (
        _gaps_are_jitter(stats) if row.gaps <= IRREGULAR_FRACTION * row.samples else _as_many_as_stated(stats)
    ):
        what = f"its time stamps jitter by {1e3 * row.jitter:.3g} ms, but it holds as many samples as its rate states"
        yield Finding(Severity.OK, where, what, "stamp samples by the device's clock")
    elif row.gaps > IRREGULAR_FRACTION * row.samples:
        share = f"{100 * row.gaps / row.samples:.0f} % of intervals exceed one and a half periods"
        what = f"comes irregularly: {share}, the longest {row.longest_gap:.3g} s"
        yield Finding(Severity.WARNING, where, what, "check the recorder; lost samples cannot be counted")
    elif row.gaps:
        steps = np.diff(stats.time)
        start = (stats.time[steps.argmax()] - stats.time[0]) / SECOND
        what = (
            f"{counted(row.gaps, 'gap')}, the longest of {row.longest_gap:.3g} s, {start:.2f} s after its start; "
            f"{row.dropped} samples lost"
        )
        yield Finding(Severity.WARNING, where, what, "presses without samples are set aside; check the link")
    elif row.dropped:
        what = f"{row.dropped} samples were lost according to the sequence numbers"
        yield Finding(Severity.WARNING, where, what, "check the link")
    yield from _missing_findings(stats)
    yield from _value_findings(stats)
    for flag, (what, remedy) in FLAG_TEXTS.items():
        count = stats.flagged(flag)
        if count:
            yield Finding(Severity.WARNING, where, f"{count} samples {what} (flag {flag.name})", remedy)
    if stats.flagged(Status.unchecked):
        yield Finding(Severity.OK, where, "came without a checksum (flag unchecked)")


def _block_findings(stats: StreamStatistics) -> Iterator[Finding]:
    block = block_size(stats.time)
    if block:
        step = block / stats.row.rate
        what = f"its time stamps come in blocks of {block} samples with nearly one stamp, a block every {step:.3g} s"
        remedy = "stamp samples by the device's clock, or spread the stamps of a block up to those of the next one"
        yield Finding(Severity.WARNING, f"/streams/{stats.row.name}", what, remedy)


def _missing_findings(stats: StreamStatistics) -> Iterator[Finding]:
    bad = np.flatnonzero((stats.missing > MAX_MISSING) & (stats.finite > 0))
    if not len(bad):
        return
    worst = bad[stats.missing[bad].argmax()]
    what = (
        f"{100 * stats.row.missing:.2g} % of values are missing or not finite, in {len(bad)} of "
        f"{stats.row.channels} channels, most in channel {worst} ({100 * stats.missing[worst]:.2g} %)"
    )
    yield Finding(Severity.WARNING, f"/streams/{stats.row.name}", what, "check the wiring of that channel")


def _mean_rate(stats: StreamStatistics) -> float:
    """Samples a second (Hz) over the whole stream."""
    seconds = stats.row.seconds
    return (len(stats.time) - 1) / seconds if seconds > 0 else float("nan")


def _gaps_are_jitter(stats: StreamStatistics) -> bool:
    """Whether samples that came early make up for gaps: a lost sample leaves a gap and no short interval."""
    steps, period = np.diff(stats.time) / SECOND, 1 / stats.row.rate
    long, short = steps > 1.5 * period, steps < 0.5 * period
    early, late = float((period - steps[short]).sum()), float((steps[long] - period).sum())
    return _as_many_as_stated(stats) and early > MIN_MADE_UP * late


def _as_many_as_stated(stats: StreamStatistics) -> bool:
    return abs(_mean_rate(stats) / stats.row.nominal_rate - 1) <= MAX_RATE_ERROR


def _rate_findings(stats: StreamStatistics) -> Iterator[Finding]:
    row, where = stats.row, f"/streams/{stats.row.name}"
    low, high = RATE_RANGE
    # A gap of a day moves the mean alone.
    if row.seconds > 1 / low and not any(low < rate < high for rate in (_mean_rate(stats), row.rate)):
        what = f"comes at {_mean_rate(stats):.3g} Hz, {row.seconds:.4g} s in all: are its time stamps in another unit?"
        yield Finding(Severity.WARNING, where, what, "import it again with the unit of its clock (s, ms, us, ns)")
    # Jitter moves the median interval and gaps move the mean, so that a wrong rate must show in both.
    wrong = np.isfinite(row.rate) and abs(row.rate / row.nominal_rate - 1) > MAX_RATE_ERROR
    if wrong and not _as_many_as_stated(stats):
        what = f"comes at {row.rate:.4g} Hz, not at the nominal {row.nominal_rate:.4g} Hz"
        yield Finding(Severity.WARNING, where, what, "correct nominal_rate_hz, or the recorder's clock")


def _value_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """Values that cannot be true; EIT and pressure have checks of their own."""
    where, variable = f"/streams/{stats.row.name}", stats.row.variable
    if variable not in PLAUSIBLE:
        return
    if not stats.finite.any():
        remedy = "check the sensor and its cable, and record again"
        yield Finding(Severity.ERROR, where, "holds no finite value", remedy)
        return
    low, high, remedy = PLAUSIBLE[variable]
    least, largest = stats.low.min(), stats.high.max()
    if least < low or largest > high:
        what = f"{variable} from {least:.4g} to {largest:.4g} {stats.row.unit} cannot be true"
        yield Finding(Severity.WARNING, where, what, remedy)


def copy_findings(stats: StreamStatistics) -> Iterator[Finding]:
    """Frames that equal the one before, or frames of an earlier part of the recording; not for noise-free frames."""
    prints, where = stats.fingerprint, f"/streams/{stats.row.name}"
    if stats.row.channels < MIN_FRAME_CHANNELS or stats.row.variable != "voltage" or len(np.unique(prints)) < 2:
        return
    held = np.diff(prints, prepend=np.nan) == 0
    if held.mean() > MAX_COPIED_FRAMES:
        runs = true_runs(held)
        first, last = runs[np.diff(runs, axis=1)[:, 0].argmax()]
        start, seconds = ((stats.time[b] - stats.time[a]) / SECOND for a, b in ((0, first), (first - 1, last - 1)))
        what = (
            f"{100 * held.mean():.0f} % of its frames equal the one before, the longest for {seconds:.3g} s, "
            f"{start:.2f} s after its start"
        )
        yield Finding(Severity.WARNING, where, what, "read the device once a scan, and check its link")
    new = prints[~held]
    copied = len(new) - len(np.unique(new))
    if copied > MAX_COPIED_FRAMES * len(new):
        what = f"{100 * copied / len(new):.0f} % of its frames are exact copies of earlier ones"
        yield Finding(Severity.WARNING, where, what, "keep one copy of what was recorded")
