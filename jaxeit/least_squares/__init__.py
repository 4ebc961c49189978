"""Least squares in fixed shapes, as solvers of optimistix, whose loop is the only one.

`LevenbergMarquardt` within bounds for curves, contacts and absolute images; `DualNewton` and `InteriorPoint` for
quadratic problems of hundreds of parameters that are nowhere negative.
"""

from .adjoint import ImplicitStep
from .levenberg_marquardt import LeastSquaresState, LevenbergMarquardt
from .non_negative import DenseProblem, DiagonalProblem, DualNewton, InteriorPoint
from .searches import BoundedDescent, Cholesky, DampingSearch, normal_equations, quadratic

__all__ = [
    "BoundedDescent",
    "Cholesky",
    "DampingSearch",
    "DenseProblem",
    "DiagonalProblem",
    "DualNewton",
    "ImplicitStep",
    "InteriorPoint",
    "LeastSquaresState",
    "LevenbergMarquardt",
    "normal_equations",
    "quadratic",
]
