"""Outlines of one piece as a smooth function of an angle, fitted to readings whose errors are known to be in common.

The logarithm of the radius about a centre is a sum of harmonics, ``a_0 + sum over k of a_k cos k t + b_k sin k t``, and
the piece has one height. Readings weigh as `ktc_bound` says, with the sizes of the simulated faults: what no method is
told. So the fit shows what the readings tell of arms, if all that is wrong with a tank is known but for its numbers.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import svd
from scipy.ndimage import label
from scipy.optimize import least_squares

import jaxeit as je

from .ktc_bound import INDEPENDENT, Seen, common_errors, log_odds
from .ktc_phantoms import CORNER_SHARES, GRID, INSIDE, LINE, RADIUS, RESISTIVE, WATER, Data
from .rows import Row

HARMONICS = 8
ORDER = np.arange(1.0, HARMONICS + 1)
BORDER = 0.02  # width of the border over the radius of the tank
PLACE, HEIGHT, HEIGHT_STD, SIZE, ARMS = 0.3, 2.3, 0.8, 0.6, 0.8  # before the frame is seen; ARMS / k of harmonic k
STD = np.concatenate([[PLACE, PLACE, HEIGHT_STD, SIZE], ARMS / ORDER, ARMS / ORDER])
ANGLES = np.linspace(0, 2 * np.pi, 128, endpoint=False)
RAY = np.arange(0.05, 2, 0.005)
FITS = 25  # evaluations, at most


def outlined(model: je.Model, image: je.model.BasisMap, missed: np.ndarray, data: Data, place: int) -> Row:
    """Score of the outline that is fitted from the regions of the image; log odds of the truth over it; what readings
    tell of its harmonics."""
    frame, truth = data.frames[place], data.truth[place]
    found = je.imaging.segment(model, data.reference, frame, image, borders=None, missed=missed)
    seen = Seen(model, data, frame, np.asarray(found.errors))
    sigma = np.mean(model.background) * jnp.exp(image.expand(found.image))
    outline = fitted_outline(seen, found.classes, sigma)
    scores = (np.where(INSIDE, classes[::-1], WATER) for classes in (found.classes, outline.classes))
    regions, fitted = (round(float(je.metrics.ktc_score(classes, truth)), 3) for classes in scores)
    _, common = log_odds(seen, truth, outline.sigma)
    row: Row = {"regions_score": regions, "score": fitted, "log_odds_common": round(common, 1)}
    return row | {f"told_{k}": round(float(part), 2) for k, part in enumerate(outline.told, 1)}


class Outline(NamedTuple):
    """A fitted outline.

    | meaning                                                                    | shape       |
    |----------------------------------------------------------------------------|-------------|
    | classes, row 0 at low y                                                    | (256, 256)  |
    | sigma: conductivity, mS                                                    | (elements,) |
    | told: standard error of each harmonic over that before the frame was seen  | (8,)        |
    """

    classes: np.ndarray
    sigma: jnp.ndarray
    told: np.ndarray


def fitted_outline(seen: Seen, start: np.ndarray, near: jnp.ndarray) -> Outline:
    """The most probable outline near the largest region of classes, (256, 256) with row 0 at low y.

    Args:
        near: conductivity, (elements,), at which errors in common are computed.
    """
    kind = RESISTIVE if (start == RESISTIVE).sum() >= (start > RESISTIVE).sum() else RESISTIVE + 1
    first = _of_region(_largest(start == kind))
    expected = np.concatenate([first[:4], np.zeros(2 * HARMONICS)])
    corners = np.asarray(seen.model.chart)[np.asarray(seen.model.triangles)] / RADIUS
    points, sign = jnp.asarray(np.einsum("sc,ecd->esd", CORNER_SHARES, corners)), 1.0 if kind > RESISTIVE else -1.0
    errors = INDEPENDENT * seen.errors[seen.used]
    axes, sizes, _ = svd(common_errors(seen, near)[seen.used] / errors[:, None], full_matrices=False)
    shared = axes * np.sqrt(1 - 1 / np.sqrt(1 + sizes**2))

    def whitened(values: np.ndarray) -> np.ndarray:
        weighted = (values.T / errors).T
        return weighted - shared @ (shared.T @ weighted)

    def residual(x: np.ndarray) -> np.ndarray:
        return np.append(whitened(seen.left(_conductivity(seen.model, points, sign, x))), (x - expected) / STD)

    def slopes(x: np.ndarray) -> np.ndarray:
        by_outline = np.asarray(_slopes(seen.model, points, sign, jnp.asarray(x)))[seen.used]
        return np.vstack([-whitened(by_outline), np.diag(1 / STD)])

    fit = least_squares(residual, first, slopes, x_scale=STD, max_nfev=FITS, ftol=1e-3)
    told = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac))) / STD
    harmonics = np.sqrt(0.5 * (told[4 : 4 + HARMONICS] ** 2 + told[4 + HARMONICS :] ** 2))
    return Outline(_classes(fit.x, kind), _conductivity(seen.model, points, sign, fit.x), harmonics)


def _largest(mask: np.ndarray) -> np.ndarray:
    regions, _ = label(mask)
    return regions == 1 + np.argmax(np.bincount(regions.ravel())[1:])


def _of_region(mask: np.ndarray) -> np.ndarray:
    """Centre, height and harmonics of a region."""
    rows, columns = np.nonzero(mask)
    centre = np.array([LINE[columns].mean(), LINE[rows].mean()])
    along = np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1)[:, None] * RAY[:, None] + centre
    place = np.clip(np.rint((along + 1) / 2 * (GRID - 1)).astype(int), 0, GRID - 1)
    inside = mask[place[..., 1], place[..., 0]]
    radius = np.max(np.where(inside, RAY, RAY[0]), 1)
    turns = ANGLES[:, None] * ORDER
    scaled = np.column_stack([np.ones(len(ANGLES)), np.cos(turns), np.sin(turns)]) * STD[3:]
    # a weak prior keeps thin regions smooth
    harmonics = np.linalg.solve(scaled.T @ scaled + 0.01 * np.eye(len(STD) - 3), scaled.T @ np.log(radius))
    return np.concatenate([centre, [HEIGHT], STD[3:] * harmonics])


def _beyond(points: jnp.ndarray, x: jnp.ndarray) -> jnp.ndarray:
    """Distance of points, (..., 2), from an outline along its radius, above zero inside."""
    away = points - x[:2]
    turns = jnp.arctan2(away[..., 1], away[..., 0])[..., None] * ORDER
    arms = jnp.cos(turns) @ x[4 : 4 + HARMONICS] + jnp.sin(turns) @ x[4 + HARMONICS :]
    return jnp.exp(x[3] + arms) - jnp.sqrt(jnp.sum(away**2, -1) + 1e-12)


@eqx.filter_jit
def _conductivity(model: je.Model, points: jnp.ndarray, sign: float, x: jnp.ndarray) -> jnp.ndarray:
    share = jnp.mean(jax.nn.sigmoid(_beyond(points, jnp.asarray(x)) / BORDER), 1)
    return model.background * jnp.exp(sign * x[2] * share)


@eqx.filter_jit
def _slopes(model: je.Model, points: jnp.ndarray, sign: float, x: jnp.ndarray) -> jnp.ndarray:
    """Derivative of the readings by centre, height and harmonics, V."""
    _, change = jax.linearize(lambda x: je.forward(model, _conductivity(model, points, sign, x)), x)
    return jax.vmap(change)(jnp.eye(len(x))).T


def _classes(x: np.ndarray, kind: int) -> np.ndarray:
    points = np.stack(np.meshgrid(LINE, LINE), -1)
    return np.where(np.asarray(_beyond(jnp.asarray(points), jnp.asarray(x))) > 0, kind, WATER)
