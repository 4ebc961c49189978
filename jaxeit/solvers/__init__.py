"""Linear solvers as objects: symmetric positive definite, pattern fixed, values traced."""

from ._base import (
    AbstractLinearSolver,
    AbstractPlan,
    Pattern,
    PatternError,
    inverse_columns,
    matvec,
    solve_spd,
)
from .conjugate_gradient import ConjugateGradient, Single
from .dense import Dense
from .nested_dissection import NestedDissection

__all__ = [
    "AbstractLinearSolver",
    "AbstractPlan",
    "ConjugateGradient",
    "Dense",
    "NestedDissection",
    "Pattern",
    "PatternError",
    "Single",
    "default_solver",
    "inverse_columns",
    "matvec",
    "solve_spd",
]


def default_solver(n: int) -> AbstractLinearSolver:
    """The quicker direct solver for n unknowns of a planar mesh."""
    return Dense() if n < 300 else NestedDissection()
