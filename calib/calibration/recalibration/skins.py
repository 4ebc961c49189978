"""Whether a session was recorded on the skin of a calibration."""

from ...presses.skins import differing_parts
from ...session import Session
from ..calibration import Calibration


def other_skin(calibration: Calibration, session: Session) -> list[str]:
    """A line if the session describes another skin than that of the calibration, though its scan is the same."""
    parts = differing_parts(session, calibration.skin)
    if calibration.electrodes is not None:
        parts = tuple(part for part in parts if part != "electrodes")  # the calibration has moved them
    if not parts:
        return []
    differ = f"the {' and the '.join(parts)} of the skin that the session describes ({session.skin_name!r})"
    return [f"{differ} differ from those of the calibration: if it is another skin, use the calibration of that skin"]
