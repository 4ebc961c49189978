"""Bayesian update of the log gains of pads: linear, Gaussian, robust against outliers.

With residuals r (n,) of observed over expected logarithms, their slopes A (n, pads) in the log gains g, their
covariance R and a prior N(m, P), the posterior has the precision P^-1 + A' W A with W = R^-1. Directions U that the
data cannot tell from something unknown, such as a gain common to all pads and the image, are projected out:
W = R^-1 - R^-1 U (U' R^-1 U)^+ U' R^-1. Along them the posterior is the prior. No inverse is formed: rows are
divided by the Cholesky factor of R, and the posterior is found by a QR decomposition of them under those of the prior.

An outlier has an independent error besides that of R: variance R_ii (1 / w - 1), with the weights w = 1 for residuals
within `OUTLIER_DEVIATIONS` and of Cauchy's distribution beyond, iterated. Multiplying the rows of R instead would take
the errors that neighbours share for differences between them, and so overstate the information. Deviations are the
larger of the stated and the median one, so that a start far away does not select a few observations.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cholesky, solve_triangular

from ..presses.streams import robust_deviation

OUTLIER_DEVIATIONS = 2.0  # deviations, beyond which an observation loses weight
MAX_STEPS = 30
GAIN_ATOL = 1e-7  # largest step of a log gain at the end
MAX_DETERMINED_RATIO = 0.5  # largest standard deviation of a determined gain, over that of its prior


class GainPrior(NamedTuple):
    """Prior of the log gains, a normal distribution: mean (pads,), covariance."""

    mean: Float[np.ndarray, " pads"]
    covariance: Float[np.ndarray, "pads pads"]


class GainDrift(NamedTuple):
    """Standard deviations by which log gains may have moved since they were known last.

    | field  | meaning                                                                 | default |
    |--------|-------------------------------------------------------------------------|---------|
    | own    | of each pad by itself: its sensor, its air, its material                | 0.1     |
    | common | of all pads together: temperature, barometric pressure, the load cell   | 0.1     |
    """

    own: float = 0.1
    common: float = 0.1

    def covariance(self, pads: int, *, together: bool) -> Float[np.ndarray, "pads pads"]:
        """Covariance of the move. Without `together` one pad says nothing about the others: the same variances."""
        shared = np.full((pads, pads), self.common**2)
        return np.asarray(self.own**2 * np.eye(pads) + (shared if together else np.diag(np.diag(shared))))


class GainUpdate(NamedTuple):
    """Log gains after an update.

    | field      | meaning                                                                   | shape        |
    |------------|---------------------------------------------------------------------------|--------------|
    | mean       | of the log gains                                                          | (pads,)      |
    | covariance | of the log gains                                                          | (pads, pads) |
    | determined | whether the data determine the gain (relative to the others, with nuisance) | (pads,)    |
    | misfit     | median deviation of the residuals over the stated one; 1 is as stated     | ()           |
    | scatter    | median deviation of the residuals                                         | ()           |
    | weight     | of each observation, small for outliers                                   | (n,)         |
    """

    mean: Float[np.ndarray, " pads"]
    covariance: Float[np.ndarray, "pads pads"]
    determined: Bool[np.ndarray, " pads"]
    misfit: float
    scatter: float
    weight: Float[np.ndarray, " n"]


Residuals = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Log gains (pads,) -> residuals (n,), observed minus expected, and the slopes (n, pads) of what is expected."""


def update_gains(
    prior: GainPrior,
    residuals: Residuals,
    covariance: Float[np.ndarray, "n n"],
    nuisance: Float[np.ndarray, "n k"] | None = None,
) -> GainUpdate:
    """Update log gains by observations with the covariance of their errors.

    The covariance of the result grows by the square of `misfit` where the residuals are significantly larger than
    stated. Without observations the result is the prior.
    """
    gain, n = prior.mean, len(covariance)
    free = np.zeros((n, 0)) if nuisance is None else nuisance
    known = solve_triangular(cholesky(prior.covariance, lower=True), np.eye(len(gain)), lower=True)
    sigma, weight, misfit, scatter = np.sqrt(np.diag(covariance)), np.ones(n), 1.0, 0.0
    rows = np.zeros((0, len(gain)))
    # Not a call of a least-squares solver: the weights follow from medians of the residuals after each step, so that no
    # sum of squares stays the same over the steps, and a step alone is linear, which one decomposition solves.
    for _ in range(MAX_STEPS if n else 0):
        rows, residual = _whiten(covariance, weight, free, *residuals(gain))
        orthogonal, triangle = np.linalg.qr(np.concatenate([known, rows]))
        step = solve_triangular(triangle, orthogonal.T @ np.concatenate([known @ (prior.mean - gain), residual]))
        gain = gain + step
        fitted = free.shape[1] + np.sum(orthogonal[len(gain) :] ** 2)
        # Residuals of a fit are smaller than the errors, as n - fitted to n.
        corrected = _residual_without(free, covariance, weight, residuals(gain)[0]) * np.sqrt(n / max(n - fitted, 1.0))
        scatter, misfit = robust_deviation(corrected), robust_deviation(corrected / sigma)
        weight = np.minimum(1.0, (1 + OUTLIER_DEVIATIONS**2) / (1 + (corrected / sigma / max(misfit, 1.0)) ** 2))
        if np.abs(step).max() < GAIN_ATOL:
            break
    scale = misfit if misfit > _max_misfit(n) else 1.0
    root = solve_triangular(np.linalg.qr(np.concatenate([known, rows / scale]), mode="r"), np.eye(len(gain)))
    posterior = root @ root.T
    determined = _is_determined(prior, posterior, nuisance is not None)
    return GainUpdate(gain, posterior, determined, misfit, scatter, weight)


def _max_misfit(n: int) -> float:
    """Misfit that residuals of the stated errors exceed in a few percent of cases."""
    return float(1 + 2.4 / np.sqrt(max(n, 1)))


def _whiten(
    covariance: np.ndarray, weight: np.ndarray, free: np.ndarray, residual: np.ndarray, slope: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes and residuals of weighted observations in their errors, with the directions `free` projected out."""
    root = cholesky(covariance + np.diag(np.diag(covariance) * (1 / weight - 1)), lower=True)
    white = solve_triangular(root, np.column_stack([slope, residual, free]), lower=True)
    rows, directions = np.split(white, [slope.shape[1] + 1], axis=1)
    if directions.shape[1]:
        rows = rows - directions @ np.linalg.lstsq(directions, rows, rcond=None)[0]
    return rows[:, :-1], rows[:, -1]


def _residual_without(free: np.ndarray, covariance: np.ndarray, weight: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Residuals after a weighted least-squares fit of the directions `free`."""
    if not free.shape[1]:
        return residual
    root = np.sqrt(weight / np.diag(covariance))
    return np.asarray(residual - free @ np.linalg.lstsq(free * root[:, None], residual * root, rcond=None)[0])


def relative_covariance(covariance: Float[np.ndarray, "pads pads"]) -> Float[np.ndarray, "pads pads"]:
    """Covariance of the log gains minus their mean over the pads."""
    pads = len(covariance)
    centre = np.eye(pads) - 1 / pads
    return np.asarray(centre @ covariance @ centre)


def _is_determined(prior: GainPrior, posterior: np.ndarray, is_relative: bool) -> np.ndarray:
    before, after = (relative_covariance(c) if is_relative else c for c in (prior.covariance, posterior))
    return np.asarray(np.diag(after) < MAX_DETERMINED_RATIO**2 * np.diag(before))
