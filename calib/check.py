"""Validate a recording and explain what is wrong, where, and what to do about it."""

import tomllib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

import jaxeit as je
from calib.check_report import (
    ChannelTable,
    CheckReport,
    Finding,
    PadRow,
    PressSummary,
    Severity,
    StreamRow,
    render,
    to_json,
)
from calib.corrections import Estimate
from calib.order import OrderCheck, check_order, transfer_matrix
from calib.presses import (
    SECOND,
    Onset,
    PressError,
    Presses,
    check_overlap,
    dominant_pad,
    find_presses,
    onset_delays,
    press_means,
    press_windows,
)
from calib.session import Session, SessionError, Status, Stream

__all__ = [
    "ChannelTable",
    "CheckReport",
    "Finding",
    "Severity",
    "check_session",
    "render",
    "to_json",
    "transfer_matrix",
]

Progress = Callable[[Iterable], Iterable]
OK, WARNING, ERROR = Severity.OK, Severity.WARNING, Severity.ERROR

_SNR = 40.0  # dB; healthy benches reach 50 to 60
_NOISY = 5.0  # times the median noise of the readings
_RECIPROCITY = 0.02
_MISSING = 0.001  # tolerated fraction of missing values
_RATE = 0.02  # tolerated difference from the nominal rate
_SATURATED = 0.01  # fraction of samples at the converter's end
_ALIKE = 3  # readings that share one extreme value: the converter's end, not chance
_QUIET_FRAMES = 2000
_FEWEST_QUIET = 8
_SMALLEST_PRESSURE = 5.0  # Pa; no touch is that light, but bar and kPa give such numbers
_ONSETS = 40  # presses that clocks are compared on


def check_session(
    session: Session,
    skin: je.Skin | None = None,
    *,
    transfer: np.ndarray | None = None,
    progress: Progress = iter,
) -> CheckReport:
    """Look for everything that would spoil a calibration on this session.

    Args:
        skin: the session should have been recorded on; default: as described in the file.
        transfer: of that skin from `transfer_matrix`, if many sessions are checked; else computed.
        progress: wraps the iteration over blocks of each stream, such as `tqdm.tqdm`.

    Returns:
        A report; damaged streams and skins become findings in it, not exceptions.
    """
    findings = [*_about(session)]
    skin = _skin(session, skin, findings)
    scans = _scans(session, skin, progress, findings)
    for scan in scans.values():
        findings += _stream_findings(scan)
    presses, source = _presses(session, scans, findings)
    onsets = _press_findings(scans, presses, skin, findings)
    channels, order = _eit(session, scans.get("eit"), presses, skin, transfer, findings)
    pads = _pads(scans.get("pressure"), skin, findings)
    return CheckReport(
        name=session.name,
        title=session.title,
        skin=session.skin_name,
        simulated=session.simulated,
        complete=session.complete,
        findings=tuple(findings),
        streams=tuple(s.row for s in scans.values()),
        pads=pads,
        channels=channels,
        order=order,
        presses=_summary(presses, source),
        onsets=onsets,
    )


def _about(session: Session) -> Iterator[Finding]:
    if session.simulated:
        yield Finding(OK, "file", "SIMULATED: nothing here was measured")
    if not session.complete:
        yield Finding(
            WARNING,
            "file",
            "the recording was interrupted (complete = 0)",
            "check its end; `jaxeit recover` finishes what a crash left",
        )
    missing = [n for n in ("eit", "pressure", "force") if n not in session.streams]
    if missing:
        what = f"no stream named {' or '.join(missing)}: what needs it is not checked"
        yield Finding(OK, "/streams", what, "a force map is calibrated from eit, pressure and force")


# --- the skin ------------------------------------------------------------------------------------


def _skin(session: Session, given: je.Skin | None, findings: list[Finding]) -> je.Skin | None:
    """The skin to check against, or None; what is wrong with it is added to ``findings``."""
    own = _own_skin(session, findings)
    if given is not None and own is not None:
        findings += _differences(own.toml, given.toml, f"the skin given, {given.name!r}")
    elif own is not None and own.name in je.shipped_skins():
        findings += _differences(own.toml, je.load_skin(own.name).toml, f"the shipped {own.name!r}")
    skin = own if given is None else given
    if skin is not None:
        findings += _protocol_findings(session, skin)
    return skin


def _own_skin(session: Session, findings: list[Finding]) -> je.Skin | None:
    if not session.skin_toml.strip():
        severity = WARNING if "eit" in session.streams else OK
        what = "describes no skin: pads, numbering and signs are checked only against one given"
        findings.append(Finding(severity, "/device", what, "give the skin that was recorded (--skin FILE)"))
        return None
    try:
        return je.parse_skin(session.skin_toml, "skin_toml")
    except ValueError as error:
        what = f"the skin's text cannot be used: {error}"
        findings.append(Finding(ERROR, "/device", what, "give a corrected skin (--skin FILE)"))
        return None


def _differences(text: str, other: str, name: str) -> Iterator[Finding]:
    a, b = _flat(tomllib.loads(text)), _flat(tomllib.loads(other))
    keys = sorted(k for k in a.keys() | b.keys() if a.get(k) != b.get(k))
    if keys:
        some = ", ".join(keys[:6]) + (", ..." if len(keys) > 6 else "")
        what = f"the recorded skin differs from {name} in: {some}"
        yield Finding(WARNING, "/device", what, "if that is meant, give the edited skin a name of its own")


def _flat(value: object, key: str = "") -> dict[str, object]:
    """A TOML document as one level of dotted keys."""
    if isinstance(value, dict):
        items = [(f"{key}.{k}" if key else k, v) for k, v in value.items()]
    elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
        items = [(f"{key}[{i}]", v) for i, v in enumerate(value)]
    else:
        return {key: value}
    return {k: v for name, part in items for k, v in _flat(part, name).items()}


def _protocol_findings(session: Session, skin: je.Skin) -> Iterator[Finding]:
    where, pattern, own = "/device/eit_protocol", session.pattern, skin.protocol
    if pattern is None:
        if "eit" in session.streams:
            remedy = "write the pattern of the scan: no reading has a meaning without it"
            yield Finding(ERROR, where, "no pattern was recorded", remedy)
        return
    if pattern.max() >= len(skin.electrodes):
        what = f"the pattern names electrode {pattern.max()}; the skin has 0 to {len(skin.electrodes) - 1}"
        yield Finding(ERROR, where, what, "electrodes are counted from 0")
    elif pattern.shape != own.pattern.shape or (pattern != own.pattern).any():
        remedy = "calibrate with the skin that was recorded (--skin FILE), or correct its protocol"
        yield Finding(ERROR, where, _pattern_difference(pattern, own.pattern), remedy)
    if session.current is not None and not np.isclose(session.current, own.current, rtol=0.01):
        what = f"drive current {session.current:g} A, the skin's file says {own.current:g} A"
        yield Finding(WARNING, where, what, "correct the one that is wrong")


def _pattern_difference(pattern: np.ndarray, own: np.ndarray) -> str:
    if pattern.shape != own.shape:
        return f"the pattern has {len(pattern)} readings, the skin's protocol {len(own)}"
    rows = np.flatnonzero((pattern != own).any(1))
    same = sorted(map(tuple, pattern.tolist())) == sorted(map(tuple, own.tolist()))
    kind = "holds the same readings in another order" if same else "is not the skin's protocol"
    first = f"row {rows[0]} is {pattern[rows[0]].tolist()}, the skin's {own[rows[0]].tolist()}"
    return f"the pattern {kind}: {len(rows)} rows differ ({first})"


# --- streams -------------------------------------------------------------------------------------


@dataclass
class _Scan:
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


def _scans(session: Session, skin: je.Skin | None, progress: Progress, findings: list[Finding]) -> dict[str, _Scan]:
    scans = {}
    limits = {} if skin is None else {"pressure": _full_scale(skin.pressure_sensor)}
    for name, stream in session.streams.items():
        if not len(stream):
            findings.append(Finding(ERROR, f"/streams/{name}", "holds no sample", "record again"))
            continue
        try:
            scans[name] = _scan(stream, limits.get(name, np.inf), progress)
        except SessionError as error:
            what = f"cannot be read: {error}"
            findings.append(Finding(ERROR, f"/streams/{name}", what, "take the file's original"))
    return scans


def _full_scale(sensor: je.PressureSensor) -> float:
    return sensor.maximum - sensor.accuracy


def _scan(stream: Stream, limit: float, progress: Progress) -> _Scan:
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
    return _Scan(stream, _row(stream, missing), stream.time, finite, low, high, at_low, at_high, full)


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


def _stream_findings(scan: _Scan) -> Iterator[Finding]:
    row, where = scan.row, f"/streams/{scan.row.name}"
    if np.isfinite(row.rate) and abs(row.rate / row.nominal_rate - 1) > _RATE:
        what = f"comes at {row.rate:.4g} Hz, not at the nominal {row.nominal_rate:.4g} Hz"
        yield Finding(WARNING, where, what, "correct nominal_rate_hz, or the recorder's clock")
    if row.gaps:
        steps = np.diff(scan.time)
        start = (scan.time[steps.argmax()] - scan.time[0]) / SECOND
        what = (
            f"{row.gaps} gaps, the longest of {row.longest_gap:.3g} s, {start:.2f} s after its start; "
            f"{row.dropped} samples lost"
        )
        yield Finding(WARNING, where, what, "presses without samples are set aside; see to the link")
    elif row.dropped:
        what = f"sequence numbers say that {row.dropped} samples were lost"
        yield Finding(WARNING, where, what, "see to the link")
    yield from _missing_findings(scan)
    for flag, (what, remedy) in _FLAGS.items():
        count = scan.flagged(flag)
        if count:
            yield Finding(WARNING, where, f"{count} samples {what} (flag {flag.name})", remedy)
    if scan.flagged(Status.unchecked):
        yield Finding(OK, where, "came without a checksum (flag unchecked)")


def _missing_findings(scan: _Scan) -> Iterator[Finding]:
    bad = np.flatnonzero((scan.missing > _MISSING) & (scan.finite > 0))
    if not len(bad):
        return
    worst = bad[scan.missing[bad].argmax()]
    what = (
        f"{100 * scan.row.missing:.2g} % of values are missing or not finite, in {len(bad)} of "
        f"{scan.row.channels} channels, most in channel {worst} ({100 * scan.missing[worst]:.2g} %)"
    )
    yield Finding(WARNING, f"/streams/{scan.row.name}", what, "see to that channel's wiring")


# --- presses, force and clocks -------------------------------------------------------------------


def _presses(session: Session, scans: dict[str, _Scan], findings: list[Finding]) -> tuple[Presses | None, str]:
    """The presses, and where they come from: "table", "force" or "none"."""
    try:
        table = session.presses
    except SessionError as error:
        findings.append(Finding(ERROR, "/presses", str(error), "correct the table, or leave it out"))
        table = None
    if table is not None and len(table):
        return table, "table"
    if "force" not in scans:
        return None, "none"
    try:
        return _found(scans["force"], findings), "force"
    except PressError as error:
        findings.append(Finding(ERROR, "/streams/force", str(error), "record a load cell"))
        return None, "none"


def _found(scan: _Scan, findings: list[Finding]) -> Presses:
    force = scan.stream.read()[:, 0]
    found, inverse = find_presses(scan.time, force), find_presses(scan.time, -force)
    if inverse.accepted.sum() > found.accepted.sum():
        findings.append(_negative())
        return inverse
    if not len(found):
        what = "no press listed, and none found in the force"
        findings.append(Finding(WARNING, "/presses", what, "was the skin pressed, and the right column recorded?"))
    return found


def _negative() -> Finding:
    return Finding(
        ERROR,
        "/streams/force",
        "the force is negative while pressing",
        "pressing is positive: negate the column at import, or turn the load cell round",
    )


def _press_findings(
    scans: dict[str, _Scan], presses: Presses | None, skin: je.Skin | None, findings: list[Finding]
) -> tuple[tuple[str, Onset], ...]:
    """What is wrong with force, sites, pads and clocks, press by press; onsets for the report."""
    if presses is None or not len(presses):
        return ()
    windows = press_windows(presses)
    streams = {n: s.stream for n, s in scans.items() if n in ("eit", "pressure", "force")}
    presses = check_overlap(presses, windows, streams.values())
    if not presses.accepted.any():
        what = f"none of {len(presses)} presses can be used: {presses.reason[0]}"
        findings.append(Finding(ERROR, "/presses", what, "see the reasons below; record again"))
        return ()
    means = {n: press_means(streams[n], windows).change for n in streams if n != "eit"}
    if "force" in means:
        findings += _force_findings(presses, means["force"])
    if skin is not None and hasattr(presses, "x"):
        findings += _site_findings(presses, means.get("pressure"), skin)
    if "force" not in streams:
        return ()
    return _onsets(streams, presses, windows, findings)


def _force_findings(presses: Presses, change: Estimate) -> Iterator[Finding]:
    force = change.mean[presses.accepted, 0]
    force = force[np.isfinite(force)]
    if len(force) and np.median(force) < 0:
        yield _negative()
        return
    target = np.asarray(getattr(presses, "target_force", np.zeros(len(presses))))[presses.accepted]
    if not len(force) or len(force) != len(target) or not (target > 0).all():
        return
    ratio = float(np.median(force / target))
    if not 0.5 < ratio < 2:
        what = f"the force reads {ratio:.3g} times the target of the presses"
        yield Finding(WARNING, "/streams/force", what, "is the unit right (N, g, kg, V)? tare and gain?")


def _onsets(streams, presses, windows, findings: list[Finding]) -> tuple[tuple[str, Onset], ...]:
    first = presses.accepted & (np.cumsum(presses.accepted) <= _ONSETS)
    chosen = replace(presses, accepted=first)
    others = [s for n, s in streams.items() if n != "force"]
    onsets = onset_delays(streams["force"], others, chosen, windows)
    ramp = float(np.median((presses.t_hold0 - presses.t_press)[first])) / SECOND
    for name, onset in onsets.items():
        # a curved response shifts the half-way point by up to a quarter of the ramp
        allowed = max(0.4 * ramp, 0.05) + 2 / streams[name].nominal_rate
        if onset.presses and abs(onset.delay) > allowed:
            what = f"rises {onset.delay:+.3f} s after the force; the ramp takes {ramp:.2f} s"
            remedy = "the clocks disagree: align the streams before calibrating"
            findings.append(Finding(ERROR, f"/streams/{name}", what, remedy))
    return tuple(sorted(onsets.items()))


def _site_findings(presses, pressure: Estimate | None, skin: je.Skin) -> Iterator[Finding]:
    sites = np.stack([presses.x, presses.y], 1)
    outside = np.flatnonzero(~skin.domain.contains(sites))
    if len(outside):
        i = outside[0]
        what = f"{len(outside)} of {len(sites)} presses lie outside the sheet (press {i} at {sites[i]} m)"
        yield Finding(ERROR, "/presses", what, "metres in the skin's frame, not mm or the stage's frame?")
    elif pressure is not None and pressure.mean.shape[1] == len(skin.pads):
        yield from _pad_order(sites, presses.accepted, pressure.mean, skin)


def _pad_order(sites, accepted, pressure, skin: je.Skin) -> Iterator[Finding]:
    """Does the pad under the tip respond, or another one?"""
    inside = np.array([je.Polygon(p.outline).contains(sites) for p in skin.pads])
    under = np.where(inside.sum(0) == 1, inside.argmax(0), -1)
    felt = dominant_pad(pressure)
    use = accepted & (under >= 0) & (felt >= 0)
    wrong = use & (under != felt)
    if wrong.sum() <= 0.3 * use.sum():
        return
    pairs = sorted(set(zip(felt[wrong].tolist(), under[wrong].tolist(), strict=True)))
    some = "; ".join(f"column {f} responds over pad {skin.pads[u].name!r}" for f, u in pairs[:4])
    what = f"another pad than the one under the tip responds in {wrong.sum()} of {use.sum()} presses: {some}"
    yield Finding(ERROR, "/streams/pressure", what, "reorder the columns or the skin's pads; or x and y are turned")


def _summary(presses: Presses | None, source: str) -> PressSummary:
    if presses is None:
        return PressSummary("none", 0, ())
    reasons = enumerate(presses.reason)
    rejected = tuple((i, r or "set aside") for i, r in reasons if not presses.accepted[i])
    return PressSummary(source, int(presses.accepted.sum()), rejected)


# --- pads ----------------------------------------------------------------------------------------


def _pads(scan: _Scan | None, skin: je.Skin | None, findings: list[Finding]) -> tuple[PadRow, ...]:
    if scan is None or scan.row.variable != "pressure":
        return ()
    names = [f"column {i}" for i in range(scan.row.channels)]
    if skin is not None and len(skin.pads) == len(names):
        names = [p.name for p in skin.pads]
    elif skin is not None:
        what = f"has {len(names)} columns, the skin {skin.name!r} has {len(skin.pads)} pads"
        remedy = "record every pad, or describe the skin as it is in its TOML file"
        findings.append(Finding(ERROR, "/streams/pressure", what, remedy))
    rows = tuple(_pad(scan, i, name) for i, name in enumerate(names))
    findings += _pad_findings(scan, rows, skin)
    return rows


def _pad(scan: _Scan, i: int, name: str) -> PadRow:
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


def _pad_findings(scan: _Scan, rows: tuple[PadRow, ...], skin: je.Skin | None) -> Iterator[Finding]:
    where = "/streams/pressure"
    for row in rows:
        if row.dead:
            how = "holds no finite sample" if np.isnan(row.low) else f"always reads {row.low:.4g} Pa"
            remedy = "see to its sensor and tube, and record again"
            yield Finding(ERROR, where, f"column {row.column}, pad {row.name!r}, {how}", remedy)
        if row.full_scale > _MISSING:
            share = f"at the end of the sensor's span in {100 * row.full_scale:.1f} % of samples"
            remedy = "press less, or set pressure_sensor.maximum in the skin's file"
            yield Finding(WARNING, where, f"column {row.column}, pad {row.name!r}, {share}", remedy)
    alive = [r for r in rows if not r.dead]
    if alive:
        yield from _pressure_unit(max(max(abs(r.low), abs(r.high)) for r in alive), skin)


def _pressure_unit(largest: float, skin: je.Skin | None) -> Iterator[Finding]:
    where, remedy = "/streams/pressure", "import again with the right unit (Pa, kPa, mbar, bar, psi)"
    span = je.PressureSensor().maximum if skin is None else skin.pressure_sensor.maximum
    if largest <= _SMALLEST_PRESSURE:
        what = f"no value exceeds {largest:.3g} Pa: were kPa or bar recorded as Pa?"
        yield Finding(WARNING, where, what, remedy)
    elif skin is not None and largest > 1.2 * span:
        what = f"the largest value, {largest:.4g} Pa, lies beyond the sensor's span of {span:.4g} Pa"
        yield Finding(WARNING, where, what, f"{remedy}; absolute pressure is not gage pressure")


# --- EIT -----------------------------------------------------------------------------------------


def _eit(
    session: Session,
    scan: _Scan | None,
    presses: Presses | None,
    skin: je.Skin | None,
    transfer: np.ndarray | None,
    findings: list[Finding],
) -> tuple[ChannelTable | None, OrderCheck | None]:
    pattern = session.pattern
    if scan is None or pattern is None or scan.row.variable != "voltage":
        return None, None
    findings += _frame_rate(session, scan, skin)
    table = _channels(scan, pattern, presses)
    findings += _channel_findings(scan, table)
    if skin is None or pattern.max() >= len(skin.electrodes):
        return table, None
    order = _order(session, table, pattern, skin, transfer, findings)
    if order is not None:
        findings += _order_findings(order)
    return table, order


def _frame_rate(session: Session, scan: _Scan, skin: je.Skin | None) -> Iterator[Finding]:
    """A scan cannot take longer than the time from one frame to the next."""
    if session.offset is not None:
        scan_time = float(np.ptp(session.offset))
    elif skin is not None:
        scan_time = skin.protocol.frame_time
    else:
        return
    if scan.row.rate * scan_time > 1.02:
        what = (
            f"{scan.row.rate:.4g} frames a second, but one scan takes {1e3 * scan_time:.3g} ms "
            f"({1 / scan_time:.4g} a second at most)"
        )
        yield Finding(WARNING, "/streams/eit", what, "correct reading_time, or the time stamps")


def _quiet(time: np.ndarray, presses: Presses | None) -> slice:
    """The longest run of frames clear of every press, or the first ones if none is clear."""
    loaded = np.zeros(len(time), bool)
    if presses is not None:
        starts = np.searchsorted(time, np.asarray(presses.t_press) - SECOND // 10)
        stops = np.searchsorted(time, np.asarray(presses.t_release) + 3 * SECOND // 2)
        for start, stop in zip(starts, stops, strict=True):
            loaded[start:stop] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[True], loaded, [True]]).astype(np.int8)))
    runs = edges.reshape(-1, 2)
    sizes = runs[:, 1] - runs[:, 0]
    if not len(runs) or sizes.max() < _FEWEST_QUIET:
        return slice(0, min(len(time), _QUIET_FRAMES))
    start = int(runs[sizes.argmax(), 0])
    return slice(start, start + min(int(sizes.max()), _QUIET_FRAMES))


def _channels(scan: _Scan, pattern: np.ndarray, presses: Presses | None) -> ChannelTable:
    quiet = _quiet(scan.time, presses)
    values = scan.stream.read(quiet.start, quiet.stop)
    mean = _mean(values)
    # from first differences, so that drift is not noise
    noise = np.sqrt(_mean(np.diff(values, axis=0) ** 2) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = 20 * np.log10(np.abs(mean) / noise)
    partner = je.reciprocal_rows(pattern)
    typical = np.median(noise[np.isfinite(noise)]) if np.isfinite(noise).any() else np.inf
    return ChannelTable(
        frames=len(values),
        pattern=pattern,
        mean=mean,
        noise=noise,
        snr=snr,
        partner=partner,
        reciprocity=_reciprocity(mean, partner),
        missing=scan.missing,
        dead=scan.dead,
        saturated=_saturated(scan) & ~scan.dead,
        noisy=(noise > _NOISY * typical) & (snr < _SNR) & ~scan.dead,
    )


def _mean(values: np.ndarray) -> np.ndarray:
    """Over frames, of what is there; NaN where nothing is."""
    good = np.isfinite(values)
    count = good.sum(0)
    return np.where(good, values, 0).sum(0) / np.where(count > 0, count, np.nan)


def _reciprocity(mean: np.ndarray, partner: np.ndarray) -> np.ndarray:
    other = np.where(partner >= 0, mean[partner], np.nan)
    rms = np.sqrt(_mean(mean[:, None] ** 2))[0]
    size = np.fmax(np.fmax(np.abs(mean), np.abs(other)), 0.1 * rms)
    return np.abs(mean - other) / np.where(size > 0, size, np.nan)


def _saturated(scan: _Scan) -> np.ndarray:
    """Channels that sit at the converter's ends: the extremes of all channels, shared by several.

    One channel alone may rest at its own extreme; with the status flag it is known not to.
    """
    some = scan.finite > 0
    out = np.zeros(len(some), bool)
    for value, count in ((scan.low, scan.at_low), (-scan.high, scan.at_high)):
        if some.any():
            at_end = some & (value == value[some].min()) & (count > _SATURATED * len(scan.time))
            if at_end.sum() >= _ALIKE or scan.flagged(Status.saturated):
                out |= at_end
    return out


def _channel_findings(scan: _Scan, table: ChannelTable) -> Iterator[Finding]:
    where = "/streams/eit"
    dead = table.dead
    yield from _listed(dead, table, ERROR, _how_dead(scan), "see to their wires and bolts")
    remedy = "lower the gain or the drive current"
    yield from _listed(table.saturated, table, ERROR, "sit at the converter's end (saturated)", remedy)
    what = f"are more than {_NOISY:g} times noisier than most and below {_SNR:g} dB"
    yield from _listed(table.noisy, table, WARNING, what, "see to their wires and bolts")
    snr = table.snr[~table.bad & ~np.isnan(table.snr)]
    if len(snr) and np.median(snr) < _SNR:
        what = f"low signal: the median SNR of a reading is {np.median(snr):.1f} dB, below {_SNR:g} dB"
        yield Finding(WARNING, where, what, "more current, averaging, better contacts, less mains hum")
    error = table.reciprocity[~table.bad & np.isfinite(table.reciprocity)]
    if len(error) and np.median(error) > _RECIPROCITY:
        what = (
            f"reciprocity error: readings differ by {100 * np.median(error):.1f} % (median) when drive "
            "and sense are exchanged, where physics allows no difference"
        )
        yield Finding(WARNING, where, what, "the wiring or the order of the readings is not as recorded")


def _how_dead(scan: _Scan) -> str:
    dead = scan.dead
    if (scan.finite[dead] == 0).all():
        return "hold no finite value (dead)"
    if (scan.low[dead] == 0).all():
        return "are always zero (dead)"
    return "never change (dead)"


def _listed(flag: np.ndarray, table: ChannelTable, severity: Severity, what: str, remedy: str) -> Iterator[Finding]:
    rows = np.flatnonzero(flag)
    if not len(rows):
        return
    names = ", ".join(map(str, rows[:6])) + (", ..." if len(rows) > 6 else "")
    text = f"{len(rows)} of {len(table)} readings {what}: {names}"
    common = _common_electrodes(flag, table.pattern)
    if common:
        text += f"; all of them use electrode {' or '.join(map(str, common))}"
        remedy = f"see to electrode {' and '.join(map(str, common))}: its bolt, wire and switch"
    yield Finding(severity, "/streams/eit", text, remedy)


def _common_electrodes(flag: np.ndarray, pattern: np.ndarray) -> list[int]:
    """One or two electrodes in all flagged readings and hardly in others, found greedily."""
    left, found = flag.copy(), []
    while left.sum() >= 3 and len(found) < 2:
        uses = np.array([(pattern == e).any(1) for e in range(pattern.max() + 1)])
        share = (uses & flag).sum(1) / np.maximum(uses.sum(1), 1)
        hits = np.where(share > 0.8, (uses & left).sum(1), 0)
        if not hits.any():
            return []
        found.append(int(hits.argmax()))
        left &= ~uses[found[-1]]
    return [] if left.any() else found


def _order(session, table, pattern, skin, transfer, findings) -> OrderCheck | None:
    """Comparison with a uniform sheet, on the readings that can be trusted."""
    good = np.isfinite(table.mean) & ~table.bad
    if good.sum() < max(10, len(good) // 4):
        what = f"only {good.sum()} readings are sound: order and signs were not checked"
        findings.append(Finding(WARNING, "/streams/eit", what, "mend the readings above first"))
        return None
    try:
        transfer = transfer_matrix(skin) if transfer is None else transfer
    except ValueError as error:
        what = f"the skin {skin.name!r} cannot be modelled: {error}"
        findings.append(Finding(ERROR, "/device", what, "correct the skin's TOML file"))
        return None
    return check_order(
        table.mean,
        good,
        pattern,
        transfer,
        current=skin.protocol.current if session.current is None else session.current,
        positions=skin.electrode_positions,
        usual=skin.protocol.pattern,
    )


def _order_findings(order: OrderCheck) -> Iterator[Finding]:
    where = "/streams/eit"
    if order.claimed:
        same = f" (or, which looks the same: {'; '.join(order.same)})" if order.same else ""
        what = (
            f"the order looks wrong: {order.what}{same}. Correlation with the model is "
            f"{order.as_is:.2f} as recorded and {order.best:.2f} if so"
        )
        yield Finding(ERROR, where, what, order.remedy)
    elif order.as_is < 0.9:
        what = (
            f"the readings do not look like this skin: correlation with its model {order.as_is:.2f}, "
            f"and no simple reordering explains it (best {order.best:.2f})"
        )
        remedy = "compare positions and numbering of the electrodes in the skin's file with the hardware"
        yield Finding(WARNING, where, what, remedy)
    if order.as_is > 0 and not 0.03 < order.scale < 30:
        what = f"amplitude {order.scale:.3g} times the model's: unit (V, mV), gain or current?"
        yield Finding(WARNING, where, what, "correct the unit at import, current or sheet_resistance")
