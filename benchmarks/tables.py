"""Tables in Markdown of what was measured, each for its mark in a page; see `readme`."""

import re
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import jaxeit as je

from . import bench_inverse, bench_paper, bench_protocol
from .repeat import compared

SHOWN = {
    ("forward", "jaxeit float64"): "forward, jaxeit",
    ("forward", "CHOLMOD by hand"): "forward, CHOLMOD driven by hand",
    ("forward", "SuperLU by hand"): "forward, SuperLU driven by hand",
    ("forward", "EIDORS"): "forward, EIDORS",
    ("forward", "pyEIT"): "forward, pyEIT",
    ("jacobian", "jaxeit float64, pixels"): "Jacobian onto 900 pixels, jaxeit",
    ("jacobian", "adjoint by hand, pixels"): "Jacobian onto 900 pixels, adjoint formula by hand",
    ("jacobian", "EIDORS, pixels"): "Jacobian onto 900 pixels, EIDORS",
}
PAPER = {"localisation": "6.9 mm (estimator not stated)", "eit": "0.31", "hybrid": "0.14"}


def filled(page: str, measured: dict) -> str:
    """A page with the tables between its marks written anew; those whose benchmark has not run stay as they are."""
    for mark, (sections, table) in TABLES.items():
        if f"<!-- {mark}:" in page and all(name in measured for name in sections):
            page = replaced(page, mark, table(*(measured[name] for name in sections)))
    return page


def replaced(page: str, mark: str, table: str) -> str:
    """A page with a table between ``<!-- mark: ... -->`` and ``<!-- end of mark -->``."""
    pattern = rf"(<!-- {mark}:.*?-->\n).*?(<!-- end of {mark} -->)"
    return re.sub(pattern, lambda m: m[1] + table + m[2], page, flags=re.DOTALL)


def evaluation(s: dict[str, float]) -> str:
    """What a calibration of the bundled session says of itself, beside the paper."""
    rows = [
        f"| localisation error, {label}, mean | {1e3 * s[f'localisation_{name}_mean']:.1f} ± "
        f"{1e3 * s[f'localisation_{name}_mean_se']:.1f} mm | {PAPER['localisation'] if name == 'quarter' else ''} |"
        for name, label in {**{n: f"{n} estimator" for n in je.ESTIMATORS}, "fitted": "contacts fitted"}.items()
    ]
    rows += [
        f"| coefficient of variation of sensitivity, {label} | {s[f'cv_{name}_ddof1']:.3f} ± {s[f'cv_{name}_se']:.3f} "
        f"| {PAPER.get(name, '')} |"
        for name, label in (
            ("eit", "EIT only"),
            ("hybrid", "hybrid, the paper's recipe"),
            ("calibrated", "hybrid, corrected for the contact's place"),
        )
    ]
    rows += [
        f"| force error on presses held out by place, RMSE, {label} | {s[f'force_{mark}rmse']:.2f} N, "
        f"{s[f'force_{mark}rmse_percent_full_scale']:.1f} % of 20 N | |"
        for mark, label in (("hybrid_", "the paper's recipe"), ("", "corrected for the place"))
    ]
    head = "| simulated, 225 presses | this run, ± SE over places | the paper, on hardware |\n|---|---|---|\n"
    return head + "\n".join(rows) + "\n"


def _speed(forward: dict, jacobian: dict) -> str:
    """Medians in ms by tool and mesh, forward solves and Jacobians onto pixels."""
    runs = [(name, row) for name, part in (("forward", forward), ("jacobian", jacobian)) for row in part["rows"]]
    nodes = sorted({row["nodes"] for _, row in runs})
    rows = []
    for (section, tool), label in SHOWN.items():
        found = {row["nodes"]: row["median_ms"] for kind, row in runs if (kind, row["tool"]) == (section, tool)}
        if found:
            rows.append([label, *(_figures(found[n]) if n in found else "" for n in nodes)])
    return _markdown(["ms, median", *(f"{n:,} nodes" for n in nodes)], rows)


def _repeat(*runs: dict) -> str:
    """Whether the ratios between the times of `_speed` came out alike in two runs; in words."""
    kinds = ("forward", "jacobian", "forward", "jacobian")
    quoted = [
        [row for row in run["rows"] if (kind, row["tool"]) in SHOWN] for kind, run in zip(kinds, runs, strict=True)
    ]
    found = [one for first, second in zip(quoted[:2], quoted[2:], strict=True) for one in compared(first, second)]
    change = max(abs(one.second.value / one.first.value - 1) for one in found)
    agree = sum(one.agrees for one in found)
    return (
        f"Measured a second time, {agree} of the {len(found)} ratios of these times to jaxeit's lie within the spread "
        f"of the other run; the largest change is {100 * change:.0f} %.\n"
    )


def _images(results: dict) -> str:
    """Methods side by side; the image's own best estimator, or the fit."""
    heads = [
        "method (seeds)",
        "error, mm",
        "inward, mm",
        "false second",
        "both, 30 mm",
        "40 mm",
        "40 mm, 1:3",
        "ms a frame",
    ]
    rows = []
    for row in results["rows"]:
        error = min(row[f"{name}_mm"] for name in (*je.ESTIMATORS, "parametric") if f"{name}_mm" in row)
        cells = [f"{error:.1f}", f"{row['inward_mm']:.1f}", f"{100 * row['false_seconds']:.0f} %"]
        cells += [f"{100 * row[f'pairs_{pair}']:.0f} %" for pair in ("30mm_1:1", "40mm_1:1", "40mm_1:3")]
        head = f"{row['method']} ({row.get('seeds', results['seeds'])})"
        rows.append([head, *cells, _figures(row["frame_ms"])])
    return _markdown(heads, rows)


def _scenes(results: dict) -> str:
    """What the shipped scenes cost."""
    rows = []
    for row in results["sessions"]:
        cells = [f"{row['recording_s']:,.0f} s", f"{row['frames']:,}", f"{row['second_s']:.1f} s"]
        rows.append([f"`{row['scene']}`", *cells, f"{row['times_real_time']:.0f}"])
    return _markdown(["scene", "recording", "frames", "simulated in", "times real time"], rows)


def _pipeline(results: dict) -> str:
    """Mesh to images of 100 frames, by tool and mesh."""
    return _by_tool("mesh to images of 100 frames, ms", results["rows"])


def _preparation(results: dict) -> str:
    """Conductivity to reconstructor, by tool and mesh."""
    return _by_tool("a reconstruction prepared, ms", results["rows"])


def _by_tool(head: str, measured: Sequence[dict]) -> str:
    nodes = sorted({row["nodes"] for row in measured})
    rows = []
    for tool in dict.fromkeys(row["tool"] for row in measured):
        found = {row["nodes"]: _figures(row["median_ms"]) for row in measured if row["tool"] == tool}
        rows.append([tool.replace(", ", ", onto "), *(found.get(n, "") for n in nodes)])
    return _markdown([head, *(f"{n:,} nodes" for n in nodes)], rows)


def _frame(results: dict) -> str:
    """One frame to its image: in a stream of frames, after other work, and in a batch."""
    stream, after, batch = (
        {row["way"]: row for row in results["application"][kind]}
        for kind in (bench_inverse.SINGLE, bench_inverse.AFTER_WORK, bench_inverse.BATCH)
    )
    heads = ["ms a frame", *(f"{p}{when}" for when in ("", ", after other work") for p in ("p50", "p99", "most"))]
    rows = []
    for way, row in stream.items():
        times = [f"{one[f'{p}_ms']:.3f}" if one else "" for one in (row, after.get(way)) for p in ("p50", "p99", "max")]
        together = f"{batch[way]['p50_ms']:.4f}" if way in batch else ""
        rows.append([way, *times, together, f"{row['least_ms']:.3f}"])
    return _markdown([*heads, "1,000 together", "as many bytes copied"], rows)


def _stream(results: dict) -> str:
    """Frames one after the other, so many that those which take long can be counted."""
    rows = results["application"][bench_inverse.STREAM]
    heads = ["ms a frame", "frames", *PERCENTILES, f"above {bench_inverse.GOAL_MS} ms"]
    cells = ([f"{row[f'{p}_ms']:.3f}" for p in PERCENTILES] for row in rows)
    return _markdown(
        heads, [[r["way"], f"{r['calls']:,}", *c, f"{r['above']:,}"] for r, c in zip(rows, cells, strict=True)]
    )


PERCENTILES = ("p50", "p99", "p99.9")


def _to_accuracy(results: dict) -> str:
    """The quickest mesh of each tool that reaches an accuracy."""
    targets = list(dict.fromkeys(row["target"] for row in results["to_accuracy"]))
    heads = [f"voltages to {100 * target:g} %" for target in targets]
    rows = []
    for kind in dict.fromkeys(row["kind"] for row in results["to_accuracy"]):
        best = [row["best"] for row in results["to_accuracy"] if row["kind"] == kind]
        cells = (f"{_figures(b['median_ms'])} ({b['unknowns']:,})" if b else "not reached" for b in best)
        rows.append([kind, *cells])
    return _markdown(["forward, ms (unknowns)", *heads], rows)


def _calibration(results: dict) -> str:
    """Error of held-out forces by presses scattered over the skin, and by recipe."""
    fits = [row for row in results["presses"] if row["spread"] == "scattered" or row["presses"] == 225]
    sizes = {row["presses"]: row["minutes"] for row in fits}
    heads = [f"{n} presses, {minutes:.0f} min" for n, minutes in sorted(sizes.items())]
    rows = []
    for curve, location in dict.fromkeys((row["curve"], row["location"]) for row in fits):
        found = {r["presses"]: r for r in fits if (r["curve"], r["location"]) == (curve, location)}
        cells = (f"{found[n]['hold_n']:.2f}" if "hold_n" in found[n] else "not determined" for n in sorted(sizes))
        rows.append([f"{curve}, location {location}", *cells])
    return _markdown(["error of held-out forces, N", *heads], rows)


def _protocol(results: dict) -> str:
    """Error of place by readings of a frame, and by the way they are chosen."""
    tried = results["rows"]
    counts = sorted({row["readings"]: row["frames_per_s"] for row in tried}.items())
    heads = [f"{n} readings, {rate:,.0f} frames/s" for n, rate in counts]
    rows = []
    for way in dict.fromkeys(row["way"] for row in tried):
        found = {row["readings"]: row["fit_mm"] for row in tried if row["way"] == way and row["fit_mm"] is not None}
        rows.append([way, *(f"{found[n]:.2g}" if n in found else "" for n, _ in counts)])
    return _markdown(["mean error of place, contacts fitted, mm", *heads], rows)


def _growth(results: dict) -> str:
    """Fitted exponents beside the theory's."""
    rows = []
    for fit in results["fits"]:
        cells = [str(fit[n][what]) for n in ("time", "memory") for what in ("exponent", "theory")]
        ends = f"{fit['sizes'][0]:,} to {fit['sizes'][-1]:,}"
        rows.append([f"{fit['series']} by {fit['of']}", ends, *cells])
    return _markdown(["work", "sizes", "time grows as size to the", "theory", "memory", "theory"], rows)


def _start(results: dict) -> str:
    """Seconds of fresh processes."""
    rows = [[row["start"], f"{row['median_ms'] / 1e3:.2f}"] for row in results["rows"]]
    return _markdown(["fresh process", "s"], rows)


def _ladder(results: dict, skin: int) -> str:
    """The rungs of a skin that name a fidelity or lie on the front of error against time of a forward solve."""
    heads = [
        "rung",
        "nodes",
        "voltages, error",
        "a touch, error",
        "forward, ms",
        "Jacobian, ms",
        "localised, mm",
        "frame, ms",
    ]
    rows = []
    for row in results["ladders"][skin]["rungs"]:
        if not (row["front"] or row["label"] in ("draft", "standard", "reference")):
            continue
        image = row["image"]
        cells = [f"{row['nodes']:,}", f"{100 * row['voltage_error']:.2g} %", f"{100 * row['difference_error']:.2g} %"]
        cells += [_figures(1e3 * row[name]["median"]) for name in ("forward", "jacobian")]
        cells += [f"{1e3 * image['localisation']:.2f}", _figures(1e3 * image["frame"]["median"])] if image else ["", ""]
        name = f"**{row['label']}**" if row["front"] else row["label"]
        rows.append([name, *cells])
    return _markdown(heads, rows)


def _paper(results: dict) -> str:
    return bench_paper.table(results["rows"])


def _event_scan(results: dict) -> str:
    return bench_protocol.event_table(results["events"]) + "\n"


def _effects(results: dict) -> str:
    """What a program holds and takes as effects are added one by one."""
    columns = {"frame_ms": "a frame, ms", "frame_mflop": "Mflop", "frame_operations": "operations"}
    columns |= {"block_ms": "1,024 frames' histories, ms", "block_mflop": "Mflop", "block_operations": "operations"}
    rows = [[row["effects"], *(_figures(row[name]) for name in columns)] for row in results["rows"]]
    return _markdown(["effects", *columns.values()], rows)


def _live(results: dict) -> str:
    """What came over loopback, and when it was shown."""
    soak, tenfold = results["soak"], results["tenfold"]
    best = [row for row in results["rates"] if row["rate_hz"] == results["highest_hz"] and row["sustained"]]
    heads = ["run", "frames", "lost", "dropped", *(f"latency {p}, ms" for p in ("p50", "p99", "max"))]
    heads += ["beyond the scan, p99, ms", "a sleeper wakes late, p99, ms", "memory, MB an hour"]
    long = f"live and recorded, {soak['rate_hz']} Hz, {soak['seconds'] / 60:.0f} min"
    rows = [
        _live_row(long, soak),
        *([_live_row(long + ", `--realtime`", results["soak_realtime"])] if "soak_realtime" in results else []),
        *(_live_row(f"live, highest rate sustained: {row['rate_hz']} Hz", row) for row in best),
        [
            f"recorded, {tenfold['rate_hz']} Hz, {tenfold['seconds'] / 60:.0f} min",
            f"{tenfold['recorded'][0]:,}",
            f"{tenfold['lost'][0]:,}",
            *[""] * 6,
            _grown(tenfold),
        ],
    ]
    return _markdown(heads, rows)


def _live_row(label: str, row: dict) -> list[str]:
    cells = [f"{row['received'][0]:,}", f"{row['lost']:,}", f"{row['dropped']:,}"]
    cells += [_figures(row[f"latency_ms_{p}"]) for p in ("p50", "p99", "max")]
    return [label, *cells, _figures(row["since_due_ms_p99"]), _figures(row["woken_ms_p99"]), _grown(row)]


def _grown(row: dict) -> str:
    name = "memory_mb_per_hour"
    return f"{row[name]:.2f} ± {row[f'{name}_error']:.2f}" if name in row else ""


def _markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def _figures(ms: float) -> str:
    return f"{ms:,.0f}" if ms >= 100 else f"{ms:.3g}"


TABLES: dict[str, tuple[tuple[str, ...], Callable[..., str]]] = {
    "speed": (("forward", "jacobian"), _speed),
    "repeat": (("forward", "jacobian", "forward-again", "jacobian-again"), _repeat),
    "images": (("images",), _images),
    "scenes": (("scene",), _scenes),
    "paper": (("paper",), _paper),
    "ladder": (("ladder",), partial(_ladder, skin=0)),
    "ladder-chest": (("ladder",), partial(_ladder, skin=1)),
    "preparation": (("inverse",), _preparation),
    "frame": (("inverse",), _frame),
    "stream": (("inverse",), _stream),
    "pipeline": (("pipeline",), _pipeline),
    "to-accuracy": (("pipeline",), _to_accuracy),
    "calibration-cost": (("calibration_cost",), _calibration),
    "measurement-cost": (("protocol_cost",), _protocol),
    "event-scan": (("protocol_cost",), _event_scan),
    "effects": (("scene",), _effects),
    "growth": (("growth",), _growth),
    "start": (("start",), _start),
    "live": (("live",), _live),
}
