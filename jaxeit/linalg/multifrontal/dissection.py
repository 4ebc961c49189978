"""Nested dissection of a graph, on the host: the assignment of unknowns to separators.

The unknowns are halved at the median of a coordinate; those of one half that touch the other form
a separator, and each half is divided in the same way (George 1973).  Of a few such cuts each part takes the
one with the least quotient of separator size to smaller half, since the fronts of one level are padded
to the largest.  All parts of one depth are cut together, so the work is a few sorts per depth.  The result is
a complete binary tree in heap numbering: 1 is the root separator, 2 t and 2 t + 1 are the halves below t,
and the deepest nodes are the leaves.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra, maximum_bipartite_matching

from ..base import SparsityPattern


def dissect(pattern: SparsityPattern, leaf_size: int) -> tuple[np.ndarray, int]:
    """The tree node that owns each unknown, (n,), and the depth of the tree (0: the root only).

    Unknowns of `SparsityPattern.root` and unknowns without a place belong to the root.
    """
    coords, placed = _places(pattern)
    depth = _depth(int(np.count_nonzero(placed)), leaf_size)
    edges = np.stack([pattern.rows, pattern.cols])[:, pattern.rows != pattern.cols]
    part = np.ones(pattern.n, np.int64)
    free = placed.copy()
    axes = _axes(coords, placed)
    for _ in range(depth):
        edges = edges[:, free[edges].all(0) & (part[edges[0]] == part[edges[1]])]
        side, cut = _best_halves(part, free, axes, edges)
        free &= ~cut
        part = np.where(free, 2 * part + side, part)
    return part, depth


def _depth(n: int, leaf_size: int) -> int:
    return max(0, int(np.ceil(np.log2(max(n, 1) / leaf_size))))


def _places(pattern: SparsityPattern) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates, and which unknowns may be dissected."""
    placed = np.ones(pattern.n, bool)
    placed[pattern.root] = False
    if pattern.coords is None:
        return _graph_coordinates(pattern, placed), placed
    return pattern.coords, placed & np.isfinite(pattern.coords).all(1)


def _graph_coordinates(pattern: SparsityPattern, placed: np.ndarray, count: int = 3) -> np.ndarray:
    """Distances along the graph from a few unknowns far from each other, (n, count).

    They replace missing coordinates.  Unknowns that cannot be reached have the distance n.
    """
    inside = placed[pattern.rows] & placed[pattern.cols]
    rows, cols = pattern.rows[inside], pattern.cols[inside]
    graph = csr_array((np.ones(rows.size), (rows, cols)), shape=(pattern.n, pattern.n))
    nearest, columns, start = np.full(pattern.n, np.inf), [], int(np.argmax(placed))
    for _ in range(count):
        start = int(np.argmax(np.where(placed, _distances(graph, start), -1)))
        columns.append(_distances(graph, start))
        nearest = np.minimum(nearest, columns[-1])
        start = int(np.argmax(np.where(placed, nearest, -1)))
    return np.stack(columns, 1)


def _distances(graph: csr_array, start: int) -> np.ndarray:
    steps = dijkstra(graph, directed=False, indices=start, unweighted=True)
    return np.asarray(np.where(np.isfinite(steps), steps, graph.shape[0]))


class Axis(NamedTuple):
    """A coordinate in whole steps of a billionth of its extent, (n,), and the unknowns in its order, (n,)."""

    steps: np.ndarray
    order: np.ndarray


def _axes(coords: np.ndarray, placed: np.ndarray) -> list[Axis]:
    finite = np.where(placed[:, None], coords, 0)
    steps = np.rint(finite / (np.abs(finite).max(initial=0) or 1) * 1e9).astype(np.int64)
    return [Axis(column, np.argsort(column, kind="stable")) for column in steps.T]


def _best_halves(
    part: np.ndarray, free: np.ndarray, axes: list[Axis], edges: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Side of each unknown, and whether it is in a separator, by the cut of least quotient of each part."""
    tries = [(side, cut) for axis in axes for side in _halves(part, free, axis) for cut in _least_covers(side, edges)]
    costs = np.stack([_quotient(part, free, side, cut) for side, cut in tries])
    best = np.argmin(costs, axis=0)[part]
    pick = np.arange(part.size)
    sides, cuts = (np.stack(column) for column in zip(*tries, strict=True))
    return sides[best, pick], cuts[best, pick]


def _quotient(part: np.ndarray, free: np.ndarray, side: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """Quotient of each part: size of the separator over that of the smaller side without it."""
    parts, rest = int(part.max()) + 1, free & ~cut
    left, right = (np.bincount(part[rest & (side == s)], minlength=parts) for s in (0, 1))
    smaller = np.minimum(left, right)
    return np.where(smaller > 0, np.bincount(part[cut], minlength=parts) / np.maximum(smaller, 1), np.inf)


def _halves(part: np.ndarray, free: np.ndarray, axis: Axis) -> list[np.ndarray]:
    """Sides of every part about the median of one coordinate, with the unknowns at the median on the one or on the
    other side; only on the first side if no part has more than one unknown there."""
    order = axis.order[free[axis.order]]
    order = order[np.argsort(part[order], kind="stable")]
    sizes = np.bincount(part[order], minlength=int(part.max()) + 1)
    first = np.cumsum(sizes) - sizes
    middle = axis.steps[order[np.minimum(first + np.maximum(sizes - 1, 0) // 2, order.size - 1)]][part]
    beyond, from_there = axis.steps > middle, axis.steps >= middle
    tied = np.count_nonzero((beyond != from_there)[order]) > np.count_nonzero(sizes)
    return [beyond, from_there] if tied else [beyond]


def _least_covers(side: np.ndarray, edges: np.ndarray) -> list[np.ndarray]:
    """The fewest unknowns that touch every edge between the sides, taken from one side or the other.

    König's theorem: given a maximum matching, let Z be the unknowns that alternating paths reach from the
    unmatched unknowns of one side; a cover is that side without Z and the other within Z.
    """
    crossing = edges[:, side[edges[0]] != side[edges[1]]]
    ends, places = np.unique(crossing, return_inverse=True)
    low, high = np.where(side[crossing[0]], places.reshape(2, -1)[::-1], places.reshape(2, -1))
    graph = csr_array((np.ones(low.size, bool), (low, high)), shape=(ends.size, ends.size))
    partner = maximum_bipartite_matching(graph, perm_type="column")
    mate = np.full(ends.size, -1)
    mate[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    covers = []
    for mine, to, back, there in ((~side[ends], partner, mate, graph), (side[ends], mate, partner, graph.T.tocsr())):
        reached = _alternating_reach(there, back, mine & (to < 0))
        cover = np.zeros(side.size, bool)
        cover[ends] = mine != reached
        covers.append(cover)
    return covers


def _alternating_reach(graph: csr_array, mate: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Unknowns on alternating paths from ``start``: any edge to the other side, the matched edge back."""
    reached, frontier = start.copy(), np.flatnonzero(start)
    while frontier.size:
        beyond = np.unique(graph[frontier].indices)
        beyond = beyond[~reached[beyond]]
        reached[beyond] = True
        frontier = mate[beyond][mate[beyond] >= 0]
        reached[frontier] = True
    return reached
