"""Doubts about the places by which forces are corrected: off the sheet, no better than a guess, or of no use."""

import numpy as np
from jaxtyping import Float

import jaxeit as je

from ...fitting.fields import Places
from ...fitting.results import FitError
from ..evaluation import CALIBRATED, Evaluation
from .locators import LOCATORS, AbstractLocatorChoice

MAX_OFF_SHEET = 0.5  # share of the places of presses outside the box of the sheet
# Least error of places that the best linear map leaves, over that of a guess: a stage with swapped axes or another
# origin leaves less.
MIN_LEFT = 0.5
MIN_SPREAD = 0.01  # m, of presses about their middle: closer ones are no test of places
MIN_PRESSES = 8  # a linear map has three coefficients a direction
MAX_RATIO = 1.25  # of the errors of forces with and without the correction: less may be chance


def require_on_sheet(skin: je.Skin, places: Places | None, locator: AbstractLocatorChoice) -> None:
    """Refuse a locator that puts most presses off the sheet, as one that returns millimetres does.

    Raises:
        FitError: names the locator, its places and the sheet.
    """
    if places is None:
        return
    place, (low, high) = np.asarray(places.position[:, 0], float), np.asarray(skin.domain.bounds, float)
    known = np.isfinite(place).all(1)
    off = known & ((place < low) | (place > high)).any(1)
    if off.sum() > MAX_OFF_SHEET * known.sum():
        middle = np.median(place[off], 0)
        raise FitError(
            f"locator {LOCATORS.text(locator)}: the places of {off.sum()} of {known.sum()} presses lie off the sheet, "
            f"about ({middle[0]:g}, {middle[1]:g}) m; return x and y in m, here {low[0]:g} to {high[0]:g} m and "
            f"{low[1]:g} to {high[1]:g} m"
        )


def worse_than_baseline_note(position: Float[np.ndarray, "n 2"], place: Float[np.ndarray, "n 2"] | None) -> str:
    """A note where the places of images err by more than the middle of all presses does; otherwise empty.

    A stage that lies aside as a whole is another matter: places of images then follow those of the stage.

    Args:
        position: that the stage tells, m; NaN: not known.
        place: that the images tell, m; NaN: not known.
    """
    if place is None:
        return ""
    known = np.isfinite(position).all(1) & np.isfinite(place).all(1)
    if known.sum() < MIN_PRESSES:
        return ""
    stated, seen = position[known], place[known]
    columns = np.column_stack([np.ones(len(seen)), seen - seen.mean(0)])
    left = _mean_length(stated - columns @ np.linalg.lstsq(columns, stated, rcond=None)[0])
    guess, error = _mean_length(stated - stated.mean(0)), _mean_length(stated - seen)
    if not MIN_SPREAD < guess <= error or left < MIN_LEFT * guess:
        return ""
    return (
        f"localisation is no better than guessing: contacts that EIT shows err by {1e3 * error:.0f} mm on average, "
        f"and the middle of all presses by {1e3 * guess:.0f} mm; check electrodes and scan, or "
        "calibrate without --location"
    )


def _mean_length(vectors: Float[np.ndarray, "n 2"]) -> float:
    return float(np.hypot(*vectors.T).mean())


def correction_that_harms(found: Evaluation) -> str:
    """A note where forces with the correction by location err more than by the paper's recipe; otherwise empty."""
    if "hybrid" not in found.others:
        return ""
    errors = np.column_stack([found.forces[name] - found.force for name in (CALIBRATED, "hybrid")])
    known = np.isfinite(errors).all(1)
    if not known.any():
        return ""
    corrected, plain = np.sqrt(np.mean(errors[known] ** 2, 0))
    if corrected <= MAX_RATIO * plain:
        return ""
    return (
        f"the correction by location makes errors {found.held_out} larger ({corrected:.3g} N against {plain:.3g} N "
        "of the paper's recipe): calibrate without --location"
    )
