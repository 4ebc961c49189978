"""The figure of a contact that moves: its place and force over time, as they are followed and as they are."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from .parts import BLUE, GREEN, RED, new_figure, plain_label

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WITHIN = float(norm.ppf(0.95))
QUANTITIES = (("along the path, mm", BLUE), ("across the path, mm", RED), ("force, N", GREEN))


@dataclass(frozen=True, eq=False)
class Stroke:
    """A contact over time.

    | meaning                                                            | shape  | unit     |
    |--------------------------------------------------------------------|--------|----------|
    | title of the panels                                                |        |          |
    | time                                                               | (n,)   | s        |
    | true, estimated: along and across the path of the contact, and its | (n, 3) | mm, mm,  |
    |   force; estimates are NaN where no contact is followed            |        | N        |
    | deviation: stated standard deviations of the estimates             | (n, 3) | mm, mm, N |
    """

    title: str
    time: Float[np.ndarray, " n"]
    true: Float[np.ndarray, "n 3"]
    estimated: Float[np.ndarray, "n 3"]
    deviation: Float[np.ndarray, "n 3"]


def moving_contact_figure(strokes: Sequence[Stroke], *, simulated: bool = False) -> "Figure":
    """Place and force of moving contacts over time, with intervals of 90 %.

    Raises:
        ReportError: matplotlib is not installed.
    """
    figure = new_figure(9.6, 6.4, simulated)
    panels = figure.subplots(len(QUANTITIES), len(strokes), sharex="col", sharey="row", squeeze=False)
    for column, stroke in zip(panels.T, strokes, strict=True):
        for k, axes in enumerate(column):
            _panel(axes, stroke, k)
        column[0].set_title(plain_label(stroke.title, 60), fontsize=10)
        column[-1].set_xlabel("time, s")
    for axes, (label, _) in zip(panels[:, 0], QUANTITIES, strict=True):
        axes.set_ylabel(label)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _panel(axes: Any, stroke: Stroke, k: int) -> None:
    colour = QUANTITIES[k][1]
    middle, half = stroke.estimated[:, k], WITHIN * stroke.deviation[:, k]
    axes.fill_between(
        stroke.time, middle - half, middle + half, color=colour, alpha=0.2, lw=0, label="interval of 90 %"
    )
    axes.plot(stroke.time, middle, color=colour, lw=1.3, label="as followed")
    axes.plot(stroke.time, stroke.true[:, k], "--", color="#333333", lw=1.1, label="true")
    axes.grid(alpha=0.25)
