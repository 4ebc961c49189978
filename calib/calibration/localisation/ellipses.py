"""Ellipses that hold a contact with a stated probability, and errors of place that no fit of a single frame knows."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..calibration import Calibration

INSIDE_90 = float(np.sqrt(-2 * np.log(0.1)))
"""Standard deviations to the ellipse that holds 90 % of a normal distribution in the plane: 2.146."""

_ANGLES = np.linspace(0, 2 * np.pi, 61)


def confidence_ellipse(position: np.ndarray, covariance: np.ndarray, radius: float = INSIDE_90) -> np.ndarray:
    """Points (61, 2) m, the last being the first, on the ellipse of ``radius`` standard deviations.

    Args:
        position: middle, (2,) m.
        covariance: of the position, (2, 2) m^2.
    """
    variance, axes = np.linalg.eigh(covariance)
    circle = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1)
    return np.asarray(position + radius * (circle * np.sqrt(np.maximum(variance, 0.0))) @ axes.T)


def placement_covariance(calibration: "Calibration", estimator: str = "fitted") -> np.ndarray:
    """Mean square error (2, 2) m^2 of an estimator's places of the calibration's presses; zero if it has none.

    It contains errors of the model, which the covariance of a fit, made from noise alone, does not.
    """
    found = calibration.evaluation
    if estimator not in found.estimated:
        return np.zeros((2, 2))
    error = np.asarray(found.estimated[estimator] - found.position, float)
    error = error[np.isfinite(error).all(1)]
    return np.asarray(error.T @ error / max(len(error), 1))
