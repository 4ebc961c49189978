"""Sparse Cholesky in pure JAX: multifrontal, one batch for each level of a nested dissection.

The host finds a tree of separators (George 1973, `_dissection`) and where every number of the
multifrontal method (Duff and Reid 1983) goes (`_fronts`).  On the device all fronts of one level
are one batch.  With a front F over pivots 1 and boundary 2,

    F11 = L L^T,    W = F21 L^-T,    update of the parent: F22 - W W^T,

a level keeps the panel M = [L^-1; -W L^-1], so that a sweep of a solve is one product per level:

    forward  [y; update] = M r1,    backward  x1 = M^T [y; x2].
"""

from collections.abc import Sequence
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ._base import AbstractLinearSolver, AbstractPlan, Pattern, index_arrays, jacobi_scale
from ._dissection import dissect
from ._fronts import Level, lay_out


class LevelPlan(eqx.Module):
    """One level of m fronts with p pivots and b boundary places; see `_fronts.Level`."""

    up: Int[Array, "m b"]
    down: Int[Array, "m c q"]
    pivots: int = eqx.field(static=True)

    @property
    def panel_shape(self) -> tuple[int, int, int]:
        return self.down.shape[0], self.down.shape[2], self.pivots


class NestedDissectionPlan(AbstractPlan):
    """The pattern, the levels from the root down, and the permutations in and out of them.

    | meaning                                                             | shape    |
    |---------------------------------------------------------------------|----------|
    | slots: where entries, then padding ones, stand in the panels, flat  | (nnz+pad,) |
    | gather: unknown at each pivot place of all levels, n where padded   | (places,) |
    | scatter: pivot place of each unknown                                | (n,)     |
    """

    rows: Int[Array, " nnz"]
    cols: Int[Array, " nnz"]
    diagonal: Int[Array, " n"]
    slots: Int[Array, " slots"]
    gather: Int[Array, " places"]
    scatter: Int[Array, " n"]
    levels: tuple[LevelPlan, ...]
    n: int = eqx.field(static=True)


class NestedDissectionFactor(eqx.Module):
    """Panels M of the levels from the root down, the scaling D, and the plan."""

    panels: tuple[Float[Array, "m q p"], ...]
    scale: Float[Array, " n"]
    plan: NestedDissectionPlan


class NestedDissection(AbstractLinearSolver):
    """Multifrontal Cholesky on a nested dissection.

    A leaf has at most about ``leaf_size`` unknowns; ``merge`` depths of the binary tree are
    eliminated together.
    """

    leaf_size: int = eqx.field(static=True, default=32)
    merge: int = eqx.field(static=True, default=1)

    def analyse(self, pattern: Pattern) -> NestedDissectionPlan:
        owner, depth = dissect(pattern, self.leaf_size)
        fronts = lay_out(pattern, owner, _level_starts(depth, self.merge))
        gather = np.concatenate([level.pivots.ravel() for level in fronts.levels])
        filled = np.flatnonzero(gather < pattern.n)
        scatter = np.empty(pattern.n, np.int64)
        scatter[gather[filled]] = filled
        return NestedDissectionPlan(
            **index_arrays(pattern),
            slots=_index(np.concatenate([fronts.slots, fronts.ones])),
            gather=_index(gather),
            scatter=_index(scatter),
            levels=tuple(_level_plan(level) for level in fronts.levels),
            n=pattern.n,
        )

    def factor(
        self, plan: NestedDissectionPlan, values: Float[Array, " nnz"]
    ) -> NestedDissectionFactor:
        scale, scaled = jacobi_scale(plan, values)
        panels, updates = [], None
        for level, panel in zip(plan.levels[::-1], _assemble(plan, scaled)[::-1], strict=True):
            panel, updates = _eliminate(panel, _extend(level, updates))
            panels.append(panel)
        return NestedDissectionFactor(tuple(panels[::-1]), scale, plan)

    def solve(
        self, factor: NestedDissectionFactor, rhs: Float[Array, "n k"]
    ) -> Float[Array, "n k"]:
        plan, scale = factor.plan, factor.scale[:, None]
        padded = jnp.concatenate([scale * rhs, jnp.zeros_like(rhs, shape=(1, rhs.shape[1]))])
        loads = _split(padded[plan.gather], [level.panel_shape for level in plan.levels])
        x = _backward(factor, _forward(factor, loads))
        return scale * x[plan.scatter]


def _index(array: np.ndarray) -> Int[Array, "..."]:
    return jnp.asarray(array, jnp.int32)


def _level_plan(level: Level) -> LevelPlan:
    return LevelPlan(_index(level.up), _index(level.down), level.pivots.shape[1])


def _level_starts(depth: int, merge: int) -> tuple[int, ...]:
    """Depths at which levels begin: the leaves by themselves, the rest merged from below."""
    return tuple(sorted({0, *range(depth, 0, -merge)}))


def _assemble(
    plan: NestedDissectionPlan, values: Float[Array, " nnz"]
) -> list[Float[Array, "m q p"]]:
    """The columns of the pivots in every front, from the matrix alone."""
    shapes = [level.panel_shape for level in plan.levels]
    sizes = [int(np.prod(shape)) for shape in shapes]
    ones = jnp.ones(plan.slots.size - values.size, values.dtype)
    flat = jnp.zeros(sum(sizes), values.dtype)
    flat = flat.at[plan.slots].set(jnp.concatenate([values, ones]), unique_indices=True)
    ends = np.cumsum([0, *sizes])
    return [
        flat[begin:end].reshape(shape)
        for (begin, end), shape in zip(pairwise(ends), shapes, strict=True)
    ]


def _extend(level: LevelPlan, updates: Float[Array, "mc b b"] | None) -> Float[Array, "m q q"]:
    """Sum of the children's updates, each put at its places in the parent's front."""
    fronts, children, size = level.down.shape
    if updates is None:
        return jnp.zeros(())
    by_child = updates.reshape(fronts, children, *updates.shape[1:])
    spread = [_spread(by_child[:, c], level.down[:, c]) for c in range(children)]
    return sum(spread[1:], spread[0])


def _spread(update: Float[Array, "m b b"], places: Int[Array, "m q"]) -> Float[Array, "m q q"]:
    front = jnp.arange(update.shape[0])[:, None, None]
    return update[front, places[:, :, None], places[:, None, :]]


def _eliminate(
    panel: Float[Array, "m q p"], extended: Float[Array, "m q q"]
) -> tuple[Float[Array, "m q p"], Float[Array, "m b b"]]:
    p = panel.shape[2]
    if extended.ndim:
        panel = panel + extended[:, :, :p]
    lower = lax.linalg.cholesky(panel[:, :p], symmetrize_input=False)
    eye = jnp.broadcast_to(jnp.eye(p, dtype=panel.dtype), lower.shape)
    inverse = lax.linalg.triangular_solve(lower, eye, left_side=True, lower=True)
    w = jnp.einsum("mbp,mkp->mbk", panel[:, p:], inverse)
    update = -jnp.einsum("mip,mjp->mij", w, w)
    if extended.ndim:
        update = update + extended[:, p:, p:]
    return jnp.concatenate([inverse, -jnp.einsum("mbk,mkp->mbp", w, inverse)], 1), update


def _split(
    rows: Float[Array, "places k"], shapes: Sequence[tuple[int, int, int]]
) -> list[Float[Array, "m p k"]]:
    ends = np.cumsum([0, *(m * p for m, _, p in shapes)])
    return [
        rows[begin:end].reshape(m, p, rows.shape[1])
        for (begin, end), (m, _, p) in zip(pairwise(ends), shapes, strict=True)
    ]


def _forward(factor, loads):
    carried, ys = None, []
    for level, panel, load in zip(
        factor.plan.levels[::-1], factor.panels[::-1], loads[::-1], strict=True
    ):
        p = level.pivots
        if carried is None:
            out = jnp.einsum("mqp,mpk->mqk", panel, load)
            y, carried = out[:, :p], out[:, p:]
        else:
            m, c, q = level.down.shape
            by_child = carried.reshape(m, c, *carried.shape[1:])
            summed = jnp.take_along_axis(by_child, level.down[..., None], axis=2).sum(1)
            out = jnp.einsum("mqp,mpk->mqk", panel, load + summed[:, :p])
            y, carried = out[:, :p], out[:, p:] + summed[:, p:]
        ys.append(y)
    return ys[::-1]


def _backward(factor, ys):
    front, xs = None, []
    for level, panel, y in zip(factor.plan.levels, factor.panels, ys, strict=True):
        m, b = level.up.shape
        if front is None:
            x2 = jnp.zeros((m, b, y.shape[2]), y.dtype)
        else:
            c = m // front.shape[0]
            x2 = jnp.take_along_axis(front, level.up.reshape(-1, c * b, 1), axis=1)
            x2 = x2.reshape(m, b, -1)
        x1 = jnp.einsum("mqp,mqk->mpk", panel, jnp.concatenate([y, x2], 1))
        front = jnp.concatenate([x1, x2], 1)
        xs.append(x1.reshape(-1, x1.shape[2]))
    return jnp.concatenate(xs)
