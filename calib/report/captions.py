"""Alternative texts and captions of the figures of a report."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.evaluation import CALIBRATED, FORCE_METHODS, Evaluation
from ..calibration.press_examples import PressExamples
from ..fitting.fields import FIELDS, FittedField
from .figures.presses import ESTIMATOR_MEANING, sensitivity_maps
from .html_parts import number_text


def about_localisation(evaluation: Evaluation, estimators: Sequence[str]) -> tuple[str, str]:
    """Alternative text and caption of the map of true and estimated positions."""
    s = evaluation.summary()
    means = (f"{number_text(1e3 * s[f'localisation_{e}_mean'], 1)} mm by the estimator {e}" for e in estimators)
    inward = 1e3 * s[f"localisation_{estimators[0]}_inward_bias"]
    alt = (
        f"Map of the sheet with true and estimated positions of {len(evaluation.force)} presses; "
        f"mean error {', '.join(means)}."
    )
    caption = (
        "True positions of the tip are black (white on a dark page), estimated ones red; green circles are the "
        "electrodes with their numbers, grey lines the "
        "outlines of the pads. Look for lines that all point one way: towards the centre they are the inward shift "
        f"of presses near the rim ({number_text(inward, 1)} mm on average by {estimators[0]}, positive is inward); "
        "all in parallel they are an offset between the stage and the sheet; swapped or mirrored regions are "
        "electrodes in another order."
    )
    return alt, caption


def about_maps(examples: PressExamples, estimator: str, larger: int) -> tuple[str, str]:
    """Alternative text and caption of images, force maps and contacts, whose ellipses are so many times larger."""
    count, fitted = len(examples.force), estimator == "fitted"
    meaning = "where the calibration finds it" if fitted else ESTIMATOR_MEANING.get(estimator, estimator)
    by = "the noise of this frame and the errors of place of all presses" if fitted else "the errors of all presses"
    return (
        f"EIT images and force maps of {count} presses, over the outlines of sheet and pads, with the contacts found.",
        f"{count} presses of nearly the largest force: one that pads share, the others near the middles of pads. "
        "EIT image: with the force of the load cell. Force map: the image cut by the pads and scaled so that each "
        "pad's part sums to the force that its pressure tells; its total stands above it. The cross marks the true "
        f"place. The ellipse holds the contact ({meaning}) with 90 %, by {by}"
        f"{f', and is drawn {larger} times larger' if larger > 1 else ''}. These presses were fitted, not held out.",
    )


def about_curved(estimator: str) -> tuple[str, str]:
    """Alternative text and caption of the views of a curved sheet."""
    return (
        "Places, sensitivity and two force maps on the curved sheet in space.",
        f"The sheet as it is curved. Places: true ones and those of the estimator {estimator}. Sensitivity: "
        "estimated over true total force, divided by its mean. Force maps: of the first and the last press of the "
        "figure above. All other figures show the sheet unrolled, with distances along it.",
    )


def about_sensitivity(evaluation: Evaluation) -> tuple[str, str]:
    """Alternative text and caption of the maps of sensitivity."""
    s, maps = evaluation.summary(), sensitivity_maps(evaluation)
    spreads = [f"{FORCE_METHODS[name]} {number_text(s.get(f'cv_{name}_ddof1', math.nan), 3)}" for name in maps]
    alt = (
        f"{len(maps)} maps of sensitivity over its mean at every place pressed; coefficients of variation: "
        f"{', '.join(spreads)}."
    )
    caption = (
        "The same newton reads high where the map is red and low where it is blue; the maps share one colour scale, "
        "which is cut at the largest 2 % of the values. Look for a blue rim in EIT only (fewer electrodes see it), for "
        "patches (uneven coating or contact), and in hybrid for lines along the edges of pads, where the stiff "
        "border carries part of the load or two pads share it. The hybrid map shows the pads and their curves, not the "
        "image: a force map sums to the pad's force whatever the image is."
    )
    if CALIBRATED in maps:
        caption += f" Calibrated is this calibration itself: {evaluation.recipe}."
    return alt, caption


def about_curves(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> tuple[str, str]:
    """Alternative text and caption of the curves and the force errors."""
    alt = (
        f"Pressure-force curves of {len(calibration.skin.pads)} pads with their presses; a map of force errors over "
        "the sheet; force errors against force and in the order of the presses."
    )
    caption = (
        "First the curve of each pad over the pressures fitted, with the 95 % band of the curve itself (1.96 standard "
        "errors; single presses scatter more), and the means over the hold of presses that this pad carried to 90 % "
        "or more. The curve is fitted to whole presses, loading to release. Points in groups beside the curve are "
        f"places that respond differently. {_about_structure(calibration)}; a slope or bend over force asks for "
        "another curve; a trend or a step over time is drift." + _one_level(calibration.evaluation, bool(evaluations))
    )
    return alt, caption


def about_loops(calibration: Calibration) -> tuple[str, str]:
    """Alternative text and caption of loading and unloading."""
    loops = calibration.loops
    assert loops is not None
    widths = [loops.width(pad) for pad in range(len(calibration.skin.pads))]
    said = ", ".join(f"{number_text(width, 2)} N" for width in widths)
    alt = f"Force against pressure along one press of each pad; mean of loading over unloading: {said}."
    law = "the law's own loop" if calibration.curves.curve.path else "one line for both ways, as this law has no memory"
    caption = (
        "Of each pad the whole press of median stiffness among those at nearly its largest force. Blue is loading, red "
        "unloading, black (white on a dark page) the pad's "
        f"fitted law times the gain at that place: {law}. Look for blue above red: at the same pressure the load is "
        "larger on the way in than on the way out, by the newtons in the titles on average; where that is more than "
        "the errors you can bear, calibrate with --curve hysteresis or auto. A loop that is open at the hold alone is "
        "the pad relaxing; one that does not end at zero is a baseline that moved."
    )
    return alt, caption


def _about_structure(calibration: Calibration) -> str:
    below = "Then estimated minus true force of presses the fit had not seen, by place, by force and over time."
    if calibration.field is None:
        return f"{below} Structure in the map asks for a correction by location"
    return (
        f"The curve is that of a gain of 1. {below} Structure left in the map is what the field of gain cannot follow, "
        "or a place estimated wrongly"
    )


def about_gain(field: FittedField) -> tuple[str, str]:
    """Alternative text and caption of the maps of gain."""
    alt = "Two maps of the pads: the gain by the place pressed, and its standard error with the places of the presses."
    spread, noise = (number_text(100 * float(size), 1) for size in (field.spread, field.noise))
    caption = (
        "Force is the pad's curve times this gain at the estimated place: above 1 (red) the pad feels a press less "
        "than on average over its presses, below 1 (blue) more. Black points are the estimated places of the presses; "
        "beyond them the gain of the nearest edge of their box holds. Single presses scatter by "
        f"{spread} % about the curves alone and by {noise} % about curves and gain. The standard error is that of the "
        f"field chosen ({FIELDS.name_of(field.field)}): where it is large, more presses are wanted."
    )
    return alt, caption


def _one_level(evaluation: Evaluation, others: bool) -> str:
    force = evaluation.force
    if np.ptp(force) > 0.1 * force.max():
        return ""
    more = "" if others else " Evaluate on presses at other forces before trusting those."
    return f" All presses were held at about {force.mean():.3g} N, so the errors here are those of that force." + more
