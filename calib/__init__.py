"""calib: from what a bench or a robot recorded to newtons.

Names are imported when first used, so that the command line answers at once.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .batch import Outcome, calibrate_many
    from .bench import Bench, Timing, load_bench, simulate
    from .calibration import Calibration, calibrate, evaluate, load_calibration
    from .check import check_session
    from .corrections import LowPass, PreOnly, TwoSided
    from .curves import Affine, Hysteresis, HysteresisSpline, Linear, MonotonePolynomial, MonotoneSpline, Play, PowerLaw
    from .evaluation import Evaluation
    from .fit import Cauchy, FittedCurve, Huber, SoftL1, Squared, fit_curve, fit_curves
    from .hybrid import Hybrid
    from .importers import import_csv
    from .location import (
        Bilinear,
        Constant,
        FittedField,
        GaussianProcess,
        PadEdge,
        PadEdgeSize,
        Places,
        RadialBasis,
        TensorSpline,
        single_places,
    )
    from .locators import FittedContact, ImageCentroid, locate
    from .maps import ForceEstimate, apply, force_map
    from .measured import Measured, Processing, measure
    from .online import RecursiveLeastSquares, SensitivityTracker, Touched, follow, follow_frames
    from .report import write_report
    from .response import cross_validate, fit_log
    from .session import (
        PressTable,
        Session,
        SessionError,
        SessionWriter,
        Status,
        Stream,
        open_session,
        read_archive,
        write_archive,
    )

_HOMES = {
    "batch": "Outcome calibrate_many",
    "bench": "Bench Timing load_bench simulate",
    "calibration": "Calibration calibrate evaluate load_calibration",
    "check": "check_session",
    "corrections": "LowPass PreOnly TwoSided",
    "curves": "Affine Hysteresis HysteresisSpline Linear MonotonePolynomial MonotoneSpline Play PowerLaw",
    "evaluation": "Evaluation",
    "fit": "Cauchy FittedCurve Huber SoftL1 Squared fit_curve fit_curves",
    "hybrid": "Hybrid",
    "location": (
        "Bilinear Constant FittedField GaussianProcess PadEdge PadEdgeSize Places RadialBasis TensorSpline "
        "single_places"
    ),
    "locators": "FittedContact ImageCentroid locate",
    "maps": "ForceEstimate apply force_map",
    "importers": "import_csv",
    "measured": "Measured Processing measure",
    "online": "RecursiveLeastSquares SensitivityTracker Touched follow follow_frames",
    "report": "write_report",
    "response": "cross_validate fit_log",
    "session": "PressTable Session SessionError SessionWriter Status Stream open_session read_archive write_archive",
}
_HOME = {name: module for module, names in _HOMES.items() for name in names.split()}

__all__ = sorted(_HOME)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'calib' has no attribute {name!r}")
    return getattr(import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
