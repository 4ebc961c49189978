"""Sparse Cholesky in pure JAX: multifrontal, one batch for each level of a nested dissection.

The host finds a tree of separators (George 1973, `_dissection`) and where every number of the
multifrontal method (Duff and Reid 1983) goes (`_fronts`).  On the device all fronts of one level
are one batch.  With a front F over pivots 1 and boundary 2,

    F11 = L L^T,    W = F21 L^-T,    update of the parent: F22 - W W^T,

a level keeps L^-1 and H = -W L^-1, so that a sweep of a solve is two products per level:

    forward  y = L^-1 r1, update = H r1,    backward  x1 = L^-T y + H^T x2.

`corner`, the inverse on the unknowns of the root, needs neither sweep: the last front holds it.
"""

from collections.abc import Sequence
from itertools import pairwise
from math import prod
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ._base import AbstractLinearSolver, AbstractPlan, Pattern, index_arrays, jacobi_scale
from ._dissection import dissect
from ._fronts import Level, lay_out

# Pivots eliminated at once.  Beyond it LAPACK's own threads and XLA's get in each other's way (a
# hundredfold on a busy machine); halving moves the work into matrix products, which XLA spreads.
_WIDEST = 72


class LevelPlan(eqx.Module):
    """One level of m fronts with p pivots and b boundary places; see `_fronts.Level`.

    The entries (number, front, row, column) are those among the pivots, and those below.
    """

    up: Int[Array, "m b"]
    down: Int[Array, "m c q"]
    among: Int[Array, "4 k"]
    below: Int[Array, "4 l"]

    @property
    def pivots(self) -> int:
        return self.down.shape[2] - self.up.shape[1]


class NestedDissectionPlan(AbstractPlan):
    """The pattern, the levels from the root down, and the permutations in and out of them.

    | meaning                                                             | shape      |
    |---------------------------------------------------------------------|------------|
    | gather: unknown at each pivot place of all levels, n where padded   | (places,)  |
    | scatter: pivot place of each unknown                                | (n,)       |
    """

    rows: Int[Array, " nnz"]
    cols: Int[Array, " nnz"]
    diagonal: Int[Array, " n"]
    root: Int[Array, " r"]
    gather: Int[Array, " places"]
    scatter: Int[Array, " n"]
    levels: tuple[LevelPlan, ...]
    n: int = eqx.field(static=True)

    @property
    def panel_shapes(self) -> list[tuple[int, int, int]]:
        """Fronts, places of a front, and pivots, of each level."""
        return [(level.down.shape[0], level.down.shape[2], level.pivots) for level in self.levels]


class Front(NamedTuple):
    """What a level keeps: L^-1 and H."""

    inverse: Float[Array, "m p p"]
    below: Float[Array, "m b p"]


class NestedDissectionFactor(eqx.Module):
    """The levels from the root down, the scaling D, and the plan."""

    levels: tuple[Front, ...]
    scale: Float[Array, " n"]
    plan: NestedDissectionPlan


class NestedDissection(AbstractLinearSolver):
    """Multifrontal Cholesky on a nested dissection whose leaves have at most about ``leaf_size`` unknowns."""

    leaf_size: int = eqx.field(static=True, default=32)

    def analyse(self, pattern: Pattern) -> NestedDissectionPlan:
        owner, depth = dissect(pattern, self.leaf_size)
        levels = lay_out(pattern, owner, depth)
        gather = np.concatenate([level.pivots.ravel() for level in levels])
        filled = np.flatnonzero(gather < pattern.n)
        scatter = np.empty(pattern.n, np.int64)
        scatter[gather[filled]] = filled
        return NestedDissectionPlan(
            **index_arrays(pattern),
            gather=_index(gather),
            scatter=_index(scatter),
            levels=tuple(_level_plan(level) for level in levels),
            n=pattern.n,
        )

    def factor(self, plan: NestedDissectionPlan, values: Float[Array, " nnz"]) -> NestedDissectionFactor:
        scale, scaled = jacobi_scale(plan, values)
        return NestedDissectionFactor(_eliminated(plan, scaled, keep=True), scale, plan)

    def solve(self, factor: NestedDissectionFactor, rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
        plan, scale = factor.plan, factor.scale[:, None]
        padded = jnp.concatenate([scale * rhs, jnp.zeros_like(rhs, shape=(1, rhs.shape[1]))])
        loads = _split(padded[plan.gather], [(m, p) for m, _, p in plan.panel_shapes])
        x = _backward(factor, _forward(factor, loads))
        return scale * x[plan.scatter]

    def columns(self, factor: NestedDissectionFactor) -> Float[Array, "n r"]:
        plan, scale = factor.plan, factor.scale[:, None]
        y = _root_loads(plan, factor.levels[0]) * scale[plan.root].T
        x = _backward(factor, [y, *[None] * (len(plan.levels) - 1)])
        return scale * x[plan.scatter]

    def corner(self, plan: NestedDissectionPlan, values: Float[Array, " nnz"]) -> Float[Array, "r r"]:
        scale, scaled = jacobi_scale(plan, values)
        y = _root_loads(plan, _eliminated(plan, scaled, keep=False)[0])[0] * scale[plan.root]
        return y.T @ y


def _index(array: np.ndarray) -> Int[Array, "..."]:
    return jnp.asarray(array, jnp.int32)


def _level_plan(level: Level) -> LevelPlan:
    pivots = level.pivots.shape[1]
    among, below = (level.entries[:, mine] for mine in (level.entries[2] < pivots, level.entries[2] >= pivots))
    below = below - [[0], [0], [pivots], [0]]
    return LevelPlan(_index(level.up), _index(level.down), _index(among), _index(below))


def _eliminated(plan: NestedDissectionPlan, values: Float[Array, " nnz"], keep: bool) -> tuple[Front, ...]:
    """What is kept of the fronts, from the root down; of the root only, unless ``keep``."""
    padded = jnp.concatenate([values, jnp.ones_like(values, shape=1)])
    update = jnp.zeros((0, 1, 1), values.dtype)
    fronts: list[Front] = []
    for level in reversed(plan.levels):
        pivots, boundary = slice(0, level.pivots), slice(level.pivots, None)
        among = _with_entries(_extended(level, update, pivots, pivots), level.among, padded)
        below = _with_entries(_extended(level, update, boundary, pivots), level.below, padded)
        w, front = _eliminate(among, below, keep or level is plan.levels[0])
        if front is not None:
            fronts.append(front)
        update = _extended(level, update, boundary, boundary) - _square(w, w)
    return tuple(fronts[::-1])


def _square(left: Float[Array, "m k i"], right: Float[Array, "m k j"]) -> Float[Array, "m i j"]:
    return jnp.einsum("mki,mkj->mij", left, right)


def _with_entries(block: Float[Array, "m i j"], entries: Int[Array, "4 k"], values: Array) -> Float[Array, "m i j"]:
    number, *place = entries
    entering = values.at[number].get(mode="promise_in_bounds")
    return block.at[tuple(place)].add(entering, unique_indices=True, indices_are_sorted=True, mode="promise_in_bounds")


def _extended(level: LevelPlan, updates: Float[Array, "mc b b"], rows: slice, columns: slice) -> Float[Array, "m i j"]:
    """Sum of the children's updates, each at its places, in these rows and columns of the fronts."""
    places, size = level.down, updates.shape[1]
    fronts, children, _ = places.shape
    updates = updates.reshape(fronts, children, size, size)
    front = jnp.arange(fronts, dtype=jnp.int32)[:, None, None]
    shape = fronts, *(len(range(places.shape[2])[part]) for part in (rows, columns))
    spread = (
        updates[:, c].at[front, places[:, c, rows, None], places[:, c, None, columns]].get(mode="promise_in_bounds")
        for c in range(children)
    )
    return sum(spread, jnp.zeros(shape, updates.dtype))


def _along(array: Array, places: Int[Array, "..."], axis: int) -> Array:
    return jnp.take_along_axis(array, places, axis, mode="promise_in_bounds")


def _eliminate(
    among: Float[Array, "m p p"], below: Float[Array, "m b p"], keep: bool
) -> tuple[Float[Array, "m p b"], Front | None]:
    """W^T of every front, and what is kept; wide fronts in two halves."""
    p = among.shape[2]
    if p <= _WIDEST:
        return _eliminate_at_once(among, below, keep)
    h = (p + 1) // 2
    w1, first = _eliminate(among[:, :h, :h], jnp.concatenate([among[:, h:, :h], below[:, :, :h]], 1), keep)
    across, beyond = w1[:, :, : p - h], w1[:, :, p - h :]
    w2, second = _eliminate(among[:, h:, h:] - _square(across, across), below[:, :, h:] - _square(beyond, across), keep)
    w = jnp.concatenate([beyond, w2], 1)
    return w, None if first is None or second is None else _joined(first, second)


def _joined(first: Front, second: Front) -> Front:
    """Both halves of a front's pivots as one."""
    (m, h, _), size = first.inverse.shape, second.inverse.shape[1]
    between, beyond = first.below[:, :size], first.below[:, size:]
    corner = jnp.zeros_like(between, shape=(m, h, size))
    inverse = _stacked([[first.inverse, corner], [second.inverse @ between, second.inverse]])
    return Front(inverse, _stacked([[beyond + second.below @ between, second.below]]))


def _eliminate_at_once(
    among: Float[Array, "m p p"], below: Float[Array, "m b p"], keep: bool
) -> tuple[Float[Array, "m p b"], Front | None]:
    """L^-1 of F12, and of the unit matrix if kept, in one call: two batched triangular solves that run at
    once wait for each other for ever (jaxlib 0.10.2 on two cores)."""
    p = among.shape[2]
    lower = lax.linalg.cholesky(among, symmetrize_input=False)
    right = jnp.swapaxes(below, 1, 2)
    if not keep:
        return lax.linalg.triangular_solve(lower, right, left_side=True, lower=True), None
    eye = jnp.broadcast_to(jnp.eye(p, dtype=among.dtype), lower.shape)
    both = lax.linalg.triangular_solve(lower, jnp.concatenate([eye, right], 2), left_side=True, lower=True)
    inverse, w = both[:, :, :p], both[:, :, p:]
    return w, Front(inverse, -_square(w, inverse))


def _stacked(blocks: list[list[Array]]) -> Array:
    return jnp.concatenate([jnp.concatenate(row, 2) for row in blocks], 1)


def _split(rows: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Cut the leading axis into pieces, and fold each into its shape."""
    ends = np.cumsum([0, *map(prod, shapes)])
    pieces = [rows[begin:end] for begin, end in pairwise(ends)]
    return [piece.reshape(*shape, *rows.shape[1:]) for piece, shape in zip(pieces, shapes, strict=True)]


def _root_loads(plan: NestedDissectionPlan, front: Front) -> Float[Array, "1 p r"]:
    """L^-1 of the unit loads on the unknowns of the root."""
    return front.inverse[:, :, plan.scatter[plan.root]]


def _forward(factor: NestedDissectionFactor, loads: list[Float[Array, "m p k"]]) -> list[Float[Array, "m p k"]]:
    """y = L^-1 r from the leaves up; every front hands what its boundary gained to its parent."""
    ys: list[Float[Array, "m p k"]] = []
    handed = jnp.zeros_like(loads[0], shape=(0, 1, loads[0].shape[2]))
    for level, front, load in reversed(list(zip(factor.plan.levels, factor.levels, loads, strict=True))):
        gained, p = _gained(level, handed), level.pivots
        load = load + gained[:, :p]
        handed = front.below @ load + gained[:, p:]
        ys.append(front.inverse @ load)
    return ys[::-1]


def _gained(level: LevelPlan, handed: Float[Array, "mc b k"]) -> Float[Array, "m q k"]:
    by_child = handed.reshape(*level.down.shape[:2], *handed.shape[1:])
    return _along(by_child, level.down[..., None], 2).sum(1)


def _backward(factor: NestedDissectionFactor, ys: Sequence[Float[Array, "m p k"] | None]) -> Float[Array, "places k"]:
    """x = L^-T y from the root down; every front finds its boundary's x in its parent's front.

    A level without load has None for y.
    """
    columns = next(y.shape[2] for y in ys if y is not None)
    whole = jnp.zeros_like(factor.scale, shape=(1, 1, columns))
    xs = []
    for level, front, y in zip(factor.plan.levels, factor.levels, ys, strict=True):
        outer = _inherited(level, whole)
        x = jnp.einsum("mbp,mbk->mpk", front.below, outer)
        if y is not None:
            x = x + jnp.einsum("mqp,mqk->mpk", front.inverse, y)
        whole = jnp.concatenate([x, outer], 1)
        xs.append(x.reshape(prod(x.shape[:2]), x.shape[2]))
    return jnp.concatenate(xs)


def _inherited(level: LevelPlan, front: Float[Array, "mp qp k"]) -> Float[Array, "m b k"]:
    by_parent = level.up.reshape(front.shape[0], -1, 1)
    return _along(front, by_parent, 1).reshape(*level.up.shape, front.shape[2])
