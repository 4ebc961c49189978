"""A calibration as one HTML page that needs nothing else, with the paper's figures beside it."""

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from types import MappingProxyType

import numpy as np

from .calibration import Calibration
from .choice import Candidate
from .evaluation import CALIBRATED, METHODS, Evaluation
from .figures import (
    ESTIMATOR_MEANING,
    curves_figure,
    gain_figure,
    has_loops,
    localisation_figure,
    loops_figure,
    png,
    require_matplotlib,
    sensitivity_figure,
    sensitivity_maps,
)
from .location import FittedField, field_name
from .session import replacing

_NO_EVALUATIONS: Mapping[str, Evaluation] = MappingProxyType({})
_HEADLINES = ("quarter", "fitted")  # the image's estimator nearest to the paper's figure, and what the field goes by


def write_report(
    calibration: Calibration,
    path: str | Path,
    *,
    evaluations: Mapping[str, Evaluation] = _NO_EVALUATIONS,
) -> list[Path]:
    """Write the page and, beside it, its figures as PNG; each file whole or not at all.

    Args:
        calibration: what the page is about.
        path: of the page; for ``report.html`` the figures are ``report_localisation.png``,
            ``report_sensitivity.png`` and ``report_curves.png``, of presses that were released also
            ``report_loops.png``, with a correction by location ``report_gain.png``.
        evaluations: of the calibration on other sessions, by name.

    Returns: the paths written, the page first.

    Raises:
        ReportError: matplotlib is not installed.
        SessionError, OSError: a file cannot be written.
    """
    require_matplotlib()
    page = Path(path)
    figures = _figures(calibration, evaluations)
    text = _page(calibration, evaluations, figures)
    pictures = [page.with_name(f"{page.stem}_{figure.name}.png") for figure in figures]
    for target, figure in zip(pictures, figures, strict=True):
        _write(target, figure.data)
    _write(page, text.encode())
    return [page, *pictures]


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(data)


# --- figures -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Picture:
    """A PNG file with its title, what it shows for who cannot see it, and what to look for; `single`: of one panel."""

    name: str
    title: str
    data: bytes
    alt: str
    caption: str
    single: bool = False


def _figures(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> list[_Picture]:
    found, skin, simulated = calibration.evaluation, calibration.skin, calibration.simulated
    estimators = [name for name in _HEADLINES if name in found.estimated] or list(found.estimated)[:1]
    localisation = localisation_figure(found, skin, *estimators, simulated=simulated)
    sensitivity = sensitivity_figure(found, skin, simulated=simulated)
    curves = curves_figure(calibration, evaluations)
    about, single = _about_localisation(found, estimators), len(estimators) == 1
    pictures = [
        _Picture("localisation", "Localisation", png(localisation), *about, single),
        _Picture("sensitivity", "Sensitivity over the sheet", png(sensitivity), *_about_sensitivity(found)),
        _Picture("curves", "Curves and force errors", png(curves), *_about_curves(calibration, evaluations)),
    ]
    if has_loops(calibration):
        pictures.append(_Picture("loops", "Hysteresis", png(loops_figure(calibration)), *_about_loops(calibration)))
    if calibration.field is not None:
        gain = png(gain_figure(calibration))
        pictures.append(_Picture("gain", "Gain by location", gain, *_about_gain(calibration.field)))
    return pictures


def _about_localisation(evaluation: Evaluation, estimators: Sequence[str]) -> tuple[str, str]:
    s = evaluation.summary()
    means = (f"{_number(1e3 * s[f'localisation_{e}_mean'], 1)} mm by the estimator {e}" for e in estimators)
    inward = 1e3 * s[f"localisation_{estimators[0]}_inward_bias"]
    alt = (
        f"Map of the sheet with true and estimated positions of {len(evaluation.force)} presses; "
        f"mean error {', '.join(means)}."
    )
    caption = (
        "True positions of the tip are black, estimated ones red; green circles are the electrodes, dark lines the "
        "outlines of the pads. Look for lines that all point one way: towards the centre they are the inward shift "
        f"of presses near the rim ({_number(inward, 1)} mm on average by {estimators[0]}, positive is inward); all in "
        "parallel they are an offset between the stage and the sheet; swapped or mirrored regions are electrodes in "
        "another order."
    )
    return alt, caption


def _about_sensitivity(evaluation: Evaluation) -> tuple[str, str]:
    s, maps = evaluation.summary(), sensitivity_maps(evaluation)
    spreads = [f"{METHODS[name]} {_number(s.get(f'cv_{name}_ddof1', math.nan), 3)}" for name in maps]
    alt = (
        f"{len(maps)} maps of sensitivity over its mean at every place pressed; coefficients of variation: "
        f"{', '.join(spreads)}."
    )
    caption = (
        "The same newton reads high where the map is red and low where it is blue; the maps share one colour scale, "
        "which is cut at the largest 2 % of the values. Look for a blue rim in EIT only (fewer electrodes see it), for "
        "patches (uneven coating or contact), and in hybrid for lines along the edges of pads, where the stiff "
        "border carries part of the load or two pads share it. The hybrid map shows the pads and their curves, not the "
        "image: a force map sums to the pad's force whatever the image is."
    )
    if CALIBRATED in maps:
        caption += f" Calibrated is this calibration itself: {evaluation.recipe}."
    return alt, caption


def _about_curves(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> tuple[str, str]:
    alt = (
        f"Pressure-force curves of {len(calibration.skin.pads)} pads with their presses; a map of force errors over "
        "the sheet; force errors against force and in the order of the presses."
    )
    caption = (
        "Top: the curve of each pad over the pressures fitted, with the 95 % band of the curve itself (1.96 standard "
        "errors; single presses scatter more), and the means over the hold of presses that this pad carried to 90 % "
        "or more. The curve is fitted to whole presses, loading to release. Points in groups beside the curve are "
        f"places that respond differently. {_about_structure(calibration)}; a slope or bend over force asks for "
        "another curve; a trend or a step over time is drift." + _one_level(calibration.evaluation, bool(evaluations))
    )
    return alt, caption


def _about_loops(calibration: Calibration) -> tuple[str, str]:
    loops = calibration.loops
    assert loops is not None
    widths = [loops.width(pad) for pad in range(len(calibration.skin.pads))]
    said = ", ".join(f"{_number(width, 2)} N" for width in widths)
    alt = f"Force against pressure along one press of each pad; mean of loading over unloading: {said}."
    law = "the law's own loop" if calibration.curves.curve.path else "one line for both ways, as this law has no memory"
    caption = (
        "Of each pad the whole press of median stiffness among those at nearly its largest force. Black is the pad's "
        f"fitted law times the gain at that place: {law}. Look for blue above red: at the same pressure the load is "
        "larger on the way in than on the way out, by the newtons in the titles on average; where that is more than "
        "the errors you can bear, calibrate with --curve hysteresis or auto. A loop that is open at the hold alone is "
        "the pad relaxing; one that does not end at zero is a baseline that moved."
    )
    return alt, caption


def _about_structure(calibration: Calibration) -> str:
    below = "Bottom: estimated minus true force of presses the fit had not seen, by place, by force and over time."
    if calibration.field is None:
        return f"{below} Structure in the map asks for a correction by location"
    return (
        f"The curve is that of a gain of 1. {below} Structure left in the map is what the field of gain cannot follow, "
        "or a place estimated wrongly"
    )


def _about_gain(field: FittedField) -> tuple[str, str]:
    alt = "Two maps of the pads: the gain by the place pressed, and its standard error with the places of the presses."
    spread, noise = (_number(100 * float(size), 1) for size in (field.spread, field.noise))
    caption = (
        "Force is the pad's curve times this gain at the estimated place: above 1 (red) the pad feels a press less "
        "than on average over its presses, below 1 (blue) more. Black points are the estimated places of the presses; "
        "beyond them the gain of the nearest edge of their box holds. Single presses scatter by "
        f"{spread} % about the curves alone and by {noise} % about curves and gain. The standard error is that of the "
        f"field chosen ({field_name(field.field)}): where it is large, more presses are wanted."
    )
    return alt, caption


def _one_level(evaluation: Evaluation, others: bool) -> str:
    force = evaluation.force
    if np.ptp(force) > 0.1 * force.max():
        return ""
    more = "" if others else " Evaluate on presses at other forces before trusting those."
    return f" All presses were held at about {force.mean():.3g} N, so the errors here are those of that force." + more


# --- the page ------------------------------------------------------------------------------------------------------


def _page(calibration: Calibration, evaluations: Mapping[str, Evaluation], figures: Iterable[_Picture]) -> str:
    mark = "SIMULATED: " if calibration.simulated else ""
    title = escape(f"{mark}Calibration of the skin {calibration.skin.name}")
    parts = [
        f"<h1>{escape(f'Calibration of the skin {calibration.skin.name}')}</h1>",
        _banner(calibration.simulated),
        f"<p>{escape(_lead(calibration))}</p>",
        _results(calibration, evaluations),
        _localisation(_all(calibration, evaluations)),
        _left_out(calibration.evaluation),
        _choice(calibration),
        *map(_figure, figures),
        _pads(calibration),
        _notes(calibration, evaluations),
        _provenance(calibration),
    ]
    return _SHELL.format(title=title, style=_STYLE, body="\n".join(filter(None, parts)))


def _banner(simulated: bool) -> str:
    if not simulated:
        return ""
    return (
        '<p class="banner" role="note"><strong>SIMULATED</strong> This calibration rests on simulated recordings. '
        "Its numbers say how the method behaves on a model of the skin, not what a real skin does.</p>"
    )


def _lead(calibration: Calibration) -> str:
    skin, found = calibration.skin, calibration.evaluation
    rows, columns = calibration.recon.shape
    return (
        f"{len(skin.pads)} pads, {len(skin.electrodes)} electrodes, {len(skin.protocol.pattern)} readings a frame, "
        f"image of {columns} x {rows} pixels. {len(found.force)} presses at {_places(found)} places, held at "
        f"{_levels(found.force)}. All forces below are predictions for presses that "
        f"the fit had not seen (held out by {found.held_out_by})."
    )


def _levels(force: np.ndarray) -> str:
    low, high = f"{force.min():.3g}", f"{force.max():.3g}"
    return f"about {low} N" if low == high else f"{low} to {high} N"


def _places(evaluation: Evaluation) -> int:
    return len(np.unique(np.round(evaluation.position, 6), axis=0))


def _results(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> str:
    groups = {
        f"{name}: {len(e.force)} presses, held out by {e.held_out_by}": _method_rows(e)
        for name, e in _all(calibration, evaluations).items()
    }
    groups[_PAPER] = [(METHODS[name], cv, *["—"] * 4) for name, cv in _PAPER_CV.items()]
    head = ["total force by", "CV, ddof 1", "RMSE, N", "RMSE, % of largest", "mean absolute, N", "worst, N"]
    about = (
        "EIT only: the integral of the image times one number; hybrid: the paper's recipe, one slope a pad; "
        "calibrated: this calibration; true place: the same, told the true place instead of the estimated one, which "
        "only a simulation knows exactly. CV: standard deviation over mean of the sensitivity over the presses; after "
        "±: its standard error over places (bootstrap). The paper is arXiv 2605.28468; it does not state its ddof, "
        "nor errors of force."
    )
    if calibration.simulated:
        about += (
            " Its numbers were measured on a real skin, ours come from a simulation whose parameters were chosen to "
            "resemble it: likeness is consistency, not validation."
        )
    return f"<h2>Results</h2>{_table(head, groups)}<p class='small'>{escape(about)}</p>"


_PAPER = "the paper: 225 presses on hardware"
_PAPER_CV = {"eit": "0.31", "hybrid": "0.14"}


def _all(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> dict[str, Evaluation]:
    return {"this calibration": calibration.evaluation, **evaluations}


def _method_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """What each way to a total force is worth on one session."""
    return [
        (
            worth.label,
            _with_error(worth.cv, worth.cv_error, 3),
            _number(worth.rmse, 2),
            _number(worth.percent, 1),
            _number(worth.mean_absolute, 2),
            _number(worth.worst, 2),
        )
        for worth in evaluation.by_method()
    ]


def _left_out(evaluation: Evaluation) -> str:
    """What comes of leaving out a pad, an indenter or a session; of those there is only one of, a sentence."""
    rows = [
        (
            split.by,
            str(split.parts),
            str(split.presses),
            f"{_number(split.rmse, 2)} ({_number(split.low, 2)} to {_number(split.high, 2)})",
            _number(split.worst, 2),
        )
        for split in evaluation.splits
        if not split.note
    ]
    notes = "".join(f"<li>{escape(split.note)}</li>" for split in evaluation.splits if split.note)
    head = ["left out at a time", "parts", "presses", "RMSE, N (90 % interval)", "worst part, N"]
    about = (
        "Each part is predicted by fits that had not seen it; a pad by the curve of all others together. Intervals are "
        "of a bootstrap over places: all presses of a place are drawn together."
    )
    table = f"{_table(head, {'': rows})}<p class='small'>{about}</p>" if rows else ""
    return f"<h2>Beyond what was pressed</h2>{table}<ul>{notes}</ul>" if rows or notes else ""


def _choice(calibration: Calibration) -> str:
    """Why this curve and this field, where there was something to choose from."""
    why = calibration.provenance.get("choice", "")
    if not why:
        return ""
    about = "Chosen by cross-validation over places, each predicted by fits that had not seen it: "
    return f"<h2>Choice of the model</h2><p>{escape(about + why)}.</p>{_tried(calibration)}"


_PARTS = {"location": "correction by location, with the first curve", "curve": "curve, with the correction chosen"}


def _tried(calibration: Calibration) -> str:
    """All candidates and their errors; calibrations of before have none to show."""
    parts = dict.fromkeys(candidate.part for candidate in calibration.tried)
    groups = {_PARTS.get(p, p): [_candidate(c) for c in calibration.tried if c.part == p] for p in parts}
    head = ["candidate", "coefficients", "held-out RMSE, N", "one standard error about, N", ""]
    return _table(head, groups) if groups else ""


def _candidate(tried: Candidate) -> tuple[str, ...]:
    if tried.rmse is None or tried.low is None or tried.high is None:
        return tried.name, str(tried.size), "not determined", "—", ""
    about = f"{_number(tried.low, 2)} to {_number(tried.high, 2)}"
    return tried.name, str(tried.size), _number(tried.rmse, 2), about, "chosen" if tried.chosen else ""


def _localisation(found: Mapping[str, Evaluation]) -> str:
    groups = {name: _localisation_rows(e) for name, e in found.items()}
    groups[_PAPER] = [("not stated", "6.9", "—", "—", "—")]
    head = ["estimator", "mean, mm", "median, mm", "95th percentile, mm", "inward bias, mm"]
    used = {name for e in found.values() for name in e.estimated}
    meaning = "; ".join(f"{name}: {text}" for name, text in ESTIMATOR_MEANING.items() if name in used)
    return (
        f"<h2>Localisation by estimator</h2>{_table(head, groups)}<p class='small'>{escape(meaning)}. Inward bias: how "
        "much nearer to the centre of the sheet the estimate lies than the truth.</p>"
    )


def _localisation_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    s = evaluation.summary()
    out = []
    for name in sorted(evaluation.estimated, key=[*ESTIMATOR_MEANING, *evaluation.estimated].index):
        mean, error, *rest = (
            1e3 * s[f"localisation_{name}_{k}"] for k in ("mean", "mean_se", "median", "p95", "inward_bias")
        )
        out.append((name, _with_error(mean, error, 1), *(_number(value, 1) for value in rest)))
    return out


def _figure(picture: _Picture) -> str:
    data = base64.b64encode(picture.data).decode()
    kind = " class='single'" if picture.single else ""
    return (
        f"<h2>{escape(picture.title)}</h2><figure{kind}>"
        f'<img alt="{escape(picture.alt)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


def _pads(calibration: Calibration) -> str:
    curve = calibration.curves.curve
    head = [
        "pad",
        *(f"{n}, {u}" if u != "1" else n for n, u in zip(curve.names, curve.units, strict=True)),
        "pressures fitted, Pa",
        "samples",
        "places",
        "residual RMS, N",
        "fit",
    ]
    rows = [_pad_row(calibration, number) for number in range(len(calibration.skin.pads))]
    kind = escape(calibration.provenance.get("curve", type(curve).__name__))
    return (
        f"<h2>Pads</h2>{_table(head, {'': rows})}<p class='small'>Curve: {kind}. After ±: standard error, from the "
        "scatter between places. Residual RMS: of all samples fitted, not held out. Outside the pressures fitted a "
        "force is marked as not valid.</p>"
    )


def _pad_row(calibration: Calibration, number: int) -> tuple[str, ...]:
    fitted = calibration.curves.pad(number)
    values, errors = np.asarray(fitted.parameters, float), np.asarray(fitted.standard_errors, float)
    low, high = np.asarray(fitted.pressure_range, float)
    return (
        f"{number} {calibration.skin.pads[number].name}",
        *(f"{_significant(v, 5)}{_PLUS_MINUS}{_significant(e, 2)}" for v, e in zip(values, errors, strict=True)),
        f"{_number(low, 0)} to {_number(high, 0)}",
        str(int(fitted.n)),
        str(int(fitted.n_groups)),
        _number(float(fitted.residual_rms), 2),
        fitted.message(),
    )


def _notes(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> str:
    notes = list(calibration.notes) + [f"{name}: {note}" for name, e in evaluations.items() for note in e.notes]
    items = "".join(f"<li>{escape(note)}</li>" for note in notes) or "<li>none</li>"
    return f"<h2>Notes</h2><ul>{items}</ul>"


def _provenance(calibration: Calibration) -> str:
    rows = [(key.replace("_", " "), value) for key, value in calibration.provenance.items() if value]
    return f"<h2>Provenance</h2>{_table(['what', 'value'], {'': rows}, 'provenance')}"


# --- parts -----------------------------------------------------------------------------------------


def _table(head: Sequence[str], groups: Mapping[str, Iterable[Sequence[str]]], kind: str = "numbers") -> str:
    """A table from plain texts in groups of rows under their names, if any; the first column names the row."""
    top = "".join(f"<th scope='col'>{escape(cell)}</th>" for cell in head)
    body = "".join(_group(name, rows, len(head)) for name, rows in groups.items())
    return f"<div class='wide'><table class='{kind}'><thead><tr>{top}</tr></thead>\n{body}</table></div>"


def _group(name: str, rows: Iterable[Sequence[str]], columns: int) -> str:
    title = f"<tr><th scope='rowgroup' colspan='{columns}'>{escape(name)}</th></tr>\n" if name else ""
    body = "".join(
        f"<tr><th scope='row'>{escape(first)}</th>{''.join(f'<td>{escape(cell)}</td>' for cell in rest)}</tr>\n"
        for first, *rest in rows
    )
    return f"<tbody>{title}{body}</tbody>"


_PLUS_MINUS = "\u00a0±\u00a0"  # never broken over two lines


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−") if math.isfinite(value) else "—"


def _significant(value: float, digits: int) -> str:
    return f"{value:.{digits}g}".replace("-", "−") if math.isfinite(value) else "—"


def _with_error(value: float, error: float, digits: int) -> str:
    """A value and its standard error, which gets one digit more where it would be lost."""
    shown = _number(error, digits + (error < 10.0**-digits))
    return f"{_number(value, digits)}{_PLUS_MINUS}{shown}" if math.isfinite(error) else _number(value, digits)


_SHELL = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""

_STYLE = """
:root { --text: #1b1b1b; --page: #ffffff; --soft: #555555; --line: #cfcfcf; --head: #f1f3f5;
  --warn-text: #7a0c0c; --warn-page: #fdecea; --warn-line: #c62828; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e8e8e8; --page: #16181b; --soft: #b3b3b3; --line: #444a50; --head: #22262b;
    --warn-text: #ffd9d4; --warn-page: #4a1512; --warn-line: #ff6f60; }
  figure img { filter: brightness(.92); } }
body { margin: 0; background: var(--page); color: var(--text);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 1.5rem 1rem 3rem; }
h1 { font-size: 1.7rem; margin: 0 0 .8rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; }
.banner { background: var(--warn-page); color: var(--warn-text); border: 2px solid var(--warn-line);
  border-radius: 6px; padding: .6rem 1rem; }
.banner strong { font-size: 1.25rem; letter-spacing: .06em; margin-right: .6rem; }
.small, figcaption { font-size: .9em; color: var(--soft); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .95em; }
th, td { border-bottom: 1px solid var(--line); padding: .35em .8em; text-align: right; vertical-align: top; }
thead th { background: var(--head); font-weight: 600; }
th:first-child { text-align: left; }
tbody th { font-weight: 400; }
th[scope=rowgroup] { font-weight: 600; padding-top: .9em; }
td { overflow-wrap: break-word; }
.provenance td, .provenance th { text-align: left; white-space: pre-wrap; }
.provenance td { overflow-wrap: anywhere; font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .9em; }
figure { margin: 0; }
figure img { display: block; width: 100%; height: auto; background: #ffffff; border: 1px solid var(--line);
  border-radius: 4px; margin-bottom: .5rem; }
figure.single img { max-width: 42rem; }
li { overflow-wrap: anywhere; }
@media print {
  :root { --text: #000000; --page: #ffffff; --soft: #333333; --line: #999999; --head: #eeeeee;
    --warn-text: #7a0c0c; --warn-page: #ffffff; --warn-line: #c62828; }
  body { font-size: 9.5pt; }
  h1 { font-size: 16pt; }
  h2 { font-size: 12pt; margin-top: 1.2em; }
  table { font-size: .9em; }
  th, td { padding: .25em .6em; }
  main { max-width: none; padding: 0; }
  h2 { break-after: avoid; }
  figure, tr, .banner { break-inside: avoid; }
  figure img { filter: none; }
  figure.single img { max-width: 13cm; }
  .wide { overflow: visible; } }
"""
