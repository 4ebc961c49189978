"""The pads: from the pressure on the sheet to the gage pressure in each pad."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects import AbstractPadEffect, fold
from ..skin.description import Skin
from .discretisation import Model

CUTS_PER_SIDE = 8
"""Sides of a triangle are cut into this many parts: samples resolve triangles that the outline of a pad crosses."""


def pad_response(skin: Skin, model: Model) -> Float[Array, "pads elements"]:
    """Gage pressure in each pad per unit of pressure on each element, without unit.

    An ideal pad feels the load on its footprint divided by its area; the scene's pad effects change
    the response to each place.  ``pad_response(skin, model) @ pressure`` is (pads,) Pa.
    """
    corners = np.asarray(model.chart, float)[np.asarray(model.triangles)]
    centres = corners.mean(1)
    radii = np.linalg.norm(corners - centres[:, None], axis=-1).max(1)
    coverage, distance = [], []
    for pad in skin.pads:
        outline = pad.polygon
        distance.append(outline.boundary_distance(centres))
        covered = outline.contains(centres).astype(float)
        cut = np.flatnonzero(distance[-1] <= radii + outline.tolerance)  # others lie on one side of the outline
        samples = np.einsum("sc,ecd->esd", _barycentric(CUTS_PER_SIDE), corners[cut])
        covered[cut] = outline.contains(samples.reshape(-1, 2)).reshape(samples.shape[:2]).mean(1)
        coverage.append(covered / pad.area)
    shape = (len(skin.pads), len(corners))
    felt = jnp.asarray(np.reshape(coverage, shape), model.dtype) * model.areas
    places_in = jnp.asarray(np.reshape(distance, shape), model.dtype)
    response: Array = felt * fold(model.effects, AbstractPadEffect, jnp.ones_like(felt), places_in)
    return response


def _barycentric(cuts: int) -> np.ndarray:
    """Centroids of a triangle's cuts^2 congruent parts, (cuts^2, 3) barycentric."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(cuts) for j in range(cuts - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(cuts - 1) for j in range(cuts - 1 - i)]
    xy = np.array(up + down) / cuts
    return np.column_stack([1 - xy.sum(1), xy])
