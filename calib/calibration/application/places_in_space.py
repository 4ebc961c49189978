"""Where pixels and pads of a skin lie in space, by the surface that the sheet is laid on."""

import numpy as np
from jaxtyping import Float

import jaxeit as je
from jaxeit.geometry import AbstractSurface, Plane

_STEP = 1e-5
"""m, of the differences that give tangents: on a radius of 10 mm the direction errs by 1e-7."""


def points_in_space(
    surface: AbstractSurface | None, chart: Float[np.ndarray, "n 2"], used: np.ndarray | None = None
) -> Float[np.ndarray, "n 3"]:
    """Places of points of the sheet in space, m; a skin without a surface lies in the plane z = 0.

    Args:
        used: the points to place (n,) bool; others are NaN, because a surface may not reach beyond the sheet.
    """
    used = np.ones(len(chart), bool) if used is None else used
    points = np.full((len(chart), 3), np.nan)
    points[used] = (surface or Plane())(np.asarray(chart, float)[used])
    return points


def normals_in_space(surface: AbstractSurface | None, chart: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Normals of length one, the cross product of the tangents along x and y of the sheet.

    They point away from the inside of a cylinder or sphere, and along z for a flat sheet.
    """
    chart = np.asarray(chart, float)
    along = [
        points_in_space(surface, chart + step) - points_in_space(surface, chart - step) for step in _STEP * np.eye(2)
    ]
    normals = np.cross(*along)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def pad_centres(skin: je.Skin) -> Float[np.ndarray, "pads 2"]:
    """Centroids of the pads' outlines in the sheet's flat coordinates, m."""
    outlines = [pad.polygon for pad in skin.pads]
    return np.array([outline.centroid for outline in outlines]).reshape(-1, 2)
