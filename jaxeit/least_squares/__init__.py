"""Bounded nonlinear least squares in fixed shapes: one loop for curves, contacts and absolute images."""

from .adjoint import ImplicitStep
from .levenberg_marquardt import LeastSquaresState, LevenbergMarquardt
from .searches import BoundedDescent, Cholesky, DampingSearch, normal_equations, quadratic

__all__ = [
    "BoundedDescent",
    "Cholesky",
    "DampingSearch",
    "ImplicitStep",
    "LeastSquaresState",
    "LevenbergMarquardt",
    "normal_equations",
    "quadratic",
]
