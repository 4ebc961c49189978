"""The tables of the pages, written from the results as tables.toml says; and what a run prints of its section."""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import reduce
from pathlib import Path

import numpy as np

from calib.calibration.localisation.press_images import REPORTED_ESTIMATORS

from .markdown import all_columns, cell, crossed, markdown, plain, replaced
from .repeat import compared
from .rows import Row, averaged, grouped
from .tools import CONTACTS

FORMATS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def report(section: str, data: Row) -> str:
    """All rows of a section, then the tables that are made of it alone and whose parts are measured."""
    parts = list(_every(data))
    for mark in FORMATS:
        with suppress(LookupError):
            parts += [table(mark, data)] if sections(mark) == [section] else []
    return "\n".join(parts)


def _every(data: Row, path: str = "") -> Iterator[str]:
    for name, value in data.items():
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield f"{path}{name}\n\n{all_columns(value)}"
        elif isinstance(value, Mapping) and all(isinstance(one, list) for one in value.values()):
            yield from _every(value, f"{path}{name}, ")
        elif name != "circumstances":
            yield f"{path}{name}: {plain(value)}\n"


def filled(page: str, measured: Row) -> str:
    """A page with the tables between its marks written anew; those whose benchmark has not run stay as they are."""
    for mark in FORMATS:
        names = sections(mark)
        if f"<!-- {mark}:" in page and names and all(name in measured for name in names):
            page = replaced(page, mark, table(mark, *(measured[name] for name in names)))
    return page


def sections(mark: str) -> list[str]:
    """Of the results, of which a table is made."""
    return FORMATS[mark].get("sections", [])


def table(mark: str, *results: Row) -> str:
    """The table of a mark from its sections of the results."""
    how = FORMATS[mark]
    found = ROWS[how["rows"]](*results) if how["rows"] in ROWS else _at(results[0], how["rows"])
    if isinstance(found, str):
        return found
    if "crossed" in how:
        return crossed(*how["crossed"], list(found), how.get("missing", ""))
    return markdown(how["heads"].split(" | "), ([cell(c, row) for c in how["cells"].split(" | ")] for row in found))


def _at(results: Row, path: str) -> Sequence[Row]:
    return reduce(lambda part, key: part[key], path.split("."), results)


# --- rows that are not those of a section


def _evaluation(summary: Row) -> Iterator[Row]:
    for what, template, paper in FORMATS["results"]["found"]:
        yield {"what": what, "found": cell(template, summary), "paper": paper}


SPEED = {
    ("forward", "jaxeit float64"): "forward, jaxeit",
    ("forward", "jaxeit float64, called from Python"): "forward, jaxeit, called from Python",
    ("forward", "jaxeit float64, without compiler options"): "forward, jaxeit, in your own `jax.jit`",
    ("forward", "CHOLMOD by hand"): "forward, CHOLMOD driven by hand",
    ("forward", "SuperLU by hand"): "forward, SuperLU driven by hand",
    ("forward", "EIDORS"): "forward, EIDORS",
    ("forward", "pyEIT"): "forward, pyEIT",
    ("gradient", "jaxeit float64"): "gradient of a loss, jaxeit",
    ("gradient", "jaxeit float64, without compiler options"): "gradient of a loss, jaxeit, in your own `jax.jit`",
    ("gradient", "adjoint by hand"): "gradient of a loss, adjoint formula by hand",
    ("jacobian", "jaxeit float64, pixels"): "Jacobian onto 900 pixels, jaxeit",
    ("jacobian", "jaxeit float64, without compiler options, pixels"): (
        "Jacobian onto 900 pixels, jaxeit, in your own `jax.jit`"
    ),
    ("jacobian", "adjoint by hand, pixels"): "Jacobian onto 900 pixels, adjoint formula by hand",
    ("jacobian", "EIDORS, pixels"): "Jacobian onto 900 pixels, EIDORS",
}


COMPILED = {("forward", "jaxeit float64"), ("gradient", "jaxeit float64"), ("jacobian", "jaxeit float64, pixels")}


def _speed(forward: Row, jacobian: Row) -> Iterator[Row]:
    """Forward solves, gradients and Jacobians onto pixels, by tool and mesh; then what ours take to compile."""
    gradients = jacobian.get("gradient_rows", [])
    runs = {"forward": forward["rows"], "jacobian": jacobian["rows"], "gradient": gradients}
    for (kind, tool), label in SPEED.items():
        yield from (row | {"tool": label} for row in runs[kind] if row["tool"] == tool)
    for kind, tool in SPEED:
        compiled = (row for row in runs[kind] if row["tool"] == tool and (kind, tool) in COMPILED)
        yield from (
            row | {"tool": f"first call with compilation: {SPEED[kind, tool]}", "median_ms": 1e3 * row["first_call_s"]}
            for row in compiled
        )


LEVELS_OF = 3721  # nodes of the mesh whose levels stand on the page


def _steps(forward: Row) -> list[Row]:
    """Steps of the solve on one mesh, with the share of each and what it reaches of the machine's limit; then all."""
    rows = [row for row in forward["levels"] if row["nodes"] == LEVELS_OF]
    whole, least = rows[-1]["until_ms"], [row.get("least_ms", 0.0) for row in rows]
    every = [row | {"share": row["ms"] / whole} for row in rows]
    known = [row | {"reached": row["least_ms"] / row["ms"]} if "least_ms" in row else row for row in every]
    return [*known, {"step": "all", "ms": whole, "share": 1.0, "reached": sum(least) / whole}]


def _batches(results: Row) -> list[Row]:
    """Solutions a second of each tool."""
    return [row | {"per_s": 1e3 * CONTACTS / row["median_ms"]} for row in results["rows"]]


def _gpu_batches(results: Row, larger: Row) -> Iterator[Row]:
    """Ours, on a larger GPU too, and those of other solvers, then memory and compilation of ours."""
    ours = [{"tool": "jaxeit"} | row for row in results["batches"]]
    beyond = [{"tool": "jaxeit on an H200"} | row for row in larger["batches"]]
    for row in ours + beyond + results["peers"]:
        yield row | {"line": f"{row['tool']}, batches of {row['batch']:,}", "shown": f"{row['per_s']:,.0f}"}
    for row in results["batches"]:
        if row["batch"] == 1024:
            yield row | {"line": "memory for a batch of 1,024, GB", "shown": f"{1e-3 * row['memory_mb']:.2f}"}
            yield row | {"line": "compilation, s", "shown": f"{row['compile_s']:.1f}"}


def _gpu_verbs(results: Row) -> Iterator[Row]:
    """Single calls, then batches of derivatives."""
    for row in results["singles"]:
        yield row | {"line": f"{row['what']}, one call, ms", "shown": f"{row['median_ms']:.2f}"}
    for row in results["gradients"]:
        yield row | {
            "line": f"{row['what']}s a second, batches of {row['batch']:,}",
            "shown": f"{row['per_s']:,.0f}",
        }


def _gpu_frames(larger: Row) -> Iterator[Row]:
    """Images and contacts of the testbed's frames: single calls, then batches and what they take."""
    names = {"image": ("one image", "images"), "contacts": ("contacts of one frame", "frames searched for contacts")}
    for row in larger["frames"]:
        one, many = names[row["what"]]
        if row["batch"] == 1:
            yield row | {"line": f"{one}, ms", "shown": f"{row['median_ms']:.2f}"}
        else:
            yield row | {"line": f"{many} a second, batches of {row['batch']:,}", "shown": f"{row['per_s']:,.0f}"}
            yield row | {"line": f"memory of the batch of {many}, GB", "shown": f"{1e-3 * row['memory_mb']:.1f}"}
            yield row | {"line": f"compilation for {many}, s", "shown": f"{row['compile_s']:.0f}"}


def _gpu_training(results: Row) -> str:
    (row,) = results["training"]
    return (
        f"Training of a proposal (`jaxeit train`) takes {row['steps_per_s']:,.0f} steps a second on the H100, of "
        f"{row['frames_per_s'] / row['steps_per_s']:.0f} random frames each; the first epoch,\nwith compilation, takes "
        f"{row['first_epoch_s']:.1f} s.\n"
    )


def _two_fingers(loads: Row, tracking: Row) -> Iterator[Row]:
    """How often two equal contacts are told apart in one frame, by what the fit assumes, and by a tracker."""
    single = {row["touch"]: row for row in loads["round"]}
    followed = {row["scene"]: row for row in tracking["scenes"]}
    for distance in (0.015, 0.02, 0.03):
        sequence = followed[f"two in sequence, {1e3 * distance:.0f} mm"]
        frame = single[f"two, 1:1, {1e3 * distance:.0f} mm"]
        yield {"distance": distance, "in_sequence": sequence["told"], "kept": sequence["kept"]} | frame


def _onto(results: Row) -> list[Row]:
    """Tools onto "pixels" and "elements", which say so in full."""
    return [row | {"tool": re.sub(", (?=pixels|elements)", ", onto ", row["tool"])} for row in results["rows"]]


def _repeat(*runs: Row) -> str:
    """Whether the ratios between the times of `_speed` came out alike in two runs; a sentence."""
    kinds = zip(("forward", "jacobian") * 2, runs, strict=True)
    quoted = [[row for row in run["rows"] if (kind, row["tool"]) in SPEED] for kind, run in kinds]
    found = [one for first, second in zip(quoted[:2], quoted[2:], strict=True) for one in compared(first, second)]
    change = max(abs(one.second.value / one.first.value - 1) for one in found)
    return (
        f"Measured a second time, {sum(one.agrees for one in found)} of the {len(found)} ratios of these times to "
        f"jaxeit's lie within the spread of the other run; the largest change is {100 * change:.0f} %.\n"
    )


def _images(results: Row) -> Iterator[Row]:
    """Methods side by side; the error is that of the image's own best estimator, or of the fit."""
    names = [f"{name}_mm" for name in (*REPORTED_ESTIMATORS, "parametric")]
    for row in results["rows"]:
        yield {"seeds": results["seeds"]} | row | {"error": min(row[name] for name in names if name in row)}


def _priors(results: Row) -> Iterator[Row]:
    """The rows of `_images` that differ in the prior, or basis, of one step alone."""
    for row in _images(results):
        method, _, prior = row["method"].partition(", ")
        if method == "one step":
            yield row | {"prior": re.sub(" [(].*", "", prior)}


def _methods(results: Row) -> Iterator[Row]:
    """The rows of `_images` that differ in the method: of one step only that with the default prior."""
    for row in _images(results):
        if not row["method"].startswith("one step") or row["method"].endswith("NOSER"):
            yield row


def _ktc(results: Row) -> list[Row]:
    """Mean scores by method and level, and their total."""
    by_level = [row | {"head": f"level {row['level']}", "score": f"{row['mean']:.3f}"} for row in results["rows"]]
    totals = results["of_21"].items()
    return by_level + [{"method": name, "head": "of 21", "score": f"{total:.2f}"} for name, total in totals]


def _ktc_phantoms(results: Row) -> list[Row]:
    """Mean scores on fresh phantoms: of each level with the total of 21, then of each kind over all levels."""
    fresh, rows = [row for row in results["phantoms"] if row["set"] == "fresh"], []
    for row in fresh:
        rows.append({"method": row["method"], "line": f"level {row['level']}", "score": f"{row['mean']:.3f}"})
    for name, total in results["phantoms_of_21"]["fresh"].items():
        rows.append({"method": name, "line": "of 21", "score": f"{total:.2f}"})
    for row in fresh:
        for kind in row["by_kind"]:
            mean = np.mean([one["by_kind"][kind] for one in fresh if one["method"] == row["method"]])
            rows.append({"method": row["method"], "line": KTC_KINDS.get(kind, kind), "score": f"{mean:.3f}"})
    return [row | {"method": KTC_METHODS[row["method"]]} for row in rows]


def _ktc_shapes(part: str) -> Callable[[Row], Iterator[Row]]:
    """Means over the phantoms of a kind at a level."""
    return lambda results: map(averaged, grouped(results[part], "kind", "level").values())


KTC_METHODS = {"linear": "linear, Otsu's thresholds", "variation": "`je.imaging.segment`"}
KTC_KINDS = {"convex": "disc, ellipse or polygon", "two": "two pieces", "three": "three pieces"}


def _paper(results: Row) -> Iterator[Row]:
    """Mean ± standard deviation over the seeds, a row for each load spreading."""
    for row in results["rows"]:
        shown = {"label": f"{row['spreading_mm']:g} mm ({row['seeds']})"}
        for name in row.keys() - {"spreading_mm", "seeds"}:
            how = "{number:.1f milli}" if name.startswith("localisation") else "{number:.3f}"
            numbers = row[name][: 2 if row["seeds"] > 1 else 1]
            shown[name] = " ± ".join(cell(how, {"number": number}) for number in numbers)
        yield shown
    yield {"label": "the paper, on hardware"} | results["paper"]


def _ladder(skin: int) -> Callable[[Row], Iterator[Row]]:
    """The rungs of a skin that name a fidelity or lie on the front of error against time of a forward solve.

    The times of a GPU stand beside them where its results are given.
    """

    def rows(results: Row, gpu: Row | None = None) -> Iterator[Row]:
        beside = {row["label"]: row for row in (gpu or {"ladder": []})["ladder"]}
        for row in results["ladders"][skin]["rungs"]:
            if row["front"] or row["label"] in ("draft", "standard", "reference"):
                name = f"**{row['label']}**" if row["front"] else row["label"]
                yield row | {"name": name, "gpu": beside.get(row["label"], {})}

    return rows


def _fidelities(results: Row) -> Iterator[Row]:
    """The rungs of both skins in float64, by the names that `Fidelity` gives them, with their settings."""
    for ladder in results["ladders"]:
        for row in ladder["rungs"]:
            if row["label"] in ("draft", "draft P2", "standard", "fine", "reference"):
                yield row | {"skin": ladder["skin"]}


def _precisions(results: Row) -> Iterator[Row]:
    """The rungs of both skins that were measured in both precisions, side by side."""
    for ladder in results["ladders"]:
        rungs = {row["label"]: row for row in ladder["rungs"]}
        for label, row in rungs.items():
            if f"{label} f32" in rungs:
                yield {"skin": ladder["skin"], "label": label, "double": row, "single": rungs[f"{label} f32"]}


SOLVERS = {
    "None": "default: `NestedDissection()`",
    "ConjugateGradient(preconditioner=Single(solver=NestedDissection()))": (
        "`ConjugateGradient(Single(NestedDissection()))`"
    ),
    "Single(solver=NestedDissection())": "`Single(NestedDissection())`",
}


def _solvers(results: Row) -> Iterator[Row]:
    """The rungs of the testbed that differ in the linear solver alone, beside those of the default."""
    rungs = [row for row in results["ladders"][0]["rungs"] if row["forward"]]
    others = [row for row in rungs if row["fidelity"]["solver"] != "None"]
    for other in others:
        same = {**other["fidelity"], "solver": "None"}
        default = next(row for row in rungs if row["fidelity"] == same)
        for row in (default, other):
            yield row | {"of": default["label"], "solver": SOLVERS[row["fidelity"]["solver"]]}


def _frame(results: Row) -> Iterator[Row]:
    """One frame to its image: in a stream of frames, after other work, and in a batch."""
    kinds = ("single", "single, after other work", "batch")
    single, after, batch = ({row["way"]: row for row in results["application"][kind]} for kind in kinds)
    for way, row in single.items():
        yield row | {"after": after.get(way, {}), "batch": batch.get(way, {})}


def _calibration(results: Row) -> list[Row]:
    """Error of held-out forces by presses scattered over the skin, and by recipe; all presses last."""
    scattered = [row for row in results["presses"] if row["spread"] == "scattered"]
    every = [row for row in results["presses"] if row["presses"] == 225]
    return sorted(scattered, key=lambda row: row["presses"]) + every


def _levels(results: Row) -> Iterator[Row]:
    """Error of held-out forces by curve and by the levels of force that its presses had."""
    for row in results["levels"]:
        levels = "all samples" if row["levels"] is None else f"{row['levels']} level" + "s" * (row["levels"] > 1)
        yield row | {"fitted": levels}


def _locations(results: Row) -> Iterator[Row]:
    """Error of held-out forces with and without a correction by location, and where the presses were."""
    return (row for row in results["presses"] if row["curve"] == "linear")


def _scans(results: Row) -> Iterator[Row]:
    """Readings chosen for the whole sheet, for a pad or for a place, and at random."""
    known = ("D-optimal", "around the pad", "around the place", "at random")
    return (row for row in results["rows"] if row["way"] in known)


def _events(results: Row) -> Iterator[Row]:
    labels = {"rest": "at rest", "first": "first frame of a contact", "next": "the frames after"}
    return (results["events"][name] | {"label": label} for name, label in labels.items())


def _growth(results: Row) -> Iterator[Row]:
    return (fit | {"last": fit["sizes"][-1]} for fit in results["fits"])


def _live(results: Row) -> Iterator[Row]:
    """What came over loopback, and when it was shown."""
    soak, recorded = results["soak"], results["tenfold"]
    labels = [f"{one['rate_hz']} Hz, {one['seconds'] / 60:.0f} min" for one in (soak, recorded)]
    yield soak | {"label": f"live and recorded, {labels[0]}"}
    if "soak_realtime" in results:
        yield results["soak_realtime"] | {"label": f"live and recorded, {labels[0]}, `--realtime`"}
    for row in results["rates"]:
        if row["rate_hz"] == results["highest_hz"] and row["sustained"]:
            yield row | {"label": f"live, highest rate sustained: {row['rate_hz']} Hz"}
    shown = {"label": f"recorded, {labels[1]}", "received": recorded["recorded"], "lost": recorded["lost"][0]}
    yield recorded | shown


ROWS: dict[str, Callable] = {
    "evaluation": _evaluation,
    "speed": _speed,
    "batches": _batches,
    "steps": _steps,
    "onto": _onto,
    "two_fingers": _two_fingers,
    "gpu_batches": _gpu_batches,
    "gpu_verbs": _gpu_verbs,
    "gpu_frames": _gpu_frames,
    "gpu_training": _gpu_training,
    "repeat": _repeat,
    "priors": _priors,
    "methods": _methods,
    "fidelities": _fidelities,
    "precisions": _precisions,
    "solvers": _solvers,
    "levels": _levels,
    "locations": _locations,
    "scans": _scans,
    "ktc": _ktc,
    "ktc_phantoms": _ktc_phantoms,
    "ktc_bound": _ktc_shapes("bound"),
    "ktc_outlines": _ktc_shapes("outlines"),
    "paper": _paper,
    "ladder_testbed": _ladder(0),
    "ladder_chest": _ladder(1),
    "frame": _frame,
    "calibration": _calibration,
    "events": _events,
    "growth": _growth,
    "live": _live,
}
