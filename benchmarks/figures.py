"""The style that the pictures of the results share."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from calib.report.figures import plain_numbers

GREY = "#555555"
BLUE, ORANGE = "#1f5fa8", "#d9730d"


def panels(width: float, height: float, rows: int, columns: int, **how: Any) -> tuple[Figure, Sequence[Any]]:
    """A figure of so many inches, and its axes row by row."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure, list(np.ravel(figure.subplots(rows, columns, **how)))


def logarithmic(axes: Any, title: str, size: float = 10, grid: str = "both", plain: bool = True, **labels: Any) -> None:
    """Both axes logarithmic, with a grid and numbers as people write them."""
    axes.set(xscale="log", yscale="log", **labels)
    axes.set_title(title, fontsize=size)
    if plain:
        plain_numbers(axes)
    axes.grid(True, which=grid, color="#e4e4e4", linewidth=0.8 if grid == "major" else 0.7)


def legend(figure: Figure, entries: Iterable[dict[str, Any]], columns: int, size: float = 8.5) -> None:
    """Below the panels, an entry for each look of a line or marker with its label."""
    handles = [Line2D([], [], **{"color": GREY} | entry) for entry in entries]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=size, frameon=False)
