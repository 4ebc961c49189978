"""Linear solvers as objects: symmetric positive definite, pattern fixed, values traced."""

from ._base import (
    AbstractLinearSolver,
    AbstractPlan,
    Pattern,
    PatternError,
    matvec,
    solve_spd,
)
from .dense import Dense
from .nested_dissection import NestedDissection

__all__ = [
    "AbstractLinearSolver",
    "AbstractPlan",
    "Dense",
    "NestedDissection",
    "Pattern",
    "PatternError",
    "default_solver",
    "matvec",
    "solve_spd",
]


def default_solver(n: int) -> AbstractLinearSolver:
    """The quicker direct solver for n unknowns of a planar mesh."""
    return Dense() if n < 300 else NestedDissection()
