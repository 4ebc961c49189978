"""The common parts of all linear solvers: the pattern, the product, the differentiable solve.

The systems are A x = b with A symmetric positive definite.  The places of A's entries are fixed, on
the host (`SparsityPattern`); the entries change under jit, vmap and grad (``values``).
"""

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Integer

from .._compile import full_precision
from ..registry import AbstractChoice


class PatternError(ValueError):
    """A sparsity pattern that does not describe a symmetric positive definite matrix.

    Example:
        try:
            linalg.SparsityPattern(2, np.array([0, 0, 1]), np.array([0, 1, 1]))  # above the diagonal
        except linalg.PatternError as error:
            print(error)
    """


def _no_indices() -> np.ndarray:
    return np.empty(0, np.int32)


@dataclass(frozen=True, eq=False)
class SparsityPattern:
    """The places where a symmetric matrix may be non-zero, and the places of its unknowns in space.

    | meaning                                                          | shape  | unit |
    |------------------------------------------------------------------|--------|------|
    | n: number of unknowns                                            |        |      |
    | rows, cols: lower triangle, whole diagonal, each place once      | (nnz,) |      |
    | coords: place of each unknown, NaN if it has none (optional)     | (n, d) | m    |
    | root: unknowns that may couple to every other, eliminated last;  | (r,)   |      |
    |   the inverse is wanted on them (`AbstractLinearSolver.corner`)  |        |      |

    Raises:
        PatternError: for an upper-triangle, repeated or out-of-range entry, or a hole in the diagonal.
    """

    n: int
    rows: np.ndarray
    cols: np.ndarray
    coords: np.ndarray | None = None
    root: np.ndarray = field(default_factory=_no_indices)

    def __post_init__(self) -> None:
        for name in ("rows", "cols", "root"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.int32))
        _check_entries(self.n, self.rows, self.cols)
        _check_places(self.n, self.coords, self.root)


def index_arrays(pattern: SparsityPattern) -> dict[str, Integer[Array, "..."]]:
    """The fields that every plan has: entries, the position of each diagonal entry among them, the root."""
    diagonal = np.empty(pattern.n, np.int32)
    places = np.flatnonzero(pattern.rows == pattern.cols)
    diagonal[pattern.rows[places]] = places
    arrays = {"rows": pattern.rows, "cols": pattern.cols, "diagonal": diagonal, "root": pattern.root}
    return {name: on_device(array, np.uint32) for name, array in arrays.items()}


def on_device(values: ArrayLike | list[float], dtype: Any) -> Array:
    """An array of this type; `jnp.asarray` would compile a program for nearly every shape.

    Indices should be unsigned: for signed indices XLA adds code to every lookup that handles negative values.
    """
    found: Array = jax.device_put(np.array(values, dtype))
    return found


def _check_entries(n: int, rows: np.ndarray, cols: np.ndarray) -> None:
    if rows.ndim != 1 or rows.shape != cols.shape:
        raise PatternError(f"rows {rows.shape} and cols {cols.shape} must be two equal vectors")
    if rows.size and not (cols.min() >= 0 and rows.max() < n and (cols <= rows).all()):
        raise PatternError(f"entries must satisfy 0 <= col <= row < {n}; mirror the upper ones")
    if np.unique(rows.astype(np.int64) * n + cols).size != rows.size:
        raise PatternError("an entry occurs twice; sum equal places before making the pattern")
    if np.count_nonzero(rows == cols) != n:
        raise PatternError("the diagonal must be whole; add the missing (i, i) entries")


def _check_places(n: int, coords: np.ndarray | None, root: np.ndarray) -> None:
    if coords is not None and (coords.ndim != 2 or coords.shape[0] != n):
        raise PatternError(f"coords has shape {coords.shape}; it needs one row for each of {n}")
    if root.ndim != 1 or np.unique(root).size != root.size:
        raise PatternError("root must be a vector of distinct indices")
    if root.size and not (root.min() >= 0 and root.max() < n):
        raise PatternError(f"root indices must lie in 0..{n - 1}")


class AbstractPlan(eqx.Module):
    """The result of `analyse` for a pattern.

    Index arrays are leaves: pass a plan to a jitted function as an argument.  If they were constants
    of the program, XLA would spend minutes on constant folding.
    """

    rows: eqx.AbstractVar[Integer[Array, " nnz"]]
    cols: eqx.AbstractVar[Integer[Array, " nnz"]]
    diagonal: eqx.AbstractVar[Integer[Array, " n"]]
    root: eqx.AbstractVar[Integer[Array, " r"]]
    n: eqx.AbstractVar[int]


class AbstractLinearSolver(AbstractChoice):
    """Analyse once on the host, factor once per matrix, solve as often as needed.

    A matrix that is not positive definite, or an iteration that does not converge, gives NaN
    in all entries, as `jax.lax.linalg.cholesky` does; the caller checks the values.
    """

    @abstractmethod
    def analyse(self, pattern: SparsityPattern) -> AbstractPlan:
        """The plan: all data that depend on the pattern only, computed on the host."""

    @abstractmethod
    def factor(self, plan: Any, values: Float[Array, " nnz"]) -> Any:
        """Factor of the matrix with these values, in their dtype; a pytree for `solve`."""

    @abstractmethod
    def solve(self, factor: Any, rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
        """The solutions (n, k) for k right-hand sides (n, k)."""

    @abstractmethod
    def columns(self, factor: Any) -> Float[Array, "n r"]:
        """The r columns of the inverse that belong to `SparsityPattern.root`, (n, r)."""

    @abstractmethod
    def corner(self, plan: Any, values: Float[Array, " nnz"]) -> Float[Array, "r r"]:
        """The inverse on `SparsityPattern.root` alone, (r, r); a direct method needs no substitution for it."""


def unit_columns(plan: AbstractPlan, dtype: Any) -> Float[Array, "n r"]:
    """Columns of the unit matrix that belong to the root."""
    return jnp.zeros((plan.n, plan.root.size), dtype).at[plan.root, jnp.arange(plan.root.size)].set(1)


def matvec(plan: AbstractPlan, values: Float[Array, " nnz"], x: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """A x from the lower triangle: an entry off the diagonal counts as (i, j) and as (j, i).

    Linear in values and in x.
    """
    rows, cols = plan.rows, plan.cols
    mirrored = jnp.where(rows == cols, 0, values)
    lower = jnp.zeros_like(x).at[rows].add(values[:, None] * x[cols])
    return lower.at[cols].add(mirrored[:, None] * x[rows])


def jacobi_scale(plan: AbstractPlan, values: Float[Array, " nnz"]) -> tuple[Float[Array, " n"], Float[Array, " nnz"]]:
    """d with d_i = A_ii^-1/2, and the values of the scaled matrix D A D, whose diagonal is one.

    Contact conductances may put 24 decades between diagonal entries.  Unit-diagonal scaling is
    within a factor n of the best diagonal scaling there is (van der Sluis 1969).
    """
    d = jax.lax.rsqrt(values[plan.diagonal])
    return d, values * d[plan.rows] * d[plan.cols]


def solve_spd(
    solver: AbstractLinearSolver,
    plan: AbstractPlan,
    values: Float[Array, " nnz"],
    rhs: Float[Array, "n k"],
) -> Float[Array, "n k"]:
    """x = A^-1 b, differentiable any number of times, forwards and backwards, and under vmap.

    The matrix is factored once.  Tangents satisfy dx = A^-1 (db - dA x) and cotangents the transpose
    of this, both with the same factor.
    """
    factor = solver.factor(plan, jax.lax.stop_gradient(values))
    return _solved(solver, factor, plan, values, rhs)


def inverse_columns(
    solver: AbstractLinearSolver, plan: AbstractPlan, values: Float[Array, " nnz"]
) -> Float[Array, "n r"]:
    """X = A^-1 on the columns of the root, differentiable as `solve_spd` is: dX = -A^-1 dA X.

    Example:
        ends = linalg.SparsityPattern(n, rows, cols, root=np.array([0, n - 1]))
        plan = linalg.Dense().analyse(ends)
        print(linalg.inverse_columns(linalg.Dense(), plan, values).shape)  # (n, 2): one column for each end
    """
    factor = solver.factor(plan, jax.lax.stop_gradient(values))
    found: Float[Array, "n r"] = _columns(values, factor, plan, solver)
    return found


@eqx.filter_custom_jvp
def _columns(
    values: Float[Array, " nnz"], factor: Any, plan: AbstractPlan, solver: AbstractLinearSolver
) -> Float[Array, "n r"]:
    return solver.columns(factor).astype(values.dtype)  # a solver may compute in lower precision


@full_precision
def _columns_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    values, factor, plan, solver = primals
    x = _columns(values, factor, plan, solver)
    if tangents[0] is None:
        return x, jnp.zeros_like(x)
    return x, _solved(solver, factor, plan, values, -matvec(plan, tangents[0], x))


_columns.def_jvp(_columns_jvp)


def _solved(
    solver: AbstractLinearSolver,
    factor: Any,
    plan: AbstractPlan,
    values: Float[Array, " nnz"],
    rhs: Float[Array, "n k"],
) -> Float[Array, "n k"]:
    found: Array = jax.lax.custom_linear_solve(
        partial(matvec, plan, values), rhs, lambda _, b: solver.solve(factor, b), symmetric=True
    )
    return found
