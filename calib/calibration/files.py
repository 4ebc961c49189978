"""Open a calibration of any kind."""

from pathlib import Path

from ..session.archive import archive_format
from . import log_calibration
from .calibration import Calibration, load_calibration as load_skin_calibration
from .log_calibration import LogCalibration, load_log_calibration


def load_calibration(path: str | Path) -> Calibration | LogCalibration:
    """Read the calibration of a skin, or of a sensor without EIT.

    Raises:
        SessionError: if the file is damaged or of another kind.
    """
    if archive_format(path) == log_calibration.FORMAT:
        return load_log_calibration(path)
    return load_skin_calibration(path)
