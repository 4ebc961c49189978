"""The response of all pads together: a curve for each pad, times a field of gain over the place pressed.

Curves and field are fitted in turn (backfitting). Given the field, `fit_curves` fits each curve to the force that its
pad carries, over the gain: the measured force less that of the other pads by their own curves, so that presses across
the edge of two pads count for both. Given the curves, `fit_field` is a linear fit in log force, with evidence and
covariance in closed form. The mean of the field over the presses of a pad is zero, so that neither changes the level of
the other: the covariance of each is complete, and a few alternations agree to well within the noise. One joint
least-squares problem would give the same numbers, but neither the evidence nor the sandwich covariance over places.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

import jaxeit as je

from ..presses.crosstalk import own_deviations, own_pressures
from ..presses.pooled import REST_FRACTION, PressData, PressSeries, with_holds
from .curves.base import AbstractCurve
from .curves.fit import fit_curves
from .curves.fitted import FittedCurve, Prediction, predict_pads
from .curves.samples import bucket, by_rows
from .fields.base import AbstractField
from .fields.fit import fit_field
from .fields.fitted import FittedField, LogGain, log_gain
from .fields.geometry import Geometry
from .fields.places import Places, nowhere
from .intervals import NORMAL_MULTIPLE, NoiseLaw
from .losses import AbstractLoss
from .pad_gains import PadGains
from .pad_predictions import PadPrediction, independent, with_gain

ALTERNATIONS = 2  # of fits of the field and of the curves; more change the result by far less than the noise
# Fraction of the largest force below which presses weigh less: their noise is constant, not proportional to the force.
FAINT_FORCE = 0.05


class LocatedPresses(NamedTuple):
    """Presses with their places.

    | field    | meaning                                                    |
    |----------|------------------------------------------------------------|
    | data     | pressures and forces of the presses                        |
    | geometry | outlines of the pads and of the sheet                      |
    | places   | place of each press by its image; None: not estimated      |
    | steady   | the same, without errors of single images; None: not known |
    """

    data: PressData
    geometry: Geometry
    places: Places | None = None
    steady: Places | None = None

    def of(self, field: AbstractField | None) -> Places | None:
        """The places to which a field is fitted: `steady` ones where it asks for them and they are known."""
        return self.steady if field is not None and field.steady and self.steady is not None else self.places


class PadModel(eqx.Module):
    """The fitted response of all pads: from what their channels read to forces.

    | field      | meaning                                                            | shape        |
    |------------|--------------------------------------------------------------------|--------------|
    | curves     | pressure-force curve of each pad                                   |              |
    | field      | gain over the place pressed; None: no correction by location       |              |
    | crosstalk  | reading of channel i per own pressure of pad j; None: no crosstalk | (pads, pads) |
    | noise      | deviation of means over parts of a press about the model; None:    |              |
    |            | residuals' own                                                     |              |
    | hold_noise | deviation of means over a hold about the model; None: as `noise`   |              |
    | gains      | by which readings have moved since the fit; None: not moved        |              |
    | sensor     | deviation of a single reading from the mean at rest, Pa; None: not | (pads,)      |
    |            | known                                                              |              |
    """

    curves: FittedCurve
    field: FittedField | None = None
    crosstalk: Float[Array, "pads pads"] | None = None
    noise: NoiseLaw | None = None
    hold_noise: NoiseLaw | None = None
    gains: PadGains | None = None
    sensor: Float[Array, " pads"] | None = None

    @property
    def dtype(self) -> np.dtype:
        """Precision of the fitted curves."""
        return self.curves.parameters.dtype

    def own(self, readings: Float[Array, "n pads"]) -> Float[Array, "n pads"]:
        """The pads' own pressures at the time of the fit, without crosstalk, from readings (n, pads) Pa; pure."""
        return self._remove_crosstalk(readings if self.gains is None else self.gains.to_calibrated(readings))

    def _remove_crosstalk(self, readings: Float[Array, "n pads"]) -> Float[Array, "n pads"]:
        return readings if self.crosstalk is None else own_pressures(self.crosstalk, readings)

    def forces(
        self,
        readings: Float[Array, "n pads"],
        places: Places | None = None,
        before: Float[Array, "m pads"] | None = None,
    ) -> PadPrediction:
        """Forces from readings (n, pads) Pa and own pressures `before` them, with the errors of the gains; pure."""

        def response(calibrated: Array) -> PadPrediction:
            return self._predict_after(self._remove_crosstalk(calibrated), places, before)

        return response(readings) if self.gains is None else self.gains.forces(response, readings)

    def _predict_after(self, own: Array, places: Places | None, before: Array | None) -> PadPrediction:
        """`predict` for curves with memory that start from own pressures `before` (m, pads)."""
        if before is None:
            return self.predict(own, places)
        first, series = len(before), jnp.concatenate([before, own])
        if places is not None:
            places = places[jnp.maximum(jnp.arange(len(series)) - first, 0)]
        return PadPrediction(*(part[first:] for part in self.predict(series, places)))

    @property
    def coefficients(self) -> float:
        """Number of effective coefficients of all curves and the field."""
        field = 0.0 if self.field is None else float(self.field.effective)
        return float(np.sum(self.curves.rank)) + field

    @property
    def idle_noise(self) -> Float[Array, " pads"]:
        """Standard deviation of the force of each pad without load, (pads,) N."""
        floor = self._noise.floor * self._noise.scale
        if self.sensor is None:
            return floor
        rest = jnp.zeros_like(self.sensor)[None]
        level, noisy = predict(self, jnp.concatenate([rest, self._own_noise(rest)])).force
        return jnp.hypot(floor, noisy - level)

    def predict(self, own: Float[Array, "n pads"], places: Places | None = None) -> PadPrediction:
        """Forces from the pads' own pressures (n, pads) Pa; pure. Without places the gain is one, and the standard
        error includes its variation over the pad."""
        found = curve_predictions(self.curves, own)
        if self.field is None:
            return independent(found)
        gain = self.field.log_gain(nowhere(own) if places is None else places)
        return with_gain(found, gain, self.field.field.shared)

    def single(
        self,
        readings: Float[Array, "n pads"],
        places: Places | None = None,
        before: Float[Array, "m pads"] | None = None,
    ) -> PadPrediction:
        """`forces` of single readings: the standard error includes the noise about the model and of the sensors; pure.

        Curves are fitted to means over parts of presses, which hold little of the sensors' noise. Without a noise law,
        the noise is that of the residuals of the fitted samples.
        """
        found = self.forces(readings, places, before)
        variance = self._noise.variance(found.force)
        if self.sensor is not None:
            # The force of a pad depends on its own pressure alone, so that all pads may be perturbed at once.
            noisy = self.own(readings) + self._own_noise(readings)
            variance += (self._predict_after(noisy, places, before).force - found.force) ** 2
        return found.with_noise(variance)

    def _own_noise(self, readings: Float[Array, "n pads"]) -> Float[Array, "n pads"]:
        """Standard deviation of the pads' own pressures (Pa) by the noise of the sensors, which must be known.

        A channel without a reading (NaN) adds nothing to the other pads.
        """
        assert self.sensor is not None
        noise = jnp.where(jnp.isfinite(readings), self.sensor, 0)
        noise = noise if self.gains is None else self.gains.to_calibrated(noise)
        return noise if self.crosstalk is None else own_deviations(self.crosstalk, noise)

    def pad_forces(
        self, pressures: Float[ArrayLike, "n pads"], places: Places | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force on each pad, its standard error (N) and validity, (n, pads), from readings (n, pads) Pa.

        The standard error is that of a single reading: it holds the uncertainty of curve and field, the noise about
        them, and that of the sensors. Without places, the gain is one, and the standard error includes its variation
        over the pad. A force is not valid outside the fitted pressures, or where the fit of the pad failed.
        """
        found = by_rows(pad_forces, np.asarray(pressures, self.dtype), places, before=(self,))
        return np.asarray(found.force), np.asarray(found.standard_error), np.asarray(found.valid)

    def hold_forces(
        self, pressures: Float[ArrayLike, "n pads"], places: Places | None = None, along: PressSeries | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Force on each pad (n, pads) N, and half the 90 % interval of their total (n,) N, of means over holds.

        The interval is narrower than that of a reading, because a mean holds less noise than the readings in it.
        See `PadPrediction` for errors of different pads.

        Args:
            pressures: means over the holds of presses, (n, pads) Pa.
            places: as for `pad_forces`.
            along: readings along the presses, on which the force of a curve with memory depends; default: each hold
                follows the one before.
        """
        if along is None or not self.curves.curve.path:
            found = by_rows(forces, np.asarray(pressures, self.dtype), places, before=(self,))
        else:
            series = with_holds(along, np.asarray(pressures))
            at = None if places is None else jax.tree.map(lambda part: part[series.press], places)
            found = by_rows(forces, np.asarray(series.pressure, self.dtype), at, before=(self,))
            found = jax.tree.map(lambda part: part[series.hold], found)
        force, noise = np.asarray(found.force), self._noise if self.hold_noise is None else self.hold_noise
        return force, noise.half_widths(force, np.asarray(found.total_variance))

    @property
    def multiple(self) -> float:
        """Half the 90 % interval of a reading, in its standard errors (`single`)."""
        return float(self._noise.multiple)

    @property
    def _noise(self) -> NoiseLaw:
        """The noise of a reading; without a law, that of the residuals of the fitted samples for all forces."""
        if self.noise is not None:
            return self.noise
        rms = self.curves.residual_rms
        one = jnp.ones((), rms.dtype)
        return NoiseLaw(one, 0 * one, rms, NORMAL_MULTIPLE * one)

    def log_gains(self, places: Places) -> np.ndarray:
        """Log of the gain of each pad at places, (n, pads). The model must have a field."""
        assert self.field is not None
        found: LogGain = by_rows(log_gain, places, before=(self.field,))
        return np.asarray(found.mean)


@je.verb
def pad_forces(model: PadModel, pressures: Float[Array, "n pads"], places: Places | None = None) -> PadPrediction:
    """`PadModel.pad_forces` as one program: arrays (n, pads)."""
    return model.single(pressures, places)


@je.verb
def forces(model: PadModel, pressures: Float[Array, "n pads"], places: Places | None = None) -> PadPrediction:
    """`PadModel.forces`, compiled."""
    return model.forces(pressures, places)


@je.verb
def predict(model: PadModel, own: Float[Array, "n pads"], places: Places | None = None) -> PadPrediction:
    """`PadModel.predict`, compiled."""
    return model.predict(own, places)


def fit_pads(
    curve: AbstractCurve,
    field: AbstractField | None,
    presses: LocatedPresses,
    loss: AbstractLoss,
    *,
    use: np.ndarray | None = None,
) -> PadModel:
    """Fit curves and field to the presses flagged in `use` (presses,), by default all.

    Check `curves.result` and `field.result`: no error is raised for samples that do not determine a fit.
    """
    data, places = presses.data, presses.of(field)
    use = np.ones(len(data.force), bool) if use is None else use
    gain, fitted = np.zeros_like(data.pressure), None
    curves = _fit_pad_curves(curve, data, data.share[data.sample_press].T * data.sample_force, gain, use, loss)
    alone = data.pressure.shape[1] == 1 and field is None
    for _ in range(0 if alone else ALTERNATIONS):
        if field is not None and places is not None:
            fitted = _fit_gains(field, curves, gain, presses, use)
            gain = by_rows(log_gain, places, before=(fitted,)).mean
        curves = _fit_pad_curves(curve, data, _partial_residuals(curves, data, gain), gain, use, loss)
    return PadModel(curves, fitted)


def _partial_residuals(curves: FittedCurve, data: PressData, gain: np.ndarray) -> np.ndarray:
    """Force on each pad at all samples, (pads, n) N: the measured force less that of the other pads by their curves."""
    fitted = np.nan_to_num(by_rows(_curve_forces, data.sample_pressure.T, before=(curves,)).T)
    fitted *= np.exp(gain[data.sample_press].T)
    return np.asarray(data.sample_force - (fitted.sum(0) - fitted))


def _fit_pad_curves(
    curve: AbstractCurve, data: PressData, force: np.ndarray, gain: np.ndarray, use: np.ndarray, loss: AbstractLoss
) -> FittedCurve:
    """Each pad's curve, fitted to its forces (pads, n) N over gains; the noise is divided by the gain too."""
    own = data.pad_samples(with_history=curve.path)
    inverse_gain = np.exp(-np.take_along_axis(gain[data.sample_press].T, own.rows, 1))
    mask = own.mask & use[data.sample_press][own.rows]
    if not _is_zero_at_rest(curve):
        top = np.where(mask, own.pressure, 0).max(1, initial=0)
        mask &= own.pressure >= REST_FRACTION * top[:, None]
    force = np.take_along_axis(force, own.rows, 1) * inverse_gain
    return fit_curves(curve, own.pressure, force, mask=mask, groups=own.place, sigma=inverse_gain, loss=loss)


_fit_field = je.verb(fit_field)


def _fit_gains(
    field: AbstractField, curves: FittedCurve, gain: np.ndarray, presses: LocatedPresses, use: np.ndarray
) -> FittedField:
    """The field fitted to log forces over those of the curves, which were fitted with the log-gain `gain`."""
    data = presses.data
    force = _hold_curve_forces(curves, data) * np.exp(gain)
    part = np.maximum(np.nan_to_num(force), 0)
    total = part.sum(1)
    use = use & (total > 0) & (data.force > 0)
    share = part / np.where(total > 0, total, 1)[:, None]
    log_ratio = np.log(np.where(use, data.force / np.where(use, total, 1), 1)) + (share * gain).sum(1)
    weight = np.where(use, _press_weights(data.force, data.place, use), 0)
    extra = bucket(len(use)) - len(use)  # presses without weight, so that compiled fits are reused
    rows = [np.pad(a, [(0, extra)] + [(0, 0)] * (a.ndim - 1)) for a in (log_ratio, share, weight)]
    places = jax.tree.map(lambda a: np.pad(a, [(0, extra)] + [(0, 0)] * (a.ndim - 1)), presses.of(field))
    y, x, w = map(jax.device_put, rows)
    return _fit_field(field, presses.geometry, places, y, x, w, jax.device_put(data.reach))


def _hold_curve_forces(curves: FittedCurve, data: PressData) -> np.ndarray:
    """Forces of the curves over the holds, (presses, pads) N; of curves with memory after the samples before them."""
    if not curves.curve.path:
        return np.asarray(by_rows(_curve_forces, data.pressure, before=(curves,)))
    series = data.with_holds
    return np.asarray(by_rows(_curve_forces, series.pressure, before=(curves,))[series.hold])


def _press_weights(force: np.ndarray, place: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Weights of the presses, (presses,): at most one for all at a place, and less for faint presses."""
    faint = FAINT_FORCE * force[use].max(initial=0)
    weight = force**2 / (force**2 + faint**2)
    return np.asarray(weight / np.maximum(np.bincount(place, use)[place], 1))


@je.verb
def _curve_forces(curves: FittedCurve, pressure: Float[Array, "n pads"]) -> Float[Array, "n pads"]:
    found: Array = eqx.filter_vmap(lambda fitted, p: fitted.curve(fitted.parameters, p))(curves, pressure.T)
    return (found * _load_factor(curves, pressure.T)).T


def curve_predictions(curves: FittedCurve, own: Float[Array, "n pads"]) -> Prediction:
    """Forces of the curves of all pads, (n, pads); a pad at rest bears none, whatever the offset of its curve."""
    found, load = predict_pads(curves, own.T), _load_factor(curves, own.T)
    return Prediction((found.force * load).T, (found.standard_error * load).T, found.valid.T)


def _is_zero_at_rest(curve: AbstractCurve) -> bool:
    return bool(curve.positive.all()) and not curve.path


def _load_factor(curves: FittedCurve, pressure: Float[Array, "pads n"]) -> Float[Array, "#pads #n"]:
    """From 0 at rest to 1 for a loaded pad; 1 everywhere for curves that are zero at rest by themselves.

    The offset of a curve, or the force that its memory holds, would otherwise count for every pad of the skin,
    pressed or not.
    """
    if _is_zero_at_rest(curves.curve):
        return jnp.ones((1, 1), pressure.dtype)
    return jnp.clip(pressure / (REST_FRACTION * curves.pressure_range[:, 1:]), 0, 1)
