"""Correction by location: how much stronger or weaker than on average a pad responds, by the place that is pressed.

A new field is one class in the file of its family, or in a file of its own that is imported here: `FIELDS`, recipes,
the command line and the tests find it from there.
"""

from jaxeit.registry import Registry

from .base import AbstractField
from .constant import Constant
from .fit import fit_field
from .fitted import FittedField, log_gain
from .geometry import Geometry, geometry_of
from .pad_edge import PadEdge, PadEdgeSize, PadEdgeSpline
from .places import Places, single_places
from .tensor_products import Bilinear, GaussianProcess, RadialBasis, TensorSpline

FIELDS = Registry(AbstractField, "field", "calib.fields")
"""Fields by the names used on the command line and in calibration files.

The order is that of the imports: where two fields do equally well, the earlier one is chosen.
"""

__all__ = [
    "FIELDS",
    "AbstractField",
    "Bilinear",
    "Constant",
    "FittedField",
    "GaussianProcess",
    "Geometry",
    "PadEdge",
    "PadEdgeSize",
    "PadEdgeSpline",
    "Places",
    "RadialBasis",
    "TensorSpline",
    "fit_field",
    "geometry_of",
    "log_gain",
    "single_places",
]
