"""Ways to make one signal of many channels: a ridge regression of the force on all channels, or the best channel."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxeit.budget import require

from ..curves.base import AbstractCurve
from ..curves.fit import fit_curves
from ..results import FitError, FitResult
from .combination import Blend, OneChannel, one_channel, quadratic_features


def _ridge_solve(x: np.ndarray, y: np.ndarray, ridge: float) -> np.ndarray:
    gram = x.T @ x
    return np.linalg.solve(gram + ridge * len(x) * np.eye(len(gram)), x.T @ y)


def _blend(signals: np.ndarray, force: np.ndarray, ridge: float) -> Blend:
    scale = np.abs(signals).max(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    x = quadratic_features(signals / scale)
    mean, offset = x.mean(axis=0), float(force.mean())
    return Blend(scale, mean, _ridge_solve(x - mean, force - offset, ridge), np.asarray(offset), np.asarray(ridge))


# Candidate penalties, relative to the number of samples.
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
    return float(np.sum((blend.signal(force[held], signals[held]) - force[held]) ** 2))


@dataclass(frozen=True)
class BlendChannels:
    """Make one signal of all channels by `fit_blend` (needs a few hundred samples).

    Example:
        blended = logs.fit_log(calib.Linear(), time, channels, force, channels=logs.BlendChannels())
        best = found.model.combination  # a Blend, OneChannel or SmoothSignal
        print(isinstance(best, (logs.OneChannel, logs.Blend, logs.SmoothSignal)), best.words)
        print("kinds in a file:", list(logs.COMBINATIONS))
    """

    def __call__(self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve | None) -> Blend:
        """The combination, from the samples (n, channels) whose force (n,) N is finite."""
        del time, curve
        known = np.isfinite(force)
        return fit_blend(signals[known], force[known])

    def near(self, found: object) -> "BlendChannels":
        """The way to fit to a part of the samples that `found` was fitted to."""
        del found
        return self


@dataclass(frozen=True)
class WithPlace:
    """Make one signal in N of all channels and of the two coordinates of the place, which are the last columns.

    ``way`` combines the columns, such as `BlendChannels`.

    Example:
        # the last two columns of the channels are the place
        with_place = logs.WithPlace(logs.BlendChannels())
    """

    way: Any

    def __call__(self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve | None) -> Any:
        """The combination, as by `way`."""
        return self.way(time, signals, force, curve)

    def near(self, found: Any) -> "WithPlace":
        """The way to fit to a part of the samples that `found` was fitted to."""
        return WithPlace(self.way.near(found))


@dataclass(frozen=True)
class BestChannel:
    """Take the channel whose own curve leaves the smallest residual; its sign is changed if it falls with the force."""

    def __call__(self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve) -> OneChannel:
        """The channel, chosen by the samples (n, channels) whose force (n,) N is finite."""
        del time
        known = np.isfinite(force)
        ranks = [_rank_correlation(s, force[known]) for s in signals[known].T]
        signs = np.where(np.array(ranks) < 0, -1.0, 1.0)
        fitted = fit_curves(curve, (signals * signs).T, force, mask=known)
        good = np.asarray(fitted.result) == FitResult.SUCCESS
        best = int(np.argmin(np.where(good, np.asarray(fitted.residual_rms), np.inf)))
        return one_channel(best, float(signs[best]))

    def near(self, found: object) -> "BestChannel":
        """The way to fit to a part of the samples that `found` was fitted to."""
        del found
        return self


def _rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's rank correlation with ties in the order of samples; 0 for a constant channel."""
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(x.argsort().argsort(), y.argsort().argsort())[0, 1])
