"""From a table of presses to fitted curves and fields of gain, with their validation and selection.

`curves` are functions of the pressure of a pad, `fields` gains over the place of the contact, `logs` fits without
presses. `pads` fits curves and field together, and `response` chooses among them.
"""

from .curves import (
    CURVES,
    AbstractCurve,
    Affine,
    AffinePlay,
    FittedCurve,
    Linear,
    MonotonePolynomial,
    MonotoneSpline,
    Play,
    PlaySpline,
    PowerLaw,
    fit_curve,
    fit_curves,
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
from .logs import fit_log
from .losses import LOSSES, AbstractLoss, Cauchy, Huber, SoftL1, Squared
from .pads import PadModel
from .results import FitError, FitResult
from .selection import Candidate

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
    "Linear",
    "MonotonePolynomial",
    "MonotoneSpline",
    "PadEdge",
    "PadEdgeSize",
    "PadModel",
    "Places",
    "Play",
    "PlaySpline",
    "PowerLaw",
    "RadialBasis",
    "SoftL1",
    "Squared",
    "TensorSpline",
    "fit_curve",
    "fit_curves",
    "fit_field",
    "fit_log",
    "single_places",
]
