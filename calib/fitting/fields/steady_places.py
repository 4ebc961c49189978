"""Places of presses without the errors of single images, from the places that the stage reports.

A field over places that err is too flat wherever presses lie close together: presses on one line of a grid seem to lie
at several distances from a wall, and their forces are alike. Between the lines the field is then too large. A field is
therefore fitted to the place where the images show presses at a stage's place *on average*: forces predicted at the
place of a single image then err at random only (regression calibration; Carroll et al. 2006, Measurement Error in
Nonlinear Models, ch. 4).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

import jaxeit as je

from ...presses.streams import robust_deviation
from ..curves.samples import by_rows
from . import Geometry, Places
from .base import cubic_bspline
from .geometry import distance, nearest_points

# Width (m) and number of B-splines, over octaves of distance from the rim, of the bias of images towards the middle.
RIM_WIDTH, RIM_BUMPS = 8e-3, 3
# Largest scatter (m) of single places about their average; with more, the average of a field over them differs from
# the field at their average.
MAX_SCATTER = 2e-3
# Least shift of all places, over the scatter of single ones, that counts as an error of the stage. Errors of
# neighbouring places are correlated, so that a smaller shift is not significant.
MIN_SHIFT_RATIO = 0.5
MIN_SCATTER = 1e-6  # m; exact places scatter by rounding only
TRIM_DEVIATIONS = 5.0  # largest error of a place that is fitted, over the scatter
MIN_PRESSES = 10  # single contacts; fewer determine no average
ITERATIONS = 3  # of fits of the average, each without the outliers of the one before


def steady_places(geometry: Geometry, places: Places, stage: Float[np.ndarray, "presses 2"]) -> Places | None:
    """Places of presses as images show them on average; None where images err too much, or presses are too few.

    Args:
        places: of the presses, by their images. Presses with several contacts keep them.
        stage: places that the stage reports, m; NaN: not known.
    """
    position = np.array(places.position, float)
    present = np.isfinite(position).all(-1)
    contact = present.argmax(1)
    single = (present.sum(1) == 1) & np.isfinite(stage).all(1)
    if single.sum() < MIN_PRESSES:
        return None
    image = np.take_along_axis(position, contact[:, None, None], 1)[:, 0]
    average, scatter = _fit_average(geometry, stage, image, single)
    if scatter > MAX_SCATTER:
        return None
    rows = np.flatnonzero(single)
    position[rows, contact[rows]] = average[rows]
    found: Places = eqx.tree_at(lambda p: p.position, places, jnp.asarray(position, places.position.dtype))
    return found


def _fit_average(
    geometry: Geometry, stage: np.ndarray, image: np.ndarray, use: Bool[np.ndarray, " presses"]
) -> tuple[np.ndarray, float]:
    """Average places (presses, 2) of images, and the scatter of a coordinate of single images about them, m."""
    features, kept = by_rows(_rim_features, np.where(use[:, None], stage, 0), before=(geometry,)), use
    error = np.where(use[:, None], image - stage, 0)
    for _ in range(ITERATIONS):
        coefficients = np.linalg.lstsq(features[kept].reshape(-1, RIM_BUMPS), error[kept].ravel(), rcond=None)[0]
        average = features @ coefficients
        shift = np.median((error - average)[kept], 0)
        scatter = robust_deviation((error - average - shift)[kept])
        if np.linalg.norm(shift) > MIN_SHIFT_RATIO * scatter:
            average = average + shift
        kept = use & (np.linalg.norm(error - average, axis=1) <= TRIM_DEVIATIONS * max(scatter, MIN_SCATTER))
    return stage + average, scatter


@je.verb
def _rim_features(geometry: Geometry, place: Float[ArrayLike, "presses 2"]) -> Float[Array, "presses 2 bumps"]:
    """Bumps of the distance to each of the two nearest sides of the rim, times the direction away from the side."""
    point = jnp.asarray(place, geometry.rim.dtype)[:, None]
    on_rim = nearest_points(point[:, 0], geometry.rim[:, 0], geometry.rim[:, 1])
    nearest = jnp.argsort(distance(on_rim, point), 1)[:, :2]
    near = jnp.take_along_axis(on_rim, nearest[..., None], 1)
    metres = distance(near, point)[..., None]
    inward = (point - near) / jnp.where(metres > 0, metres, 1)
    bumps = cubic_bspline(jnp.log2(1 + metres / RIM_WIDTH) - jnp.arange(RIM_BUMPS, dtype=point.dtype))
    return jnp.einsum("psd,psb->pdb", inward, bumps)
