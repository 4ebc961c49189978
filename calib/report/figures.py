"""Figures of presses: the paper's figures 5 and 6; and the parts that all figures share.

Lengths are drawn in mm, pressures in kPa, forces in N. Nothing here touches matplotlib's global state.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

import jaxeit as je

from ..calibration.evaluation import CALIBRATED, Evaluation
from ..session import replacing

try:  # an extra: without it everything but the figures works
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.figure import Figure
except ImportError:
    Figure = None  # type: ignore[assignment,misc]

MM = 1e3
DPI = 125
RED, GREEN, BLUE, GREY = "#c62828", "#2e7d32", "#1f5fa8", "#8a8a8a"
OUTLINE = "#747474"  # of pads, on white, on black and on maps
MARKS = ("#d9730d", "#7b3fa0", "#00838f", "#6d4c41")
LAST_IN_FONT = "\u052f"  # the font that comes with matplotlib has Latin, Greek and Cyrillic letters

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


class ReportError(ValueError):
    """A figure or a report cannot be made."""


def require_matplotlib() -> None:
    """Raise `ReportError` where matplotlib is not installed."""
    if Figure is None:
        raise ReportError("figures and reports need matplotlib, which is not installed; install jaxeit[report]")


def plain_numbers(axes: Any) -> None:
    """Label logarithmic axes with plain numbers, without powers of ten; on axes of about one decade also 2 and 5."""

    def between(axis: Any, value: float) -> str:
        low, high = axis.get_view_interval()
        return f"{value:g}" if high < 100 * low and f"{value:e}"[0] in "25" else ""

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(lambda value, _, axis=axis: between(axis, value))


def write_figure(figure: "Figure", path: Path) -> None:
    """The figure as a PNG file at a path, whole or not at all."""
    with replacing(path) as new:
        new.write_bytes(png(figure))


def png(figure: "Figure") -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


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
    cv, error = summary[f"cv_{name}_ddof1"], summary[f"cv_{name}_se"]
    return f"{label}\nCV {cv:.3f} ± {error:.3f} (SE), ddof 1"


# --- parts -----------------------------------------------------------------------------------------


def new_figure(width: float, height: float, simulated: bool) -> "Figure":
    """An empty figure of this size in inches; titled SIMULATED if it shows simulated data."""
    figure = bare_figure(width, height, layout="constrained")
    if simulated:
        figure.suptitle("SIMULATED", color=RED, fontsize=11, fontweight="bold")
    return figure


def bare_figure(width: float, height: float, layout: Any = None) -> "Figure":
    """An empty figure of this size in inches, without title and, by default, without layout."""
    require_matplotlib()
    figure = Figure(figsize=(width, height), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def plain_label(text: str, limit: int = 24) -> str:
    """Convert a name from a file to a label: one line, no mathematical notation, only letters of the font."""
    known = "".join(c if c.isprintable() and c <= LAST_IN_FONT else "?" for c in text)
    short = known if len(known) <= limit else known[: limit - 3] + "..."
    return short.replace("\\", "/").replace("$", r"\$")


def colour_reach(deviation: np.ndarray) -> float:
    """Half the span of a symmetric colour scale that covers nearly all values, so that one outlier does not set it."""
    size = np.abs(deviation[np.isfinite(deviation)])
    return float(max(np.percentile(size, 98), 1e-6)) if size.size else 1.0


def draw_sheet(axes: Any, skin: je.Skin) -> None:
    """Draw the outlines of the sheet and its pads, and label the axes in mm."""
    rim = np.union1d(np.linspace(0, skin.domain.perimeter, 181), skin.domain.corners)
    axes.plot(*(skin.domain.boundary_point(rim) * MM).T, color=GREY, lw=1.2, zorder=1)
    for pad in skin.pads:
        axes.fill(*(pad.outline * MM).T, fill=False, edgecolor=OUTLINE, lw=0.9, zorder=2)
    axes.set_aspect("equal")
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")


def draw_electrodes(axes: Any, skin: je.Skin) -> None:
    """Draw polygons to scale, all other electrodes as circles of one size, because most are too small to see."""
    shapes = [e.outline.corner_points * MM for e in skin.electrodes if isinstance(e, je.PolygonPatch)]
    round_ones = [not isinstance(e, je.PolygonPatch) for e in skin.electrodes]
    place = skin.electrode_positions[round_ones] * MM
    if len(place):
        axes.plot(*place.T, "o", ms=9, mfc="none", mec=GREEN, mew=1.6, label="electrode", zorder=2)
    label = None if len(place) else "electrode"
    axes.add_collection(PolyCollection(shapes, fc="none", ec=GREEN, lw=1.6, label=label, zorder=2))


def label_y_once(panels: Any) -> None:
    """Label the y axis of the first panel only, for panels that share it."""
    for axes in panels[1:]:
        axes.set_ylabel("")


def draw_pixels(
    axes: Any,
    image: je.imaging.AbstractReconstructor,
    values: np.ndarray,
    scale: tuple[float, float, str],
    interpolation: str | None = "none",
) -> Any:
    """Draw values of an image's pixels, with their scale (low, high, colours)."""
    low, high, colours = scale
    return axes.imshow(
        values.reshape(image.shape),
        origin="lower",
        extent=np.asarray(image.extent, float) * MM,
        cmap=colours,
        vmin=low,
        vmax=high,
        interpolation=interpolation,
        zorder=0,
    )


def value_map(axes: Any, position: np.ndarray, values: np.ndarray, low: float, high: float, colours: str) -> Any:
    """Draw values at places as coloured cells if the places form a grid, otherwise as coloured marks."""
    options = {"vmin": low, "vmax": high, "cmap": colours}
    place, index = np.unique(np.round(position, 6), axis=0, return_inverse=True)
    index = index.ravel()
    mean = np.bincount(index, values) / np.bincount(index)
    x, y = np.unique(place[:, 0]), np.unique(place[:, 1])
    if min(len(x), len(y)) > 1 and len(x) * len(y) == len(place):
        cells = mean.reshape(len(x), len(y)).T
        return axes.pcolormesh(cell_edges(x) * MM, cell_edges(y) * MM, cells, zorder=0, **options)
    marks = {"s": 60, "edgecolors": "black", "linewidths": 0.5, "zorder": 3}
    return axes.scatter(*(place * MM).T, c=mean, **marks, **options)


def cell_edges(centres: np.ndarray) -> np.ndarray:
    """Borders of cells about ascending centres."""
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])
