"""Decide whether a session may be used: an error of `check_session` is refused, or noted if the user allows it.

Warnings are noted, so that whoever uses a session reads what `jaxeit check` says of it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jaxeit as je

from ..session import Session
from ..session.errors import SessionError, printable
from .eit.reading_order import transfer_matrix
from .report import Finding, Severity, counted
from .session import check_session
from .skin import DIFFERS


class RecordingError(SessionError):
    """A recording contains values that cannot be true, so that results computed from it would be wrong."""


# Parts of a session whose warnings are noted. Commands note presses that are set aside, the recorder its faults.
NOTED_PARTS = ("/device", "/streams")


class Acceptance(NamedTuple):
    """What is to be noted of sessions that are used: their errors, if these are ignored, and their warnings."""

    ignored: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """The errors, then the warnings."""
        return self.ignored + self.warnings


def accept(
    sessions: Sequence[Session],
    skin: je.Skin | None,
    *,
    ignore_errors: bool = False,
    where: Sequence[str] = ("",),
    uninformative: bool = True,
) -> Acceptance:
    """Check sessions before they are used; returns their warnings, and their errors if errors are ignored, as notes.

    Args:
        skin: the skin with which the sessions are used; None: the skin of each session.
        ignore_errors: return errors as notes instead of raising.
        where: beginnings of the places in a file that are used, such as "/streams/eit"; default: all. Errors and
            warnings elsewhere do not count.
        uninformative: return the warnings about channels without information, too.

    Raises:
        RecordingError: naming the first error of the first session that has one, and how many more there are.

    Example:
        try:
            with calib.open_session("session.h5") as session:
                print(calib.check.accept([session], None).warnings)
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
    ignored: list[str] = []
    warnings: list[str] = []
    for session in sessions:
        found = check_session(session, skin, transfer=transfer).findings
        findings = [f for f in found if f.where.startswith(tuple(where))]
        errors = [f for f in findings if f.severity is Severity.ERROR]
        if errors and not ignore_errors:
            raise RecordingError(_refusal(session, errors, [f for f in found if f.what.startswith(DIFFERS)]))
        name = printable(session.name)
        ignored += [f"{name}: error ignored: {printable(f'{f.where}: {f.what}', 300)}" for f in errors]
        warned = [f for f in findings if f.severity is Severity.WARNING and f.where.startswith(NOTED_PARTS)]
        warnings += [f"{name}: {_said(f)}" for f in warned if uninformative or not f.uninformative]
    return Acceptance(tuple(ignored), tuple(warnings))


def _said(finding: Finding) -> str:
    """A finding and what to do, in one line."""
    return printable(f"{finding.where}: {finding.what}; {finding.remedy}", 600)


def _refusal(session: Session, errors: Sequence[Finding], differing: Sequence[Finding]) -> str:
    """The first error; where the skin of the session differs, this first, and the error as what follows from it."""
    name, said, command = printable(session.name), _said(errors[0]), "jaxeit check"
    if differing:
        why, error = (printable(f"{f.where}: {f.what}", 300) for f in (differing[0], errors[0]))
        said, command = f"{why}; use a session of that skin. With it, {error}", "jaxeit check --skin"
    others = counted(len(errors) - 1, "more error")
    more = f" ({others}: {command})" if others else ""
    return f"{name}: {said}{more}; or use the session all the same (--force, ignore_errors=True)"
