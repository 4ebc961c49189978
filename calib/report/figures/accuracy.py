"""The picture of `jaxeit bench`: error against time, one point per fidelity."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from jaxeit.accuracy import undominated

from .parts import bare_figure, plain_numbers

with suppress(ImportError):  # an extra: without it everything but the figures works
    from matplotlib.lines import Line2D
if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMED = ("draft", "standard", "reference")
_COLOURS = {1: "#d9730d", 2: "#1f5fa8"}
_GREY = "#8a8a8a"


def ladder_figure(ladders: Sequence[Mapping[str, Any]]) -> "Figure":
    """A panel per ladder: difference error against time per forward solve.

    Args:
        ladders: from `jaxeit.accuracy.Ladder.summary`. If its rungs have ``least_ms``, the shortest time of the
            factorisation that the arithmetic and memory of the machine allow, a line shows this bound.

    Raises:
        ReportError: where matplotlib is not installed.
    """
    figure = bare_figure(5.2 * len(ladders) + 0.4, 4.9, layout="constrained")
    for axes, found in zip(figure.subplots(1, len(ladders), sharey=True, squeeze=False)[0], ladders, strict=True):
        _panel(axes, found)
    figure.axes[0].set_ylabel("error of the difference data, % of its rms")
    limited = any("least_ms" in rung for found in ladders for rung in found["rungs"])
    figure.legend(handles=_legend(limited), loc="outside lower center", ncols=3, fontsize=8.5, frameon=False)
    return figure


def _panel(axes: Any, found: Mapping[str, Any]) -> None:
    axes.set(xscale="log", yscale="log", xlabel="time of one forward solve, ms")
    axes.set_title(", ".join([found["skin"], *found["effects"]]), fontsize=10.5)
    plain_numbers(axes)
    axes.margins(0.12)
    axes.grid(True, which="major", color="#e4e4e4", linewidth=0.8)
    axes.axhspan(0, 100 * found["reference"]["difference_uncertainty"], color="#f0f0f0", zorder=0)
    rungs = _once(found["rungs"])
    front = sorted(_point(rung) for rung in rungs if rung["front"])
    axes.plot(*zip(*front, strict=True), color=_GREY, linewidth=0.9, zorder=1)
    least = [(rung["least_ms"], 100 * rung["difference_error"]) for rung in rungs if "least_ms" in rung]
    if least:
        limit = sorted(undominated(least, lambda costs: costs))
        axes.plot(*zip(*limit, strict=True), color=_GREY, linewidth=1.2, linestyle=":", zorder=1)
    for rung in rungs:
        _mark(axes, rung)


def _once(rungs: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The first rung of each fidelity."""
    found: list[Mapping[str, Any]] = []
    for rung in rungs:
        if all(rung["fidelity"] != other["fidelity"] for other in found):
            found.append(rung)
    return found


def _point(rung: Mapping[str, Any]) -> tuple[float, float]:
    return 1e3 * rung["forward"]["median"], 100 * rung["difference_error"]


def _mark(axes: Any, rung: Mapping[str, Any]) -> None:
    fidelity, place = rung["fidelity"], _point(rung)
    colour = _COLOURS[fidelity["order"]]
    face = colour if fidelity["dtype"] == "float64" else "white"
    plain = fidelity["solver"] == "None"
    axes.plot(*place, marker="o" if plain else "s", color=colour, markerfacecolor=face, markersize=6, linestyle="none")
    if rung["label"] in NAMED:
        below = {"xytext": (-9, -9), "ha": "right", "va": "center"}  # where no rung is, nor the line between them
        axes.annotate(rung["label"], place, textcoords="offset points", fontsize=9, **below)


def _legend(limited: bool) -> list["Line2D"]:
    dot: dict[str, Any] = {"linestyle": "none", "marker": "o"}
    entries = [Line2D([], [], color=colour, label=f"P{order}, float64", **dot) for order, colour in _COLOURS.items()]
    entries.append(Line2D([], [], color=_GREY, markerfacecolor="white", label="float32", **dot))
    entries.append(Line2D([], [], color=_GREY, marker="s", linestyle="none", label="another solver"))
    entries.append(Line2D([], [], color="#f0f0f0", linewidth=7, label="below the reference's uncertainty"))
    if limited:
        label = "least time of the factorisation here"
        entries.append(Line2D([], [], color=_GREY, linewidth=1.2, linestyle=":", label=label))
    return entries
