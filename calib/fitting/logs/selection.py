"""Choice and fit of the model of a log, with what it predicts for stretches of time that it has not seen.

Every candidate is fitted to all used samples and, in the same compiled call, without each of a few folds. A fold is
several blocks of time dealt out in turn: a single long stretch would measure extrapolation to states that occur in it
alone. Only the later half of the blocks of a log is scored, because a model is chosen for what comes after the
recording, and soft sensors run in: their first minutes are like no later ones. Standard errors come from the blocks as
groups, because samples that follow each other err together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np

from ..cross_validation.selection import Candidate, Option, simplest
from ..curves import CURVES
from ..curves.base import AbstractCurve
from ..curves.elementary import Affine
from ..curves.fit import fit_curves
from ..curves.fitted import FittedCurve
from ..fields import FIELDS, AbstractField, FittedField
from ..losses import AbstractLoss
from ..results import FitError, FitResult
from .blend import BestChannel, BlendChannels, WithPlace
from .combination import AbstractCombination, one_channel
from .directions import count_cycles, travel_of
from .gaussian_process import SmoothChannels
from .location import LogLocation, bounding_box, box_coordinates, fit_gains, gain_ratios, in_box
from .model import (
    RANGE_MARGIN,
    LogModel,
    LogPrediction,
    channel_ranges,
    curve_forces,
    filter_signals,
    in_ranges,
    with_noise,
)
from .noise import fit_log_noise
from .series import LogSeries

Way = BestChannel | BlendChannels | SmoothChannels | WithPlace | None
"""How several channels become one signal; None: there is only one."""

# Parts of time whose errors count as one in the quantile of the interval. Half of them decide; a quantile of 90 % from
# ten would be their maximum, and many short ones err together.
NOISE_BLOCKS = 40
FOLDS = 5  # of blocks of time
ITERATIONS = 2  # of alternate fits of the gain over places and of the curve
WAY_PENALTY = 10.0  # effective coefficients that are added for a way over those of the one before it


class HeldOutSamples(NamedTuple):
    """Predictions of fits without the stretch of time of a sample; NaN for samples that are not used.

    | field    | meaning                                        | shape | unit |
    |----------|------------------------------------------------|-------|------|
    | force    |                                                | (n,)  | N    |
    | error    | standard error of the curve                    | (n,)  | N    |
    | valid    | channels within the ranges of the other folds  | (n,)  |      |
    """

    force: np.ndarray
    error: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class FittedLog:
    """A model fitted to used samples of a series, and how it was chosen.

    | field      | meaning                                                              |
    |------------|----------------------------------------------------------------------|
    | model      | the model fitted to all used samples                                 |
    | predicted  | its forces at all samples of the series, used or not                 |
    | held_out   | its forces without the stretch of time of each used sample           |
    | way, curve, field | what was chosen                                               |
    | why        | reason for the choice; empty: there was none                         |
    | tried      | the candidates                                                       |
    """

    model: LogModel
    predicted: LogPrediction
    held_out: HeldOutSamples
    way: Way
    curve: AbstractCurve
    field: AbstractField | None
    why: str
    tried: tuple[Candidate, ...]


class _Fits(NamedTuple):
    """Fits of one candidate: with all used samples (row 0), and without each fold."""

    combination: AbstractCombination
    curves: FittedCurve
    gains: FittedField | None
    force: np.ndarray
    error: np.ndarray
    valid: np.ndarray

    @property
    def succeeded(self) -> np.ndarray:
        """Flags (fits,): the fit with all samples succeeded; others need no covariance, but all parameters."""
        result, rank = np.asarray(self.curves.result), np.asarray(self.curves.rank)
        usable = (result == FitResult.SINGULAR) & (rank == self.curves.parameters.shape[1]) & (np.arange(len(rank)) > 0)
        if self.gains is not None:
            usable &= np.asarray(self.gains.result) == FitResult.SUCCESS
            result = np.where(np.asarray(self.gains.result) == FitResult.SUCCESS, result, self.gains.result)
        return np.asarray((result == FitResult.SUCCESS) | usable)

    @property
    def effective(self) -> float:
        """Effective coefficients of the field."""
        return 0.0 if self.gains is None else float(self.gains.effective[0])


class _Problem:
    """The samples, their folds and blocks; signals and fits are computed once."""

    def __init__(self, series: LogSeries, use: np.ndarray, loss: AbstractLoss, folds: int):
        self.series, self.loss = series, loss
        self.used = use & series.complete
        self.block = series.blocks(self.used)
        self.fold = self.block % folds
        self.scored = self.used & series.late(self.block)
        kept = [self.used, *(self.used & (self.fold != k) for k in np.unique(self.fold[self.used]))]
        self.train = np.stack([rows for rows in kept if rows.any()])
        self._signals: dict[str, tuple[AbstractCombination, np.ndarray]] = {}
        self._fits: dict[tuple[str, str, str], _Fits] = {}

    @property
    def over(self) -> str:
        """What is held out, in words."""
        return "stretches of time" if self.series.site is None else "places"

    @cached_property
    def box(self) -> np.ndarray:
        """Box of the used presses, (2, 2) m; the series has places."""
        assert self.series.place is not None
        return bounding_box(self.series.place[self.used & self.series.loaded])

    @cached_property
    def inside(self) -> np.ndarray:
        """Flags (fits, n): channels, and places, within the ranges of the samples of each fit."""
        values, place = self.series.values, self.series.place
        found = np.stack([in_ranges(channel_ranges(values[rows]), values) for rows in self.train])
        if place is None:
            return found
        pressed = self.train & self.series.loaded
        return np.asarray(found & np.stack([in_box(bounding_box(place[rows]), place) for rows in pressed]))

    def inputs(self, way: Way) -> np.ndarray:
        """The channels, and the place if the way takes it."""
        s = self.series
        if not isinstance(way, WithPlace) or s.place is None:
            return s.values
        return np.column_stack([s.values, box_coordinates(self.box, s.place)])

    def signals(self, way: Way) -> tuple[AbstractCombination, np.ndarray]:
        """The combination of all used samples, and the signals (fits, n) of the combinations of each fit."""
        key = _key(way)
        if key not in self._signals:
            self._signals[key] = self._combine(way)
        return self._signals[key]

    def _combine(self, way: Way) -> tuple[AbstractCombination, np.ndarray]:
        s, inputs = self.series, self.inputs(way)
        if way is None:
            return one_channel(0), np.broadcast_to(s.values[:, 0], self.train.shape)
        forces = [np.where(rows, s.force, np.nan) for rows in self.train]
        first: AbstractCombination = way(s.time, inputs, forces[0], Affine())
        near = way.near(first)
        others = [near(s.time, inputs, force, Affine()) for force in forces[1:]]
        return first, np.stack([one.signal(s.time, inputs) for one in (first, *others)])

    def fits(self, way: Way, curve: AbstractCurve, field: AbstractField | None = None) -> _Fits:
        """All fits of a candidate."""
        key = _key(way), CURVES.name_of(curve), "" if field is None else FIELDS.name_of(field)
        if key not in self._fits:
            combination, signals = self.signals(way)
            signals = filter_signals(curve, signals)
            fitted, gains, gain, spread = self._fit_candidate(curve, field, signals)
            force, error, _ = curve_forces(fitted, signals)
            error = gain * np.hypot(np.nan_to_num(error), np.nan_to_num(force) * spread)
            valid = self.inside & _in_range(fitted, signals)
            self._fits[key] = _Fits(combination, fitted, gains, gain * force, error, valid)
        return self._fits[key]

    def _fit_candidate(
        self, curve: AbstractCurve, field: AbstractField | None, signals: np.ndarray
    ) -> tuple[FittedCurve, FittedField | None, np.ndarray, np.ndarray]:
        """Curves and fields of all fits, and the gain (fits, n) with the standard deviation of its logarithm."""
        force, gain, spread = self.series.force, np.ones(self.train.shape), np.zeros(self.train.shape)
        options: dict[str, Any] = {"mask": self.train, "groups": self.block, "loss": self.loss}
        fitted, gains = fit_curves(curve, signals, force, **options), None
        for _ in range(0 if field is None else ITERATIONS):
            assert field is not None
            gains = self._fit_gains(field, curve_forces(fitted, signals)[0])
            gain, spread = self._sample_gains(gains)
            fitted = fit_curves(curve, signals, force / gain, **options)
        return fitted, gains, gain, spread

    def _fit_gains(self, field: AbstractField, curves: np.ndarray) -> FittedField:
        """The fields of the fits, from the force over that of the curves at each place."""
        s = self.series
        assert s.place is not None
        pressed, count = self.used & s.loaded, int(s.sites.max()) + 1
        at = s.sites[pressed]
        samples = np.maximum(np.bincount(at, minlength=count), 1)
        place = np.stack([np.bincount(at, one[pressed], count) / samples for one in s.place.T], 1)
        return fit_gains(field, self.box, place, gain_ratios(s.force, curves, self.train & pressed, s.sites, count))

    def _sample_gains(self, gains: FittedField) -> tuple[np.ndarray, np.ndarray]:
        assert self.series.place is not None
        each = [LogLocation(self.box, _fit_row(gains, k)).gains(self.series.place) for k in range(len(self.train))]
        return np.stack([gain for gain, _ in each]), np.sqrt(np.stack([variance for _, variance in each]))

    def held_out(self, fits: _Fits) -> HeldOutSamples:
        """Each used sample as the fit without its fold predicts it; NaN where that fit failed."""
        n, succeeded = len(self.fold), fits.succeeded
        found = HeldOutSamples(np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, bool))
        for row in range(1, len(self.train)):
            if succeeded[row]:
                _copy(fits, row, self.used & ~self.train[row], found)
        return found

    def errors(self, way: Way, curve: AbstractCurve, field: AbstractField | None = None) -> np.ndarray:
        """Mean square held-out errors of the blocks that decide, (blocks,) N^2; NaN if a fit failed."""
        fits = self.fits(way, curve, field)
        numbers = np.unique(self.block[self.scored])
        if not fits.succeeded.all():
            return np.full(len(numbers), np.nan)
        square = (self.held_out(fits).force - self.series.force) ** 2
        return np.array([square[self.scored & (self.block == k)].mean() for k in numbers])


def _key(way: Way) -> str:
    return f"{type(way.way).__name__} with place" if isinstance(way, WithPlace) else type(way).__name__


def _fit_row(gains: FittedField, row: int) -> FittedField:
    found: FittedField = jax.tree.map(lambda leaf: leaf[row], gains)
    return found


def _copy(fits: _Fits, row: int, rows: np.ndarray, found: HeldOutSamples) -> None:
    """Write what one fit predicts for the flagged samples."""
    for part, given in zip(found, (fits.force, fits.error, fits.valid), strict=True):
        part[rows] = given[row, rows]


def _in_range(curves: FittedCurve, signals: np.ndarray) -> np.ndarray:
    """Flags (fits, n) of the signals within the range of each fit."""
    low, high = np.asarray(curves.pressure_range).T[:, :, None]
    margin = RANGE_MARGIN * (high - low)
    return np.asarray((signals >= low - margin) & (signals <= high + margin))


def fit_series(
    series: LogSeries,
    use: np.ndarray,
    curves: Sequence[AbstractCurve],
    ways: Mapping[str, Way],
    loss: AbstractLoss,
    folds: int = FOLDS,
    fields: Sequence[AbstractField | None] = (None,),
) -> FittedLog:
    """Choose how to combine channels, the curve and the field by held-out parts of the log, and fit the chosen ones.

    Parts are stretches of time: ways are compared with an affine curve, then curves with the chosen way. If the series
    has places, these are held out, and all three are chosen together, because a gain over the place goes with a curve.

    Raises:
        FitError: if no used sample is complete, or the fit of the only or of every candidate failed.
    """
    problem = _Problem(series, use, loss, folds)
    if not problem.used.any():
        raise FitError("no sample of the fitted part has both a force and all channels; record more.")
    why: list[str] = []
    tried: tuple[Candidate, ...] = ()
    if len(ways) > 1 and series.site is None:
        (name, *_), reason, tried = _select(problem, ways, [Affine()], fields)
        why, ways = [reason], {name: ways[name]}
    (name, curve, field), reason, table = _select(problem, ways, curves, fields)
    fits = problem.fits(ways[name], curve, field)
    _require_success(curve, fits)
    return _fitted_log(
        problem, fits, (ways[name], curve, field), "; ".join(filter(None, [*why, reason])), tried + table
    )


def _select(
    problem: _Problem,
    ways: Mapping[str, Way],
    curves: Sequence[AbstractCurve],
    fields: Sequence[AbstractField | None],
) -> tuple[tuple[str, AbstractCurve, AbstractField | None], str, tuple[Candidate, ...]]:
    """The best of all ways with all curves and fields; a way that takes the place itself has no field."""
    parts = [part for part, of in (("channels", ways), ("curve", curves), ("location", fields)) if len(of) > 1]
    options = []
    for order, (name, way) in enumerate(ways.items()):
        for curve, field in product(curves, (None,) if isinstance(way, WithPlace) else fields):
            at = "none" if field is None else FIELDS.name_of(field)
            names = {"channels": name, "curve": CURVES.name_of(curve), "location": at}
            size = WAY_PENALTY * order + curve.size
            size += 0.0 if field is None else problem.fits(way, curve, field).effective
            options.append(Option((name, curve, field), ", ".join(names[part] for part in parts), size))
    return simplest(" and ".join(parts), options, lambda one: problem.errors(ways[one[0]], *one[1:]), problem.over)


def _require_success(curve: AbstractCurve, fits: _Fits) -> None:
    fitted = fits.curves.pad(0)
    if int(fitted.result) != FitResult.SUCCESS:
        raise FitError(f"the {CURVES.name_of(curve)} curve could not be fitted: {fitted.message()}")
    if not fits.succeeded[0]:
        raise FitError("the gain over the place could not be fitted: press more places, or leave the location out")


def _fitted_log(
    problem: _Problem, fits: _Fits, chosen: tuple[Way, AbstractCurve, AbstractField | None], why: str,
    tried: tuple[Candidate, ...],
) -> FittedLog:  # fmt: skip
    series, (way, curve, field), held = problem.series, chosen, problem.held_out(fits)
    residual = np.where(held.valid & problem.scored, series.force - held.force, np.nan)
    groups = series.blocks(problem.used, NOISE_BLOCKS)
    used = np.where(problem.used, series.force, np.nan)
    repetitions = count_cycles(used, series.log) if series.site is None else len(np.unique(series.sites[problem.used]))
    noise = fit_log_noise(residual, series.time, held.force, held.error**2, groups, repetitions)
    gains = None if fits.gains is None else _fit_row(fits.gains, 0)
    location = LogLocation(problem.box, gains) if gains is not None or isinstance(way, WithPlace) else None
    reach = channel_ranges(series.values[problem.used])
    travel = travel_of(used, series.log)
    model = LogModel(fits.combination, fits.curves.pad(0), noise, reach, location, travel)
    predicted = with_noise(noise, series.time, fits.force[0], fits.error[0], fits.valid[0])
    return FittedLog(model, predicted, held, way, curve, field, why, tried)


def ways_of(channels: int, most: int, places: bool = False) -> dict[str, Any]:
    """The ways to combine this number of channels, the simplest first; `most` channels can be blended.

    Args:
        places: also those that take the place of the contact as two further inputs. For one channel there are none: a
            curve and its gain over the place say what a function of signal and place can.
    """
    if channels == 1:
        return {"channel": None}
    blend = {"blend": BlendChannels()} if channels <= most else {}
    many: dict[str, Any] = {"best channel": BestChannel(), **blend, "Gaussian process": SmoothChannels()}
    if not places:
        return many
    also = {"blend with place": WithPlace(BlendChannels())} if channels + 2 <= most else {}
    return many | also | {"Gaussian process with place": WithPlace(SmoothChannels(coordinates=2))}
