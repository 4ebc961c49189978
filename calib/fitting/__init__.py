"""From a table of presses to fitted curves and fields of gain, with their validation and selection.

`curves` are functions of the pressure of a pad, `fields` gains over the place of the contact, `logs` fits without
presses. `pads` fits curves and field together, and `response` chooses among them.

Example:
    import jax
    import numpy as np

    import calib
    from calib import fitting

    jax.config.update("jax_enable_x64", True)

    rng = np.random.default_rng(0)
    pressures = np.sort(rng.uniform(0, 6000, (2, 300)))  # Pa, of two pads
    forces = np.array([[1.6e-3], [1.2e-3]]) * pressures**1.05 + 0.1 * rng.normal(size=(2, 300))  # N
    forces[:, ::50] += 5.0  # spikes, which a robust loss leaves out
    for curve in (calib.Linear(), calib.PowerLaw(), calib.fitting.MonotoneSpline()):
        fitted = calib.fit_curves(curve, pressures, forces, loss=fitting.Huber())
        print(curve.name, fitted.scale, [fitting.FitResult(int(r)).name for r in fitted.result])  # N
    found = fitted.pad(0).predict(np.array([1000.0, 9000.0]))
    print(found.force, found.standard_error, found.valid)  # N, N; the second is beyond what was fitted
"""

from .cross_validation.selection import Candidate
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
    PadEdgeSpline,
    Places,
    RadialBasis,
    TensorSpline,
    fit_field,
    geometry_of,
    single_places,
)
from .logs import fit_log
from .losses import LOSSES, AbstractLoss, Cauchy, Huber, SoftL1, Squared
from .pads import PadModel
from .results import FitError, FitResult

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
    "PadEdgeSpline",
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
    "geometry_of",
    "single_places",
]
