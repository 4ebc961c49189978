"""From a cloud of nodes to a good triangulation: Delaunay, relaxation, repair.

Free nodes move to the weighted mean of their triangles' circumcentres (optimal Delaunay
triangulation, Chen and Holst 2011), nodes that crowd are removed and gaps are filled, and last
the nodes of the poorest triangles are moved, each to the place at which the smallest angle around it is largest.
Triangles are (m, 3) indices, counter-clockwise; points are (n, 2) m with the fixed ones first.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import Delaunay, cKDTree

from ..geometry.plane_vectors import cross
from ..geometry.shapes import Domain
from .sizes import SizeField, thin

GOOD_ANGLE = 30.0
"""Smallest angle, degrees, above which a mesh is not improved further."""

WEIGHT_POWER = 3
"""Power p in the weight area / size^p of a triangle, by which small and large triangles count alike."""

MAX_CIRCUMRADIUS = 0.85
"""Largest circumradius, over the wanted edge length; a triangle with a larger one gets a new node."""

MIN_MEAN_EDGE = 0.72
"""Smallest mean edge of a node, over the wanted edge length; a node with a smaller one is removed."""

ROUNDS, SWEEPS, POLISHES = 3, 2, 8


@dataclass(frozen=True, eq=False)
class SmoothingConstraints:
    """The constraints on `relax`.

    | meaning                                                      | shape  | unit |
    |--------------------------------------------------------------|--------|------|
    | fixed: nodes that stay                                       | (f, 2) | m    |
    | rim, rings: edges between fixed nodes that must appear       | (., 2) |      |
    | open_to: whether a free node may start at each of points     | (n, 2) -> (n,) | |
    """

    domain: Domain
    size: SizeField
    fixed: np.ndarray
    rim: np.ndarray
    rings: np.ndarray
    open_to: Callable[[np.ndarray], np.ndarray]


class Triangulation(NamedTuple):
    """Points (n, 2) m, triangles (m, 3), and their `quality`: the smallest angle, degrees."""

    angle: float
    points: np.ndarray
    triangles: np.ndarray


def relax(problem: SmoothingConstraints, free: np.ndarray) -> Triangulation:
    """The best triangulation found, starting from the free nodes (n, 2) m."""
    points = np.concatenate([problem.fixed, free])
    triangles = delaunay(points, problem.domain)
    best = Triangulation(quality(problem, points, triangles), points, triangles)
    for _ in range(ROUNDS):
        points = _adapt(problem, points, triangles)
        triangles = delaunay(points, problem.domain)
        for _ in range(SWEEPS):
            points = _sweep(problem, points, triangles)
            triangles = delaunay(points, problem.domain)
            best = better(best, Triangulation(quality(problem, points, triangles), points, triangles))
        if best.angle >= GOOD_ANGLE:
            break
    return _polish(problem, *best)


def better(one: Triangulation, other: Triangulation) -> Triangulation:
    """That of larger angles, the first if they are alike."""
    return other if other.angle > one.angle else one


def quality(problem: SmoothingConstraints, points: np.ndarray, triangles: np.ndarray) -> float:
    """Smallest angle in degrees, or -1 where an edge of the rim or of a ring is missing."""
    if len(missing_edges(problem, triangles)):
        return -1.0
    return float(corner_angles(points[triangles]).min())


def missing_edges(problem: SmoothingConstraints, triangles: np.ndarray) -> np.ndarray:
    """Edges (k, 2) of the rim and the rings that no triangle has, and edges of the rim with
    triangles outside the domain."""
    directed = directed_edges(triangles)
    # Edges that must appear join fixed nodes, so that only such edges are compared.
    present = edge_keys(directed[(directed < len(problem.fixed)).all(1)])
    wanted = np.concatenate([problem.rim, problem.rings])
    absent = wanted[~np.isin(edge_keys(wanted), present)]
    crossed = problem.rim[np.isin(edge_keys(problem.rim[:, ::-1]), present)]
    return np.concatenate([absent, crossed])


def edge_keys(edges: np.ndarray) -> np.ndarray:
    """One int64 per directed edge (n, 2), unequal for unequal edges."""
    return np.asarray((edges[:, 0].astype(np.int64) << 32) | edges[:, 1])


def delaunay(points: np.ndarray, domain: Domain) -> np.ndarray:
    """Delaunay triangles (m, 3) inside the domain, counter-clockwise."""
    low, high = np.asarray(domain.bounds)
    scaled = (points - 0.5 * (low + high)) / (high - low).max()
    triangles = Delaunay(scaled).simplices
    doubled = doubled_areas(points[triangles])
    triangles[doubled < 0] = triangles[doubled < 0][:, [0, 2, 1]]
    longest = np.linalg.norm(_sides(points[triangles]), axis=2).max(1)
    # Rounding leaves slivers along straight sides; on a convex domain no other triangle is dropped.
    triangles = triangles[np.abs(doubled) > 1e-6 * longest**2]
    if domain.is_convex:
        return np.asarray(triangles)
    return np.asarray(triangles[domain.contains(points[triangles].mean(1))])


def doubled_areas(corners: np.ndarray) -> np.ndarray:
    """Twice the signed areas of plane triangles, corners (m, 3, 2) m; (m,) m^2."""
    return cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def corner_angles(corners: np.ndarray) -> np.ndarray:
    """Angles in degrees at the corners (..., 3, 2 or 3) of triangles in the plane or in space."""
    sides = _sides(corners)
    lengths = np.linalg.norm(sides, axis=-1)
    product = lengths * np.roll(lengths, 1, axis=-1)
    cosine = -(sides * np.roll(sides, 1, axis=-2)).sum(-1) / np.where(product > 0, product, 1.0)
    return np.where(product > 0, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))), 0.0)


def directed_edges(triangles: np.ndarray) -> np.ndarray:
    """The three edges of every triangle, along its orientation; (3 m, 2) int64."""
    pairs = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1)
    return pairs.reshape(-1, 2).astype(np.int64)


def _sides(corners: np.ndarray) -> np.ndarray:
    return np.asarray(np.roll(corners, -1, axis=-2) - corners)


def _circles(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Circumcentres (m, 2) and circumradii (m,) of plane triangles (m, 3, 2)."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    uu, vv = (u * u).sum(1, keepdims=True), (v * v).sum(1, keepdims=True)
    towards = np.stack([v[:, 1], -v[:, 0]], -1) * uu - np.stack([u[:, 1], -u[:, 0]], -1) * vv
    offset = towards / (2 * cross(u, v))[:, None]
    return corners[:, 0] + offset, np.linalg.norm(offset, axis=1)


def _sweep(problem: SmoothingConstraints, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """One step of every free node to the weighted mean of its triangles' circumcentres."""
    corners = points[triangles]
    centroids = corners.mean(1)
    centres, radii = _circles(corners)
    # The circumcentre of a flat triangle is far away; the limit keeps nodes from leaving their surroundings.
    pull = centres - centroids
    length = np.linalg.norm(pull, axis=1)
    pull *= np.minimum(1.0, 0.5 * radii / np.maximum(length, 1e-300))[:, None]
    weights = doubled_areas(corners) / problem.size(centroids) ** WEIGHT_POWER
    moved = _vertex_means(triangles, centroids + pull, weights, len(points))
    moved[: len(problem.fixed)] = problem.fixed
    return moved


def _vertex_means(triangles: np.ndarray, values: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Weighted mean of triangle values (m, 2) around each of ``count`` nodes."""
    at, repeated = triangles.ravel(), np.repeat(weights, 3)
    total = np.bincount(at, repeated, count)
    sums = [np.bincount(at, repeated * np.repeat(v, 3), count) for v in values.T]
    return np.stack(sums, -1) / np.where(total > 0, total, 1.0)[:, None]


def _adapt(problem: SmoothingConstraints, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The points without crowded or misplaced free nodes, and with new nodes in gaps."""
    new = _gap_nodes(problem, points, triangles)
    keep = ~_crowded(problem, points, triangles) & ~_misplaced(problem, points)
    return np.concatenate([points[keep], new])


def _gap_nodes(problem: SmoothingConstraints, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corners = points[triangles]
    centroids = corners.mean(1)
    wanted = problem.size(centroids)
    excess = _circles(corners)[1] / wanted
    wide = np.flatnonzero((excess > MAX_CIRCUMRADIUS) & problem.open_to(centroids))
    wide = wide[np.argsort(-excess[wide], kind="stable")]
    return thin(centroids[wide], points, 0.5 * wanted[wide])


def _crowded(problem: SmoothingConstraints, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Free nodes whose mean edge is too short or that have four edges or fewer, no two of them
    neighbours; (n,) bool."""
    start, stop = directed_edges(triangles).T
    length = np.linalg.norm(points[stop] - points[start], axis=1)
    relative = length / problem.size(0.5 * (points[start] + points[stop]))
    degree = np.bincount(start, minlength=len(points))
    mean = np.bincount(start, relative, len(points)) / np.maximum(degree, 1)
    wanted = (mean < MIN_MEAN_EDGE) | (degree <= 4)
    wanted[: len(problem.fixed)] = False
    return _independent(wanted, mean, triangles)


def _independent(wanted: np.ndarray, order: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A subset of the ``wanted`` nodes, lowest ``order`` first, with no two in one triangle."""
    start, stop = directed_edges(triangles).T
    chosen, blocked = np.zeros(len(wanted), bool), np.zeros(len(wanted), bool)
    around = wanted[start] | wanted[stop]
    start, stop = start[around], stop[around]
    edges = np.concatenate([np.stack([start, stop]), np.stack([stop, start])], axis=1)
    edges = edges[:, np.argsort(edges[0], kind="stable")]
    first = np.searchsorted(edges[0], np.arange(len(wanted) + 1))
    candidates = np.flatnonzero(wanted)
    for node in candidates[np.argsort(order[candidates], kind="stable")]:
        if not blocked[node]:
            chosen[node] = True
            blocked[edges[1, first[node] : first[node + 1]]] = True
    return chosen


def _misplaced(problem: SmoothingConstraints, points: np.ndarray) -> np.ndarray:
    """Free nodes outside the domain or so near to an edge that must appear that they block it; (n,) bool."""
    fixed = len(problem.fixed)
    astray = np.zeros(len(points), bool)
    if len(points) == fixed:
        return astray
    astray[fixed:] = ~problem.domain.contains(points[fixed:])
    ends = problem.fixed[np.concatenate([problem.rim, problem.rings])]
    reach = 0.45 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    near = cKDTree(points[fixed:]).query_ball_point(ends.mean(1), reach)
    hit = np.concatenate([np.asarray(n, int) for n in near])
    astray[fixed + hit] = True
    return astray


def _polish(problem: SmoothingConstraints, angle: float, points: np.ndarray, triangles: np.ndarray) -> Triangulation:
    """Raise the smallest angles by moving single nodes; the smallest angle never decreases."""
    for _ in range(POLISHES):
        if angle >= GOOD_ANGLE:
            break
        moved = points
        for reach in (0.3, 0.15, 0.08, 0.04):
            moved = _improve_stars(moved, triangles, len(problem.fixed), reach)
        flipped = delaunay(moved, problem.domain)
        trial = quality(problem, moved, flipped)
        if trial <= angle:
            break
        angle, points, triangles = trial, moved, flipped
    return Triangulation(angle, points, triangles)


def _improve_stars(points: np.ndarray, triangles: np.ndarray, fixed: int, reach: float) -> np.ndarray:
    """Move free nodes of poor triangles, no two in one triangle, to the best of eight places at
    ``reach`` times their mean edge, if that raises the smallest angle around them."""
    smallest = corner_angles(points[triangles]).min(1)
    worst = np.full(len(points), 180.0)
    np.minimum.at(worst, triangles.ravel(), np.repeat(smallest, 3))
    wanted = worst < GOOD_ANGLE + 1
    wanted[:fixed] = False
    nodes = np.flatnonzero(_independent(wanted, worst, triangles))
    return _best_places(points, triangles, nodes, reach) if len(nodes) else points


def _best_places(points: np.ndarray, triangles: np.ndarray, nodes: np.ndarray, reach: float) -> np.ndarray:
    row, corner = np.nonzero(np.isin(triangles, nodes))
    order = np.argsort(triangles[row, corner], kind="stable")
    row, corner = row[order], corner[order]
    own = np.searchsorted(nodes, triangles[row, corner])
    others = points[triangles[row[:, None], (corner[:, None] + [1, 2]) % 3]]
    starts = np.searchsorted(own, np.arange(len(nodes)))
    radius = np.linalg.norm(others - points[nodes[own], None], axis=2).mean(1)
    radius = reach * np.add.reduceat(radius, starts) / np.bincount(own)
    turn = np.arange(8) * (np.pi / 4)
    offsets = np.concatenate([np.zeros((1, 2)), np.stack([np.cos(turn), np.sin(turn)], -1)])
    places = points[nodes] + offsets[:, None] * radius[:, None]
    angles = np.stack([_star_angles(p, own, others, starts) for p in places])
    moved = points.copy()
    moved[nodes] = places[angles.argmax(0), np.arange(len(nodes))]
    return moved


def _star_angles(places: np.ndarray, own: np.ndarray, others: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Smallest angle, degrees, around each node at ``places`` (k, 2) m; -1 where a triangle flips."""
    corners = np.concatenate([places[own, None], others], axis=1)
    angles = np.where(doubled_areas(corners) > 0, corner_angles(corners).min(1), -1.0)
    return np.minimum.reduceat(angles, starts)
