"""Validate a recording and explain what is wrong, where, and what to do about it."""

import tomllib
from collections.abc import Iterator

import numpy as np

import jaxeit as je
from calib.check.eit import check_eit
from calib.check.presses import find_or_list, press_findings, summary
from calib.check.report import CheckReport, Finding, Severity
from calib.check.streams import Progress, check_pads, scan_streams, stream_findings
from calib.session import Session


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
    scans = scan_streams(session, skin, progress, findings)
    for scan in scans.values():
        findings += stream_findings(scan)
    presses, source = find_or_list(session, scans, findings)
    presses, onsets = press_findings(scans, presses, skin, findings)
    channels, order = check_eit(session, scans.get("eit"), presses, skin, transfer, findings)
    pads = check_pads(scans.get("pressure"), skin, findings)
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
        presses=summary(presses, source),
        onsets=onsets,
    )


def _about(session: Session) -> Iterator[Finding]:
    if session.simulated:
        yield Finding(Severity.OK, "file", "SIMULATED: nothing here was measured")
    if not session.complete:
        yield Finding(
            Severity.WARNING,
            "file",
            "the recording was interrupted (complete = 0)",
            "check its end; `jaxeit recover` finishes what a crash left",
        )
    missing = [n for n in ("eit", "pressure", "force") if n not in session.streams]
    if missing:
        what = f"no stream named {' or '.join(missing)}: what needs it is not checked"
        yield Finding(Severity.OK, "/streams", what, "a force map is calibrated from eit, pressure and force")


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
        severity = Severity.WARNING if "eit" in session.streams else Severity.OK
        what = "describes no skin: pads, numbering and signs are checked only against one given"
        findings.append(Finding(severity, "/device", what, "give the skin that was recorded (--skin FILE)"))
        return None
    try:
        return je.parse_skin(session.skin_toml, "skin_toml")
    except ValueError as error:
        what = f"the skin's text cannot be used: {error}"
        findings.append(Finding(Severity.ERROR, "/device", what, "give a corrected skin (--skin FILE)"))
        return None


def _differences(text: str, other: str, name: str) -> Iterator[Finding]:
    a, b = _flat(tomllib.loads(text)), _flat(tomllib.loads(other))
    keys = sorted(k for k in a.keys() | b.keys() if a.get(k) != b.get(k))
    if keys:
        some = ", ".join(keys[:6]) + (", ..." if len(keys) > 6 else "")
        what = f"the recorded skin differs from {name} in: {some}"
        yield Finding(Severity.WARNING, "/device", what, "if that is meant, give the edited skin a name of its own")


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
            yield Finding(Severity.ERROR, where, "no pattern was recorded", remedy)
        return
    if pattern.max() >= len(skin.electrodes):
        what = f"the pattern names electrode {pattern.max()}; the skin has 0 to {len(skin.electrodes) - 1}"
        yield Finding(Severity.ERROR, where, what, "electrodes are counted from 0")
    elif pattern.shape != own.pattern.shape or (pattern != own.pattern).any():
        remedy = "calibrate with the skin that was recorded (--skin FILE), or correct its protocol"
        yield Finding(Severity.ERROR, where, _pattern_difference(pattern, own.pattern), remedy)
    if session.current is not None and not np.isclose(session.current, own.current, rtol=0.01):
        what = f"drive current {session.current:g} A, the skin's file says {own.current:g} A"
        yield Finding(Severity.WARNING, where, what, "correct the one that is wrong")


def _pattern_difference(pattern: np.ndarray, own: np.ndarray) -> str:
    if pattern.shape != own.shape:
        return f"the pattern has {len(pattern)} readings, the skin's protocol {len(own)}"
    rows = np.flatnonzero((pattern != own).any(1))
    same = sorted(map(tuple, pattern.tolist())) == sorted(map(tuple, own.tolist()))
    kind = "holds the same readings in another order" if same else "is not the skin's protocol"
    first = f"row {rows[0]} is {pattern[rows[0]].tolist()}, the skin's {own[rows[0]].tolist()}"
    return f"the pattern {kind}: {len(rows)} rows differ ({first})"
