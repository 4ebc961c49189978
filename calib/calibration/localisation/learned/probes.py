"""Presses that a calibration kept, and how what covers the sheet spreads loads, as they tell."""

from typing import Any

import numpy as np
from jaxtyping import Float

import jaxeit as je
from jaxeit.tracking import Tracker, TrackerSettings

from ...calibration import Calibration

# Part of a pad's force by which curve and shape of the load may err; its standard error is that of the pressure alone.
PAD_SHARE = 0.05


def pad_errors(force: Float[np.ndarray, "*n pads"], error: Float[np.ndarray, "*n pads"]) -> np.ndarray:
    """Standard errors of the forces on pads as data for a tracker, N."""
    return np.asarray(np.hypot(error, PAD_SHARE * force))


def probe_presses(calibration: Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Frames of presses of the calibration (n, readings) V, the forces on the pads and their errors (n, pads) N; None
    for a calibration of an early version, which kept none."""
    probes = calibration.probes
    if probes is None:
        return None
    force, error, _ = calibration.pad_forces(probes.pressure)
    return probes.dv, force, pad_errors(force, error)


def learned_depth(calibration: Calibration, tracker: Tracker) -> float:
    """Depth of the sheet, m, as presses of the calibration tell (`jaxeit.tracking.fit_depth`); 0: loads are Gaussian.

    Where the gain of the contact layer was learned, it is the depth of then: under another one presses show another
    gain.

    Args:
        tracker: of the skin, whose loads are Gaussian.
    """
    if calibration.layer is not None:
        return calibration.layer.field.depth
    presses = probe_presses(calibration)
    return 0.0 if presses is None else je.tracking.fit_depth(tracker, *presses)


def depth_of_loads(calibration: Calibration, model: je.Model, known: dict[str, Any]) -> float:
    """The same for fits of loads.

    Args:
        known: noise, sigma and channels of the frames whose loads are to be fitted.
    """
    settings = TrackerSettings(most=1)
    return learned_depth(calibration, je.tracking.prepare_tracker(model, calibration.skin, settings, **known))
