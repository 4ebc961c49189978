"""EIT readings of a recording: dead, saturated, noisy, irreciprocal, in the wrong order."""

from collections.abc import Iterator

import numpy as np

import jaxeit as je
from calib.check.order import OrderCheck, check_order, transfer_matrix
from calib.check.report import ChannelTable, Finding, Severity
from calib.check.streams import Scan
from calib.presses import SECOND, Presses
from calib.session import Session, Status

_SNR = 40.0  # dB; healthy benches reach 50 to 60
_NOISY = 5.0  # times the median noise of the readings
_RECIPROCITY = 0.02
_SATURATED = 0.01  # fraction of samples at the converter's end
_ALIKE = 3  # readings that share one extreme value: the converter's end, not chance
_QUIET_FRAMES = 2000
_FEWEST_QUIET = 8


def check_eit(
    session: Session,
    scan: Scan | None,
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


def _frame_rate(session: Session, scan: Scan, skin: je.Skin | None) -> Iterator[Finding]:
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
        yield Finding(Severity.WARNING, "/streams/eit", what, "correct reading_time, or the time stamps")


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


def _channels(scan: Scan, pattern: np.ndarray, presses: Presses | None) -> ChannelTable:
    quiet = _quiet(scan.time, presses)
    values = scan.stream.read(quiet.start, quiet.stop)
    mean = _mean(values)
    # from first differences, so that drift is not noise
    noise = np.sqrt(_mean(np.diff(values, axis=0) ** 2) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = 20 * np.log10(np.abs(mean) / noise)
    partner, saturated = je.reciprocal_rows(pattern), _saturated(scan)
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
        dead=scan.dead & ~saturated,
        saturated=saturated,
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


def _saturated(scan: Scan) -> np.ndarray:
    """Channels that sit at the converter's ends: the extremes of all channels, shared by several.

    One channel alone may rest at its own extreme; with the status flag it is known not to. Channels
    that are always zero are dead, whatever the others do.
    """
    some = (scan.finite > 0) & ~((scan.low == 0) & (scan.high == 0))
    out = np.zeros(len(some), bool)
    for value, count in ((scan.low, scan.at_low), (-scan.high, scan.at_high)):
        if some.any():
            at_end = some & (value == value[some].min()) & (count > _SATURATED * len(scan.time))
            if at_end.sum() >= _ALIKE or scan.flagged(Status.saturated):
                out |= at_end
    return out


def _channel_findings(scan: Scan, table: ChannelTable) -> Iterator[Finding]:
    where = "/streams/eit"
    dead = table.dead
    yield from _listed(dead, table, Severity.ERROR, _how_dead(scan, dead), "see to their wires and bolts")
    remedy = "lower the gain or the drive current"
    yield from _listed(table.saturated, table, Severity.ERROR, "sit at the converter's end (saturated)", remedy)
    what = f"are more than {_NOISY:g} times noisier than most and below {_SNR:g} dB"
    yield from _listed(table.noisy, table, Severity.WARNING, what, "see to their wires and bolts")
    snr = table.snr[~table.bad & ~np.isnan(table.snr)]
    if len(snr) and np.median(snr) < _SNR:
        what = f"low signal: the median SNR of a reading is {np.median(snr):.1f} dB, below {_SNR:g} dB"
        yield Finding(Severity.WARNING, where, what, "more current, averaging, better contacts, less mains hum")
    error = table.reciprocity[~table.bad & np.isfinite(table.reciprocity)]
    if len(error) and np.median(error) > _RECIPROCITY:
        what = (
            f"reciprocity error: readings differ by {100 * np.median(error):.1f} % (median) when drive "
            "and sense are exchanged, where physics allows no difference"
        )
        yield Finding(Severity.WARNING, where, what, "the wiring or the order of the readings is not as recorded")


def _how_dead(scan: Scan, dead: np.ndarray) -> str:
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
    left = flag.copy()
    found: list[int] = []
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
        findings.append(Finding(Severity.WARNING, "/streams/eit", what, "mend the readings above first"))
        return None
    try:
        transfer = transfer_matrix(skin) if transfer is None else transfer
    except ValueError as error:
        what = f"the skin {skin.name!r} cannot be modelled: {error}"
        findings.append(Finding(Severity.ERROR, "/device", what, "correct the skin's TOML file"))
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
            f"{order.as_is:.3f} as recorded and {order.best:.3f} if so"
        )
        yield Finding(Severity.ERROR, where, what, order.remedy)
    elif order.as_is < 0.9:
        what = (
            f"the readings do not look like this skin: correlation with its model {order.as_is:.2f}, "
            f"and no simple reordering explains it (best {order.best:.2f})"
        )
        remedy = "compare positions and numbering of the electrodes in the skin's file with the hardware"
        yield Finding(Severity.WARNING, where, what, remedy)
    if order.as_is > 0 and not 0.03 < order.scale < 30:
        what = f"amplitude {order.scale:.3g} times the model's: unit (V, mV), gain or current?"
        yield Finding(Severity.WARNING, where, what, "correct the unit at import, current or sheet_resistance")
