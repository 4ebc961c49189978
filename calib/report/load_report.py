"""The part of a report about what touched the skin, window by window: probabilities, places and forces."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from jaxeit.contacts import LoadKind

from ..calibration.localisation.load_windows import left_by_fits
from .figures.force_series import SERIES
from .figures.panels import WIDE_PANEL_WIDTH, FigurePanel, chart_axes, panel
from .figures.parts import MM
from .html_parts import html_table, number_text

MOST_WINDOWS = 60  # in the table
LEGEND = 0.3  # height of the legend, over that of all probabilities
NAMES = {
    LoadKind.NONE: "nothing",
    LoadKind.ONE: "one contact",
    LoadKind.TWO: "two contacts",
    LoadKind.EDGE: "an edge",
    LoadKind.MORE: "more contacts",
}
CAPTION = (
    "Probabilities of what touched the skin in each window, one above the other. On skins that are like the simulated "
    "ones, a kind is the true one about as often as its probability says."
)
Windows = Mapping[str, np.ndarray]


def load_parts(windows: Windows, learned: Sequence[str] = (), *, simulated: bool) -> list[str]:
    """The part of a page, as elements of HTML; empty without windows.

    Args:
        windows: arrays of the group "loads" of a file of force maps, by their names.
        learned: what presses of the calibration told the fits, a line each.

    Raises:
        ReportError: matplotlib is not installed.
    """
    if not windows or not len(windows["time"]):
        return []
    chart = panel_of_kinds(windows, simulated=simulated).html()
    alt = "Probabilities of what touched the skin over time"
    shown = f"<div class='panels few' role='group' aria-label='{alt}'>{chart}</div>"
    return [
        "<h2>What touched the skin</h2>",
        f"<figure>{shown}<figcaption>{escape(CAPTION)}</figcaption></figure>",
        *_notes(windows, learned),
        _table(windows),
    ]


def panel_of_kinds(windows: Windows, *, simulated: bool) -> FigurePanel:
    """Probabilities of the kinds over time, one above the other."""
    figure, axes = chart_axes(simulated=simulated, width=WIDE_PANEL_WIDTH, height=0.6 * WIDE_PANEL_WIDTH)
    begin, end = windows["time"].T / 1e9
    bottom = np.zeros(len(begin))
    for kind, name in NAMES.items():
        share = windows["probability"][:, kind]
        colour = "#9e9e9e" if kind is LoadKind.NONE else SERIES[kind - 1]
        axes.bar(begin, share, end - begin, bottom, align="edge", color=colour, label=name, lw=0)
        bottom += share
    axes.set(xlabel="time, s", ylabel="probability", ylim=(0, 1 + LEGEND), title="What touched the skin")
    axes.set_yticks(np.linspace(0, 1, 6))
    axes.legend(ncols=3, fontsize=8, frameon=False, loc="upper center")
    return panel(figure, axes, "kinds", "Probabilities of what touched the skin over time")


def _notes(windows: Windows, learned: Sequence[str]) -> list[str]:
    left = left_by_fits(windows["misfit"]) if "misfit" in windows else ""  # a file of an early version has none
    said = [f"Of these windows, {left}"] if left else []
    said += [f"What presses of the calibration taught the fits: {line}" for line in learned]
    return [*_of_network(windows), *(f"<p>{escape(line)}.</p>" for line in said)]


def _of_network(windows: Windows) -> list[str]:
    unlike = int(np.sum(windows["distance"] > 1))
    if np.isnan(windows["distance"]).all():
        return ["<p>Fits alone tell these probabilities; no network was used.</p>"]
    told = f"{unlike} of {len(windows['distance'])} windows are unlike what the network was trained on"
    return [f"<p>{told}; fits alone tell these.</p>"] if unlike else []


def _table(windows: Windows) -> str:
    """One row for each window: the kinds with their probabilities, and the loads of the most probable one."""
    count = len(windows["time"])
    rows = [_row({name: part[k] for name, part in windows.items()}) for k in range(min(count, MOST_WINDOWS))]
    head = ["from, s", "to, s", "most probably", *NAMES.values(), "at, mm", "force, N"]
    left_out = f"<p>The first {MOST_WINDOWS} of {count} windows.</p>" if count > MOST_WINDOWS else ""
    return html_table(head, {"": rows}) + left_out


def _row(one: Windows) -> tuple[str, ...]:
    probability, there = one["probability"], np.isfinite(one["force"])
    places = (", ".join(number_text(x * MM, 0) for x in place) for place in one["position"][there])
    forces = (number_text(force, 1) for force in one["force"][there])
    return (
        *(number_text(t / 1e9, 2) for t in one["time"]),
        NAMES[LoadKind(int(probability.argmax()))],
        *(f"{100 * p:.0f} %" for p in probability),
        "; ".join(places),
        "; ".join(forces),
    )
