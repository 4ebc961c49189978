"""Error against time: linear and quadratic elements, both precisions, three gradings of the mesh, on two sheets."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import jaxeit as je
from jaxeit.linalg import NestedDissection

from .clock import Call, Tool, interleaved, seconds, spread, taken
from .figures import BLUE, GREY, ORANGE, curves, legend, logarithmic, panels
from .harness import Question, Run
from .markdown import cell
from .peers import cholmod, eidors
from .problems import CONTACT, ELECTRODES, Case, Problem, disc, rectangle
from .rows import Row, grouped
from .tools import Entry, forward_of, present

GRADINGS = (1.2, 1.4, 1.7)
EDGES = {1: (0.15, 0.05, 0.015), 2: (0.12, 0.06, 0.025)}  # by order; in sqrt(sheet area)
CELLS = {1: (30, 60, 120, 240), 2: (10, 30, 60, 120)}  # by order; regular meshes, cells a side
PEERS = (  # order, and cells a side; of more EIDORS takes too long: it assembles in a loop over elements, in Octave
    (Entry(cholmod.NAME, cholmod.prepare, cholmod), 1, (60,)),
    (Entry(eidors.NAME, partial(eidors.Eidors, order=2), eidors), 2, (10, 30, 60)),
)
TARGET = 2e-4


@dataclass(frozen=True, eq=False)
class Solve:
    """A tool at work on unit conductivity, how far it is off there, and what to call it."""

    labels: Row
    tool: Tool
    flat: np.ndarray


def with_error(case: Case, labels: Row, tool: Tool, elements: int) -> Solve:
    """The tool's first call, and its root mean square error relative to that of the exact readings."""
    flat = np.ones(elements)
    first, (_, found) = seconds(taken, tool, flat)
    error = float(np.linalg.norm(found - case.exact) / np.linalg.norm(case.exact))
    labels = {"sheet": case.name} | labels | {"relative_error": error, "first_call_s": round(first, 3)}
    print(cell("{sheet}, {tool}, {mesh}, P{order}, {dtype}, {unknowns:,} unknowns: {relative_error:.3g %}", labels))
    return Solve(labels, tool, flat)


def ours(case: Case, model: je.Model, mesh: str, order: int, dtype: str, **size: float) -> Solve:
    labels = {"tool": "jaxeit", "mesh": mesh, "order": order, "dtype": dtype} | size
    sizes = {"nodes": len(model.nodes), "unknowns": model.system.unknowns}
    return with_error(case, labels | sizes, forward_of(model, dtype), len(model.areas))


def graded(case: Case, order: int, edge: float, growth: float, dtype: str = "float64") -> Solve:
    """On our own mesh."""
    fidelity = je.Fidelity(edge, order, dtype, growth=growth, solver=NestedDissection())
    model = je.discretise(je.Scene(case.skin), fidelity)
    return ours(case, model, f"growth {growth}", order, dtype, edge_length=edge)


def regular(case: Case, order: int, cells: int, dtype: str = "float64") -> Solve:
    """On the mesh of the other benchmarks, as many triangles everywhere."""
    return ours(case, Problem(cells).model(dtype, order), "regular", order, dtype, cells=cells)


def peers(case: Case, several: Sequence[tuple[Entry, int, tuple[int, ...]]]) -> Iterator[Solve]:
    """Those that are installed, at each of their sizes."""
    for entry, order, sizes in several:
        for cells in sizes if present([entry], sizes[0]) else ():
            problem = Problem(cells)
            labels = {"tool": entry.name, "mesh": "regular", "order": order, "dtype": "float64", "cells": cells}
            labels |= {"nodes": (cells + 1) ** 2, "unknowns": (order * cells + 1) ** 2 - 1}
            yield with_error(case, labels, entry.prepare(problem), len(problem.sigma))


def with_precision(sizes: Sequence[Any]) -> list[tuple[Any, str]]:
    """All in float64, every second one in float32 too, the finest among them: each is a program to compile."""
    single = sizes[(len(sizes) - 1) % 2 :: 2]
    return [(size, "float64") for size in sizes] + [(size, "float32") for size in single]


def on_sheet(case: Case, smoke: bool) -> Iterator[Solve]:
    """Peers and regular meshes on the rectangle; graded meshes on both, those of an order and precision a curve."""
    if case.name == "rectangle" and not smoke:
        yield from peers(case, PEERS)
        for order, sizes in CELLS.items():
            yield from (regular(case, order, cells, dtype) for cells, dtype in with_precision(sizes))
    edges: dict[int, tuple[float, ...]] = {2: (0.2,)} if smoke else EDGES
    for growth in GRADINGS[-1:] if smoke else GRADINGS:
        for order, lengths in edges.items():
            yield from (graded(case, order, edge, growth, dtype) for edge, dtype in with_precision(lengths))


def timed(solves: Sequence[Solve], repeats: int, budget: float) -> list[Row]:
    """The labels of each with its times."""
    times = interleaved([Call(solve.tool, solve.flat) for solve in solves], repeats, budget)
    return [solve.labels | spread(own) for solve, (own, _) in zip(solves, times, strict=True)]


def measure(run: Run) -> Iterator[Row]:
    """Error and time of everything on the rectangle, then of everything on the disc."""
    for case in (rectangle(), disc()):
        yield {"rows": timed(list(on_sheet(case, run.smoke)), 2 if run.smoke else 15, budget=4.0)}


# --- the picture

COLOURS, ORDERS = {1: ORANGE, 2: BLUE}, {1: "P1, linear", 2: "P2, quadratic"}
STYLES: dict[str, Any] = {"float64": "-", "float32": (0, (3, 2))}
MARKERS = dict(zip(("regular", *(f"growth {g}" for g in GRADINGS)), "Do^s", strict=True))
EIDORS: Row = {"color": "#7b3fa0", "marker": "*", "markersize": 10, "linestyle": "none"}
TARGET_LINE: Row = {"color": GREY, "linewidth": 0.9, "linestyle": ":"}
CHOLMOD_LINE: Row = {"color": GREY, "linewidth": 1.2, "linestyle": "-."}
TITLES = {
    "rectangle": "Rectangle, 25 point electrodes",
    "disc": f"Disc, {ELECTRODES} electrodes on the rim, contact z = {CONTACT}",
}


def picture(data: Row) -> Figure:
    """A panel per sheet, error against time; a curve per order, precision and grading."""
    figure, axes = panels(10.4, 6.0, 1, 2, sharey=True)
    rows = grouped((row | {"percent": 100 * row["relative_error"]} for row in data["rows"]), "sheet", "tool")
    for panel, (sheet, title) in zip(axes, TITLES.items(), strict=True):
        logarithmic(panel, title, 10.5, "major", xlabel="time of one forward solve, ms")
        panel.axhline(100 * TARGET, **TARGET_LINE)
        curves(panel, rows[sheet, "jaxeit"], "median_ms", "percent", ("mesh", "order", "dtype"), _look)
        for row in rows.get((sheet, cholmod.NAME), ()):
            panel.axvline(row["median_ms"], **CHOLMOD_LINE)
        curves(panel, rows.get((sheet, eidors.NAME), ()), "median_ms", "percent", ("tool",), lambda tool: EIDORS)
    axes[0].set_ylabel("error of the readings, rms, % of their rms")
    legend(figure, _entries(rows), 6)
    return figure


def _look(mesh: str, order: int, dtype: str) -> Row:
    look = {"color": COLOURS[order], "linestyle": STYLES[dtype], "marker": MARKERS[mesh], "linewidth": 1.3}
    return look | {"markersize": 5.5, "markerfacecolor": COLOURS[order] if dtype == "float64" else "white"}


def _entries(rows: dict[tuple[str, str], list[Row]]) -> Iterator[Row]:
    """One for each colour, style, marker and reference; in columns of two."""
    for order, name in ORDERS.items():
        yield {"color": COLOURS[order], "linewidth": 3, "label": name}
    for dtype, style in STYLES.items():
        face = GREY if dtype == "float64" else "white"
        yield {"linestyle": style, "label": dtype, "marker": "o", "markerfacecolor": face, "markersize": 5.5}
    for mesh, marker in MARKERS.items():
        label = "regular mesh" if mesh == "regular" else f"graded, {mesh}"
        yield {"marker": marker, "linestyle": "none", "label": label}
    yield TARGET_LINE | {"label": f"{100 * TARGET:.3g} %"}
    for row in rows.get(("rectangle", cholmod.NAME), ()):
        yield CHOLMOD_LINE | {"label": f"CHOLMOD's time,\nP1, {row['nodes']:,} nodes"}
    if ("rectangle", eidors.NAME) in rows:
        yield EIDORS | {"label": "EIDORS, P2, regular"}


main = Question("accuracy", __doc__, {"rows": measure}, picture=picture, file="accuracy.png")

if __name__ == "__main__":
    main()
