"""Pictures of docs/costs.md that summarise its tables; `benchmarks.readme` draws them from the results."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calib.report.figures.parts import write_figure

from .figures import BLUE, GREY, ORANGE, legend, logarithmic, panels
from .harness import ROOT
from .markdown import cell
from .rows import Row, grouped

STAGES = {"reading": GREY, "model and images": BLUE, "fitting": ORANGE, "holding out": "#8a9a5b"}
FIRST = ("import numpy", "import jax", "first use", "README")


def to_accuracy(results: Row) -> Figure:
    """Time of a forward solution by tool, one panel for each accuracy."""
    rows = results["accuracy"]["to_accuracy"]
    targets, kinds = (list(dict.fromkeys(row[key] for row in rows)) for key in ("target", "kind"))
    figure, axes = panels(9, 3.4, 1, len(targets), sharex=True, sharey=True)
    best = {(row["kind"], row["target"]): row["best"] for row in rows if row["best"]}
    for panel, target in zip(axes, targets, strict=True):
        values = [best[kind, target]["median_ms"] if (kind, target) in best else np.nan for kind in kinds]
        _bars(panel, kinds, values, [BLUE if kind.startswith("jaxeit") else GREY for kind in kinds], "{value:ms}")
        panel.set(xscale="log", title=f"to {100 * target:g} %", xlabel="forward solution, ms", xlim=(0.1, 20_000))
    return figure


def frames(results: Row) -> Figure:
    """Median and 99th percentile of a frame's image, by the way it is called."""
    application = results["inverse"]["application"]
    after = {row["way"]: row for row in application["single, after other work"]}
    rows = [row for row in application["single"] if row["way"].endswith("float64")]
    names = [row["way"].removesuffix(", float64") for row in rows]
    figure, (axes,) = panels(9, 3.6, 1, 1)
    for place, row in enumerate(rows):
        for shift, times, colour in ((-0.17, row, BLUE), (0.17, after.get(row["way"], {}), ORANGE)):
            if "p50_ms" in times:
                axes.plot([times["p50_ms"], times["p99_ms"]], [place + shift] * 2, color=colour, linewidth=2)
                axes.plot(times["p50_ms"], place + shift, "o", color=colour, markersize=4)
    _named(axes, names)
    axes.set(xscale="log", xlabel="ms from the readings of a frame to its image: median (dot) to 99th percentile")
    looks = {"frame after frame": BLUE, "after other work": ORANGE}
    legend(figure, [{"label": label, "color": colour, "marker": "o"} for label, colour in looks.items()], 2)
    return figure


def growth(results: Row) -> Figure:
    """Time of forward solution and Jacobian against nodes, and against electrodes."""
    figure, axes = panels(9, 3.2, 1, 2, sharey=True)
    rows = results["growth"]["rows"]
    for panel, of in zip(axes, ("nodes", "electrodes"), strict=True):
        for series, colour in (("forward", BLUE), ("Jacobian", ORANGE)):
            mine = [row for row in rows if (row["series"], row["of"]) == (series, of)]
            panel.plot([r["size"] for r in mine], [r["median_ms"] for r in mine], "o-", color=colour, label=series)
        logarithmic(panel, f"by {of}", xlabel=of, ylabel="ms" if of == "nodes" else "")
    axes[0].legend(frameon=False, fontsize=8)
    return figure


def start(results: Row) -> Figure:
    """From the start of a process to what a user does first."""
    rows = [row for row in results["start"]["rows"] if any(name in row["start"] for name in FIRST)]
    figure, (axes,) = panels(9, 2.2, 1, 1)
    _bars(axes, [r["start"] for r in rows], [r["median_ms"] / 1e3 for r in rows], BLUE, "{value:.1f}")
    axes.set(xlabel="s after the start of the process")
    return figure


def gpu(results: Row) -> Figure:
    """The most forward solutions a second on a GPU, by tool, size and precision."""
    rows = [row for row in results["gpu"]["batches"] + results["gpu"]["peers"] if row["what"] == "forward"]
    best = grouped([{"tool": "jaxeit"} | row for row in rows], "tool", "nodes", "dtype")
    figure, axes = panels(9, 2.8, 1, 2, sharex=True, sharey=True)
    for panel, dtype in zip(axes, ("float32", "float64"), strict=True):
        mine = {key: max(row["per_s"] for row in several) for key, several in best.items() if key[2] == dtype}
        order = sorted(mine, key=lambda key: (key[1], -mine[key]))
        names = [f"{tool}, {nodes:,} nodes" for tool, nodes, _ in order]
        colours = [BLUE if tool == "jaxeit" else GREY for tool, *_ in order]
        _bars(panel, names, [mine[key] for key in order], colours, "{value:,.0f}")
        panel.set(xscale="log", title=dtype, xlabel="forward solutions a second", xlim=(1e3, 5e6))
    return figure


def calibration(results: Row) -> Figure:
    """Where the time of a calibration goes: first call of a process, and later ones."""
    rows = [row for row in results["fit"]["end_to_end"] if row["call"] != "second"]
    names = [f"{r['session']}, {'for the place' if r['location'] == 'yes' else 'no place'}, {r['call']}" for r in rows]
    figure, (axes,) = panels(9, 2.8, 1, 1)
    done = np.zeros(len(rows))
    for stage, colour in STAGES.items():
        each = np.array([row[stage] for row in rows])
        axes.barh(np.arange(len(rows)), each, left=done, color=colour, label=stage, height=0.7)
        done += each
    _named(axes, names)
    axes.set(xlabel="s")
    axes.legend(frameon=False, fontsize=8)
    return figure


def effects(results: Row) -> Figure:
    """What the shipped scenes, and a scene of all effects, cost a frame."""
    rows = [r for r in results["scene"]["rows"] if r["effects"].startswith(("scene ", "none")) or "all" in r["effects"]]
    names = [row["effects"].removeprefix("scene ").replace("+ DropOut: all 33", "all 33 effects") for row in rows]
    figure, axes = panels(9, 2.6, 1, 2, sharey=True)
    sheet, readout = ([row[f"{part}_ms"] for row in rows] for part in ("frame", "block"))
    _bars(axes[0], names, sheet, BLUE, "{value:.1f}")
    _bars(axes[1], names, np.array(readout) / 1.024, ORANGE, "{value:.1f}")
    axes[0].set(title="one solved frame", xlabel="ms")
    axes[1].set(title="histories and readout", xlabel="µs a frame")
    return figure


PICTURES = {
    "to-accuracy": to_accuracy,
    "frame-times": frames,
    "growth": growth,
    "first-result": start,
    "gpu-batches": gpu,
    "calibration-seconds": calibration,
    "effects-cost": effects,
}


def _bars(axes: Any, names: Sequence[str], values: Any, colour: Any, shown: str) -> None:
    axes.barh(np.arange(len(names)), np.nan_to_num(values), color=colour, height=0.7)
    for place, value in enumerate(values):
        text = cell(shown, {"value": value}) if np.isfinite(value) else "not reached"
        axes.annotate(text, (np.nan_to_num(value, nan=axes.get_xlim()[0]), place), (3, 0), textcoords="offset points",
                      va="center", fontsize=7, annotation_clip=False)  # fmt: skip
    _named(axes, names)


def _named(axes: Any, names: Sequence[str]) -> None:
    """Names beside horizontal lines, the first on top."""
    axes.set_yticks(np.arange(len(names)), names, fontsize=8)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.spines[["top", "right"]].set_visible(False)


def draw(results: Row) -> None:
    """Write all pictures into docs/."""
    for name, picture in PICTURES.items():
        write_figure(picture(results), ROOT / "docs" / f"{name}.png")
