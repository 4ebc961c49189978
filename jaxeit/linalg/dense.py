"""Dense Cholesky factorisation, for a few hundred unknowns and as an oracle."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Integer

from .._compile import full_precision
from .base import AbstractLinearSolver, AbstractPlan, SparsityPattern, index_arrays, jacobi_scale, unit_columns
from .lapack import cho_solve, cholesky


class DensePlan(AbstractPlan):
    """The pattern on the device."""

    rows: Integer[Array, " nnz"]
    cols: Integer[Array, " nnz"]
    diagonal: Integer[Array, " n"]
    root: Integer[Array, " r"]
    n: int = eqx.field(static=True)


class DenseFactor(eqx.Module):
    """Lower L with D A D = L L^T, and the diagonal of D."""

    lower: Float[Array, "n n"]
    scale: Float[Array, " n"]
    plan: DensePlan


class Dense(AbstractLinearSolver):
    """Cholesky factorisation of the full matrix, zeros included: n^3 / 3 operations."""

    def analyse(self, pattern: SparsityPattern) -> DensePlan:
        return DensePlan(**index_arrays(pattern), n=pattern.n)

    @full_precision
    def factor(self, plan: DensePlan, values: Float[Array, " nnz"]) -> DenseFactor:
        scale, scaled = jacobi_scale(plan, values)
        matrix = jnp.zeros((plan.n, plan.n), values.dtype).at[plan.rows, plan.cols].set(scaled)
        return DenseFactor(cholesky(matrix, lower=True), scale, plan)

    @full_precision
    def solve(self, factor: DenseFactor, rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
        scale = factor.scale[:, None]
        return scale * cho_solve((factor.lower, True), scale * rhs)

    @full_precision
    def columns(self, factor: DenseFactor) -> Float[Array, "n r"]:
        return self.solve(factor, unit_columns(factor.plan, factor.lower.dtype))

    @full_precision
    def corner(self, plan: DensePlan, values: Float[Array, " nnz"]) -> Float[Array, "r r"]:
        return self.columns(self.factor(plan, values))[plan.root]
