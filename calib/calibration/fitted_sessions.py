"""Which sessions a calibration was fitted to or moved by: each once, and none of them as a test."""

from collections.abc import Mapping, Sequence

from ..session import Session, SessionError

FITTED = "the calibration was fitted to this session, so that the errors on other sessions are larger"


def require_each_once(sessions: Sequence[Session]) -> None:
    """Refuse a recording that is given twice, whose copy would be held out by itself.

    Raises:
        SessionError: naming both files.
    """
    known: dict[str, Session] = {}
    for session in sessions:
        for mark in {session.hash, session.session_id}:
            if mark in known:
                other = known[mark].name
                raise SessionError(
                    f"{session.name}: is the recording of {other} again (session_id {session.session_id}); "
                    "give each recording once"
                )
        known |= {session.hash: session, session.session_id: session}


def is_fitted(provenance: Mapping[str, str], session: Session) -> bool:
    """Whether a calibration of this provenance was fitted to the very file of a session, or moved by it."""
    return any(_is_listed(provenance, name, session) for name in ("sessions", "recalibrations"))


def is_calibrated_from(provenance: Mapping[str, str], session: Session) -> bool:
    """Whether a calibration of this provenance was fitted to the very file of a session."""
    return _is_listed(provenance, "sessions", session)


def require_not_moved_by(provenance: Mapping[str, str], session: Session) -> None:
    """Refuse a session by which a calibration was moved before: counted twice, it would seem surer than it is.

    Raises:
        SessionError: naming the session.
    """
    if _is_listed(provenance, "recalibrations", session):
        raise SessionError(f"{session.name}: has moved this calibration before; give a recording that is new")


def _is_listed(provenance: Mapping[str, str], name: str, session: Session) -> bool:
    return any(line.startswith(f"{session.hash}  ") for line in provenance.get(name, "").splitlines())
