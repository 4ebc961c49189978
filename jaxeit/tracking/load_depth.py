"""At which depth in an elastic half-space the sheet lies, from frames in which one contact presses."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from .._compile import require_known
from ..contacts.loads.spreading import Spreading
from ..imaging.inputs import InverseError
from .belief.state import Update
from .model_error import press_observations
from .tracker import Tracker

# Depths, m, between which the best one is searched: below a third of the usual width loads are as good as Gaussian. The
# search ends when it is known to this length.
DEPTH_LIMITS, PRECISION = (3e-3, 30e-3), 2e-4
# Most presses that tell the depth: a few do, since each is a hundred readings of one number.
MAX_PRESSES = 12
# Share of presses that may be misfits where loads are Gaussian.
MAX_MISFIT_SHARE = 0.1
# Log of the ratio of probabilities from which a press speaks for a depth, on average. Where loads spread by a depth it
# is about fifty; less is of a layer of another law, which a depth explains in part, at another place.
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
    Gaussian if nine of ten presses are explained so, or if no depth makes the presses more probable.

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
    gaussian = [tracker.press_update(tracker.start().belief, *one) for one in observations]
    if np.mean([tracker.is_misfit(update) for update in gaussian]) <= MAX_MISFIT_SHARE:
        return 0.0

    @cache
    def log_ratio(depth: float) -> float:
        deeper = _at_depth(tracker, depth)
        found = [deeper.press_update(deeper.start().belief, *one) for one in observations]
        return _log_probability(found, tracker.programs.size) - _log_probability(gaussian, tracker.programs.size)

    found = minimize_scalar(
        lambda depth: -log_ratio(float(depth)), bounds=DEPTH_LIMITS, method="bounded", options={"xatol": PRECISION}
    )
    return float(found.x) if log_ratio(float(found.x)) > MIN_LOG_RATIO * len(observations) else 0.0


def _at_depth(tracker: Tracker, depth: float) -> Tracker:
    settings = replace(tracker.settings, loads=replace(tracker.settings.loads, depth=depth))
    spreading = Spreading.at_depth(depth, tracker.settings.dtype)
    filters = tracker.filter, tracker.press_filter
    followed, single = (eqx.tree_at(lambda one: one.sheet.spreading, each, spreading) for each in filters)
    return Tracker(followed, single, settings, tracker.area, replace(tracker.field, depth=depth))


def _log_probability(updates: Sequence[Update], size: int) -> float:
    """Log of the probability of presses of so many readings, up to a constant.

    Each press has the error of the model under which it is most probable, and at least that of the settings: a press
    near a bolt, where any model errs, says no more than others.
    """
    deviances = np.array([-2 * np.nan_to_num(float(one.evidence), nan=-np.inf) for one in updates])
    return float(-0.5 * size * np.log(np.maximum(deviances / size, 1)).sum())
