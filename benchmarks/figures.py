"""What the pictures of the results share: panels, axes, curves and legends."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from calib.report.figures.parts import plain_numbers

from .rows import Row, grouped

GREY = "#555555"
BLUE, ORANGE = "#1f5fa8", "#d9730d"


def panels(width: float, height: float, rows: int, columns: int, **how: Any) -> tuple[Figure, Sequence[Any]]:
    """A figure of so many inches, and its axes row by row."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure, list(np.ravel(figure.subplots(rows, columns, **how)))


def logarithmic(axes: Any, title: str, size: float = 10, grid: str = "both", plain: bool = True, **labels: Any) -> None:
    """Make both axes logarithmic, with a grid and decimal numbers."""
    axes.set(xscale="log", yscale="log", **labels)
    axes.set_title(title, fontsize=size)
    if plain:
        plain_numbers(axes)
    axes.grid(True, which=grid, color="#e4e4e4", linewidth=0.8 if grid == "major" else 0.7)


def curves(axes: Any, rows: Iterable[Row], x: str, y: str, by: Sequence[str], look: Callable[..., Row]) -> None:
    """Draw ``y`` over ``x`` of the rows that have both, a curve for each group, with ``look(*values of the group)``."""
    found = grouped((row for row in rows if row.get(x) is not None and row.get(y) is not None), *by)
    for key, several in found.items():
        how = {"marker": "o"} | (look(*key) if len(by) > 1 else look(key))
        axes.plot([row[x] for row in several], [row[y] for row in several], **how)


def legend(figure: Figure, entries: Iterable[Row], columns: int, size: float = 8.5) -> None:
    """Below the panels, an entry for each look of a line or marker with its label."""
    handles = [Line2D([], [], **{"color": GREY} | entry) for entry in entries]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=size, frameon=False)
