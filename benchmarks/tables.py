"""The tables of the pages, by their marks, as data; and what a run prints of its section."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress

import jaxeit as je

from .markdown import Table, all_columns, cell, crossing, listed, markdown, plain, replaced
from .repeat import compared
from .rows import Row


def report(section: str, data: Row) -> str:
    """All rows of a section, then the tables that are made of it alone and whose parts are measured."""
    parts = list(_every(data))
    for table in TABLES.values():
        with suppress(LookupError):
            parts += [table.text(data)] if table.sections == (section,) else []
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
    for mark, table in TABLES.items():
        if f"<!-- {mark}:" in page and all(name in measured for name in table.sections):
            page = replaced(page, mark, table.text(*(measured[name] for name in table.sections)))
    return page


PAPER = {"quarter": "6.9 mm (estimator not stated)", "eit": "0.31", "hybrid": "0.14"}
EVALUATED = (  # what is told, in which cell (@ is the name of a variant in the summary), and the variants
    (
        "localisation error, {}, mean",
        "{localisation_@_mean:.1f milli} ± {localisation_@_mean_se:.1f milli} mm",
        {name: f"{name} estimator" for name in je.metrics.ESTIMATORS} | {"fitted": "contacts fitted"},
    ),
    (
        "coefficient of variation of sensitivity, {}",
        "{cv_@_ddof1:.3f} ± {cv_@_se:.3f}",
        {"eit": "EIT only", "hybrid": "hybrid, the paper's recipe",
         "calibrated": "hybrid, corrected for the contact's place"},
    ),
    (
        "force error on presses held out by place, RMSE, {}",
        "{force_@rmse:.2f} N, {force_@rmse_percent_full_scale:.1f} % of 20 N",
        {"hybrid_": "the paper's recipe", "": "corrected for the place"},
    ),
)  # fmt: skip


def evaluation(summary: Row) -> str:
    """The evaluation of a calibration on the bundled session, beside the paper."""
    heads = ["simulated, 225 presses", "this run, ± SE over places", "the paper, on hardware"]
    return markdown(
        heads,
        [
            [what.format(label), cell(template.replace("@", name), summary), PAPER.get(name, "")]
            for what, template, variants in EVALUATED
            for name, label in variants.items()
        ],
    )


SPEED = {
    ("forward", "jaxeit float64"): "forward, jaxeit",
    ("forward", "CHOLMOD by hand"): "forward, CHOLMOD driven by hand",
    ("forward", "SuperLU by hand"): "forward, SuperLU driven by hand",
    ("forward", "EIDORS"): "forward, EIDORS",
    ("forward", "pyEIT"): "forward, pyEIT",
    ("jacobian", "jaxeit float64, pixels"): "Jacobian onto 900 pixels, jaxeit",
    ("jacobian", "adjoint by hand, pixels"): "Jacobian onto 900 pixels, adjoint formula by hand",
    ("jacobian", "EIDORS, pixels"): "Jacobian onto 900 pixels, EIDORS",
}


def _speed(forward: Row, jacobian: Row) -> list[Row]:
    """Forward solves and Jacobians onto pixels, by tool and mesh."""
    runs = {"forward": forward["rows"], "jacobian": jacobian["rows"]}
    return [row | {"tool": label} for (kind, tool), label in SPEED.items() for row in runs[kind] if row["tool"] == tool]


def _by_size(sections: str, head: str, rows: Callable[..., Sequence[Row]] | None = None) -> Table:
    """Medians by tool and mesh; tools onto "pixels" and "elements" say so in full."""

    def named(results: Row) -> list[Row]:
        return [row | {"tool": re.sub(", (?=pixels|elements)", ", onto ", row["tool"])} for row in results["rows"]]

    return crossing(sections, head, "{tool}", "{nodes:,} nodes", "{median_ms:ms}", rows=rows or named)


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
    names = [f"{name}_mm" for name in (*je.metrics.ESTIMATORS, "parametric")]
    for row in results["rows"]:
        yield {"seeds": results["seeds"]} | row | {"error": min(row[name] for name in names if name in row)}


PAPER_BENCH = {  # head, and the format of a number
    "localisation_quarter_mean": ("localisation, quarter, mm", ".1f milli"),
    "localisation_half_mean": ("half, mm", ".1f milli"),
    "localisation_peak_mean": ("peak, mm", ".1f milli"),
    "localisation_quarter_inward_bias": ("inward, mm", ".1f milli"),
    "cv_eit_ddof1": ("CV, EIT only", ".3f"),
    "cv_hybrid_ddof1": ("CV, hybrid", ".3f"),
    "localisation_fitted_mean": ("contacts fitted, mm", ".1f milli"),
    "cv_calibrated_ddof1": ("CV, hybrid corrected for the place", ".3f"),
}


def _paper(results: Row) -> str:
    """Mean ± standard deviation over the seeds, a line for each load spreading."""
    lines = []
    for row in results["rows"]:
        lines.append([f"{row['spreading_mm']:g} mm ({row['seeds']})"])
        for name, (_, how) in PAPER_BENCH.items():
            shown = row[name] if row["seeds"] > 1 else row[name][:1]
            lines[-1].append(" ± ".join(cell(f"{{value:{how}}}", {"value": value}) for value in shown))
    lines.append(["the paper, on hardware", *(results["paper"].get(name, "") for name in PAPER_BENCH)])
    return markdown(["load spreading (seeds)", *(head for head, _ in PAPER_BENCH.values())], lines)


def _ladder(skin: int) -> Table:
    """The rungs of a skin that name a fidelity or lie on the front of error against time of a forward solve."""

    def rows(results: Row) -> Iterator[Row]:
        for row in results["ladders"][skin]["rungs"]:
            if row["front"] or row["label"] in ("draft", "standard", "reference"):
                yield row | {"name": f"**{row['label']}**" if row["front"] else row["label"]}

    return listed(
        "ladder",
        "fidelity | nodes | voltages, error | a touch, error | forward, ms | Jacobian, ms | localised, mm | frame, ms",
        "{name} | {nodes:,} | {voltage_error:.2g %} | {difference_error:.2g %} | {forward[median]:ms milli} | "
        "{jacobian[median]:ms milli} | {image[localisation]:.2f milli} | {image[frame][median]:ms milli}",
        rows,
    )


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


EVENTS = {"rest": "at rest", "first": "first frame of a contact", "next": "the frames after"}


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


# By the mark in a page; `forward` and `jacobian` are only printed.
TABLES: dict[str, Table] = {
    "forward": _by_size("forward", "forward solve, ms"),
    "jacobian": _by_size("jacobian", "Jacobian, ms"),
    "speed": _by_size("forward jacobian", "ms, median", _speed),
    "repeat": Table(("forward", "jacobian", "forward-again", "jacobian-again"), _repeat),
    "images": listed(
        "images",
        "method (seeds) | error, mm | inward, mm | false second | both, 30 mm | 40 mm | 40 mm, 1:3 | ms a frame",
        "{method} ({seeds}) | {error:.1f} | {inward_mm:.1f} | {false_seconds:.0f %} | {0[pairs_30mm_1:1]:.0f %} | "
        "{0[pairs_40mm_1:1]:.0f %} | {0[pairs_40mm_1:3]:.0f %} | {frame_ms:ms}",
        _images,
    ),
    "loads": listed(
        "loads",
        "one frame of | frames | told by loads | told by bumps | error of place, mm | ellipse of 90 % covers",
        "{touch} | {frames} | {told:.0f %} | {by_bumps:.0f %} | {error_mm:.1f} | {covered:.0f %}",
        lambda loads: loads["rows"],
    ),
    "loads-reliability": listed(
        "loads",
        "probability stated, mean | kinds true | frames times kinds",
        "{stated:.0f %} | {true:.0f %} | {count}",
        lambda loads: loads["reliability"],
    ),
    "scenes": listed(
        "scene",
        "scene | recording | frames | simulated in | times real time",
        "`{scene}` | {recording_s:,.0f} s | {frames:,} | {second_s:.1f} s | {times_real_time:.0f}",
        lambda scene: scene["sessions"],
    ),
    "paper": Table(("paper",), _paper),
    "ladder": _ladder(0),
    "ladder-chest": _ladder(1),
    "preparation": _by_size("inverse", "a reconstruction prepared, ms"),
    "frame": listed(
        "inverse",
        "ms a frame | p50 | p99 | max | p50, after other work | p99, after other work | max, after other work | "
        "batch of 1,000 | memory-copy bound",
        "{way} | {p50_ms:.3f} | {p99_ms:.3f} | {max_ms:.3f} | {after[p50_ms]:.3f} | {after[p99_ms]:.3f} | "
        "{after[max_ms]:.3f} | {batch[p50_ms]:.4f} | {least_ms:.3f}",
        _frame,
    ),
    "stream": listed(
        "inverse",
        "ms a frame | frames | p50 | p99 | p99.9 | above 0.1 ms",
        "{way} | {calls:,} | {p50_ms:.3f} | {p99_ms:.3f} | {0[p99.9_ms]:.3f} | {above:,}",
        lambda inverse: inverse["application"]["stream"],
    ),
    "pipeline": _by_size("pipeline", "mesh to images of 100 frames, ms"),
    "to-accuracy": crossing(
        "pipeline",
        "forward, ms (unknowns)",
        "{kind}",
        "voltages to {target:g %}",
        "{best[median_ms]:ms} ({best[unknowns]:,})",
        rows=lambda pipeline: pipeline["to_accuracy"],
        missing="not reached",
    ),
    "calibration-cost": crossing(
        "calibration_cost",
        "error of held-out forces, N",
        "{curve}, location {location}",
        "{presses} presses, {minutes:.0f} min",
        "{hold_n:.2f}",
        rows=_calibration,
        missing="not determined",
    ),
    "measurement-cost": crossing(
        "protocol_cost",
        "mean error of place, contacts fitted, mm",
        "{way}",
        "{readings} readings, {frames_per_s:,.0f} frames/s",
        "{fit_mm:.2g}",
        rows=lambda protocol: protocol["rows"],
    ),
    "event-scan": listed(
        "protocol_cost",
        "event-driven scan | readings | fit, mm | lost | frames/s | frames/s with switching",
        "{label} | {readings:.0f} | {fit_mm:.2f} | {lost:.0f %} | {frames_per_s:,.0f} | "
        "{frames_per_s_with_switching:,.0f}",
        lambda protocol: (protocol["events"][name] | {"label": label} for name, label in EVENTS.items()),
    ),
    "effects": listed(
        "scene",
        "effects | a frame, ms | Mflop | operations | 1,024 frames' histories, ms | Mflop | operations",
        "{effects} | {frame_ms:ms} | {frame_mflop:ms} | {frame_operations:ms} | {block_ms:ms} | {block_mflop:ms} | "
        "{block_operations:ms}",
        lambda scene: scene["rows"],
    ),
    "growth": listed(
        "growth",
        "work | sizes | time grows as size to the | theory | memory | theory",
        "{series} by {of} | {sizes[0]:,} to {last:,} | {time[exponent]} | {time[theory]} | {memory[exponent]} | "
        "{memory[theory]}",
        lambda growth: (fit | {"last": fit["sizes"][-1]} for fit in growth["fits"]),
    ),
    "start": listed("start", "fresh process | s", "{start} | {median_ms:.2f kilo}", lambda start: start["rows"]),
    "live": listed(
        "live",
        "run | frames | lost | dropped | latency p50, ms | latency p99, ms | latency max, ms | "
        "after due time, p99, ms | wake-up delay of a sleeper, p99, ms | memory, MB an hour",
        "{label} | {received[0]:,} | {lost:,} | {dropped:,} | {latency_ms_p50:ms} | {latency_ms_p99:ms} | "
        "{latency_ms_max:ms} | {since_due_ms_p99:ms} | {woken_ms_p99:ms} | "
        "{memory_mb_per_hour:.2f} ± {memory_mb_per_hour_error:.2f}",
        _live,
    ),
}
