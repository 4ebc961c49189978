"""Nested dissection of a graph, on the host: which unknown belongs to which separator.

The unknowns are halved at the median of a coordinate; those of one half that touch the other form
a separator, and each half is treated alike (George 1973).  All parts of one depth are cut together,
so the work is a few sorts per depth.  The result is a complete binary tree in heap numbering: 1 is
the root separator, 2 t and 2 t + 1 are the halves below t, and the deepest nodes are the leaves.
"""

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra, maximum_bipartite_matching

from ._base import Pattern


def dissect(pattern: Pattern, leaf_size: int) -> tuple[np.ndarray, int]:
    """The tree node that owns each unknown, (n,), and the depth of the tree (0: the root only).

    Unknowns of `Pattern.root` or without a place are owned by the root.
    """
    coords, placed = _places(pattern)
    depth = _depth(int(np.count_nonzero(placed)), leaf_size)
    edges = np.stack([pattern.rows, pattern.cols])[:, pattern.rows != pattern.cols]
    part = np.ones(pattern.n, np.int64)
    free = placed.copy()
    for _ in range(depth):
        edges = edges[:, free[edges].all(0) & (part[edges[0]] == part[edges[1]])]
        side, cut = _best_halves(part, free, coords, edges)
        free &= ~cut
        part = np.where(free, 2 * part + side, part)
    return part, depth


def _depth(n: int, leaf_size: int) -> int:
    return max(0, int(np.ceil(np.log2(max(n, 1) / leaf_size))))


def _places(pattern: Pattern) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates, and which unknowns may be dissected."""
    placed = np.ones(pattern.n, bool)
    placed[pattern.root] = False
    if pattern.coords is None:
        return _graph_coordinates(pattern, placed), placed
    return pattern.coords, placed & np.isfinite(pattern.coords).all(1)


def _graph_coordinates(pattern: Pattern, placed: np.ndarray, count: int = 3) -> np.ndarray:
    """Distances along the graph from a few unknowns far from each other, (n, count).

    They stand in for coordinates where there are none.  Unknowns that cannot be reached lie at n.
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
    return np.where(np.isfinite(steps), steps, graph.shape[0])


def _best_halves(
    part: np.ndarray, free: np.ndarray, coords: np.ndarray, edges: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Side of each unknown and whether it is cut out, along each part's cheapest coordinate."""
    tries = [_halve(part, free, coords, edges, axis) for axis in range(coords.shape[1])]
    parts = int(part.max()) + 1
    costs = np.stack([np.bincount(part[cut], minlength=parts) for _, cut in tries])
    best = np.argmin(costs, axis=0)[part]
    pick = np.arange(part.size)
    sides, cuts = (np.stack(column) for column in zip(*tries, strict=True))
    return sides[best, pick], cuts[best, pick]


def _halve(
    part: np.ndarray, free: np.ndarray, coords: np.ndarray, edges: np.ndarray, axis: int
) -> tuple[np.ndarray, np.ndarray]:
    """Halve every part at the median of one coordinate (ties by the others); cut a least cover."""
    others = [coords[:, k] for k in range(coords.shape[1]) if k != axis]
    order = np.lexsort([*others, coords[:, axis], part, ~free])[: np.count_nonzero(free)]
    sizes = np.bincount(part[order], minlength=int(part.max()) + 1)
    first = np.cumsum(sizes) - sizes
    rank = np.arange(order.size) - first[part[order]]
    side = np.zeros(part.size, np.int64)
    side[order] = 2 * rank >= sizes[part[order]]
    return side, _least_cover(side, edges)


def _least_cover(side: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The fewest unknowns that touch every edge between the sides (König's theorem).

    Given a maximum matching, let Z be what alternating paths reach from the unmatched unknowns of
    side 0; the cover is side 0 without Z and side 1 within Z.
    """
    n = side.size
    crossing = edges[:, side[edges[0]] != side[edges[1]]]
    swap = side[crossing[0]] == 1
    low, high = np.where(swap, crossing[::-1], crossing)
    graph = csr_array((np.ones(low.size, bool), (low, high)), shape=(n, n))
    partner = maximum_bipartite_matching(graph, perm_type="column")
    touched = np.zeros(n, bool)
    touched[low] = True
    reached = _alternating_reach(graph, partner, touched & (partner < 0))
    cover = touched & ~reached
    cover[high] = reached[high]
    return cover


def _alternating_reach(graph: csr_array, partner: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Everything on alternating paths from start: any edge to side 1, its matched edge back."""
    mate = np.full(start.size, -1)
    matched = np.flatnonzero(partner >= 0)
    mate[partner[matched]] = matched
    reached, frontier = start.copy(), np.flatnonzero(start)
    while frontier.size:
        high = np.unique(graph[frontier].indices)
        high = high[~reached[high]]
        reached[high] = True
        frontier = mate[high][mate[high] >= 0]
        reached[frontier] = True
    return reached
