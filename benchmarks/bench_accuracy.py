"""Error against time: linear and quadratic elements, both precisions, three gradings of the mesh, on two sheets.

python -m benchmarks.bench_accuracy [--smoke | --draw-only]
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

import jaxeit as je
from calib.figures import plain_numbers, write_figure
from jaxeit.solvers import NestedDissection
from tests.oracles.disc import disc_potentials
from tests.oracles.rectangle import green

from . import _common as c
from .peers import cholmod, eidors

PICTURE = c.ROOT / "docs" / "accuracy.png"
GRADINGS = (1.2, 1.4, 1.7)
EDGES = {1: (0.15, 0.05, 0.015), 2: (0.12, 0.06, 0.025)}  # by order; in sqrt(sheet area)
CELLS = {1: (30, 60, 120, 240), 2: (10, 30, 60, 120)}  # by order; regular meshes, cells a side
CHOLMOD_CELLS = 60  # 3,721 nodes
EIDORS_CELLS = (10, 30, 60)  # more takes too long: it assembles in a loop over elements, in Octave
FULL: tuple = (EDGES, GRADINGS, CELLS, EIDORS_CELLS, 15)  # what `measure` is given
SMOKE: tuple = ({2: (0.2,)}, (1.7,), {}, (), 2)
TARGET = 2e-4
CONTACT, ELECTRODES = 0.1, 16

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Case:
    """A skin of unit conductivity whose readings (readings,) in V are known."""

    name: str
    skin: je.Skin
    exact: np.ndarray


@dataclass(frozen=True, eq=False)
class Run:
    """A tool at work on unit conductivity, how far it is off there, and what to call it."""

    labels: Row
    tool: c.Tool
    flat: np.ndarray
    error: float


def rectangle() -> Case:
    problem = c.Problem(10)
    electrodes = tuple(je.PointElectrode(tuple(p)) for p in problem.points.tolist())
    protocol = je.Protocol(problem.pattern, 1.0)
    skin = je.Skin("bench", je.Rectangle(c.SIDE, c.SIDE), 1.0, electrodes, protocol, ())
    return Case("rectangle", skin, exact(problem))


def disc() -> Case:
    """The unit disc, half its rim covered by complete electrodes, adjacent drives and senses."""
    width = np.pi / ELECTRODES
    starts = (2 * width * np.arange(ELECTRODES) - width / 2) % (2 * np.pi)
    electrodes = tuple(je.BoundaryPatch(float(s), float(s + width), CONTACT) for s in starts)
    pattern = je.adjacent(ELECTRODES)
    skin = je.Skin("bench", je.Disc(1.0), 1.0, electrodes, je.Protocol(pattern, 1.0), ())
    return Case("disc", skin, exact_disc(pattern))


def exact(problem: c.Problem) -> np.ndarray:
    """Voltages of the homogeneous square; along the axis in which two points lie farther apart."""
    source, sink, plus, minus = problem.pattern.T
    z = np.zeros((25, 25))
    for i, j in zip(*np.triu_indices(25, 1), strict=True):
        a, b = problem.points[i], problem.points[j]
        flip = slice(None, None, -1 if abs(a - b)[0] > abs(a - b)[1] else 1)
        z[i, j] = z[j, i] = green(c.SIDE, c.SIDE, a[flip], b[flip])
    return z[plus, source] - z[minus, source] - z[plus, sink] + z[minus, sink]


def exact_disc(pattern: np.ndarray) -> np.ndarray:
    """Voltages of the homogeneous disc for adjacent drives, which are rotations of one; good to 1e-7."""
    first = disc_potentials(CONTACT, ELECTRODES)
    by_drive = np.stack([np.roll(first, turn) for turn in range(ELECTRODES)])
    source, _, plus, minus = pattern.T
    return by_drive[source, plus] - by_drive[source, minus]


def with_error(labels: Row, tool: c.Tool, elements: int, want: np.ndarray) -> Run:
    """The tool's first call, and its root mean square error relative to that of the exact readings."""
    flat = np.ones(elements)
    first, (_, found) = c.seconds(c.taken, tool, flat)
    error = float(np.linalg.norm(found - want) / np.linalg.norm(want))
    return Run(labels | {"relative_error": error, "first_call_s": round(first, 3)}, tool, flat, error)


def ours(case: Case, model: je.Model, labels: Row) -> Run:
    tool = c.as_tool(c.compiled(je.forward, model, options=je.compiler_options()), labels["dtype"])
    sizes = {"nodes": len(model.nodes), "unknowns": model.system.unknowns}
    return with_error({"sheet": case.name, "tool": "jaxeit"} | labels | sizes, tool, len(model.areas), case.exact)


def with_precision(sizes: Sequence[Any]) -> list[tuple[Any, str]]:
    """All in float64, every second one in float32 too, the finest among them: each is a program to compile."""
    single = sizes[(len(sizes) - 1) % 2 :: 2]
    return [(size, "float64") for size in sizes] + [(size, "float32") for size in single]


def graded(case: Case, edges: Mapping[int, Sequence[float]], gradings: Sequence[float]) -> Iterator[Run]:
    """Our own meshes; those of one order, grading and precision are a curve."""
    for growth in gradings:
        for order, lengths in edges.items():
            for edge, dtype in with_precision(lengths):
                fidelity = je.Fidelity(edge, order, dtype, growth=growth, solver=NestedDissection())
                labels = {"mesh": f"growth {growth}", "order": order, "dtype": dtype, "edge_length": edge}
                yield ours(case, je.discretise(je.Scene(case.skin), fidelity), labels)


def regular(case: Case, cells: Mapping[int, Sequence[int]]) -> Iterator[Run]:
    """The meshes of the other benchmarks, as many triangles everywhere."""
    for order, several in cells.items():
        for side, dtype in with_precision(several):
            labels = {"mesh": "regular", "order": order, "dtype": dtype, "cells": side}
            yield ours(case, c.Problem(side).model(dtype, order), labels)


def peers(case: Case, eidors_cells: Sequence[int]) -> Iterator[Run]:
    """CHOLMOD by hand (linear) and EIDORS (quadratic) on regular meshes, where they are installed."""
    if cholmod.missing():
        print(f"{cholmod.NAME} left out: {cholmod.missing()}")
    else:
        yield peer(case, cholmod.NAME, cholmod.prepare, 1, CHOLMOD_CELLS)
    if eidors.missing():
        print(f"{eidors.NAME} left out: {eidors.missing()}")
        return
    for cells in eidors_cells:
        yield peer(case, eidors.NAME, eidors.prepare_quadratic, 2, cells)


def peer(case: Case, name: str, prepare: Any, order: int, cells: int) -> Run:
    problem = c.Problem(cells)
    labels = {"sheet": case.name, "tool": name, "mesh": "regular", "order": order, "dtype": "float64", "cells": cells}
    sizes = {"nodes": (cells + 1) ** 2, "unknowns": (order * cells + 1) ** 2 - 1}
    return with_error(labels | sizes, prepare(problem), len(problem.sigma), case.exact)


def timed(runs: Sequence[Run], repeats: int, budget: float) -> list[Row]:
    """What each is called, with its times."""
    times = c.interleaved([c.Call(run.tool, run.flat) for run in runs], repeats, budget)
    return [run.labels | c.spread(own) for run, (own, _) in zip(runs, times, strict=True)]


def prepared(runs: Iterator[Run]) -> list[Run]:
    """One after the other, and says which is ready."""
    done = []
    for run in runs:
        label = f"{run.labels['sheet']}, {run.labels['tool']}, {run.labels['mesh']}, P{run.labels['order']}"
        print(f"{label}, {run.labels['dtype']}, {run.labels['unknowns']:,} unknowns: {_percent(run.error)}", flush=True)
        done.append(run)
    return done


def measure(
    edges: Mapping[int, Sequence[float]],
    gradings: Sequence[float],
    cells: Mapping[int, Sequence[int]],
    eidors_cells: Sequence[int],
    repeats: int,
) -> list[Row]:
    """Error and time of everything on the rectangle, then of everything on the disc."""
    square, circle = rectangle(), disc()
    several = [[peers(square, eidors_cells), regular(square, cells), graded(square, edges, gradings)]]
    several.append([graded(circle, edges, gradings)])
    rows: list[Row] = []
    for kinds in several:
        rows += timed([run for kind in kinds for run in prepared(kind)], repeats, budget=4.0)
    return rows


def table(rows: list[Row]) -> str:
    lines = ["| sheet | tool | mesh | element | precision | unknowns | error | ms |", "|---" * 8 + "|"]
    lines += [
        f"| {r['sheet']} | {r['tool']} | {r['mesh']} | P{r['order']} | {r['dtype']} | {r['unknowns']:,} "
        f"| {_percent(r['relative_error'])} | {c.cell(r)} |"
        for r in rows
    ]
    return "\n".join(lines)


def _percent(error: float) -> str:
    return f"{100 * error:.3g} %"


def verdict(rows: list[Row]) -> str:
    """The quickest way to the target on the rectangle, against the time of CHOLMOD's one point."""
    good = [r for r in _of(rows, "rectangle", "jaxeit") if r["relative_error"] <= TARGET]
    if not good:
        return f"Nothing reaches {_percent(TARGET)} on the rectangle."
    best = min(good, key=lambda r: r["median_ms"])
    size = f"mesh {best['mesh']}, {best['unknowns']:,} unknowns, {_percent(best['relative_error'])}"
    return (
        f"Quickest of these ways to {_percent(TARGET)} on the rectangle: P{best['order']} {best['dtype']}, {size}, "
        f"{best['median_ms']:.3g} ms{_against(rows)}."
    )


def _against(rows: list[Row]) -> str:
    linear = _of(rows, "rectangle", cholmod.NAME)
    times = [f"{r['tool']} takes {r['median_ms']:.3g} ms for P1 with {r['nodes']:,} nodes" for r in linear]
    errors = [_percent(r["relative_error"]) for r in linear]
    return "".join(f"; {said} ({error})" for said, error in zip(times, errors, strict=True))


def _of(rows: list[Row], sheet: str, tool: str) -> list[Row]:
    return [r for r in rows if (r["sheet"], r["tool"]) == (sheet, tool)]


COLOURS: dict[int, str] = {1: "#d9730d", 2: "#1f5fa8"}
STYLES: dict[str, Any] = {"float64": "-", "float32": (0, (3, 2))}
MARKERS = dict(zip(("regular", *(f"growth {g}" for g in GRADINGS)), "Do^s", strict=True))
GREY = "#555555"
TITLES = {
    "rectangle": "Rectangle, 25 point electrodes",
    "disc": f"Disc, {ELECTRODES} electrodes on the rim, contact z = {CONTACT}",
}


def picture(rows: list[Row]) -> Figure:
    """A panel per sheet, error against time; a curve per order, precision and grading."""
    figure = Figure(figsize=(10.4, 6.0), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    for axes, sheet in zip(figure.subplots(1, 2, sharey=True), TITLES, strict=True):
        _panel(axes, rows, sheet)
    figure.axes[0].set_ylabel("error of the readings, rms, % of their rms")
    figure.legend(handles=_legend(rows), loc="outside lower center", ncols=6, fontsize=8.5, frameon=False)
    return figure


def _panel(axes: Any, rows: list[Row], sheet: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel="time of one forward solve, ms")
    axes.set_title(TITLES[sheet], fontsize=10.5)
    plain_numbers(axes)
    axes.grid(True, which="major", color="#e4e4e4", linewidth=0.8)
    axes.axhline(100 * TARGET, color=GREY, linewidth=0.9, linestyle=":")
    for (mesh, order, dtype), curve in _curves(_of(rows, sheet, "jaxeit")).items():
        look: Row = {"color": COLOURS[order], "linestyle": STYLES[dtype], "marker": MARKERS[mesh]}
        face = COLOURS[order] if dtype == "float64" else "white"
        axes.plot(*_points(curve), **look, linewidth=1.3, markersize=5.5, markerfacecolor=face)
    for row in _of(rows, sheet, cholmod.NAME):
        axes.axvline(row["median_ms"], color=GREY, linewidth=1.2, linestyle="-.")
    axes.plot(*_points(_of(rows, sheet, eidors.NAME)), **_EIDORS)


_EIDORS: dict[str, Any] = {"color": "#7b3fa0", "marker": "*", "markersize": 10, "linestyle": "none"}


def _curves(rows: list[Row]) -> dict[tuple, list[Row]]:
    keys = dict.fromkeys((r["mesh"], r["order"], r["dtype"]) for r in rows)
    return {key: [r for r in rows if (r["mesh"], r["order"], r["dtype"]) == key] for key in keys}


def _points(rows: list[Row]) -> tuple[list[float], list[float]]:
    return [r["median_ms"] for r in rows], [100 * r["relative_error"] for r in rows]


def _legend(rows: list[Row]) -> list[Line2D]:
    """One entry per colour, style, marker and reference; in columns of two."""
    names = {1: "P1, linear", 2: "P2, quadratic"}
    entries = [Line2D([], [], color=COLOURS[order], linewidth=3, label=name) for order, name in names.items()]
    for dtype, style in STYLES.items():
        face = GREY if dtype == "float64" else "white"
        look: Row = {"marker": "o", "markerfacecolor": face, "markersize": 5.5}
        entries.append(Line2D([], [], color=GREY, linestyle=style, label=dtype, **look))
    for mesh, marker in MARKERS.items():
        label = "regular mesh" if mesh == "regular" else f"graded, {mesh}"
        entries.append(Line2D([], [], color=GREY, marker=marker, linestyle="none", label=label))
    entries.append(Line2D([], [], color=GREY, linewidth=0.9, linestyle=":", label=_percent(TARGET)))
    for row in _of(rows, "rectangle", cholmod.NAME):
        label = f"CHOLMOD's time,\nP1, {row['nodes']:,} nodes"
        entries.append(Line2D([], [], color=GREY, linewidth=1.2, linestyle="-.", label=label))
    if _of(rows, "rectangle", eidors.NAME):
        entries.append(Line2D([], [], **_EIDORS, label="EIDORS, P2, regular"))
    return entries


def main(argv: list[str] | None = None) -> Row:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="a few small models, few repeats, nothing written")
    parser.add_argument("--draw-only", action="store_true", help="draw the stored results again")
    args = parser.parse_args(argv)
    c.set_up()
    if args.draw_only:
        write_figure(picture(c.stored("accuracy")["rows"]), PICTURE)
        return {}
    data: Row = {"circumstances": c.circumstances()}
    data["rows"] = rows = measure(*(SMOKE if args.smoke else FULL))
    print(table(rows), verdict(rows), sep="\n\n", flush=True)
    if not args.smoke:
        c.write("accuracy", c.closed(data))
        write_figure(picture(rows), PICTURE)
    return data


if __name__ == "__main__":
    main(sys.argv[1:])
