"""One signal of many channels: a ridge regression of the force on all channels, or the best single channel."""

from dataclasses import dataclass

import numpy as np

from jaxeit.budget import require

from ..curves.base import AbstractCurve
from ..curves.fit import fit_curves
from ..results import FitError, FitResult


@dataclass(frozen=True, eq=False)
class Blend:
    """One signal in N of many channels: a ridge regression on channels, their squares and products.

    It makes a sensor whose channels are not pads (magnetometers, taxels) into one virtual pressure, to which a curve
    is fitted as to any other. It does not model the place of contact, and needs contacts at one or a few places.

    | field   | meaning                                         | shape       | unit     |
    |---------|-------------------------------------------------|-------------|----------|
    | scale   | largest absolute value of a channel in training | (channels,) | sensor's |
    | mean    | of the features in training                     | (features,) | 1        |
    | weights | of the centred features                         | (features,) | N        |
    | offset  | mean force in training                          | ()          | N        |
    | ridge   | penalty chosen, relative to the samples         | ()          | 1        |
    """

    scale: np.ndarray
    mean: np.ndarray
    weights: np.ndarray
    offset: float
    ridge: float

    def __call__(self, signals: np.ndarray) -> np.ndarray:
        """Signal (n,) N of readings (n, channels); NaN where a channel is NaN."""
        return np.asarray((_features(signals / self.scale) - self.mean) @ self.weights + self.offset)


def _features(z: np.ndarray) -> np.ndarray:
    """Channels and all products of two of them, (n, features)."""
    i, j = np.triu_indices(z.shape[1])
    return np.concatenate([z, z[:, i] * z[:, j]], axis=1)


def _ridge_solve(x: np.ndarray, y: np.ndarray, ridge: float) -> np.ndarray:
    gram = x.T @ x
    return np.linalg.solve(gram + ridge * len(x) * np.eye(len(gram)), x.T @ y)


def _blend(signals: np.ndarray, force: np.ndarray, ridge: float) -> Blend:
    scale = np.abs(signals).max(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    x = _features(signals / scale)
    mean, offset = x.mean(axis=0), float(force.mean())
    return Blend(scale, mean, _ridge_solve(x - mean, force - offset, ridge), offset, ridge)


# Penalties tried, relative to the number of samples.
RIDGES = tuple(10.0**k for k in range(-10, 0))


def fit_blend(signals: np.ndarray, force: np.ndarray, stretches: int = 20, folds: int = 5) -> Blend:
    """`Blend` of complete rows (n, channels) in order of time, and force (n,) N.

    The ridge is the one of `RIDGES` with the smallest squared error in cross-validation. Folds consist of stretches of
    time, dealt out in turn. Few long stretches would measure extrapolation to states that occur in one stretch alone.

    Raises:
        FitError: for more channels than `Budget` allows; memory grows with the fourth power of their number.
    """
    require("blend_channels", signals.shape[1], "fit_blend", FitError)
    fold = (np.arange(len(force)) * stretches // len(force)) % folds

    def held_out(ridge: float) -> float:
        return sum(_held_out_error(signals, force, fold == k, ridge) for k in range(folds))

    return _blend(signals, force, min(RIDGES, key=held_out))


def _held_out_error(signals: np.ndarray, force: np.ndarray, held: np.ndarray, ridge: float) -> float:
    """Sum of squared errors (N^2) on the held rows, of a blend fitted to the other rows."""
    blend = _blend(signals[~held], force[~held], ridge)
    return float(np.sum((blend(signals[held]) - force[held]) ** 2))


class BlendChannels:
    """Make one signal of all channels by `fit_blend` (needs a few hundred samples)."""

    def __call__(
        self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve | None
    ) -> tuple[np.ndarray, str]:
        """Signal (n,) N, from the samples (n, channels) whose force (n,) is finite."""
        del time, curve
        known = np.isfinite(force)
        blend = fit_blend(signals[known], force[known])
        return blend(signals), f"all {signals.shape[1]} channels blended (ridge {blend.ridge:g})"


class BestChannel:
    """Take the channel whose own curve leaves the smallest residual; its sign is changed if it falls with the force."""

    def __call__(
        self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve
    ) -> tuple[np.ndarray, str]:
        """Signal (n,) in the unit of the sensor, chosen by the samples whose force (n,) is finite."""
        del time
        known = np.isfinite(force)
        ranks = [_rank_correlation(s, force[known]) for s in signals[known].T]
        signs = np.where(np.array(ranks) < 0, -1.0, 1.0)
        fitted = fit_curves(curve, (signals[known] * signs).T, force[known])
        good = np.asarray(fitted.result) == FitResult.SUCCESS
        best = int(np.argmin(np.where(good, np.asarray(fitted.residual_rms), np.inf)))
        return signals[:, best] * signs[best], f"channel {best}"


def _rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's rank correlation with ties in the order of samples; 0 for a constant channel."""
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(x.argsort().argsort(), y.argsort().argsort())[0, 1])
