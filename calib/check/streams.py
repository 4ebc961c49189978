"""Check the streams of a recording: statistics in one pass over every sample, then what is wrong with them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import jaxeit as je

from ..session import Session, SessionError, Status, Stream
from ..session.units import SECOND
from .report import Finding, Severity, StreamRow, counted

Progress = Callable[[Iterable[Any]], Iterable[Any]]

MAX_MISSING = 0.001  # tolerated fraction of missing values
IRREGULAR_FRACTION = 0.1  # of the intervals: more gaps than that are the rule of the stream, not its exception
MAX_RATE_ERROR = 0.02  # tolerated relative difference from the nominal rate


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
    limits = {} if skin is None else {"pressure": _full_scale(skin.pressure_sensor)}
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


def _full_scale(sensor: je.skin.PressureSensor) -> float:
    return sensor.maximum - sensor.accuracy


def _statistics(stream: Stream, limit: float, progress: Progress) -> StreamStatistics:
    n = stream.channels
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    finite, at_low, at_high, full = (np.zeros(n, int) for _ in range(4))
    for _, _, values in progress(stream.blocks()):
        finite += np.isfinite(values).sum(0)
        full += (values >= limit).sum(0)
        at_low, low = _count_extreme(np.where(np.isnan(values), np.inf, values), at_low, low)
        at_high, high = _count_extreme(np.where(np.isnan(values), np.inf, -values), at_high, -high)
        high = -high
    missing = 1 - finite.sum() / (n * len(stream))
    return StreamStatistics(
        stream, _summary_row(stream, missing), stream.time, finite, low, high, at_low, at_high, full
    )


def _count_extreme(values: np.ndarray, count: np.ndarray, lowest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Update the lowest value, and the number of samples that have it, with one more block of values."""
    now = np.minimum(lowest, values.min(0))
    return np.where(now < lowest, 0, count) + (values == now).sum(0), now


def _summary_row(stream: Stream, missing: float) -> StreamRow:
    time = stream.time
    steps = np.diff(time) / SECOND
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
    """Wrong rates, gaps, lost samples, missing values and status flags of one stream."""
    row, where = stats.row, f"/streams/{stats.row.name}"
    if np.isfinite(row.rate) and abs(row.rate / row.nominal_rate - 1) > MAX_RATE_ERROR:
        what = f"comes at {row.rate:.4g} Hz, not at the nominal {row.nominal_rate:.4g} Hz"
        yield Finding(Severity.WARNING, where, what, "correct nominal_rate_hz, or the recorder's clock")
    if row.gaps > IRREGULAR_FRACTION * row.samples:
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
    for flag, (what, remedy) in FLAG_TEXTS.items():
        count = stats.flagged(flag)
        if count:
            yield Finding(Severity.WARNING, where, f"{count} samples {what} (flag {flag.name})", remedy)
    if stats.flagged(Status.unchecked):
        yield Finding(Severity.OK, where, "came without a checksum (flag unchecked)")


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
