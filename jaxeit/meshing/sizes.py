"""The wanted edge length of a graded mesh as a function of position, and its initial nodes.

The wanted edge length is ``h(x) = min(cap, min_i size_i + slope * distance(x, source_i))``, so that
layers around a source grow by the factor ``1 + slope``.  Hexagonal lattices of stepped spacing fill
the plane, and a greedy pass thins them where steps meet; `smoothing` then moves the nodes.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..budget import require
from ..geometry.shapes import Domain

STEPS_PER_OCTAVE = 3
"""Lattice spacings between a length and its half."""

REACH_MARGIN = 1 + 1e-9
"""Factor on the distance up to which a source matters, for rounding."""

QUARTER_CENTRES = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) / 4
"""Centres of the four quarters of a square of side 1 around the origin, (4, 2)."""


@dataclass(frozen=True, eq=False)
class SizeField:
    """Wanted edge length as a function of position.

    | meaning                                   | shape  | unit |
    |-------------------------------------------|--------|------|
    | centres, radii of the sources             | (k, 2), (k,) | m |
    | sizes: edge length at each source's rim   | (k,)   | m    |
    | slope: growth of the size per distance    | ()     |      |
    | cap: largest edge length                  | ()     | m    |
    """

    centres: np.ndarray
    radii: np.ndarray
    sizes: np.ndarray
    slope: float
    cap: float

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Wanted edge length at points (n, 2); (n,) m."""
        # A source matters only where its size is below the cap. On a long strip that is a small part of the points,
        # which is contiguous if they are sorted along the strip.
        axis = int(np.argmax(np.ptp(points, axis=0))) if len(points) else 0
        order = np.argsort(points[:, axis], kind="stable")
        ordered, size = points[order], np.full(len(points), self.cap)
        reach = self.radii + REACH_MARGIN * (self.cap - self.sizes) / self.slope if self.slope > 0 else np.inf
        first, last = (np.searchsorted(ordered[:, axis], self.centres[:, axis] + side * reach) for side in (-1, 1))
        for i in np.flatnonzero(first < last):
            part = slice(first[i], last[i])
            away = np.hypot(*(ordered[part] - self.centres[i]).T) - self.radii[i]
            np.minimum(size[part], self.sizes[i] + self.slope * np.maximum(away, 0.0), out=size[part])
        out = np.empty_like(size)
        out[order] = size
        return out

    def level(self, size: np.ndarray) -> np.ndarray:
        """Number of the lattice whose spacing is nearest to ``size``; 0 is the coarsest."""
        return np.asarray(np.rint(np.log2(self.cap / size) * STEPS_PER_OCTAVE).astype(int))

    def spacing(self, level: int) -> float:
        """Spacing in m of the lattice of a level."""
        return float(self.cap * 2.0 ** (-level / STEPS_PER_OCTAVE))


def narrow_places(domain: Domain, cap: float, slope: float) -> tuple[np.ndarray, np.ndarray]:
    """Sources that keep edges shorter than the domain is wide: points (k, 2) and sizes (k,), m.

    Sampled along the rim, at most 4000 places; those that another source already implies are left out.
    """
    coarse = domain.clearance(_along_rim(domain, domain.perimeter / 500))
    if coarse.min() >= cap:
        return np.zeros((0, 2)), np.zeros(0)
    s = _along_rim(domain, max(0.5 * float(coarse.min()), domain.perimeter / 4000))
    size, points = domain.clearance(s), domain.boundary_point(s)
    kept = np.zeros(len(s), bool)
    for i in np.argsort(size, kind="stable"):
        away = np.linalg.norm(points[kept] - points[i], axis=1)
        implied = np.min(size[kept] + slope * away, initial=cap)
        kept[i] = size[i] < 0.9 * implied
    return points[kept], size[kept]


def _along_rim(domain: Domain, spacing: float) -> np.ndarray:
    count = int(np.ceil(domain.perimeter / spacing))
    return (np.arange(count) + 0.5) * (domain.perimeter / count)


def divide_rim(domain: Domain, fixed: np.ndarray, size: SizeField) -> np.ndarray:
    """Arc lengths (n,) of rim nodes: those ``fixed`` (k,), ascending, and graded ones between."""
    ends = fixed if len(fixed) else np.zeros(1)
    stops = np.append(ends[1:], ends[0] + domain.perimeter)
    samples = _size_samples(domain, size)
    pieces = [_divide(domain, a, b, size, samples) for a, b in zip(ends, stops, strict=True)]
    return np.concatenate(pieces)


def _size_samples(domain: Domain, size: SizeField) -> np.ndarray:
    """Ascending arc lengths over two turns that resolve the size field, which varies fastest where
    the rim passes a source: samples crowd there geometrically."""
    nearest = domain.boundary_coordinate(size.centres)[:, None]
    away = size.sizes[:, None] * np.geomspace(0.1, 1e4, 80)
    close = np.concatenate([nearest - away, nearest, nearest + away], axis=1).ravel()
    even = np.linspace(0, domain.perimeter, 2000)
    once = np.unique(np.mod(np.concatenate([close, even]), domain.perimeter))
    return np.concatenate([once, once + domain.perimeter])


def _divide(domain: Domain, start: float, stop: float, size: SizeField, samples: np.ndarray) -> np.ndarray:
    """``start`` and nodes up to, not including, ``stop``, evenly spread in the integral of 1/h."""
    inside = samples[(samples > start) & (samples < stop)]
    s = np.concatenate([[start], inside, np.linspace(start, stop, 33)[1:-1], [stop]])
    s.sort()
    per_length = 1.0 / size(domain.boundary_point(s))
    steps = 0.5 * (per_length[1:] + per_length[:-1]) * np.diff(s)
    edges_to = np.concatenate([[0.0], np.cumsum(steps)])
    # The slack makes one edge, not two, of up to 1.3 wanted edges.
    count = max(1, int(np.ceil(edges_to[-1] - 0.3)))
    require("mesh_nodes", count, "triangulate: rim")
    return np.asarray(np.interp(np.arange(count) / count * edges_to[-1], edges_to, s))


def fill(domain: Domain, size: SizeField) -> np.ndarray:
    """Candidate nodes (n, 2) m over the domain's bounding box, finest lattices first.

    Lattices start at the middle of the box, and the order depends on positions only, so that equal
    input gives equal meshes.
    """
    low, high = np.asarray(domain.bounds)
    middle = 0.5 * (low + high)
    found = list(_lattice_points(high - low, middle, size))
    points = np.concatenate([p for _, p in found])
    level = np.concatenate([np.full(len(p), k) for k, p in found])
    return points[np.lexsort((points[:, 0], points[:, 1], -level))]


def _lattice_points(extent: np.ndarray, middle: np.ndarray, size: SizeField) -> Iterator[tuple[int, np.ndarray]]:
    """Points of each lattice where its level is the wanted one: level, and points (n, 2) m."""
    for side, centres, wanted in _cells(extent, middle, size):
        reach = size.slope * side / np.sqrt(2)
        coarsest = size.level(np.minimum(wanted + reach, size.cap))
        finest = size.level(np.maximum(wanted - reach, 0.1 * wanted))
        for level in range(coarsest.min(), finest.max() + 1):
            cells = centres[(coarsest <= level) & (level <= finest)]
            points = middle + _hexagonal(cells - side / 2 - middle, side, size.spacing(level))
            yield level, points[size.level(size(points)) == level]


def _cells(extent: np.ndarray, middle: np.ndarray, size: SizeField) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
    """Leaves of a quadtree no larger than about four wanted edges: (side, centres, sizes there)."""
    side = 2.0 * size.cap
    counts = np.ceil(extent / side + 1e-9).astype(int)
    require("mesh_nodes", float(np.prod(counts, dtype=float)), "triangulate: domain")
    x, y = np.meshgrid(np.arange(counts[0]), np.arange(counts[1]))
    centres = middle + (np.stack([x, y], -1).reshape(-1, 2) - (counts - 1) / 2) * side
    while len(centres):
        wanted = size(centres)
        smallest = np.maximum(wanted - size.slope * side / np.sqrt(2), 0.1 * wanted)
        split = side > 4 * smallest
        if not split.all():
            yield side, centres[~split], wanted[~split]
        require("mesh_nodes", 4 * int(split.sum()), "triangulate: narrow places")
        centres = (centres[split][:, None] + side * QUARTER_CENTRES).reshape(-1, 2)
        side /= 2


def _hexagonal(corners: np.ndarray, side: float, spacing: float) -> np.ndarray:
    """Points of the hexagonal lattice through the origin that lie in square cells, each with its
    lower-left corner in ``corners`` (k, 2) and half open, so that neighbours share no point."""
    row, slack = spacing * np.sqrt(3) / 2, 1e-9
    j = np.ceil(corners[:, 1] / row - slack)[:, None] + np.arange(int(np.ceil(side / row)) + 1)
    shift = (j % 2) / 2
    first = np.ceil(corners[:, :1] / spacing - shift - slack)
    i = first[..., None] + np.arange(int(np.ceil(side / spacing)) + 1)
    x, y = (i + shift[..., None]) * spacing, np.broadcast_to((j * row)[..., None], i.shape)
    ends = corners[:, None, None] + side
    inside = (x < ends[..., 0] - slack * spacing) & (y < ends[..., 1] - slack * row)
    return np.asarray(np.stack([x, y], -1)[inside])


def thin(candidates: np.ndarray, fixed: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """The candidates (n, 2), in order, that keep ``radii`` (n,) m from every fixed point and from the
    candidates taken before them."""
    near = cKDTree(fixed).query(candidates)[0] if len(fixed) else np.full(len(candidates), np.inf)
    candidates, radii = candidates[near > radii], radii[near > radii]
    if not len(candidates):
        return candidates
    free = np.ones(len(candidates), bool)
    for i, around in enumerate(cKDTree(candidates).query_ball_point(candidates, radii)):
        if free[i] and len(around) > 1:
            free[around] = False
            free[i] = True
    return candidates[free]
