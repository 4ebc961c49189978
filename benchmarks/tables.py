"""Tables in Markdown of what was measured, each for its mark in a page; see `readme`."""

import re
from collections.abc import Callable
from functools import partial

import jaxeit as je

from . import bench_paper, bench_protocol

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
    rows = [(name, row) for name, part in (("forward", forward), ("jacobian", jacobian)) for row in part["rows"]]
    nodes = sorted({row["nodes"] for _, row in rows})
    lines = ["| ms, median | " + " | ".join(f"{n:,} nodes" for n in nodes) + " |", "|---" * (1 + len(nodes)) + "|"]
    for (section, tool), label in SHOWN.items():
        found = {row["nodes"]: row["median_ms"] for kind, row in rows if (kind, row["tool"]) == (section, tool)}
        if found:
            cells = (_figures(found[n]) if n in found else "" for n in nodes)
            lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _images(results: dict) -> str:
    """Methods side by side; the image's own best estimator, or the fit."""
    lines = [
        "| method (seeds) | error, mm | inward, mm | false second | both, 30 mm | 40 mm | 40 mm, 1:3 | ms a frame |",
        "|---" * 8 + "|",
    ]
    for row in results["rows"]:
        error = min(row[f"{name}_mm"] for name in (*je.ESTIMATORS, "parametric") if f"{name}_mm" in row)
        cells = [f"{error:.1f}", f"{row['inward_mm']:.1f}", f"{100 * row['false_seconds']:.0f} %"]
        cells += [f"{100 * row[f'pairs_{pair}']:.0f} %" for pair in ("30mm_1:1", "40mm_1:1", "40mm_1:3")]
        head = f"{row['method']} ({row.get('seeds', results['seeds'])})"
        lines.append("| " + " | ".join([head, *cells, _figures(row["frame_ms"])]) + " |")
    return "\n".join(lines) + "\n"


def _scenes(results: dict) -> str:
    """What the shipped scenes cost."""
    lines = ["| scene | recording | frames | simulated in | times real time |", "|---|---|---|---|---|"]
    for row in results["sessions"]:
        lines.append(
            f"| `{row['scene']}` | {row['recording_s']:,.0f} s | {row['frames']:,} | {row['second_s']:.1f} s "
            f"| {row['times_real_time']:.0f} |"
        )
    return "\n".join(lines) + "\n"


def _pipeline(results: dict) -> str:
    """Mesh to images of 100 frames, by tool and mesh."""
    nodes = sorted({row["nodes"] for row in results["rows"]})
    lines = ["| mesh to images of 100 frames, ms | " + " | ".join(f"{n:,} nodes" for n in nodes) + " |"]
    lines.append("|---" * (1 + len(nodes)) + "|")
    for tool in dict.fromkeys(row["tool"] for row in results["rows"]):
        found = {row["nodes"]: _figures(row["median_ms"]) for row in results["rows"] if row["tool"] == tool}
        lines.append(f"| {tool.replace(', ', ', onto ')} | " + " | ".join(found.get(n, "") for n in nodes) + " |")
    return "\n".join(lines) + "\n"


def _to_accuracy(results: dict) -> str:
    """The quickest mesh of each tool that reaches an accuracy."""
    targets = list(dict.fromkeys(row["target"] for row in results["to_accuracy"]))
    heads = [f"voltages to {100 * target:g} %" for target in targets]
    lines = ["| forward, ms (unknowns) | " + " | ".join(heads) + " |", "|---" * (1 + len(targets)) + "|"]
    for kind in dict.fromkeys(row["kind"] for row in results["to_accuracy"]):
        best = [row["best"] for row in results["to_accuracy"] if row["kind"] == kind]
        cells = (f"{_figures(b['median_ms'])} ({b['unknowns']:,})" if b else "not reached" for b in best)
        lines.append(f"| {kind} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _calibration(results: dict) -> str:
    """Error of held-out forces by presses scattered over the skin, and by recipe."""
    rows = [row for row in results["presses"] if row["spread"] == "scattered" or row["presses"] == 225]
    sizes = {row["presses"]: row["minutes"] for row in rows}
    heads = [f"{n} presses, {minutes:.0f} min" for n, minutes in sorted(sizes.items())]
    lines = ["| error of held-out forces, N | " + " | ".join(heads) + " |", "|---" * (1 + len(heads)) + "|"]
    for curve, location in dict.fromkeys((row["curve"], row["location"]) for row in rows):
        found = {r["presses"]: r for r in rows if (r["curve"], r["location"]) == (curve, location)}
        cells = (f"{found[n]['hold_n']:.2f}" if "hold_n" in found[n] else "not determined" for n in sorted(sizes))
        lines.append(f"| {curve}, location {location} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _protocol(results: dict) -> str:
    """Error of place by readings of a frame, and by the way they are chosen."""
    rows = results["rows"]
    counts = sorted({row["readings"]: row["frames_per_s"] for row in rows}.items())
    heads = [f"{n} readings, {rate:,.0f} frames/s" for n, rate in counts]
    lines = ["| mean error of place, contacts fitted, mm | " + " | ".join(heads) + " |"]
    lines.append("|---" * (1 + len(counts)) + "|")
    for way in dict.fromkeys(row["way"] for row in rows):
        found = {row["readings"]: row["fit_mm"] for row in rows if row["way"] == way and row["fit_mm"] is not None}
        lines.append(f"| {way} | " + " | ".join(f"{found[n]:.2g}" if n in found else "" for n, _ in counts) + " |")
    return "\n".join(lines) + "\n"


def _growth(results: dict) -> str:
    """Fitted exponents beside the theory's."""
    lines = ["| | sizes | time grows as size to the | theory | memory | theory |", "|---" * 6 + "|"]
    for fit in results["fits"]:
        cells = [f"{fit[n]['exponent']} | {fit[n]['theory']}" for n in ("time", "memory")]
        ends = f"{fit['sizes'][0]:,} to {fit['sizes'][-1]:,}"
        lines.append(f"| {fit['series']} by {fit['of']} | {ends} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _start(results: dict) -> str:
    """Seconds of fresh processes."""
    lines = ["| fresh process | s |", "|---|---|"]
    lines += [f"| {row['start']} | {row['median_ms'] / 1e3:.2f} |" for row in results["rows"]]
    return "\n".join(lines) + "\n"


def _ladder(results: dict, skin: int) -> str:
    """The rungs of a skin that name a fidelity or lie on the front of error against time of a forward solve."""
    lines = [
        "| rung | nodes | voltages, error | a touch, error | forward, ms | Jacobian, ms | localised, mm | frame, ms |",
        "|---" * 8 + "|",
    ]
    for row in results["ladders"][skin]["rungs"]:
        if not (row["front"] or row["label"] in ("draft", "standard", "reference")):
            continue
        image = row["image"]
        cells = [f"{row['nodes']:,}", f"{100 * row['voltage_error']:.2g} %", f"{100 * row['difference_error']:.2g} %"]
        cells += [_figures(1e3 * row[name]["median"]) for name in ("forward", "jacobian")]
        cells += [f"{1e3 * image['localisation']:.2f}", _figures(1e3 * image["frame"]["median"])] if image else ["", ""]
        name = f"**{row['label']}**" if row["front"] else row["label"]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(lines) + "\n"


def _paper(results: dict) -> str:
    return bench_paper.table(results["rows"])


def _event_scan(results: dict) -> str:
    return bench_protocol.event_table(results["events"]) + "\n"


def _effects(results: dict) -> str:
    """What a program holds and takes as effects are added one by one."""
    columns = {"frame_ms": "a frame, ms", "frame_mflop": "Mflop", "frame_operations": "operations"}
    columns |= {"block_ms": "1,024 frames' histories, ms", "block_mflop": "Mflop", "block_operations": "operations"}
    lines = ["| effects | " + " | ".join(columns.values()) + " |", "|---" * (1 + len(columns)) + "|"]
    for row in results["rows"]:
        lines.append(f"| {row['effects']} | " + " | ".join(_figures(row[name]) for name in columns) + " |")
    return "\n".join(lines) + "\n"


def _figures(ms: float) -> str:
    return f"{ms:,.0f}" if ms >= 100 else f"{ms:.3g}"


TABLES: dict[str, tuple[tuple[str, ...], Callable[..., str]]] = {
    "speed": (("forward", "jacobian"), _speed),
    "images": (("images",), _images),
    "scenes": (("scene",), _scenes),
    "paper": (("paper",), _paper),
    "ladder": (("ladder",), partial(_ladder, skin=0)),
    "ladder-chest": (("ladder",), partial(_ladder, skin=1)),
    "pipeline": (("pipeline",), _pipeline),
    "to-accuracy": (("pipeline",), _to_accuracy),
    "calibration-cost": (("calibration_cost",), _calibration),
    "measurement-cost": (("protocol_cost",), _protocol),
    "event-scan": (("protocol_cost",), _event_scan),
    "effects": (("scene",), _effects),
    "growth": (("growth",), _growth),
    "start": (("start",), _start),
}
