"""What `jaxeit` and `calib` may ask of the machine: one budget of sizes, and the opening of files.

A package of its own, so that the recorder and the readers of files hold the same limits without importing JAX.
"""

from .budget import OR_RAISE, Budget, BudgetError, current_budget, require
from .files import open_regular

__all__ = ["OR_RAISE", "Budget", "BudgetError", "current_budget", "open_regular", "require"]
