"""The response of all pads together: a curve for each pad, times a field of gain over the place pressed.

Curves and field are fitted in turn. Given the field, `fit_curves` fits each curve to forces over gains. Given the
curves, `fit_field` is a linear fit in log force, with evidence and covariance in closed form. The mean of the field
over the presses of a pad is zero, so that neither changes the level of the other: the covariance of each is complete,
and a few alternations agree to well within the noise. One joint least-squares problem would give the same numbers, but
neither the evidence nor the sandwich covariance over places.
"""

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

import jaxeit as je

from ..presses.pooled import PressData
from .curves.base import AbstractCurve
from .curves.fit import fit_curves
from .curves.fitted import FittedCurve, Prediction, predict_pads
from .curves.samples import bucket
from .fields.base import AbstractField
from .fields.fit import fit_field
from .fields.fitted import FittedField, log_gain
from .fields.geometry import Geometry
from .fields.places import Places, nowhere
from .losses import AbstractLoss
from .results import FitResult

ALTERNATIONS = 2  # fits of the field, then of the curves; more change the result by far less than the noise
# Fraction of the largest force below which presses weigh less: their noise is constant, not proportional to the force.
FAINT_FORCE = 0.05


class LocatedPresses(NamedTuple):
    """Presses with their places.

    | field    | meaning                                                    |
    |----------|------------------------------------------------------------|
    | data     | pressures and forces of the presses                        |
    | geometry | outlines of the pads and of the sheet                      |
    | places   | place of each press by its image; None: not estimated      |
    """

    data: PressData
    geometry: Geometry
    places: Places | None = None


@dataclass(frozen=True, eq=False)
class Hybrid:
    """The fitted curves, and the field of gain that multiplies them (None: no correction by location)."""

    curves: FittedCurve
    field: FittedField | None = None

    def pad_forces(
        self, pressures: Float[ArrayLike, "n pads"], places: Places | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force on each pad, its standard error (N) and validity, (n, pads), from pressures (n, pads) Pa.

        Without places, the gain is one, and the standard error includes its variation over the pad. A force is not
        valid outside the fitted pressures, or where the fit of the pad failed.
        """
        p = jnp.asarray(pressures, self.curves.parameters.dtype)
        found = pad_forces(self.curves, self.field, p, places)
        return tuple(map(np.asarray, found))  # type: ignore[return-value]

    def log_gains(self, places: Places) -> np.ndarray:
        """Log of the gain of each pad at places, (n, pads). The response must have a field."""
        assert self.field is not None
        return np.asarray(log_gain(self.field, places).mean)

    @property
    def scatter(self) -> np.ndarray:
        """Root mean square residual of the samples of each pad, (pads,) N."""
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


def fit_hybrid(
    curve: AbstractCurve,
    field: AbstractField | None,
    presses: LocatedPresses,
    loss: AbstractLoss,
    *,
    use: np.ndarray | None = None,
) -> Hybrid:
    """Fit curves and field to the presses flagged in `use` (presses,), by default all.

    Check `curves.result` and `field.result`: no error is raised for samples that do not determine a fit.
    """
    data, places = presses.data, presses.places
    use = np.ones(len(data.force), bool) if use is None else use
    hybrid = Hybrid(_curves(curve, data, np.zeros_like(data.sample_pressure), use, loss))
    if field is None or places is None:
        return hybrid
    mean = np.zeros_like(data.pressure)
    for _ in range(ALTERNATIONS):
        fitted = _field(field, hybrid.curves, mean, presses, use)
        mean = np.asarray(log_gain(fitted, places).mean)
        hybrid = Hybrid(_curves(curve, data, mean[data.sample_press].T, use, loss), fitted)
    return hybrid


def _curves(
    curve: AbstractCurve, data: PressData, gain: np.ndarray, use: np.ndarray, loss: AbstractLoss
) -> FittedCurve:
    """Each pad's curve, fitted to forces over gains; the noise is divided by the gain too."""
    own = data.pad_samples(with_history=curve.path)
    less = np.exp(-np.take_along_axis(gain, own.rows, 1))
    mask = own.mask & use[data.sample_press][own.rows]
    return fit_curves(curve, own.pressure, own.force * less, mask=mask, groups=own.place, sigma=less, loss=loss)


_fit_field = je.verb(fit_field)


def _field(
    field: AbstractField, curves: FittedCurve, gain: np.ndarray, presses: LocatedPresses, use: np.ndarray
) -> FittedField:
    """The field fitted to log forces over those of the curves, which were fitted with the log-gain `gain`."""
    data = presses.data
    force = np.asarray(predict_pads(curves, jnp.asarray(data.pressure.T)).force).T * np.exp(gain)
    part = np.maximum(np.nan_to_num(force), 0)
    total = part.sum(1)
    use = use & (total > 0) & (data.force > 0)
    share = part / np.where(total > 0, total, 1)[:, None]
    log_ratio = np.log(np.where(use, data.force / np.where(use, total, 1), 1)) + (share * gain).sum(1)
    weight = np.where(use, _weights(data.force, data.place, use), 0)
    extra = bucket(len(use)) - len(use)  # presses without weight, so that compiled fits are reused
    rows = [np.pad(a, [(0, extra)] + [(0, 0)] * (a.ndim - 1)) for a in (log_ratio, share, weight)]
    wide = jax.tree.map(lambda a: jnp.pad(a, [(0, extra)] + [(0, 0)] * (a.ndim - 1)), presses.places)
    y, x, w = map(jnp.asarray, rows)
    return _fit_field(field, presses.geometry, wide, y, x, w, jnp.asarray(data.reach))


def _weights(force: np.ndarray, place: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Weights of the presses, (presses,): those at one place sum to one at most, faint presses weigh less."""
    faint = FAINT_FORCE * force[use].max(initial=0)
    weight = force**2 / (force**2 + faint**2)
    return np.asarray(weight / np.maximum(np.bincount(place, use)[place], 1))


def sample_forces(hybrid: Hybrid, presses: LocatedPresses) -> np.ndarray:
    """Pad forces at all samples of the presses, (pads, n) N; NaN for pads whose fit failed."""
    data = presses.data
    force = np.asarray(_curve_forces(hybrid.curves, jnp.asarray(data.sample_pressure)))
    force = np.where((np.asarray(hybrid.curves.result) == FitResult.SUCCESS)[:, None], force, np.nan)
    if hybrid.field is None or presses.places is None:
        return force
    return np.asarray(force * np.exp(hybrid.log_gains(presses.places)[data.sample_press].T))


@je.verb
def _curve_forces(curves: FittedCurve, pressure: Float[Array, "pads n"]) -> Float[Array, "pads n"]:
    found: Array = eqx.filter_vmap(lambda fitted, p: fitted.curve(fitted.parameters, p))(curves, pressure)
    return found
