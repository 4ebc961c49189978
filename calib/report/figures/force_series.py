"""The figure of true and estimated forces over time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from .parts import BLUE, GREEN, GREY, RED, new_figure, plain_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SERIES = (BLUE, RED, GREEN, "#7b3fa0", "#d9730d")
"""Colours of the contacts or pads, repeated in this order."""


@dataclass(frozen=True, eq=False)
class ForceSeries:
    """True and estimated forces over time.

    | meaning                                  | shape     | unit |
    |------------------------------------------|-----------|------|
    | title of the figure                      |           |      |
    | names of the contacts or pads            | (k,)      |      |
    | time                                     | (n,)      | s    |
    | true and estimated forces                | (n, k)    | N    |
    | events: name to time                     |           | s    |
    """

    title: str
    names: tuple[str, ...]
    time: np.ndarray
    true: np.ndarray
    estimated: np.ndarray
    events: Mapping[str, float] = field(default_factory=dict)


def force_series_figure(series: Sequence[ForceSeries], *, simulated: bool = False) -> "Figure":
    """The paper's figure 8: forces over time while contacts begin and end in turn, and their errors below.

    Raises:
        ReportError: matplotlib is not installed.
    """
    figure = new_figure(9.6, 5.6, simulated)
    panels = figure.subplots(2, len(series), sharex="col", sharey="row", squeeze=False, height_ratios=[2, 1])
    for (above, below), one in zip(panels.T, series, strict=True):
        _series_panels(above, below, one)
    panels[0, 0].set_ylabel("force, N")
    panels[1, 0].set_ylabel("estimated − true, N")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _series_panels(above: Any, below: Any, one: ForceSeries) -> None:
    for k, name in enumerate(one.names):
        colour = SERIES[k % len(SERIES)]
        above.plot(one.time, one.true[:, k], "--", color=colour, lw=1.2)
        above.plot(one.time, one.estimated[:, k], color=colour, lw=1.4, label=plain_label(name, 40))
        below.plot(one.time, one.estimated[:, k] - one.true[:, k], color=colour, lw=1.0)
    for name, when in one.events.items():
        for axes in (above, below):
            axes.axvline(when, color=GREY, lw=0.7, zorder=0)
        at = {"xycoords": above.get_xaxis_transform(), "rotation": 90, "va": "top", "ha": "right"}
        above.annotate(plain_label(name), (when, 0.98), fontsize=7.5, color="#555555", **at)
    above.plot([], [], "--", color="#333333", lw=1.2, label="true")
    above.set_title(plain_label(one.title, 60), fontsize=10)
    above.grid(alpha=0.25)
    below.axhline(0, color=GREY, lw=1)
    below.grid(alpha=0.25)
    below.set_xlabel("time, s")
