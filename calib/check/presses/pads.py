"""Check the pads of a recording, and the channels of a wide pressure array that no skin describes."""

from collections.abc import Iterator, Mapping

import numpy as np

import jaxeit as je

from ...presses.channel_faults import MIN_ARRAY_CHANNELS, faults
from ...presses.streams import resample
from ...session import Stream
from ..report import Finding, PadRow, Severity, listed
from ..streams.statistics import MAX_MISSING, StreamStatistics

MIN_PRESSURE = 5.0  # Pa; no press is lighter, but bar and kPa recorded as Pa give such numbers
MAX_BELOW = 0.1  # of the span, by which all values may lie below it
MAX_REST = 0.8  # of the span, at which a pad may rest
# An array of many channels is searched for faults in so many pieces of so many samples, spread over the recording,
# because the search holds what it reads in memory.
PIECES, PIECE_LENGTH = 64, 512


def check_pads(
    statistics: Mapping[str, StreamStatistics], skin: je.Skin | None, findings: list[Finding]
) -> tuple[PadRow, ...]:
    """Check the columns of the pressure stream; add what is wrong to ``findings``.

    Each pad of a skin is checked by itself. Without a skin, many columns are an array of plain channels, which is
    searched for channels that carry no information.
    """
    stats = statistics.get("pressure")
    if stats is None and skin is not None and skin.pads and {"eit", "force"} <= statistics.keys():
        what = f"missing; the skin {skin.name!r} has {len(skin.pads)} pads, the file has: {listed(sorted(statistics))}"
        remedy = "record the pads, or import their stream by the name pressure"
        findings.append(Finding(Severity.ERROR, "/streams/pressure", what, remedy))
    if stats is None or stats.row.variable not in ("pressure", "counts"):
        return ()
    is_array = skin is None and stats.row.channels >= MIN_ARRAY_CHANNELS
    if is_array:
        # An EIT session is pressed in one place at a time, so that channels elsewhere do not follow the force.
        reference = None if "eit" in statistics else statistics.get("force")
        findings += _array_findings(stats, None if reference is None else reference.stream)
    if stats.row.variable == "counts":
        return ()
    rows = tuple(_pad(stats, i, name) for i, name in enumerate(_column_names(stats, skin, findings)))
    if not is_array:
        findings += _pad_findings(rows)
    findings += _unit_findings(rows, skin)
    return rows


def _column_names(stats: StreamStatistics, skin: je.Skin | None, findings: list[Finding]) -> list[str]:
    names = [f"column {i}" for i in range(stats.row.channels)]
    if skin is None:
        return names
    if len(skin.pads) == len(names):
        return [pad.name for pad in skin.pads]
    what = f"has {len(names)} columns, the skin {skin.name!r} has {len(skin.pads)} pads"
    remedy = "record every pad, or describe the skin as it is in its TOML file"
    findings.append(Finding(Severity.ERROR, "/streams/pressure", what, remedy))
    return names


def _pad(stats: StreamStatistics, i: int, name: str) -> PadRow:
    some = stats.finite[i] > 0
    return PadRow(
        column=i,
        name=name,
        low=float(stats.low[i]) if some else np.nan,
        high=float(stats.high[i]) if some else np.nan,
        missing=float(stats.missing[i]),
        full_scale=float(stats.full_scale[i] / max(stats.finite[i], 1)),
        dead=bool(stats.dead[i]),
    )


def _pad_findings(rows: tuple[PadRow, ...]) -> Iterator[Finding]:
    where = "/streams/pressure"
    for row in rows:
        if row.dead:
            how = "holds no finite sample" if np.isnan(row.low) else f"always reads {row.low:.4g} Pa"
            remedy = "check its sensor and tube, and record again"
            yield Finding(Severity.ERROR, where, f"column {row.column}, pad {row.name!r}, {how}", remedy)
        if row.full_scale > MAX_MISSING:
            share = f"at the end of the sensor's span in {100 * row.full_scale:.1f} % of samples"
            remedy = "press less, or set pressure_sensor.maximum in the skin's file"
            yield Finding(Severity.WARNING, where, f"column {row.column}, pad {row.name!r}, {share}", remedy)


def _unit_findings(rows: tuple[PadRow, ...], skin: je.Skin | None) -> Iterator[Finding]:
    alive = [r for r in rows if not r.dead]
    if not alive:
        return
    largest = max(max(abs(r.low), abs(r.high)) for r in alive)
    where, remedy = "/streams/pressure", "import again with the right unit (Pa, kPa, mbar, bar, psi)"
    span = je.skin.PressureSensor().maximum if skin is None else skin.pressure_sensor.maximum
    below = skin is not None and max(r.high for r in alive) < skin.pressure_sensor.minimum - MAX_BELOW * span
    if below:
        low = min(r.low for r in alive)
        what = f"all values, from {low:.4g} Pa on, lie below the sensor's span: a gage pressure at rest is near zero"
        yield Finding(Severity.WARNING, where, what, "subtract the ambient pressure once at most, or tare the sensor")
    elif largest <= MIN_PRESSURE:
        what = f"no value exceeds {largest:.3g} Pa: were kPa or bar recorded as Pa?"
        yield Finding(Severity.WARNING, where, what, remedy)
    elif skin is not None and largest > 1.2 * span:
        what = f"the largest value, {largest:.4g} Pa, lies beyond the sensor's span of {span:.4g} Pa"
        yield Finding(Severity.WARNING, where, what, f"{remedy}; absolute pressure is not gage pressure")
    elif skin is not None and min(r.low for r in alive) > MAX_REST * span:
        low = min(r.low for r in alive)
        what = f"no value is below {low:.4g} Pa, also at rest, of a span of {span:.4g} Pa: little is left for presses"
        yield Finding(Severity.WARNING, where, what, "give gage pressure, or a sensor of a larger span")


def _array_findings(stats: StreamStatistics, force: Stream | None) -> Iterator[Finding]:
    """Channels of an array that carry no information, or that spike. The calibration of a log leaves the former out."""
    time, values = _pieces(stats.stream)
    reference = None if force is None else resample(force.time, force.read()[:, :1], time)[:, 0]
    found = faults(values, reference)
    repair = "check their sensors and wires; the calibration of a log leaves them out"
    press_less = "lower the gain, or press less: the fit of such a channel is wrong there"
    kinds = (
        ("hold no finite sample (dead)", found.dead, repair, True),
        ("have one value in 99 % of the samples (stuck)", found.stuck, repair, True),
        ("sit at one end of the range of all for 1 % of the samples (saturated)", found.saturated, press_less, False),
        ("do not follow the force (silent)", found.silent, repair, True),
        (
            "jump away from their neighbours in time and back (spiking)",
            found.spiking,
            "check their wires and plugs",
            False,
        ),
    )
    for what, flag, remedy, left_out in kinds:
        columns = np.flatnonzero(flag)
        if len(columns):
            text = f"{len(columns)} of {stats.row.channels} channels {what}: {listed(columns)}"
            uninformative = tuple(columns.tolist()) if left_out else ()
            yield Finding(Severity.WARNING, "/streams/pressure", text, remedy, uninformative)


def _pieces(stream: Stream) -> tuple[np.ndarray, np.ndarray]:
    """Time and values of the whole stream, or of evenly spaced pieces of a long one."""
    if len(stream) <= PIECES * PIECE_LENGTH:
        return stream.time, stream.read()
    starts = np.linspace(0, len(stream) - PIECE_LENGTH, PIECES).astype(int)
    spans = [(int(a), int(a) + PIECE_LENGTH) for a in starts]
    return (
        np.concatenate([stream.time[a:b] for a, b in spans]),
        np.concatenate([stream.read(a, b) for a, b in spans]),
    )
