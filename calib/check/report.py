"""What `jaxeit check` found: the nouns, as a page of text, and as JSON."""

import enum
import json
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass

import numpy as np

from calib.check.order import OrderCheck
from calib.presses import Onset
from calib.session.model import printable

_WIDTH = 96
_WORST = 10


class Severity(enum.IntEnum):
    """OK is worth knowing, WARNING worth a look, an ERROR spoils a calibration."""

    OK = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True)
class Finding:
    """One sentence about a recording: where in it, what, and what to do."""

    severity: Severity
    where: str
    what: str
    remedy: str = ""


@dataclass(frozen=True)
class StreamRow:
    """One stream. Rates in Hz; ``rate`` is found from time stamps and NaN below two samples.

    ``gaps`` are longer than one and a half periods; ``longest_gap`` in s; ``dropped`` samples are
    counted from sequence numbers where there are any, else estimated from the gaps; ``jitter`` is
    the 95 % quantile of the deviation of intervals from their median, gaps apart, in s; ``missing``
    is a fraction of all values; ``flags`` counts samples by status flag.
    """

    name: str
    variable: str
    unit: str
    channels: int
    samples: int
    seconds: float
    nominal_rate: float
    rate: float
    gaps: int
    longest_gap: float
    dropped: int
    jitter: float
    missing: float
    flags: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class PadRow:
    """One column of the pressure stream: ``low`` and ``high`` in Pa, the rest fractions and flags.

    ``full_scale`` is the fraction of samples at the sensor's upper end.
    """

    column: int
    name: str
    low: float
    high: float
    missing: float
    full_scale: float
    dead: bool


@dataclass(frozen=True, eq=False)
class ChannelTable:
    """EIT readings of the untouched skin; every array has one entry per reading.

    | meaning                                                                 | unit |
    |-------------------------------------------------------------------------|------|
    | pattern: drive+, drive-, sense+, sense-; (readings, 4)                  |      |
    | mean, noise: over `frames` frames without contact                       | V    |
    | snr: 20 log10(|mean| / noise)                                           | dB   |
    | partner: the reciprocal reading, -1 for none                            |      |
    | reciprocity: difference to it, over the larger of the two (or a tenth    |      |
    |   of the rms reading, if that is larger); NaN where there is none        |      |
    | missing: fraction of all samples                                        |      |
    | dead, saturated, noisy: flags                                           |      |
    """

    frames: int
    pattern: np.ndarray
    mean: np.ndarray
    noise: np.ndarray
    snr: np.ndarray
    partner: np.ndarray
    reciprocity: np.ndarray
    missing: np.ndarray
    dead: np.ndarray
    saturated: np.ndarray
    noisy: np.ndarray

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def bad(self) -> np.ndarray:
        """Readings with any flag."""
        return self.dead | self.saturated | self.noisy


@dataclass(frozen=True)
class PressSummary:
    """Where the presses come from ("table", "force" or "none"), and those set aside by reason."""

    source: str
    accepted: int
    rejected: tuple[tuple[int, str], ...]


@dataclass(frozen=True, eq=False)
class CheckReport:
    """All that `check_session` has to say; ``ok`` is False if any finding is an error."""

    name: str
    title: str
    skin: str
    simulated: bool
    complete: bool
    findings: tuple[Finding, ...]
    streams: tuple[StreamRow, ...]
    pads: tuple[PadRow, ...]
    channels: ChannelTable | None
    order: OrderCheck | None
    presses: PressSummary
    onsets: tuple[tuple[str, Onset], ...]

    @property
    def ok(self) -> bool:
        """Whether nothing found spoils a calibration."""
        return all(f.severity < Severity.ERROR for f in self.findings)

    def count(self, severity: Severity) -> int:
        """Number of findings of one severity."""
        return sum(f.severity == severity for f in self.findings)


# --- JSON ----------------------------------------------------------------------------------------


def to_json(report: CheckReport) -> str:
    """The whole report as JSON; the same report gives the same text. NaN becomes null."""
    body = {"format": "skin-check", "ok": report.ok, **_plain(report)}
    return json.dumps(body, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)


def _plain(value):
    if isinstance(value, Severity):
        return value.name
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


# --- text ----------------------------------------------------------------------------------------


def render(report: CheckReport, verbose: bool = False) -> str:
    """The report for a terminal, below 100 columns; ``verbose`` lists every reading of the scan."""
    parts: list[Iterable[str]] = [
        _head(report),
        _findings(report.findings),
        _streams(report.streams),
        _pads(report.pads),
        _presses(report),
        _channels(report, verbose),
        _verdict(report),
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
    marks += [] if report.complete else ["INTERRUPTED"]
    yield ", ".join(marks)


def _findings(findings: Sequence[Finding]) -> Iterator[str]:
    for finding in sorted(findings, key=lambda f: -f.severity):
        label = "note" if finding.severity is Severity.OK else finding.severity.name
        yield from _wrapped(f"{label:<8} ", f"{finding.where}: {finding.what}")
        if finding.remedy:
            yield from _wrapped("         -> ", finding.remedy)


def _wrapped(start: str, text: str) -> list[str]:
    indent = " " * len(start)
    return textwrap.wrap(printable(text, 2000), _WIDTH, initial_indent=start, subsequent_indent=indent)


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """A title and aligned columns: the first to the left, the others to the right."""
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


_SOURCES = {
    "table": "listed in the file",
    "force": "found from the force stream, as the file lists none",
    "none": "none listed, and no force stream to find them from",
}


def _presses(report: CheckReport) -> Iterator[str]:
    presses = report.presses
    total = presses.accepted + len(presses.rejected)
    if presses.source == "none":
        yield f"Presses  {_SOURCES['none']}"
        return
    yield f"Presses  {presses.accepted} of {total} usable ({_SOURCES[presses.source]})"
    for number, reason in presses.rejected[:_WORST]:
        yield f"  press {number}: {printable(reason)}"
    if len(presses.rejected) > _WORST:
        yield f"  ... and {len(presses.rejected) - _WORST} more"
    for name, onset in report.onsets:
        if onset.presses:
            yield (
                f"  {printable(name, 16)} rises {round(1e3 * onset.delay):+d} ms after the force "
                f"(spread {1e3 * onset.spread:.0f} ms, {counted(onset.presses, 'press', 'presses')})"
            )


def _channels(report: CheckReport, verbose: bool) -> Iterator[str]:
    table = report.channels
    if table is None:
        return
    yield (
        f"EIT      {len(table)} readings, {table.frames} frames without contact: "
        f"median SNR {_number(_median(table.snr), '.1f')} dB, "
        f"reciprocity error {_percent(_median(table.reciprocity))}"
    )
    yield (
        f"         {table.dead.sum()} dead, {table.saturated.sum()} saturated, "
        f"{table.noisy.sum()} noisy, {(table.missing > 0).sum()} with missing values"
    )
    order = report.order
    if order is not None:
        yield (
            f"         correlation with a uniform sheet {order.as_is:.3f} as recorded, "
            f"amplitude {_number(order.scale, '.3g')} of the model's"
        )
    rows = np.arange(len(table)) if verbose else worst(table)
    title = "  all readings" if verbose else f"  the worst {len(rows)} that live (all: --all)"
    yield from _table(title, _CHANNEL_HEAD, [_channel(table, int(i)) for i in rows])


_CHANNEL_HEAD = ("  reading", "drive", "sense", "mean mV", "SNR dB", "reciprocity", "missing", "")


def _channel(table: ChannelTable, i: int) -> tuple[str, ...]:
    drive, sense = table.pattern[i, :2], table.pattern[i, 2:]
    names = ("dead", "saturated", "noisy")
    return (
        f"  {i}",
        f"{drive[0]}-{drive[1]}",
        f"{sense[0]}-{sense[1]}",
        _number(1e3 * table.mean[i], ".4f"),
        _number(table.snr[i], ".1f"),
        _percent(table.reciprocity[i]),
        _percent(table.missing[i]),
        " ".join(n for n in names if getattr(table, n)[i]),
    )


def worst(table: ChannelTable, count: int = _WORST) -> np.ndarray:
    """Living readings to look at first: flagged, with most missing, by reciprocity error; then the dead."""
    flagged = 2 * table.saturated + 1 * table.noisy
    keys = (-np.nan_to_num(table.reciprocity), -table.missing.round(3), -flagged, table.dead)
    return np.lexsort(keys)[:count]


def _median(values: np.ndarray) -> float:
    good = values[np.isfinite(values)]
    return float(np.median(good)) if len(good) else math.nan


def _verdict(report: CheckReport) -> Iterator[str]:
    errors, warnings = report.count(Severity.ERROR), report.count(Severity.WARNING)
    if not errors and not warnings:
        yield "Nothing wrong was found."
        return
    counts = [counted(errors, "error"), counted(warnings, "warning")]
    end = "Mend the errors before calibrating." if errors else "It can be calibrated."
    yield ", ".join(c for c in counts if c) + ". " + end


def counted(count: int, noun: str, plural: str = "") -> str:
    """ "1 gap", "2 gaps", or nothing for none."""
    return f"{count} {(plural or noun + 's') if count > 1 else noun}" if count else ""
