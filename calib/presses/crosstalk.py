"""Crosstalk between pads: the part of a pad's pressure that shows in the channel of another.

Channels read p = M u, with u the pads' own pressures and M the crosstalk matrix, whose diagonal is one. A press far
from pad i leaves u_i = 0, so that p_i = sum_j M_ij u_j over the other pads: row i of M is a linear regression on such
presses, wherever else they lie. Forces are not needed. A press near pad i loads pad i itself, and does not inform on M.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxeit as je
from jaxeit.linalg import solve

from .streams import robust_deviation

ITERATIONS = 4  # of the regressions; each uses the pads' own pressures by the iteration before
MIN_PLACES = 4  # far from a pad, and at least twice the number of other pads; fewer do not determine a row
MAX_CROSSTALK = 0.5  # beyond it a channel is not that of its pad, which `check` reports
SIGNIFICANCE = 4.0  # an element below so many of its standard errors counts as no crosstalk
MAX_LOAD_RATIO = 2.0  # largest load over the median load; rows above it are scaled down to it
HUBER_WIDTH = 2.0  # standard deviations beyond which a press loses weight


@dataclass(frozen=True, eq=False)
class Crosstalk:
    """The crosstalk matrix of a skin.

    | field          | meaning                                                              | shape        |
    |----------------|----------------------------------------------------------------------|--------------|
    | matrix         | reading of channel i per own pressure of pad j; the diagonal is one  | (pads, pads) |
    | standard_error | of the matrix; NaN where the presses do not determine it             | (pads, pads) |
    """

    matrix: np.ndarray
    standard_error: np.ndarray

    @classmethod
    def none(cls, pads: int) -> "Crosstalk":
        """No crosstalk between this number of pads."""
        return cls(np.eye(pads), np.full((pads, pads), np.nan))

    @cached_property
    def present(self) -> bool:
        """Whether any pad shows in the channel of another."""
        return bool((self.matrix != np.eye(len(self.matrix))).any())

    @property
    def largest(self) -> float:
        """Largest part of a pad's pressure that shows in the channel of another."""
        return float(np.abs(self.matrix - np.eye(len(self.matrix))).max(initial=0))

    def own(self, pressure: np.ndarray) -> np.ndarray:
        """The pads' own pressures, from readings (..., pads) Pa."""
        return np.asarray(own_pressures(jnp.asarray(self.matrix), jnp.asarray(pressure))) if self.present else pressure


def own_pressures(matrix: Float[Array, "pads pads"], pressure: Float[Array, "... pads"]) -> Float[Array, "... pads"]:
    """The pads' own pressures u of p = M u; a channel without a reading is NaN, and adds nothing to the others."""
    known = jnp.isfinite(pressure)
    rows = jnp.where(known, pressure, 0).reshape(-1, pressure.shape[-1])
    own: Array = solve(matrix.astype(rows.dtype), rows.T).T.reshape(pressure.shape)
    return jnp.where(known, own, jnp.nan)


def own_deviations(matrix: Float[Array, "pads pads"], deviation: Float[Array, "n pads"]) -> Float[Array, "n pads"]:
    """Standard deviations of the pads' own pressures, (n, pads) Pa, from those of independent noise of the channels."""
    inverse = solve(matrix.astype(deviation.dtype), jnp.eye(len(matrix), dtype=deviation.dtype))
    return jnp.sqrt(deviation**2 @ (inverse**2).T)


def fit_crosstalk(
    pressure: Float[np.ndarray, "presses pads"], position: Float[np.ndarray, "presses 2"], pads: Sequence[je.Pad]
) -> Crosstalk:
    """The crosstalk matrix, from readings over the holds of presses (Pa) and the positions of the tip (m).

    Presses on the far half, by their distance to a pad, determine the row of that pad. Without a significant element,
    without enough places, or with an element above `MAX_CROSSTALK`, there is no crosstalk.
    """
    count = len(pads)
    found = Crosstalk.none(count)
    finite = np.isfinite(pressure).all(1) & np.isfinite(position).all(1)
    pressure, position = pressure[finite], position[finite]
    place = np.unique(np.round(position, 6), axis=0, return_inverse=True)[1].ravel()
    distance = [_distance(pad, position) for pad in pads]
    for _ in range(ITERATIONS if count > 1 else 0):
        own = found.own(pressure)
        rows = [_matrix_row(i, pressure[:, i], own, distance[i], place) for i in range(count)]
        found = Crosstalk(*map(np.stack, zip(*rows, strict=True)))
        if found.largest > MAX_CROSSTALK:
            return Crosstalk.none(count)
    return found


def _distance(pad: je.Pad, position: np.ndarray) -> np.ndarray:
    """Distance of positions to a pad, (n,) m; 0 on the pad."""
    outline = pad.polygon
    return np.where(outline.contains(position), 0.0, outline.boundary_distance(position))


def _matrix_row(
    pad: int, reading: np.ndarray, own: np.ndarray, distance: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Row of a pad in the matrix, and its standard errors; without crosstalk if the presses do not determine it."""
    count = own.shape[1]
    others = np.arange(count) != pad
    row, error = np.eye(count)[pad], np.full(count, np.nan)
    outside = distance > 0
    far = outside & (distance >= np.median(distance[outside])) if outside.any() else outside
    if len(np.unique(place[far])) < max(MIN_PLACES, 2 * (count - 1)):
        return row, error
    coefficients, error[others] = _huber_regression(own[far][:, others], reading[far], place[far])
    row[others] = np.where(np.abs(coefficients) > SIGNIFICANCE * error[others], coefficients, 0.0)
    return row, error


def _huber_regression(x: np.ndarray, y: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (k,) of y = x @ c with Huber's weights, and their standard errors.

    Rows of loads far above the others are scaled down, because a single wrong press of large load would have too much
    leverage. The errors are those of independent rows or of the sandwich over places, whichever are larger: the latter
    alone are uncertain for few places.
    """
    load = np.abs(x).sum(1)
    limit = MAX_LOAD_RATIO * np.median(load)
    scale = np.where(load > limit, limit / np.where(load > limit, load, 1), 1)[:, None]
    x, y = x * scale, y * scale[:, 0]
    weight = np.ones(len(y))
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        coefficients = np.linalg.lstsq(x * root, y * root[:, 0], rcond=None)[0]
        residual = y - x @ coefficients
        deviation = robust_deviation(residual)
        outside = np.abs(residual) > HUBER_WIDTH * deviation
        huber = HUBER_WIDTH * deviation / np.where(outside, np.abs(residual), 1)
        weight = np.where(outside & (deviation > 0), huber, 1)
    scores = np.stack([np.bincount(place, column) for column in (x * (weight * residual)[:, None]).T], 1)
    gram = x.T @ (x * weight[:, None])
    clusters = len(np.unique(place))
    correction = clusters / max(clusters - x.shape[1], 1)
    sandwich = (np.linalg.lstsq(gram, scores.T, rcond=None)[0] ** 2).sum(1)
    independent = np.diagonal(np.linalg.pinv(x.T @ x)) * np.mean((weight * residual) ** 2) / np.mean(weight >= 1) ** 2
    return coefficients, np.sqrt(correction * np.maximum(sandwich, independent))
