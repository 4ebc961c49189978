"""Cross-validation: forces predicted by fits without the place, pad, indenter or session of the press.

Cross-validation over places gives the error of presses between known places. The other splits give the error of
extrapolation: to a pad that was never pressed, another tip, another day. Intervals come from a bootstrap over places:
all presses of a place are drawn together, because they share the error of the place.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from ...presses.means import DOMINANT_SHARE
from ...presses.pooled import MIN_SHARE, PressData
from ..curves.base import AbstractCurve
from ..curves.fit import fit_curves
from ..fields.base import AbstractField
from ..fields.fitted import FittedField
from ..intervals import COVERAGE, NoiseLaw, fit_noise
from ..losses import AbstractLoss
from ..pads import LocatedPresses, PadModel, fit_pads
from ..press_forces import PadForces, predict_holds, predict_samples
from ..results import FitResult
from .scores import assign_folds

BOOTSTRAP_DRAWS = 2000  # with these the ends of a 90 % range vary by about 2 % of its length


class LeaveOutErrors(NamedTuple):
    """Errors of the total force over the holds, each part predicted by a fit to the others.

    | meaning                                                             | unit |
    |---------------------------------------------------------------------|------|
    | by: kind of part left out, in the singular, such as "pad"           |      |
    | parts: number of parts                                              |      |
    | presses: number of presses that were predicted                      |      |
    | rmse: root mean square error of all presses                         | N    |
    | low, high: ends of the 90 % interval of rmse over places            | N    |
    | worst: root mean square error of the worst part                     | N    |
    | note: why there are no errors; empty if there are                   |      |
    """

    by: str
    parts: int
    presses: int = 0
    rmse: float = float("nan")
    low: float = float("nan")
    high: float = float("nan")
    worst: float = float("nan")
    note: str = ""


def place_draws(place: np.ndarray) -> np.ndarray:
    """Counts of each press in bootstrap samples of places, (draws, presses), with a fixed seed."""
    _, first, index = np.unique(place, return_index=True, return_inverse=True)
    number = np.argsort(np.argsort(first))[index.ravel()]  # of each place, in the order of appearance
    count = len(first)
    draws = np.random.default_rng(0).integers(count, size=(BOOTSTRAP_DRAWS, count))
    return np.stack([np.bincount(draw, minlength=count) for draw in draws])[:, number]


def bootstrap_interval(draws: np.ndarray) -> tuple[float, float]:
    """Ends of the 90 % interval of the draws of a statistic."""
    low, high = np.quantile(draws, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2])
    return float(low), float(high)


def folds_by_place(place: np.ndarray, folds: int) -> np.ndarray:
    """Fold of each press, (presses,); all presses at one place have the same fold."""
    return assign_folds(place, min(folds, len(np.unique(place))))


class HeldOut(NamedTuple):
    """Forces predicted by fits without the fold of the press; NaN for pads whose fit failed.

    | field | meaning                                                   | shape      |
    |-------|-----------------------------------------------------------|------------|
    | hold  | forces of pads over the holds, variance of their total    | (presses,) |
    | along | the same at all samples of the presses                    | (n,)       |
    | fold  | of each press                                             | (presses,) |

    Noise laws and intervals take the variance of the total from the same rule, because the multiple of an interval is
    a quantile of errors over it.
    """

    hold: PadForces
    along: PadForces
    fold: np.ndarray

    def noise(self, data: PressData, use: np.ndarray | None = None) -> NoiseLaw:
        """The noise law of the residuals at the samples of the presses `use` (presses,), by default all."""
        rows = slice(None) if use is None else use[data.sample_press]
        force, variance = (part[rows] for part in self.along)
        residual = data.sample_force[rows] - force.sum(1)
        return fit_noise(residual, force, variance, data.sample_place[rows])

    def hold_noise(self, data: PressData, use: np.ndarray | None = None) -> NoiseLaw:
        """The noise law of the means over the holds of the presses `use` (presses,), by default all."""
        use = np.ones(len(data.force), bool) if use is None else use
        force, variance = (part[use] for part in self.hold)
        return fit_noise(data.force[use] - force.sum(1), force, variance, data.place[use])

    def half_widths(self, data: PressData, variance: np.ndarray) -> np.ndarray:
        """Half the 90 % interval of the total force over each hold, (presses,) N, by the residuals of other folds.

        Args:
            variance: of the total force by the model, (presses,) N^2.
        """
        force = self.hold.force
        half = np.full(len(force), np.nan)
        for k in np.unique(self.fold):
            held = self.fold == k
            if not held.all():
                half[held] = self.hold_noise(data, ~held).half_widths(force[held], variance[held])
        return half


class Folds:
    """Presses divided into folds by place, and the fits without some of the folds, each made once.

    | attribute | meaning                                                     | shape      |
    |-----------|-------------------------------------------------------------|------------|
    | presses   | the presses with their places                               |            |
    | loss      | robust loss of the curve fits                               |            |
    | fold      | fold of each press, the same for all at one place           | (presses,) |
    """

    def __init__(self, presses: LocatedPresses, loss: AbstractLoss, fold: np.ndarray):
        self.presses, self.loss, self.fold = presses, loss, fold
        self._fits: dict[tuple[int, int, frozenset[int]], tuple[PadModel, object]] = {}

    @property
    def indices(self) -> list[int]:
        """Indices of the folds."""
        indices: list[int] = np.unique(self.fold).tolist()
        return indices

    def _in_folds(self, folds: frozenset[int]) -> np.ndarray:
        return np.isin(self.fold, list(folds))

    def fit(self, curve: AbstractCurve, field: AbstractField | None, without: frozenset[int]) -> PadModel:
        """The fit of curve and field to the presses of all folds but these."""
        key = id(curve), id(field), without
        if key not in self._fits:
            model = fit_pads(curve, field, self.presses, self.loss, use=~self._in_folds(without))
            self._fits[key] = model, (curve, field)  # the choices are kept too, so that no other takes their id
        return self._fits[key][0]

    def predict(self, model: PadModel, within: frozenset[int]) -> HeldOut:
        """Forces of the presses of these folds; NaN for the others."""
        held, data = self._in_folds(within), self.presses.data
        out = HeldOut(_empty_forces(data.pressure.shape), _empty_forces(data.sample_pressure.T.shape), self.fold)
        _fill(out.hold, predict_holds(model, self.presses), held)
        _fill(out.along, predict_samples(model, self.presses), held[data.sample_press])
        return out

    def hold_out(
        self, curve: AbstractCurve, field: AbstractField | None, without: frozenset[int] = frozenset()
    ) -> HeldOut:
        """Pad forces of every press by fits without its fold and without the folds `without`; NaN for the latter."""
        singles = [frozenset({k}) for k in self.indices if k not in without]
        return join_folds([self.predict(self.fit(curve, field, fold | without), fold) for fold in singles], self)

    def place_errors(
        self, curve: AbstractCurve, field: AbstractField | None, without: frozenset[int] = frozenset()
    ) -> np.ndarray:
        """Mean square error of the total force at each place, (places,) N^2, by fits without the fold of the place.

        Places in the folds `without` are left out. NaN at all places if a fit fails: its errors must not be compared
        with those of others. Pads at rest bear the same force for every candidate: some curves vanish there, and would
        be chosen because they leave out the noise of pads that nobody presses.
        """
        data, held = self.presses.data, self.hold_out(curve, field, without)
        kept = ~self._in_folds(without)
        if not np.isfinite(held.hold.force[kept]).all():
            return np.full(len(np.unique(data.place[kept])), np.nan)
        at_rest = data.rest_forces.T
        square = (np.where(np.isfinite(at_rest), at_rest, held.along.force).sum(1) - data.sample_force) ** 2
        square = np.where(np.isfinite(data.sample_force) & np.isfinite(data.sample_pressure).all(0), square, 0)
        rows = kept[data.sample_press]
        _, place, count = np.unique(data.sample_place[rows], return_inverse=True, return_counts=True)
        return np.bincount(place, square[rows]) / count


def join_folds(parts: Sequence[HeldOut], folds: Folds) -> HeldOut:
    """Predictions of several folds as one."""
    data = folds.presses.data
    out = HeldOut(_empty_forces(data.pressure.shape), _empty_forces(data.sample_pressure.T.shape), folds.fold)
    for part in parts:
        for target, source in ((out.hold, part.hold), (out.along, part.along)):
            _fill(target, source, np.isfinite(source.force).any(1))
    return out


def _empty_forces(shape: tuple[int, ...]) -> PadForces:
    return PadForces(np.full(shape, np.nan), np.full(shape[0], np.nan))


def _fill(out: PadForces, source: PadForces, rows: np.ndarray) -> None:
    for target, values in zip(out, source, strict=True):
        target[rows] = values[rows]


def hold_out_image(image_sum: np.ndarray, force: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """Total force by the image alone, (presses,) N: integral (presses,) S m^2 times a gain fitted without the fold."""
    out = np.empty(len(image_sum))
    for k in np.unique(fold):
        held = fold == k
        gain = force[~held].sum() / image_sum[~held].sum() if (~held).any() else np.nan
        out[held] = gain * image_sum[held]
    return out


def leave_groups_out(
    curve: AbstractCurve,
    field: AbstractField | None,
    presses: LocatedPresses,
    loss: AbstractLoss,
    groups: Mapping[str, np.ndarray],
) -> tuple[LeaveOutErrors, ...]:
    """A `LeaveOutErrors` for every grouping of the presses.

    Args:
        groups: number of each press's part, (presses,), for each kind of part; -1: in none, and never left out.
            A left-out "pad" is predicted by one curve of all other pads, and by the field that it shares with them.
    """
    return tuple(
        _leave_out(
            by, part, presses, partial(_fit_with_other_pads if by == "pad" else fit_pads, curve, field, presses, loss)
        )
        for by, part in groups.items()
    )


def _leave_out(by: str, part: np.ndarray, presses: LocatedPresses, fit: Callable[..., PadModel]) -> LeaveOutErrors:
    data, parts = presses.data, np.unique(part[part >= 0])
    if len(parts) < 2:
        return LeaveOutErrors(by, len(parts), note=f"the presses are of one {by} only: record presses of another too")
    error = np.full(len(data.force), np.nan)
    for k in parts:
        held = part == k
        force = predict_holds(fit(use=~held), presses).force
        error[held] = (force.sum(1) - data.force)[held]
    if not np.isfinite(error[part >= 0]).all():
        return LeaveOutErrors(
            by, len(parts), note=f"without one {by} the rest does not determine the fit: record more presses"
        )
    return _errors(by, error, part, data.place)


def _errors(by: str, error: np.ndarray, part: np.ndarray, place: np.ndarray) -> LeaveOutErrors:
    predicted_rows = part >= 0
    square, part = error[predicted_rows] ** 2, part[predicted_rows]
    weight = place_draws(place[predicted_rows])
    draws = np.sqrt(weight @ square / weight.sum(1))
    worst = max(np.sqrt(square[part == k].mean()) for k in np.unique(part))
    return LeaveOutErrors(
        by, len(np.unique(part)), len(square), float(np.sqrt(square.mean())), *bootstrap_interval(draws), float(worst)
    )


def _fit_with_other_pads(
    curve: AbstractCurve,
    field: AbstractField | None,
    presses: LocatedPresses,
    loss: AbstractLoss,
    *,
    use: np.ndarray,
) -> PadModel:
    """As `fit_pads`; a pad without presses of its own in `use` gets one curve, fitted to the samples of all others."""
    data, places = presses.data, presses.of(field)
    empty = np.flatnonzero(~(use[:, None] & (data.share >= DOMINANT_SHARE)).any(0))
    use = use & (data.share[:, empty] < MIN_SHARE).all(1)
    found = fit_pads(curve, field, presses, loss, use=use)
    dominant = data.mask & (use[:, None] & (data.share >= DOMINANT_SHARE))[data.sample_press].T
    gain = 0.0 if found.field is None or places is None else found.log_gains(places)[data.sample_press].T
    pooled = fit_curves(
        curve,
        np.where(dominant, data.sample_pressure, 0).sum(0)[None],
        data.sample_force * np.exp(-np.where(dominant, gain, 0).sum(0)),
        mask=dominant.any(0),
        groups=data.sample_place,
        loss=loss,
    )
    if not len(empty) or np.asarray(pooled.result)[0] != FitResult.SUCCESS:
        return found

    def replace_empty(pads: jax.Array, common: jax.Array) -> np.ndarray:
        values = np.array(pads)
        values[empty] = np.asarray(common)[0]
        return values

    curves = jax.device_put(jax.tree.map(replace_empty, found.curves, pooled))
    return replace(found, curves=curves, field=_with_mean_features(found.field, empty))


def _with_mean_features(field: FittedField | None, empty: np.ndarray) -> FittedField | None:
    """The field, with the mean features of the other pads taken for the `empty` pads, which have no presses."""
    if field is None:
        return None
    centre = np.array(field.centre)
    centre[empty] = np.delete(centre, empty, axis=0).mean(0)
    found: FittedField | None = eqx.tree_at(lambda f: f.centre, field, jax.device_put(centre))
    return found
