"""Sessions without EIT in a batch: a calibration each, by `calib.calibration.logs.procedure`."""

import contextlib

from ..calibration.logs.calibration import LogCalibration, load_log_calibration
from ..calibration.logs.procedure import calibrate_logs, with_batch_mark
from ..calibration.recipe import Recipe
from ..session import Session, SessionError


def ensure_log_calibration(
    path: str, session: Session, recipe: Recipe, mark: str, ignore_errors: bool = False
) -> tuple[LogCalibration, bool]:
    """The calibration of a session without EIT with this mark, and whether the file existed already.

    Raises:
        SessionError, FitError: if a stream is missing or nothing can be fitted.
        RecordingError: if `check_session` finds an error in the session, unless errors are ignored.
    """
    with contextlib.suppress(SessionError):
        found = load_log_calibration(path)
        if found.provenance.get("batch") == mark:
            return found, True
    made = with_batch_mark(calibrate_logs([session], recipe, ignore_errors=ignore_errors), mark)
    made.save(path)
    return made, False
