"""Calibration: from recorded sessions to the numbers that turn a skin's signals into newtons."""

import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

from .choice import Candidate
from .curves import CURVES, AbstractCurve, Linear, curve_name
from .evaluation import Evaluation, evaluate_presses
from .fit import AbstractLoss, FitError, FitResult, FittedCurve, SoftL1
from .hybrid import Hybrid, PressData, choose, fit_hybrid, folds_by_place, hold_out, thinned
from .location import (
    FIELDS,
    AbstractField,
    FittedField,
    Geometry,
    Places,
    field_name,
    geometry_of,
    restored,
    single_places,
)
from .locators import (
    AbstractLocator,
    AbstractLocatorChoice,
    FittedContact,
    locate,
    locator_from_numbers,
    locator_numbers,
)
from .loops import Loops, typical_loops
from .measured import Measured, Processing, measure
from .presses import dominant_pad
from .session import Archive, Session, SessionError, read_archive, write_archive
from .splits import leave_out

FORMAT = "skin-calibration"
STAGES = ("reading", "model and images", "fitting", "holding out")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Everything needed to turn frames and pressures into force maps, with its provenance.

    | meaning                                                                  |
    |--------------------------------------------------------------------------|
    | skin: the hardware                                                       |
    | recon: the image reconstruction, a matrix                                |
    | masks: which pad carries which pixel                                     |
    | curves: the fitted pressure-force curve of each pad, with covariance     |
    | evaluation: of the presses fitted, forces held out by location           |
    | provenance: sessions, their hashes, versions, options, date              |
    | simulated: some session it rests on was simulated                        |
    | notes: what a person should know                                         |
    | field: of gain over the place pressed; None: no correction by location   |
    | locator: tells that place from a frame; None with no field               |
    | baseline: the paper's curves, one slope a pad, for comparison            |
    | image_gain: force over the integral of the image, N / (S m^2), likewise  |
    | loops: a whole press of each pad, loading and unloading                  |
    | tried: the curves and fields that were chosen from, with held-out errors |
    """

    skin: je.Skin
    recon: je.Reconstructor
    masks: je.PadMasks
    curves: FittedCurve
    evaluation: Evaluation
    provenance: dict[str, str]
    simulated: bool
    notes: tuple[str, ...] = ()
    field: FittedField | None = None
    locator: AbstractLocator | None = None
    baseline: FittedCurve | None = None
    image_gain: float = float("nan")
    loops: Loops | None = None
    tried: tuple[Candidate, ...] = ()

    @property
    def hybrid(self) -> Hybrid:
        """Curves and field together."""
        return Hybrid(self.curves, self.field)

    def pad_forces(self, pressures, places: Places | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force on each pad, its standard error (N) and validity from pressures (n, pads) Pa.

        With a correction by location, `places` (from `locate`) say where; left out, the gain is 1 and the standard
        error says how much that may be wrong. Not valid: outside the range that was calibrated, or a failed fit.
        """
        return self.hybrid.pad_forces(pressures, places)

    def locate(self, frames, image=None, *, single: bool = False) -> Places | None:
        """Where difference frames (n, readings) V are touched; None without a correction by location.

        `single`: each frame is known to hold one contact, as a press on a bench does.
        """
        if self.locator is None:
            return None
        return locate(self.locator.single() if single else self.locator, frames, self.recon, self.masks, image)

    @property
    def dtype(self):
        """Of the fitted curves."""
        return self.curves.parameters.dtype

    def save(self, path: str | Path) -> None:
        """Write the calibration, whole or not at all, as HDF5 in the format skin-calibration."""
        write_archive(path, FORMAT, *_to_archive(self))


def calibrate(
    sessions: Sequence[Session],
    skin: je.Skin | None = None,
    *,
    curve: AbstractCurve | Sequence[AbstractCurve] | None = None,
    location: AbstractField | Sequence[AbstractField | None] | None = None,
    locator: AbstractLocatorChoice | None = None,
    basis: je.Pixels | None = None,
    prior=None,
    hyperparameter: float = 0.1,
    fidelity: je.Fidelity | None = None,
    loss: AbstractLoss | None = None,
    processing: Processing | None = None,
    folds: int = 5,
    progress: Callable[[str], object] = lambda stage: None,
) -> Calibration:
    """Fit one pressure-force curve per pad, and a correction by location, and prepare the image reconstruction.

    Args:
        sessions: recorded on one skin, from `open_session`.
        skin: default: the one described in the first session.
        curve: the law, such as `Linear` (the paper's, default) or `PowerLaw`; of several, one is chosen by
            cross-validation over locations.
        location: the field of gain over the place pressed, such as `PadEdge()`; default: none. Several: as for curve.
        locator: how that place is told from a frame; default `FittedContact()`.
        basis, prior, hyperparameter, fidelity: of the reconstruction, as in `jaxeit.prepare`.
        loss: of the curve fit; default `SoftL1`.
        processing: how sessions are cut and corrected.
        folds: parts into which the locations are divided; each is predicted from the others.
        progress: told the name of each of the `STAGES` as it begins.

    Raises:
        SessionError: a session cannot be used, or was recorded on another skin.
        FitError: a pad was not pressed enough to fit its curve, or there are too few presses for a field.
    """
    if not sessions:
        raise SessionError("calibrate: no session given; give one or more session files")
    skin = skin or je.parse_skin(sessions[0].skin_toml, f"{sessions[0].name}: skin_toml")
    curves, fields, loss = _several(curve or Linear()), _several(location), loss or SoftL1()
    progress("reading")
    measured = [measure(session, skin, processing) for session in sessions]
    pressed = _join(measured)
    _require_pressed(skin, pressed.data)
    progress("model and images")
    wanted = (locator or FittedContact()) if any(f is not None for f in fields) else None
    seen = _look(skin, pressed, fidelity, wanted, prior=prior, basis=basis, hyperparameter=hyperparameter)
    progress("fitting")
    geometry = geometry_of(skin, seen.places.position.dtype if seen.places else None)
    trial = _Trial(pressed.data, geometry, seen.places, loss, folds_by_place(pressed.data.place, folds))
    law, where, why, tried = choose(curves, fields, pressed.data, geometry, seen.places, loss, trial.fold)
    hybrid = trial.fit(law, where)
    _require_fits(skin, hybrid)
    baseline = hybrid.curves if _is_papers(law, where) else trial.fit(Linear(), None).curves
    progress("holding out")
    options = {
        "curve": curve_name(law),
        "location": "none" if where is None else field_name(where),
        "choice": why,
        "loss": type(loss).__name__,
        "hyperparameter": repr(float(hyperparameter)),
        "prior": repr(prior or je.Noser()),
        "pixels": "x".join(map(str, seen.recon.shape[::-1])),
        "fidelity": repr(fidelity or je.Fidelity.standard()),
        "processing": repr(processing or Processing()),
        "folds": str(folds),
    }
    return Calibration(
        skin=skin,
        recon=seen.recon,
        masks=seen.masks,
        curves=hybrid.curves,
        evaluation=_held_out(skin, pressed, seen, trial, law, where),
        provenance=_provenance(sessions, options),
        simulated=any(s.simulated for s in sessions),
        notes=(*pressed.notes, *([f"chosen: {why}"] if why else []), *filter(None, [seen.note])),
        field=hybrid.field,
        locator=seen.locator if hybrid.field is not None else None,
        baseline=baseline,
        image_gain=float(pressed.data.force.sum() / seen.image_sum.sum()),
        loops=_loops(measured, pressed.data, hybrid, seen.places),
        tried=tried,
    )


def _loops(measured: Sequence[Measured], data: PressData, hybrid: Hybrid, places: Places | None) -> Loops:
    gain = None if hybrid.field is None or places is None else np.exp(hybrid.log_gains(places))
    return typical_loops(measured, _press_of_samples(measured), dominant_pad(data.pressure), gain)


@dataclass(frozen=True, eq=False)
class _Pressed:
    """Sessions one after the other, press by press.

    | meaning                                                       | shape               | unit |
    |---------------------------------------------------------------|---------------------|------|
    | data: what curves and fields are fitted to                    |                     |      |
    | dv: change of the readings over the hold                      | (presses, readings) | V    |
    | position of the tip, true                                     | (presses, 2)        | m    |
    | groups: number of each press's pad, indenter, session         | (presses,) each     |      |
    | channels: readings that were finite in every press            | (readings,)         |      |
    | noise of a frame: the largest of the sessions                 | (readings,)         | V    |
    | untouched: readings without contact                           | (readings,)         | V    |
    | true_place: whether a simulation knows the place exactly      |                     |      |
    | notes                                                         |                     |      |
    """

    data: PressData
    dv: np.ndarray
    position: np.ndarray
    groups: Mapping[str, np.ndarray]
    channels: np.ndarray
    noise: np.ndarray
    untouched: np.ndarray
    true_place: bool
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Seen:
    """What the presses look like: image (presses, pixels) S, its integral (presses,) S m^2, and places if asked for."""

    recon: je.Reconstructor
    masks: je.PadMasks
    image: np.ndarray
    image_sum: np.ndarray
    locator: AbstractLocator | None
    places: Places | None
    note: str


def _look(
    skin: je.Skin, pressed: _Pressed, fidelity: je.Fidelity | None, choice: AbstractLocatorChoice | None, **imaging: Any
) -> _Seen:
    """Images of the presses; with a choice of locator, their places on the sheet that the untouched frames show."""
    model = je.discretise(je.Scene(skin), fidelity)
    recon = je.prepare(model, channels=pressed.channels, **imaging)
    masks = je.pad_masks(skin, recon)
    image = recon(jnp.asarray(pressed.dv, recon.factor.dtype))
    found, places, note = None, None, ""
    if choice is not None:
        sigma = None
        if choice.looks_through_sheet:
            sigma, note = _background(model, pressed.untouched, pressed.channels)
        found = choice.prepare(model, pressed.noise, pressed.channels, sigma)
        places = locate(found.single(), pressed.dv, recon, masks, image)
    image_sum = np.asarray(je.image_sum(image, recon.areas), float)
    return _Seen(recon, masks, np.asarray(image), image_sum, found, places, note)


def _background(model: je.Model, untouched: np.ndarray, channels: np.ndarray) -> tuple[Any, str]:
    """The sheet that contacts are seen through, and a note where it had to be taken for even."""
    try:
        return je.fit_background(model, np.where(channels, untouched, np.nan)), ""
    except je.InverseError as error:
        return None, f"contacts are placed on an even sheet, as the untouched frame shows none that fits: {error}"


def _several(choice) -> tuple:
    return tuple(choice) if isinstance(choice, Sequence) else (choice,)


def _is_papers(curve: AbstractCurve, field: AbstractField | None) -> bool:
    return isinstance(curve, Linear) and field is None


def _recipe(curve: AbstractCurve, field: AbstractField | None) -> str:
    return curve_name(curve) + (f", {field_name(field)}" if field is not None else "")


@dataclass(frozen=True, eq=False)
class _Trial:
    """Presses, where they were found, and how they are divided: fits of all, and predictions by fits that never saw
    a press's place."""

    data: PressData
    geometry: Geometry
    places: Places | None
    loss: AbstractLoss
    fold: np.ndarray

    def fit(self, curve: AbstractCurve, field: AbstractField | None) -> Hybrid:
        """From all presses."""
        return fit_hybrid(curve, field, self.data, self.geometry, self.places, self.loss)

    def predict(self, curve: AbstractCurve, field: AbstractField | None, places: Places | None = None) -> np.ndarray:
        """Pad forces over the holds, (presses, pads) N; `places`: other ones than those found."""
        there = self.places if places is None else places
        return hold_out(curve, field, self.data, self.geometry, there, self.loss, self.fold)

    def image_only(self, image_sum: np.ndarray) -> np.ndarray:
        """Total force by the integral of the image times one number, (presses,) N."""
        out = np.empty(len(image_sum))
        for k in np.unique(self.fold):
            held = self.fold == k
            gain = self.data.force[~held].sum() / image_sum[~held].sum() if (~held).any() else np.nan
            out[held] = gain * image_sum[held]
        return out


def _held_out(
    skin: je.Skin, pressed: _Pressed, seen: _Seen, trial: _Trial, law: AbstractCurve, where: AbstractField | None
) -> Evaluation:
    """What is predicted of presses by fits that had not seen their places, and of whole parts left out."""
    pad_force, data = trial.predict(law, where), pressed.data
    others = {"eit": trial.image_only(seen.image_sum)}
    others["hybrid"] = (pad_force if _is_papers(law, where) else trial.predict(Linear(), None)).sum(1)
    if where is not None and pressed.true_place:
        true = single_places(jnp.asarray(pressed.position), len(skin.pads))
        others["true_place"] = trial.predict(law, where, true).sum(1)
    return evaluate_presses(
        seen.recon,
        skin,
        seen.image,
        pressed.position,
        data.force,
        data.pressure,
        pad_force,
        held_out_by="location",
        others=others,
        fitted=None if seen.places is None else np.asarray(seen.places.position[:, 0], float),
        recipe=_recipe(law, where),
        splits=leave_out(law, where, data, trial.geometry, seen.places, trial.loss, pressed.groups),
    )


def evaluate(calibration: Calibration, session: Session, processing: Processing | None = None) -> Evaluation:
    """How well a calibration does on the presses of another session.

    Raises:
        SessionError: if the session was recorded on another skin or cannot be used.
    """
    found = measure(session, calibration.skin, processing)
    lost = np.asarray(calibration.recon.channels) & ~found.channels
    if lost.any():
        raise SessionError(
            f"{session.name}: /streams/eit: channels {np.flatnonzero(lost)[:8].tolist()} hold no finite "
            "value but the calibration uses them; calibrate again with this session's channels"
        )
    recon = calibration.recon
    image = recon(jnp.asarray(found.dv, recon.factor.dtype))
    places = calibration.locate(found.dv, image, single=True)
    force, _, _ = calibration.pad_forces(found.pressure, places)
    return evaluate_presses(
        recon,
        calibration.skin,
        np.asarray(image),
        found.position,
        found.force,
        found.pressure,
        force,
        held_out_by="session",
        notes=found.notes,
        others=_by_others(calibration, found, np.asarray(je.image_sum(image, recon.areas), float)),
        fitted=None if places is None else np.asarray(places.position[:, 0], float),
        recipe=calibration.evaluation.recipe,
    )


def _by_others(calibration: Calibration, found: Measured, image_sum: np.ndarray) -> dict[str, np.ndarray]:
    """Total force by the methods to compare with; none for a calibration of before they were kept."""
    if calibration.baseline is None:
        return {}
    papers = Hybrid(calibration.baseline).pad_forces(found.pressure)[0].sum(1)
    others = {"eit": calibration.image_gain * image_sum, "hybrid": papers}
    if calibration.field is not None and "contact_position" in found.session.truth:
        true = single_places(jnp.asarray(found.position), len(calibration.skin.pads))
        others["true_place"] = calibration.pad_forces(found.pressure, true)[0].sum(1)
    return others


_PER_PRESS = 24  # means that stand for the samples of a press, near-duplicates of each other


def _join(measured: Sequence[Measured]) -> _Pressed:
    data, dv, position = press_data(measured)
    tip = np.concatenate([m.presses.tip_diameter[m.presses.accepted] for m in measured])
    return _Pressed(
        data=data,
        dv=dv,
        position=position,
        groups={
            "pad": dominant_pad(data.pressure),
            "indenter": np.unique(np.round(tip, 6), return_inverse=True)[1].ravel(),
            "session": np.repeat(np.arange(len(measured)), [len(m.force) for m in measured]),
        },
        channels=np.logical_and.reduce([m.channels for m in measured]),
        noise=np.max([m.noise for m in measured], 0),
        untouched=np.mean([m.untouched for m in measured], 0),
        true_place=any("contact_position" in m.session.truth for m in measured),
        notes=tuple(f"{m.session.name}: {note}" for m in measured for note in m.notes),
    )


def press_data(measured: Sequence[Measured]) -> tuple[PressData, np.ndarray, np.ndarray]:
    """Sessions one after the other: their presses, frames (presses, readings) V and positions (presses, 2) m.

    What `fit_hybrid` takes, whose ``use`` fits from some of the presses without reading the sessions again.
    """
    position = np.concatenate([m.position for m in measured])
    place = np.unique(np.round(position, 6), axis=0, return_inverse=True)[1].ravel()
    pressure = np.concatenate([m.pressure for m in measured])
    owner = dominant_pad(pressure)
    press, sample_pressure, sample_force = thinned(
        _press_of_samples(measured),
        np.concatenate([m.samples.pressure for m in measured]),
        np.concatenate([m.samples.force for m in measured]),
        _PER_PRESS,
    )
    finite = np.isfinite(sample_pressure).all(1) & np.isfinite(sample_force)
    data = PressData(
        sample_pressure=sample_pressure.T,
        sample_force=sample_force,
        sample_press=press,
        mask=finite & (owner[press] == np.arange(pressure.shape[1])[:, None]),
        pressure=pressure,
        force=np.concatenate([m.force for m in measured]),
        place=place,
        reach=np.stack([position.min(0), position.max(0)]),
    )
    return data, np.concatenate([m.dv for m in measured]), position


def _press_of_samples(measured: Sequence[Measured]) -> np.ndarray:
    """Row of each sample's press among all presses kept."""
    rows, first = [], 0
    for m in measured:
        number = np.cumsum(m.presses.accepted) - 1
        rows.append(first + number[m.samples.press])
        first += len(m.force)
    return np.concatenate(rows)


def _require_pressed(skin: je.Skin, data: PressData) -> None:
    """Before the model is built: a pad without presses cannot be mended later."""
    for number, pad in enumerate(skin.pads):
        if not data.mask[number].any():
            raise FitError(
                f"pad {number} ({pad.name}): the curve could not be fitted: no press rests on it alone; press it "
                "away from its neighbours"
            )


def _require_fits(skin: je.Skin, hybrid: Hybrid) -> None:
    curves = hybrid.curves
    for number, pad in enumerate(skin.pads):
        if int(curves.result[number]) != FitResult.SUCCESS:
            raise FitError(f"pad {number} ({pad.name}): the curve could not be fitted: {curves.pad(number).message()}")
    if hybrid.field is not None and int(hybrid.field.result) != FitResult.SUCCESS:
        raise FitError(
            f"location: the field could not be fitted to {float(hybrid.field.n):.3g} places that the images find: "
            "press at more places, or calibrate without a correction by location"
        )


def _provenance(sessions: Sequence[Session], options: dict[str, str]) -> dict[str, str]:
    return {
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": f"jaxeit {je.__version__}, jax {jax.__version__}, Python {platform.python_version()}",
        "sessions": "\n".join(f"{s.hash}  {s.name}" for s in sessions),
        **options,
    }


# --- the file ------------------------------------------------------------------------------------


def _to_archive(cal: Calibration) -> tuple[dict, dict]:
    attrs: dict = {
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
    recon, masks, curves = cal.recon, cal.masks, cal.curves
    arrays = {
        **{f"image/{name}": (array, *je.NUMBERS[name][1:]) for name, array in je.to_numbers(recon).items()},
        "image/extent": (recon.extent, "m", "x0, x1, y0, y1 of the picture"),
        "image/masks": (masks.weights, "1", "share of each pad in each pixel"),
    }
    for name, meaning in _CURVE_FIELDS.items():
        arrays[f"pads/{name}"] = (getattr(curves, name), "", meaning)
    for f in fields(curves.curve):
        arrays[f"pads/curve-{f.name}"] = (getattr(curves.curve, f.name), "Pa", "what the curve left open, as fitted")
    if cal.baseline is not None:
        attrs["image_gain"] = cal.image_gain
        for name, meaning in _CURVE_FIELDS.items():
            arrays[f"baseline/{name}"] = (getattr(cal.baseline, name), "", meaning)
    if cal.field is not None and cal.locator is not None:
        arrays |= _field_arrays(cal.field)
        for name, array in locator_numbers(cal.locator).items():
            arrays[f"locator/{name}"] = (array, "", "of the estimator of the place, as the library names it")
    for name, value in cal.evaluation.arrays().items():
        arrays[f"presses/{name}"] = value
    if cal.loops is not None:
        arrays |= {f"loops/{name}": value for name, value in cal.loops.arrays().items()}
    return attrs, {k: (np.asarray(v), u, text) for k, (v, u, text) in arrays.items()}


def _field_arrays(found: FittedField) -> dict[str, tuple]:
    choice = {f"choice-{f.name}": getattr(found.field, f.name) for f in fields(found.field)}
    place = {f"geometry-{f.name}": getattr(found.geometry, f.name) for f in fields(Geometry)}
    out: dict[str, tuple] = {f"location/{name}": (value, "", "setting of the field") for name, value in choice.items()}
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
    "n": ("1", "places fitted"),
    "result": ("1", "0: success"),
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


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration that `Calibration.save` wrote.

    Raises:
        SessionError: if the file is damaged or of another kind.
    """
    archive = read_archive(path, FORMAT)
    try:
        return _from_archive(archive)
    except (KeyError, IndexError) as error:
        raise SessionError(
            f"{Path(path).name}: {error.args[0]}: missing from the calibration; calibrate again"
        ) from None
    except je.StoreError as error:
        raise SessionError(f"{Path(path).name}: image/{error}; calibrate again") from None
    except (ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        why = " ".join(str(error).split())[:200]
        raise SessionError(f"{Path(path).name}: its numbers do not fit each other ({why}); calibrate again") from None


def _from_archive(archive: Archive) -> Calibration:
    attrs, arrays = archive.attrs, archive.arrays
    skin = je.parse_skin(str(attrs["skin_toml"]), "calibration: skin_toml")
    numbers = {k.removeprefix("image/"): v for k, v in arrays.items() if k.startswith("image/")}
    shape = int(attrs["image_rows"]), int(attrs["image_columns"])
    recon = je.from_numbers(numbers, shape, tuple(map(float, numbers["extent"])))
    provenance = {k.removeprefix("provenance_"): str(v) for k, v in attrs.items() if k.startswith("provenance_")}
    kind = CURVES[provenance["curve"]]
    old = {"pads/curve-reference": arrays["pads/reference"]} if "pads/reference" in arrays else {}
    choices = {f.name: np.asarray((old or arrays)[f"pads/curve-{f.name}"]) for f in fields(kind)}
    for name, array in choices.items():
        _shaped(choices, name, (len(skin.pads), *array.shape[1:]), "f")
    curve = kind(**{name: jnp.asarray(array) for name, array in choices.items()})
    fitted = _fitted(arrays, "pads/", len(skin.pads), kind())
    located = provenance.get("location", "none") != "none"
    return Calibration(
        skin=skin,
        recon=recon,
        masks=je.PadMasks(
            jnp.asarray(_shaped(arrays, "image/masks", (len(skin.pads), recon.areas.size), "f")), recon.areas
        ),
        curves=FittedCurve(curve=curve, **fitted),
        evaluation=Evaluation.restore(attrs, arrays, "evaluation_", "presses/"),
        provenance=provenance,
        simulated=bool(attrs["simulated"]),
        notes=tuple(filter(None, str(attrs["notes"]).split("\n"))),
        field=_field_from(arrays, FIELDS[provenance["location"]]) if located else None,
        locator=_locator_from(arrays, recon.factor.dtype) if located else None,
        baseline=_baseline_from(arrays, len(skin.pads)),
        image_gain=float(attrs.get("image_gain", "nan")),
        loops=Loops.restore(arrays, "loops/"),
        tried=tuple(Candidate(**candidate) for candidate in json.loads(str(attrs.get("tried", "[]")))),
    )


def _field_from(arrays: Mapping[str, np.ndarray], kind: type[AbstractField]) -> FittedField:
    choice = {f.name: arrays[f"location/choice-{f.name}"] for f in fields(kind)}
    geometry = {f.name: jnp.asarray(arrays[f"location/geometry-{f.name}"]) for f in fields(Geometry)}
    numbers = {name: jnp.asarray(arrays[f"location/{name}"]) for name in _FIELD_FIELDS}
    return FittedField(field=restored(kind, choice), geometry=Geometry(**geometry), **numbers)


def _locator_from(arrays: Mapping[str, np.ndarray], dtype) -> AbstractLocator:
    numbers = {k.removeprefix("locator/"): v for k, v in arrays.items() if k.startswith("locator/")}
    return locator_from_numbers(numbers, dtype)


def _baseline_from(arrays: Mapping[str, np.ndarray], pads: int) -> FittedCurve | None:
    """None: a calibration written before the paper's recipe was kept beside it."""
    if "baseline/parameters" not in arrays:
        return None
    return FittedCurve(curve=Linear(), **_fitted(arrays, "baseline/", pads, Linear()))


def _fitted(arrays: Mapping[str, np.ndarray], where: str, pads: int, curve: AbstractCurve) -> dict[str, jax.Array]:
    """The numbers of `FittedCurve` for all pads."""
    tails = {"parameters": (curve.size,), "covariance": (curve.size, curve.size), "pressure_range": (2,)}
    kinds = dict.fromkeys(("n", "n_missing", "n_groups", "rank", "result"), "iu")
    return {
        name: jnp.asarray(_shaped(arrays, where + name, (pads, *tails.get(name, ())), kinds.get(name, "f")))
        for name in _CURVE_FIELDS
    }


def _shaped(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], kinds: str) -> np.ndarray:
    """An array that is used as it is, once it has been looked at."""
    array = arrays[name]
    if array.shape != shape or array.dtype.kind not in kinds:
        raise ValueError(f"{name} is {array.dtype} of shape {array.shape}, not numbers of shape {shape}")
    return array
