"""Convert a calibration to the attributes and arrays of its file, and back."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

from ...fitting.cross_validation.selection import Candidate
from ...fitting.curves import CURVES, AbstractCurve, FittedCurve, Linear
from ...fitting.fields import FIELDS, AbstractField, FittedField, Geometry
from ...fitting.fields.base import restore_field
from ...fitting.intervals import NoiseLaw
from ...presses.crosstalk import Crosstalk
from ...session import Archive
from ..evaluation import Evaluation
from ..hysteresis_loops import Loops
from ..localisation.electrode_places import PlacedElectrodes
from ..localisation.learned.law_arrays import law_arrays, law_from
from ..localisation.learned.layer_arrays import layer_arrays, layer_from
from ..localisation.locators import AbstractLocator, locator_from_numbers, locator_numbers
from ..press_examples import PressExamples
from ..recalibration.changes import Recalibration
from .arrays import shaped
from .provenance import recorded_imaging

if TYPE_CHECKING:
    from ..calibration import Calibration

Described = dict[str, tuple[Any, str, str]]  # arrays by name: values, unit and meaning


def to_archive(cal: "Calibration") -> tuple[dict[str, Any], dict[str, Any]]:
    """The attributes and the arrays that hold a calibration."""
    attrs = _attributes(cal)
    arrays = _image_arrays(cal.recon, cal.masks) | _pad_arrays(cal)
    if cal.field is not None and cal.locator is not None:
        arrays |= field_arrays(cal.field) | _locator_arrays(cal.locator)
    for where, part in (
        ("presses/", cal.evaluation),
        ("loops/", cal.loops),
        ("examples/", cal.examples),
        ("probes/", cal.probes),
        ("", cal.recalibration),
        ("", cal.electrodes),
    ):
        if part is not None:
            arrays |= {where + name: value for name, value in part.arrays().items()}
    if cal.layer is not None:
        arrays |= layer_arrays(cal.layer)
    if cal.contact_law is not None:
        arrays |= law_arrays(cal.contact_law)
    given = {k: (np.asarray(v), u, text) for k, (v, u, text) in arrays.items()}
    return attrs | {SEAL: seal(attrs, {k: v for k, (v, _, _) in given.items()})}, given


def _attributes(cal: "Calibration") -> dict[str, Any]:
    attrs: dict[str, Any] = {
        "skin": cal.skin.name,
        "skin_toml": cal.skin.toml,
        "simulated": int(cal.simulated),
        "notes": "\n".join(cal.notes),
        "image_rows": cal.recon.shape[0],
        "image_columns": cal.recon.shape[1],
        "tried": json.dumps([candidate._asdict() for candidate in cal.tried]),
        **{f"provenance_{k}": v for k, v in cal.provenance.items()},
        **{f"evaluation_{k}": v for k, v in cal.evaluation.attributes().items()},
    }
    if cal.baseline is not None:
        attrs["image_gain"] = cal.image_gain
    if cal.recalibration is not None:
        attrs |= cal.recalibration.attributes()
    return attrs


def _image_arrays(recon: je.Reconstructor | je.imaging.IterativeReconstructor, masks: je.fusion.PadMasks) -> Described:
    numbers = je.imaging.to_numbers(recon)
    return {
        **{f"image/{name}": (array, *je.imaging.NUMBERS[name][1:]) for name, array in numbers.items()},
        "image/extent": (recon.extent, "m", "x0, x1, y0, y1 of the picture"),
        "image/masks": (masks.weights, "1", "share of each pad in each pixel"),
    }


def _pad_arrays(cal: "Calibration") -> Described:
    """Curves, crosstalk, noise, and pressures without contact of the pads, and the paper's curves."""
    arrays, curve = _curve_arrays("pads/", cal.curves), cal.curves.curve
    for f in fields(curve):
        arrays[f"pads/curve-{f.name}"] = (getattr(curve, f.name), "Pa", "what the curve left open, as fitted")
    if cal.crosstalk is not None:
        arrays["pads/crosstalk"] = (cal.crosstalk.matrix, "1", "reading of channel i per own pressure of pad j")
        arrays["pads/crosstalk_se"] = (cal.crosstalk.standard_error, "1", "of the crosstalk; NaN: not determined")
    for name in _NOISES:
        law = getattr(cal, name.replace("-", "_"))
        if law is not None:
            arrays |= {f"pads/{name}-{f.name}": (getattr(law, f.name), *_NOISE_FIELDS[f.name]) for f in fields(law)}
    for name, known, meaning in (("rest", cal.rest, "gage pressure"), ("sensor", cal.sensor, "deviation of a reading")):
        if known is not None:
            arrays[f"pads/{name}"] = (known, "Pa", f"{meaning} without contact")
    return arrays if cal.baseline is None else arrays | _curve_arrays("baseline/", cal.baseline)


def _curve_arrays(where: str, fitted: FittedCurve) -> Described:
    return {where + name: (getattr(fitted, name), "", meaning) for name, meaning in _CURVE_FIELDS.items()}


def _locator_arrays(locator: AbstractLocator) -> Described:
    meaning = "of the estimator of the place, as the library names it"
    return {f"locator/{name}": (array, "", meaning) for name, array in locator_numbers(locator).items()}


_NOISES = ("noise", "hold-noise")  # of a reading, of a mean over a hold
_NOISE_FIELDS = {
    "floor": ("N", "standard deviation of a new reading, or of a mean over a hold, without force"),
    "fraction": ("1", "the same per force"),
    "scale": ("1", "of each pad's deviation"),
    "multiple": ("1", "standard deviations in half the 90 % interval"),
}
MAX_CONDITION = 1e3  # of a crosstalk matrix: beyond it one pad cannot be told from another

SEAL = "seal_sha256"
_OF_THE_FORMAT = (SEAL, "format", "format_version", "Conventions", "complete")


def seal(attrs: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """A hash of all words and numbers. No other check can tell numbers of one pad from those of another."""
    digest = hashlib.sha256()
    for name in sorted(attrs.keys() - set(_OF_THE_FORMAT)):
        digest.update(f"{name}={attrs[name]}\n".encode())
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        words = array.ravel().tolist() if array.dtype.kind == "U" else None
        digest.update(f"{name} {array.dtype.kind} {array.shape}\n".encode())
        digest.update(repr(words).encode() if words is not None else array.tobytes())
    return digest.hexdigest()


def _require_sealed(archive: Archive) -> None:
    """Refuse a calibration that was changed since it was saved; one of before has no seal."""
    if SEAL in archive.attrs and archive.attrs[SEAL] != seal(archive.attrs, archive.arrays):
        raise ValueError("they were changed after the calibration was saved")


def field_arrays(found: FittedField) -> Described:
    """The arrays of a field of gain, by name: values, unit and meaning."""
    choice = {f"choice-{f.name}": getattr(found.field, f.name) for f in fields(found.field)}
    place = {f"geometry-{f.name}": getattr(found.geometry, f.name) for f in fields(Geometry)}
    out: Described = {f"location/{name}": (value, "", "setting of the field") for name, value in choice.items()}
    out |= {f"location/{name}": (value, "m", "outlines of pads and rim") for name, value in place.items()}
    return out | {f"location/{name}": (getattr(found, name), u, text) for name, (u, text) in _FIELD_FIELDS.items()}


_FIELD_FIELDS = {
    "coefficients": ("1", "of the centred features, in log gain"),
    "covariance": ("1", "of the coefficients"),
    "reach": ("m", "lowest and highest corner of the box of each pad that was pressed"),
    "centre": ("1", "mean features of each pad's presses"),
    "noise": ("1", "scatter of single presses about the field, in log force"),
    "spread": ("1", "scatter of single presses about no field, in log force"),
    "evidence": ("1", "log of the largest marginal likelihood, over that of no field"),
    "effective": ("1", "coefficients that the presses determine"),
    "n": ("1", "places fitted"),
    "result": ("1", "0: success"),
    "error_scale": ("1", "factor of standard errors, by held-out neighbourhoods of presses"),
}

_CURVE_FIELDS = {
    "parameters": "parameters of the pressure-force curve, in the curve's own units",
    "covariance": "of the parameters",
    "pressure_range": "lowest and highest pressure fitted, Pa",
    "scale": "robust standard deviation of the residuals, N",
    "residual_rms": "root mean square residual, N",
    "n": "samples fitted",
    "n_missing": "samples not finite",
    "n_groups": "places fitted",
    "rank": "parameters that the samples determine",
    "result": "0: success",
}


def fields_from_archive(archive: Archive) -> dict[str, Any]:
    """The fields of the calibration that `to_archive` described.

    Raises:
        KeyError, ValueError: for what is missing, or does not fit; `StorageError` for the image's numbers.
    """
    attrs, arrays = archive.attrs, archive.arrays
    skin = je.skin.parse_skin(str(attrs["skin_toml"]), "calibration: skin_toml")
    provenance = {k.removeprefix("provenance_"): str(v) for k, v in attrs.items() if k.startswith("provenance_")}
    recon, pads = _recon_from(archive, provenance), len(skin.pads)
    masks = jax.device_put(shaped(arrays, "image/masks", (pads, recon.areas.size), "f"))
    of_pads = _pads_from(arrays, CURVES.find(provenance["curve"]), pads)
    _require_possible(arrays)
    parts = {
        "skin": skin,
        "recon": recon,
        "masks": je.fusion.PadMasks(masks, recon.areas, recon.shape),
        **of_pads,
        "evaluation": Evaluation.restore(attrs, arrays, "evaluation_", "presses/"),
        "provenance": provenance,
        "simulated": bool(attrs["simulated"]),
        "notes": tuple(filter(None, str(attrs["notes"]).split("\n"))),
        **_location_from(arrays, provenance.get("location", "none"), recon.dtype),
        "image_gain": float(attrs.get("image_gain", "nan")),
        "loops": Loops.restore(arrays, "loops/"),
        "examples": _examples_from(arrays, "examples", pads, recon.readings),
        "probes": _examples_from(arrays, "probes", pads, recon.readings),
        "recalibration": Recalibration.restore(attrs, arrays, pads),
        "layer": layer_from(arrays),
        "contact_law": law_from(arrays),
        "electrodes": PlacedElectrodes.restore(arrays, len(skin.electrodes)),
        "tried": tuple(Candidate(**candidate) for candidate in json.loads(str(attrs.get("tried", "[]")))),
    }
    _require_sealed(archive)  # last: what does not fit is named by the checks above
    return parts


def _recon_from(archive: Archive, provenance: Mapping[str, str]) -> je.imaging.AbstractReconstructor:
    attrs = archive.attrs
    numbers = {k.removeprefix("image/"): v for k, v in archive.arrays.items() if k.startswith("image/")}
    shape = int(attrs["image_rows"]), int(attrs["image_columns"])
    imaging = recorded_imaging(provenance) if "jacobian" in numbers else None
    return je.imaging.from_numbers(numbers, shape, tuple(map(float, numbers["extent"])), None, imaging)


def _pads_from(arrays: Mapping[str, np.ndarray], kind: type[AbstractCurve], pads: int) -> dict[str, Any]:
    """What `_pad_arrays` described."""
    curves = _curves_from(arrays, kind, pads)
    return {
        "curves": curves,
        "crosstalk": _crosstalk_from(arrays, pads),
        "noise": _noise_from(arrays, "noise", curves.residual_rms),
        "hold_noise": _noise_from(arrays, "hold-noise", curves.residual_rms),
        **{
            name: shaped(arrays, f"pads/{name}", (pads,), "f") if f"pads/{name}" in arrays else None
            for name in ("rest", "sensor")
        },
        "baseline": _baseline_from(arrays, pads),
    }


def _curves_from(arrays: Mapping[str, np.ndarray], kind: type[AbstractCurve], pads: int) -> FittedCurve:
    """The curves of all pads, with what the curve left open."""
    # Early versions stored the reference pressure of the power law under another name.
    old = {"pads/curve-reference": arrays["pads/reference"]} if "pads/reference" in arrays else {}
    choices = {f.name: np.asarray((old or arrays)[f"pads/curve-{f.name}"]) for f in fields(kind)}
    for name, array in choices.items():
        shaped(choices, name, (pads, *array.shape[1:]), "f")
    curve = kind(**{name: jax.device_put(array) for name, array in choices.items()})
    return FittedCurve(curve=curve, **_fitted(arrays, "pads/", pads, kind()))


def field_from(arrays: Mapping[str, np.ndarray], kind: type[AbstractField]) -> FittedField:
    """The field that `field_arrays` described."""
    choice = {
        f.name: arrays[f"location/choice-{f.name}"] for f in fields(kind) if f"location/choice-{f.name}" in arrays
    }
    missing = {f.name for f in fields(kind)} - choice.keys() - kind.early.keys()
    if missing:
        raise KeyError(f"location/choice-{min(missing)}")
    geometry = {f.name: jax.device_put(arrays[f"location/geometry-{f.name}"]) for f in fields(Geometry)}
    # early versions did not store these
    given = {"location/effective": np.asarray(np.nan), "location/error_scale": np.ones(()), **arrays}
    numbers = {name: jax.device_put(given[f"location/{name}"]) for name in _FIELD_FIELDS}
    return FittedField(field=restore_field(kind, choice), geometry=Geometry(**geometry), **numbers)


def _location_from(arrays: Mapping[str, np.ndarray], name: str, dtype: Any) -> dict[str, Any]:
    """The correction by location of this name, and the estimator of the place; neither for "none"."""
    if name == "none":
        return {"field": None, "locator": None}
    numbers = {k.removeprefix("locator/"): v for k, v in arrays.items() if k.startswith("locator/")}
    return {"field": field_from(arrays, FIELDS.find(name)), "locator": locator_from_numbers(numbers, dtype)}


def _examples_from(arrays: Mapping[str, np.ndarray], kind: str, pads: int, readings: int) -> PressExamples | None:
    """Some presses as they were read; None for a file of an early version."""
    found = PressExamples.restore(arrays, f"{kind}/")
    if found is not None:
        count = len(found.force)
        for name, tail in {"dv": (readings,), "pressure": (pads,), "position": (2,), "force": ()}.items():
            shaped(arrays, f"{kind}/{name}", (count, *tail), "f")
    return found


def _crosstalk_from(arrays: Mapping[str, np.ndarray], pads: int) -> Crosstalk | None:
    """The crosstalk; None for a file of an early version."""
    if "pads/crosstalk" not in arrays:
        return None
    matrix, error = (shaped(arrays, f"pads/{name}", (pads, pads), "f") for name in ("crosstalk", "crosstalk_se"))
    if not np.isfinite(matrix).all() or np.linalg.cond(matrix) > MAX_CONDITION or (np.diagonal(matrix) != 1).any():
        raise ValueError("pads/crosstalk is no crosstalk: singular, not finite, or not one on the diagonal")
    return Crosstalk(matrix, error)


def _noise_from(arrays: Mapping[str, np.ndarray], name: str, rms: jax.Array) -> NoiseLaw | None:
    """The noise law of this name, for residuals (pads,) of the curves; None for a file of an early version."""
    if f"pads/{name}-floor" not in arrays:
        return None
    shapes = {"scale": (len(rms),)}
    numbers = {f.name: shaped(arrays, f"pads/{name}-{f.name}", shapes.get(f.name, ()), "f") for f in fields(NoiseLaw)}
    return NoiseLaw(**{name: jnp.asarray(number, rms.dtype) for name, number in numbers.items()})


def _baseline_from(arrays: Mapping[str, np.ndarray], pads: int) -> FittedCurve | None:
    """The paper's curves; None for a file of an early version."""
    if "baseline/parameters" not in arrays:
        return None
    return FittedCurve(curve=Linear(), **_fitted(arrays, "baseline/", pads, Linear()))


def _fitted(arrays: Mapping[str, np.ndarray], where: str, pads: int, curve: AbstractCurve) -> dict[str, jax.Array]:
    """The numbers of `FittedCurve` for all pads."""
    tails = {"parameters": (curve.size,), "covariance": (curve.size, curve.size), "pressure_range": (2,)}
    kinds = dict.fromkeys(("n", "n_missing", "n_groups", "rank", "result"), "iu")
    return {
        name: jax.device_put(shaped(arrays, where + name, (pads, *tails.get(name, ())), kinds.get(name, "f")))
        for name in _CURVE_FIELDS
    }


_NOT_NEGATIVE = (
    "image/masks",
    "pads/scale",
    "pads/residual_rms",
    *(f"pads/{name}-{field}" for name in _NOISES for field in _NOISE_FIELDS),
    "baseline/scale",
    "location/noise",
    "location/spread",
    "location/error_scale",
    "layer/mesh_error",
)
_RANGES = ("pads/pressure_range", "baseline/pressure_range")
_COVARIANCES = (
    "pads/covariance",
    "baseline/covariance",
    "location/covariance",
    "recalibration/covariance",
    "layer/covariance",
    "contact_law/covariance",
    "electrodes/covariance",
)


def _require_possible(arrays: Mapping[str, np.ndarray]) -> None:
    """Refuse numbers that no fit can give: negative sizes, reversed ranges, matrices that are no covariances."""
    given = {name: np.asarray(array) for name, array in arrays.items()}
    for name in filter(given.__contains__, _NOT_NEGATIVE):
        if (given[name] < 0).any():
            raise ValueError(f"{name} holds {np.nanmin(given[name]):g}, below zero")
    for name in filter(given.__contains__, _RANGES):
        if (given[name][..., 0] > given[name][..., 1]).any():
            raise ValueError(f"{name} ends below its start")
    for name in filter(given.__contains__, _COVARIANCES):
        known = np.isfinite(given[name]).all((-2, -1))  # a fit that failed has none
        if not je.linalg.is_covariance(given[name][known]):
            raise ValueError(f"{name} is no covariance: not symmetric, or of a variance below zero")
