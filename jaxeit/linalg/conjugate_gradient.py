"""Preconditioned conjugate gradients: without a factor, or as refinement of an inexact factor.

With the diagonal as preconditioner the memory is that of the matrix, for meshes whose factor is too
large.  With a factorisation in single precision (`Single`) as preconditioner the method is iterative
refinement that cannot diverge: double accuracy from single-precision factors.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

from .._compile import full_precision
from ..registry import limited
from .base import AbstractLinearSolver, AbstractPlan, SparsityPattern, index_arrays, jacobi_scale, matvec, unit_columns

# Step, solution, residual, direction, and energy of the residual.
State = tuple[int | Array, Array, Array, Array, Array]


class ConjugateGradientPlan(AbstractPlan):
    """The pattern on the device, and the preconditioner's plan."""

    rows: Integer[Array, " nnz"]
    cols: Integer[Array, " nnz"]
    diagonal: Integer[Array, " n"]
    root: Integer[Array, " r"]
    inner: AbstractPlan | None
    n: int = eqx.field(static=True)


class ConjugateGradientFactor(eqx.Module):
    """The scaled matrix D A D, the diagonal of D, and the preconditioner's factor."""

    values: Float[Array, " nnz"]
    scale: Float[Array, " n"]
    inner: Any
    plan: ConjugateGradientPlan


class ConjugateGradient(AbstractLinearSolver):
    """Conjugate gradients on all right-hand sides at once (Hestenes and Stiefel 1952).

    | meaning                                                              | default     |
    |----------------------------------------------------------------------|-------------|
    | preconditioner: a linear solver, or None for the diagonal            | None        |
    | tolerance: of the residual relative to the load, after scaling; not  | 1e-12       |
    |   taken below 8 roundings of the precision                           |             |
    | max_steps: number of steps after which the result is NaN             | 5000        |
    """

    preconditioner: AbstractLinearSolver | None = None
    tolerance: float = limited(1e-12, above=0, most=1, static=True)
    max_steps: int = limited(5000, least=1, static=True)

    def analyse(self, pattern: SparsityPattern) -> ConjugateGradientPlan:
        inner = None if self.preconditioner is None else self.preconditioner.analyse(pattern)
        return ConjugateGradientPlan(**index_arrays(pattern), inner=inner, n=pattern.n)

    @full_precision
    def factor(self, plan: ConjugateGradientPlan, values: Float[Array, " nnz"]) -> ConjugateGradientFactor:
        scale, scaled = jacobi_scale(plan, values)
        inner = None if self.preconditioner is None else self.preconditioner.factor(plan.inner, scaled)
        return ConjugateGradientFactor(scaled, scale, inner, plan)

    @full_precision
    def solve(self, factor: ConjugateGradientFactor, rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
        scale = factor.scale[:, None]
        return scale * self._iterate(factor, scale * rhs)

    @full_precision
    def columns(self, factor: ConjugateGradientFactor) -> Float[Array, "n r"]:
        return self.solve(factor, unit_columns(factor.plan, factor.values.dtype))

    @full_precision
    def corner(self, plan: ConjugateGradientPlan, values: Float[Array, " nnz"]) -> Float[Array, "r r"]:
        return self.columns(self.factor(plan, values))[plan.root]

    def _iterate(self, factor: ConjugateGradientFactor, b: Float[Array, "n k"]) -> Float[Array, "n k"]:
        goal = max(self.tolerance, 8 * float(jnp.finfo(b.dtype).eps)) * jnp.linalg.norm(b, axis=0)

        def unfinished(state: State) -> Array:
            step, _, r, _, _ = state
            return (step < self.max_steps) & jnp.any(jnp.linalg.norm(r, axis=0) > goal)

        def advance(state: State) -> State:
            step, x, r, p, energy = state
            moved = matvec(factor.plan, factor.values, p)
            # A column that has converged exactly has a zero direction; `_ratio` makes its step zero, not 0 / 0.
            x, r = (v + s * _ratio(energy, jnp.sum(p * moved, 0)) for v, s in ((x, p), (r, -moved)))
            z = self._precondition(factor, r)
            new = jnp.sum(r * z, 0)
            return step + 1, x, r, z + _ratio(new, energy) * p, new

        z = self._precondition(factor, b)
        start: State = (0, jnp.zeros_like(b), b, z, jnp.sum(b * z, 0))
        _, x, r, _, _ = jax.lax.while_loop(unfinished, advance, start)
        return jnp.where(jnp.linalg.norm(r, axis=0) <= goal, x, jnp.nan)

    def _precondition(self, factor: ConjugateGradientFactor, r: Float[Array, "n k"]) -> Float[Array, "n k"]:
        return r if self.preconditioner is None else self.preconditioner.solve(factor.inner, r)


def _ratio(above: Float[Array, " k"], below: Float[Array, " k"]) -> Float[Array, " k"]:
    return jnp.where(below == 0, 0, above / jnp.where(below == 0, 1, below))


class Single(AbstractLinearSolver):
    """Another solver in single precision, for values of any precision; its solutions have single accuracy."""

    solver: AbstractLinearSolver

    def analyse(self, pattern: SparsityPattern) -> AbstractPlan:
        return self.solver.analyse(pattern)

    @full_precision
    def factor(self, plan: AbstractPlan, values: Float[Array, " nnz"]) -> Any:
        return self.solver.factor(plan, values.astype(jnp.float32))

    @full_precision
    def solve(self, factor: Any, rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
        return self.solver.solve(factor, rhs.astype(jnp.float32)).astype(rhs.dtype)

    @full_precision
    def columns(self, factor: Any) -> Float[Array, "n r"]:
        return self.solver.columns(factor)

    @full_precision
    def corner(self, plan: AbstractPlan, values: Float[Array, " nnz"]) -> Float[Array, "r r"]:
        return self.solver.corner(plan, values.astype(jnp.float32)).astype(values.dtype)
