"""Sparse Cholesky in pure JAX: multifrontal, one batch for each level of a nested dissection.

The host finds a tree of separators (George 1973, `dissection`) and the place of every number of the
multifrontal method (Duff and Reid 1983, `symbolic`).  On the device all fronts of one level
are one batch.  With a front F over pivots 1 and boundary 2,

    F11 = U^T U,    W = U^-T F12,    update of the parent: F22 - W^T W,

a level keeps U and W for the sweeps of a solve:

    forward  y = U^-T r1, update = -W^T y,    backward  x1 = U^-1 (y - W x2).

`corner`, the inverse on the unknowns of the root, needs no sweep, since the last front determines it.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from math import prod
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Integer

from ..._compile import by_platform, full_precision
from ...registry import limited
from ..base import AbstractLinearSolver, SparsityPattern, index_arrays, jacobi_scale, on_device
from ..lapack import portion_of, portioned
from ..small_matrices import stacked_product, summed
from .batches import eliminated_lanes, lane_plan, lanewise, unrolled_levels
from .dissection import dissect
from .fronts import Front, LevelPlan, NestedDissectionFactor, NestedDissectionPlan, Panel
from .symbolic import Level, lay_out

# Largest number of pivots eliminated at once.  For more, the threads of LAPACK and of XLA compete (a factor of
# a hundred on a busy machine); halving moves the work into matrix products, which XLA runs in parallel.
MAX_PANEL_PIVOTS = 72

# Number of unknowns of a subtree whose fronts fit in a processor's cache.
SUBTREE_UNKNOWNS = 6000

# Largest number of parts of a level that are unrolled; more run in a loop, which copies its arrays in and out.
MAX_UNROLLED_PARTS = 8


T = TypeVar("T")


class NestedDissection(AbstractLinearSolver):
    """Multifrontal Cholesky on a nested dissection whose leaves have at most about ``leaf_size`` unknowns."""

    leaf_size: int = limited(32, least=1, static=True)

    def analyse(self, pattern: SparsityPattern) -> NestedDissectionPlan:
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
            subtrees=max(0, min(depth, round(np.log2(pattern.n / SUBTREE_UNKNOWNS)))),
        )

    @full_precision
    def factor(self, plan: NestedDissectionPlan, values: Float[Array, " nnz"]) -> NestedDissectionFactor:
        scale, scaled = jacobi_scale(plan, values)
        return NestedDissectionFactor(_eliminated(plan, scaled, keep=True), scale, plan)

    @full_precision
    def solve(self, factor: NestedDissectionFactor, rhs: Float[Array, "n k"]) -> Float[Array, "n k"]:
        plan, scale = factor.plan, factor.scale[:, None]
        padded = jnp.concatenate([scale * rhs, jnp.zeros_like(rhs, shape=(1, rhs.shape[1]))])
        loads = _split(padded[plan.gather], [(m, p) for m, _, p in plan.panel_shapes])
        x = _backward(factor, _forward(factor, loads))
        return scale * x[plan.scatter]

    @full_precision
    def columns(self, factor: NestedDissectionFactor) -> Float[Array, "n r"]:
        plan, scale = factor.plan, factor.scale[:, None]
        # A load on the root, which is eliminated last, changes no front below it: there is nothing to pass up.
        ys = [y * scale[plan.root].T for y in _root_loads(plan, factor.levels[0])]
        x = _backward(factor, [ys, *[None] * (len(plan.levels) - 1)])
        return scale * x[plan.scatter]

    @full_precision
    def corner(self, plan: NestedDissectionPlan, values: Float[Array, " nnz"]) -> Float[Array, "r r"]:
        found: Array = _root_corner(plan, values)
        return found


def _index(array: np.ndarray) -> Integer[Array, "..."]:
    return on_device(array, np.uint32)


def _level_plan(level: Level) -> LevelPlan:
    pivots = level.pivots.shape[1]
    among, beside = np.split(level.entries, [pivots], 2)
    return LevelPlan(_index(level.up), _index(level.down), _index(among), _index(beside))


def _suits_lanes(plan: NestedDissectionPlan) -> bool:
    """Whether most fronts are narrow enough for `eliminated_lanes`."""
    return unrolled_levels(plan.levels) < len(plan.levels)


def _root_corner_lanes(
    plan: NestedDissectionPlan, apart: bool
) -> Callable[[Float[Array, "lanes nnz"]], Float[Array, "lanes r r"]]:
    """`_root_corner` of many matrices: lanes are the last axis of narrow fronts (`batches`), the first of wide ones."""
    top = unrolled_levels(plan.levels)
    narrow = lax.optimization_barrier(lane_plan(plan.levels, plan.n, apart))

    def several(values: Float[Array, "lanes nnz"]) -> Float[Array, "lanes r r"]:
        scale, scaled = jax.vmap(partial(jacobi_scale, plan))(values)
        padded = jax.vmap(with_constants)(scaled)
        update = eliminated_lanes(narrow, lax.optimization_barrier(padded.T))
        found: Float[Array, "lanes r r"] = jax.vmap(beyond)(padded, update, scale)
        return found

    def beyond(padded: Array, update: Float[Array, "m b b"], scale: Float[Array, " n"]) -> Float[Array, "r r"]:
        update, _ = swept(plan.levels[1:top], padded, update, keep=False)
        _, (root,) = swept(plan.levels[:1], padded, update, keep=True)
        return _corner_of(plan, root, scale)

    return several


@partial(lanewise, lanes=_root_corner_lanes, suits=_suits_lanes)
def _root_corner(plan: NestedDissectionPlan, values: Float[Array, " nnz"]) -> Float[Array, "r r"]:
    """The inverse on the root."""
    scale, scaled = jacobi_scale(plan, values)
    return _corner_of(plan, _eliminated(plan, scaled, keep=False)[0], scale)


def _corner_of(plan: NestedDissectionPlan, root: Front, scale: Float[Array, " n"]) -> Float[Array, "r r"]:
    """The inverse on the root, from the factor of its front and the scale."""
    # The root is eliminated last: its front is the Schur complement U^T U, whose inverse is that of the matrix there.
    y = jnp.concatenate(_root_loads(plan, root), 1)[0] * scale[plan.root]
    return y.T @ y


def with_constants(values: Float[Array, " nnz"]) -> Float[Array, " nnz_and_2"]:
    """The values, then what `symbolic.Level` has where there is none: a zero, and a one for padded pivots."""
    return jnp.concatenate([values, jnp.array([0.0, 1.0], values.dtype)])


def _eliminated(plan: NestedDissectionPlan, values: Float[Array, " nnz"], keep: bool) -> tuple[Front, ...]:
    """The factors of all fronts, from the root down; of the root only, unless ``keep``."""
    padded = with_constants(values)
    top = max(plan.subtrees, 1)
    update, low = by_platform(
        plan.levels[top:],
        padded,
        cpu=partial(in_subtrees, count=1 if keep else 1 << plan.subtrees, keep=keep),
        default=partial(in_subtrees, count=1, keep=keep),
    )
    update, middle = swept(plan.levels[1:top], padded, update, keep)
    _, root = swept(plan.levels[:1], padded, update, True)
    found: tuple[Front, ...] = root + middle + low
    return found


def in_subtrees(
    levels: tuple[LevelPlan, ...], values: Array, count: int, keep: bool
) -> tuple[Float[Array, "m b b"], tuple[Front, ...]]:
    """`swept` over one subtree after another, so that their fronts stay in the processor's cache."""
    leafless = jnp.zeros((0, 1, 1), values.dtype)
    if count == 1:
        return swept(levels, values, leafless, keep)
    apart = jax.tree.map(lambda a: a.reshape(count, a.shape[0] // count, *a.shape[1:]), levels)
    found = lax.map(lambda levels: swept(levels, values, leafless, keep), apart)
    out: tuple[Float[Array, "m b b"], tuple[Front, ...]] = jax.tree.map(
        lambda a: a.reshape(a.shape[0] * a.shape[1], *a.shape[2:]), found
    )
    return out


def swept(
    levels: tuple[LevelPlan, ...], values: Array, update: Float[Array, "children q q"], keep: bool
) -> tuple[Float[Array, "m b b"], tuple[Front, ...]]:
    """Eliminate these levels, the last one first: the update of the level above, and the factors if ``keep``."""
    fronts: list[Front] = []
    for level in reversed(levels):
        parts = _parts(level)
        w, front = by_platform(
            level, values, update, cpu=partial(_panels, parts=parts), default=partial(_panels, parts=1)
        )
        fronts.append(front)
        boundary = slice(level.pivots, None)
        update = summed(_spread(level, update, boundary, boundary), 1) - stacked_product(w, w)
    return update, tuple(fronts[::-1]) if keep else ()


def _parts(level: LevelPlan) -> int:
    """Number of parts of a level such that no part needs a loop (`portioned`); 1 if that number is too large."""
    count, pivots, boundary = level.beside.shape
    parts = count // portion_of(count, pivots, boundary)
    return parts if pivots <= MAX_PANEL_PIVOTS and parts <= MAX_UNROLLED_PARTS else 1


def _panels(
    level: LevelPlan, values: Array, update: Float[Array, "children q q"], parts: int
) -> tuple[Float[Array, "m p b"], Front]:
    """W of every front of a level, and the level's factor; fronts are assembled and eliminated part by part."""
    if parts > 1:
        cut = partial(_cut, parts=parts)
        done = [_panels(*piece, 1) for piece in zip(cut(level), [values] * parts, cut(update), strict=True)]
        found: tuple[Float[Array, "m p b"], Front] = jax.tree.map(lambda *pieces: jnp.concatenate(pieces), *done)
        return found
    pivots, boundary = slice(0, level.pivots), slice(level.pivots, None)
    among = _values_at(values, level.among) + summed(_spread(level, update, pivots, pivots), 1)
    beside = _values_at(values, level.beside) + summed(_spread(level, update, pivots, boundary), 1)
    return _eliminate(among, beside)


def _cut(tree: T, parts: int) -> list[T]:
    """The tree in ``parts`` pieces: every array is cut along its leading axis."""
    arrays, structure = jax.tree.flatten(tree)
    pieces = zip(*(jnp.split(array, parts) for array in arrays), strict=True)
    return [jax.tree.unflatten(structure, piece) for piece in pieces]


def _values_at(values: Array, places: Integer[Array, "..."]) -> Array:
    return values.at[places].get(mode="promise_in_bounds")


def _spread(
    level: LevelPlan, updates: Float[Array, "children q q"], rows: slice, columns: slice
) -> Float[Array, "m c i j"]:
    """The children's updates, each at its places, in these rows and columns of the fronts.

    The caller sums over the children by `summed`, which XLA computes once. XLA would recompute a sum written as two
    terms for every use of its result.
    """
    places, size = level.down, updates.shape[1]
    fronts, children, _ = places.shape
    updates = updates.reshape(fronts, children, size, size)
    front = jnp.arange(fronts, dtype=jnp.uint32)[:, None, None, None]
    child = jnp.arange(children, dtype=jnp.uint32)[:, None, None]
    at = front, child, places[..., rows, None], places[..., None, columns]
    return updates.at[at].get(mode="promise_in_bounds")


def _gather(array: Array, places: Integer[Array, "..."], axis: int) -> Array:
    """Entries of the array at places along one axis; the places are known to be in bounds, so XLA need not check."""
    return jnp.take_along_axis(array, places, axis, mode="promise_in_bounds")


def _eliminate(among: Float[Array, "m p p"], beside: Float[Array, "m p b"]) -> tuple[Float[Array, "m p b"], Front]:
    """W of every front, and the level's factor; wide fronts are eliminated in two halves."""
    p = among.shape[2]
    if p <= MAX_PANEL_PIVOTS:
        panel = Panel(*_panel(among, beside))
        return panel.beside, (panel,)
    h = (p + 1) // 2
    w1, first = _eliminate(among[:, :h, :h], jnp.concatenate([among[:, :h, h:], beside[:, :h]], 2))
    across, beyond = w1[:, :, : p - h], w1[:, :, p - h :]
    w2, second = _eliminate(
        among[:, h:, h:] - stacked_product(across, across), beside[:, h:] - stacked_product(across, beyond)
    )
    return jnp.concatenate([beyond, w2], 1), first + second


# LAPACK stores a matrix by columns, XLA by rows: the lower triangle of the one is the upper triangle of the other,
# so that a transposed argument needs no copy.  The barriers keep XLA from moving the transposition elsewhere.


@portioned
def _panel(among: Float[Array, "m p p"], beside: Float[Array, "m p b"]) -> Panel:
    """U, and W = U^-T F12; only the upper triangle of ``among`` is read."""
    among, beside = lax.optimization_barrier((among, beside))
    lower = lax.linalg.cholesky(_transposed(among), symmetrize_input=False)
    w = lax.linalg.triangular_solve(lower, _transposed(beside), left_side=False, lower=True, transpose_a=True)
    return Panel(*lax.optimization_barrier((_transposed(lower), _transposed(w))))


@portioned
def _descended(upper: Float[Array, "m p p"], rhs: Float[Array, "m p k"]) -> tuple[Float[Array, "m p k"]]:
    """U^-T r."""
    lower, rhs = _transposed(upper), _transposed(rhs)
    return (_transposed(lax.linalg.triangular_solve(lower, rhs, left_side=False, lower=True, transpose_a=True)),)


@portioned
def _ascended(upper: Float[Array, "m p p"], rhs: Float[Array, "m p k"]) -> tuple[Float[Array, "m p k"]]:
    """U^-1 r."""
    lower, rhs = _transposed(upper), _transposed(rhs)
    return (_transposed(lax.linalg.triangular_solve(lower, rhs, left_side=False, lower=True)),)


def _transposed(array: Float[Array, "m i j"]) -> Float[Array, "m j i"]:
    return jnp.swapaxes(array, 1, 2)


def _split(rows: Array, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Cut the leading axis into pieces, and fold each into its shape."""
    ends = np.cumsum([0, *map(prod, shapes)])
    pieces = [rows[begin:end] for begin, end in pairwise(ends)]
    return [piece.reshape(*shape, *rows.shape[1:]) for piece, shape in zip(pieces, shapes, strict=True)]


def _root_loads(plan: NestedDissectionPlan, front: Front) -> list[Float[Array, "1 _ r"]]:
    """U^-T of the unit loads on the unknowns of the root, panel by panel."""
    size = sum(panel.upper.shape[1] for panel in front) + front[-1].beside.shape[2]
    unit = jnp.arange(size, dtype=plan.scatter.dtype)[:, None] == plan.scatter[plan.root]
    return _forward_front(front, unit[None].astype(front[0].upper.dtype))[0]


def _forward_front(
    front: Front, load: Float[Array, "m q k"]
) -> tuple[list[Float[Array, "m _ k"]], Float[Array, "m b k"]]:
    """y = U^-T r of every panel, and the update of the boundary."""
    ys = []
    for panel in front:
        p = panel.upper.shape[1]
        _, y = _descended(panel.upper, load[:, :p])
        load = load[:, p:] - stacked_product(panel.beside, y)
        ys.append(y)
    return ys, load


def _forward(factor: NestedDissectionFactor, loads: list[Float[Array, "_ _ k"]]) -> list[list[Float[Array, "_ _ k"]]]:
    """y = U^-T r from the leaves up; every front passes the update of its boundary to its parent."""
    ys = []
    handed = jnp.zeros_like(loads[0], shape=(0, 1, loads[0].shape[2]))
    for level, front, load in reversed(list(zip(factor.plan.levels, factor.levels, loads, strict=True))):
        padded = jnp.pad(load, [(0, 0), (0, level.up.shape[1]), (0, 0)])
        y, handed = _forward_front(front, padded + _from_children(level, handed))
        ys.append(y)
    return ys[::-1]


def _from_children(level: LevelPlan, handed: Float[Array, "mc b k"]) -> Float[Array, "m q k"]:
    """The sum of the children's boundary updates, at the places of their parent's front."""
    by_child = handed.reshape(*level.down.shape[:2], *handed.shape[1:])
    return summed(_gather(by_child, level.down[..., None], 2), 1)


def _backward(
    factor: NestedDissectionFactor, ys: Sequence[list[Float[Array, "_ _ k"]] | None]
) -> Float[Array, "places k"]:
    """x = U^-1 y from the root down; every front finds its boundary's x in its parent's front.

    A level without load has None for y.
    """
    columns = next(y[0].shape[2] for y in ys if y is not None)
    x = jnp.zeros_like(factor.scale, shape=(1, 1, columns))
    xs = []
    for level, front, y in zip(factor.plan.levels, factor.levels, ys, strict=True):
        x = _from_parents(level, x)
        for k in reversed(range(len(front))):
            # x = U^-1 (y - W x_b) as -U^-1 (W x_b - y): without load there is no y to subtract from.
            rest = stacked_product(_transposed(front[k].beside), x)
            _, own = _ascended(front[k].upper, rest if y is None else rest - y[k])
            x = jnp.concatenate([-own, x], 1)
        own = x[:, : level.pivots]
        xs.append(own.reshape(prod(own.shape[:2]), columns))
    return jnp.concatenate(xs)


def _from_parents(level: LevelPlan, front: Float[Array, "mp qp k"]) -> Float[Array, "m b k"]:
    """x of every front's boundary, from the front of its parent."""
    by_parent = level.up.reshape(front.shape[0], -1, 1)
    return _gather(front, by_parent, 1).reshape(*level.up.shape, front.shape[2])
