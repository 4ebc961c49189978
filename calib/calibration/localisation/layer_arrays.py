"""What was learned of the contact layer, as arrays of a calibration file."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxeit.tracking import GainField, LearnedLayer

from ..archives.arrays import shaped

_NUMBERS = {
    "length": ("m", "over which the log gain changes"),
    "level": ("1", "standard deviation of the level that all places share, before any contact"),
    "deviation": ("1", "standard deviation of the field, before any contact"),
    "norm": ("1", "root of the sum of squares of the bumps at a place"),
}


def layer_arrays(layer: LearnedLayer) -> dict[str, tuple[Any, str, str]]:
    """The arrays of what was learned of the contact layer; the first mode is the level and has no place."""
    numbers = {f"layer/{name}": (getattr(layer.field, name), *about) for name, about in _NUMBERS.items()}
    return numbers | {
        "layer/places": (layer.field.places[1:], "m", "of the bumps that the log gain of the contact layer is made of"),
        "layer/mean": (layer.mean, "1", "of level and bumps, in their standard deviations before any contact"),
        "layer/covariance": (layer.covariance, "1", "of these"),
        "layer/evidence": (layer.evidence, "1", "log probability of all presses for each variance of a press's effect"),
        "layer/contacts": (layer.contacts, "1", "number of contacts that they were learned from"),
    }


def layer_from(arrays: Mapping[str, np.ndarray]) -> LearnedLayer | None:
    """What was learned of the contact layer, if anything was."""
    if "layer/mean" not in arrays:
        return None
    size = len(arrays["layer/mean"])
    shapes = {"mean": (size,), "covariance": (size, size), "places": (size - 1, 2)} | dict.fromkeys(_NUMBERS, ())
    found = {name: shaped(arrays, f"layer/{name}", shape, "f") for name, shape in shapes.items()}
    for name, array in found.items():
        if not np.isfinite(array).all() or (name in _NUMBERS and array <= 0):
            raise ValueError(f"layer/{name} holds a number that is not finite, or zero or less")
    places = np.concatenate([np.full((1, 2), np.inf), found["places"]])
    field = GainField(places, **{name: float(found[name]) for name in _NUMBERS})
    contacts = int(shaped(arrays, "layer/contacts", (), "iu"))
    if contacts < 0:
        raise ValueError(f"layer/contacts is {contacts}; nothing is learned from less than none")
    learned = LearnedLayer(field, found["mean"], found["covariance"], contacts)
    if "layer/evidence" not in arrays:  # of an early version
        return learned
    evidence = shaped(arrays, "layer/evidence", learned.evidence.shape, "f")
    if not np.isfinite(evidence).all():
        raise ValueError("layer/evidence holds a number that is not finite")
    return learned._replace(evidence=evidence)
