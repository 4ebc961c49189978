"""What a function is given in the place of sessions or of paths: taken as meant, or refused with the call to make."""

import os
from collections.abc import Iterable
from pathlib import Path
from types import NoneType
from typing import Any

import jaxeit as je
from jaxeit.messages.kinds import require_kind

from .errors import SessionError
from .reader import Session


def call_on(name: str, value: Any) -> str:
    """The call of a function that opens a file, with the path of that file if a user gave one."""
    return f"{name}({os.fspath(value)!r})" if isinstance(value, str | os.PathLike) else f"{name}(path)"


def require_session(session: Any, call: str) -> None:
    """Refuse what is no open session, such as a path, in a ``call``.

    Raises:
        SessionError: naming the call, and the function that opens the file.
    """
    require_kind(session, Session, SessionError, "a Session", call_on("calib.open_session", session), call)


def require_skin_or_none(skin: Any, call: str) -> None:
    """Refuse what is neither a skin nor None, such as a recipe or a path in the place of the skin, in a ``call``.

    Raises:
        SessionError: naming the call, and how a skin is given.
    """
    give = (
        "one, such as skin=jaxeit.load_skin('testbed'), or None for that of the session; other choices by their names"
    )
    require_kind(skin, (je.Skin, NoneType), SessionError, "a skin", give, call)


def sessions_of(given: Session | Iterable[Session], call: str) -> list[Session]:
    """The sessions of any iterable, or of one session by itself.

    Raises:
        SessionError: if one of them is no open session.
    """
    several = isinstance(given, Iterable) and not isinstance(given, str | os.PathLike)
    sessions: list[Session] = list(given) if several else [given]  # type: ignore[arg-type, list-item]
    for session in sessions:
        require_session(session, call)
    return sessions


def paths_of(given: Iterable[str | os.PathLike[str]], call: str, error: type[ValueError] = SessionError) -> list[Path]:
    """The paths of a list; a path in the place of the list would be taken for the list of its letters.

    Raises:
        error: for a path that stands by itself.
    """
    if isinstance(given, str | os.PathLike):
        raise error(f"{call}: {os.fspath(given)!r} is a path, and not a list of paths; give [{os.fspath(given)!r}]")
    return [Path(path) for path in given]
