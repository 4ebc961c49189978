"""Calibration: from recorded sessions to the numbers that turn a skin's signals into newtons."""

import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxeit as je

from .curves import CURVES, AbstractCurve, Linear, curve_name
from .evaluation import Evaluation, evaluate_presses
from .fit import AbstractLoss, FitError, FitResult, FittedCurve, SoftL1, fit_curves, predict_pads
from .measured import Measured, Processing, measure
from .presses import dominant_pad
from .response import cross_validate
from .session import Archive, Session, SessionError, read_archive, write_archive

FORMAT = "skin-calibration"
STAGES = ("reading", "fitting curves", "holding out", "model and images")


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
    """

    skin: je.Skin
    recon: je.Reconstructor
    masks: je.PadMasks
    curves: FittedCurve
    evaluation: Evaluation
    provenance: dict[str, str]
    simulated: bool
    notes: tuple[str, ...] = field(default=())

    def pad_forces(self, pressures) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force on each pad, its standard error (N) and validity from pressures (n, pads) Pa.

        Not valid: outside the range that was calibrated, or a pad whose fit failed.
        """
        predicted = predict_pads(self.curves, jnp.asarray(pressures, self.dtype).T)
        parts = (predicted.force, predicted.standard_error, predicted.valid)
        force, error, valid = (np.asarray(part).T for part in parts)
        return force, error, valid

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
    curve: AbstractCurve | None = None,
    basis: je.Pixels | None = None,
    prior=None,
    hyperparameter: float = 0.1,
    fidelity: je.Fidelity | None = None,
    loss: AbstractLoss | None = None,
    processing: Processing | None = None,
    folds: int = 5,
    progress: Callable[[str], object] = lambda stage: None,
) -> Calibration:
    """Fit one pressure-force curve per pad and prepare the image reconstruction.

    Args:
        sessions: recorded on one skin, from `open_session`.
        skin: default: the one described in the first session.
        curve: the law, such as `Linear` (the paper's, default) or `PowerLaw`.
        basis, prior, hyperparameter, fidelity: of the reconstruction, as in `jaxeit.prepare`.
        loss: of the curve fit; default `SoftL1`.
        processing: how sessions are cut and corrected.
        folds: parts into which the locations are divided; each is predicted from the others.
        progress: told the name of each of the `STAGES` as it begins.

    Raises:
        SessionError: a session cannot be used, or was recorded on another skin.
        FitError: a pad was not pressed enough to fit its curve.
    """
    if not sessions:
        raise SessionError("calibrate: no session given; give one or more session files")
    skin = skin or je.parse_skin(sessions[0].skin_toml, f"{sessions[0].name}: skin_toml")
    curve, loss = curve or Linear(), loss or SoftL1()
    progress("reading")
    measured = [measure(session, skin, processing) for session in sessions]
    data = _join(measured)
    progress("fitting curves")
    curves = _fit(curve, data, loss)
    _require_fits(skin, curves)
    progress("holding out")
    held_out = _held_out(curve, data, folds, loss)
    progress("model and images")
    recon = je.prepare(
        je.discretise(je.Scene(skin), fidelity),
        prior,
        basis=basis,
        hyperparameter=hyperparameter,
        channels=np.logical_and.reduce([m.channels for m in measured]),
    )
    evaluation = evaluate_presses(
        recon, skin, data.position, data.dv, data.force, data.pressure, held_out, held_out_by="location"
    )
    options = {
        "curve": curve_name(curve),
        "loss": type(loss).__name__,
        "hyperparameter": repr(float(hyperparameter)),
        "prior": repr(prior or je.Noser()),
        "pixels": "x".join(map(str, recon.shape[::-1])),
        "fidelity": repr(fidelity or je.Fidelity.standard()),
        "processing": repr(processing or Processing()),
        "folds": str(folds),
    }
    return Calibration(
        skin=skin,
        recon=recon,
        masks=je.pad_masks(skin, recon),
        curves=curves,
        evaluation=evaluation,
        provenance=_provenance(sessions, options),
        simulated=any(s.simulated for s in sessions),
        notes=tuple(f"{m.session.name}: {note}" for m in measured for note in m.notes),
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
    force, _, _ = calibration.pad_forces(found.pressure)
    return evaluate_presses(
        calibration.recon,
        calibration.skin,
        found.position,
        found.dv,
        found.force,
        found.pressure,
        force,
        held_out_by="session",
        notes=found.notes,
    )


@dataclass(frozen=True, eq=False)
class _Joined:
    """Sessions one after the other: presses, and the samples of their ramps, holds and releases.

    The means over the holds ride along as the last samples; no fit may use them, so that what is
    predicted for them is predicted like any held-out sample.
    """

    position: np.ndarray
    dv: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    sample_pressure: np.ndarray  # (pads, n)
    sample_force: np.ndarray
    sample_place: np.ndarray
    mask: np.ndarray  # (pads, n): samples of presses that this pad carries nearly alone


def _join(measured: Sequence[Measured]) -> _Joined:
    position = np.concatenate([m.position for m in measured])
    place = np.unique(np.round(position, 6), axis=0, return_inverse=True)[1].ravel()
    pressure = np.concatenate([m.pressure for m in measured])
    force = np.concatenate([m.force for m in measured])
    owner = dominant_pad(pressure)
    press = _press_of_samples(measured)
    pads = np.arange(pressure.shape[1])[:, None]
    unseen = np.zeros((len(pads), len(force)), bool)
    return _Joined(
        position=position,
        dv=np.concatenate([m.dv for m in measured]),
        pressure=pressure,
        force=force,
        sample_pressure=np.concatenate([*(m.samples.pressure for m in measured), pressure]).T,
        sample_force=np.concatenate([*(m.samples.force for m in measured), force]),
        sample_place=np.concatenate([place[press], place]),
        mask=np.concatenate([_finite(measured) & (owner[press] == pads), unseen], 1),
    )


def _press_of_samples(measured: Sequence[Measured]) -> np.ndarray:
    """Row of each sample's press among all presses kept."""
    rows, first = [], 0
    for m in measured:
        number = np.cumsum(m.presses.accepted) - 1
        rows.append(first + number[m.samples.press])
        first += len(m.force)
    return np.concatenate(rows)


def _finite(measured: Sequence[Measured]) -> np.ndarray:
    return np.concatenate([np.isfinite(m.samples.pressure).all(1) & np.isfinite(m.samples.force) for m in measured])


def _require_fits(skin: je.Skin, curves: FittedCurve) -> None:
    for number, pad in enumerate(skin.pads):
        if int(curves.result[number]) != FitResult.SUCCESS:
            raise FitError(f"pad {number} ({pad.name}): the curve could not be fitted: {curves.pad(number).message()}")


def _fit(curve: AbstractCurve, data: _Joined, loss: AbstractLoss) -> FittedCurve:
    return fit_curves(
        curve,
        data.sample_pressure,
        data.sample_force,
        mask=data.mask,
        groups=data.sample_place,
        loss=loss,
    )


def _held_out(curve: AbstractCurve, data: _Joined, folds: int, loss: AbstractLoss) -> np.ndarray:
    """Pad forces over the hold of every press, (presses, pads) N, by curves that never saw its place."""
    found = cross_validate(
        curve,
        data.sample_pressure,
        data.sample_force,
        groups=data.sample_place,
        mask=data.mask,
        folds=min(folds, len(np.unique(data.sample_place))),
        loss=loss,
    )
    return found.predicted[:, -len(data.force) :].T


def _provenance(sessions: Sequence[Session], options: dict[str, str]) -> dict[str, str]:
    return {
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": f"jaxeit {je.__version__}, jax {jax.__version__}, Python {platform.python_version()}",
        "sessions": "\n".join(f"{s.hash}  {s.name}" for s in sessions),
        **options,
    }


# --- the file ------------------------------------------------------------------------------------


def _to_archive(cal: Calibration) -> tuple[dict, dict]:
    attrs = {
        "skin": cal.skin.name,
        "skin_toml": cal.skin.toml,
        "simulated": int(cal.simulated),
        "notes": "\n".join(cal.notes),
        "image_rows": cal.recon.shape[0],
        "image_columns": cal.recon.shape[1],
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
    reference = getattr(curves.curve, "reference", None)
    if reference is not None:
        arrays["pads/reference"] = (reference, "Pa", "reference pressure of the curve")
    for name, value in cal.evaluation.arrays().items():
        arrays[f"presses/{name}"] = value
    return attrs, {k: (np.asarray(v), u, text) for k, (v, u, text) in arrays.items()}


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


def _from_archive(archive: Archive) -> Calibration:
    attrs, arrays = archive.attrs, archive.arrays
    skin = je.parse_skin(str(attrs["skin_toml"]), "calibration: skin_toml")
    numbers = {k.removeprefix("image/"): v for k, v in arrays.items() if k.startswith("image/")}
    shape = int(attrs["image_rows"]), int(attrs["image_columns"])
    recon = je.from_numbers(numbers, shape, tuple(map(float, numbers["extent"])))
    provenance = {k.removeprefix("provenance_"): str(v) for k, v in attrs.items() if k.startswith("provenance_")}
    curve = CURVES[provenance["curve"]]()
    if "pads/reference" in arrays:
        curve = type(curve)(reference=jnp.asarray(arrays["pads/reference"]))
    fitted = {name: jnp.asarray(arrays[f"pads/{name}"]) for name in _CURVE_FIELDS}
    return Calibration(
        skin=skin,
        recon=recon,
        masks=je.PadMasks(jnp.asarray(arrays["image/masks"]), recon.areas),
        curves=FittedCurve(curve=curve, **fitted),
        evaluation=Evaluation.restore(attrs, arrays, "evaluation_", "presses/"),
        provenance=provenance,
        simulated=bool(attrs["simulated"]),
        notes=tuple(filter(None, str(attrs["notes"]).split("\n"))),
    )
