"""Applying a calibration: from frames and pressures to force maps in newtons."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

import jaxeit as je

from .calibration import Calibration
from .corrections import correct
from .fit import FittedCurve, bucket
from .hybrid import pad_forces
from .location import FittedField, Places
from .locators import AbstractLocator
from .measured import Processing, resting_levels
from .presses import resample
from .session import ArchiveWriter, Session, SessionError, Stream

FORMAT = "skin-forcemap"
_BLOCK = 512  # frames held in memory at once
_MARGIN = 0.5  # s read beyond a block on both sides, so that filters start and end outside it

Progress = Callable[[Iterable], Iterable]


class ForceEstimate(NamedTuple):
    """Forces on the skin, frame by frame.

    | meaning                                                             | shape        | unit |
    |---------------------------------------------------------------------|--------------|------|
    | map: force on each pixel, with the validity of its shape            | (n, pixels)  | N    |
    | force on each pad                                                   | (n, pads)    | N    |
    | standard_error of a new reading: of the curve and about it          | (n, pads)    | N    |
    | valid: pressure within the calibrated range                         | (n, pads)    |      |
    """

    map: je.ForceMap
    force: Any
    standard_error: Any
    valid: Any


class ForceLaw(eqx.Module):
    """What of a calibration turns numbers into forces, as one pytree for compiled programs; see `Calibration`."""

    recon: je.Reconstructor
    masks: je.PadMasks
    curves: FittedCurve
    field: FittedField | None
    locator: AbstractLocator | None

    @property
    def remembers(self) -> bool:
        """Whether forces depend on the pressures that came before."""
        return self.curves.curve.path


def law_of(calibration: Calibration) -> ForceLaw:
    """What of a calibration turns numbers into forces."""
    c = calibration
    return ForceLaw(c.recon, c.masks, c.curves, c.field, c.locator)


def force_map(calibration: Calibration, frames, pressures, *, gate: float = 0.6, before=None) -> ForceEstimate:
    """Force maps of frames and pad pressures, each less its value without contact.

    Args:
        frames: change of the readings, (n, readings) V.
        pressures: change of the pads' gage pressure at the same times, (n, pads) Pa.
        gate: as in `jaxeit.fuse`.
        before: pressures that came earlier, (m, pads) Pa, for curves that remember them; see `remembered`.

    Raises:
        ValueError: if the shapes do not fit the calibration.
    """
    frames, pressures = np.atleast_2d(frames), np.atleast_2d(pressures)
    readings, pads = calibration.recon.readings, len(calibration.skin.pads)
    if frames.shape[1] != readings or pressures.shape != (len(frames), pads):
        raise ValueError(
            f"frames {frames.shape} and pressures {pressures.shape} do not fit this calibration: "
            f"give (n, {readings}) V and (n, {pads}) Pa"
        )
    law = law_of(calibration)
    frames = np.asarray(frames, law.recon.factor.dtype)
    pressures = np.asarray(pressures, law.curves.parameters.dtype)
    found = _force_map(law, frames, pressures, filled(law, before), gate)
    return ForceEstimate(found.map, *map(np.asarray, found[1:]))


def filled(law: ForceLaw, before: np.ndarray | None) -> np.ndarray | None:
    """Earlier pressures (m, pads) after rows that move nothing, so that lengths recur; None for curves that forget."""
    if before is None or not law.remembers:
        return None
    first = bucket(len(before))
    rows = np.concatenate([np.full((first - len(before), before.shape[1]), np.nan), before])
    return rows.astype(law.curves.parameters.dtype)


@je.verb
def _force_map(law: ForceLaw, frames, pressures, before, gate) -> ForceEstimate:
    image = law.recon(frames)
    places = None
    if law.locator is not None:
        touched = jnp.any(is_loaded(law, pressures), 1, keepdims=True)
        places = law.locator(jnp.where(touched, frames, 0), image, law.recon, law.masks)
    return fused(law, image, pressures, places, before, gate)


def fused(
    law: ForceLaw,
    image: Float[Array, "n pixels"],
    pressures: Float[Array, "n pads"],
    places: Places | None,
    before: Float[Array, "m pads"] | None,
    gate: float,
) -> ForceEstimate:
    """`force_map` from images and places that are known (None: nothing known); pure."""
    force, error, valid = _pad_forces(law, pressures, places, before)
    found = je.fuse(image, law.masks, force.astype(image.dtype), gate=gate)
    return ForceEstimate(found, force, jnp.hypot(error, law.curves.residual_rms), valid)


def _pad_forces(law: ForceLaw, pressures, places: Places | None, before):
    """Forces, errors and validity (n, pads), of curves that remember after what came `before`."""
    if before is None:
        return pad_forces(law.curves, law.field, pressures, places)
    first, whole = len(before), jnp.concatenate([before, pressures])
    if places is not None:
        places = places[jnp.maximum(jnp.arange(len(whole)) - first, 0)]
    return (part[first:] for part in pad_forces(law.curves, law.field, whole, places))


_LOADED = 3.0  # times the scatter of single samples: pads below are taken as idle, and their frames not searched


def is_loaded(law: ForceLaw, pressures: Float[Array, "n pads"]) -> Bool[Array, "n pads"]:
    """Whether a pad carries more than its pressure's scatter, wherever it is touched; pure."""
    return pad_forces(law.curves, None, pressures).force > _LOADED * law.curves.residual_rms


def remembered(pressures: np.ndarray) -> np.ndarray:
    """The turns (m, pads) of pressures (n, pads) that a curve with hysteresis still remembers; NaN fills up.

    A turn is forgotten as soon as a later excursion goes back beyond it (Preisach's wiping out), so that few are left.
    """
    turns = [_turns(column) for column in np.asarray(pressures).T]
    longest = max(map(len, turns), default=0)
    return np.stack([np.r_[np.full(longest - len(t), np.nan), t] for t in turns], 1)


def _turns(column: np.ndarray) -> list[float]:
    kept: list[float] = [0.0]  # at rest
    for value in column[np.isfinite(column)].tolist():
        kept.append(value)
        while len(kept) > 3 and abs(kept[-1] - kept[-2]) >= abs(kept[-2] - kept[-3]):
            del kept[-3:-1]
        while len(kept) > 2 and (kept[-1] - kept[-2]) * (kept[-2] - kept[-3]) >= 0:
            del kept[-2]
    return kept


def apply(
    calibration: Calibration,
    session: Session,
    path: str | Path,
    *,
    processing: Processing | None = None,
    progress: Progress = iter,
) -> Path:
    """Write the force map of every EIT frame of a session; memory does not grow with its length.

    The file, format skin-forcemap, appears only when complete.

    Raises:
        SessionError: if the session was recorded on another skin or lacks a stream.
    """
    processing = processing or Processing()
    levels = resting_levels(session, calibration.skin, processing)
    eit, pressure = session.stream("eit"), session.stream("pressure")
    filters = {s.name: processing.of(s)[0] for s in (eit, pressure)}
    recon, pads = calibration.recon, len(calibration.skin.pads)
    attrs: dict[str, str | int] = {
        "skin": calibration.skin.name,
        "session": session.name,
        "session_sha256": session.hash,
        "simulated": int(session.simulated or calibration.simulated),
        "time_epoch_utc": session.epoch,
        "image_rows": recon.shape[0],
        "image_columns": recon.shape[1],
        "calibration_created_utc": calibration.provenance["created_utc"],
    }
    with ArchiveWriter(path, FORMAT, attrs) as writer:
        writer.add("centres", np.asarray(recon.centres), "m", "centres of the pixels")
        writer.add("areas", np.asarray(recon.areas), "m2", "areas of the pixels")
        writer.add_rows("time", (), "ns", "since time_epoch_utc", "i8")
        writer.add_rows("force", (recon.areas.shape[0],), "N", "force on each pixel", "f4")
        writer.add_rows("pad_force", (pads,), "N", "force on each pad", "f8")
        writer.add_rows("pad_force_se", (pads,), "N", "standard error of a pad's force", "f8")
        writer.add_rows("pad_valid", (pads,), "1", "pressure in the calibrated range", "u1")
        writer.add_rows("shape_valid", (pads,), "1", "1: shape from the image; 0: even", "u1")
        before = np.zeros((1, pads))
        for first in progress(range(0, len(eit), _BLOCK)):
            span = slice(first, min(first + _BLOCK, len(eit)))
            time, frames = _corrected(eit, span, filters["eit"])
            around = _around(pressure, time)
            pressure_time, values = _corrected(pressure, around, filters["pressure"])
            at_frames = resample(pressure_time, values, time)
            pressed = at_frames - levels["pressure"](time)
            found = force_map(calibration, frames - levels["eit"](time), pressed, before=before)
            if calibration.curves.curve.path:
                before = remembered(np.concatenate([before, pressed]))
            for name, rows in (
                ("time", time),
                ("force", found.map.force),
                ("pad_force", found.force),
                ("pad_force_se", found.standard_error),
                ("pad_valid", found.valid),
                ("shape_valid", found.map.valid),
            ):
                writer.append(name, np.asarray(rows))
    return Path(path)


def _corrected(stream: Stream, span: slice, corrections) -> tuple[np.ndarray, np.ndarray]:
    """Times and corrected values of a block, read with a margin for the filters."""
    time = stream.time
    margin = round(_MARGIN * 1e9)
    first = int(np.searchsorted(time, time[span.start] - margin))
    last = int(np.searchsorted(time, time[span.stop - 1] + margin, side="right"))
    values = correct(corrections, time[first:last], stream.read(first, last), stream.name)
    kept = slice(span.start - first, span.stop - first)
    return time[span], values[kept]


def _around(stream: Stream, time: np.ndarray) -> slice:
    """Samples of a stream that surround the given times."""
    first = max(int(np.searchsorted(stream.time, time[0])) - 1, 0)
    last = min(int(np.searchsorted(stream.time, time[-1])) + 1, len(stream))
    if last <= first:
        raise SessionError(
            f"/streams/{stream.name}: no sample at the time of the EIT frames; the streams do not "
            "overlap: check their clocks"
        )
    return slice(first, last)
