"""Whether vertices are those of a simple polygon: one whose sides meet at shared corners only."""

import numpy as np

from ..budget import require
from .plane_vectors import cross, segment_distance

TOLERANCE = 1e-9
"""Points this close to the rim, relative to the domain's diagonal, count as being on it."""

BLOCK = 1 << 20
"""Largest number of pairs, of a point and a side or of two sides, that are compared at once: this bounds memory."""


def require_polygon(points: np.ndarray) -> None:
    """Raise ValueError unless these are three or more finite vertices (n, 2) of a simple polygon."""
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
        raise ValueError(f"Polygon: vertices have shape {points.shape}; give three or more (x, y) pairs")
    if not np.all(np.isfinite(points)):
        row = int(np.flatnonzero(~np.isfinite(points).all(1))[0])
        raise ValueError(f"Polygon: vertex {row} is {points[row]}; give finite metres")
    require("corners", len(points), "Polygon")
    _require_simple(points)


def _require_simple(points: np.ndarray) -> None:
    """Raise ValueError for a rim that meets itself: two sides that share more than one corner."""
    tolerance = TOLERANCE * float(np.linalg.norm(np.ptp(points, axis=0)))
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    if np.any(steps <= tolerance):
        row = int(np.argmin(steps))
        raise ValueError(
            f"Polygon: vertices {row} and {(row + 1) % len(points)} coincide at {points[row]}; "
            "remove one (the last vertex need not repeat the first)"
        )
    first, second = _meeting_sides(points, tolerance)
    if len(first):
        raise ValueError(
            f"Polygon: the sides from vertices {first[0]} and {second[0]} meet; "
            "give the corners in order along the rim, without crossing or touching"
        )


def _meeting_sides(points: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of sides that cross, touch or fold back on each other; the numbers of both sides, (pairs,) each."""
    n = len(points)
    first, second = _close_sides(points, tolerance)
    distance = segment_distance(points[first], points[(first + 1) % n], points[second], points[(second + 1) % n])
    neighbours = (second == first + 1) | ((first == 0) & (second == n - 1))
    meet = np.where(neighbours, _folds_back(points, first, second), distance <= tolerance)
    return first[meet], second[meet]


def _close_sides(points: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of sides, the lower number first, whose bounding boxes meet."""
    n, ends = len(points), np.stack([points, np.roll(points, -1, axis=0)])
    low, high = ends.min(0) - tolerance, ends.max(0) + tolerance
    rows = max(1, BLOCK // n)
    found = []
    for start in range(0, n, rows):
        part = slice(start, start + rows)
        meets = ((low[part, None] <= high) & (low <= high[part, None])).all(-1)
        found.append(np.argwhere(np.triu(meets, start + 1)) + np.array([start, 0]))
    first, second = np.concatenate(found).T
    return first, second


def _folds_back(points: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether two sides that share a corner run back over each other."""
    sides = np.roll(points, -1, axis=0) - points
    a, b = sides[first], sides[second]
    scale = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.asarray((np.abs(cross(a, b)) <= TOLERANCE * scale) & ((a * b).sum(1) < 0))
