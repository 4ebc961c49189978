"""Applying a calibration: from frames and pressures to force maps in newtons."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxeit as je

from .calibration import Calibration
from .corrections import correct
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


def force_map(calibration: Calibration, frames, pressures, *, gate: float = 0.6) -> ForceEstimate:
    """Force maps of frames and pad pressures, each less its value without contact.

    Args:
        frames: change of the readings, (n, readings) V.
        pressures: change of the pads' gage pressure at the same times, (n, pads) Pa.
        gate: as in `jaxeit.fuse`.

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
    force, error, valid = calibration.pad_forces(pressures)
    image = calibration.recon(frames)
    fused = je.fuse(image, calibration.masks, jnp.asarray(force, image.dtype), gate=gate)
    about = np.asarray(calibration.curves.residual_rms)
    return ForceEstimate(fused, force, np.hypot(error, about), valid)


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
        for first in progress(range(0, len(eit), _BLOCK)):
            span = slice(first, min(first + _BLOCK, len(eit)))
            time, frames = _corrected(eit, span, filters["eit"])
            around = _around(pressure, time)
            pressure_time, values = _corrected(pressure, around, filters["pressure"])
            at_frames = resample(pressure_time, values, time)
            found = force_map(
                calibration,
                frames - levels["eit"](time),
                at_frames - levels["pressure"](time),
            )
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
