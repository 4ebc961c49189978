"""The paper's figures 5 and 6: places and evenness of the presses of an evaluation."""

from collections.abc import Mapping
from contextlib import suppress
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

import jaxeit as je

from ...calibration.evaluation import CALIBRATED, Evaluation
from .parts import (
    GREY,
    MM,
    RED,
    ReportError,
    colour_reach,
    draw_electrodes,
    draw_sheet,
    label_y_once,
    new_figure,
    plain_label,
    value_map,
)

with suppress(ImportError):  # an extra: without it everything but the figures works
    from matplotlib.collections import LineCollection
if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATOR_MEANING: Mapping[str, str] = MappingProxyType(
    {
        "peak": "largest pixel",
        "half": "centroid of the pixels at or above 1/2 of the maximum",
        "quarter": "centroid of the pixels at or above 1/4 of the maximum",
        "positive": "value-weighted centroid of the positive part",
        "fitted": "place that the correction by location goes by",
    }
)
"""The position that each named estimator of an evaluation takes, in words."""


def localisation_figure(evaluation: Evaluation, skin: je.Skin, *estimators: str, simulated: bool = False) -> "Figure":
    """The paper's figure 5: true positions (black), estimated ones (red), a line between.

    Args:
        evaluation: of the presses.
        skin: for its outline, electrodes (green) and pads.
        estimators: names in ``evaluation.estimated``, one panel each; default: "quarter".
        simulated: whether to write SIMULATED above the figure.

    Raises:
        ReportError: no such estimator, or matplotlib is not installed.
    """
    estimators = estimators or ("quarter",)
    for unknown in set(estimators) - set(evaluation.estimated):
        known = ", ".join(evaluation.estimated) or "none"
        raise ReportError(f"no estimator {unknown!r} in this evaluation; there are: {known}")
    figure = new_figure(*((6.6, 7.2) if len(estimators) == 1 else (9.6, 6.2)), simulated)
    panels = figure.subplots(1, len(estimators), sharex=True, sharey=True, squeeze=False)[0]
    for axes, estimator in zip(panels, estimators, strict=True):
        localisation_panel(axes, evaluation, skin, estimator)
    label_y_once(panels)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def localisation_panel(axes: Any, evaluation: Evaluation, skin: je.Skin, estimator: str) -> None:
    """Draw true and estimated places of one estimator, with electrodes and pads."""
    draw_sheet(axes, skin)
    draw_electrodes(axes, skin)
    true, estimated = evaluation.position * MM, evaluation.estimated[estimator] * MM
    axes.add_collection(LineCollection(list(np.stack([true, estimated], 1)), colors=GREY, linewidths=0.8))
    axes.plot(*true.T, "o", ms=3.2, color="black", label="true", zorder=3)
    axes.plot(*estimated.T, "o", ms=3.2, color=RED, label="estimated", zorder=4)
    axes.set_title(_localisation_title(evaluation, estimator), fontsize=10)


def _localisation_title(evaluation: Evaluation, estimator: str) -> str:
    estimate = evaluation.estimated[estimator]
    error = np.linalg.norm(estimate - evaluation.position, axis=1) * MM
    found = np.isfinite(error)
    mean = f"{error[found].mean():.1f} mm" if found.any() else "unknown"
    lost = f", {np.count_nonzero(~found)} not found" if not found.all() else ""
    meaning = ESTIMATOR_MEANING.get(estimator, "")
    return f"Mean localisation error {mean} ({len(error)} presses{lost})\nestimator {plain_label(estimator)}" + (
        f":\n{meaning}" if meaning else ""
    )


def sensitivity_figure(evaluation: Evaluation, skin: je.Skin, *, simulated: bool = False) -> "Figure":
    """The paper's figure 6: sensitivity over its mean at every place, EIT only and hybrid.

    A calibration that is more than the paper's recipe has a third panel. All maps share one colour scale, symmetric
    about 1.

    Raises:
        ReportError: matplotlib is not installed.
    """
    maps = sensitivity_maps(evaluation)
    figure = new_figure(9.6, 5.4 if len(maps) == 2 else 4.0, simulated)
    panels = figure.subplots(1, len(maps), sharex=True, sharey=True)
    summary = evaluation.summary()
    reach = colour_reach(np.concatenate(list(maps.values())) - 1)
    for axes, (name, values) in zip(panels, maps.items(), strict=True):
        draw_sheet(axes, skin)
        drawn = value_map(axes, evaluation.position, values, 1 - reach, 1 + reach, "RdBu_r")
        axes.set_title(sensitivity_title(name, summary), fontsize=10)
    label_y_once(panels)
    bar = figure.colorbar(drawn, ax=panels, shrink=0.8, extend="both", pad=0.02)
    bar.set_label("sensitivity / its mean")
    return figure


def sensitivity_maps(evaluation: Evaluation) -> dict[str, np.ndarray]:
    """Sensitivity by method as in figure 6, (presses,) each, divided by its mean."""
    maps = {"eit": evaluation.sensitivity_eit, "hybrid": evaluation.sensitivity_hybrid}
    calibrated = evaluation.sensitivity(CALIBRATED)
    if not np.array_equal(calibrated, maps["hybrid"]):
        maps[CALIBRATED] = calibrated
    return {name: values / values.mean() for name, values in maps.items()}


_SENSITIVITY_TITLE = {
    "eit": "EIT only: image sum / force",
    "hybrid": "Hybrid: estimated / true force",
    CALIBRATED: "Calibrated: estimated / true force",
}


def sensitivity_title(name: str, summary: Mapping[str, float]) -> str:
    """Name of a map of sensitivity, with its coefficient of variation."""
    label = _SENSITIVITY_TITLE[name]
    if f"cv_{name}_ddof1" not in summary:
        return f"{label}\nCV needs two presses or more"
    cv, error = summary[f"cv_{name}_ddof1"], summary.get(f"cv_{name}_se")
    spread = "" if error is None else f" ± {error:.3f} (SE)"  # one place does not tell it
    return f"{label}\nCV {cv:.3f}{spread}, ddof 1"
