"""Check a whole session: what is wrong, where, and what to do about it."""

from collections.abc import Iterator

import numpy as np

import jaxeit as je

from ..record.journal.records import EventCode
from ..session import Session
from .eit import check_eit
from .pads import check_pads
from .presses import list_presses, press_findings, press_summary
from .report import CheckReport, Finding, Severity
from .skin import check_skin
from .streams import Progress, stream_findings, stream_statistics


def check_session(
    session: Session,
    skin: je.Skin | None = None,
    *,
    transfer: np.ndarray | None = None,
    progress: Progress = iter,
) -> CheckReport:
    """Search a session for everything that would spoil a calibration.

    Args:
        skin: the skin that was recorded; default: the one described in the file.
        transfer: result of `transfer_matrix` for that skin, to check many sessions; default: computed here.
        progress: wraps the iteration over blocks of each stream, such as `tqdm.tqdm`.

    Returns:
        A report. Damaged streams and skins become findings in it, not exceptions.
    """
    findings = [*_session_findings(session)]
    skin = check_skin(session, skin, findings)
    statistics = stream_statistics(session, skin, progress, findings)
    for stats in statistics.values():
        findings += stream_findings(stats)
    presses, source = list_presses(session, statistics, findings)
    presses, onsets = press_findings(statistics, presses, skin, findings)
    channels, order = check_eit(session, statistics.get("eit"), presses, skin, transfer, findings)
    pads = check_pads(statistics, skin, findings)
    return CheckReport(
        name=session.name,
        title=session.title,
        skin=session.skin_name,
        simulated=session.simulated,
        complete=session.complete,
        findings=tuple(findings),
        streams=tuple(s.row for s in statistics.values()),
        pads=pads,
        channels=channels,
        order=order,
        presses=press_summary(presses, source),
        onsets=onsets,
    )


def _session_findings(session: Session) -> Iterator[Finding]:
    if session.simulated:
        yield Finding(Severity.OK, "file", "SIMULATED: nothing here was measured")
    if not session.complete:
        yield Finding(
            Severity.WARNING,
            "file",
            "the recording was interrupted (complete = 0)",
            "check its end; `jaxeit recover` finishes what a crash left",
        )
    yield from _recorded_faults(session)
    missing = [n for n in ("eit", "pressure", "force") if n not in session.streams]
    if missing:
        what = f"no stream named {' or '.join(missing)}: checks that need it are left out"
        yield Finding(Severity.OK, "/streams", what, "a force map is calibrated from eit, pressure and force")


def _recorded_faults(session: Session) -> Iterator[Finding]:
    """What the recorder found wrong with the devices."""
    events = session.events
    if events is not None:
        for code, label in zip(events.code, events.label, strict=True):
            if code == EventCode.FAULT:
                yield Finding(Severity.WARNING, "/events", str(label), "mend the device and record again")
