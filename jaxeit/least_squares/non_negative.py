"""Quadratic least squares over hundreds of parameters that are nowhere negative: which parameters are above zero.

Once these are known, the solution is a linear one among them, and so are its derivatives. Two solvers of optimistix
find them: `DualNewton` in as few as five steps where the problem is well conditioned, and `InteriorPoint` in about
thirty steps whatever the condition.

`LevenbergMarquardt` with a `BoundedDescent` finds the same solution, to 1e-13 of the slope at zero, but moves the set
of positive parameters only little in a step. Its steps and CPU time for a frame of the testbed, stopped at once when
the conditions of the solution are met to 1e-13 or after 160 steps, and the CPU time of the solvers here:

| prior, hyperparameter | 400 pixels: steps, ms | here, ms | 900 pixels: steps, ms | here, ms |
|-----------------------|-----------------------|----------|-----------------------|----------|
| `Noser`, 0.1          | 26, 66                | 13       | 58, 1096              | 47       |
| `Noser`, 0.01         | 60, 131               | 71       | 126, 2318             | 483      |
| `Noser`, 1e-6         | 93, 215               | 122      | 160 (not met), 4040   | 567      |
| `Laplace`, 0.1        | 6, 19                 | 49       | 7, 184                | 447      |
| `Laplace`, 0.01       | 32, 76                | 50       | 79, 1663              | 463      |
| `Laplace`, 1e-6       | 93, 200               | 51       | 160 (not met), 3281   | 466      |
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ..linalg.lapack import cho_factor, cho_solve
from .adjoint import ImplicitStep
from .searches import SUCCESSFUL, Matrix, Parameters, Scalar

Data = Float[Array, " m"]
Flags = Bool[Array, " k"]
Ended = tuple[Bool[Array, ""], optx.RESULTS]

# Number of step lengths, 1, 1/2, 1/4 ..., that `DualNewton` compares. Problems on which it still does not end after its
# steps are badly conditioned and left to `InteriorPoint`.
HALVINGS = 12
# Factor of the duality gap that a step of `InteriorPoint` aims at, and the part of the way to the boundary that it goes
# at most (Nocedal and Wright 2006, section 16.6).
CENTERING, TO_BOUNDARY = 0.1, 0.99


class DiagonalProblem(eqx.Module):
    """``argmin over x >= 0 of |J x - y|^2 + x^T diag(weight) x``.

    | meaning                   | shape  |
    |---------------------------|--------|
    | jacobian J                | (m, k) |
    | weight, above zero        | (k,)   |
    | data y                    | (m,)   |
    """

    jacobian: Float[Array, "m k"]
    weight: Parameters
    data: Data

    def solution(self, positive: Flags) -> Parameters:
        """x where these parameters are free and the others zero, without what is negative."""
        x = jnp.maximum(self.jacobian.T @ self.residual(positive) / self.weight, 0)
        return x * positive.astype(x.dtype)  # NaN, of unsolvable data, stays

    def residual(self, positive: Flags) -> Data:
        """``y - J x`` where these parameters are free and the others zero, from a system as large as the data."""
        j = self.jacobian
        system = jnp.eye(len(j), dtype=j.dtype) + (j * (positive.astype(j.dtype) / self.weight)) @ j.T
        return cho_solve(cho_factor(system), self.data)

    def quick_residual(self, positive: Flags) -> Data:
        """`residual`, from a system of half that size where so few parameters are free."""
        size = min(len(positive), len(self.data) // 2)

        def of_few(problem: DiagonalProblem) -> Data:
            place = jnp.flatnonzero(positive, size=size, fill_value=0)
            free = jnp.arange(size) < jnp.sum(positive)
            part = jnp.where(free, problem.jacobian[:, place], 0)
            system = part.T @ part + jnp.diag(jnp.where(free, problem.weight[place], 1))
            return problem.data - part @ cho_solve(cho_factor(system), part.T @ problem.data)

        few = jnp.sum(positive) <= size
        residual: Array = jax.lax.cond(few, of_few, lambda problem: problem.residual(positive), self)
        return residual

    def dense(self) -> "DenseProblem":
        """The same problem with a matrix as large as the parameters."""
        known = self.jacobian, self.weight
        j, weight = jax.lax.optimization_barrier(known)  # XLA takes minutes to multiply constants
        return DenseProblem(j.T @ j + jnp.diag(weight), j.T @ self.data)

    def dual(self, a: Data) -> Scalar:
        """``|a|^2 / 2 - y a + sum (J^T a)_+^2 / (2 weight)``, least where ``a = y - J x`` at the solution."""
        return self.dual_of(a, self.jacobian.T @ a)

    def dual_of(self, a: Data, slope: Parameters) -> Scalar:
        """`dual`, given ``J^T a``."""
        return 0.5 * a @ a - a @ self.data + 0.5 * jnp.sum(jnp.maximum(slope, 0) ** 2 / self.weight)


class DenseProblem(eqx.Module):
    """``argmin over x >= 0 of x^T H x / 2 - b x``, with H the ``hessian``, (k, k), and b the ``linear`` term, (k,).

    H must be positive definite.
    """

    hessian: Matrix
    linear: Parameters

    def of_order_one(self) -> "DenseProblem":
        """The problem of a multiple of x, with H and b of order one."""
        curvature, top = jnp.mean(jnp.diagonal(self.hessian)), jnp.max(jnp.abs(self.linear))
        return DenseProblem(self.hessian / curvature, self.linear / jnp.where(top > 0, top, 1))

    def value(self, x: Parameters) -> Scalar:
        """What is minimised."""
        return 0.5 * x @ (self.hessian @ x) - self.linear @ x

    def solution(self, positive: Flags) -> Parameters:
        """x where these parameters are free and the others zero, without what is negative."""
        among = jnp.where(positive[:, None] & positive, self.hessian, jnp.diag((~positive).astype(self.linear.dtype)))
        return jnp.maximum(cho_solve(cho_factor(among), jnp.where(positive, self.linear, 0)), 0)


class DualState(NamedTuple):
    """Parameters above zero now and before the last step, and the length of that step."""

    positive: Flags
    before: Flags
    length: Scalar


class DualNewton(optx.AbstractMinimiser[Data, Any, DualState]):
    """Newton's method for `DiagonalProblem.dual`, in as many unknowns as there are data.

    The objective is a parabola while the set of positive parameters stays the same, so that the method ends exactly: a
    whole step to the same set is the last one. The ``args`` of `optimistix.minimise` are the problem. ``rtol``,
    ``atol`` and ``norm``, which optimistix expects of a minimiser, have no influence.

    Example:
        J = jax.random.normal(jax.random.key(0), (15, 24))
        problem = ls.DiagonalProblem(J, jnp.full(24, 0.1), jnp.ones(15))
        found = optx.minimise(lambda a, p: p.dual(a), ls.DualNewton(), jnp.zeros(15), problem, max_steps=40)
        image = problem.solution(found.state.positive)  # (24,), nowhere negative
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Any = optx.max_norm

    def init(self, fn: Any, y: Data, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> DualState:
        """All parameters are free."""
        every = jnp.ones(args.weight.shape, bool)
        return DualState(every, ~every, jnp.ones((), y.dtype))

    def step(
        self, fn: Any, y: Data, args: DiagonalProblem, options: Any, state: DualState, tags: Any
    ) -> tuple[Data, DualState, None]:
        """The best of 1, 1/2, 1/4 ... of a Newton step."""
        step = args.quick_residual(state.positive) - y
        slope, change = args.jacobian.T @ y, args.jacobian.T @ step
        lengths = 0.5 ** jnp.arange(HALVINGS, dtype=y.dtype)
        values = jax.vmap(lambda length: args.dual_of(y + length * step, slope + length * change))(lengths)
        length = lengths[jnp.argmin(values)]
        y = y + length * step
        return y, DualState(args.jacobian.T @ y > 0, state.positive, length), None

    def terminate(self, fn: Any, y: Data, args: Any, options: Any, state: DualState, tags: Any) -> Ended:
        """Whether a whole step has led to the same set."""
        moves = (state.length < 1) | jnp.any(state.positive != state.before)
        return ~moves, SUCCESSFUL

    def postprocess(
        self, fn: Any, y: Data, aux: Any, args: Any, options: Any, state: DualState, tags: Any, result: Any
    ) -> tuple[Data, Any, dict[str, Any]]:
        """As it is."""
        return y, aux, {}


class InteriorPoint(optx.AbstractMinimiser[Parameters, Any, Parameters]):
    """Primal-dual interior-point method for a `DenseProblem` (Nocedal and Wright 2006, section 16.6).

    Solves ``H x - b = z``, ``x z = 0`` with x, z > 0. Each step divides the duality gap, the mean of x z, by about ten
    whatever the condition of H. Ends where the gap is ``atol``, for a problem of order one, which is the ``args`` of
    `optimistix.minimise`. The state is the multiplier z. ``rtol`` and ``norm``, which optimistix expects of a
    minimiser, have no influence.

    Example:
        dense = problem.dense().of_order_one()
        found = optx.minimise(
            lambda x, p: p.value(x), ls.InteriorPoint(0.0, 1e-12), jnp.ones(24), dense, max_steps=40
        )
    """

    rtol: float
    atol: float
    norm: Any = optx.max_norm

    def init(self, fn: Any, y: Parameters, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> Array:
        """Multipliers of one."""
        return jnp.ones_like(y)

    def step(
        self, fn: Any, y: Parameters, args: DenseProblem, options: Any, state: Parameters, tags: Any
    ) -> tuple[Parameters, Parameters, None]:
        """A Newton step towards a tenth of the gap, as far as x and z stay above zero."""
        x, z = y, state
        target = CENTERING * jnp.mean(x * z)
        # The step of z is eliminated: z + dz = (target - z dx) / x.
        right = args.linear - args.hessian @ x + target / x
        dx = cho_solve(cho_factor(args.hessian + jnp.diag(z / x)), right)
        dz = (target - z * dx) / x - z
        return x + _fraction_inside(x, dx) * dx, z + _fraction_inside(z, dz) * dz, None

    def terminate(self, fn: Any, y: Parameters, args: Any, options: Any, state: Parameters, tags: Any) -> Ended:
        """Whether the gap is small enough."""
        return jnp.mean(y * state) <= self.atol, SUCCESSFUL

    def postprocess(
        self, fn: Any, y: Parameters, aux: Any, args: Any, options: Any, state: Parameters, tags: Any, result: Any
    ) -> tuple[Parameters, Any, dict[str, Any]]:
        """As it is."""
        return y, aux, {}


def _fraction_inside(value: Parameters, change: Parameters) -> Scalar:
    """The part of a change, one at most, that keeps every value above zero."""
    falling = change < 0
    return jnp.minimum(jnp.min(jnp.where(falling, -TO_BOUNDARY * value / jnp.where(falling, change, 1), 1)), 1)


def positive_by_interior_point(problem: DenseProblem, steps: int) -> Flags:
    """Parameters above zero in the solution; in at most so many steps of `InteriorPoint`."""
    scaled = problem.of_order_one()
    least = float(jnp.finfo(problem.linear.dtype).eps) ** 2  # of a solution of order one, so that x or z is rounding
    found: optx.Solution[Array, Any] = optx.minimise(
        lambda x, problem: problem.value(x),
        InteriorPoint(rtol=0.0, atol=least / CENTERING),
        jnp.ones_like(problem.linear),
        scaled,
        max_steps=steps,
        adjoint=ImplicitStep(),
        throw=False,
    )
    positive: Array = found.value > found.state
    return positive


def positive_by_newton(problem: DiagonalProblem, steps: int) -> Flags:
    """Parameters above zero in the solution; in at most so many steps of `DualNewton`, then of `InteriorPoint`."""
    found: optx.Solution[Array, Any] = optx.minimise(
        lambda a, problem: problem.dual(a),
        DualNewton(),
        jnp.zeros_like(problem.data),
        problem,
        max_steps=steps,
        adjoint=ImplicitStep(),
        throw=False,
    )
    positive: Array = jax.lax.cond(
        found.result == optx.RESULTS.successful,
        lambda problem: found.state.positive,
        lambda problem: positive_by_interior_point(problem.dense(), steps),
        problem,
    )
    return positive
