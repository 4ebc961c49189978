"""Multifrontal elimination of many matrices of one pattern at once: arrays of shape (fronts, rows, columns, lanes).

The fronts of nested dissection are small, so that LAPACK calls for single fronts reach a fraction of the speed of the
processor. Here the last axis counts matrices (lanes), and each operation is the same for `lane_count` neighbouring
numbers, which fill whole vector registers whatever the size of the fronts. The rest is the method of the
module `nested_dissection`. With rows u of U and W for the pivots that are eliminated so far, a row of a front is

    r_i = F_i - sum_k u_ki u_k,    u_i = r_i / sqrt(r_ii),

the second only where i is a pivot. Rows are formed in blocks (left-looking elimination), and from the diagonal on,
since fronts are symmetric. Sums are written out term by term, so that XLA makes one loop of each block.

A matrix that is not positive definite gets a square root of a negative number, and NaN in all that depends on it; no
operation mixes lanes.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Float, Integer

from ..._compile import by_platform, full_precision
from .fronts import LevelPlan

# On a CPU, bytes of the numbers of all lanes at one place: two cache lines. With more, the fronts of a level leave the
# cache.
LANE_BYTES = 128

# Elsewhere, bytes of the values of all matrices that are eliminated together. Their fronts take about 16 times as much.
PORTION_BYTES = 1 << 27

# Smallest batch that is eliminated in lanes; for fewer, the program takes longer to compile than it saves.
MIN_BATCH = 32

# Largest number of pivots whose elimination is written out; compilation takes a fraction of a second for each level.
MAX_WRITTEN_PIVOTS = 32

# Number of unknowns of a subtree whose fronts fit in a processor's cache, all lanes of them.
SUBTREE_UNKNOWNS = 300

PANEL_ROWS = 4  # pivots in a block of rows; the rows of a block are eliminated in one loop, which repeats some work
BOUNDARY_BLOCKS = 3  # blocks of the other rows; each computes a few numbers below the diagonal
MIN_BOUNDARY_ROWS = 8


class Block(NamedTuple):
    """Rows ``first`` to ``last`` of the fronts of a level, from the column ``first`` on."""

    first: int
    last: int

    def size(self, places: int) -> int:
        """Number of entries in a front with so many places."""
        return (self.last - self.first) * (places - self.first)


P = TypeVar("P")
T = TypeVar("T")
Tables = list[list[Integer[Array, "_ _ _"]]]  # for each block: rows of the values, then of children's updates


class LanePlan(NamedTuple):
    """The narrow levels and their tables: those above the subtrees, and those of the subtrees, which have an axis in
    front that counts subtrees."""

    above: tuple[LevelPlan, ...]
    tables: list[Tables]
    below: tuple[LevelPlan, ...]
    tables_below: list[Tables]


def lane_count(dtype: np.dtype) -> int:
    """Number of matrices that are eliminated together on a CPU."""
    return LANE_BYTES // dtype.itemsize


def lanewise(
    function: Callable[[P, Array], T], lanes: Callable[[P, bool], Callable[[Array], T]], suits: Callable[[P], bool]
) -> Callable[[P, Array], T]:
    """``function(plan, values)``, whose `jax.vmap` over values calls ``lanes(plan, apart)`` for portions of the values.

    That function gets and returns arrays with one more axis, in front. A portion has `lane_count` values on a CPU,
    where ``apart`` is true: subtrees follow one another, so that their fronts stay in the cache. It has up to
    `PORTION_BYTES` on other devices. Batches of fewer than `MIN_BATCH`, plans that do not suit and batches of plans use
    `jax.vmap` of ``function``.
    """
    function = full_precision(function)
    single = custom_vmap(function)
    plainly: Callable[[P, Array], T] = jax.vmap(function, (None, 0))

    @custom_vmap
    def several(plan: P, values: Array) -> T:
        if len(values) < MIN_BATCH or not suits(plan):
            return plainly(plan, values)
        return _in_lanes(lanes, plan, values)

    @single.def_vmap
    def _(size: int, batched: Sequence[Any], plan: P, values: Array) -> tuple[T, Any]:
        found = several(plan, values) if _values_only(batched) else _mapped(function, batched, plan, values)
        return found, jax.tree.map(lambda _: True, found)

    @several.def_vmap
    def _(size: int, batched: Sequence[Any], plan: P, values: Array) -> tuple[T, Any]:
        if _values_only(batched):
            count = values.shape[1]
            flat = several(plan, values.reshape(size * count, -1))
            found = jax.tree.map(lambda a: a.reshape(size, count, *a.shape[1:]), flat)
        else:
            found = _mapped(plainly, batched, plan, values)
        return found, jax.tree.map(lambda _: True, found)

    return single


def _values_only(batched: Sequence[Any]) -> bool:
    of_plan, of_values = batched
    return bool(of_values) and not any(jax.tree.leaves(of_plan))


def _mapped(function: Callable[[P, Array], T], batched: Sequence[Any], plan: P, values: Array) -> T:
    """`jax.vmap` of ``function`` over the arrays that have a batch."""
    mapped, shared = eqx.partition((plan, values), tuple(batched))
    found: T = jax.vmap(lambda mapped: function(*eqx.combine(mapped, shared)))(mapped)
    return found


def _in_lanes(lanes: Callable[[P, bool], Callable[[Array], T]], plan: P, values: Float[Array, "batch nnz"]) -> T:
    """``lanes`` of all values, in the portions that suit the platform."""
    portions = -(-values.size * values.dtype.itemsize // PORTION_BYTES)
    width = -(-len(values) // portions)
    return by_platform(
        plan,
        values,
        cpu=partial(_in_portions, lanes, True, lane_count(values.dtype)),
        default=partial(_in_portions, lanes, False, width),
    )


def _in_portions(
    lanes: Callable[[P, bool], Callable[[Array], T]],
    apart: bool,
    width: int,
    plan: P,
    values: Float[Array, "batch nnz"],
) -> T:
    """``lanes(plan, apart)`` of ``width`` values, one portion after another; the last value fills up the last one."""
    batch = len(values)
    count = -(-batch // width)
    filled = jnp.concatenate([values, jnp.broadcast_to(values[-1], (count * width - batch, values.shape[1]))])
    found = lax.map(full_precision(lanes(plan, apart)), filled.reshape(count, width, -1))
    whole: T = jax.tree.map(lambda a: a.reshape(count * width, *a.shape[2:])[:batch], found)
    return whole


def unrolled_levels(levels: Sequence[LevelPlan]) -> int:
    """The first level that `eliminated_lanes` can eliminate with all below it, but never the root."""
    wide = [number for number, level in enumerate(levels) if level.pivots > MAX_WRITTEN_PIVOTS]
    return max([0, *wide]) + 1


def lane_plan(levels: Sequence[LevelPlan], unknowns: int, apart: bool = True) -> LanePlan:
    """What `eliminated_lanes` needs for all levels from `unrolled_levels` on.

    Args:
        apart: whether subtrees that fit in a processor's cache follow one another; else all are eliminated at once.
    """
    top = unrolled_levels(levels)
    depth = round(np.log2(max(1, unknowns / SUBTREE_UNKNOWNS))) if apart else 0
    cut = min(max(depth, top), len(levels) - 1) if depth > 0 else len(levels)
    above, below = tuple(levels[top:cut]), tuple(levels[cut:])
    count = 1 << cut
    subtrees = jax.tree.map(lambda a: a.reshape(count, a.shape[0] // count, *a.shape[1:]), below)
    tables = _gather_tables((*above, *below[:1]))[: len(above)]
    return LanePlan(above, tables, subtrees, jax.vmap(_gather_tables)(subtrees) if below else [])


def _gather_tables(levels: Sequence[LevelPlan]) -> list[Tables]:
    """For each level, the places from which `_eliminate` takes the entries of each block of rows."""
    below = [*levels[1:], None]
    return [_level_tables(level, child) for level, child in zip(levels, below, strict=True)]


def eliminated_lanes(plan: LanePlan, values: Float[Array, "nnz_and_2 lanes"]) -> Float[Array, "lanes m b b"]:
    """The update of the wide levels, after elimination of the narrow ones, the last one first.

    Args:
        values: entries of the matrices, then a zero and a one.
    """
    update = None
    if plan.below:
        subtrees = lax.map(lambda part: _swept(part[0], part[1], values, None), (plan.below, plan.tables_below))
        update = subtrees.reshape(-1, values.shape[1])
    update = _swept(plan.above, plan.tables, values, update)
    return _whole((*plan.above, *plan.below)[0], update)


def _swept(
    levels: Sequence[LevelPlan],
    tables: Sequence[Tables],
    values: Float[Array, "nnz_and_2 lanes"],
    update: Float[Array, "_ lanes"] | None,
) -> Float[Array, "_ lanes"]:
    """The update of the level above these, laid out as `_row_offsets` says, from that of the level below them."""
    for level, table in zip(reversed(levels), reversed(tables), strict=True):
        update = _eliminate(level, table, values, update)
    assert update is not None
    return update


def _blocks(level: LevelPlan) -> tuple[list[Block], list[Block]]:
    """Blocks of pivots, and blocks of boundary rows."""
    pivots, boundary = level.beside.shape[-2:]
    count = min(BOUNDARY_BLOCKS, max(1, boundary // MIN_BOUNDARY_ROWS))
    cuts = np.linspace(pivots, pivots + boundary, count + 1).astype(int).tolist()
    panels = [Block(first, min(first + PANEL_ROWS, pivots)) for first in range(0, pivots, PANEL_ROWS)]
    return panels, [Block(*ends) for ends in pairwise(cuts)]


def _row_offsets(level: LevelPlan) -> tuple[np.ndarray, int]:
    """Where an update lies in memory: the entry (i, j), i <= j, is at ``offset[i] + j``; and its size.

    The blocks of boundary rows follow one another, each (rows, columns from its first row on).
    """
    pivots, boundary = level.beside.shape[-2:]
    offsets, size = np.zeros(boundary, np.int64), 0
    for block in _blocks(level)[1]:
        first, last = block.first - pivots, block.last - pivots
        offsets[first:last] = size + np.arange(last - first) * (boundary - first) - first
        size += block.size(pivots + boundary)
    return offsets, size


def _level_tables(level: LevelPlan, child: LevelPlan | None) -> Tables:
    entries = jnp.concatenate([level.among, level.beside], 2)
    panels, boundary = _blocks(level)
    tables: Tables = []
    for block in panels + boundary:
        own = [entries[:, block.first : block.last, block.first :]] if block.first < level.pivots else []
        tables.append(own + ([] if child is None else _child_places(level, child, block)))
    return tables


def _child_places(level: LevelPlan, child: LevelPlan, block: Block) -> list[Integer[Array, "_ _ _"]]:
    """Places of a block's entries in the updates of the first and of the second children."""
    offsets, size = _row_offsets(child)
    # An offset may be negative; unsigned sums are right all the same, since they count modulo 2^32.
    start = jnp.asarray(offsets.astype(np.uint32))
    fronts, children, _ = level.down.shape
    front = jnp.arange(fronts, dtype=jnp.uint32)[:, None, None] * np.uint32(children)
    places = []
    for number in range(children):
        i = level.down[:, number, block.first : block.last, None]
        j = level.down[:, number, None, block.first :]
        places.append((front + np.uint32(number)) * np.uint32(size) + start[jnp.minimum(i, j)] + jnp.maximum(i, j))
    return places


def _eliminate(
    level: LevelPlan, tables: Tables, values: Float[Array, "nnz_and_2 lanes"], update: Float[Array, "_ lanes"] | None
) -> Float[Array, "_ lanes"]:
    """The update of the level above, laid out as `_row_offsets` says."""
    panels, boundary = _blocks(level)
    rows: list[Array] = []
    found = []
    for block, table in zip(panels + boundary, tables, strict=True):
        front = _assembled(level, block, table, values, update)
        front = lax.optimization_barrier(front - _products(rows, block) if rows else front)
        if block.first < level.pivots:
            rows.append(lax.optimization_barrier(_pivot_rows(front)))
        else:
            found.append(front.reshape(front.shape[0], -1, front.shape[3]))
    joined = jnp.concatenate(found, 1)
    kept: Array = lax.optimization_barrier(joined.reshape(-1, joined.shape[2]))
    return kept


def _assembled(
    level: LevelPlan,
    block: Block,
    table: list[Integer[Array, "_ _ _"]],
    values: Float[Array, "nnz_and_2 lanes"],
    update: Float[Array, "_ lanes"] | None,
) -> Float[Array, "m rows columns lanes"]:
    """The block's entries of the matrices and of the children's updates."""
    children = 0 if update is None else 2
    terms = [_rows_at(values, places) for places in table[: len(table) - children]]
    if update is not None:
        terms += [_rows_at(update, places) for places in table[len(table) - children :]]
    if not terms:
        fronts, pivots, boundary = level.beside.shape
        shape = fronts, block.last - block.first, pivots + boundary - block.first, values.shape[1]
        return jnp.zeros(shape, values.dtype)
    return sum(terms[1:], start=terms[0])


def _rows_at(array: Float[Array, "_ lanes"], places: Integer[Array, "..."]) -> Float[Array, "... lanes"]:
    return array.at[places].get(mode="promise_in_bounds")


def _products(rows: list[Array], block: Block) -> Array:
    """``sum_k u_ki u_kj`` over all rows so far, for i in the block and j from its first column on."""
    places = rows[0].shape[2]
    done = [panel[:, :, block.first - places + panel.shape[2] :] for panel in rows]
    u = done[0] if len(done) == 1 else jnp.concatenate(done, 1)
    count = block.last - block.first
    total: Array = u[:, 0, :count, None] * u[:, 0, None]
    for k in range(1, u.shape[1]):
        total = total + u[:, k, :count, None] * u[:, k, None]
    return total


def _pivot_rows(front: Float[Array, "m rows columns lanes"]) -> Float[Array, "m rows columns lanes"]:
    """Rows of U and W from the rows of a block of pivots, which are its first columns; zero below the diagonal."""
    rows: list[Array] = []
    for i in range(front.shape[1]):
        row = front[:, i, i:]
        for k, above in enumerate(rows):
            row = row - above[:, i - k, None] * above[:, i - k :]
        rows.append(row * lax.rsqrt(row[:, :1]))
    return jnp.stack([jnp.pad(row, ((0, 0), (i, 0), (0, 0))) for i, row in enumerate(rows)], 1)


def _whole(level: LevelPlan, update: Float[Array, "_ lanes"]) -> Float[Array, "lanes m b b"]:
    """Both triangles of an update, the lanes in front."""
    offsets, size = _row_offsets(level)
    i, j = np.indices((len(offsets), len(offsets)))
    places = (offsets[np.minimum(i, j)] + np.maximum(i, j)).astype(np.uint32)
    by_front = update.reshape(-1, size, update.shape[1])
    return jnp.moveaxis(by_front[:, places], -1, 0)
