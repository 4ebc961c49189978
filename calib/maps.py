"""Applying a calibration: from frames and pressures to force maps in newtons."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxeit as je

from .calibration import Calibration
from .corrections import correct
from .fit import bucket
from .location import Places
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
    force: np.ndarray
    standard_error: np.ndarray
    valid: np.ndarray


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
    image = calibration.recon(frames)
    places = _places(calibration, frames, pressures, image)
    force, error, valid = _pad_forces(calibration, pressures, places, before)
    fused = je.fuse(image, calibration.masks, jnp.asarray(force, image.dtype), gate=gate)
    return ForceEstimate(fused, force, np.hypot(error, calibration.hybrid.scatter), valid)


def _pad_forces(calibration: Calibration, pressures, places: Places | None, before):
    """Forces, errors and validity (n, pads), of curves that remember after what came `before`."""
    if before is None or not calibration.curves.curve.path:
        return calibration.pad_forces(pressures, places)
    first = bucket(len(before))  # missing pressures move nothing, and lengths recur
    whole = np.concatenate([np.full((first - len(before), before.shape[1]), np.nan), before, pressures])
    if places is not None:
        rows = jnp.maximum(jnp.arange(len(whole)) - first, 0)
        places = places[rows]
    return tuple(part[first:] for part in calibration.pad_forces(whole, places))


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


_LOADED = 3.0  # times the scatter of single samples: pads below are taken as idle, and their frames not searched


def _places(calibration: Calibration, frames, pressures, image) -> Places | None:
    """Where the frames in which some pad is loaded are touched; of the rest, nowhere."""
    if calibration.locator is None:
        return None
    plain, _, _ = calibration.pad_forces(pressures)
    loaded = np.any(plain > _LOADED * calibration.hybrid.scatter, axis=1, keepdims=True)
    return calibration.locate(np.where(loaded, frames, 0.0), image)


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
