"""At which depth in an elastic half-space the sheet lies, from frames in which one contact presses."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from .._compile import require_known
from ..contacts.loads.spreading import Spreading
from ..imaging.inputs import InverseError
from .belief.state import Pads
from .model_error import press_observations, with_loads
from .tracker import Tracker

# Depths, m, between which the best one is searched: below a third of the usual width loads are as good as Gaussian. The
# search begins only if presses speak for the trial depth, and ends when the depth is known to this length.
DEPTH_LIMITS, TRIAL_DEPTH, PRECISION = (3e-3, 30e-3), 8e-3, 2e-4
# Most presses that tell the depth: a few do, since each is a hundred readings of one number.
MAX_PRESSES = 12
# Log of the ratio of probabilities from which a press speaks for a depth, on average. Where loads spread by a depth it
# is fifty and more; less is of a layer of another law, which a depth explains in part, at another place.
MIN_LOG_RATIO = 5.0


def fit_depth(
    tracker: Tracker,
    dv: Float[ArrayLike, "n readings"],
    pad_forces: Float[ArrayLike, "n pads"] | None = None,
    pad_errors: Float[ArrayLike, "n pads"] | None = None,
) -> float:
    """Depth of the sheet, m, for `LoadSettings.depth`, under which presses are most probable; 0: loads are Gaussian.

    What covers the sheet spreads loads, and their tails reach farther than those of a Gaussian. A tracker that takes
    loads for Gaussian explains the tails by another place, and by a gain of the contact layer that is none. Loads are
    Gaussian if no depth makes the presses far more probable.

    Args:
        tracker: whose loads are Gaussian.
        dv: difference frames, (n, readings) V, in each of which one contact presses, as means over holds; the first
            `MAX_PRESSES` count.
        pad_forces, pad_errors: forces on the pads and their standard errors, (n, pads) N, as for `Tracker.step`.

    Raises:
        InverseError: if there is no frame, an array has another shape, or jit hides the values.

    Example:
        presses = jnp.stack(frames[:2])  # one contact in each
        depth = tracking.fit_depth(tracker, presses)
        loads = je.contacts.LoadSettings(depth=depth)
        deeper = tracking.TrackerSettings(loads=loads)  # for `prepare_tracker`
        print(f"{1e3 * depth:.1f} mm")
    """
    require_known("fit_depth", InverseError, dv, pad_forces, pad_errors)
    observations = press_observations(tracker, dv, pad_forces, pad_errors)[:MAX_PRESSES]
    enough = _log_probability(tracker, observations) + MIN_LOG_RATIO * len(observations)

    @cache
    def log_probability(depth: float) -> float:
        return _log_probability(_at_depth(tracker, depth), observations)

    if log_probability(TRIAL_DEPTH) <= enough:
        return 0.0
    found = minimize_scalar(
        lambda depth: -log_probability(depth), bounds=DEPTH_LIMITS, method="bounded", options={"xatol": PRECISION}
    )
    return float(found.x)


def _at_depth(tracker: Tracker, depth: float) -> Tracker:
    loads, field = replace(tracker.settings.loads, depth=depth), replace(tracker.field, depth=depth)
    spreading = Spreading.at_depth(depth, tracker.settings.dtype)
    return with_loads(tracker, loads, field, lambda one: one.sheet.spreading, spreading)


def _log_probability(tracker: Tracker, observations: Sequence[tuple[np.ndarray, Pads]]) -> float:
    """Log of the probability of presses, up to a constant.

    How far each press errs is not known: a mean over a hold has less noise than a frame, and near a bolt any model
    errs. With Jeffreys' prior of the scale of its n errors a press of chi-square D has a probability as D^(-n/2).
    """
    before, size = tracker.start().belief, tracker.programs.size
    updates = [tracker.press_update(before, *one) for one in observations]
    deviances = [float(one.misfit) + float(one.correction_square) for one in updates]
    return float(-0.5 * size * np.log(np.nan_to_num(deviances, nan=np.inf)).sum())
