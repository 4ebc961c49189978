"""The two parts of Levenberg and Marquardt's method: a damped step inside a box, and the choice of its damping.

Both work on `optimistix.FunctionInfo.EvalGradHessian`: half the sum of squares, its gradient J^T r and an approximate
second derivative such as J^T J. So do the descents and searches of optimistix, which may take their places.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Bool, DTypeLike, Float

from ..linalg.lapack import cho_factor, cho_solve

Parameters = Float[Array, " k"]
Matrix = Float[Array, "k k"]
Scalar = Float[Array, ""]

if TYPE_CHECKING:  # for type checkers optimistix keeps the class among the variables of another

    class HalfSquares(optx.FunctionInfo):
        """Half a sum of squares near a point: value, gradient and second derivative."""

        f: Scalar
        grad: Parameters
        hessian: lx.MatrixLinearOperator

        def __init__(self, f: Scalar, grad: Parameters, hessian: lx.MatrixLinearOperator): ...

        def as_min(self) -> Scalar: ...
else:
    HalfSquares = optx.FunctionInfo.EvalGradHessian

# For type checkers its class holds the text of each result.
SUCCESSFUL = cast(optx.RESULTS, optx.RESULTS.successful)

# Roundings of one that are added to a normal matrix of unit diagonal, so that its Cholesky factor exists.
RIDGE = 1e3
# Part of Gauss and Newton's curvature that is left to a residual at least, so that the normal matrix stays definite.
MIN_CURVATURE = 0.01


def quadratic(value: Scalar, gradient: Parameters, hessian: Matrix) -> HalfSquares:
    """An objective near a point, ``value + gradient . d + d^T hessian d / 2``.

    Example:
        bowl = ls.quadratic(jnp.array(0.0), jnp.ones(2), 2 * jnp.eye(2))  # d . (1, 1) + |d|^2
    """
    return HalfSquares(value, gradient, lx.MatrixLinearOperator(hessian, lx.positive_semidefinite_tag))


def normal_equations(
    residual: Float[Array, " n"], slopes: Float[Array, "n k"], weight: Float[Array, " n"] | None = None
) -> HalfSquares:
    """Half the sum of squares of residuals near a point, from their slopes J: J^T r, and J^T diag(weight) J.

    Args:
        weight: part of Gauss and Newton's curvature that a robust loss leaves to each residual; default: all.

    Example:
        x = fit.value
        near = ls.normal_equations(residual(x, force), jax.jacfwd(residual)(x, force))
        print(jnp.abs(near.grad).max())  # next to nothing at the minimum
    """
    weighed = slopes if weight is None else slopes * jnp.maximum(weight, MIN_CURVATURE)[:, None]
    return quadratic(0.5 * residual @ residual, slopes.T @ residual, weighed.T @ slopes)


def inverse_scale(diagonal: Parameters) -> Parameters:
    """One over the root of a normal matrix's diagonal, which vanishes for a parameter that does nothing."""
    return jax.lax.rsqrt(jnp.maximum(diagonal, 1e-12 * jnp.max(diagonal) + jnp.finfo(diagonal.dtype).tiny))


def ridge(dtype: DTypeLike) -> float:
    """What keeps the Cholesky factor of a normal matrix of unit diagonal from failing, by precision."""
    return RIDGE * float(jnp.finfo(dtype).eps)


def normal_inverse(
    normal: Matrix, used: Bool[Array, " k"], damping: Scalar | float = 0.0
) -> Callable[[Float[Array, "k ..."]], Float[Array, "k ..."]]:
    """The function ``right -> (N + damping diag N)^-1 right`` among the parameters used; zero for the others."""
    scale = jnp.where(used, inverse_scale(jnp.diagonal(normal)), 0)
    extra = jnp.where(used, damping + ridge(normal.dtype), 1).astype(normal.dtype)
    factor = cho_factor(normal * scale[:, None] * scale + jnp.diag(extra))

    def solve(right: Float[Array, "k ..."]) -> Float[Array, "k ..."]:
        column = scale.reshape(-1, *[1] * (right.ndim - 1))
        return column * cho_solve(factor, column * right)

    return solve


def free_parameters(y: Parameters, gradient: Parameters, lower: Parameters, upper: Parameters) -> Bool[Array, " k"]:
    """Which parameters are not pushed against their bounds (Bertsekas 1982, SIAM J. Control Optim. 20)."""
    return ~((y <= lower) & (gradient > 0) | (y >= upper) & (gradient < 0))


class Cholesky(lx.Cholesky):  # type: ignore[misc]  # lineax has annotations but no py.typed
    """`lineax.Cholesky` of a positive operator, by our factors, which are safe under `jax.vmap`.

    For the descents of optimistix, such as ``optimistix.NewtonDescent(linear_solver=Cholesky())``.

    Example:
        newton = optx.NewtonDescent(linear_solver=ls.Cholesky())
        unbounded = ls.LevenbergMarquardt(1e-8, 1e-8, descent=newton, search=optx.BacktrackingArmijo())
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> tuple[Matrix, None]:
        """The factor."""
        return cho_factor(operator.as_matrix())[0], None

    def compute(
        self, state: tuple[Matrix, None], vector: Parameters, options: dict[str, Any]
    ) -> tuple[Parameters, lx.RESULTS, dict[str, Any]]:
        """The solution for one right-hand side."""
        return cho_solve((state[0], False), vector), lx.RESULTS.successful, {}


class _AtPoint(NamedTuple):
    """The point from which a step is made, and the quadratic there."""

    y: Parameters
    quadratic: HalfSquares


class BoundedDescent(optx.AbstractDescent[Parameters, HalfSquares, _AtPoint]):
    """Marquardt's damped step inside a box; the damping is one over the step size, as in optimistix.

    A parameter that is pushed against its bound rests there. One that the step would take out of the box goes to its
    bound, and the others take the step that is best then. ``lower`` and ``upper`` are the bounds, (k,); None: no bound.

    Example:
        solver = ls.LevenbergMarquardt(1e-8, 1e-8, descent=ls.BoundedDescent(lower=jnp.zeros(2)))
    """

    lower: Parameters | None = None
    upper: Parameters | None = None

    def within(self, lower: Parameters | None, upper: Parameters | None) -> "BoundedDescent":
        """The same descent inside another box."""
        return BoundedDescent(lower, upper)

    def init(self, y: Parameters, f_info_struct: HalfSquares) -> _AtPoint:
        """Nothing is known yet."""
        return _AtPoint(y, jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), f_info_struct))

    def query(self, y: Parameters, f_info: HalfSquares, state: _AtPoint) -> _AtPoint:
        """Remember the point."""
        return _AtPoint(y, f_info)

    def step(self, step_size: Scalar, state: _AtPoint) -> tuple[Parameters, optx.RESULTS]:
        """The step, (k,)."""
        y, gradient, normal = state.y, state.quadratic.grad, state.quadratic.hessian.matrix
        damping = 1 / step_size
        if self.lower is None and self.upper is None:
            return -normal_inverse(normal, jnp.ones(y.shape, bool), damping)(gradient), SUCCESSFUL
        low = jnp.full_like(y, -jnp.inf) if self.lower is None else self.lower
        high = jnp.full_like(y, jnp.inf) if self.upper is None else self.upper
        free = free_parameters(y, gradient, low, high)
        step = -normal_inverse(normal, free, damping)(gradient)
        below, above = y + step < low, y + step > high

        def others_anew() -> Parameters:
            hit = below | above
            part = jnp.where(below, low - y, jnp.where(above, high - y, 0))
            rest = -normal_inverse(normal, free & ~hit, damping)(gradient + normal @ part)
            return jnp.clip(y + part + rest, low, high) - y

        return jax.lax.cond(jnp.any(below | above), others_anew, lambda: step), SUCCESSFUL


class DampingSearch(optx.AbstractSearch[Parameters, HalfSquares, HalfSquares, Scalar]):
    """Takes every step that leads down; less damping after it, more after one that leads up.

    | meaning                                                    | default |
    |------------------------------------------------------------|---------|
    | first damping, of the diagonal of the normal matrix        | 1e-3    |
    | after_descent: factor after a step that leads down         | 0.1     |
    | after_ascent: factor after a step that leads up            | 10      |
    | least damping                                              | 1e-9    |
    """

    first: float = 1e-3
    after_descent: float = 0.1
    after_ascent: float = 10.0
    least: float = 1e-9

    def init(self, y: Parameters, f_info_struct: HalfSquares) -> Scalar:
        """The first damping."""
        return jnp.full((), self.first, y.dtype)

    def step(
        self,
        first_step: Bool[Array, ""],
        y: Parameters,
        y_eval: Parameters,
        f_info: HalfSquares,
        f_eval_info: HalfSquares,
        state: Scalar,
    ) -> tuple[Scalar, Bool[Array, ""], optx.RESULTS, Scalar]:
        """Step size (one over the damping), whether the last step is taken, and the damping."""
        accept = f_eval_info.as_min() < f_info.as_min()
        after_descent = jnp.where(first_step, 1.0, self.after_descent)
        damping = jnp.maximum(state * jnp.where(accept, after_descent, self.after_ascent), self.least)
        damping = damping.astype(state.dtype)
        return 1 / damping, accept, SUCCESSFUL, damping
