"""Forces that a fitted model of the pads predicts for the presses of a table, on the host."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float

import jaxeit as je

from .curves.samples import by_rows
from .fields.fitted import LogGain, log_gain
from .pad_predictions import PadPrediction, independent, with_gain
from .pads import LocatedPresses, PadModel, curve_predictions, predict
from .results import FitResult


class PadForces(NamedTuple):
    """Predicted pad forces on the host, (n, pads) N, NaN without a fit; and the variance of their total by the model,
    (n,) N^2."""

    force: np.ndarray
    total_variance: np.ndarray


def predict_holds(model: PadModel, presses: LocatedPresses) -> PadForces:
    """Pad forces over the holds of the presses, (presses, pads)."""
    if model.curves.curve.path:
        series = presses.data.with_holds
        found = _predict_series(model, series.pressure, series.press, presses)
        return _valid_forces(model, jax.tree.map(lambda part: part[series.hold], found))
    return _valid_forces(model, by_rows(predict, presses.data.pressure, presses.places, before=(model,)))


def predict_samples(model: PadModel, presses: LocatedPresses) -> PadForces:
    """Pad forces at all samples of the presses, (n, pads)."""
    data = presses.data
    return _valid_forces(model, _predict_series(model, data.sample_pressure.T, data.sample_press, presses))


def _predict_series(model: PadModel, own: np.ndarray, press: np.ndarray, presses: LocatedPresses) -> PadPrediction:
    """Forces along own pressures (n, pads) Pa, at the places of the `press` (n,) of each row."""
    gain = (
        None
        if model.field is None or presses.places is None
        else by_rows(log_gain, presses.places, before=(model.field,))
    )
    rows = own, None if gain is None else LogGain(*(part[press] for part in gain))
    found: PadPrediction = by_rows(_with_gains, *rows, before=(model,))
    return found


@je.verb
def _with_gains(model: PadModel, own: Float[Array, "n pads"], gain: LogGain | None) -> PadPrediction:
    """`PadModel.predict` with known gains (None: the curves alone)."""
    found = curve_predictions(model.curves, own)
    return (
        independent(found) if model.field is None or gain is None else with_gain(found, gain, model.field.field.shared)
    )


def _valid_forces(model: PadModel, found: PadPrediction) -> PadForces:
    good = np.asarray(model.curves.result) == FitResult.SUCCESS
    return PadForces(np.where(good, found.force, np.nan), np.asarray(found.total_variance))
