"""The integral of an image per newton at the calibration, over place and force, with its uncertainty.

log(S / F) = b0 + b1 l + b2 l^2 + u(x) + e, with l the log of the force over its geometric mean, u a Gaussian process
over the place x with the correlation exp(-(d / L)^p / 2) at a distance d, and e scatter. p = 2 is a smooth field of one
length. p = 1 is a rough one that varies at all lengths, as a sheet with many separate protrusions does: a smooth field
would follow its short variations, and take its long ones, which differ from pad to pad, for gains of the pads.
Deviations of b are stated, so that a force or a place that was not pressed has a wide prediction instead of a wrong
one. Length, roughness, scatter and size have the largest marginal likelihood on a small grid (Rasmussen and Williams
2006, 2.3, 4.2.1 and 5.4.1).
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

BASIS_DEVIATIONS = (2.0, 0.5, 0.2)  # of b0, b1, b2; b0 is of residuals about the median
LENGTHS = (0.7, 1.5, 3.0, 6.0)  # over the median distance between neighbouring places
POWERS = (1.0, 2.0)  # of the distance: a rough and a smooth field
SHARES = (0.0, 0.5, 0.9, 0.99)  # part of the variance that depends on the place
SIZES = (0.6, 1.0, 1.6)  # standard deviation about the basis, over the robust one of the data
MIN_PRESSES = 8
MAX_PRESSES = 160  # of the calibration that are used, because the cost grows with the cube


@dataclass(frozen=True, eq=False)
class ImageReference:
    """Fitted reference; make it with `fit_reference`.

    | field   | meaning                                                       | shape  | unit  |
    |---------|---------------------------------------------------------------|--------|-------|
    | place   | of the presses, by their images                               | (m, 2) | m     |
    | level   | log of the force over `middle`                                | (m,)   | 1     |
    | middle  | geometric mean of the forces                                  | ()     | N     |
    | offset  | median of log(S / F)                                          | ()     | 1     |
    | length  | of the process                                                | ()     | m     |
    | power   | of the distance in its correlation                            | ()     | 1     |
    | signal, scatter | standard deviations of u and e                        | ()     | 1     |
    | factor, solved  | of the covariance of the data, and its solution       |        |       |
    """

    place: np.ndarray
    level: np.ndarray
    middle: float
    offset: float
    length: float
    power: float
    signal: float
    scatter: float
    factor: tuple[np.ndarray, bool]
    solved: np.ndarray

    def predict(
        self, place: Float[np.ndarray, "n 2"], force: Float[np.ndarray, " n"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean (n,) of log(S / F), its covariance (n, n) but for scatter, and its slope (n,) in log force."""
        level = np.log(force / self.middle)
        across = self._kernel(place, level, self.place, self.level)
        mean = self.offset + across @ self.solved
        covariance = self._kernel(place, level, place, level) - across @ cho_solve(self.factor, across.T)
        slope = ((_basis_slope(level) * np.square(BASIS_DEVIATIONS)) @ _basis(self.level).T) @ self.solved
        return mean, (covariance + covariance.T) / 2, slope

    def _kernel(self, x: np.ndarray, a: np.ndarray, y: np.ndarray, b: np.ndarray) -> np.ndarray:
        return _covariance(_correlation(cdist(x, y), self.length, self.power), a, b, self.signal)


def fit_reference(
    place: Float[np.ndarray, "m 2"], force: Float[np.ndarray, " m"], image_sum: Float[np.ndarray, " m"]
) -> ImageReference:
    """Fit the reference to the presses of a calibration.

    Raises:
        ValueError: for fewer than `MIN_PRESSES` presses with a place, a force and an image.
    """
    sound = np.isfinite(place).all(1) & (force > 0) & (image_sum > 0)
    rows = np.flatnonzero(sound)
    if len(rows) < MIN_PRESSES:
        raise ValueError(f"only {len(rows)} presses of the calibration have a place, a force and an image")
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_PRESSES)).astype(int)]
    place, force, ratio = place[rows], force[rows], np.log(image_sum[rows] / force[rows])
    middle, offset = float(np.exp(np.log(force).mean())), float(np.median(ratio))
    level, values, distance = np.log(force / middle), ratio - offset, cdist(place, place)
    spacing = np.median(np.where(distance > 1e-4, distance, np.inf).min(1))
    spacing = float(spacing) if np.isfinite(spacing) else 0.01
    size = max(float(np.std(values)), 1e-3)
    kinds = ((spacing * length, power) for length, power in product(LENGTHS, POWERS))
    fits = (
        (kind, _fitted(_correlation(distance, *kind), level, values, size * total, share))
        for kind, total, share in product(kinds, SIZES, SHARES)
    )
    (length, power), (_, signal, scatter, factor, solved) = max(fits, key=lambda one: one[1][0])
    return ImageReference(place, level, middle, offset, length, power, signal, scatter, factor, solved)


def _fitted(
    near: np.ndarray, level: np.ndarray, values: np.ndarray, total: float, share: float
) -> tuple[float, float, float, tuple[np.ndarray, bool], np.ndarray]:
    """Log marginal likelihood, signal, scatter, factor and solution of one choice."""
    signal, scatter = total * np.sqrt(share), total * np.sqrt(1 - share)
    matrix = _covariance(near, level, level, signal) + scatter**2 * np.eye(len(level))
    factor = cho_factor(matrix, lower=True)[0], True
    solved = cho_solve(factor, values)
    likelihood = -0.5 * values @ solved - np.log(np.diag(factor[0])).sum()
    return float(likelihood), float(signal), float(scatter), factor, solved


def _correlation(distance: np.ndarray, length: float, power: float) -> np.ndarray:
    return np.asarray(np.exp(-0.5 * (distance / length) ** power))


def _covariance(near: np.ndarray, a: np.ndarray, b: np.ndarray, signal: float) -> np.ndarray:
    return np.asarray((_basis(a) * np.square(BASIS_DEVIATIONS)) @ _basis(b).T + signal**2 * near)


def _basis(level: np.ndarray) -> np.ndarray:
    return np.stack([np.ones_like(level), level, level**2], 1)


def _basis_slope(level: np.ndarray) -> np.ndarray:
    return np.stack([np.zeros_like(level), np.ones_like(level), 2 * level], 1)
