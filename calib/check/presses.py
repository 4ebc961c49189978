"""Presses of a recording, and what they say about force, sites, pads and clocks."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import jaxeit as je
from calib.check.report import Finding, PressSummary, Severity
from calib.check.streams import Scan
from calib.corrections import Estimate
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
    recording_end,
)
from calib.session import Session, SessionError

_ONSETS = 40  # presses that clocks are compared on


def find_or_list(session: Session, scans: dict[str, Scan], findings: list[Finding]) -> tuple[Presses | None, str]:
    """The presses, and where they come from: "table", "force" or "none"."""
    try:
        table = session.presses
    except SessionError as error:
        findings.append(Finding(Severity.ERROR, "/presses", str(error), "correct the table, or leave it out"))
        table = None
    if table is not None and len(table):
        return table, "table"
    if "force" not in scans:
        return None, "none"
    try:
        return _found(scans["force"], findings), "force"
    except PressError as error:
        findings.append(Finding(Severity.ERROR, "/streams/force", str(error), "record a load cell"))
        return None, "none"


def _found(scan: Scan, findings: list[Finding]) -> Presses:
    force = scan.stream.read()[:, 0]
    found, inverse = find_presses(scan.time, force), find_presses(scan.time, -force)
    if inverse.accepted.sum() > found.accepted.sum():
        findings.append(_negative())
        return inverse
    if not len(found):
        what = "no press listed, and none found in the force"
        findings.append(
            Finding(Severity.WARNING, "/presses", what, "was the skin pressed, and the right column recorded?")
        )
    return found


def _negative() -> Finding:
    return Finding(
        Severity.ERROR,
        "/streams/force",
        "the force is negative while pressing",
        "pressing is positive: negate the column at import, or turn the load cell round",
    )


def press_findings(
    scans: dict[str, Scan], presses: Presses | None, skin: je.Skin | None, findings: list[Finding]
) -> tuple[Presses | None, tuple[tuple[str, Onset], ...]]:
    """The presses less those that lack samples, and onsets; findings on force, sites, pads, clocks."""
    if presses is None or not len(presses):
        return presses, ()
    before = presses.accepted.sum()
    streams = {n: s.stream for n, s in scans.items() if n in ("eit", "pressure", "force")}
    windows = press_windows(presses, end=recording_end(streams.values()))
    presses = check_overlap(presses, windows, streams.values())
    lost = int(before - presses.accepted.sum())
    if not presses.accepted.any():
        what = f"none of {len(presses)} presses can be used: {presses.reason[0]}"
        # a log of force alone is fitted sample by sample and needs no presses
        severity = Severity.ERROR if "eit" in streams else Severity.WARNING
        findings.append(Finding(severity, "/presses", what, "see the reasons below; record again"))
        return presses, ()
    if lost:
        what = f"{lost} of {len(presses)} presses lack samples of a stream and are set aside"
        findings.append(Finding(Severity.WARNING, "/presses", what, "see the list below; press those places again"))
    means = {n: press_means(streams[n], windows).change for n in streams if n != "eit"}
    if "force" in means:
        findings += _force_findings(presses, means["force"])
    if skin is not None and hasattr(presses, "x"):
        findings += _site_findings(presses, means.get("pressure"), skin)
    return presses, _onsets(streams, presses, windows, findings)


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
        yield Finding(Severity.WARNING, "/streams/force", what, "is the unit right (N, g, kg, V)? tare and gain?")


def _onsets(streams, presses, windows, findings: list[Finding]) -> tuple[tuple[str, Onset], ...]:
    if "force" not in streams:
        return ()
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
            findings.append(Finding(Severity.ERROR, f"/streams/{name}", what, remedy))
    return tuple(sorted(onsets.items()))


def _site_findings(presses, pressure: Estimate | None, skin: je.Skin) -> Iterator[Finding]:
    sites = np.stack([presses.x, presses.y], 1)
    outside = np.flatnonzero(~skin.domain.contains(sites))
    if len(outside):
        i = outside[0]
        what = f"{len(outside)} of {len(sites)} presses lie outside the sheet (press {i} at {sites[i]} m)"
        yield Finding(Severity.ERROR, "/presses", what, "metres in the skin's frame, not mm or the stage's frame?")
    elif pressure is not None and pressure.mean.shape[1] == len(skin.pads):
        yield from _pad_order(sites, presses.accepted, pressure.mean, skin)


def _pad_order(sites, accepted, pressure, skin: je.Skin) -> Iterator[Finding]:
    """Does the pad under the tip respond, or another one?"""
    inside = np.array([_outline(p).contains(sites) for p in skin.pads])
    under = np.where(inside.sum(0) == 1, inside.argmax(0), -1)
    felt = dominant_pad(pressure)
    use = accepted & (under >= 0) & (felt >= 0)
    wrong = use & (under != felt)
    if wrong.sum() <= 0.3 * use.sum():
        return
    pairs = sorted(set(zip(felt[wrong].tolist(), under[wrong].tolist(), strict=True)))
    some = "; ".join(f"column {f} responds over pad {skin.pads[u].name!r}" for f, u in pairs[:4])
    what = f"another pad than the one under the tip responds in {wrong.sum()} of {use.sum()} presses: {some}"
    yield Finding(
        Severity.ERROR, "/streams/pressure", what, "reorder the columns or the skin's pads; or x and y are turned"
    )


def _outline(pad: je.Pad) -> je.Polygon:
    return je.Polygon(tuple((float(x), float(y)) for x, y in pad.outline))


def summary(presses: Presses | None, source: str) -> PressSummary:
    if presses is None:
        return PressSummary("none", 0, ())
    reasons = enumerate(presses.reason)
    rejected = tuple((i, r or "set aside") for i, r in reasons if not presses.accepted[i])
    return PressSummary(source, int(presses.accepted.sum()), rejected)
