"""Streams and pads of a recording: one pass over every sample, then what is wrong with them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

import jaxeit as je
from calib.check.report import Finding, PadRow, Severity, StreamRow, counted
from calib.presses import SECOND
from calib.session import Session, SessionError, Status, Stream

Progress = Callable[[Iterable], Iterable]

_MISSING = 0.001  # tolerated fraction of missing values
_IRREGULAR = 0.1  # fraction of intervals that are gaps from which they are no exception
_RATE = 0.02  # tolerated difference from the nominal rate
_SMALLEST_PRESSURE = 5.0  # Pa; no touch is that light, but bar and kPa give such numbers


@dataclass
class Scan:
    """One pass over a stream: per channel how many values, their extremes and how often these occur.

    ``full_scale`` counts values at or above a given limit.
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
        """Channels without a value, or always with the same one."""
        return (self.finite == 0) | ((self.low == self.high) & (len(self.time) > 1))

    def flagged(self, flag: Status) -> int:
        """Samples with a status flag."""
        return dict(self.row.flags).get(str(flag.name), 0)


def scan_streams(
    session: Session, skin: je.Skin | None, progress: Progress, findings: list[Finding]
) -> dict[str, Scan]:
    scans = {}
    limits = {} if skin is None else {"pressure": _full_scale(skin.pressure_sensor)}
    for name, stream in session.streams.items():
        if not len(stream):
            findings.append(Finding(Severity.ERROR, f"/streams/{name}", "holds no sample", "record again"))
            continue
        try:
            scans[name] = _scan(stream, limits.get(name, np.inf), progress)
        except SessionError as error:
            what = f"cannot be read: {error}"
            findings.append(Finding(Severity.ERROR, f"/streams/{name}", what, "take the file's original"))
    return scans


def _full_scale(sensor: je.PressureSensor) -> float:
    return sensor.maximum - sensor.accuracy


def _scan(stream: Stream, limit: float, progress: Progress) -> Scan:
    n = stream.channels
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    finite, at_low, at_high, full = (np.zeros(n, int) for _ in range(4))
    for _, _, values in progress(stream.blocks()):
        finite += np.isfinite(values).sum(0)
        full += (values >= limit).sum(0)
        at_low, low = _extreme(np.where(np.isnan(values), np.inf, values), at_low, low)
        at_high, high = _extreme(np.where(np.isnan(values), np.inf, -values), at_high, -high)
        high = -high
    missing = 1 - finite.sum() / (n * len(stream))
    return Scan(stream, _row(stream, missing), stream.time, finite, low, high, at_low, at_high, full)


def _extreme(values: np.ndarray, count: np.ndarray, lowest: np.ndarray):
    """How often the lowest value occurs, and that value, with one more block."""
    now = np.minimum(lowest, values.min(0))
    return np.where(now < lowest, 0, count) + (values == now).sum(0), now


def _row(stream: Stream, missing: float) -> StreamRow:
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
    steps = np.diff(seq).astype(np.int64)  # of unsigned numbers: a wrap is a step of one
    return int(np.maximum(steps - 1, 0).sum())


def _flags(stream: Stream) -> tuple[tuple[str, int], ...]:
    status = stream.status()
    if status is None:
        return ()
    counts = [(str(f.name), int(((status & f.value) != 0).sum())) for f in Status]
    return tuple((name, count) for name, count in counts if count)


_FLAGS = {
    Status.saturated: ("beyond the converter's range", "lower the gain or the drive current"),
    Status.clock_step: ("after a step of the clock", "compare the onsets of the streams below"),
    Status.disconnected: ("while disconnected", "see to plug and cable"),
    Status.crc_resync: ("after damaged frames", "see to the cable, or lower the serial speed"),
}


def stream_findings(scan: Scan) -> Iterator[Finding]:
    row, where = scan.row, f"/streams/{scan.row.name}"
    if np.isfinite(row.rate) and abs(row.rate / row.nominal_rate - 1) > _RATE:
        what = f"comes at {row.rate:.4g} Hz, not at the nominal {row.nominal_rate:.4g} Hz"
        yield Finding(Severity.WARNING, where, what, "correct nominal_rate_hz, or the recorder's clock")
    if row.gaps > _IRREGULAR * row.samples:
        share = f"{100 * row.gaps / row.samples:.0f} % of intervals exceed one and a half periods"
        what = f"comes irregularly: {share}, the longest {row.longest_gap:.3g} s"
        yield Finding(Severity.WARNING, where, what, "see to the recorder; what it dropped cannot be told")
    elif row.gaps:
        steps = np.diff(scan.time)
        start = (scan.time[steps.argmax()] - scan.time[0]) / SECOND
        what = (
            f"{counted(row.gaps, 'gap')}, the longest of {row.longest_gap:.3g} s, {start:.2f} s after its start; "
            f"{row.dropped} samples lost"
        )
        yield Finding(Severity.WARNING, where, what, "presses without samples are set aside; see to the link")
    elif row.dropped:
        what = f"sequence numbers say that {row.dropped} samples were lost"
        yield Finding(Severity.WARNING, where, what, "see to the link")
    yield from _missing_findings(scan)
    for flag, (what, remedy) in _FLAGS.items():
        count = scan.flagged(flag)
        if count:
            yield Finding(Severity.WARNING, where, f"{count} samples {what} (flag {flag.name})", remedy)
    if scan.flagged(Status.unchecked):
        yield Finding(Severity.OK, where, "came without a checksum (flag unchecked)")


def _missing_findings(scan: Scan) -> Iterator[Finding]:
    bad = np.flatnonzero((scan.missing > _MISSING) & (scan.finite > 0))
    if not len(bad):
        return
    worst = bad[scan.missing[bad].argmax()]
    what = (
        f"{100 * scan.row.missing:.2g} % of values are missing or not finite, in {len(bad)} of "
        f"{scan.row.channels} channels, most in channel {worst} ({100 * scan.missing[worst]:.2g} %)"
    )
    yield Finding(Severity.WARNING, f"/streams/{scan.row.name}", what, "see to that channel's wiring")


# --- pads --------------------------------------------------------------------------------------------


def check_pads(scan: Scan | None, skin: je.Skin | None, findings: list[Finding]) -> tuple[PadRow, ...]:
    if scan is None or scan.row.variable != "pressure":
        return ()
    names = [f"column {i}" for i in range(scan.row.channels)]
    if skin is not None and len(skin.pads) == len(names):
        names = [p.name for p in skin.pads]
    elif skin is not None:
        what = f"has {len(names)} columns, the skin {skin.name!r} has {len(skin.pads)} pads"
        remedy = "record every pad, or describe the skin as it is in its TOML file"
        findings.append(Finding(Severity.ERROR, "/streams/pressure", what, remedy))
    rows = tuple(_pad(scan, i, name) for i, name in enumerate(names))
    findings += _pad_findings(scan, rows, skin)
    return rows


def _pad(scan: Scan, i: int, name: str) -> PadRow:
    some = scan.finite[i] > 0
    return PadRow(
        column=i,
        name=name,
        low=float(scan.low[i]) if some else np.nan,
        high=float(scan.high[i]) if some else np.nan,
        missing=float(scan.missing[i]),
        full_scale=float(scan.full_scale[i] / max(scan.finite[i], 1)),
        dead=bool(scan.dead[i]),
    )


def _pad_findings(scan: Scan, rows: tuple[PadRow, ...], skin: je.Skin | None) -> Iterator[Finding]:
    where = "/streams/pressure"
    for row in rows:
        if row.dead:
            how = "holds no finite sample" if np.isnan(row.low) else f"always reads {row.low:.4g} Pa"
            remedy = "see to its sensor and tube, and record again"
            yield Finding(Severity.ERROR, where, f"column {row.column}, pad {row.name!r}, {how}", remedy)
        if row.full_scale > _MISSING:
            share = f"at the end of the sensor's span in {100 * row.full_scale:.1f} % of samples"
            remedy = "press less, or set pressure_sensor.maximum in the skin's file"
            yield Finding(Severity.WARNING, where, f"column {row.column}, pad {row.name!r}, {share}", remedy)
    alive = [r for r in rows if not r.dead]
    if alive:
        yield from _pressure_unit(max(max(abs(r.low), abs(r.high)) for r in alive), skin)


def _pressure_unit(largest: float, skin: je.Skin | None) -> Iterator[Finding]:
    where, remedy = "/streams/pressure", "import again with the right unit (Pa, kPa, mbar, bar, psi)"
    span = je.PressureSensor().maximum if skin is None else skin.pressure_sensor.maximum
    if largest <= _SMALLEST_PRESSURE:
        what = f"no value exceeds {largest:.3g} Pa: were kPa or bar recorded as Pa?"
        yield Finding(Severity.WARNING, where, what, remedy)
    elif skin is not None and largest > 1.2 * span:
        what = f"the largest value, {largest:.4g} Pa, lies beyond the sensor's span of {span:.4g} Pa"
        yield Finding(Severity.WARNING, where, what, f"{remedy}; absolute pressure is not gage pressure")
