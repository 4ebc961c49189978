"""Symbolic multifrontal factorisation, on the host: the place of every number.

Each node of the dissection tree has a *front*, a small dense matrix over its own unknowns (pivots)
and those of its ancestors that its elimination will fill (boundary).  Eliminating the pivots leaves
an update of the boundary, which is added into the parent's front (Duff and Reid 1983).

All fronts of one tree level are padded to one shape: p pivots and b boundary places, of which the
last is always padding.  Padded pivots carry a one on the diagonal, and padded boundary rows zeros.
"""

from dataclasses import dataclass

import numpy as np

from ..base import SparsityPattern


@dataclass(frozen=True, eq=False)
class Level:
    """One level of m fronts; each has two children on the level below, except the leaves.

    | meaning                                                              | shape       |
    |----------------------------------------------------------------------|-------------|
    | pivots: unknown at each pivot place, n where padded                  | (m, p)      |
    | up: place of each boundary unknown in the parent's front             | (m, b)      |
    | down: place of each unknown in each of 2 or 0 children's boundaries   | (m, c, p+b) |
    | entries: number of the entry at each place in the rows of the pivots; | (m, p, p+b) |
    |   nnz where there is none, nnz + 1 on the diagonal of padded pivots  |             |
    """

    pivots: np.ndarray
    up: np.ndarray
    down: np.ndarray
    entries: np.ndarray


class _Tree:
    """The dissection tree: level and index of the front that owns each unknown."""

    def __init__(self, owner: np.ndarray, depth: int) -> None:
        self.level = np.frexp(owner.astype(float))[1] - 1  # the floor of log2, which np.log2 may round up
        self.index = owner - (1 << self.level)
        self.rank, self.pivots = self._ranked(depth)

    def _ranked(self, depth: int) -> tuple[np.ndarray, list[np.ndarray]]:
        """Place of each unknown among its front's pivots, and for each level the unknown at each place."""
        rank, tables = np.zeros(self.level.size, np.int64), []
        for level in range(depth + 1):
            mine = np.flatnonzero(self.level == level)
            mine = mine[np.argsort(self.index[mine], kind="stable")]
            rank[mine], size = _ranks(self.index[mine], 1 << level)
            table = np.full((1 << level, size), rank.size)
            table[self.index[mine], rank[mine]] = mine
            tables.append(table)
        return rank, tables


def _ranks(groups: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """Position of each element within its (sorted) group, and the size of the largest group."""
    sizes = np.bincount(groups, minlength=count)
    first = np.cumsum(sizes) - sizes
    return np.arange(groups.size) - first[groups], int(sizes.max(initial=0))


class _Boundaries:
    """Boundary lists of one level as sorted keys, front * n + unknown; `find` gives the place of an unknown."""

    def __init__(self, fronts: np.ndarray, unknowns: np.ndarray, count: int, n: int) -> None:
        self.n, self.keys = n, np.unique(fronts * n + unknowns)
        self.fronts, self.unknowns = np.divmod(self.keys, n)
        self.rank, largest = _ranks(self.fronts, count)
        self.size = largest + 1

    def find(self, fronts: np.ndarray, unknowns: np.ndarray) -> np.ndarray:
        return np.asarray(self.rank[np.searchsorted(self.keys, fronts * self.n + unknowns)])


def lay_out(pattern: SparsityPattern, owner: np.ndarray, depth: int) -> tuple[Level, ...]:
    """Levels, from the root down, of the tree of this depth with heap numbers `owner`."""
    tree = _Tree(owner, depth)
    bounds = _boundaries(pattern, tree)
    ups = [_parent_rows(tree, bounds, level) for level in range(len(bounds))]
    entries = _entries(pattern, tree, bounds)
    return tuple(
        Level(tree.pivots[level], ups[level], _child_rows(tree, bounds, ups, level), entries[level])
        for level in range(len(bounds))
    )


def _boundaries(pattern: SparsityPattern, tree: _Tree) -> list[_Boundaries]:
    """Boundaries of all fronts, bottom up: unknowns coupled by entries, and unknowns that children pass up."""
    n, below = pattern.n, np.concatenate([pattern.rows, pattern.cols])
    above = np.concatenate([pattern.cols, pattern.rows])
    upward = tree.level[above] < tree.level[below]
    below, above = below[upward], above[upward]
    handed = np.zeros((2, 0), np.int64)
    found: list[_Boundaries] = []
    for level in reversed(range(len(tree.pivots))):
        mine = tree.level[below] == level
        direct = np.stack([tree.index[below[mine]], above[mine]])
        fronts, unknowns = np.concatenate([direct, handed], 1)
        found.append(_Boundaries(fronts, unknowns, 1 << level, n))
        handed = _passed_up(tree, found[-1], level)
    return found[::-1]


def _passed_up(tree: _Tree, bound: _Boundaries, level: int) -> np.ndarray:
    """Boundary unknowns that the parents do not eliminate, with the parents' indices."""
    keep = tree.level[bound.unknowns] < level - 1
    unknowns = bound.unknowns[keep]
    if not unknowns.size:
        return np.zeros((2, 0), np.int64)
    return np.stack([bound.fronts[keep] >> 1, unknowns])


def _front_size(tree: _Tree, bounds: list[_Boundaries], level: int) -> int:
    return int(tree.pivots[level].shape[1] + bounds[level].size)


def _parent_rows(tree: _Tree, bounds: list[_Boundaries], level: int) -> np.ndarray:
    bound = bounds[level]
    if level == 0:
        return np.zeros((1, bound.size), np.int64)
    last = _front_size(tree, bounds, level - 1) - 1
    table = np.full((1 << level, bound.size), last)
    table[bound.fronts, bound.rank] = _place(tree, bounds, level - 1, bound.fronts >> 1, bound.unknowns)
    return table


def _place(tree: _Tree, bounds: list[_Boundaries], level: int, fronts: np.ndarray, unknowns: np.ndarray) -> np.ndarray:
    """Place of unknowns in fronts of a level: among the pivots, or behind them in the boundary."""
    place: np.ndarray = tree.rank[unknowns]
    outside = tree.level[unknowns] < level
    found = bounds[level].find(fronts[outside], unknowns[outside])
    place[outside] = tree.pivots[level].shape[1] + found
    return place


def _child_rows(tree: _Tree, bounds: list[_Boundaries], ups: list[np.ndarray], level: int) -> np.ndarray:
    """The inverse of the children's `up`; an unknown that a child lacks points to its padding."""
    fronts, size = 1 << level, _front_size(tree, bounds, level)
    if level + 1 == len(bounds):
        return np.zeros((fronts, 0, size), np.int64)
    child = bounds[level + 1]
    table = np.full((2 << level, size), child.size - 1)
    table[child.fronts, ups[level + 1][child.fronts, child.rank]] = child.rank
    return table.reshape(fronts, -1, size)


def _entries(pattern: SparsityPattern, tree: _Tree, bounds: list[_Boundaries]) -> list[np.ndarray]:
    """Number of the entry at each place; an entry is in the row of the one of its unknowns that is eliminated first."""
    first, second = _elimination_order(pattern, tree)
    tables = []
    for level, pivots in enumerate(tree.pivots):
        mine = np.flatnonzero(tree.level[first] == level)
        front, row = tree.index[first[mine]], tree.rank[first[mine]]
        column = _place(tree, bounds, level, front, second[mine])
        table = np.full((*pivots.shape, _front_size(tree, bounds, level)), first.size)
        table[front, row, column] = mine
        padded, place = np.nonzero(pivots == pattern.n)
        table[padded, place, place] = first.size + 1
        tables.append(table)
    return tables


def _elimination_order(pattern: SparsityPattern, tree: _Tree) -> tuple[np.ndarray, np.ndarray]:
    rows, cols = pattern.rows, pattern.cols
    level, rank = tree.level, tree.rank
    swap = (level[rows] > level[cols]) | ((level[rows] == level[cols]) & (rank[rows] < rank[cols]))
    return np.where(swap, rows, cols), np.where(swap, cols, rows)
