"""Check the EIT readings of a recording: dead, saturated, noisy or not reciprocal readings, and their order."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import jaxeit as je

from ...presses.streams import finite_mean, true_runs
from ...presses.timing.times import PressColumns
from ...session import Session, Status
from ...session.units import SECOND
from ..evidence import PressEvidence
from ..report import ChannelTable, Finding, Severity, listed
from ..skin import EMPTY_REMEDY, MAX_EMPTY
from ..streams.statistics import StreamStatistics
from .contradictions import check_reciprocity, lost_electrode_findings, offset_finding
from .grouping import common_electrodes, readings_of_electrodes
from .model import MIN_SOUND_READINGS, SkinModel, are_enough
from .order_findings import MIN_CORRELATION, amplitude_findings, order_findings
from .reading_order import OrderCheck, transfer_matrix
from .rests import rest_change, rest_finding

MIN_SNR = 40.0  # dB; healthy benches reach 50 to 60
NOISE_RATIO = 5.0  # over the median noise of the readings
SATURATED_FRACTION = 0.01  # of the samples at the converter's end
UNIFORM_DEVIATION = 12**-0.5  # standard deviation of what a converter rounds off, over its step
MIN_SHARED_EXTREMES = 3  # so many readings with one extreme value are at the converter's end; fewer may be chance
MAX_EMPTY_FRACTION = 0.25  # of the readings without a value, up to which the others make an image
MAX_SATURATED_FRACTION = 0.05  # of the readings: those beside the drive may clip without much harm to an image
MIN_REST_FRAMES, MAX_REST_FRAMES = 8, 2000
# Quantile of the changes of the frames, which is that of a touch; and the part of it, and of the model's voltage, below
# which the frame at rest is none of voltages.
TOUCHED, MAX_REST = 0.95, 0.3


def check_eit(
    session: Session,
    stats: StreamStatistics | None,
    presses: PressColumns | None,
    evidence: PressEvidence | None,
    skin: je.Skin | None,
    transfer: np.ndarray | None,
    findings: list[Finding],
) -> tuple[ChannelTable | None, OrderCheck | None]:
    """Check the readings against each other and against a model of the skin; add what is wrong to ``findings``.

    Returns None for what was not checked: without EIT voltages, without a pattern or without a skin.
    """
    pattern = session.pattern
    if stats is None or pattern is None or stats.row.variable != "voltage":
        return None, None
    findings += _frame_rate_findings(session, stats, skin)
    model = None
    if skin is not None and pattern.max() < len(skin.electrodes):
        model = _model(session, skin, transfer, findings)
    table = _channel_table(stats, session, presses, model)
    findings += _fault_findings(stats, table)
    if model is not None and _is_difference(stats, table, model):
        findings.append(_difference_finding(table, model))
        return table, None
    findings += _noise_findings(table)
    change = None if evidence is None else rest_change(evidence, stats)
    changed = None if change is None else rest_finding(change, int(stats.time[0]), table, model)
    if changed is not None:
        findings.append(changed)
        # Its words hold for a part of the recording, which a mean frame does not tell.
        return table, None if model is None else _check_order(table, _sound(table), model, findings)
    wrong = check_reciprocity(table, model, findings)
    order = None if model is None else _check_order(table, _sound(table) & ~wrong, model, findings)
    if order is not None and model is not None:
        findings += _model_findings(table, _sound(table) & ~wrong, order, model)
    return table, order


def _model(session: Session, skin: je.Skin, transfer: np.ndarray | None, findings: list[Finding]) -> SkinModel | None:
    """The model of the skin with the current of the session; None if the skin has no model, which is added."""
    try:
        transfer = transfer_matrix(skin) if transfer is None else transfer
    except ValueError as error:
        what = f"the skin {skin.name!r} cannot be modelled: {error}"
        findings.append(Finding(Severity.ERROR, "/device", what, "correct the skin's TOML file"))
        return None
    return SkinModel.of(skin, transfer, session.current)


def _sound(table: ChannelTable) -> np.ndarray:
    return np.asarray(np.isfinite(table.mean) & ~table.bad)


def _check_order(table: ChannelTable, good: np.ndarray, model: SkinModel, findings: list[Finding]) -> OrderCheck | None:
    """Compare the good readings (readings,) with a uniform sheet; None if there are too few."""
    if not are_enough(good):
        if good.all():
            what = f"a frame has only {len(good)} readings: too few to check their order and signs"
            findings.append(Finding(Severity.OK, "/streams/eit", what, f"scan {MIN_SOUND_READINGS} readings or more"))
            return None
        what = f"only {good.sum()} readings are sound: order and signs were not checked"
        findings.append(Finding(Severity.WARNING, "/streams/eit", what, "correct the readings above first"))
        return None
    return model.check(table.mean, good, table)


def _model_findings(table: ChannelTable, good: np.ndarray, order: OrderCheck, model: SkinModel) -> Iterator[Finding]:
    """Findings from the comparison with a uniform sheet: order, lost electrodes, offset and amplitude."""
    yield from order_findings(order)
    sound = order.as_is >= MIN_CORRELATION and not order.claimed
    if sound:
        yield from lost_electrode_findings(table, model)
    offset = offset_finding(table, good, model) if sound else None
    if offset is not None:
        yield offset
    else:
        yield from amplitude_findings(order)


def _frame_rate_findings(session: Session, stats: StreamStatistics, skin: je.Skin | None) -> Iterator[Finding]:
    """A scan cannot take longer than the time from one frame to the next."""
    if session.offset is not None:
        scan_time = float(np.ptp(session.offset))
    elif skin is not None:
        scan_time = skin.protocol.frame_time
    else:
        return
    if stats.row.rate * scan_time > 1.02:
        what = (
            f"{stats.row.rate:.4g} frames a second, but one scan takes {1e3 * scan_time:.3g} ms "
            f"({1 / scan_time:.4g} a second at most)"
        )
        yield Finding(Severity.WARNING, "/streams/eit", what, "correct reading_time, or the time stamps")


def _rest_frames(time: np.ndarray, presses: PressColumns | None) -> slice:
    """Longest run of frames without a press, or the first frames if there is no such run."""
    loaded = np.zeros(len(time), bool)
    if presses is not None:
        starts = np.searchsorted(time, np.asarray(presses.t_press) - SECOND // 10)
        stops = np.searchsorted(time, np.asarray(presses.t_release) + 3 * SECOND // 2)
        for start, stop in zip(starts, stops, strict=True):
            loaded[start:stop] = True
    runs = true_runs(~loaded)
    sizes = runs[:, 1] - runs[:, 0]
    if not len(runs) or sizes.max() < MIN_REST_FRAMES:
        return slice(0, min(len(time), MAX_REST_FRAMES))
    start = int(runs[sizes.argmax(), 0])
    return slice(start, start + min(int(sizes.max()), MAX_REST_FRAMES))


def _channel_table(
    stats: StreamStatistics, session: Session, presses: PressColumns | None, model: SkinModel | None
) -> ChannelTable:
    pattern, mixing = np.asarray(session.pattern), session.mixing
    rest = _rest_frames(stats.time, presses)
    values = stats.stream.read(rest.start, rest.stop)
    mean = finite_mean(values)
    # First differences suppress drift, which is no noise.
    noise = np.sqrt(finite_mean(np.diff(values, axis=0) ** 2) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = 20 * np.log10(np.abs(mean) / noise)
    partner = je.skin.reciprocal_rows(pattern) if mixing is None else np.full(len(mean), -1)
    # Readings of a symmetric skin share values where there is no noise, far from the converter's end.
    saturated = _saturated(stats, by_shared=not session.simulated and bool((noise > 0).any()))
    step = _converter_step(values)
    typical = np.median(noise[np.isfinite(noise)]) if np.isfinite(noise).any() else np.inf
    typical = max(typical, step * UNIFORM_DEVIATION)
    table = ChannelTable(
        frames=len(values),
        pattern=pattern,
        mean=mean,
        noise=noise,
        snr=snr,
        partner=partner,
        reciprocity=_reciprocity(mean, partner),
        missing=stats.missing,
        dead=stats.dead & ~saturated,
        saturated=saturated,
        mixing=mixing,
        noisy=(noise > NOISE_RATIO * typical) & (snr < MIN_SNR) & ~stats.dead,
        empty=np.zeros(len(mean), bool),
    )
    return table if model is None else _without_empty(table, stats, model, max(typical, step / 2))


def _converter_step(values: np.ndarray) -> float:
    """Least difference (V) of two successive frames in one reading: a step of the converter; 0 without any."""
    steps = np.abs(np.diff(values, axis=0))
    return float(np.min(steps, where=steps > 0, initial=np.inf)) if (steps > 0).any() else 0.0


def _without_empty(table: ChannelTable, stats: StreamStatistics, model: SkinModel, floor: float) -> ChannelTable:
    """The table with the readings marked that hold no voltage by the model; those of them that are zero are not dead.

    Args:
        floor: voltage (V) that noise or a step of the converter hides.
    """
    if table.dead.all() or not np.isfinite(floor):
        return table
    floor = max(floor, model.rounding)
    empty = (np.abs(model.predict(table)) < floor) & ~(np.abs(table.mean) > NOISE_RATIO * floor)
    zero = np.fmax(np.abs(stats.low), np.abs(stats.high)) <= floor
    return replace(table, empty=empty, dead=table.dead & ~(empty & zero))


def _reciprocity(mean: np.ndarray, partner: np.ndarray) -> np.ndarray:
    other = np.where(partner >= 0, mean[partner], np.nan)
    rms = np.sqrt(finite_mean(mean[:, None] ** 2))[0]
    size = np.fmax(np.fmax(np.abs(mean), np.abs(other)), 0.1 * rms)
    return np.asarray(np.abs(mean - other) / np.where(size > 0, size, np.nan))


def _saturated(stats: StreamStatistics, by_shared: bool) -> np.ndarray:
    """Channels that reach an end of the converter: an extreme value of all channels that several of them share.

    A single channel may rest at its own extreme; it counts only if the status flag says that some reading is
    saturated, as all do unless ``by_shared``. A channel that is always zero is dead.
    """
    some = (stats.finite > 0) & ~((stats.low == 0) & (stats.high == 0))
    out = np.zeros(len(some), bool)
    for value, count in ((stats.low, stats.at_low), (-stats.high, stats.at_high)):
        if some.any():
            at_end = some & (value == value[some].min()) & (count > SATURATED_FRACTION * len(stats.time))
            if (by_shared and at_end.sum() >= MIN_SHARED_EXTREMES) or stats.flagged(Status.saturated):
                out |= at_end
    return out


def _is_difference(stats: StreamStatistics, table: ChannelTable, model: SkinModel) -> bool:
    """Whether a frame of the untouched skin was subtracted: frames at rest are small beside those under load."""
    good = _sound(table)
    if not good.any():
        return False
    rest, noise, expected = (
        float(np.sqrt(np.mean(part[good] ** 2))) for part in (table.mean, table.noise, model.predict(table))
    )
    touched = float(np.quantile(stats.activity, TOUCHED))
    return touched > NOISE_RATIO * noise and rest < min(MAX_REST * touched, MAX_REST * expected)


def _difference_finding(table: ChannelTable, model: SkinModel) -> Finding:
    rest, expected = (1e3 * float(np.nanmedian(np.abs(part))) for part in (table.mean, model.predict(table)))
    what = (
        f"the readings of the untouched skin are about zero ({rest:.2g} mV, median) and those of a press are not: a "
        f"reference frame was subtracted, or frames were divided by it; the model expects {expected:.2g} mV. Order and "
        "signs were not checked"
    )
    return Finding(Severity.WARNING, "/streams/eit", what, "record the voltages themselves, or add the reference again")


def _fault_findings(stats: StreamStatistics, table: ChannelTable) -> Iterator[Finding]:
    """Readings that are dead or saturated."""
    remedy = "check the wires and terminals of these electrodes"
    empty = stats.finite == 0
    # A calibration leaves out readings without a value, and so loses little if they are few.
    severity = Severity.WARNING if empty.mean() < MAX_EMPTY_FRACTION else Severity.ERROR
    yield from _channel_list_finding(empty, table, severity, "hold no finite value (dead)", remedy)
    dead = table.dead & ~empty
    yield from _channel_list_finding(dead, table, Severity.ERROR, _dead_text(stats, dead), remedy)
    what = "sit at the converter's end (saturated)"
    gain = "lower the gain or the drive current"
    severity = Severity.WARNING if table.saturated.mean() < MAX_SATURATED_FRACTION else Severity.ERROR
    yield from _channel_list_finding(table.saturated, table, severity, what, gain)


def _noise_findings(table: ChannelTable) -> Iterator[Finding]:
    """Readings that are noisy, empty by the model, or low as a whole."""
    where, remedy = "/streams/eit", "check the wires and terminals of these electrodes"
    what = f"are more than {NOISE_RATIO:g} times noisier than most and below {MIN_SNR:g} dB"
    yield from _channel_list_finding(table.noisy, table, Severity.WARNING, what, remedy)
    if table.empty.mean() > MAX_EMPTY:
        what = f"{table.empty.sum()} of {len(table)} readings hold no voltage above the noise, as the model expects"
        yield Finding(Severity.OK, where, f"{what}: {listed(np.flatnonzero(table.empty))}", EMPTY_REMEDY)
    snr = table.snr[~table.bad & ~table.empty & ~np.isnan(table.snr)]
    if len(snr) and np.median(snr) < MIN_SNR:
        what = f"low signal: the median SNR of a reading is {np.median(snr):.1f} dB, below {MIN_SNR:g} dB"
        remedy = "raise the current or the averaging, improve the contacts, shield against mains hum"
        yield Finding(Severity.WARNING, where, what, remedy)


def _dead_text(stats: StreamStatistics, dead: np.ndarray) -> str:
    if (stats.low[dead] == 0).all():
        return "are always zero (dead)"
    return "never change (dead)"


def _channel_list_finding(
    flag: np.ndarray, table: ChannelTable, severity: Severity, what: str, remedy: str
) -> Iterator[Finding]:
    rows = np.flatnonzero(flag)
    if not len(rows):
        return
    text = f"{len(rows)} of {len(table)} readings {what}: {listed(rows)}"
    common = common_electrodes(flag, readings_of_electrodes(table), ~table.empty | flag)
    if common:
        text += f"; all of them use electrode {' or '.join(map(str, common))}"
        remedy = f"check electrode {' and '.join(map(str, common))}: its terminal, wire and switch"
    yield Finding(severity, "/streams/eit", text, remedy)
