"""Check the presses of a recording: list them, and gather the changes of the streams during each press."""

from ...presses.streams import PressError, recording_end
from ...presses.timing.detection import find_presses
from ...presses.timing.times import PressColumns
from ...presses.timing.windows import press_windows, reject_without_samples
from ...session import Session, SessionError
from ..evidence import PressEvidence, gather_evidence
from ..report import Finding, PressSummary, Severity
from ..streams.statistics import StreamStatistics
from .force import is_negative, negative_force

NEEDED_STREAMS = ("eit", "pressure", "force")  # streams that every press needs samples of


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
        return _detected(statistics, findings), "force"
    except PressError as error:
        findings.append(Finding(Severity.ERROR, "/streams/force", str(error), "record a load cell"))
        return None, "none"


def _detected(statistics: dict[str, StreamStatistics], findings: list[Finding]) -> PressColumns:
    stats = statistics["force"]
    force = stats.stream.read()[:, 0]
    found, inverse = find_presses(stats.time, force), find_presses(stats.time, -force)
    if inverse.accepted.sum() > found.accepted.sum() and is_negative(statistics, inverse):
        findings.append(negative_force())
        return inverse
    if not len(found):
        what = "the session lists no press, and none was found in the force"
        remedy = "check that the skin was pressed and that the right column was recorded"
        findings.append(Finding(Severity.WARNING, "/presses", what, remedy))
    return found


def press_evidence(
    statistics: dict[str, StreamStatistics], presses: PressColumns | None, findings: list[Finding]
) -> PressEvidence | None:
    """Changes of the streams during the presses that have samples; None if there is no such press."""
    if presses is None or not len(presses):
        return None
    streams = {name: s.stream for name, s in statistics.items()}
    needed = [streams[name] for name in NEEDED_STREAMS if name in streams]
    if not needed:
        return None
    before = presses.accepted.sum()
    windows = press_windows(presses, end=recording_end(needed))
    presses = reject_without_samples(presses, windows, needed)
    lost = int(before - presses.accepted.sum())
    if not presses.accepted.any():
        reason = next(filter(None, presses.reason), "all are set aside (accepted = 0) without a reason")
        what = f"none of {len(presses)} presses can be used: {reason}"
        # a log of force alone is fitted sample by sample and needs no presses
        severity = Severity.ERROR if "eit" in streams else Severity.WARNING
        findings.append(Finding(severity, "/presses", what, "see the reasons below and record again"))
    elif 2 * before < len(presses):
        what = f"{len(presses) - before} of {len(presses)} presses are set aside (accepted = 0)"
        findings.append(Finding(Severity.WARNING, "/presses", what, "see the list below; press those places again"))
    elif lost:
        what = f"{lost} of {len(presses)} presses lack samples of a stream and are set aside"
        findings.append(Finding(Severity.WARNING, "/presses", what, "see the list below; press those places again"))
    overlaps = int((presses.t_press[1:] < presses.t_release[:-1]).sum())
    if overlaps:
        what = f"{overlaps} of {len(presses)} presses begin before the one before is released"
        findings.append(Finding(Severity.WARNING, "/presses", what, "correct the times of the table"))
    return gather_evidence(streams, presses, windows)


def press_summary(presses: PressColumns | None, source: str) -> PressSummary:
    """Source of the presses, number of accepted ones, and index and reason of each rejected one."""
    if presses is None:
        return PressSummary("none", 0, ())
    reasons = enumerate(presses.reason)
    rejected = tuple((i, r or "set aside") for i, r in reasons if not presses.accepted[i])
    return PressSummary(source, int(presses.accepted.sum()), rejected)
