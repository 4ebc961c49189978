"""Parts that all figures share.

Lengths are drawn in mm, pressures in kPa, forces in N. Nothing here touches matplotlib's global state.
"""

import io
from pathlib import Path
from typing import Any

import numpy as np

import jaxeit as je

from ...session import replacing

try:  # an extra: without it everything but the figures works
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
except ImportError:
    Figure = None  # type: ignore[assignment,misc]

MM = 1e3
DPI = 125
UNDATED = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}  # equal figures give equal files
RED, GREEN, BLUE, GREY = "#c62828", "#2e7d32", "#1f5fa8", "#8a8a8a"
OUTLINE = "#747474"  # of pads, on white, on black and on maps
MARKS = ("#d9730d", "#7b3fa0", "#00838f", "#6d4c41")
LAST_IN_FONT = "\u052f"  # the font that comes with matplotlib has Latin, Greek and Cyrillic letters


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
    """The figure at a path, whole or not at all: PDF or SVG by the end of its name, or else PNG."""
    kind = path.suffix.lower()
    with replacing(path) as new:
        if kind in UNDATED:
            figure.savefig(new, format=kind[1:], metadata=UNDATED[kind])
        else:
            new.write_bytes(png(figure))


def png(figure: "Figure") -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()


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
    """Draw electrodes that give outlines to scale, all others as circles of one size, because most are too small."""
    drawings = [electrode.drawing(skin.domain) for electrode in skin.electrodes]
    shapes = [outline * MM for drawing in drawings for outline in drawing.outlines]
    place = skin.electrode_positions[[not drawing.outlines for drawing in drawings]] * MM
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
