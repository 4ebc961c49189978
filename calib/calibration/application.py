"""Applying a calibration to a session: the force map of every frame, in a file."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..check.acceptance import accept
from ..fitting.curves.play_operators import remembered
from ..presses.corrections import AbstractCorrection, correct
from ..presses.streams import resample
from ..presses.table import Processing, resting_levels
from ..session import ArchiveWriter, Session, SessionError, Stream
from .calibration import Calibration
from .force_maps import USED, ForceEstimate, force_map, is_loaded, law_of
from .localisation.load_windows import WindowedFrames, fit_windows
from .recalibration.agreement import agreement_of_use

FORMAT = "skin-forcemap"
_BLOCK = 512  # frames held in memory at once
_MARGIN = 0.5  # s read beyond a block on both sides, so that filters start and end outside it

Progress = Callable[[Iterable[Any]], Iterable[Any]]


def apply(
    calibration: Calibration,
    session: Session,
    path: str | Path,
    *,
    processing: Processing | None = None,
    ignore_errors: bool = False,
    progress: Progress = iter,
    loads: float | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> Path:
    """Write the force map of every EIT frame of a session; memory does not grow with its length.

    The file, format skin-forcemap, appears only when complete. Where the pads disagree with the image, intervals are
    wider by as much. What lies outside of what was calibrated is told, and stands in the file's attribute "outside".

    Args:
        processing: how the session is corrected; default: as the sessions of the calibration.
        ignore_errors: apply also to a session in whose skin, frames or pressures `check_session` finds an error; the
            file then names the errors.
        loads: also tell what touches the skin, none, one, two or an edge, in windows of so many s; None: do not.
        tell: called with a line about the loads, and about each thing outside of what was calibrated.

    Raises:
        SessionError: if the session was recorded on another skin, lacks a stream, or holds no frame.
        RecordingError: if `check_session` finds an error in its skin, frames or pressures.
    """
    processing = processing or calibration.processing
    levels = resting_levels(session, calibration.skin, processing)
    ignored = accept([session], calibration.skin, ignore_errors=ignore_errors, where=USED)
    calibration, outside = agreement_of_use(calibration, session)
    eit, pressure = session.stream("eit"), session.stream("pressure")
    filters = {s.name: processing.of(s)[0] for s in (eit, pressure)}
    recon = calibration.recon
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
    attrs |= {"ignored_errors": "\n".join(ignored)} if ignored else {}
    attrs |= {"outside": "\n".join(outside)} if outside else {}
    for line in outside:
        tell(f"note: {line}")
    kinds = _rows(calibration)
    windows = None if loads is None else WindowedFrames(loads, recon.readings)
    with ArchiveWriter(path, FORMAT, attrs) as writer:
        writer.add("centres", np.asarray(recon.centres), "m", "centres of the pixels")
        writer.add("areas", np.asarray(recon.areas), "m2", "areas of the pixels")
        for name, kind in kinds.items():
            writer.add_rows(name, *kind)
        before = np.zeros((1, len(calibration.skin.pads)))
        for first in progress(range(0, len(eit), _BLOCK)):
            span = slice(first, min(first + _BLOCK, len(eit)))
            time, frames = _corrected(eit, span, filters["eit"])
            around = _around(pressure, time)
            pressure_time, values = _corrected(pressure, around, filters["pressure"])
            at_frames = resample(pressure_time, values, time)
            pressed = at_frames - levels["pressure"](time)
            found = force_map(calibration, frames - levels["eit"](time), pressed, before=before)
            if calibration.curves.curve.path:
                before = remembered(np.concatenate([before, calibration.own_pressures(pressed)]))
            rows = _of_block(time, found, calibration.pads.multiple)
            for name in kinds:
                writer.append(name, rows[name])
            if windows is not None:
                touched = np.asarray(np.asarray(is_loaded(law_of(calibration), jnp.asarray(pressed))).any(1))
                windows.add(time, frames, frames - levels["eit"](time), touched, found.force.sum(1))
        if windows is not None:
            windows.close()
            seen = fit_windows(calibration, windows, progress)
            for name, about in seen.arrays.items():
                writer.add(name, *about)
            tell(seen.render())
    return Path(path)


def _rows(calibration: Calibration) -> dict[str, tuple[tuple[int, ...], str, str, str]]:
    """Arrays of a force map file with one row per frame: shape of a row, unit, meaning and type."""
    pixels, pads = calibration.recon.areas.shape, (len(calibration.skin.pads),)
    rows = {
        "time": ((), "ns", "since time_epoch_utc", "i8"),
        "force": (pixels, "N", "force on each pixel", "f4"),
        "force_se": (pixels, "N", "standard error of a pixel's force, for the shape as it is", "f4"),
        "pad_force": (pads, "N", "force on each pad", "f8"),
        "pad_force_se": (pads, "N", "standard error of a pad's force", "f8"),
        "pad_force_half": (pads, "N", "half the interval that 90 % of readings of a pad's force fall into", "f8"),
        "total_force": ((), "N", "sum of the forces on the pads", "f8"),
        "total_force_half": ((), "N", "half the 90 % interval of a reading of the sum", "f8"),
        "pad_valid": (pads, "1", "pressure in the calibrated range", "u1"),
        "shape_valid": (pads, "1", "1: shape from the image; 0: even", "u1"),
    }
    if calibration.locator is None:
        return rows
    contacts = (calibration.locator.contacts,)
    return rows | {
        "contact_position": ((*contacts, 2), "m", "of each contact found; NaN: none", "f8"),
        "contact_force": (contacts, "N", "its shares of the forces on pads that it lies on", "f8"),
    }


def _of_block(time: np.ndarray, found: ForceEstimate, multiple: float) -> dict[str, np.ndarray]:
    """Rows under the names of `_rows`; half the 90 % interval is a multiple of the standard error.

    Errors of different pads count as independent.
    """
    parts = {
        "time": time,
        "force": found.map.force,
        "force_se": found.map.standard_error,
        "pad_force": found.force,
        "pad_force_se": found.standard_error,
        "pad_force_half": multiple * found.standard_error,
        "total_force": found.force.sum(1),
        "total_force_half": multiple * np.sqrt((found.standard_error**2).sum(1)),
        "pad_valid": found.valid,
        "shape_valid": found.map.valid,
        "contact_position": found.position,
        "contact_force": found.contact_force,
    }
    return {name: np.asarray(part) for name, part in parts.items()}


def _corrected(stream: Stream, span: slice, corrections: Sequence[AbstractCorrection]) -> tuple[np.ndarray, np.ndarray]:
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
