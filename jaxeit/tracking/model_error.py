"""How far the model of a skin errs, from frames in which one contact presses."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from .._compile import require_known
from ..imaging.noise import InverseError
from .belief.filter import Pads
from .belief.layer import LearnedLayer
from .tracker import Tracker

# Model errors that are tried: each is larger than the one before by this factor, up to the last.
STEP, LAST = 2**0.5, 0.15
# Share of the presses whose model error is no larger than that of the tracker.
SHARE = 0.9


def fit_model_error(
    tracker: Tracker,
    dv: Float[ArrayLike, "n readings"],
    pad_forces: Float[ArrayLike, "n pads"] | None = None,
    pad_errors: Float[ArrayLike, "n pads"] | None = None,
) -> Tracker:
    """The tracker with the model error that nine of ten frames of single presses stay below.

    Mesh, contact layer and loads of a real skin are not those of the model. A tracker that takes the model for better
    than it is explains what the model leaves of a press by further contacts. Here one contact is fitted to each frame
    under each of some model errors, from that of the settings on, until the evidence of the frame falls (empirical
    Bayes; MacKay 1992, Neural Computation 4, 415). Presses differ: near an electrode a model may err ten times as
    much as elsewhere, and the tracker must not err there either.

    Args:
        dv: difference frames, (n, readings) V, in each of which one contact presses, as means over holds.
        pad_forces, pad_errors: forces on the pads and their standard errors, (n, pads) N, as for `Tracker.step`.

    Raises:
        InverseError: if there is no frame, an array has another shape, or jit hides the values.

    Example:
        presses = jnp.stack(frames[:2])  # one contact in each
        humble = tracking.fit_model_error(tracker, presses)
        print(humble.settings.loads.model_error, tracking.press_evidence(humble, presses))
    """
    require_known("fit_model_error", InverseError, dv, pad_forces, pad_errors)
    seen = _seen(tracker, dv, pad_forces, pad_errors)
    least = tracker.settings.loads.model_error
    last = max(0, int(np.ceil(np.log(LAST / least) / np.log(STEP))))
    tried = cache(lambda k: _with_model_error(tracker, least * STEP**k))  # most presses ask for the first few
    found = [_most_probable(tried, last, *one) for one in seen]
    return tried(int(np.quantile(found, SHARE, method="higher")))


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
    seen = _seen(tracker, dv, pad_forces, pad_errors)
    before = tracker.start(layer).belief
    return np.array([float(tracker.press_update(before, frame, pads).evidence) for frame, pads in seen])


def _seen(
    tracker: Tracker, dv: ArrayLike, pad_forces: ArrayLike | None, pad_errors: ArrayLike | None
) -> list[tuple[np.ndarray, Pads]]:
    frames = np.asarray(dv, float)
    if frames.ndim != 2 or not len(frames):
        raise InverseError(f"dv has shape {frames.shape}; give one frame or more, (n, readings)")
    forces, errors = ([None] * len(frames) if a is None else list(np.asarray(a)) for a in (pad_forces, pad_errors))
    return [
        (tracker.frame(frame), tracker.pads(force, error))
        for frame, force, error in zip(frames, forces, errors, strict=True)
    ]


def _most_probable(
    tried: Callable[[int], Tracker], last: int, frame: Float[np.ndarray, " readings"], pads: Pads
) -> int:
    """Which of the trackers 0 to ``last`` makes a frame most probable; the evidence falls from there on."""
    best = _evidence(tried(0), frame, pads)
    for k in range(last):
        evidence = _evidence(tried(k + 1), frame, pads)
        if evidence < best:
            return k
        best = evidence
    return last


def _with_model_error(tracker: Tracker, error: float) -> Tracker:
    settings = replace(tracker.settings, loads=replace(tracker.settings.loads, model_error=error))
    value = jnp.asarray(error, tracker.filter.model_error.dtype)
    changed = (eqx.tree_at(lambda f: f.model_error, one, value) for one in (tracker.filter, tracker.of_presses))
    return Tracker(*changed, settings, tracker.area, tracker.field)


def _evidence(tracker: Tracker, frame: Float[np.ndarray, " readings"], pads: Pads) -> float:
    """Log of the probability of a frame with one contact, up to a constant that all model errors share.

    The contact begins as contacts of the tracker do. Where its fit then ends elsewhere, a tracker that believes its
    model less goes less astray.
    """
    programs, before = tracker.programs, tracker.start().belief
    left = programs.unexplained(before, frame, pads)  # y / s, with s^2 = 1 + e |y|^2 / n, e = error_share
    belief = tracker.events.with_contact(before, programs.explaining_place(left))
    share = 1 - float(tracker.filter.error_share) * float(left @ left) / len(left)  # 1 / s^2
    return float(programs.completed(belief, frame, pads).evidence) + 0.5 * len(left) * float(np.log(share))
