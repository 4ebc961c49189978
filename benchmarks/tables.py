"""Tables in Markdown of what was measured, declared as data: those of the pages by their marks, and what a run prints.

A cell is a format string over a row of the results, as ``"{frames:,}"``. Two kinds of numbers are added to Python's:
``{x:ms}``, three figures or whole numbers from 100 on, and ``{x:.1f %}``, a fraction in percent. A cell is empty where
the row lacks the number.
"""

import re
import string
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import jaxeit as je

from .repeat import compared
from .rows import Row


class _Format(string.Formatter):
    def format_field(self, value: Any, format_spec: str) -> str:
        if format_spec == "ms":
            return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
        if format_spec.endswith(" %"):
            return format(100 * value, format_spec[:-2]) + " %"
        return format(value, format_spec)


def cell(template: str, row: Row, missing: str = "") -> str:
    """A format string filled from a row; ``missing`` where the row has not all that the string names."""
    try:
        return _Format().vformat(template, (row,), row)
    except (KeyError, TypeError):
        return missing


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


# --- what a run prints


def report(section: str, data: Row) -> str:
    """All rows of a section, then the tables that are made of it alone and whose parts are measured."""
    parts = list(_every(data))
    for sections, table in TABLES.values():
        with suppress(LookupError):
            parts += [table(data)] if sections == (section,) else []
    return "\n".join(parts)


def _every(data: Row, path: str = "") -> Iterator[str]:
    for name, value in data.items():
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield f"{path}{name}\n\n{_all_columns(value)}"
        elif isinstance(value, Mapping) and all(isinstance(one, list) for one in value.values()):
            yield from _every(value, f"{path}{name}, ")
        elif name != "circumstances":
            yield f"{path}{name}: {_plain(value)}\n"


def _all_columns(rows: Sequence[Row]) -> str:
    """Every number of the rows; least and most stand beside the median, and a standard deviation after its mean."""
    names = dict.fromkeys(name for row in rows for name, value in row.items() if not isinstance(value, Mapping))
    shown = [n for n in names if not (n.endswith("_sd") or re.sub("^(min|max)_", "median_", n) in {*names} - {n})]
    return markdown([name.replace("_", " ") for name in shown], [[_with_spread(row, n) for n in shown] for row in rows])


def _with_spread(row: Row, name: str) -> str:
    value, least, most = (row.get(name.replace("median_", kind)) for kind in ("median_", "min_", "max_"))
    if name.startswith("median_") and least is not None:
        return f"{value:.3g} ({least:.3g} to {most:.3g})"
    sd = row.get(f"{name}_sd")
    return _plain(row.get(name)) + ("" if sd is None else f" ± {sd:.2g}")


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)


# --- the pages


class Columns(NamedTuple):
    """Heads of a table and the line of a row, both with their cells between bars."""

    heads: str
    line: str

    def __call__(self, rows: Iterable[Row]) -> str:
        lines = ([cell(template, row) for template in self.line.split(" | ")] for row in rows)
        return markdown(self.heads.split(" | "), lines)

    def of(self, key: str) -> Callable[[Row], str]:
        """The table of the rows that a section holds under a key."""
        return lambda results: self(results[key])


def crossed(head: str, line: str, column: str, content: str, rows: Sequence[Row], missing: str = "") -> str:
    """A line and a column for each value of two format strings, in order of appearance; of equals the last counts."""
    heads = dict.fromkeys(cell(column, row) for row in rows)
    found: dict[str, dict[str, str]] = {}
    for row in rows:
        found.setdefault(cell(line, row), {})[cell(column, row)] = cell(content, row, missing)
    return markdown([head, *heads], [[label, *(cells.get(h, "") for h in heads)] for label, cells in found.items()])


def filled(page: str, measured: Row) -> str:
    """A page with the tables between its marks written anew; those whose benchmark has not run stay as they are."""
    for mark, (sections, table) in TABLES.items():
        if f"<!-- {mark}:" in page and all(name in measured for name in sections):
            page = replaced(page, mark, table(*(measured[name] for name in sections)))
    return page


def replaced(page: str, mark: str, table: str) -> str:
    """A page with a table between ``<!-- mark: ... -->`` and ``<!-- end of mark -->``."""
    pattern = rf"(<!-- {mark}:.*?-->\n).*?(<!-- end of {mark} -->)"
    return re.sub(pattern, lambda m: m[1] + table + m[2], page, flags=re.DOTALL)


PAPER = {"quarter": "6.9 mm (estimator not stated)", "eit": "0.31", "hybrid": "0.14"}
SENSITIVITY = {
    "eit": "EIT only",
    "hybrid": "hybrid, the paper's recipe",
    "calibrated": "hybrid, corrected for the contact's place",
}
FORCE = {"hybrid_": "the paper's recipe", "": "corrected for the place"}
EVALUATION = Columns(
    "simulated, 225 presses | this run, ± SE over places | the paper, on hardware", "{what} | {found} | {paper}"
)


def evaluation(s: Mapping[str, float]) -> str:
    """The evaluation of a calibration on the bundled session, beside the paper."""
    rows: list[tuple[str, str, str]] = []
    for name, label in {**{n: f"{n} estimator" for n in je.metrics.ESTIMATORS}, "fitted": "contacts fitted"}.items():
        mean, error = (1e3 * s[f"localisation_{name}_mean{end}"] for end in ("", "_se"))
        rows.append((f"localisation error, {label}, mean", f"{mean:.1f} ± {error:.1f} mm", PAPER.get(name, "")))
    for name, label in SENSITIVITY.items():
        found = f"{s[f'cv_{name}_ddof1']:.3f} ± {s[f'cv_{name}_se']:.3f}"
        rows.append((f"coefficient of variation of sensitivity, {label}", found, PAPER.get(name, "")))
    for name, label in FORCE.items():
        found = f"{s[f'force_{name}rmse']:.2f} N, {s[f'force_{name}rmse_percent_full_scale']:.1f} % of 20 N"
        rows.append((f"force error on presses held out by place, RMSE, {label}", found, ""))
    return EVALUATION(dict(zip(("what", "found", "paper"), row, strict=True)) for row in rows)


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


def _speed(forward: Row, jacobian: Row) -> str:
    """Medians of forward solves and of Jacobians onto pixels, by tool and mesh."""
    runs = {"forward": forward["rows"], "jacobian": jacobian["rows"]}
    rows = [row | {"tool": label} for (kind, tool), label in SPEED.items() for row in runs[kind] if row["tool"] == tool]
    return _by_size("ms, median", rows)


def _by_size(head: str, rows: Sequence[Row]) -> str:
    return crossed(head, "{tool}", "{nodes:,} nodes", "{median_ms:ms}", rows)


def _by_tool(head: str) -> Callable[[Row], str]:
    return lambda results: _by_size(
        head, [row | {"tool": re.sub(", (?=pixels|elements)", ", onto ", row["tool"])} for row in results["rows"]]
    )


def _repeat(*runs: Row) -> str:
    """Whether the ratios between the times of `_speed` came out alike in two runs; a sentence."""
    kinds = ("forward", "jacobian", "forward", "jacobian")
    quoted = [
        [row for row in run["rows"] if (kind, row["tool"]) in SPEED] for kind, run in zip(kinds, runs, strict=True)
    ]
    found = [one for first, second in zip(quoted[:2], quoted[2:], strict=True) for one in compared(first, second)]
    change = max(abs(one.second.value / one.first.value - 1) for one in found)
    agree = sum(one.agrees for one in found)
    return (
        f"Measured a second time, {agree} of the {len(found)} ratios of these times to jaxeit's lie within the spread "
        f"of the other run; the largest change is {100 * change:.0f} %.\n"
    )


IMAGES = Columns(
    "method (seeds) | error, mm | inward, mm | false second | both, 30 mm | 40 mm | 40 mm, 1:3 | ms a frame",
    "{method} ({seeds}) | {error:.1f} | {inward_mm:.1f} | {false_seconds:.0f %} | {0[pairs_30mm_1:1]:.0f %} | "
    "{0[pairs_40mm_1:1]:.0f %} | {0[pairs_40mm_1:3]:.0f %} | {frame_ms:ms}",
)


def _images(results: Row) -> str:
    """Methods side by side; the error is that of the image's own best estimator, or of the fit."""
    names = [f"{name}_mm" for name in (*je.metrics.ESTIMATORS, "parametric")]
    best = ({"error": min(row[name] for name in names if name in row)} for row in results["rows"])
    return IMAGES({"seeds": results["seeds"]} | row | error for row, error in zip(results["rows"], best, strict=True))


PAPER_BENCH = {  # head, factor from SI to its unit
    "localisation_quarter_mean": ("localisation, quarter, mm", 1e3),
    "localisation_half_mean": ("half, mm", 1e3),
    "localisation_peak_mean": ("peak, mm", 1e3),
    "localisation_quarter_inward_bias": ("inward, mm", 1e3),
    "cv_eit_ddof1": ("CV, EIT only", 1),
    "cv_hybrid_ddof1": ("CV, hybrid", 1),
    "localisation_fitted_mean": ("contacts fitted, mm", 1e3),
    "cv_calibrated_ddof1": ("CV, hybrid corrected for the place", 1),
}


def _paper(results: Row) -> str:
    """Mean ± standard deviation over the seeds, a line for each load spreading."""
    lines = []
    for row in results["rows"]:
        lines.append([f"{row['spreading_mm']:g} mm ({row['seeds']})"])
        for name, (_, factor) in PAPER_BENCH.items():
            mean, sd = (f"{factor * value:.{1 if factor > 1 else 3}f}" for value in row[name])
            lines[-1].append(f"{mean} ± {sd}" if row["seeds"] > 1 else mean)
    lines.append(["the paper, on hardware", *(results["paper"].get(name, "") for name in PAPER_BENCH)])
    return markdown(["load spreading (seeds)", *(head for head, _ in PAPER_BENCH.values())], lines)


LADDER = Columns(
    "fidelity | nodes | voltages, error | a touch, error | forward, ms | Jacobian, ms | localised, mm | frame, ms",
    "{name} | {nodes:,} | {voltage_error:.2g %} | {difference_error:.2g %} | {forward_ms:ms} | {jacobian_ms:ms} | "
    "{localised_mm:.2f} | {frame_ms:ms}",
)


def _ladder(skin: int) -> Callable[[Row], str]:
    """The rungs of a skin that name a fidelity or lie on the front of error against time of a forward solve."""

    def shown(row: Row) -> Row:
        new = {"name": f"**{row['label']}**" if row["front"] else row["label"]}
        new |= {f"{name}_ms": 1e3 * row[name]["median"] for name in ("forward", "jacobian")}
        if image := row["image"]:
            new |= {"localised_mm": 1e3 * image["localisation"], "frame_ms": 1e3 * image["frame"]["median"]}
        return row | new

    named = ("draft", "standard", "reference")
    return lambda results: LADDER(
        shown(row) for row in results["ladders"][skin]["rungs"] if row["front"] or row["label"] in named
    )


FRAME = Columns(
    "ms a frame | p50 | p99 | max | p50, after other work | p99, after other work | max, after other work | "
    "batch of 1,000 | memory-copy bound",
    "{way} | {p50_ms:.3f} | {p99_ms:.3f} | {max_ms:.3f} | {after[p50_ms]:.3f} | {after[p99_ms]:.3f} | "
    "{after[max_ms]:.3f} | {batch[p50_ms]:.4f} | {least_ms:.3f}",
)
STREAM = Columns(
    "ms a frame | frames | p50 | p99 | p99.9 | above 0.1 ms",
    "{way} | {calls:,} | {p50_ms:.3f} | {p99_ms:.3f} | {0[p99.9_ms]:.3f} | {above:,}",
)


def _frame(results: Row) -> str:
    """One frame to its image: in a stream of frames, after other work, and in a batch."""
    kinds = ("single", "single, after other work", "batch")
    single, after, batch = ({row["way"]: row for row in results["application"][kind]} for kind in kinds)
    return FRAME(row | {"after": after.get(way, {}), "batch": batch.get(way, {})} for way, row in single.items())


def _to_accuracy(results: Row) -> str:
    """The quickest mesh of each tool that reaches an accuracy."""
    column, content = "voltages to {target:g %}", "{best[median_ms]:ms} ({best[unknowns]:,})"
    return crossed("forward, ms (unknowns)", "{kind}", column, content, results["to_accuracy"], "not reached")


def _calibration(results: Row) -> str:
    """Error of held-out forces by presses scattered over the skin, and by recipe."""
    fits = sorted((r for r in results["presses"] if r["spread"] == "scattered"), key=lambda r: r["presses"])
    line, column = "{curve}, location {location}", "{presses} presses, {minutes:.0f} min"
    every = [r for r in results["presses"] if r["presses"] == 225]
    return crossed("error of held-out forces, N", line, column, "{hold_n:.2f}", fits + every, "not determined")


def _readings(results: Row) -> str:
    """Error of place by readings of a frame, and by the way they are chosen."""
    head, column = "mean error of place, contacts fitted, mm", "{readings} readings, {frames_per_s:,.0f} frames/s"
    return crossed(head, "{way}", column, "{fit_mm:.2g}", results["rows"])


EVENT_SCAN = Columns(
    "event-driven scan | readings | fit, mm | lost | frames/s | frames/s with switching",
    "{label} | {readings:.0f} | {fit_mm:.2f} | {lost:.0f %} | {frames_per_s:,.0f} | {frames_per_s_with_switching:,.0f}",
)
EVENTS = {"rest": "at rest", "first": "first frame of a contact", "next": "the frames after"}


def _event_scan(results: Row) -> str:
    return EVENT_SCAN(results["events"][name] | {"label": label} for name, label in EVENTS.items())


LIVE = Columns(
    "run | frames | lost | dropped | latency p50, ms | latency p99, ms | latency max, ms | after due time, p99, ms | "
    "wake-up delay of a sleeper, p99, ms | memory, MB an hour",
    "{label} | {received[0]:,} | {lost:,} | {dropped:,} | {latency_ms_p50:ms} | {latency_ms_p99:ms} | "
    "{latency_ms_max:ms} | {since_due_ms_p99:ms} | {woken_ms_p99:ms} | "
    "{memory_mb_per_hour:.2f} ± {memory_mb_per_hour_error:.2f}",
)


def _live(results: Row) -> str:
    """What came over loopback, and when it was shown."""
    soak, recorded = results["soak"], results["tenfold"]
    labels = [f"{one['rate_hz']} Hz, {one['seconds'] / 60:.0f} min" for one in (soak, recorded)]
    rows = [soak | {"label": f"live and recorded, {labels[0]}"}]
    if "soak_realtime" in results:
        rows.append(results["soak_realtime"] | {"label": f"live and recorded, {labels[0]}, `--realtime`"})
    for row in results["rates"]:
        if row["rate_hz"] == results["highest_hz"] and row["sustained"]:
            rows.append(row | {"label": f"live, highest rate sustained: {row['rate_hz']} Hz"})
    shown = {"label": f"recorded, {labels[1]}", "received": recorded["recorded"], "lost": recorded["lost"][0]}
    return LIVE([*rows, recorded | shown])


SCENES = Columns(
    "scene | recording | frames | simulated in | times real time",
    "`{scene}` | {recording_s:,.0f} s | {frames:,} | {second_s:.1f} s | {times_real_time:.0f}",
)
EFFECTS = Columns(
    "effects | a frame, ms | Mflop | operations | 1,024 frames' histories, ms | Mflop | operations",
    "{effects} | {frame_ms:ms} | {frame_mflop:ms} | {frame_operations:ms} | {block_ms:ms} | {block_mflop:ms} | "
    "{block_operations:ms}",
)
GROWTH = Columns(
    "work | sizes | time grows as size to the | theory | memory | theory",
    "{series} by {of} | {sizes[0]:,} to {last:,} | {time[exponent]} | {time[theory]} | {memory[exponent]} | "
    "{memory[theory]}",
)
START = Columns("fresh process | s", "{start} | {seconds:.2f}")


def _growth(results: Row) -> str:
    return GROWTH(fit | {"last": fit["sizes"][-1]} for fit in results["fits"])


def _start(results: Row) -> str:
    return START(row | {"seconds": row["median_ms"] / 1e3} for row in results["rows"])


def _stream(results: Row) -> str:
    return STREAM(results["application"]["stream"])


# By the mark in a page (`forward` and `jacobian` are only printed): the sections that a table is made of, and how.
TABLES: dict[str, tuple[tuple[str, ...], Callable[..., str]]] = {
    "forward": (("forward",), _by_tool("forward solve, ms")),
    "jacobian": (("jacobian",), _by_tool("Jacobian, ms")),
    "speed": (("forward", "jacobian"), _speed),
    "repeat": (("forward", "jacobian", "forward-again", "jacobian-again"), _repeat),
    "images": (("images",), _images),
    "scenes": (("scene",), SCENES.of("sessions")),
    "paper": (("paper",), _paper),
    "ladder": (("ladder",), _ladder(0)),
    "ladder-chest": (("ladder",), _ladder(1)),
    "preparation": (("inverse",), _by_tool("a reconstruction prepared, ms")),
    "frame": (("inverse",), _frame),
    "stream": (("inverse",), _stream),
    "pipeline": (("pipeline",), _by_tool("mesh to images of 100 frames, ms")),
    "to-accuracy": (("pipeline",), _to_accuracy),
    "calibration-cost": (("calibration_cost",), _calibration),
    "measurement-cost": (("protocol_cost",), _readings),
    "event-scan": (("protocol_cost",), _event_scan),
    "effects": (("scene",), EFFECTS.of("rows")),
    "growth": (("growth",), _growth),
    "start": (("start",), _start),
    "live": (("live",), _live),
}
