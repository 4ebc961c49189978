"""The response of all pads together: a curve for each, times a field of gain over the place pressed.

The two are fitted in turn. Given the field, each curve is the robust fit of `fit_curves`, untouched, to forces over
gains; given the curves, the field is a linear fit in log force with evidence and covariance in closed form
(`fit_field`). As the field's mean over the presses of a pad is zero, neither moves the other's level: the covariances
of the two are each complete, and a few turns agree to well within the noise. One joint least-squares problem would
give the same numbers but neither the evidence nor the sandwich over places.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxeit as je

from .choice import Candidate, Tried, simplest
from .curves import AbstractCurve, curve_name
from .fit import AbstractLoss, FitResult, FittedCurve, Prediction, bucket, fit_curves, predict_pads
from .location import AbstractField, FittedField, Geometry, Places, field_name, fit_field, log_gain
from .response import assign_folds

_TURNS = 2
_FAINT = 0.05  # of the largest force: presses below weigh less, as their noise is not proportional


class PadSamples(NamedTuple):
    """What each pad's curve is fitted to, in order of time; rows that only fill up are not in `mask`.

    | field    | meaning                          | shape     | unit |
    |----------|----------------------------------|-----------|------|
    | rows     | of the samples in `PressData`    | (pads, m) |      |
    | pressure | of the pad                       | (pads, m) | Pa   |
    | force    |                                  | (pads, m) | N    |
    | mask     | samples to be fitted             | (pads, m) |      |
    | place    | number of the place pressed      | (pads, m) |      |
    """

    rows: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    mask: np.ndarray
    place: np.ndarray


@dataclass(frozen=True, eq=False)
class PressData:
    """Presses of one or more sessions: their samples, and the means over their holds.

    | field           | meaning                                                      | shape           | unit |
    |-----------------|--------------------------------------------------------------|-----------------|------|
    | sample_pressure | along the presses                                            | (pads, n)       | Pa   |
    | sample_force    |                                                              | (n,)            | N    |
    | sample_press    | row of the sample's press                                    | (n,)            |      |
    | mask            | samples from which a pad's curve is fitted                   | (pads, n)       |      |
    | pressure        | over the hold                                                | (presses, pads) | Pa   |
    | force           |                                                              | (presses,)      | N    |
    | place           | number of the place pressed                                  | (presses,)      |      |
    | reach           | lowest and highest corner of the box of places               | (2, 2)          | m    |
    """

    sample_pressure: np.ndarray
    sample_force: np.ndarray
    sample_press: np.ndarray
    mask: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    place: np.ndarray
    reach: np.ndarray

    @property
    def sample_place(self) -> np.ndarray:
        """Number of the place of each sample, (n,)."""
        return self.place[self.sample_press]

    def samples_for(self, curve: AbstractCurve) -> PadSamples:
        """All samples for a curve with a path; for one that forgets, none but the pad's own: of four, a quarter."""
        everything = np.broadcast_to(np.arange(len(self.sample_force)), self.mask.shape)
        rows = everything if curve.path else self._own
        pressure, mask = (np.take_along_axis(a, rows, 1) for a in (self.sample_pressure, self.mask))
        return PadSamples(rows, pressure, self.sample_force[rows], mask, self.sample_place[rows])

    @cached_property
    def _own(self) -> np.ndarray:
        """Each pad's samples in `mask`, those that are missing, and others that fill up, (pads, m) in order of time."""
        wanted = self.mask | ~(np.isfinite(self.sample_pressure) & np.isfinite(self.sample_force))
        most = wanted.sum(1).max(initial=0)
        return np.argsort(~wanted, axis=1, kind="stable")[:, :most]


@dataclass(frozen=True, eq=False)
class Hybrid:
    """The fitted curves, and the field they are multiplied with (None: no correction by location)."""

    curves: FittedCurve
    field: FittedField | None = None

    def pad_forces(self, pressures, places: Places | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force on each pad, its standard error (N) and validity, (n, pads), from pressures (n, pads) Pa.

        Without places, a field says nothing but how uncertain that leaves the force. Not valid: beyond the pressures
        fitted, or a pad whose fit failed.
        """
        p = jnp.asarray(pressures, self.curves.parameters.dtype)
        found = pad_forces(self.curves, self.field, p, places)
        return tuple(map(np.asarray, found))  # type: ignore[return-value]

    def log_gains(self, places: Places) -> np.ndarray:
        """Log of the gain of each pad at places, (n, pads)."""
        assert self.field is not None
        return np.asarray(log_gain(self.field, places).mean)

    @property
    def scatter(self) -> np.ndarray:
        """Root mean square distance of single samples from each pad's response, (pads,) N."""
        return np.asarray(self.curves.residual_rms)


@je.verb
def pad_forces(
    curves: FittedCurve, field: FittedField | None, pressures: Float[Array, "n pads"], places: Places | None = None
) -> Prediction:
    """`Hybrid.pad_forces` as one program: arrays (n, pads)."""
    predicted = predict_pads(curves, pressures.T)
    force, error, valid = (part.T for part in predicted)
    if field is None:
        return Prediction(force, error, valid)
    gain = field.log_gain(nowhere(pressures) if places is None else places)
    factor = jnp.exp(gain.mean)
    return Prediction(force * factor, factor * jnp.sqrt(error**2 + force**2 * gain.variance), valid)


def nowhere(pressures: Float[Array, "n pads"], contacts: int = 1) -> Places:
    """Places of which nothing is known."""
    n, pads = pressures.shape
    position = jnp.full((n, contacts, 2), jnp.nan, pressures.dtype)
    weight, none = (jnp.zeros((n, contacts, *more), pressures.dtype) for more in ((pads,), ()))
    return Places(position, weight, none + jnp.nan, none)


def fit_hybrid(
    curve: AbstractCurve,
    field: AbstractField | None,
    data: PressData,
    geometry: Geometry,
    places: Places | None,
    loss: AbstractLoss,
    *,
    use: np.ndarray | None = None,
) -> Hybrid:
    """Curves and field from the presses that `use` (presses,) marks; all by default.

    Look at `curves.result` and `field.result`: nothing is raised for samples that do not determine them.
    """
    use = np.ones(len(data.force), bool) if use is None else use
    hybrid = Hybrid(_curves(curve, data, np.zeros_like(data.sample_pressure), use, loss))
    if field is None or places is None:
        return hybrid
    mean = np.zeros_like(data.pressure)
    for _ in range(_TURNS):
        fitted = _field(field, hybrid.curves, mean, data, geometry, places, use)
        mean = np.asarray(log_gain(fitted, places).mean)
        hybrid = Hybrid(_curves(curve, data, mean[data.sample_press].T, use, loss), fitted)
    return hybrid


def _curves(curve, data: PressData, gain: np.ndarray, use: np.ndarray, loss) -> FittedCurve:
    """Each pad's curve through forces over gains, each with the noise that the division left it."""
    own = data.samples_for(curve)
    less = np.exp(-np.take_along_axis(gain, own.rows, 1))
    mask = own.mask & use[data.sample_press][own.rows]
    return fit_curves(curve, own.pressure, own.force * less, mask=mask, groups=own.place, sigma=less, loss=loss)


_fit_field = je.verb(fit_field)


def _field(field, curves: FittedCurve, gain, data: PressData, geometry, places: Places, use) -> FittedField:
    """The field that is left of the presses' log forces by the curves; `gain` is the one they were fitted with."""
    force = np.asarray(predict_pads(curves, jnp.asarray(data.pressure.T)).force).T * np.exp(gain)
    part = np.maximum(np.nan_to_num(force), 0)
    total = part.sum(1)
    use = use & (total > 0) & (data.force > 0)
    share = part / np.where(total > 0, total, 1)[:, None]
    log_ratio = np.log(np.where(use, data.force / np.where(use, total, 1), 1)) + (share * gain).sum(1)
    weight = np.where(use, _weights(data.force, data.place, use), 0)
    extra = bucket(len(use)) - len(use)  # presses without weight, so that compiled fits are reused
    rows = [np.pad(a, [(0, extra)] + [(0, 0)] * (a.ndim - 1)) for a in (log_ratio, share, weight)]
    wide = jax.tree.map(lambda a: jnp.pad(a, [(0, extra)] + [(0, 0)] * (a.ndim - 1)), places)
    y, x, w = map(jnp.asarray, rows)
    return _fit_field(field, geometry, wide, y, x, w, jnp.asarray(data.reach))


def _weights(force: np.ndarray, place: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Places count once however often they are pressed, faint presses less."""
    faint = _FAINT * force[use].max(initial=0)
    weight = force**2 / (force**2 + faint**2)
    return weight / np.maximum(np.bincount(place, use)[place], 1)


def hold_out(
    curve: AbstractCurve,
    field: AbstractField | None,
    data: PressData,
    geometry: Geometry,
    places: Places | None,
    loss: AbstractLoss,
    fold: np.ndarray,
) -> np.ndarray:
    """Pad forces over the hold of every press, (presses, pads) N, by fits that never saw its fold (presses,)."""
    out = np.full(data.pressure.shape, np.nan)
    for k in np.unique(fold):
        held = fold == k
        hybrid = fit_hybrid(curve, field, data, geometry, places, loss, use=~held)
        force, _, _ = hybrid.pad_forces(data.pressure, places)
        good = np.asarray(hybrid.curves.result) == FitResult.SUCCESS
        out[held] = np.where(good, force, np.nan)[held]
    return out


class Choice(NamedTuple):
    """A curve and a field, in words why these, and all that were tried (empty where there was nothing to choose)."""

    curve: AbstractCurve
    field: AbstractField | None
    why: str
    tried: tuple[Candidate, ...] = ()


def choose(
    curves: Sequence[AbstractCurve],
    fields: Sequence[AbstractField | None],
    data: PressData,
    geometry: Geometry,
    places: Places | None,
    loss: AbstractLoss,
    fold: np.ndarray,
) -> Choice:
    """The simplest field, then the simplest curve, whose held-out error is within one standard error of the least.

    The error is the mean over places of the mean square over a press's samples, so that all loads of a ramp count,
    predicted by fits that never saw the place (see `simplest`). The field is chosen with the first curve; simple means
    few coefficients.
    """

    def judged(curve, field):
        return place_errors(curve, field, data, geometry, places, loss, fold)

    by_field = [Tried(f, _field_title(f), 0 if f is None else f.size(geometry.pads)) for f in fields]
    field, why, first = simplest("location", by_field, lambda f: judged(curves[0], f), "places")
    by_curve = [Tried(c, curve_name(c), c.size) for c in curves]
    curve, more, second = simplest("curve", by_curve, lambda c: judged(c, field), "places")
    return Choice(curve, field, "; ".join(filter(None, [why, more])), first + second)


def _field_title(field: AbstractField | None) -> str:
    return "none" if field is None else field_name(field)


def place_errors(curve, field, data: PressData, geometry, places, loss, fold: np.ndarray) -> np.ndarray:
    """Mean square error of the total force at each place, (places,) N^2, by fits that never saw its fold."""
    total = np.full(data.sample_force.shape, np.nan)
    for k in np.unique(fold):
        hybrid = fit_hybrid(curve, field, data, geometry, places, loss, use=fold != k)
        held = fold[data.sample_press] == k
        total[held] = _sample_forces(hybrid, data, places).sum(0)[held]
    square = (total - data.sample_force) ** 2
    square = np.where(np.isfinite(data.sample_force) & np.isfinite(data.sample_pressure).all(0), square, 0)
    count = np.bincount(data.sample_place, minlength=data.place.max() + 1)
    return np.bincount(data.sample_place, square, len(count)) / np.maximum(count, 1)


def _sample_forces(hybrid: Hybrid, data: PressData, places: Places | None) -> np.ndarray:
    """Pad forces along the presses, (pads, n) N; NaN from pads whose fit failed."""
    force = np.asarray(_curve_forces(hybrid.curves, jnp.asarray(data.sample_pressure)))
    force = np.where((np.asarray(hybrid.curves.result) == FitResult.SUCCESS)[:, None], force, np.nan)
    if hybrid.field is None or places is None:
        return force
    return force * np.exp(np.asarray(log_gain(hybrid.field, places).mean)[data.sample_press].T)


@je.verb
def _curve_forces(curves: FittedCurve, pressure):
    return eqx.filter_vmap(lambda fitted, p: fitted.curve(fitted.parameters, p))(curves, pressure)


def thinned(
    press: np.ndarray, pressure: np.ndarray, force: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means of at most `most` equal stretches of each press: press (n,), pressure (n, pads) and force (n,), in order.

    A stretch with a missing sample is missing.
    """
    starts = np.flatnonzero(np.r_[True, press[1:] != press[:-1]]) if len(press) else np.empty(0, int)
    ends = np.append(starts[1:], len(press))
    cuts = [np.linspace(a, b, min(most, b - a) + 1).astype(int)[:-1] for a, b in zip(starts, ends, strict=True)]
    first = np.concatenate([*cuts, np.empty(0, int)]).astype(int)
    count = np.diff(np.append(first, len(press)))
    if not len(first):
        return press, pressure, force
    return press[first], np.add.reduceat(pressure, first) / count[:, None], np.add.reduceat(force, first) / count


def folds_by_place(place: np.ndarray, folds: int) -> np.ndarray:
    """(presses,) fold of each press; presses at one place stay together."""
    return assign_folds(place, min(folds, len(np.unique(place))))
