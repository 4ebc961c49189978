"""From a table of presses to fitted curves and fields of gain, with their validation and selection."""

from .curve_fit import fit_curve, fit_curves
from .curves import (
    CURVES,
    AbstractCurve,
    Affine,
    AffinePlay,
    Linear,
    MonotonePolynomial,
    MonotoneSpline,
    Play,
    PlaySpline,
    PowerLaw,
)
from .fields import (
    FIELDS,
    AbstractField,
    Bilinear,
    Constant,
    FittedField,
    GaussianProcess,
    Geometry,
    PadEdge,
    PadEdgeSize,
    Places,
    RadialBasis,
    TensorSpline,
    fit_field,
    single_places,
)
from .fitted_curve import FittedCurve
from .losses import LOSSES, AbstractLoss, Cauchy, Huber, SoftL1, Squared
from .pads import Hybrid
from .recursive import RecursiveLeastSquares, SensitivityTracker, Touched, follow, follow_frames
from .results import FitError, FitResult
from .selection import Candidate
from .validation import cross_validate, fit_log

__all__ = [
    "CURVES",
    "FIELDS",
    "LOSSES",
    "AbstractCurve",
    "AbstractField",
    "AbstractLoss",
    "Affine",
    "AffinePlay",
    "Bilinear",
    "Candidate",
    "Cauchy",
    "Constant",
    "FitError",
    "FitResult",
    "FittedCurve",
    "FittedField",
    "GaussianProcess",
    "Geometry",
    "Huber",
    "Hybrid",
    "Linear",
    "MonotonePolynomial",
    "MonotoneSpline",
    "PadEdge",
    "PadEdgeSize",
    "Places",
    "Play",
    "PlaySpline",
    "PowerLaw",
    "RadialBasis",
    "RecursiveLeastSquares",
    "SensitivityTracker",
    "SoftL1",
    "Squared",
    "TensorSpline",
    "Touched",
    "cross_validate",
    "fit_curve",
    "fit_curves",
    "fit_field",
    "fit_log",
    "follow",
    "follow_frames",
    "single_places",
]
