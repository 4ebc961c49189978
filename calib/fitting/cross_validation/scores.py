"""Accuracy of a pressure-to-force response on samples that it was not fitted to: metrics and cross-validation.

Folds consist of whole presses or locations, never of single samples: samples of one press are near-duplicates, and a
random split of them would measure how well the fit remembers them.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ..curves.fitted import FittedCurve, predict_pads
from ..curves.samples import Numbers
from ..results import FitError, FitResult

# --- metrics, over the samples where both are finite -----------------------------------------------------------------


def _error(predicted: Numbers, true: Numbers) -> np.ndarray:
    error = np.asarray(predicted, float) - np.asarray(true, float)
    return np.asarray(error[np.isfinite(error)])


def rmse(predicted: Numbers, true: Numbers) -> float:
    """Root mean square error, in the unit of its arguments; NaN without a finite pair."""
    error = _error(predicted, true)
    return float(np.sqrt(np.mean(error**2))) if error.size else float("nan")


def mae(predicted: Numbers, true: Numbers) -> float:
    """Mean absolute error, in the unit of its arguments; NaN without a finite pair."""
    error = _error(predicted, true)
    return float(np.mean(np.abs(error))) if error.size else float("nan")


def percent_full_scale(error: float, full_scale: float) -> float:
    """An error as a percentage of full scale (the largest force of the data, unless stated otherwise)."""
    return 100 * error / full_scale if full_scale > 0 else float("nan")


@dataclass(frozen=True)
class Score:
    """Errors of `n` predictions: RMSE, MAE and largest error in N, RMSE in % of the largest true force."""

    rmse: float
    mae: float
    largest: float
    percent_full_scale: float
    n: int


def score(predicted: Numbers, true: Numbers) -> Score:
    """`Score` over the samples where both are finite."""
    error, size = _error(predicted, true), rmse(predicted, true)
    full_scale = float(np.nanmax(np.abs(true))) if np.isfinite(true).any() else float("nan")
    largest = float(np.abs(error).max()) if error.size else float("nan")
    percent = percent_full_scale(size, full_scale)
    return Score(size, mae(predicted, true), largest, percent, error.size)


# --- cross-validation by group ---------------------------------------------------------------------------------------


def assign_folds(groups: Numbers, folds: int = 5, seed: int = 0) -> np.ndarray:
    """Fold of each sample, (n,): groups are shuffled with a fixed `seed` and dealt out evenly.

    Raises:
        FitError: if there are fewer groups than folds.
    """
    labels, index = np.unique(groups, return_inverse=True)
    if folds < 2 or len(labels) < folds:
        todo = "choose at least 2 folds" if len(labels) > 1 else "press two or more places"
        if folds > len(labels) > 1:
            todo = "choose at most one fold for each press or location"
        raise FitError(f"cannot divide {len(labels)} presses or locations into {folds} folds: {todo}")
    order = np.random.default_rng(seed).permutation(len(labels))
    return (order % folds)[index.reshape(-1)]


def valid_forces(fitted: FittedCurve, pressures: np.ndarray) -> np.ndarray:
    """Forces (pads, n) N by fits that succeeded, NaN by those that did not."""
    force = predict_pads(fitted, jnp.asarray(pressures, fitted.parameters.dtype)).force
    good = np.asarray(fitted.result) == FitResult.SUCCESS
    return np.where(good[:, None], np.asarray(force, float), np.nan)
