"""Curves from pad pressure to force, one family per file, and their robust fit.

A new curve is one class in the file of its family, or in a file of its own that is imported here: `CURVES`, recipes,
the command line and the tests find it from there.
"""

from jaxeit.registry import Registry

from .base import AbstractCurve
from .elementary import Affine, Linear, PowerLaw
from .fit import fit_curve, fit_curves
from .fitted import FittedCurve
from .monotone import MonotonePolynomial, MonotoneSpline
from .play_operators import AffinePlay, Play, PlaySpline

CURVES = Registry(AbstractCurve, "curve", "calib.curves")
"""Curves by the names used on the command line and in calibration files.

The order is that of the imports: where two curves do equally well, the earlier one is chosen.
"""

__all__ = [
    "CURVES",
    "AbstractCurve",
    "Affine",
    "AffinePlay",
    "FittedCurve",
    "Linear",
    "MonotonePolynomial",
    "MonotoneSpline",
    "Play",
    "PlaySpline",
    "PowerLaw",
    "fit_curve",
    "fit_curves",
]
