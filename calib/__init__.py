"""calib: from what a bench or a robot recorded to newtons.

The names used every day are here; each room holds the rest, such as `calib.fitting.Huber`.
Rooms and names are imported on first use, so that the command line answers at once.
"""

from typing import TYPE_CHECKING

from ._lazy import lazy_names

if TYPE_CHECKING:
    from . import batch, bench, calibration, check, fitting, live, presses, record, report, session
    from .batch.sessions import calibrate_many
    from .bench import Bench, load_bench, simulate
    from .calibration import (
        Calibration,
        Evaluation,
        FittedContact,
        ForceEstimate,
        ImageCentroid,
        Recipe,
        apply,
        calibrate,
        evaluate,
        force_map,
        load_calibration,
        locate,
    )
    from .check import check_session
    from .fitting import (
        Affine,
        Bilinear,
        GaussianProcess,
        Linear,
        MonotonePolynomial,
        MonotoneSpline,
        PadEdge,
        PadEdgeSize,
        PowerLaw,
        RadialBasis,
        TensorSpline,
        fit_curve,
        fit_curves,
    )
    from .report.document import write_report
    from .session import Session, SessionError, SessionWriter, open_session
    from .session.importers import import_csv

__getattr__, __all__ = lazy_names(
    __name__,
    {
        "batch.sessions": "calibrate_many",
        "bench": "Bench load_bench simulate",
        "calibration": (
            "Calibration Evaluation FittedContact ForceEstimate ImageCentroid Recipe apply "
            "calibrate evaluate force_map load_calibration locate"
        ),
        "check": "check_session",
        "fitting": (
            "Affine Bilinear GaussianProcess Linear MonotonePolynomial MonotoneSpline PadEdge "
            "PadEdgeSize PowerLaw RadialBasis TensorSpline fit_curve fit_curves"
        ),
        "report.document": "write_report",
        "session": "Session SessionError SessionWriter open_session",
        "session.importers": "import_csv",
    },
    rooms=("batch", "bench", "calibration", "check", "fitting", "live", "presses", "record", "report", "session"),
)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
