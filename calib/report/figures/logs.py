"""Figures of a log's calibration: residuals and predictions over force, forces over time, and gain by place."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...calibration.logs.evaluation import LogEvaluation
from ...fitting.fields import FittedField
from .pads import pad_gain, symmetric_limit
from .panels import PANEL_WIDTH, WIDE_PANEL_WIDTH, FigurePanel, chart_axes, panel
from .parts import BLUE, GREY, MM, RED, bare_figure, cell_edges

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MAX_POINTS = 2000  # drawn, evenly spread; more only make the page larger


def _rows(found: LogEvaluation, rows: np.ndarray) -> np.ndarray:
    """At most `MAX_POINTS` of the flagged samples."""
    at = np.flatnonzero(rows)
    return np.asarray(at[np.linspace(0, len(at) - 1, min(len(at), MAX_POINTS)).astype(int)])


def _axes(height: float, x: str, y: str) -> tuple["Figure", Any]:
    figure, axes = chart_axes(width=WIDE_PANEL_WIDTH, height=height)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    return figure, axes


def residual_figure(found: LogEvaluation) -> "Figure":
    """Predicted minus recorded force over the predicted force, with the interval; samples out of range in red."""
    figure, axes = _axes(3.2, "predicted force, N", "predicted - recorded, N")
    _scatter(axes, found, found.predicted, found.predicted - found.force)
    rows = _rows(found, found.known)
    rows = rows[np.argsort(found.predicted[rows])]
    half = ((found.high - found.low) / 2)[rows]
    axes.fill_between(found.predicted[rows], -half, half, color=GREY, alpha=0.25, linewidth=0)
    axes.axhline(0, color="black", linewidth=0.8)
    return figure


def scatter_figure(found: LogEvaluation) -> "Figure":
    """Predicted over recorded force."""
    figure, axes = _axes(3.6, "recorded force, N", "predicted force, N")
    _scatter(axes, found, found.force, found.predicted)
    low, high = np.nanmin(found.force[found.known]), np.nanmax(found.force[found.known])
    axes.plot([low, high], [low, high], color="black", linewidth=0.8)
    return figure


def _scatter(axes: Any, found: LogEvaluation, x: np.ndarray, y: np.ndarray) -> None:
    for rows, colour, label in ((found.valid, BLUE, "calibrated range"), (~found.valid, RED, "outside of it")):
        shown = _rows(found, found.known & rows)
        if len(shown):
            axes.plot(x[shown], y[shown], ".", color=colour, markersize=2.5, label=label)
    if not found.valid[found.known].all():
        axes.legend()


def time_figure(found: LogEvaluation) -> "Figure":
    """Recorded and predicted force over time, with the interval."""
    figure, axes = _axes(3.0, "time, s", "force, N")
    rows = _rows(found, np.isfinite(found.predicted))
    axes.fill_between(
        found.time[rows], found.low[rows], found.high[rows], color=BLUE, alpha=0.2, linewidth=0, label="90 % interval"
    )
    axes.plot(found.time[rows], found.predicted[rows], color=BLUE, linewidth=0.9, label="predicted")
    recorded = _rows(found, np.isfinite(found.force))
    axes.plot(found.time[recorded], found.force[recorded], ".", color="black", markersize=1.5, label="recorded")
    axes.legend()
    return figure


def place_panels(gain: FittedField, box: np.ndarray) -> list[FigurePanel]:
    """Gain and its standard error over the box (2, 2) m of the presses."""
    x, y, value, error = pad_gain(gain, 0, box)
    reach = symmetric_limit(value - 1)
    shown = (
        (value, (1 - reach, 1 + reach), "RdBu_r", "gain"),
        (error, (0.0, symmetric_limit(error)), "Purples", "standard error of the gain, %"),
    )
    return [_place_panel(cell_edges(x) * MM, cell_edges(y) * MM, *one) for one in shown]


def _place_panel(
    x: np.ndarray, y: np.ndarray, cells: np.ndarray, limits: tuple[float, float], colours: str, label: str
) -> FigurePanel:
    figure = bare_figure(PANEL_WIDTH, 0.8 * PANEL_WIDTH, layout="constrained")
    axes = figure.add_subplot()
    drawn = axes.pcolormesh(x, y, cells, vmin=limits[0], vmax=limits[1], cmap=colours, rasterized=True)
    figure.colorbar(drawn, ax=axes).set_label(label)
    axes.set_aspect("equal")
    axes.set(xlabel="x, mm", ylabel="y, mm", title=label)
    return panel(figure, axes, label.split()[0])
