"""Open a calibration of any kind."""

from pathlib import Path

from ...session.archive import archive_format
from ..calibration import Calibration, load_calibration as load_skin_calibration
from ..logs import calibration as log_calibration
from ..logs.calibration import LogCalibration, load_log_calibration


def load_calibration(path: str | Path) -> Calibration | LogCalibration:
    """Read the calibration of a skin, or of a sensor without EIT.

    Raises:
        SessionError: if the file is damaged or of another kind.
    """
    if archive_format(path) == log_calibration.FORMAT:
        return load_log_calibration(path)
    return load_skin_calibration(path)
