"""Sparse Cholesky in pure JAX: multifrontal, one batch for each level of a nested dissection.

The host finds a tree of separators (George 1973, `_dissection`) and where every number of the
multifrontal method (Duff and Reid 1983) goes (`_fronts`).  On the device all fronts of one level
are one batch.  With a front F over pivots 1 and boundary 2,

    F11 = L L^T,    W = F21 L^-T,    update of the parent: F22 - W W^T,

a level keeps the panel M = [L^-1; -W L^-1], so that a sweep of a solve is one product per level:

    forward  [y; update] = M r1,    backward  x1 = M^T [y; x2].
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import prod
from typing import Any

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

    | meaning                                                             | shape      |
    |---------------------------------------------------------------------|------------|
    | slots: where entries, then padding ones, stand in the panels, flat  | (nnz+pad,) |
    | gather: unknown at each pivot place of all levels, n where padded   | (places,)  |
    | scatter: pivot place of each unknown                                | (n,)       |
    """

    rows: Int[Array, " nnz"]
    cols: Int[Array, " nnz"]
    diagonal: Int[Array, " n"]
    slots: Int[Array, " slots"]
    gather: Int[Array, " places"]
    scatter: Int[Array, " n"]
    levels: tuple[LevelPlan, ...]
    n: int = eqx.field(static=True)

    @property
    def panel_shapes(self) -> list[tuple[int, int, int]]:
        return [level.panel_shape for level in self.levels]


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

    def factor(self, plan: NestedDissectionPlan, values: Float[Array, " nnz"]) -> NestedDissectionFactor:
        scale, scaled = jacobi_scale(plan, values)
        panels: list[Float[Array, "m q p"]] = []
        update = jnp.zeros((0, 1, 1), values.dtype)
        for level, entries in _upwards(plan.levels, _assemble(plan, scaled)):
            extended = _extended(level, update)
            panel, lost = _eliminate(entries + extended[:, :, : level.pivots])
            update = extended[:, level.pivots :, level.pivots :] - lost
            panels.append(panel)
        return NestedDissectionFactor(tuple(panels[::-1]), scale, plan)

    def solve(self, factor: NestedDissectionFactor, rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
        plan, scale = factor.plan, factor.scale[:, None]
        padded = jnp.concatenate([scale * rhs, jnp.zeros_like(rhs, shape=(1, rhs.shape[1]))])
        loads = _split(padded[plan.gather], [(m, p) for m, _, p in plan.panel_shapes])
        x = _backward(factor, _forward(factor, loads))
        return scale * x[plan.scatter]


def _index(array: np.ndarray) -> Int[Array, "..."]:
    return jnp.asarray(array, jnp.int32)


def _level_plan(level: Level) -> LevelPlan:
    return LevelPlan(_index(level.up), _index(level.down), level.pivots.shape[1])


def _level_starts(depth: int, merge: int) -> tuple[int, ...]:
    """Depths at which levels begin: the leaves by themselves, the rest merged from below."""
    return tuple(sorted({0, *range(depth, 0, -merge)}))


def _assemble(plan: NestedDissectionPlan, values: Float[Array, " nnz"]) -> list[Float[Array, "m q p"]]:
    """The columns of the pivots in every front, from the matrix alone."""
    shapes = plan.panel_shapes
    ones = jnp.ones(plan.slots.size - values.size, values.dtype)
    flat = jnp.zeros(sum(map(prod, shapes)), values.dtype)
    flat = flat.at[plan.slots].set(jnp.concatenate([values, ones]), unique_indices=True, mode="promise_in_bounds")
    return _split(flat, shapes)


def _split(rows: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Cut the leading axis into pieces, and fold each into its shape."""
    ends = np.cumsum([0, *map(prod, shapes)])
    pieces = [rows[begin:end] for begin, end in pairwise(ends)]
    return [piece.reshape(*shape, *rows.shape[1:]) for piece, shape in zip(pieces, shapes, strict=True)]


def _extended(level: LevelPlan, updates: Float[Array, "mc bc bc"]) -> Float[Array, "m q q"]:
    """Sum of the children's updates, each at its places in the front; zero for leaves."""
    by_child = _by_child(level, updates)
    spread = (_spread(by_child[:, c], level.down[:, c]) for c in range(by_child.shape[1]))
    fronts, _, size = level.down.shape
    return sum(spread, jnp.zeros((fronts, size, size), updates.dtype))


def _by_child(level: LevelPlan, children: Array) -> Array:
    return children.reshape(*level.down.shape[:2], *children.shape[1:])


def _spread(update: Float[Array, "m b b"], places: Int[Array, "m q"]) -> Float[Array, "m q q"]:
    front = jnp.arange(update.shape[0])[:, None, None]
    spread = update.at[front, places[:, :, None], places[:, None, :]]
    return spread.get(mode="promise_in_bounds")


def _eliminate(
    panel: Float[Array, "m q p"],
) -> tuple[Float[Array, "m q p"], Float[Array, "m b b"]]:
    """M of every front, and W W^T, which its F22 loses."""
    p = panel.shape[2]
    lower = lax.linalg.cholesky(panel[:, :p], symmetrize_input=False)
    eye = jnp.broadcast_to(jnp.eye(p, dtype=panel.dtype), lower.shape)
    inverse = lax.linalg.triangular_solve(lower, eye, left_side=True, lower=True)
    w = jnp.einsum("mbp,mkp->mbk", panel[:, p:], inverse)
    below = -jnp.einsum("mbk,mkp->mbp", w, inverse)
    return jnp.concatenate([inverse, below], 1), jnp.einsum("mip,mjp->mij", w, w)


def _forward(factor: NestedDissectionFactor, loads: list[Float[Array, "m p k"]]) -> list[Float[Array, "m p k"]]:
    """y = L^-1 r from the leaves up; every front hands what its boundary gained to its parent."""
    ys: list[Float[Array, "m p k"]] = []
    handed = jnp.zeros_like(loads[0], shape=(0, 1, loads[0].shape[2]))
    for level, panel, load in _upwards(factor.plan.levels, factor.panels, loads):
        gained, p = _gained(level, handed), level.pivots
        out = jnp.einsum("mqp,mpk->mqk", panel, load + gained[:, :p])
        handed = out[:, p:] + gained[:, p:]
        ys.append(out[:, :p])
    return ys[::-1]


def _gained(level: LevelPlan, handed: Float[Array, "mc bc k"]) -> Float[Array, "m q k"]:
    by_child = _by_child(level, handed)
    places = level.down[..., None]
    return jnp.take_along_axis(by_child, places, 2, mode="promise_in_bounds").sum(1)


def _backward(factor: NestedDissectionFactor, ys: list[Float[Array, "m p k"]]) -> Float[Array, "places k"]:
    """x = L^-T y from the root down; every front finds its boundary's x in its parent's front."""
    front = jnp.zeros_like(ys[0], shape=(1, 1, ys[0].shape[2]))
    xs = []
    for level, panel, y in zip(factor.plan.levels, factor.panels, ys, strict=True):
        outer = _inherited(level, front)
        x = jnp.einsum("mqp,mqk->mpk", panel, jnp.concatenate([y, outer], 1))
        front = jnp.concatenate([x, outer], 1)
        xs.append(x.reshape(-1, x.shape[2]))
    return jnp.concatenate(xs)


def _inherited(level: LevelPlan, front: Float[Array, "mp qp k"]) -> Float[Array, "m b k"]:
    by_parent = level.up.reshape(front.shape[0], -1, 1)
    outer = jnp.take_along_axis(front, by_parent, 1, mode="promise_in_bounds")
    return outer.reshape(*level.up.shape, -1)


def _upwards(*columns: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
    """The levels from the leaves up."""
    return zip(*(column[::-1] for column in columns), strict=True)
