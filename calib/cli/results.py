"""Calibrations and evaluations of any kind as lines for a terminal."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..calibration import Calibration, LogCalibration
    from ..calibration.evaluation import Evaluation
    from ..calibration.logs.evaluation import LogEvaluation


def render_calibration(calibration: "Calibration | LogCalibration", heading: str) -> str:
    """What a calibration attains, and what is to be known of it."""
    from ..calibration.layer import render_layer
    from ..calibration.logs.calibration import LogCalibration
    from ..calibration.logs.procedure import render_log

    if isinstance(calibration, LogCalibration):
        return f"{render_log(heading, calibration)}\n\n{render_found(calibration.evaluation)}"
    lines = [render_found(calibration.evaluation, heading), *(f"  note: {note}" for note in calibration.notes)]
    if calibration.layer is not None:
        lines.append(f"  {render_layer(calibration.layer, calibration.recon)}")
    if calibration.contact_law is not None:
        lines.append(f"  force without pads: {calibration.contact_law.render()}")
    return "\n".join(lines)


def render_found(evaluation: "Evaluation | LogEvaluation", heading: str = "") -> str:
    """The errors of a calibration on a session."""
    from ..calibration.evaluation import render_table
    from ..calibration.logs.evaluation import LogEvaluation, render_evaluation

    if isinstance(evaluation, LogEvaluation):
        return render_evaluation(evaluation, heading)
    return render_table(evaluation, heading)
