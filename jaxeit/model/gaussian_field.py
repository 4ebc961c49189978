"""Gaussian random fields made of bumps on a grid, whose covariance is ``exp(-d^2 / (2 length^2))``.

Fits and trackers believe that coatings and gains of contact layers are such fields: modes of independent unknowns of
variance one, in place of a covariance of all points.
"""

import numpy as np
from jaxtyping import Float


def field_modes(points: Float[np.ndarray, "n 2"], length: float) -> Float[np.ndarray, "n g"]:
    """Modes of a Gaussian field of variance one at points: bumps whose sum of products is exp(-d^2 / 2 length^2)."""
    modes = field_bumps(points, field_nodes(points.min(0), points.max(0), length), length)
    return modes / field_norm(modes)


def field_nodes(low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], length: float) -> Float[np.ndarray, "g 2"]:
    """Where the bumps of a field between two corners lie, m: on a grid whose pitch is its length."""
    axes = [np.arange(a - length, b + 1.5 * length, length) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)


def field_bumps(
    points: Float[np.ndarray, "n 2"], nodes: Float[np.ndarray, "g 2"], length: float
) -> Float[np.ndarray, "n g"]:
    """Bumps at nodes, whose sum of products is proportional to exp(-d^2 / 2 length^2)."""
    return np.asarray(np.exp(-((points[:, None] - nodes) ** 2).sum(-1) / length**2))


def field_norm(bumps: Float[np.ndarray, "n g"]) -> float:
    """What bumps are to be divided by for a mean variance of one."""
    return float(np.sqrt(np.mean((bumps**2).sum(-1))))
