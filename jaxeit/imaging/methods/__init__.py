"""Methods of reconstruction: how data and prior are weighed against each other.

All work on whitened readings y (`whitening`), of independent noise of one size, with the Jacobian J of y:

    x = argmin |J x - y|^2 + l^2 x^T R x,        l^2 = hyperparameter^2 tr(J R^-1 J^T) / readings.

The scale makes the hyperparameter a number without unit that means the same on every skin: the standard deviation of
the noise over that of the data which the prior expects.

A new method is one class in the file of its family, or in a file of its own, and its import here: `METHODS`, recipes,
the command line and the tests find it from there.
"""

from ...registry import Registry
from .back_projection import BackProjection
from .base import AbstractIterativeMethod, AbstractLinearMethod, AbstractMethod, Problem
from .greit import Greit
from .non_negative import NonNegative
from .one_step import OneStep
from .reweighted import Reweighted
from .sparse_bayes import SparseBayes
from .truncated_svd import TruncatedSvd

METHODS = Registry(AbstractMethod, "method", "jaxeit.methods")
"""Methods by the names that the command line and recipes use."""

__all__ = [
    "METHODS",
    "AbstractIterativeMethod",
    "AbstractLinearMethod",
    "AbstractMethod",
    "BackProjection",
    "Greit",
    "NonNegative",
    "OneStep",
    "Problem",
    "Reweighted",
    "SparseBayes",
    "TruncatedSvd",
]
