"""How far the model of a skin errs, from frames in which one contact presses."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from .._compile import require_known
from ..contacts.loads import LoadSettings
from ..contacts.loads.learned.model_error import select_model_error
from ..imaging.inputs import InverseError, require_real
from ..messages.kinds import require_unmasked
from .belief.contact_filter import ContactFilter
from .belief.layer import GainField, LearnedLayer
from .belief.state import Pads
from .preparation import MESH_ERROR_RATIO
from .tracker import Tracker
from .unexpected_frames import has_converged


def fit_model_error(
    tracker: Tracker,
    dv: Float[ArrayLike, "n readings"],
    pad_forces: Float[ArrayLike, "n pads"] | None = None,
    pad_errors: Float[ArrayLike, "n pads"] | None = None,
) -> Tracker:
    """The tracker with the model error that nine of ten frames of single presses stay below.

    Mesh, contact layer and loads of a real skin are not those of the model. A tracker that takes the model for better
    than it is explains what the model leaves of a press by further contacts. Here one contact is fitted to each frame
    under each of some model errors, from that of the settings on (`select_model_error`). Frames for which no such fit
    converges are left out.

    Args:
        dv: difference frames, (n, readings) V, in each of which one contact presses, as means over holds.
        pad_forces, pad_errors: forces on the pads and their standard errors, (n, pads) N, as for `Tracker.step`.

    Raises:
        InverseError: if there is no frame, an array has another shape, the fit of one contact converges for half of the
            frames or less, or jit hides the values.

    Example:
        presses = jnp.stack(frames[:2])  # one contact in each
        humble = tracking.fit_model_error(tracker, presses)
        print(humble.settings.loads.model_error, tracking.press_evidence(humble, presses))
    """
    require_known("fit_model_error", InverseError, dv, pad_forces, pad_errors)
    observations = press_observations(tracker, dv, pad_forces, pad_errors)
    tracker_with = cache(partial(_with_model_error, tracker))  # most presses ask for the first few

    def evidence(frame: np.ndarray, pads: Pads, error: float) -> float:
        return _evidence(tracker_with(error), frame, pads)

    evidences = [partial(evidence, *one) for one in observations]
    return tracker_with(select_model_error(evidences, tracker.settings.loads.model_error))


def press_evidence(
    tracker: Tracker,
    dv: Float[ArrayLike, "n readings"],
    pad_forces: Float[ArrayLike, "n pads"] | None = None,
    pad_errors: Float[ArrayLike, "n pads"] | None = None,
    layer: LearnedLayer | None = None,
) -> Float[np.ndarray, " n"]:
    """Log of the probability of each frame of a single press (n,), up to a constant of the frame.

    What was learned of the contact layer is true if presses from which it was not learned are more probable with it.

    Args:
        dv, pad_forces, pad_errors: as for `fit_model_error`.
        layer: as for `Tracker.start`.
    """
    require_known("press_evidence", InverseError, dv, pad_forces, pad_errors)
    observations = press_observations(tracker, dv, pad_forces, pad_errors)
    before = tracker.start(layer).belief
    return np.array([float(tracker.press_update(before, frame, pads).evidence) for frame, pads in observations])


def press_observations(
    tracker: Tracker, dv: ArrayLike, pad_forces: ArrayLike | None, pad_errors: ArrayLike | None
) -> list[tuple[np.ndarray, Pads]]:
    """Frames of single presses, with what pads tell of each.

    Raises:
        InverseError: if there is no frame, or an array has another shape.
    """
    require_real(dv=dv)
    require_unmasked({"pad_forces": pad_forces, "pad_errors": pad_errors}, InverseError)
    frames = np.asarray(dv, float)
    if frames.ndim != 2 or not len(frames):
        raise InverseError(f"dv has shape {frames.shape}; give one frame or more, (n, readings)")
    forces, errors = ([None] * len(frames) if a is None else list(np.asarray(a)) for a in (pad_forces, pad_errors))
    return [
        (tracker.frame(frame), tracker.pads(force, error))
        for frame, force, error in zip(frames, forces, errors, strict=True)
    ]


def _with_model_error(tracker: Tracker, error: float) -> Tracker:
    loads = replace(tracker.settings.loads, model_error=error)
    field = replace(tracker.field, mesh_error=MESH_ERROR_RATIO * error)
    value = jnp.asarray(error, tracker.filter.model_error.dtype)
    return with_loads(tracker, loads, field, lambda one: one.model_error, value)


def with_loads(
    tracker: Tracker, loads: LoadSettings, field: GainField, where: Callable[[ContactFilter], Any], value: Any
) -> Tracker:
    """A tracker with other settings of loads, whose value is at ``where`` in both of its filters, and another field."""
    settings = replace(tracker.settings, loads=loads)
    followed, single = (eqx.tree_at(where, each, value) for each in (tracker.filter, tracker.press_filter))
    return Tracker(followed, single, settings, tracker.area, field)


def _evidence(tracker: Tracker, frame: Float[np.ndarray, " readings"], pads: Pads) -> float:
    """Log of the probability of a frame with one contact, up to a constant that all model errors share.

    The contact begins where the fit of a single press has found it, which tries several places: a fit that ends
    elsewhere, or does not converge, would ask for a larger error of the model only to be led less astray. Where no fit
    converges the probability counts as zero.
    """
    programs, before = tracker.programs, tracker.start().belief
    press = tracker.press_update(before, frame, pads)
    if not has_converged(press):
        return -np.inf
    begin = tracker.events.with_contact(before, np.asarray(press.belief.contacts)[0, :2])
    # The frames of a tracker reach less far than a single press, and the error is to hold what that leaves out.
    update = programs.single_frame_update(begin, frame, pads)
    if not has_converged(update):
        return -np.inf
    left = programs.innovation(before, frame, pads)  # y / s, with s^2 = 1 + e |y|^2 / n, e = error_share
    share = 1 - float(tracker.filter.error_share) * float(left @ left) / len(left)  # 1 / s^2
    return float(update.evidence) + 0.5 * len(left) * float(np.log(share))
