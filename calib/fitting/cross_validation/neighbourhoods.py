"""Calibration of the standard errors of a field, by presses held out with their neighbourhoods.

Presses on a grid that is aligned with the walls have few distances to walls. A field of these distances then predicts a
held-out press from others of the same distances: its error says nothing of the places between the distances, where
the field bends as its basis does. Presses whose fields are alike are therefore held out together, and the ratio of the
errors to those stated is the factor by which standard errors of the field are multiplied.
"""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage

from ..curves.base import AbstractCurve
from ..curves.samples import by_rows
from ..fields.base import AbstractField
from ..fields.fitted import FittedField, centred_features
from ..fields.places import Places
from ..intervals import NORMAL_MULTIPLE, NoiseLaw, fit_variance_components
from ..pads import PadModel
from .held_out import Folds, HeldOut, join_folds
from .scores import assign_folds

# Least correlation of the fields at two places of one neighbourhood, by the prior: each place then explains half of the
# variance of the other.
MIN_CORRELATION = np.sqrt(0.5)
# Largest number of fits without a neighbourhood; of more neighbourhoods, several are held out together.
MAX_FITS = 12


def field_neighbourhoods(fitted: FittedField, places: Places, share: np.ndarray) -> np.ndarray:
    """Number of the neighbourhood of each press, (presses,): the fields of any two presses of one are correlated.

    Args:
        places: of the presses.
        share: of each pad in a press, (presses, pads).
    """
    rows = np.einsum(
        "np,npm->nm", np.nan_to_num(share), by_rows(centred_features, places, before=(fitted,)).astype(float)
    )
    shapes = np.tile(fitted.field.shapes(), (1, 1 if fitted.field.shared else fitted.geometry.pads))
    rows = rows * np.sqrt(shapes.mean(0))
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    unit = rows / np.where(length > 0, length, 1)
    cluster = fcluster(linkage(unit, "complete"), np.sqrt(2 - 2 * MIN_CORRELATION), "distance")
    return np.asarray(cluster)


def error_scale(folds: Folds, curve: AbstractCurve, model: PadModel, noise: NoiseLaw) -> float:
    """Factor of the field's standard errors, at least 1, by which errors in unknown neighbourhoods are as stated.

    Neighbourhoods are too few to tell a quantile. Intervals are `noise.multiple` standard errors wide, so that the
    factor makes those of the field as wide as of normal errors.

    Args:
        model: curve and field, fitted to all presses.
        noise: of means over holds.
    """
    presses = folds.presses
    places = None if model.field is None else presses.of(model.field.field)
    if model.field is None or places is None:
        return 1.0
    group = field_neighbourhoods(model.field, places, presses.data.share)
    count = len(np.unique(group))
    if count < 2:
        return 1.0
    grouped = Folds(presses, folds.loss, assign_folds(group, min(MAX_FITS, count)))
    return _fit_error_scale(grouped, curve, model.field.field, noise, group)


def _fit_error_scale(
    folds: Folds, curve: AbstractCurve, field: AbstractField, noise: NoiseLaw, group: np.ndarray
) -> float:
    """The factor of largest normal likelihood; a neighbourhood counts as one, because its presses err together."""
    data, held = folds.presses.data, folds.hold_out(curve, field)
    force, stated = held.hold
    residual, known = data.force - force.sum(1), np.asarray(noise.variance(jnp.asarray(force))).sum(1)
    finite = np.isfinite(residual) & np.isfinite(known) & np.isfinite(stated)
    if not finite.any():
        return 1.0
    _, number, count = np.unique(group[finite], return_inverse=True, return_counts=True)
    found = fit_variance_components(residual[finite], known[finite], 1 / count[number], stated[finite, None])
    return max(1.0, float(found[0]) * NORMAL_MULTIPLE / float(noise.multiple))


def with_error_scale(model: PadModel, scale: float) -> PadModel:
    """The model, the standard errors of whose field are multiplied by `scale`; itself without a field."""
    if model.field is None:
        return model
    factor = jnp.asarray(scale, model.field.noise.dtype)
    found: PadModel = eqx.tree_at(lambda m: m.field.error_scale, model, factor)
    return found


def hold_out_scaled(folds: Folds, models: Mapping[int, PadModel], scale: float) -> HeldOut:
    """Predictions of every fold by the model without it, the errors of whose field are multiplied by `scale`."""
    parts = [folds.predict(with_error_scale(model, scale), frozenset({k})) for k, model in models.items()]
    return join_folds(parts, folds)
