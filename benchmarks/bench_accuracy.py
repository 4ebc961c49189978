"""Error against time: linear and quadratic elements, both precisions, three gradings of the mesh, on two sheets.

The error is the root mean square over the readings of the even sheet, relative to that of the exact ones: Green's
function of the rectangle, a series for the disc.  For 1, 0.1 and 0.02 % the fastest mesh of each tool and element order
that reaches it; ours also has meshes that are graded towards the electrodes, as those of every user are.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

import jaxeit as je
from jaxeit.linalg import NestedDissection

from .clock import Tool, interleaved, seconds, spread, taken
from .figures import BLUE, GREY, ORANGE, curves, legend, logarithmic, panels
from .harness import Question, Run
from .markdown import cell
from .peers import cholmod, eidors, pyeit, superlu
from .problems import CONTACT, ELECTRODES, Case, Problem, disc, rectangle
from .rows import Row, grouped
from .tools import Entry, forward_of, present

TARGETS = (1e-2, 1e-3, 2e-4)
GRADINGS = (1.2, 1.4, 1.7)
EDGES = {1: (0.15, 0.05, 0.015), 2: (0.25, 0.12, 0.06, 0.05, 0.025)}  # by order; in sqrt(sheet area)
CELLS = {1: (10, 30, 60, 120, 240), 2: (10, 20, 30, 60, 120)}  # by order; regular meshes, cells a side
PEERS: tuple[tuple[Entry, int, tuple[int, ...]], ...] = (  # order, and cells a side; of more they take too long
    (Entry(cholmod.NAME, cholmod.prepare, cholmod), 1, CELLS[1]),
    (Entry(superlu.NAME, superlu.prepare, superlu), 1, CELLS[1]),
    (Entry(f"{eidors.NAME} first order", eidors.Eidors, eidors), 1, CELLS[1]),
    (Entry(f"{eidors.NAME} second order", partial(eidors.Eidors, order=2), eidors), 2, (10, 20, 30, 60)),
    (Entry(pyeit.NAME, pyeit.prepare, pyeit), 1, (10, 30, 60, 120)),
)
REFERENCE = (cholmod.NAME, 3721)  # whose time with linear elements the picture shows


class Solve(NamedTuple):
    """A tool at work on unit conductivity, how far it is off there, and what to call it."""

    labels: Row
    tool: Tool
    flat: np.ndarray


def with_error(case: Case, labels: Row, tool: Tool, elements: int) -> Solve:
    """The tool's first call, and its error."""
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


def graded(case: Case, order: int, growth: float, edge: float, dtype: str) -> Solve:
    """On our own mesh."""
    fidelity = je.Fidelity(edge, order, dtype, growth=growth, solver=NestedDissection())
    model = je.discretise(je.Scene(case.skin), fidelity)
    return ours(case, model, f"growth {growth}", order, dtype, edge_length=edge)


def regular(case: Case, order: int, cells: int, dtype: str) -> Solve:
    """On the mesh of the other benchmarks, as many triangles everywhere."""
    return ours(case, Problem(cells).model(dtype, order), "regular", order, dtype, cells=cells)


def by_peer(case: Case, entry: Entry, order: int, cells: int) -> Solve:
    problem = Problem(cells)
    labels = {"tool": entry.name, "mesh": "regular", "order": order, "dtype": "float64", "cells": cells}
    labels |= {"nodes": (cells + 1) ** 2, "unknowns": (order * cells + 1) ** 2 - 1}
    return with_error(case, labels, entry.prepare(problem), len(problem.sigma))


def with_precision(sizes: Sequence[Any]) -> list[tuple[Any, str]]:
    """All in float64, every second one in float32 too, the finest among them: each is a program to compile."""
    single = sizes[(len(sizes) - 1) % 2 :: 2]
    return [(size, "float64") for size in sizes] + [(size, "float32") for size in single]


def on_sheet(case: Case, smoke: bool) -> Iterator[Solve]:
    """Peers and regular meshes on the rectangle; graded meshes on both."""
    if case.name == "rectangle":
        for entry, order, sizes in PEERS:
            found = sizes if present([entry], sizes[0]) else ()
            yield from (by_peer(case, entry, order, cells) for cells in found[: 1 if smoke else None])
        for order, sizes in ({2: (10, 20)} if smoke else CELLS).items():
            yield from (regular(case, order, cells, dtype) for cells, dtype in with_precision(sizes))
    edges: dict[int, tuple[float, ...]] = {2: (0.2,)} if smoke else EDGES
    for growth in GRADINGS[-1:] if smoke else GRADINGS:
        for order, lengths in edges.items():
            yield from (graded(case, order, growth, edge, dtype) for edge, dtype in with_precision(lengths))


def measure(run: Run) -> Iterator[Row]:
    """Error and time of everything on the rectangle, then of everything on the disc."""
    for case in (rectangle(), disc()):
        solves = list(on_sheet(case, run.smoke))
        turns = interleaved([(one.tool, one.flat) for one in solves], 2 if run.smoke else 15, budget=4.0)
        rows = [one.labels | spread([turn.last for turn in own]) for one, own in zip(solves, turns, strict=True)]
        yield {"rows": rows} | ({"to_accuracy": to_accuracy(rows)} if case.name == "rectangle" else {})


def kind(row: Row) -> str:
    """The tool; of ours also the element order, and whether the mesh is graded."""
    if row["tool"] != "jaxeit":
        return row["tool"]
    return f"jaxeit P{row['order']}, {'regular' if row['mesh'] == 'regular' else 'graded'}"


def to_accuracy(rows: Sequence[Row]) -> list[Row]:
    """For each kind and target the fastest row in float64 that reaches it; None where no mesh does."""
    double = [row | {"kind": kind(row)} for row in rows if row["dtype"] == "float64"]
    out = []
    for name, mine in grouped(double, "kind").items():
        for target in TARGETS:
            good = [row for row in mine if row["relative_error"] <= target]
            best = min(good, key=lambda row: row["median_ms"], default=None)
            out.append({"kind": name, "target": target, "best": best})
    return out


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
    rows = [row | {"percent": 100 * row["relative_error"]} for row in data["rows"]]
    for panel, (sheet, title) in zip(axes, TITLES.items(), strict=True):
        mine = [row for row in rows if row["sheet"] == sheet]
        quadratic = [row for row in mine if eidors.NAME in row["tool"] and row["order"] == 2]
        logarithmic(panel, title, 10.5, "major", xlabel="time of one forward solve, ms")
        panel.axhline(100 * TARGETS[-1], **TARGET_LINE)
        ours = [row for row in mine if row["tool"] == "jaxeit"]
        curves(panel, ours, "median_ms", "percent", ("mesh", "order", "dtype"), _look)
        for row in mine:
            if (row["tool"], row["nodes"]) == REFERENCE:
                panel.axvline(row["median_ms"], **CHOLMOD_LINE)
        curves(panel, quadratic, "median_ms", "percent", ("tool",), lambda tool: EIDORS)
    axes[0].set_ylabel("error of the readings, rms, % of their rms")
    legend(figure, _entries({row["tool"].split(" ")[0] for row in rows}), 6)
    return figure


def _look(mesh: str, order: int, dtype: str) -> Row:
    look = {"color": COLOURS[order], "linestyle": STYLES[dtype], "marker": MARKERS[mesh], "linewidth": 1.3}
    return look | {"markersize": 5.5, "markerfacecolor": COLOURS[order] if dtype == "float64" else "white"}


def _entries(tools: set[str]) -> Iterator[Row]:
    """One for each colour, style, marker and reference; in columns of two."""
    for order, name in ORDERS.items():
        yield {"color": COLOURS[order], "linewidth": 3, "label": name}
    for dtype, style in STYLES.items():
        face = GREY if dtype == "float64" else "white"
        yield {"linestyle": style, "label": dtype, "marker": "o", "markerfacecolor": face, "markersize": 5.5}
    for mesh, marker in MARKERS.items():
        label = "regular mesh" if mesh == "regular" else f"graded, {mesh}"
        yield {"marker": marker, "linestyle": "none", "label": label}
    yield TARGET_LINE | {"label": f"{100 * TARGETS[-1]:.3g} %"}
    if "CHOLMOD" in tools:
        yield CHOLMOD_LINE | {"label": f"CHOLMOD's time,\nP1, {REFERENCE[1]:,} nodes"}
    if eidors.NAME in tools:
        yield EIDORS | {"label": "EIDORS, P2, regular"}


main = Question("accuracy", __doc__, {"rows": measure}, picture=picture, file="accuracy.png")

if __name__ == "__main__":
    main()
