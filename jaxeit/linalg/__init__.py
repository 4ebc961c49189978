"""Linear solvers as objects: symmetric positive definite, pattern fixed, values traced.

Example:
    import jax
    import jax.numpy as jnp
    import numpy as np

    import jaxeit as je
    from jaxeit import linalg

    jax.config.update("jax_enable_x64", True)

    n = 200  # a chain of springs: 2.1 on the diagonal, -1 beside it
    rows = np.concatenate([np.arange(n), np.arange(1, n)])
    cols = np.concatenate([np.arange(n), np.arange(n - 1)])
    pattern = linalg.SparsityPattern(n, rows, cols)
    values = jnp.concatenate([jnp.full(n, 2.1), jnp.full(n - 1, -1.0)])
    load = jnp.ones((n, 1))
    solve_spd = je.verb(linalg.solve_spd)
    for solver in (linalg.Dense(), linalg.NestedDissection(), linalg.ConjugateGradient()):
        plan = solver.analyse(pattern)  # once, on the host
        x = solve_spd(solver, plan, values, load)  # as often as needed, also under vmap and grad
        left = jnp.abs(linalg.matvec(plan, values, x) - load).max()
        print(f"{linalg.SOLVERS.text(solver)}: {left:.1e} left of the load")
    print(je.Fidelity.draft(solver=linalg.default_solver(n)))

    stack = jnp.eye(3) + 0.1 * jnp.arange(1.0, 5.0)[:, None, None]  # small matrices, safe under vmap
    eigenvalues, vectors = jax.vmap(linalg.eigh)(stack)
    singular = jax.vmap(lambda a: linalg.svd(a)[1])(stack)
    print(eigenvalues[:, ::-1] - singular, jax.vmap(linalg.solve, (0, None))(stack, jnp.ones(3)))
"""

from ..registry import Registry
from .base import AbstractLinearSolver, AbstractPlan, PatternError, SparsityPattern, inverse_columns, matvec, solve_spd
from .conjugate_gradient import ConjugateGradient, Single
from .covariance import is_covariance
from .dense import Dense
from .lapack import eigh, solve, svd
from .multifrontal.nested_dissection import NestedDissection

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
    "eigh",
    "inverse_columns",
    "is_covariance",
    "matvec",
    "solve",
    "solve_spd",
    "svd",
]


SOLVERS: Registry[AbstractLinearSolver] = Registry(AbstractLinearSolver, "linear solver", "jaxeit.solvers")
"""Linear solvers by the names that recipes use; a solver may contain another."""
SOLVERS.parts = (SOLVERS,)


def default_solver(n: int) -> AbstractLinearSolver:
    """The faster direct solver for n unknowns of a planar mesh."""
    return Dense() if n < 300 else NestedDissection()
