"""Force maps in newtons: from changes of frames and pressures, by the parts of a calibration."""

from dataclasses import replace
from typing import Any, NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

import jaxeit as je

from ...fitting.curves.samples import bucket
from ...fitting.fields import Places
from ...fitting.fields.places import nowhere
from ...fitting.logs import LogPrediction
from ...fitting.pad_gains import PadGains
from ...fitting.pads import PadModel
from ...session import SessionError
from ..argument_checks import require_calibration, require_no_eit_choices
from ..calibration import Calibration, real_rows
from ..localisation.locators import AbstractLocator, locate
from ..logs.calibration import LogCalibration

USED_PARTS = ("/device", "/streams/eit", "/streams/pressure")  # parts of a session from which forces are computed


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
    | total_error: standard error of one reading of the sum over the pads      | (n,)         | N    |

    Contacts are found by a calibration with a correction by location; otherwise K is 0. The force of a pad is divided
    among contacts by the parts of their fitted bumps on the pad. Forces of pads without a contact are noise or
    crosstalk and belong to no contact.

    Example:
        pressed = found.force.sum(1) > 1.0  # N
        print(f"{pressed.sum()} of {len(pressed)} frames are pressed; maps {found.map.force.shape}")
        print(found.contact_force[strongest])  # N of each contact
    """

    map: je.fusion.ForceMap
    force: Any
    standard_error: Any
    valid: Any
    position: Any
    contact_force: Any
    total_error: Any


class ForceModel(eqx.Module):
    """The parts of a `Calibration` from which forces are computed, as one pytree for compiled programs."""

    recon: je.Reconstructor | je.imaging.IterativeReconstructor
    masks: je.fusion.PadMasks
    pads: PadModel
    locator: AbstractLocator | None

    @property
    def remembers(self) -> bool:
        """Whether forces depend on the pressures that came before."""
        return self.pads.curves.curve.path

    def moved(self, gains: PadGains | None) -> "ForceModel":
        """The model with these gains of the pads."""
        return replace(self, pads=replace(self.pads, gains=gains))


def force_model(calibration: Calibration) -> ForceModel:
    """The parts of a calibration from which forces are computed."""
    c = calibration
    return ForceModel(c.recon, c.masks, c.pads, c.locator)


@overload
def force_map(
    calibration: Calibration,
    frames: ArrayLike,
    pressures: ArrayLike,
    place: None = None,
    *,
    gate: float = je.fusion.USUAL_GATE,
    before: np.ndarray | None = None,
) -> ForceEstimate: ...


@overload
def force_map(
    calibration: LogCalibration, time: ArrayLike, values: ArrayLike, /, place: ArrayLike | None = None
) -> LogPrediction: ...


def force_map(
    calibration: Calibration | LogCalibration,
    frames: ArrayLike,
    pressures: ArrayLike,
    place: ArrayLike | None = None,
    *,
    gate: float = je.fusion.USUAL_GATE,
    before: np.ndarray | None = None,
) -> ForceEstimate | LogPrediction:
    """Force maps from changes of frames and pad pressures against the skin without contact.

    By the calibration of a log, the force over time, which has no map: ``force_map(calibration, time, values)`` is
    ``calibration.predict(time, values)``, with times (n,) ns and all channels as they were recorded, (n, columns).

    Args:
        frames: change of the readings, (n, readings) V.
        pressures: change of the readings of the pads at the same times, (n, pads) Pa.
        place: of the contact (n, 2) m, only for the calibration of a log that `needs_place`.
        gate: as in `jaxeit.fuse`.
        before: the pads' own pressures that came earlier, (m, pads) Pa, for curves with memory; see `remembered`.

    Raises:
        ValueError: if the shapes do not fit the calibration, or values are not real numbers.
        FusionError: if the gate is no number from 0 to 1.
        SessionError: for what is no calibration; a place for the calibration of a skin; for that of a log a gate or
            earlier pressures, and as `LogCalibration.predict`.
    """
    if isinstance(calibration, LogCalibration):
        require_no_eit_choices("force_map", gate=None if gate == je.fusion.USUAL_GATE else gate, before=before)
        return calibration.predict(frames, pressures, place)
    require_calibration(calibration, "force_map")
    if place is not None:
        raise SessionError("force_map: the place of contact is that of the frames; leave out place")
    return _force_map(calibration, frames, pressures, gate, before)


def _force_map(
    calibration: Calibration, frames: ArrayLike, pressures: ArrayLike, gate: float, before: np.ndarray | None
) -> ForceEstimate:
    """`force_map` for the calibration of a skin."""
    je.fusion.require_gate(gate)
    if before is not None:
        before = calibration.pad_rows(before, "before")
    frames, pressures = _changes(calibration, frames, pressures)
    if not len(frames):  # programs are of one row at least
        row = _force_map(calibration, np.zeros((1, frames.shape[1])), np.zeros((1, pressures.shape[1])), gate, None)
        return first_rows(row, 0)
    model = force_model(calibration)
    pressures = jnp.asarray(pressures, model.pads.dtype)
    frames = jnp.asarray(frames, model.recon.dtype)
    earlier = filled(model, before)
    image, places = model.recon(frames), None
    if model.locator is not None:
        touched = jnp.any(is_loaded(model, pressures), 1, keepdims=True)
        places = locate(model.locator, jnp.where(touched, frames, 0), model.recon, model.masks, image)
    found = _fused(model, image, pressures, places, None if earlier is None else jnp.asarray(earlier), gate)
    return ForceEstimate(found.map, *map(np.asarray, found[1:]))


def _changes(calibration: Calibration, frames: ArrayLike, pressures: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Frames (n, readings) V and pressures (n, pads) Pa; ValueError if they do not fit the calibration."""
    frames, pressures = real_rows(frames, "frames"), real_rows(pressures, "pressures")
    readings, pads = calibration.recon.readings, len(calibration.skin.pads)
    if frames.shape[1:] != (readings,) or pressures.shape != (len(frames), pads):
        raise ValueError(
            f"frames {frames.shape} and pressures {pressures.shape} do not fit this calibration: "
            f"give (n, {readings}) V and (n, {pads}) Pa"
        )
    return frames, pressures


def first_rows(found: ForceEstimate, count: int) -> ForceEstimate:
    """The forces in the first frames."""
    cut: ForceEstimate = jax.tree.map(lambda part: part[:count], found)
    return cut._replace(map=replace(cut.map, areas=found.map.areas))


def filled(model: ForceModel, before: np.ndarray | None) -> np.ndarray | None:
    """Earlier pressures (m, pads) after rows of NaN, which have no effect; None for curves without memory."""
    if before is None or not model.remembers:
        return None
    # Lengths are rounded up to a few sizes, because each new length compiles the program again.
    first = bucket(len(before))
    rows = np.concatenate([np.full((first - len(before), before.shape[1]), np.nan), before])
    return rows.astype(model.pads.dtype)


def fused(
    model: ForceModel,
    image: Float[Array, "n pixels"],
    pressures: Float[Array, "n pads"],
    places: Places | None,
    before: Float[Array, "m pads"] | None,
    gate: float,
) -> ForceEstimate:
    """`force_map` from known images and places (None: places are not estimated); pure."""
    force, error, valid, variance = model.pads.single(pressures, places, before)
    numbers, shares = (part.astype(image.dtype) for part in (force, error)), None
    if places is None:
        places = nowhere(pressures, 0)
    else:
        shares = je.fusion.contact_shares(
            places.position, places.width, places.amplitude, model.recon.centres, model.masks
        )
    pad_force, pad_error = numbers
    found = je.fuse(image, model.masks, pad_force, gate=gate, contacts=shares, pad_errors=pad_error)
    of_contacts = _of_contacts(force, places, shares)
    return ForceEstimate(found, force, error, valid, places.position, of_contacts, jnp.sqrt(variance))


_fused = je.verb(fused)


def _of_contacts(
    force: Float[Array, "n pads"], places: Places, shares: je.fusion.ContactShares | None
) -> Float[Array, "n K"]:
    """Force of each contact: its shares of the forces on the pads that it lies on; 0 for an absent contact.

    A contact beside a pad on which there is no other has a share of that pad, but what the pad reads is noise or
    crosstalk. A contact beside all pads keeps its shares.
    """
    weight = places.weight
    if shares is not None:
        weight = jnp.where(shares.on | ~jnp.any(shares.on, -1, keepdims=True), weight, 0)
    return jnp.einsum("np,nkp->nk", jnp.where(jnp.isfinite(force), force, 0), weight)


def unmoved_forces(
    model: ForceModel, pressures: Float[Array, "n pads"], places: Places | None
) -> Float[Array, "n pads"]:
    """Force on each pad from the pressures that it would have read at the calibration, one row for a contact; pure.

    For a curve with memory, each contact follows a full press and its release, as most presses of a used pad do.
    """
    pads = replace(model.pads, gains=None)
    if not model.remembers:
        return pads.forces(pressures, places).force
    full = jnp.broadcast_to(pads.curves.pressure_range[:, 1], pressures.shape)
    series = jnp.stack([full, jnp.zeros_like(full), pressures], 1).reshape(-1, pressures.shape[1])
    at = None if places is None else places[jnp.repeat(jnp.arange(len(pressures)), 3)]
    return pads.forces(series, at).force[2::3]


_LOADED_MULTIPLE = 3.0  # of the noise without force: noise rarely exceeds it, so that idle pads stay idle


@je.verb
def is_loaded(model: ForceModel, pressures: Float[Array, "n pads"]) -> Bool[Array, "n pads"]:
    """Whether the force on a pad, without correction by location, exceeds the noise of an idle pad; pure."""
    force = replace(model.pads, field=None).forces(pressures).force
    return force > _LOADED_MULTIPLE * model.pads.idle_noise
