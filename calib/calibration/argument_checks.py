"""What a function is given in the place of the calibration of a skin, refused with the call to make."""

from collections.abc import Sequence
from typing import Any

from jaxeit.messages.kinds import require_kind
from jaxeit.model import require_dtype

from ..session import Session, SessionError
from ..session.argument_checks import call_on
from .calibration import Calibration
from .logs.calibration import LogCalibration


def require_calibration(calibration: Any, call: str, for_logs: str = "give that of a skin") -> None:
    """Refuse what is no calibration of a skin, such as a path, or one that JAX would lower to float32, in a ``call``.

    Args:
        for_logs: what to do with the calibration of a log, which functions that take one have handled before.

    Raises:
        SessionError: naming the call, and what to give.
        FidelityError: for a calibration of float64 while JAX's x64 mode is off.
    """
    if isinstance(calibration, LogCalibration):
        raise SessionError(f"{call}: the calibration is of a log, which has no EIT; {for_logs}")
    give = call_on("calib.load_calibration", calibration)
    require_kind(calibration, Calibration, SessionError, "a Calibration", give, call)
    require_dtype(calibration.dtype, f"{call}: the calibration is of float64")


def require_no_eit_choices(call: str, why: str = "the calibration is of a log", /, **choices: object) -> None:
    """Refuse choices about EIT for a log or its calibration.

    Args:
        why: why there is no EIT, in words.

    Raises:
        SessionError: naming the call and the first choice that is neither None nor False.
    """
    for name, value in choices.items():
        if value is not None and value is not False:
            raise SessionError(f"{call}: {name} is about EIT, and {why}; leave out {name}")


def are_logs(sessions: Sequence[Session], call: str) -> bool:
    """Whether sessions are logs, which hold no EIT.

    Raises:
        SessionError: there is no session, or some hold EIT and others none.
    """
    if not sessions:
        raise SessionError(f"{call}: no session given; give one or more session files")
    without = [session for session in sessions if "eit" not in session.streams]
    if without and len(without) < len(sessions):
        other = next(session for session in sessions if "eit" in session.streams)
        raise SessionError(
            f"{without[0].name}: /streams/eit: missing, as in a log, while {other.name} holds EIT; {call} logs and "
            "sessions of a skin apart"
        )
    return bool(without)
