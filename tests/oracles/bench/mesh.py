"""A triangulation of the sheet: rings around every bolt, a hexagonal lattice between them, Delaunay's triangles."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import Delaunay

from .skin import Skin

AROUND = 24
INWARD = (0.05e-3, 0.13e-3, 0.3e-3, 0.8e-3)
"""Distances of rings inside the rim, m: the current enters within about 0.1 mm of the rim."""
OUTWARD = (0.4e-3, 1.0e-3, 2.0e-3)


class Mesh(NamedTuple):
    """Points (n, 2); triangles (t, 3), counter-clockwise; the bolt over each triangle or -1, (t,)."""

    points: np.ndarray
    triangles: np.ndarray
    bolt: np.ndarray


def make_mesh(skin: Skin, bolts: np.ndarray, spacing: float = 2e-3) -> Mesh:
    """Mesh with a polygon for each bolt, at ``bolts`` (m); ``spacing`` of the lattice between the bolts."""
    # A polygon of the circle's own area stands for the circle.
    turn = 2 * np.pi / AROUND
    rim = skin.radius * np.sqrt(turn / np.sin(turn))
    radii = np.concatenate([rim - np.array(INWARD), [rim], rim + np.array(OUTWARD)])
    local = np.concatenate([_ring(radii), _ring(np.array([0.4 * rim]), AROUND // 4), [[0.0, 0.0]]])
    lattice = _lattice(skin.size, spacing)
    apart = np.linalg.norm(lattice[:, None] - bolts, axis=-1).min(1)
    points = np.concatenate([(bolts[:, None] + local).reshape(-1, 2), lattice[apart > radii.max() + 0.6 * spacing]])
    triangles = _triangles(points)
    centres = points[triangles].mean(1)
    distance = np.linalg.norm(centres[:, None] - bolts, axis=-1)
    nearest = distance.argmin(1)
    inside = distance.min(1) < rim * np.cos(turn / 2)
    return Mesh(points, triangles, np.where(inside, nearest, -1))


def _ring(radii: np.ndarray, count: int = AROUND) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return (radii[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)).reshape(-1, 2)


def _lattice(size: np.ndarray, spacing: float) -> np.ndarray:
    """Rows of points, every other row shifted by half a spacing; the rim has points too."""
    rows = round(size[1] / (spacing * np.sqrt(0.75)))
    columns = round(size[0] / spacing)
    even = np.linspace(0, size[0], columns + 1)
    odd = np.concatenate([[0], 0.5 * (even[1:] + even[:-1]), [size[0]]])
    heights = np.linspace(0, size[1], rows + 1)
    return np.concatenate([np.stack([x := odd if k % 2 else even, np.full(len(x), y)], 1)
                           for k, y in enumerate(heights)])  # fmt: skip


def _triangles(points: np.ndarray) -> np.ndarray:
    found = Delaunay(points).simplices
    size = doubled_areas(points[found])
    found = np.where(size[:, None] < 0, found[:, ::-1], found)
    return found[np.abs(size) > 1e-12]  # points in a line on the rim leave triangles of no area


def doubled_areas(corners: np.ndarray) -> np.ndarray:
    """Twice the signed area of triangles (t, 3, 2)."""
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    return ax * by - ay * bx
