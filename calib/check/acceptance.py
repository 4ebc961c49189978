"""Decide whether a session may be used: an error of `check_session` is refused, or noted if the user allows it."""

from collections.abc import Sequence

import jaxeit as je

from ..session import Session
from ..session.errors import SessionError, printable
from .eit.reading_order import transfer_matrix
from .report import Finding, Severity, counted
from .session import check_session


class RecordingError(SessionError):
    """A recording contains values that cannot be true, so that results computed from it would be wrong."""


def accept(
    sessions: Sequence[Session], skin: je.Skin | None, *, ignore_errors: bool = False, where: Sequence[str] = ("",)
) -> tuple[str, ...]:
    """Check sessions before they are used; returns their errors as notes if errors are ignored, otherwise no notes.

    Args:
        skin: the skin with which the sessions are used; None: the skin of each session.
        ignore_errors: return errors as notes instead of raising.
        where: beginnings of the places in a file whose errors count, such as "/streams/eit"; default: all.

    Raises:
        RecordingError: naming the first error of the first session that has one, and how many more there are.

    Example:
        try:
            with calib.open_session("session.h5") as session:
                calib.check.accept([session], je.load_skin("chest"))  # another skin
        except calib.check.RecordingError as error:
            print(error)
    """
    transfer = None
    if skin is not None and any("eit" in session.streams for session in sessions):
        try:
            transfer = transfer_matrix(skin)
        except ValueError:  # the check names it
            transfer = None
    notes: list[str] = []
    for session in sessions:
        findings = check_session(session, skin, transfer=transfer).findings
        errors = [f for f in findings if f.severity is Severity.ERROR and f.where.startswith(tuple(where))]
        if errors and not ignore_errors:
            raise RecordingError(_refusal(session, errors))
        notes += [f"{printable(session.name)}: error ignored: {printable(f'{f.where}: {f.what}', 300)}" for f in errors]
    return tuple(notes)


def _refusal(session: Session, errors: Sequence[Finding]) -> str:
    first, name = errors[0], printable(session.name)
    others = counted(len(errors) - 1, "more error")
    more = f" ({others}: jaxeit check)" if others else ""
    said = printable(f"{first.where}: {first.what}; {first.remedy}", 600)
    return f"{name}: {said}{more}; or use the session all the same (--force, ignore_errors=True)"
