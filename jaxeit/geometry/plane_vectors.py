"""Vectors and segments of the plane."""

from typing import TypeVar

import numpy as np
from jaxtyping import Array

Vectors = TypeVar("Vectors", np.ndarray, Array)


def cross(a: Vectors, b: Vectors) -> Vectors:
    """z component of the cross product of plane vectors (..., 2), in NumPy or in JAX; NumPy >= 2.5 has none."""
    product: Vectors = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


def signed_area(points: np.ndarray) -> float:
    """Area of a polygon with vertices (n, 2), m^2; negative for clockwise ones."""
    # Relative to the first vertex, so that a polygon far from the origin loses no digits to cancellation.
    points = points - points[0]
    return 0.5 * float(np.sum(cross(points, np.roll(points, -1, axis=0))))


def segment_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distance of the segments a-b and c-d, row by row; 0 where they cross."""
    ends = np.stack(
        [
            _point_segment(a, c, d),
            _point_segment(b, c, d),
            _point_segment(c, a, b),
            _point_segment(d, a, b),
        ]
    ).min(0)
    crosses = (cross(b - a, c - a) * cross(b - a, d - a) < 0) & (cross(d - c, a - c) * cross(d - c, b - c) < 0)
    return np.where(crosses, 0.0, ends)


def _point_segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance of the points p from the segments a-b, row by row."""
    along = ((p - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1)
    distance: np.ndarray = np.linalg.norm(p - a - np.clip(along, 0.0, 1.0)[..., None] * (b - a), axis=-1)
    return distance
