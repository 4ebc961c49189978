"""Check a whole session: what is wrong, where, and what to do about it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import jaxeit as je

from ..presses.timing.onsets import OnsetDelay
from ..record.journal.records import EventCode
from ..session import Session
from ..session.argument_checks import require_session, require_skin_or_none
from ..session.units import wrong_quantity
from .eit.reading_order import OrderCheck
from .eit.readings import check_eit
from .electrodes import check_electrodes
from .evidence import PressEvidence
from .logs.findings import log_findings
from .presses.force import force_findings, is_silent
from .presses.pad_responses import pad_response_findings
from .presses.pads import check_pads
from .presses.places import place_findings
from .presses.responses import reading_response_findings
from .presses.usable import NEEDED_STREAMS, list_presses, press_evidence, press_summary
from .report import ChannelTable, CheckReport, Finding, Severity
from .skin import check_skin
from .streams.clipping import clipping_findings
from .streams.clocks import CLOCKS_DISAGREE, COMPARED_STREAMS, compare_clocks
from .streams.dropouts import dropout_findings
from .streams.shifts import shift_findings
from .streams.statistics import Progress, StreamStatistics, copy_findings, stream_findings, stream_statistics
from .streams.stuck import stuck_findings
from .streams.table_clock import table_clock_finding


def check_session(
    session: Session,
    skin: je.Skin | None = None,
    *,
    transfer: np.ndarray | None = None,
    electrodes: bool = False,
    progress: Progress = iter,
) -> CheckReport:
    """Search a session for everything that would spoil a calibration.

    Args:
        skin: the skin that was recorded; default: the one described in the file.
        transfer: result of `transfer_matrix` for that skin, to check many sessions; default: computed here.
        electrodes: also fit the places of the electrodes to the untouched frame, which takes some ten seconds, and a
            minute where the programs have to be compiled.
        progress: wraps the iteration over blocks of each stream, such as `tqdm.tqdm`.

    Returns:
        A report. Damaged streams and skins become findings in it, not exceptions.

    Raises:
        SessionError: for a path or another object in the place of the session.
    """
    require_session(session, "check_session")
    require_skin_or_none(skin, "check_session")
    findings = [*_session_findings(session)]
    skin = check_skin(session, skin, findings)
    statistics = _checked_streams(session, skin, progress, findings)
    presses, source = list_presses(session, statistics, findings)
    evidence = press_evidence(statistics, presses, findings)
    channels, order = check_eit(session, statistics.get("eit"), presses, evidence, skin, transfer, findings)
    pads = check_pads(statistics, skin, findings)
    places = check_electrodes(skin, channels, order, findings) if electrodes else ()
    onsets = _compare(session, statistics, evidence, skin, channels, order, findings)
    if "eit" not in session.streams:
        findings += log_findings(statistics, session.simulated)
    return CheckReport(
        name=session.name,
        title=session.title,
        skin=session.skin_name,
        simulated=session.simulated,
        complete=session.complete,
        # A wrong sign shows where presses are detected and where they are compared.
        findings=tuple(dict.fromkeys(findings)),
        streams=tuple(s.row for s in statistics.values()),
        pads=pads,
        channels=channels,
        order=order,
        presses=press_summary(presses if evidence is None else evidence.presses, source),
        onsets=onsets,
        electrodes=places,
    )


def _checked_streams(
    session: Session, skin: je.Skin | None, progress: Progress, findings: list[Finding]
) -> dict[str, StreamStatistics]:
    """Read every stream once; returns what is kept of each."""
    statistics = stream_statistics(session, skin, progress, findings)
    for stats in statistics.values():
        findings += stream_findings(stats)
        if not session.simulated:  # a simulation may be free of noise
            findings += [*copy_findings(stats), *stuck_findings(stats), *dropout_findings(stats)]
            findings += clipping_findings(stats, skin)
    findings += shift_findings(statistics)
    return statistics


def _compare(
    session: Session,
    statistics: dict[str, StreamStatistics],
    evidence: PressEvidence | None,
    skin: je.Skin | None,
    channels: ChannelTable | None,
    order: OrderCheck | None,
    findings: list[Finding],
) -> tuple[tuple[str, OnsetDelay], ...]:
    """Compare the streams with each other by the presses that all of them see; returns the onset delays by stream."""
    if evidence is None or not len(evidence.number):
        return ()
    onsets = compare_clocks(statistics, evidence, findings)
    moved = _streams_of_wrong_clocks(statistics, evidence, findings)
    # What a wrong clock makes of the presses looks like wrong signs, places and pads.
    if "force" in statistics and not ({*COMPARED_STREAMS} & {*statistics} <= moved and moved):
        wrong = [*force_findings(evidence, skin, statistics["force"])]
        findings += wrong
        # What a wrong force makes of the pads looks like a wrong scale of them.
        evidence = replace(evidence, force=None) if any(f.where.endswith("force") for f in wrong) else evidence
    if channels is not None and "eit" not in moved:
        findings += reading_response_findings(evidence, channels)
    if skin is None:
        return onsets
    # A wrong order of the readings, or of the pads, would show as wrong places too.
    told = None if order is None or order.claimed or "eit" in moved else channels
    places = list(place_findings(evidence, skin, told, {n: s.stream for n, s in statistics.items()}))
    findings += places
    if "pressure" in {*statistics} - moved and all(f.severity < Severity.ERROR for f in places):
        findings += pad_response_findings(evidence, skin, int(statistics["pressure"].time[0]))
    return onsets


def _streams_of_wrong_clocks(
    statistics: dict[str, StreamStatistics], evidence: PressEvidence, findings: list[Finding]
) -> set[str]:
    """Names of the streams that disagree with the force in time; all of them if the table of presses does."""
    moved = {f.where.rpartition("/")[2] for f in findings if f.remedy == CLOCKS_DISAGREE}
    if moved or "force" not in statistics or is_silent(evidence, statistics["force"]):
        return moved
    found = table_clock_finding(statistics["force"], evidence)
    if found is None:
        return set()
    findings.append(found)
    return {*NEEDED_STREAMS}


def _session_findings(session: Session) -> Iterator[Finding]:
    if session.simulated:
        yield Finding(Severity.OK, "file", "SIMULATED: nothing here was measured")
    if not session.complete:
        yield Finding(
            Severity.WARNING,
            "file",
            "the recording is not complete (complete = 0)",
            "see the faults at /events, if there are any, and check its end",
        )
    yield from _recorded_faults(session)
    for name, stream in session.streams.items():
        if wrong := wrong_quantity(name, stream.unit):
            yield Finding(Severity.ERROR, f"/streams/{name}", wrong, "correct its unit, or give it another name")
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
