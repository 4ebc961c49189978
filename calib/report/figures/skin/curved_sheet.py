"""Results on a curved sheet, in space: places, sensitivity and force maps, as seen from in front of the skin."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

import jaxeit as je

from ....calibration.application.force_maps import force_map
from ....calibration.calibration import Calibration
from ..panels import CHART_HEIGHT, PANEL_WIDTH, FigurePanel, panel, panel_figure
from ..parts import GREEN, GREY, MM, RED, cell_edges, colour_reach, new_figure

try:  # an extra, as in `figures`
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection
except ImportError:
    Poly3DCollection = None

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VIEW = {"elev": 48, "azim": -72}  # degrees
ZOOM = 1.0
PROJECTION: dict[str, Any] = {"projection": "3d", "computed_zorder": False}
LABELS = ("", "sensitivity / its mean", "force per area, kPa", "force per area, kPa")  # of the views' scales of colour
EDGE_POINTS = 24  # along each side of a pad, so that its outline follows the surface


def curved_figure(calibration: Calibration, estimator: str) -> "Figure":
    """Four views of a skin with a surface: places, sensitivity, and the force maps of two examples.

    Args:
        calibration: of a skin whose sheet is curved, with examples.
        estimator: of the place; a name in ``calibration.evaluation.estimated``.
    """
    figure = new_figure(9.6, 6.4, calibration.simulated)
    panels = figure.subplots(2, 2, subplot_kw=PROJECTION).ravel()
    views = _views(calibration, estimator)
    drawn = [view(axes) for view, axes in zip(views, panels, strict=True)]
    figure.colorbar(drawn[1], ax=panels[1], shrink=0.6, pad=0.02).set_label(LABELS[1])
    figure.colorbar(drawn[3], ax=panels[2:], shrink=0.6, pad=0.02).set_label(LABELS[3])
    for axes in panels:
        _sheet(axes, calibration.skin)
    return figure


def curved_panels(calibration: Calibration, estimator: str) -> list[FigurePanel]:
    """The same four views as panels of the page."""
    return [
        _view_panel(calibration, view, label, f"view{k}")
        for k, (view, label) in enumerate(zip(_views(calibration, estimator), LABELS, strict=True))
    ]


def _view_panel(calibration: Calibration, view: Callable[[Any], Any], label: str, name: str) -> FigurePanel:
    figure, beside = panel_figure(PANEL_WIDTH, CHART_HEIGHT, calibration.simulated), 0.8
    axes = figure.add_axes((0.0, 0.0, beside if label else 1.0, 0.95), **PROJECTION)
    drawn = view(axes)
    _sheet(axes, calibration.skin)
    for cells in axes.collections:
        cells.set_rasterized(True)
    if label:
        figure.colorbar(drawn, cax=figure.add_axes((beside, 0.15, 0.03, 0.7))).set_label(label)
    return panel(figure, axes, name)


def _views(calibration: Calibration, estimator: str) -> list[Callable[[Any], Any]]:
    """Functions that draw one view each and return what has a scale of colour."""
    found, skin, shown, recon = calibration.evaluation, calibration.skin, calibration.examples, calibration.recon
    assert shown is not None
    values = found.total_force / found.force / (found.total_force / found.force).mean()
    reach = colour_reach(values - 1)
    chosen = [0, len(shown.force) - 1]
    force = np.asarray(force_map(calibration, shown.dv[chosen], shown.pressure[chosen]).map.force)
    areas = np.asarray(recon.areas)
    density = np.where(areas > 0, force / np.where(areas > 0, areas, 1), np.nan) / 1e3
    high = float(np.nanmax(density)) or 1.0
    x0, x1, y0, y1 = np.asarray(recon.extent, float)
    rows, columns = recon.shape
    edges = np.linspace(x0, x1, columns + 1), np.linspace(y0, y1, rows + 1)

    def force_view(k: int, axes: Any) -> Any:
        axes.plot(*_lifted(skin, shown.position[chosen[k]][None]), "+", color=RED, ms=9, zorder=4)
        axes.set_title(f"force map, {force[k].sum():.3g} N", fontsize=10)
        return _cells(axes, skin, *edges, density[k].reshape(rows, columns), (0.0, high), "viridis")

    return [
        lambda axes: _places(axes, skin, found.position, found.estimated[estimator]),
        lambda axes: _at_places(axes, skin, found.position, values, (1 - reach, 1 + reach)),
        partial(force_view, 0),
        partial(force_view, 1),
    ]


def _lifted(skin: je.Skin, chart: np.ndarray) -> np.ndarray:
    """Points of the sheet in space, (3, n) mm."""
    assert skin.surface is not None
    return np.asarray(skin.surface(chart).T * MM)


def _sheet(axes: Any, skin: je.Skin) -> None:
    rim = np.union1d(np.linspace(0, skin.domain.perimeter, 181), skin.domain.corners)
    outline = _lifted(skin, skin.domain.boundary_point(rim))
    axes.plot(*outline, color=GREY, lw=1.2, zorder=2)
    for pad in skin.pads:
        ends = np.roll(pad.outline, -1, 0)
        along = np.linspace(0, 1, EDGE_POINTS)[:, None]
        sides = [start + along * (end - start) for start, end in zip(pad.outline, ends, strict=True)]
        axes.plot(*_lifted(skin, np.concatenate(sides)), color="#555555", lw=0.9, zorder=3)
    axes.view_init(**VIEW)
    axes.set(**{f"{name}lim": (part.min(), part.max()) for name, part in zip("xyz", outline, strict=True)})
    axes.set_box_aspect(np.maximum(np.ptp(outline, 1), 1e-3), zoom=ZOOM)
    axes.set_axis_off()


def _places(axes: Any, skin: je.Skin, true: np.ndarray, estimated: np.ndarray) -> None:
    start, end = _lifted(skin, true).T, _lifted(skin, estimated).T
    for pair in zip(start, end, strict=True):
        axes.plot(*np.transpose(pair), color=GREY, lw=0.8, zorder=3)
    axes.plot(*_lifted(skin, skin.electrode_positions), "o", ms=7, mfc="none", mec=GREEN, zorder=3, label="electrode")
    axes.plot(*start.T, "o", ms=3, color="black", zorder=4, label="true")
    axes.plot(*end.T, "o", ms=3, color=RED, zorder=4, label="estimated")
    axes.legend(loc="lower left", frameon=False, fontsize=8)
    axes.set_title(
        f"places, mean error {np.nanmean(np.linalg.norm(estimated - true, axis=1)) * MM:.1f} mm", fontsize=10
    )


def _at_places(axes: Any, skin: je.Skin, position: np.ndarray, values: np.ndarray, limits: tuple[float, float]) -> Any:
    """Values at the places of a grid as cells, otherwise as marks."""
    axes.set_title("estimated / true force", fontsize=10)
    place, index = np.unique(np.round(position, 6), axis=0, return_inverse=True)
    mean = np.bincount(index.ravel(), values) / np.bincount(index.ravel())
    x, y = np.unique(place[:, 0]), np.unique(place[:, 1])
    if min(len(x), len(y)) > 1 and len(x) * len(y) == len(place):
        low, high = np.array(skin.domain.bounds)
        across, up = (np.clip(cell_edges(c), low[k], high[k]) for k, c in enumerate((x, y)))
        return _cells(axes, skin, across, up, mean.reshape(len(x), len(y)).T, limits, "RdBu_r")
    return axes.scatter(*_lifted(skin, place), c=mean, cmap="RdBu_r", vmin=limits[0], vmax=limits[1], s=40, zorder=3)


def _cells(
    axes: Any,
    skin: je.Skin,
    x: np.ndarray,
    y: np.ndarray,
    values: np.ndarray,
    limits: tuple[float, float],
    colours: str,
) -> Any:
    """Cells between edges x and y, coloured by values (len(y) - 1, len(x) - 1); cells of NaN are left out."""
    corners = np.stack(np.meshgrid(x, y), -1)
    parts = [corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]]
    quads = np.stack(parts, 2).reshape(-1, 2)
    shapes = _lifted(skin, quads).T.reshape(-1, 4, 3)
    known = np.isfinite(values.ravel())
    cells = Poly3DCollection(shapes[known], cmap=colours, linewidths=0, antialiased=False, zorder=1)
    cells.set_array(values.ravel()[known])
    cells.set_clim(*limits)
    axes.add_collection3d(cells)
    return cells
