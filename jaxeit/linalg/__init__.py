"""Linear solvers as objects: symmetric positive definite, pattern fixed, values traced."""

from ..registry import Registry
from .base import AbstractLinearSolver, AbstractPlan, PatternError, SparsityPattern, inverse_columns, matvec, solve_spd
from .conjugate_gradient import ConjugateGradient, Single
from .covariance import is_covariance
from .dense import Dense
from .nested_dissection import NestedDissection

__all__ = [
    "SOLVERS",
    "AbstractLinearSolver",
    "AbstractPlan",
    "ConjugateGradient",
    "Dense",
    "NestedDissection",
    "PatternError",
    "Single",
    "SparsityPattern",
    "default_solver",
    "inverse_columns",
    "is_covariance",
    "matvec",
    "solve_spd",
]


SOLVERS: Registry[AbstractLinearSolver] = Registry(AbstractLinearSolver, "linear solver", "jaxeit.solvers")
"""Linear solvers by the names that recipes use; a solver may contain another."""
SOLVERS.parts = (SOLVERS,)


def default_solver(n: int) -> AbstractLinearSolver:
    """The faster direct solver for n unknowns of a planar mesh."""
    return Dense() if n < 300 else NestedDissection()
