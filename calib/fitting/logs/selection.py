"""Choice and fit of the model of a log, with what it predicts for stretches of time that it has not seen.

Every candidate is fitted to all used samples and, in the same compiled call, without each of a few folds. A fold is
several blocks of time dealt out in turn: a single long stretch would measure extrapolation to states that occur in it
alone. Only the later half of the blocks of a log decides, because a model is chosen for what comes after the
recording, and soft sensors run in: their first minutes are like no later ones. Standard errors come from the blocks as
groups, because samples that follow each other err together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..curves import CURVES
from ..curves.base import AbstractCurve
from ..curves.elementary import Affine
from ..curves.fit import fit_curves
from ..curves.fitted import FittedCurve
from ..losses import AbstractLoss
from ..results import FitError, FitResult
from ..selection import Candidate, Tried, simplest
from .blend import BestChannel, BlendChannels
from .combination import AbstractCombination, one_channel
from .gaussian_process import SmoothChannels
from .model import TOLERANCE, LogModel, LogPrediction, curve_forces, reach_of, with_noise, within
from .noise import fit_log_noise
from .series import LogSeries

Way = BestChannel | BlendChannels | SmoothChannels | None
"""How several channels become one signal; None: there is only one."""

# Parts of time whose errors count as one in the quantile of the interval. Half of them decide; a quantile of 90 % from
# ten would be their maximum, and many short ones err together.
NOISE_BLOCKS = 40
FOLDS = 5  # of blocks of time, which are held out in turn


class HeldOut(NamedTuple):
    """What fits without a sample's stretch of time predict for it; NaN for samples that are not used.

    | field    | meaning                                        | shape | unit |
    |----------|------------------------------------------------|-------|------|
    | force    |                                                | (n,)  | N    |
    | error    | standard error of the curve                    | (n,)  | N    |
    | valid    | channels within the ranges of the other folds  | (n,)  |      |
    | block    | number of the block of time                    | (n,)  |      |
    """

    force: np.ndarray
    error: np.ndarray
    valid: np.ndarray
    block: np.ndarray


@dataclass(frozen=True, eq=False)
class FittedLog:
    """A model fitted to used samples of a series, and how it was chosen.

    | field      | meaning                                                              |
    |------------|----------------------------------------------------------------------|
    | model      | the model fitted to all used samples                                 |
    | predicted  | its forces at all samples of the series, used or not                 |
    | held_out   | its forces without the stretch of time of each used sample           |
    | way, curve | what was chosen                                                      |
    | why        | reason for the choice; empty: there was none                         |
    | tried      | the candidates                                                       |
    """

    model: LogModel
    predicted: LogPrediction
    held_out: HeldOut
    way: Way
    curve: AbstractCurve
    why: str
    tried: tuple[Candidate, ...]


class _Fits(NamedTuple):
    """Fits of one candidate: with all used samples (row 0), and without each fold."""

    combination: AbstractCombination
    curves: FittedCurve
    force: np.ndarray
    error: np.ndarray
    valid: np.ndarray

    @property
    def good(self) -> np.ndarray:
        """Flags (fits,): the fit with all samples succeeded; others need no covariance, but all parameters."""
        result, rank = np.asarray(self.curves.result), np.asarray(self.curves.rank)
        whole = (result == FitResult.SINGULAR) & (rank == self.curves.parameters.shape[1]) & (np.arange(len(rank)) > 0)
        return np.asarray((result == FitResult.SUCCESS) | whole)


class _Problem:
    """The samples, their folds and blocks; signals and fits are computed once."""

    def __init__(self, series: LogSeries, use: np.ndarray, loss: AbstractLoss, folds: int):
        self.series, self.loss = series, loss
        self.used = use & series.complete
        self.block = series.blocks(self.used)
        self.fold = self.block % folds
        self.decides = self.used & series.late(self.block)
        kept = [self.used, *(self.used & (self.fold != k) for k in np.unique(self.fold[self.used]))]
        self.train = np.stack([rows for rows in kept if rows.any()])
        self._signals: dict[str, tuple[AbstractCombination, np.ndarray]] = {}
        self._fits: dict[tuple[str, str], _Fits] = {}

    @cached_property
    def inside(self) -> np.ndarray:
        """Flags (fits, n): channels within the ranges of the samples of each fit."""
        values = self.series.values
        return np.stack([within(reach_of(values[rows]), values) for rows in self.train])

    def signals(self, way: Way) -> tuple[AbstractCombination, np.ndarray]:
        """The combination of all used samples, and the signals (fits, n) of the combinations of each fit."""
        key = type(way).__name__
        if key not in self._signals:
            self._signals[key] = self._combined(way)
        return self._signals[key]

    def _combined(self, way: Way) -> tuple[AbstractCombination, np.ndarray]:
        s = self.series
        if way is None:
            return one_channel(0), np.broadcast_to(s.values[:, 0], self.train.shape)
        forces = [np.where(rows, s.force, np.nan) for rows in self.train]
        first: AbstractCombination = way(s.time, s.values, forces[0], Affine())
        near = way.near(first)
        others = [near(s.time, s.values, force, Affine()) for force in forces[1:]]
        return first, np.stack([one.signal(s.time, s.values) for one in (first, *others)])

    def fits(self, way: Way, curve: AbstractCurve) -> _Fits:
        """All fits of a candidate."""
        key = type(way).__name__, CURVES.name_of(curve)
        if key not in self._fits:
            combination, signals = self.signals(way)
            fitted = fit_curves(curve, signals, self.series.force, mask=self.train, groups=self.block, loss=self.loss)
            force, error, _ = curve_forces(fitted, signals)
            valid = self.inside & _in_range(fitted, signals)
            self._fits[key] = _Fits(combination, fitted, force, np.nan_to_num(error), valid)
        return self._fits[key]

    def held_out(self, fits: _Fits) -> HeldOut:
        """Each used sample as the fit without its fold predicts it; NaN where that fit failed."""
        n, good = len(self.fold), fits.good
        force, error, valid = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, bool)
        for row in range(1, len(self.train)):
            held = self.used & ~self.train[row]
            if good[row]:
                force[held], error[held] = fits.force[row, held], fits.error[row, held]
                valid[held] = fits.valid[row, held]
        return HeldOut(force, error, valid, self.block)

    def errors(self, way: Way, curve: AbstractCurve) -> np.ndarray:
        """Mean square held-out errors of the blocks that decide, (blocks,) N^2; NaN if a fit failed."""
        fits = self.fits(way, curve)
        numbers = np.unique(self.block[self.decides])
        if not fits.good.all():
            return np.full(len(numbers), np.nan)
        square = (self.held_out(fits).force - self.series.force) ** 2
        return np.array([square[self.decides & (self.block == k)].mean() for k in numbers])


def _in_range(curves: FittedCurve, signals: np.ndarray) -> np.ndarray:
    """Flags (fits, n) of the signals within the range of each fit."""
    low, high = np.asarray(curves.pressure_range).T[:, :, None]
    margin = TOLERANCE * (high - low)
    return np.asarray((signals >= low - margin) & (signals <= high + margin))


def fit_series(
    series: LogSeries,
    use: np.ndarray,
    curves: Sequence[AbstractCurve],
    ways: Mapping[str, Way],
    loss: AbstractLoss,
    folds: int = FOLDS,
) -> FittedLog:
    """Choose how to combine the channels, then the curve, by held-out stretches of time, and fit the chosen ones.

    Raises:
        FitError: if no used sample is complete, or the fit of the only or of every candidate failed.
    """
    problem = _Problem(series, use, loss, folds)
    if not problem.used.any():
        raise FitError("no sample of the fitted part has both a force and all channels; record more.")
    named = [Tried(way, name, order) for order, (name, way) in enumerate(ways.items())]
    way, why, first = simplest("channels", named, lambda way: problem.errors(way, Affine()), "stretches of time")
    listed = [Tried(curve, CURVES.name_of(curve), curve.size) for curve in curves]
    curve, more, second = simplest("curve", listed, lambda curve: problem.errors(way, curve), "stretches of time")
    fits = problem.fits(way, curve)
    _require_success(curve, fits.curves.pad(0))
    return _fitted(problem, fits, way, curve, "; ".join(filter(None, [why, more])), first + second)


def _require_success(curve: AbstractCurve, fitted: FittedCurve) -> None:
    if int(fitted.result) != FitResult.SUCCESS:
        raise FitError(f"the {CURVES.name_of(curve)} curve could not be fitted: {fitted.message()}")


def _fitted(
    problem: _Problem, fits: _Fits, way: Way, curve: AbstractCurve, why: str, tried: tuple[Candidate, ...]
) -> FittedLog:
    series, held = problem.series, problem.held_out(fits)
    residual = np.where(held.valid & problem.decides, series.force - held.force, np.nan)
    groups = series.blocks(problem.used, NOISE_BLOCKS)
    noise = fit_log_noise(residual, series.time, held.force, held.error**2, groups)
    model = LogModel(fits.combination, fits.curves.pad(0), noise, reach_of(series.values[problem.used]))
    predicted = with_noise(noise, series.time, fits.force[0], fits.error[0], fits.valid[0])
    return FittedLog(model, predicted, held, way, curve, why, tried)


def ways_of(channels: int, most: int) -> dict[str, Any]:
    """The ways to combine this number of channels, the simplest first; `most` channels can be blended."""
    if channels == 1:
        return {"channel": None}
    blend = {"blend": BlendChannels()} if channels <= most else {}
    return {"best channel": BestChannel(), **blend, "Gaussian process": SmoothChannels()}
