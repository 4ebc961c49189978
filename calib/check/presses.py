"""Check the presses of a recording: their force, their places, the order of the pads, and the clocks of the streams."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import jaxeit as je

from ..presses.corrections import WindowMeans
from ..presses.detection import find_presses
from ..presses.means import dominant_pad, press_means
from ..presses.onsets import OnsetDelay, onset_delays
from ..presses.streams import PressError, recording_end
from ..presses.times import PressColumns
from ..presses.windows import PressWindows, press_windows, reject_without_samples
from ..session import PressTable, Session, SessionError, Stream
from ..session.units import SECOND
from .report import Finding, PressSummary, Severity
from .streams import StreamStatistics

MAX_COMPARED_PRESSES = 40  # on which the clocks are compared
MAX_WRONG_PADS = 0.3  # of the presses: so many may lie close to the edge of a pad


def list_presses(
    session: Session, statistics: dict[str, StreamStatistics], findings: list[Finding]
) -> tuple[PressColumns | None, str]:
    """The presses of a session and their source: the "table", detection in the "force", or "none"."""
    try:
        table = session.presses
    except SessionError as error:
        findings.append(Finding(Severity.ERROR, "/presses", str(error), "correct the table, or leave it out"))
        table = None
    if table is not None and len(table):
        return table, "table"
    if "force" not in statistics:
        return None, "none"
    try:
        return _detected(statistics["force"], findings), "force"
    except PressError as error:
        findings.append(Finding(Severity.ERROR, "/streams/force", str(error), "record a load cell"))
        return None, "none"


def _detected(stats: StreamStatistics, findings: list[Finding]) -> PressColumns:
    force = stats.stream.read()[:, 0]
    found, inverse = find_presses(stats.time, force), find_presses(stats.time, -force)
    if inverse.accepted.sum() > found.accepted.sum():
        findings.append(_negative_force())
        return inverse
    if not len(found):
        what = "the session lists no press, and none was found in the force"
        remedy = "check that the skin was pressed and that the right column was recorded"
        findings.append(Finding(Severity.WARNING, "/presses", what, remedy))
    return found


def _negative_force() -> Finding:
    return Finding(
        Severity.ERROR,
        "/streams/force",
        "the force is negative while pressing",
        "pressing is positive: negate the column at import, or turn the load cell over",
    )


def press_findings(
    statistics: dict[str, StreamStatistics], presses: PressColumns | None, skin: je.Skin | None, findings: list[Finding]
) -> tuple[PressColumns | None, tuple[tuple[str, OnsetDelay], ...]]:
    """Check the presses; returns them without those that lack samples, and the onset delays by stream."""
    if presses is None or not len(presses):
        return presses, ()
    before = presses.accepted.sum()
    streams = {n: s.stream for n, s in statistics.items() if n in ("eit", "pressure", "force")}
    windows = press_windows(presses, end=recording_end(streams.values()))
    presses = reject_without_samples(presses, windows, streams.values())
    lost = int(before - presses.accepted.sum())
    if not presses.accepted.any():
        what = f"none of {len(presses)} presses can be used: {presses.reason[0]}"
        # a log of force alone is fitted sample by sample and needs no presses
        severity = Severity.ERROR if "eit" in streams else Severity.WARNING
        findings.append(Finding(severity, "/presses", what, "see the reasons below and record again"))
        return presses, ()
    if lost:
        what = f"{lost} of {len(presses)} presses lack samples of a stream and are set aside"
        findings.append(Finding(Severity.WARNING, "/presses", what, "see the list below; press those places again"))
    means = {n: press_means(streams[n], windows).change for n in streams if n != "eit"}
    if "force" in means:
        findings += _force_findings(presses, means["force"])
    if skin is not None and isinstance(presses, PressTable):
        findings += _site_findings(presses, means.get("pressure"), skin)
    return presses, _compare_clocks(streams, presses, windows, findings)


def _force_findings(presses: PressColumns, change: WindowMeans) -> Iterator[Finding]:
    force = change.mean[presses.accepted, 0]
    force = force[np.isfinite(force)]
    if len(force) and np.median(force) < 0:
        yield _negative_force()
        return
    if not len(force) or not isinstance(presses, PressTable):
        return
    target = presses.target_force[presses.accepted]
    if len(force) != len(target) or not (target > 0).all():
        return
    ratio = float(np.median(force / target))
    if not 0.5 < ratio < 2:
        what = f"the force reads {ratio:.3g} times the target of the presses"
        yield Finding(Severity.WARNING, "/streams/force", what, "check the unit (N, g, kg, V), the tare and the gain")


def _compare_clocks(
    streams: dict[str, Stream], presses: PressColumns, windows: PressWindows, findings: list[Finding]
) -> tuple[tuple[str, OnsetDelay], ...]:
    if "force" not in streams:
        return ()
    first = presses.accepted & (np.cumsum(presses.accepted) <= MAX_COMPARED_PRESSES)
    chosen = replace(presses, accepted=first)  # type: ignore[type-var]
    others = [s for n, s in streams.items() if n != "force"]
    onsets = onset_delays(streams["force"], others, chosen, windows)
    ramp = float(np.median((presses.t_hold0 - presses.t_press)[first])) / SECOND
    for name, onset in onsets.items():
        # A curved response shifts the half-way point by up to a quarter of the ramp.
        allowed = max(0.4 * ramp, 0.05) + 2 / streams[name].nominal_rate
        if onset.presses and abs(onset.delay) > allowed:
            what = f"rises {onset.delay:+.3f} s after the force; the ramp takes {ramp:.2f} s"
            remedy = "the clocks disagree: align the streams before the calibration"
            findings.append(Finding(Severity.ERROR, f"/streams/{name}", what, remedy))
    return tuple(sorted(onsets.items()))


def _site_findings(presses: PressTable, pressure: WindowMeans | None, skin: je.Skin) -> Iterator[Finding]:
    sites = np.stack([presses.x, presses.y], 1)
    outside = np.flatnonzero(~skin.domain.contains(sites))
    if len(outside):
        i = outside[0]
        what = f"{len(outside)} of {len(sites)} presses lie outside the sheet (press {i} at {sites[i]} m)"
        remedy = "give metres in the frame of the skin, not mm and not the frame of the stage"
        yield Finding(Severity.ERROR, "/presses", what, remedy)
    elif pressure is not None and pressure.mean.shape[1] == len(skin.pads):
        yield from _pad_order(sites, presses.accepted, pressure.mean, skin)


def _pad_order(sites: np.ndarray, accepted: np.ndarray, pressure: np.ndarray, skin: je.Skin) -> Iterator[Finding]:
    """Compare the pad that responds with the pad under the tip."""
    inside = np.array([_outline(p).contains(sites) for p in skin.pads])
    under = np.where(inside.sum(0) == 1, inside.argmax(0), -1)
    felt = dominant_pad(pressure)
    use = accepted & (under >= 0) & (felt >= 0)
    wrong = use & (under != felt)
    if wrong.sum() <= MAX_WRONG_PADS * use.sum():
        return
    pairs = sorted(set(zip(felt[wrong].tolist(), under[wrong].tolist(), strict=True)))
    some = "; ".join(f"column {f} responds over pad {skin.pads[u].name!r}" for f, u in pairs[:4])
    what = f"another pad than the one under the tip responds in {wrong.sum()} of {use.sum()} presses: {some}"
    remedy = "reorder the columns or the pads of the skin, or check whether x and y are exchanged"
    yield Finding(Severity.ERROR, "/streams/pressure", what, remedy)


def _outline(pad: je.Pad) -> je.Polygon:
    return je.Polygon(tuple((float(x), float(y)) for x, y in pad.outline))


def press_summary(presses: PressColumns | None, source: str) -> PressSummary:
    if presses is None:
        return PressSummary("none", 0, ())
    reasons = enumerate(presses.reason)
    rejected = tuple((i, r or "set aside") for i, r in reasons if not presses.accepted[i])
    return PressSummary(source, int(presses.accepted.sum()), rejected)
