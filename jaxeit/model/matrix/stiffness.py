"""The sheet's stiffness, coefficient by coefficient of an image.

The contribution of one coefficient to the energy of two fields is ``A_p(x, y) = x^T K_p y`` with K_p the sum of its
elements' stiffnesses at unit conductivity.  K_p depends on differences of potentials only: with potentials relative to
the first node, that node drops out.  Half of the rest is stored, ``K_p = H + H^T``, with few entries in each row of H.
``x^T K_p y = x^T H y + (y^T H x)^T`` then takes a row of products per node, while a sum over elements takes two per
triangle (six on P2 elements), and there are twice as many triangles as nodes.
"""

from functools import partial
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Integer, Shaped
from scipy import sparse

from ...linalg.base import on_device
from ...linalg.small_matrices import stacked_product

BATCH_ROWS = 4096  # rows of H in a batch, whose potentials fit in a core's cache
HOST_BATCH_ELEMENTS = 1 << 18  # elements whose H the host computes at once: this bounds its memory
# Entries of H up to which XLA's loops are faster than a library: for more, they recompute H x for each field and take
# twice as long.
MAX_LOOPED_ENTRIES = 40


class TableBatch(NamedTuple):
    """Neighbouring lines of a table. The last batch repeats lines of the one before, so that all have one size.

    | meaning                                 | shape   |
    |-----------------------------------------|---------|
    | start: the first line                   | ()      |
    | fresh: lines that are in no batch before | (size,) |
    """

    start: Int[Array, ""]
    fresh: Bool[Array, " size"]

    @classmethod
    def number(cls, i: Int[Array, ""], size: int, lines: int) -> "TableBatch":
        """Batch i of ``size`` lines, of a table that has at least as many."""
        start = jnp.minimum(i * size, lines - size)
        return cls(start, start + jnp.arange(size) >= i * size)

    def cut(self, table: Shaped[Array, "lines ..."]) -> Shaped[Array, "size ..."]:
        """These lines of a table."""
        return jax.lax.dynamic_slice_in_dim(table, self.start, len(self.fresh))


class Stiffness(eqx.Module):
    """H of each line of a `BasisMap`, whose elements have up to n + 1 nodes.

    | meaning                                                       | shape          | unit |
    |---------------------------------------------------------------|----------------|------|
    | dofs: unknowns of the line; all potentials are from the first | (lines, n + 1) |      |
    | column, entry of each row of H, the first node left out       | (lines, n, c)  | 1    |
    """

    dofs: Integer[Array, "lines n1"]
    column: Integer[Array, "lines n c"]
    entry: Float[Array, "lines n c"]
    unknowns: int = eqx.field(static=True)

    def products(
        self,
        potential: Float[Array, "unknowns k"],
        pairs: tuple[Integer[Array, " r"], Integer[Array, " r"]],
        coefficient: Integer[Array, " lines"] | None,
        size: int,
    ) -> Float[Array, "size r"]:
        """``x_a^T K_p x_b`` for each coefficient p and these pairs (a, b) of fields, in batches of lines.

        Args:
            coefficient: the coefficient of each line; None if line p belongs to coefficient p.
        """
        lines, rows, width = self.entry.shape
        # At least two batches, since XLA would unroll a loop of one step and fuse it with the code around it.
        batch = max(1, min(-(-lines // 2), BATCH_ROWS // rows))
        here = jnp.arange(batch)[:, None]
        product = stacked_product if rows * width <= MAX_LOOPED_ENTRIES else partial(jnp.einsum, "lna,lnb->lab")
        first, second = pairs

        def add(i: Int[Array, ""], sums: Float[Array, "size pairs"]) -> Float[Array, "size pairs"]:
            part = TableBatch.number(i, batch, lines)
            dofs, column, entry = part.cut(self.dofs), part.cut(self.column), part.cut(self.entry)
            x = potential.at[dofs].get(mode="promise_in_bounds")
            x = x[:, 1:] - x[:, :1]
            terms = (
                entry[..., c, None] * x.at[here, column[..., c]].get(mode="promise_in_bounds") for c in range(width)
            )
            half = product(x, cast(Array, sum(terms)))
            found = half[:, first, second] + half[:, second, first]
            if coefficient is None:
                return jax.lax.dynamic_update_slice_in_dim(sums, found, part.start, 0)
            return sums.at[part.cut(coefficient)].add(jnp.where(part.fresh[:, None], found, 0))

        none = jnp.zeros((size, len(first)), potential.dtype)
        found: Array = jax.lax.fori_loop(0, -(-lines // batch), add, none)
        return found


def stiffness(
    element: Int[np.ndarray, "lines e"],
    weight: Float[np.ndarray, "lines e"],
    dofs: Int[np.ndarray, "elements k"],
    slopes: Float[np.ndarray, "elements k r"],
    unknowns: int,
    dtype: np.dtype,
) -> Stiffness:
    """H of each line, from its elements times their weights; elements of weight zero do not count.

    Args:
        dofs, slopes, unknowns: of a `System`.
        dtype: precision of the entries; an entry that is rounding error of a right angle is left out.
    """
    lines, step = len(element), max(1, HOST_BATCH_ELEMENTS // element.shape[1])
    cuts = [slice(start, start + step) for start in range(0, lines, step)]
    rounding = 4 * float(np.finfo(dtype).eps)
    parts = [_halves(element[cut], weight[cut], dofs, slopes, unknowns, rounding) for cut in cuts]
    nodes = max(2, *(part.dofs.shape[1] for part in parts))
    shape = lines, nodes - 1, max(1, *(part.slot.max(initial=-1) + 1 for part in parts))
    table = np.empty((lines, nodes), np.uint32)
    column, entry = np.zeros(shape, np.min_scalar_type(nodes)), np.zeros(shape, dtype)
    for cut, part in zip(cuts, parts, strict=True):
        table[cut] = np.pad(part.dofs, ((0, 0), (0, nodes - part.dofs.shape[1])), mode="edge")
        at = cut.start + part.line, part.row, part.slot
        column[at], entry[at] = part.column, part.entry
    indices = on_device(table, table.dtype), on_device(column, column.dtype)
    return Stiffness(*indices, on_device(entry, dtype), unknowns)


class _Halves(NamedTuple):
    """H of some lines: each entry with its line, row, column and slot in the row."""

    dofs: np.ndarray  # (lines, nodes)
    line: np.ndarray
    row: np.ndarray
    column: np.ndarray
    slot: np.ndarray
    entry: np.ndarray


def _halves(
    element: np.ndarray, weight: np.ndarray, dofs: np.ndarray, slopes: np.ndarray, unknowns: int, rounding: float
) -> _Halves:
    line, place = np.nonzero(weight)
    chosen = element[line, place]
    root = slopes[chosen]
    table, owner, local, row = _numbered(line, dofs[chosen], len(element), unknowns)
    lower = _lower_triangle(row, weight[line, place, None, None] * (root @ root.swapaxes(1, 2)), len(owner))
    first, second = lower.row, lower.col
    value = np.where(first == second, 0.5, 1) * lower.data
    largest = np.zeros(len(element))
    np.maximum.at(largest, owner[first], np.abs(value))
    kept = (local[first] > 0) & (local[second] > 0) & (np.abs(value) > rounding * largest[owner[first]])
    first, second, value = first[kept], second[kept], value[kept]
    first, second = _balanced(first, second, len(owner))
    order = np.argsort(first, kind="stable")
    first, second, value = first[order], second[order], value[order]
    slot = np.arange(len(first)) - np.searchsorted(first, first)
    return _Halves(table, owner[first], local[first] - 1, local[second] - 1, slot, value)


class _Numbering(NamedTuple):
    """Rows of one sparse matrix that holds all lines: every line has its own rows, one for each of its unknowns."""

    table: np.ndarray  # (lines, nodes): the unknowns of each line
    owner: np.ndarray  # (rows,): the line of each row
    local: np.ndarray  # (rows,): the number of each row in its line
    row: np.ndarray  # (elements, k): the row of each node


def _numbered(line: np.ndarray, dofs: np.ndarray, lines: int, unknowns: int) -> _Numbering:
    """Rows for the unknowns (elements, k) of elements that belong to lines."""
    known, row = np.unique(line[:, None] * unknowns + dofs, return_inverse=True)
    owner = known // unknowns
    begin = np.searchsorted(owner, np.arange(lines))
    local = np.arange(len(known)) - begin[owner]
    table = np.zeros((lines, local.max(initial=0) + 1), int)
    table[:] = np.append(known % unknowns, 0)[begin, None]
    table[owner, local] = known % unknowns
    return _Numbering(table, owner, local, row.reshape(dofs.shape))


def _lower_triangle(row: np.ndarray, own: np.ndarray, count: int) -> sparse.coo_array:
    """The sum of the elements' matrices (elements, k, k), of ``count`` rows; what is above its diagonal is left out."""
    i, j = np.tril_indices(row.shape[1])
    places = np.maximum(row[:, i], row[:, j]), np.minimum(row[:, i], row[:, j])
    # Two nodes of an element may be one unknown (an electrode); the entry between them then counts twice.
    twice = (row[:, i] == row[:, j]) & (i != j)
    values = np.where(twice, 2, 1) * own[:, i, j]
    lower = sparse.coo_array((values.ravel(), tuple(place.ravel() for place in places)), (count, count))
    return lower.tocsr().tocoo()  # sums entries of several elements


def _balanced(first: np.ndarray, second: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The pairs, exchanged until no row has two entries more than a row that it shares a pair with.

    The longest row determines the width of the table: in meshes it decreases from 8 to 4, nearly the mean.
    """
    while True:
        entries = np.bincount(first, minlength=count)
        excess = entries[first] - entries[second]
        turned = np.flatnonzero(excess > 1)
        if not len(turned):
            return first, second
        turned = turned[np.argsort(-excess[turned], kind="stable")]
        for end in (first, second):  # exchange one pair of a row at a time, so that no row overshoots
            turned = turned[np.sort(np.unique(end[turned], return_index=True)[1])]
        first, second = first.copy(), second.copy()
        first[turned], second[turned] = second[turned], first[turned]
