"""How well a pressure-to-force response predicts what it has not seen: metrics, cross-validation, plain logs.

Splits are by press or location, never by sample: samples of one press are near-duplicates, and a random split of
them would test memory. A log without presses is split in time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxeit_bounds import require

from .curve_fit import fit_curves
from .curves import AbstractCurve
from .fitted_curve import FittedCurve, predict_pads
from .results import FitError, FitResult
from .samples import Numbers

Channels = Callable[[np.ndarray, np.ndarray, np.ndarray, AbstractCurve], tuple[np.ndarray, str]]

# --- metrics, over the samples where both are finite -----------------------------------------------------------------


def _error(predicted: Numbers, true: Numbers) -> np.ndarray:
    error = np.asarray(predicted, float) - np.asarray(true, float)
    return np.asarray(error[np.isfinite(error)])


def rmse(predicted: Numbers, true: Numbers) -> float:
    """Root mean square error, in the unit of its arguments; NaN if there is nothing to compare."""
    error = _error(predicted, true)
    return float(np.sqrt(np.mean(error**2))) if error.size else float("nan")


def mae(predicted: Numbers, true: Numbers) -> float:
    """Mean absolute error."""
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
    """(n,) fold of each sample: groups are shuffled (by `seed`, so always alike) and dealt out evenly.

    Raises: `FitError` if there are fewer groups than folds.
    """
    labels, index = np.unique(groups, return_inverse=True)
    if folds < 2 or len(labels) < folds:
        raise FitError(
            f"{folds} folds need at least 2 folds and as many presses or locations; there are {len(labels)}."
        )
    order = np.random.default_rng(seed).permutation(len(labels))
    return (order % folds)[index.reshape(-1)]


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Held-out predictions.

    | field     | meaning                                                            | shape         | unit |
    |-----------|--------------------------------------------------------------------|---------------|------|
    | fold      | the fold in which a sample was held out                            | (n,)          |      |
    | predicted | each pad's force on held-out samples; NaN where its fit failed     | (pads, n)     | N    |
    | total     | sum over pads                                                      | (n,)          | N    |
    | pads      | `Score` of each pad on the samples of its own mask                 | pads          |      |
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
    """Fit on all folds but one, predict that one, for every fold; whole groups are held out.

    Args:
      pressures: (pads, n) Pa; forces: (n,) N of the whole skin; groups: (n,) location (or press) of each sample.
      mask: (pads, n) or (n,) samples from which a pad may be fitted (left out: all finite ones). Held-out
        predictions are made for all samples, so that `total` covers presses that load several pads.
      options: as for `fit_curves`.

    A curve that is not zero at zero pressure (`Affine`) adds its offset for every idle pad to `total`.
    Raises: `FitError` as `assign_folds` and `fit_curves` do.
    """
    p, f = np.asarray(pressures), np.asarray(forces)
    if p.ndim != 2 or f.shape != p.shape[1:] or np.shape(groups) != f.shape:
        raise FitError(
            f"pressures (pads, n), forces (n,) and groups (n,) do not fit together: "
            f"{p.shape}, {f.shape}, {np.shape(groups)}."
        )
    usable = np.isfinite(p) & np.isfinite(f)
    usable = usable if mask is None else usable & np.broadcast_to(mask, p.shape)
    fold = assign_folds(groups, folds, seed)
    predicted, results = np.full(p.shape, np.nan), np.empty((folds, len(p)), int)
    for k in range(folds):
        fitted = fit_curves(curve, p, f, mask=usable & (fold != k), groups=groups, **options)
        results[k] = np.asarray(fitted.result)
        held = _trusted(fitted, p)
        predicted[:, fold == k] = held[:, fold == k]
    total = predicted.sum(axis=0)
    pads = tuple(score(np.where(u, q, np.nan), f) for u, q in zip(usable, predicted, strict=True))
    return CrossValidation(fold, predicted, total, pads, score(total, f), results)


def _trusted(fitted: FittedCurve, pressures: np.ndarray) -> np.ndarray:
    """Predictions (pads, n) of fits that succeeded, NaN from those that did not."""
    force = predict_pads(fitted, jnp.asarray(pressures, fitted.parameters.dtype)).force
    good = np.asarray(fitted.result) == FitResult.SUCCESS
    return np.where(good[:, None], np.asarray(force, float), np.nan)


# --- logs without presses --------------------------------------------------------------------------------------------


def time_split(time: Numbers, fraction: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Masks (n,) of the first `fraction` of the time span and of the rest."""
    at = np.asarray(time)
    first = (at - at[0]) < fraction * (at[-1] - at[0])
    return first, ~first


@dataclass(frozen=True, eq=False)
class Blend:
    """Many channels as one signal in N: a ridge regression on channels, their squares and products.

    Turns a sensor whose channels are not pads (magnetometers, taxels) into one virtual pressure, on which a curve
    is then fitted as on any other. It learns no position: one place of contact, or a few.

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
        """(n, channels) -> (n,) N; NaN where a channel is."""
        return np.asarray((_features(signals / self.scale) - self.mean) @ self.weights + self.offset)


def _features(z: np.ndarray) -> np.ndarray:
    """Channels and all their products of two."""
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


RIDGES = tuple(10.0**k for k in range(-10, 0))


def fit_blend(signals: np.ndarray, force: np.ndarray, stretches: int = 20, folds: int = 5) -> Blend:
    """`Blend` of complete rows (n, channels) in order of time, and force (n,) N.

    The ridge is the one of `RIDGES` with the smallest squared error in cross-validation by stretches of time, dealt
    to the folds in turn. Few long stretches would measure extrapolation to what a stretch alone has seen.

    Raises: `FitError` for more channels than `Budget` allows: memory grows with the fourth power of their number.
    """
    require("blend_channels", signals.shape[1], "fit_blend", FitError)
    fold = (np.arange(len(force)) * stretches // len(force)) % folds

    def held_out(ridge: float) -> float:
        return sum(_held_out_error(signals, force, fold == k, ridge) for k in range(folds))

    return _blend(signals, force, min(RIDGES, key=held_out))


def _held_out_error(signals: np.ndarray, force: np.ndarray, held: np.ndarray, ridge: float) -> float:
    """Sum of squared errors on the held rows of a blend of the others."""
    blend = _blend(signals[~held], force[~held], ridge)
    return float(np.sum((blend(signals[held]) - force[held]) ** 2))


class BlendChannels:
    """Make one signal of all channels by `fit_blend` (needs a few hundred samples)."""

    def __call__(
        self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve | None
    ) -> tuple[np.ndarray, str]:
        del time, curve
        known = np.isfinite(force)
        blend = fit_blend(signals[known], force[known])
        return blend(signals), f"all {signals.shape[1]} channels blended (ridge {blend.ridge:g})"


class BestChannel:
    """Take the one channel, turned round if it falls with force, whose own curve leaves the smallest residual."""

    def __call__(
        self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve
    ) -> tuple[np.ndarray, str]:
        del time
        known = np.isfinite(force)
        ranks = [_rank_correlation(s, force[known]) for s in signals[known].T]
        signs = np.where(np.array(ranks) < 0, -1.0, 1.0)
        fitted = fit_curves(curve, (signals[known] * signs).T, force[known])
        good = np.asarray(fitted.result) == FitResult.SUCCESS
        best = int(np.argmin(np.where(good, np.asarray(fitted.residual_rms), np.inf)))
        return signals[:, best] * signs[best], f"channel {best}"


def _rank_correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Spearman's, ties in order of appearance; 0 for a constant channel."""
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0
    return float(np.corrcoef(x.argsort().argsort(), y.argsort().argsort())[0, 1])


@dataclass(frozen=True, eq=False)
class LogFit:
    """A curve fitted on the first part of a log and tried on the rest.

    `signal` (n,) is what the curve was fitted on, `source` says in words what it is made of; `missing` counts
    samples without a force or without a signal, `train` and `held_out` are `Score`s.
    """

    fitted: FittedCurve
    signal: np.ndarray
    predicted: np.ndarray
    source: str
    missing: int
    train: Score
    held_out: Score


def fit_log(
    curve: AbstractCurve,
    time: Numbers,
    signals: Numbers,
    force: Numbers,
    *,
    fraction: float = 0.5,
    channels: Channels | None = None,
    **options: Any,
) -> LogFit:
    """One curve for a log without presses, honest about what it has not seen.

    Args:
      time: (n,); signals: (n,) or (n, channels), Pa or a sensor's own unit; force: (n,) N; NaN: missing.
      fraction: of the time span that is fitted; the rest is held out.
      channels: how several channels become one: `BlendChannels()` (default), `BestChannel()` or
        `calib.smooth.SmoothChannels()`, from the fitted part alone.
      options: as for `fit_curves`.

    Raises: `FitError` if no sample of the fitted part is complete.
    """
    values, forces = np.asarray(signals, float), np.asarray(force, float)
    values = values[:, None] if values.ndim == 1 else values
    first, rest = time_split(time, fraction)
    complete = np.isfinite(values).all(axis=1) & np.isfinite(forces)
    train = first & complete
    if not train.any():
        raise FitError("no sample of the fitted part has both a force and a signal; nothing can be fitted.")
    signal, source = _one_signal(np.asarray(time), values, np.where(train, forces, np.nan), curve, channels)
    fitted = fit_curves(curve, signal[None], forces, mask=train, **options)
    predicted = _trusted(fitted, signal[None])[0]
    scores = [score(predicted[m], forces[m]) for m in (train, rest & complete)]
    return LogFit(fitted.pad(0), signal, predicted, source, int((~complete).sum()), *scores)


def _one_signal(
    time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve, channels: Channels | None
) -> tuple[np.ndarray, str]:
    """A signal (n,) from all channels; `force` is NaN where it is not to be looked at."""
    if signals.shape[1] == 1:
        return signals[:, 0], "channel 0"
    choose = BlendChannels() if channels is None else channels
    return choose(time, signals, force, curve)
