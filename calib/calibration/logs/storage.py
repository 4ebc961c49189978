"""Convert the calibration of a log to the attributes and arrays of its file, and back."""

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxeit as je

from ...fitting.cross_validation.selection import Candidate
from ...fitting.curves import CURVES, FittedCurve
from ...fitting.fields import FIELDS
from ...fitting.logs import COMBINATIONS, AbstractCombination, LogLocation, LogModel, LogNoise, Travel
from ...session import Archive
from ..archives.storage import SEAL, field_arrays, field_from, seal
from .evaluation import LogEvaluation
from .shift import LogShift

Described = dict[str, tuple[Any, str, str]]

CURVE_FIELDS = {
    "parameters": "parameters of the curve, in its own units",
    "covariance": "of the parameters, over blocks of time",
    "pressure_range": "lowest and highest signal fitted, in the unit of the signal",
    "scale": "robust standard deviation of the residuals, N",
    "residual_rms": "root mean square residual, N",
    "n": "samples fitted",
    "n_missing": "samples not finite",
    "n_groups": "blocks of time fitted",
    "rank": "parameters that the samples determine",
    "result": "0: success",
}
NO_PLACE, PLACE_INPUTS = "none", "inputs"  # what a model does with the place, unless it has a field of gain
NOISE_FIELDS = {
    "floor": ("N", "standard deviation of a reading without force"),
    "fraction": ("1", "standard deviation of a reading per force"),
    "lag": ("s", "standard deviation of a reading per rate of the force"),
    "multiple": ("1", "half the 90 % interval, in standard deviations"),
}


def log_archive(given: Mapping[str, Any]) -> tuple[dict[str, Any], Described]:
    """The attributes and the arrays that hold a calibration with these fields, with its seal."""
    model: LogModel = given["model"]
    evaluation: LogEvaluation = given["evaluation"]
    attrs: dict[str, Any] = {
        "stream": given["stream"],
        "columns": given["columns"],
        "unit": given["unit"],
        "simulated": int(given["simulated"]),
        "notes": "\n".join(given["notes"]),
        "why": given["why"],
        "tried": json.dumps([candidate._asdict() for candidate in given["tried"]]),
        "curve": CURVES.name_of(model.curve.curve),
        "combination": model.combination.name,
        "location": location_name(model.location),
        **{f"provenance_{k}": v for k, v in given["provenance"].items()},
        **{f"evaluation_{k}": v for k, v in evaluation.attributes().items()},
    }
    arrays = {"channels/kept": (given["kept"], "", "numbers of the channels that are used"), **_model_arrays(model)}
    arrays |= {f"evaluation/{name}": about for name, about in evaluation.arrays().items()}
    shift: LogShift | None = given["shift"]
    if shift is not None:
        attrs, arrays = attrs | shift.attributes(), arrays | shift.arrays()
    plain = {k: (np.asarray(v), unit, text) for k, (v, unit, text) in arrays.items()}
    return attrs | {SEAL: seal(attrs, {k: v for k, (v, _, _) in plain.items()})}, plain


def _model_arrays(model: LogModel) -> Described:
    curve = model.curve
    arrays: Described = {"channels/reach": (model.reach, "", "lowest and highest fitted value of each channel")}
    arrays |= {
        f"combination/{k}": (v, "", "of the combination of channels") for k, v in model.combination.arrays().items()
    }
    arrays |= {f"curve/{name}": (getattr(curve, name), "", text) for name, text in CURVE_FIELDS.items()}
    arrays |= {
        f"curve/choice-{f.name}": (getattr(curve.curve, f.name), "", "setting of the curve")
        for f in fields(curve.curve)
    }
    if model.location is not None:
        arrays["location/box"] = (model.location.box, "m", "lowest and highest corner of the presses")
        arrays |= {} if model.location.gain is None else field_arrays(model.location.gain)
    arrays["force/travel"] = (np.array(model.travel), "N", "largest rise and fall of the fitted force")
    return arrays | {f"noise/{name}": (getattr(model.noise, name), *about) for name, about in NOISE_FIELDS.items()}


def location_name(location: LogLocation | None) -> str:
    """The name that files have for what a model does with the place."""
    if location is None:
        return NO_PLACE
    return PLACE_INPUTS if location.gain is None else FIELDS.name_of(location.gain.field)


def fields_of_log(archive: Archive) -> dict[str, Any]:
    """The fields of the calibration that `log_archive` described.

    Raises:
        KeyError, ValueError: for what is missing, was changed, or does not fit.
    """
    attrs, arrays = archive.attrs, archive.arrays
    kept, columns = arrays["channels/kept"], int(attrs["columns"])
    model = _model(attrs, arrays)
    _require_possible(model, kept, columns)
    found = {
        "model": model,
        "kept": kept,
        "columns": columns,
        "stream": str(attrs["stream"]),
        "unit": str(attrs["unit"]),
        "evaluation": LogEvaluation.restore(attrs, arrays, "evaluation_", "evaluation/"),
        "provenance": {k.removeprefix("provenance_"): str(v) for k, v in attrs.items() if k.startswith("provenance_")},
        "simulated": bool(attrs["simulated"]),
        "notes": tuple(filter(None, str(attrs["notes"]).split("\n"))),
        "shift": LogShift.restore(attrs, arrays),
        "why": str(attrs["why"]),
        "tried": tuple(Candidate(**candidate) for candidate in json.loads(str(attrs["tried"]))),
    }
    if attrs[SEAL] != seal(attrs, arrays):
        raise ValueError("they were changed after the calibration was saved")
    return found


def _model(attrs: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> LogModel:
    kind = CURVES.find(str(attrs["curve"]))
    curve = kind(**{f.name: jnp.asarray(arrays[f"curve/choice-{f.name}"]) for f in fields(kind)})
    numbers = {name: jnp.asarray(arrays[f"curve/{name}"]) for name in CURVE_FIELDS}
    given = {"noise/lag": np.zeros(()), **arrays}  # early versions did not store it
    noise = LogNoise(**{name: jnp.asarray(given[f"noise/{name}"]) for name in NOISE_FIELDS})
    fitted = FittedCurve(curve=curve, **numbers)
    location = _location(str(attrs.get("location", NO_PLACE)), arrays)
    travel = Travel(*map(float, arrays.get("force/travel", ())))  # early versions did not store it
    return LogModel(_combination(attrs, arrays), fitted, noise, arrays["channels/reach"], location, travel)


def _location(name: str, arrays: Mapping[str, np.ndarray]) -> LogLocation | None:
    if name == NO_PLACE:
        return None
    gain = None if name == PLACE_INPUTS else field_from(arrays, FIELDS.find(name))
    return LogLocation(arrays["location/box"], gain)


def _combination(attrs: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> AbstractCombination:
    kind = COMBINATIONS[str(attrs["combination"])]
    return kind(**{f.name: arrays[f"combination/{f.name}"] for f in fields(kind)})


def _require_possible(model: LogModel, kept: np.ndarray, columns: int) -> None:
    """Refuse numbers that no fit can give."""
    size, channels = model.curve.curve.size, len(kept)
    if model.curve.parameters.shape != (size,) or model.curve.covariance.shape != (size, size):
        raise ValueError(f"a curve of {size} parameters has {model.curve.parameters.shape}")
    if not je.linalg.is_covariance(np.asarray(model.curve.covariance)):
        raise ValueError("curve/covariance is no covariance: not symmetric, or of a variance below zero")
    if model.reach.shape != (2, channels) or (model.reach[0] > model.reach[1]).any():
        raise ValueError(f"channels/reach is not lowest and highest values of {channels} channels")
    if channels == 0 or kept.min() < 0 or kept.max() >= columns:
        raise ValueError(f"channels/kept names channels outside of {columns}")
    _require_possible_place(model.location)
    model.predict(np.zeros(1), np.full((1, channels), np.nan))  # raises where shapes do not fit
    if min(float(getattr(model.noise, name)) for name in NOISE_FIELDS) < 0:
        raise ValueError("noise holds a number below zero")


def _require_possible_place(location: LogLocation | None) -> None:
    if location is None:
        return
    if location.box.shape != (2, 2) or not (location.box[0] < location.box[1]).all():
        raise ValueError("location/box is not the lowest and highest corner of a box")
    if location.gain is not None and not je.linalg.is_covariance(np.asarray(location.gain.covariance)):
        raise ValueError("location/covariance is no covariance: not symmetric, or of a variance below zero")
