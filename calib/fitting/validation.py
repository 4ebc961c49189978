"""Accuracy of a pressure-to-force response on samples that it was not fitted to: metrics and cross-validation.

Folds consist of whole presses or locations, never of single samples: samples of one press are near-duplicates, and a
random split of them would measure how well the fit remembers them.
"""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from .curves.base import AbstractCurve
from .curves.fit import fit_curves
from .curves.fitted import FittedCurve, predict_pads
from .curves.samples import Numbers
from .results import FitError, FitResult

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
        raise FitError(
            f"cannot divide {len(labels)} presses or locations into {folds} folds: choose at least 2 folds, "
            "and at most one for each press or location."
        )
    order = np.random.default_rng(seed).permutation(len(labels))
    return (order % folds)[index.reshape(-1)]


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Predictions by fits that did not use the sample.

    | field     | meaning                                                            | shape         | unit |
    |-----------|--------------------------------------------------------------------|---------------|------|
    | fold      | the fold in which a sample was held out                            | (n,)          |      |
    | predicted | each pad's force on held-out samples; NaN where its fit failed     | (pads, n)     | N    |
    | total     | sum over pads                                                      | (n,)          | N    |
    | pads      | `Score` of each pad on the samples from which it may be fitted     | pads          |      |
    | overall   | `Score` of `total` against the force                               |               |      |
    | results   | `FitResult` of every fit                                           | (folds, pads) |      |
    """

    fold: np.ndarray
    predicted: np.ndarray
    total: np.ndarray
    pads: tuple[Score, ...]
    overall: Score
    results: np.ndarray


def cross_validate(
    curve: AbstractCurve,
    pressures: Numbers,
    forces: Numbers,
    *,
    groups: Numbers,
    mask: Numbers | None = None,
    folds: int = 5,
    seed: int = 0,
    **options: Any,
) -> CrossValidation:
    """Predict each fold by fits to the other folds; a group is never divided between folds.

    Args:
      pressures: (pads, n) Pa; forces: (n,) N of the whole skin; groups: (n,) location (or press) of each sample.
      mask: (pads, n) or (n,) samples from which a pad may be fitted; default: all finite ones. All samples are
        predicted, so that `total` covers presses that load several pads.
      options: further arguments of `fit_curves`.

    A curve that is not zero at zero pressure (`Affine`) adds its offset for every idle pad to `total`.

    Raises:
        FitError: for shapes that do not fit together, fewer groups than folds, and as `fit_curves` does.
    """
    p, f = np.asarray(pressures), np.asarray(forces)
    if p.ndim != 2 or f.shape != p.shape[1:] or np.shape(groups) != f.shape:
        raise FitError(
            "pressures must be (pads, n), forces and groups (n,), with the same n; their shapes are "
            f"{p.shape}, {f.shape} and {np.shape(groups)}."
        )
    usable = np.isfinite(p) & np.isfinite(f)
    usable = usable if mask is None else usable & np.broadcast_to(mask, p.shape)
    fold = assign_folds(groups, folds, seed)
    predicted, results = np.full(p.shape, np.nan), np.empty((folds, len(p)), int)
    for k in range(folds):
        fitted = fit_curves(curve, p, f, mask=usable & (fold != k), groups=groups, **options)
        results[k] = np.asarray(fitted.result)
        held = trusted_forces(fitted, p)
        predicted[:, fold == k] = held[:, fold == k]
    total = predicted.sum(axis=0)
    pads = tuple(score(np.where(u, q, np.nan), f) for u, q in zip(usable, predicted, strict=True))
    return CrossValidation(fold, predicted, total, pads, score(total, f), results)


def trusted_forces(fitted: FittedCurve, pressures: np.ndarray) -> np.ndarray:
    """Forces (pads, n) N by fits that succeeded, NaN by those that did not."""
    force = predict_pads(fitted, jnp.asarray(pressures, fitted.parameters.dtype)).force
    good = np.asarray(fitted.result) == FitResult.SUCCESS
    return np.where(good[:, None], np.asarray(force, float), np.nan)
