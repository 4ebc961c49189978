"""Applying a calibration: from frames and pressures to force maps in newtons."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

import jaxeit as je

from ..check.acceptance import accept
from ..fitting.curves.play_operators import remembered
from ..fitting.curves.samples import bucket
from ..fitting.fields import Places
from ..fitting.fields.places import nowhere
from ..fitting.pad_gains import PadGains
from ..fitting.pads import PadModel
from ..presses.corrections import AbstractCorrection, correct
from ..presses.streams import resample
from ..presses.table import Processing, resting_levels
from ..session import ArchiveWriter, Session, SessionError, Stream
from .calibration import Calibration
from .localisation.load_windows import WindowedFrames, fit_windows
from .localisation.locators import AbstractLocator

FORMAT = "skin-forcemap"
_BLOCK = 512  # frames held in memory at once
USED = ("/device", "/streams/eit", "/streams/pressure")  # parts of a session from which forces are computed
_MARGIN = 0.5  # s read beyond a block on both sides, so that filters start and end outside it

Progress = Callable[[Iterable[Any]], Iterable[Any]]


class ForceEstimate(NamedTuple):
    """Forces on the skin, frame by frame.

    | meaning                                                                  | shape        | unit |
    |--------------------------------------------------------------------------|--------------|------|
    | map: force on each pixel, its standard error, the validity of its shape  | (n, pixels)  | N    |
    | force on each pad                                                        | (n, pads)    | N    |
    | standard_error of one reading: of the model, and of the noise about it   | (n, pads)    | N    |
    | valid: pressure within the calibrated range                              | (n, pads)    |      |
    | position of each contact found; NaN: none                                | (n, K, 2)    | m    |
    | contact_force: its shares of the forces on pads that it lies on          | (n, K)       | N    |

    Contacts are found by a calibration with a correction by location; otherwise K is 0. The force of a pad is divided
    among contacts by the parts of their fitted bumps on the pad. Forces of pads without a contact are noise or
    crosstalk and belong to no contact.
    """

    map: je.ForceMap
    force: Any
    standard_error: Any
    valid: Any
    position: Any
    contact_force: Any


class ForceLaw(eqx.Module):
    """The parts of a `Calibration` from which forces are computed, as one pytree for compiled programs."""

    recon: je.Reconstructor | je.imaging.IterativeReconstructor
    masks: je.PadMasks
    pads: PadModel
    locator: AbstractLocator | None

    @property
    def remembers(self) -> bool:
        """Whether forces depend on the pressures that came before."""
        return self.pads.curves.curve.path

    def moved(self, gains: PadGains | None) -> "ForceLaw":
        """The law with these gains of the pads."""
        return replace(self, pads=replace(self.pads, gains=gains))


def law_of(calibration: Calibration) -> ForceLaw:
    """The parts of a calibration from which forces are computed."""
    c = calibration
    return ForceLaw(c.recon, c.masks, c.pads, c.locator)


def force_map(
    calibration: Calibration,
    frames: ArrayLike,
    pressures: ArrayLike,
    *,
    gate: float = 0.6,
    before: np.ndarray | None = None,
) -> ForceEstimate:
    """Force maps from changes of frames and pad pressures against the skin without contact.

    Args:
        frames: change of the readings, (n, readings) V.
        pressures: change of the readings of the pads at the same times, (n, pads) Pa.
        gate: as in `jaxeit.fuse`.
        before: the pads' own pressures that came earlier, (m, pads) Pa, for curves with memory; see `remembered`.

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
    frames = jnp.asarray(frames, law.recon.dtype)
    pressures = jnp.asarray(pressures, law.pads.dtype)
    earlier = filled(law, before)
    found = _force_map(law, frames, pressures, None if earlier is None else jnp.asarray(earlier), gate)
    return ForceEstimate(found.map, *map(np.asarray, found[1:]))


def filled(law: ForceLaw, before: np.ndarray | None) -> np.ndarray | None:
    """Earlier pressures (m, pads) after rows of NaN, which have no effect; None for curves without memory."""
    if before is None or not law.remembers:
        return None
    # Lengths are rounded up to a few sizes, because each new length compiles the program again.
    first = bucket(len(before))
    rows = np.concatenate([np.full((first - len(before), before.shape[1]), np.nan), before])
    return rows.astype(law.pads.dtype)


@je.verb
def _force_map(law: ForceLaw, frames: Array, pressures: Array, before: Array | None, gate: float) -> ForceEstimate:
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
    """`force_map` from known images and places (None: places are not estimated); pure."""
    force, error, valid = law.pads.with_noise(law.pads.forces(pressures, places, before))
    numbers, shares = (part.astype(image.dtype) for part in (force, error)), None
    if places is None:
        places = nowhere(pressures, 0)
    else:
        shares = je.fusion.contact_shares(places.position, places.width, places.amplitude, law.recon.centres, law.masks)
    pad_force, pad_error = numbers
    found = je.fuse(image, law.masks, pad_force, gate=gate, contacts=shares, pad_errors=pad_error)
    return ForceEstimate(found, force, error, valid, places.position, _of_contacts(force, places, shares))


# Part of a contact's bump: a pad with less of it on its area does not bear that contact. A fitted bump has tails, and
# at the border of a pad they reach over to the neighbour.
_MIN_PART_ON_PAD = 0.1


def _of_contacts(
    force: Float[Array, "n pads"], places: Places, shares: je.fusion.ContactShares | None
) -> Float[Array, "n K"]:
    """Force of each contact: its shares of the forces on the pads that it lies on; 0 for an absent contact."""
    weight = places.weight
    if shares is not None:
        beside_all = jnp.all(shares.lies <= _MIN_PART_ON_PAD, -1, keepdims=True)  # such a contact keeps its shares
        on = (shares.lies > _MIN_PART_ON_PAD) | beside_all
        weight = jnp.where(on, weight, 0)
    return jnp.einsum("np,nkp->nk", jnp.where(jnp.isfinite(force), force, 0), weight)


def unmoved_forces(law: ForceLaw, pressures: Float[Array, "n pads"], places: Places | None) -> Float[Array, "n pads"]:
    """Force on each pad from the pressures that it would have read at the calibration; pure."""
    return replace(law.pads, gains=None).forces(pressures, places).force


_LOADED_MULTIPLE = 3.0  # of the noise without force: noise rarely exceeds it, so that idle pads stay idle


def is_loaded(law: ForceLaw, pressures: Float[Array, "n pads"]) -> Bool[Array, "n pads"]:
    """Whether the force on a pad, without correction by location, exceeds the noise of an idle pad; pure."""
    force = replace(law.pads, field=None).forces(pressures).force
    return force > _LOADED_MULTIPLE * law.pads.idle_noise


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

    The file, format skin-forcemap, appears only when complete.

    Args:
        processing: how the session is corrected; default: as the sessions of the calibration.
        ignore_errors: apply also to a session in whose skin, frames or pressures `check_session` finds an error; the
            file then names the errors.
        loads: also tell what touches the skin, none, one, two, an edge or more, in windows of so many s; None: do not.
        tell: called with a line about the loads.

    Raises:
        SessionError: if the session was recorded on another skin, lacks a stream, or holds no frame.
        RecordingError: if `check_session` finds an error in its skin, frames or pressures.
    """
    processing = processing or calibration.processing
    levels = resting_levels(session, calibration.skin, processing)
    ignored = accept([session], calibration.skin, ignore_errors=ignore_errors, where=USED)
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
