"""Errors of a calibration on new presses, from its held-out presses: their size, and how far they extend."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.distance import cdist

from ...fitting.pads import FAINT_FORCE
from ...presses.streams import robust_deviation
from ..evaluation import Evaluation

DEFAULT_SHARE = 0.8  # of the variance that presses at one place have in common, where no place was pressed twice
MIN_FRACTION = 1e-3  # of the force
MIN_HALF = 4  # presses that determine a deviation
MIN_DISTANCE = 1e-4  # m between two places


class PressNoise(NamedTuple):
    """Errors of the total force of a press, in its logarithm. They have a normal core, and outliers beside it.

    | field    | meaning                                                          | unit |
    |----------|------------------------------------------------------------------|------|
    | fraction | standard deviation for large forces                              | 1    |
    | floor    | standard deviation of a force near zero                          | N    |
    | share    | part of the variance that presses at one place have in common    | 1    |
    | length   | distance over which that part falls to 0.6                       | m    |
    """

    fraction: float
    floor: float
    share: float
    length: float

    def covariance(self, force: Float[np.ndarray, " n"], place: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """Covariance (n, n) of the logs of total forces (n,) N at places (n, 2) m."""
        sigma = np.sqrt(self.fraction**2 + (self.floor / force) ** 2)
        near = np.exp(-0.5 * (cdist(place, place) / self.length) ** 2)
        return np.asarray(np.outer(sigma, sigma) * (self.share * near + (1 - self.share) * np.eye(len(sigma))))

    def with_scatter(self, scatter: float) -> "PressNoise":
        """With a further standard deviation, which presses at one place have in common like the others."""
        return self._replace(fraction=float(np.hypot(self.fraction, scatter)))

    @property
    def least_force(self) -> float:
        """Force (N) below which a press says little, because the floor is a fifth of it."""
        return 5 * self.floor


def press_noise(found: Evaluation) -> PressNoise:
    """The noise of a calibration's held-out presses, by medians of the halves of larger and of smaller forces."""
    sound = (found.total_force > 0) & (found.force > 0)
    force, position = found.force[sound], found.position[sound]
    error = np.log(found.total_force[sound] / force)
    error = error - np.median(error)
    small = force < np.median(force)
    fraction = max(robust_deviation(error[~small]), MIN_FRACTION)
    more = robust_deviation(error[small]) ** 2 - fraction**2 if small.sum() >= MIN_HALF else 0.0
    level = float(np.median(force[small])) if small.any() else 0.0
    floor = max(float(np.sqrt(max(more, 0.0))) * level, FAINT_FORCE * fraction * float(force.max(initial=0)))
    return PressNoise(fraction, floor, _share(error, position), place_spacing(position) / 2)


def place_spacing(position: Float[np.ndarray, "n 2"]) -> float:
    """Median distance (m) from each place to the nearest other one; 0.02 m for a single place."""
    distance = cdist(position, position)
    nearest = np.where(distance > MIN_DISTANCE, distance, np.inf).min(1, initial=np.inf)
    known = nearest[np.isfinite(nearest)]
    return float(np.median(known)) if len(known) else 0.02


def _share(error: np.ndarray, position: np.ndarray) -> float:
    """Part of the variance between places, from places that were pressed more than once."""
    place = np.unique(np.round(position, 6), axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(place, minlength=1)
    if (count - 1).clip(0).sum() < MIN_HALF:
        return DEFAULT_SHARE
    mean = (np.bincount(place, error) / np.maximum(count, 1))[place]
    own = np.sqrt(count / np.maximum(count - 1, 1))[place]  # a mean over few presses is near to each of them
    whole = robust_deviation(error)
    within = robust_deviation(((error - mean) * own)[count[place] > 1])
    return float(np.clip(1 - (within / whole) ** 2, 0.0, 1.0)) if whole > 0 else DEFAULT_SHARE
