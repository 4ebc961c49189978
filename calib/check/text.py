"""The report of `jaxeit check` as text for a terminal."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from ..session.errors import printable
from .report import ChannelTable, CheckReport, Finding, PadRow, Severity, StreamRow, counted
from .streams.clocks import beside

TEXT_WIDTH = 96
MAX_LISTED = 10  # rejected presses and readings on a page


def render(report: CheckReport, verbose: bool = False) -> str:
    """The report as text of fewer than 100 columns; ``verbose`` lists every reading of the scan."""
    parts: list[Iterable[str]] = [
        _head(report),
        findings_text(report.findings),
        _streams(report.streams),
        _pads(report.pads),
        _presses(report),
        _channels(report, verbose),
        _electrodes(report, verbose),
        _conclusion(report),
    ]
    texts = ["\n".join(lines) for lines in parts]
    return "\n\n".join(t for t in texts if t) + "\n"


def _head(report: CheckReport) -> Iterator[str]:
    title = f": {printable(report.title)}" if report.title else ""
    yield printable(report.name) + title
    marks = [f"skin {printable(report.skin)}" if report.skin else "no skin"]
    seconds = max((s.seconds for s in report.streams), default=0.0)
    marks.append(f"{seconds:.1f} s")
    marks += ["SIMULATED"] if report.simulated else []
    marks += [] if report.complete else ["NOT COMPLETE"]
    yield ", ".join(marks)


def findings_text(findings: Sequence[Finding]) -> Iterator[str]:
    """Lines of findings and of what to do about them, the worst first."""
    for finding in sorted(findings, key=lambda f: -f.severity):
        label = "note" if finding.severity is Severity.OK else finding.severity.name
        yield from _wrapped(f"{label:<8} ", f"{finding.where}: {finding.what}")
        if finding.remedy:
            yield from _wrapped("         -> ", finding.remedy)


def _wrapped(start: str, text: str) -> list[str]:
    indent = " " * len(start)
    return textwrap.wrap(printable(text, 2000), TEXT_WIDTH, initial_indent=start, subsequent_indent=indent)


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """A title and aligned columns: the first is left-aligned, the others right-aligned."""
    if not rows:
        return
    widths = [max(len(r[i]) for r in (head, *rows)) for i in range(len(head))]
    yield title
    for row in (head, *rows):
        cells = [c.rjust(w) for c, w in zip(row, widths, strict=True)]
        cells[0] = row[0].ljust(widths[0])
        yield ("  " + "  ".join(cells)).rstrip()


def _number(value: float, form: str = ".4g") -> str:
    return format(value, form) if math.isfinite(value) else "-"


def _percent(fraction: float) -> str:
    if not math.isfinite(fraction):
        return "-"
    return "0 %" if fraction == 0 else "<0.1 %" if fraction < 0.0005 else f"{100 * fraction:.1f} %"


def _streams(rows: Sequence[StreamRow]) -> Iterator[str]:
    head = ("name", "unit", "channels", "samples", "rate Hz", "nominal", "gaps", "dropped")
    cells = [
        (
            printable(r.name, 16),
            r.unit,
            str(r.channels),
            str(r.samples),
            _number(r.rate),
            _number(r.nominal_rate),
            str(r.gaps),
            str(r.dropped),
            _number(1e3 * r.jitter, ".2f"),
            _percent(r.missing),
        )
        for r in rows
    ]
    yield from _table("Streams", (*head, "jitter ms", "missing"), cells)


def _pads(rows: Sequence[PadRow]) -> Iterator[str]:
    head = ("pad", "column", "lowest Pa", "highest Pa", "full scale", "missing", "")
    cells = [
        (
            printable(r.name, 24),
            str(r.column),
            _number(r.low, ".1f"),
            _number(r.high, ".1f"),
            _percent(r.full_scale),
            _percent(r.missing),
            "DEAD" if r.dead else "",
        )
        for r in rows
    ]
    yield from _table("Pads", head, cells)


SOURCE_TEXTS = {
    "table": "listed in the file",
    "force": "detected in the force stream, because the file lists none",
    "none": "none listed, and no force stream to detect them in",
}


def _presses(report: CheckReport) -> Iterator[str]:
    presses = report.presses
    total = presses.accepted + len(presses.rejected)
    if presses.source == "none":
        yield f"Presses  {SOURCE_TEXTS['none']}"
        return
    yield f"Presses  {presses.accepted} of {total} usable ({SOURCE_TEXTS[presses.source]})"
    for number, reason in presses.rejected[:MAX_LISTED]:
        yield f"  press {number}: {printable(reason)}"
    if len(presses.rejected) > MAX_LISTED:
        yield f"  ... and {len(presses.rejected) - MAX_LISTED} more"
    for name, onset in report.onsets:
        if onset.presses:
            yield (
                f"  {printable(name, 16)} rises {beside(onset.delay)} the force "
                f"(spread {1e3 * onset.spread:.0f} ms, {counted(onset.presses, 'press', 'presses')})"
            )


def _channels(report: CheckReport, verbose: bool) -> Iterator[str]:
    table = report.channels
    if table is None:
        return
    yield (
        f"EIT      {len(table)} readings, {table.frames} frames without contact: "
        f"median SNR {_number(_median(table.snr), '.1f')} dB, "
        f"{_reciprocity(table)}"
    )
    empty = f"{table.empty.sum()} empty by the model, " if table.empty.any() else ""
    yield (
        f"         {table.dead.sum()} dead, {table.saturated.sum()} saturated, "
        f"{table.noisy.sum()} noisy, {empty}{(table.missing > 0).sum()} with missing values"
    )
    order = report.order
    if order is not None:
        yield (
            f"         correlation with a uniform sheet {order.as_is:.3f} as recorded, "
            f"amplitude {_number(order.scale, '.3g')} of the model's"
        )
    rows = np.arange(len(table)) if verbose else worst(table)
    title = "  all readings" if verbose else f"  the worst {len(rows)} of the working ones (all: --all)"
    yield from _table(title, CHANNEL_COLUMNS, [_channel(table, int(i)) for i in rows])


def _electrodes(report: CheckReport, verbose: bool) -> Iterator[str]:
    rows = [row for row in report.electrodes if verbose or row.elsewhere]
    cells = [
        (str(row.electrode), *(f"{1e3 * value:+.2f}" for value in (row.x, row.y)), f"{1e3 * row.error:.2f}")
        for row in rows
    ]
    title = "Electrodes, from their places in the skin's file"
    yield from _table(title, ("electrode", "x mm", "y mm", "standard error mm"), cells)


def _reciprocity(table: ChannelTable) -> str:
    if (table.partner < 0).all():
        return "reciprocity not tested: no two readings exchange drive and sense"
    return f"reciprocity error {_percent(_median(table.reciprocity))}"


CHANNEL_COLUMNS = ("  reading", "drive", "sense", "mean mV", "SNR dB", "reciprocity", "missing", "")


def _terminals(table: ChannelTable, i: int) -> tuple[str, str]:
    """Drive and sense of a reading: the pair of electrodes, or how many pairs the reading is a sum of."""
    rows = table.pattern[[i] if table.mixing is None else table.mixing[[i]].indices]
    pairs = (np.unique(part, axis=0) for part in (rows[:, :2], rows[:, 2:]))
    drive, sense = (f"{p[0, 0]}-{p[0, 1]}" if len(p) == 1 else f"{len(p)} pairs" for p in pairs)
    return drive, sense


def _channel(table: ChannelTable, i: int) -> tuple[str, ...]:
    names = ("dead", "saturated", "noisy", "empty")
    return (
        f"  {i}",
        *_terminals(table, i),
        _number(1e3 * table.mean[i], ".4f"),
        _number(table.snr[i], ".1f"),
        _percent(table.reciprocity[i]),
        _percent(table.missing[i]),
        " ".join(n for n in names if getattr(table, n)[i]),
    )


def worst(table: ChannelTable, count: int = MAX_LISTED) -> np.ndarray:
    """Readings to look at first: flagged, then by missing samples and reciprocity error; last dead and empty ones."""
    flagged = 2 * table.saturated + 1 * table.noisy
    keys = (-np.nan_to_num(table.reciprocity), -table.missing.round(3), -flagged, table.dead | table.empty)
    return np.lexsort(keys)[:count]


def _median(values: np.ndarray) -> float:
    good = values[np.isfinite(values)]
    return float(np.median(good)) if len(good) else math.nan


def _conclusion(report: CheckReport) -> Iterator[str]:
    errors, warnings = report.count(Severity.ERROR), report.count(Severity.WARNING)
    lacks = " and ".join(_lacks(report))
    if not errors and not warnings:
        yield from _wrapped("", "Nothing wrong was found." + (f" A calibration needs {lacks} too." if lacks else ""))
        return
    counts = [counted(errors, "error"), counted(warnings, "warning")]
    usable = f"It can be used; a calibration needs {lacks} too." if lacks else "It can be calibrated."
    end = "Correct the errors before the calibration." if errors else usable
    yield from _wrapped("", ", ".join(c for c in counts if c) + ". " + end)


def _lacks(report: CheckReport) -> Iterator[str]:
    """What a calibration needs and the session has not. A log without EIT needs the force alone."""
    names = {stream.name for stream in report.streams}
    if "force" not in names:
        yield "the force"
    if "eit" not in names:
        return
    if "pressure" not in names:
        yield "the pressures of the pads"
    if "force" in names and not report.presses.accepted:
        yield "presses"
    if "stage" not in names and report.presses.source != "table":
        yield "the places of the presses (a stream named stage, or a table of presses)"
