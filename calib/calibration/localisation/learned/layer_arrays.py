"""What was learned of the contact layer, as arrays of a calibration file."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxeit.tracking import GainField, LearnedLayer
from jaxeit.tracking.belief import PRESS_VARIANCES

from ...archives.arrays import shaped

_NUMBERS = {
    "length": ("m", "over which the log gain changes"),
    "level": ("1", "standard deviation of the level that all places share, before any contact"),
    "deviation": ("1", "standard deviation of the field, before any contact"),
    "norm": ("1", "root of the sum of squares of the bumps at a place"),
}


def layer_arrays(layer: LearnedLayer) -> dict[str, tuple[Any, str, str]]:
    """The arrays of what was learned of the contact layer; the first mode is the level and has no place."""
    numbers = {f"layer/{name}": (getattr(layer.field, name), *about) for name, about in _NUMBERS.items()}
    each, field = "for each variance of a press's effect", layer.field
    return numbers | {
        "layer/places": (field.places[1:], "m", "of the bumps that the log gain of the contact layer is made of"),
        "layer/sheet_error": (field.sheet_error, "1", "modes that each mode of the error of the sheet looks like"),
        "layer/mesh_error": (field.mesh_error, "1", "standard deviation of the log gain that mesh errors look like"),
        "layer/depth": (field.depth, "m", "of the sheet, by which loads spread; zero: loads are Gaussian"),
        "layer/mean": (layer.means, "1", f"of level and bumps, in their standard deviations before contact, {each}"),
        "layer/covariance": (layer.covariances, "1", "of these"),
        "layer/evidence": (layer.evidence, "1", f"log probability of all presses, {each}"),
        "layer/contacts": (layer.contacts, "1", "number of contacts that they were learned from"),
    }


def layer_from(arrays: Mapping[str, np.ndarray]) -> LearnedLayer | None:
    """What was learned of the contact layer, if anything was; early versions knew no effects of presses, no errors of
    sheet and mesh, or no depth of the sheet."""
    if "layer/mean" not in arrays:
        return None
    early, modes = "layer/evidence" not in arrays, np.shape(arrays["layer/mean"])[-1:]
    each = () if early else PRESS_VARIANCES.shape
    zero = np.zeros(())
    missing = {"layer/sheet_error": np.zeros((*modes, 0)), "layer/mesh_error": zero, "layer/depth": zero}
    arrays = missing | dict(arrays)
    shapes = {"mean": each + modes, "covariance": each + 2 * modes, "places": (sum(modes) - 1, 2)}
    shapes |= {"mesh_error": (), "depth": (), "sheet_error": modes + np.shape(arrays["layer/sheet_error"])[1:]}
    shapes |= dict.fromkeys(_NUMBERS, ()) | ({} if early else {"evidence": each})
    found = {name: shaped(arrays, f"layer/{name}", shape, "f") for name, shape in shapes.items()}
    for name, array in found.items():
        if not np.isfinite(array).all() or (name in _NUMBERS and array <= 0):
            raise ValueError(f"layer/{name} holds a number that is not finite, or zero or less")
    contacts = int(shaped(arrays, "layer/contacts", (), "iu"))
    if contacts < 0:
        raise ValueError(f"layer/contacts is {contacts}; nothing is learned from less than none")
    field = _field(found)
    if early:
        return LearnedLayer.normal(field, found["mean"], found["covariance"], contacts)
    return LearnedLayer(field, found["mean"], found["covariance"], found["evidence"], contacts)


def _field(found: Mapping[str, np.ndarray]) -> GainField:
    places = np.concatenate([np.full((1, 2), np.inf), found["places"]])
    numbers = {name: float(found[name]) for name in (*_NUMBERS, "mesh_error", "depth")}
    return GainField(places, sheet_error=found["sheet_error"], **numbers)
