"""The report of a calibration: one self-contained HTML page, and the paper's figures as files beside it."""

from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import Any, overload

import numpy as np

import jaxeit as je
from jaxeit.messages.kinds import require_kind

from ..calibration.argument_checks import require_calibration
from ..calibration.calibration import Calibration
from ..calibration.evaluation import FORCE_METHODS, FORCE_THIRDS, Evaluation, localisation_errors
from ..calibration.logs.calibration import LogCalibration
from ..calibration.logs.evaluation import LogEvaluation
from ..fitting.cross_validation.selection import Candidate
from ..session import SessionError, replacing
from .figures.parts import require_matplotlib
from .figures.presses import ESTIMATOR_MEANING
from .html_parts import PAGE, PLUS_MINUS, STYLE, html_table, number_text, significant_text, with_error
from .log_document import write_log_report
from .pictures import PictureSection, calibration_pictures

_NONE: Mapping[str, Any] = MappingProxyType({})


@overload
def write_report(
    calibration: Calibration, path: str | Path, *, evaluations: Mapping[str, Evaluation] = _NONE
) -> list[Path]: ...


@overload
def write_report(
    calibration: LogCalibration, path: str | Path, *, evaluations: Mapping[str, LogEvaluation] = _NONE
) -> list[Path]: ...


def write_report(
    calibration: Calibration | LogCalibration, path: str | Path, *, evaluations: Mapping[str, Any] = _NONE
) -> list[Path]:
    """Write the page and, beside it, its figures as PNG; each file whole or not at all.

    Args:
        calibration: what the page is about.
        path: of the page; for ``report.html`` the figures are ``report_maps.png``, ``report_localisation.png``,
            ``report_sensitivity.png`` and ``report_curves.png``, of presses that were released also
            ``report_loops.png``, with a correction by location ``report_gain.png``. The page of a log
            holds its figures.
        evaluations: of the calibration on other sessions, by name, as `calib.evaluate` returns them.

    Returns:
        The paths written, the page first.

    Raises:
        ReportError: matplotlib is not installed.
        SessionError: for a path in the place of the calibration, or an evaluation of a calibration of another kind.
        SessionError, OSError: a file cannot be written.

    Example:
        for path in calib.write_report(calibration, "report.html"):
            print(path)  # the page, and its figures as PNG
    """
    if isinstance(calibration, LogCalibration):
        _require_evaluations(evaluations, LogEvaluation, "a log")
        return [write_log_report(calibration, path, evaluations=evaluations)]
    require_calibration(calibration, "write_report")
    _require_evaluations(evaluations, Evaluation, "a skin")
    require_matplotlib()
    page = Path(path)
    pictures = calibration_pictures(calibration, evaluations)
    text = _page(calibration, evaluations, pictures)
    files = [page.with_name(f"{page.stem}_{picture.name}.png") for picture in pictures]
    for target, picture in zip(files, pictures, strict=True):
        _write(target, picture.data)
    _write(page, text.encode())
    return [page, *files]


def _require_evaluations(evaluations: Mapping[str, Any], kind: type, of: str) -> None:
    """Refuse evaluations of a calibration of another kind."""
    for name, found in evaluations.items():
        give = "calib.evaluate(calibration, session)"
        require_kind(
            found, kind, SessionError, f"an evaluation of the calibration of {of}", give, f"evaluations: {name}"
        )


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(data)


# --- the page ------------------------------------------------------------------------------------------------------


def _page(calibration: Calibration, evaluations: Mapping[str, Evaluation], pictures: Iterable[PictureSection]) -> str:
    mark = "SIMULATED: " if calibration.simulated else ""
    title = escape(f"{mark}Calibration of the skin {calibration.skin.name}")
    parts = [
        f"<h1>{escape(f'Calibration of the skin {calibration.skin.name}')}</h1>",
        _banner(calibration.simulated),
        f"<p>{escape(_lead(calibration))}</p>",
        _health(calibration),
        _residuals(_all(calibration, evaluations), calibration.skin),
        _results(calibration, evaluations),
        _localisation(_all(calibration, evaluations), calibration.skin.name == PAPERS_SKIN),
        _left_out(calibration.evaluation),
        _choice(calibration),
        *(picture.html() for picture in pictures),
        _pads(calibration),
        _notes(calibration, evaluations),
        _provenance(calibration),
    ]
    return PAGE.format(title=title, style=STYLE, body="\n".join(filter(None, parts)))


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
        f"{len(skin.pads)} pads, {len(skin.electrodes)} electrodes, {skin.protocol.readings} readings a frame, "
        f"image of {columns} x {rows} pixels. {len(found.force)} presses at {_places(found)} places, held at "
        f"{_levels(found.force)}. All forces below are predictions for presses that "
        f"the fit had not seen ({found.held_out})."
    )


def _health(calibration: Calibration) -> str:
    """How the pads have moved since the calibration; empty if it was never recalibrated."""
    found = calibration.recalibration
    if found is None:
        return ""
    head = ["pad", "offset, Pa", "change, Pa", "gain before", "gain", "moved, %", "presses or contacts", ""]
    errors, own = np.sqrt(np.diag(found.covariance)), np.exp(found.log_gain)
    rows = [
        (
            name,
            with_error(found.offset[i], found.offset_error[i], 1),
            number_text(found.offset_change[i], 1),
            number_text(np.exp(found.before[i]), 4),
            with_error(own[i], own[i] * errors[i], 4),
            with_error(100 * np.expm1(found.change[i]), 100 * found.change_error[i], 2),
            number_text(found.count[i], 1),
            "significant" if found.significant[i] else "" if found.determined[i] else "not determined",
        )
        for i, name in enumerate(found.pads)
    ]
    notes = "".join(f"<li>{escape(note)}</li>" for note in found.notes)
    about = (
        f"From {found.evidence} in {found.session.split('  ')[-1]}. Results, figures and curves below are those of the "
        "calibration itself; forces are computed from pressures divided by these gains."
    )
    return (
        f"<h2>Calibration health</h2><p>{escape(found.health)}.</p>{html_table(head, {'': rows})}"
        f"<p class='small'>{escape(about)}</p><ul>{notes}</ul>"
    )


def _residuals(found: Mapping[str, Evaluation], skin: je.Skin) -> str:
    """Residuals of the presses on each pad, by the pad that bears most of the press; and the coverage of intervals."""
    groups = {name: [_residual_row(e, k, pad.name) for k, pad in enumerate(skin.pads)] for name, e in found.items()}
    head = ["presses mostly on pad", "presses", "mean error, N", "RMSE, N", "median |error|, N", "worst, N", "in 90 %"]
    told = [f"{name}: {text}" for name, e in found.items() if (text := _coverage(e))]
    about = (
        "Error: estimated less true total force. In 90 %: part of the presses whose true force lies in the 90 % "
        "interval that the calibration gives with the force. " + " ".join(told)
    )
    return f"<h2>Residuals by pad</h2>{html_table(head, groups)}<p class='small'>{escape(about)}</p>"


def _residual_row(found: Evaluation, pad: int, name: str) -> tuple[str, ...]:
    mine = np.nan_to_num(found.pressure).argmax(1) == pad
    error = (found.total_force - found.force)[mine]
    if not len(error):
        return f"{pad} {name}", "0", *["—"] * 5
    inside = "—"
    if found.half_width is not None and np.isfinite(found.half_width[mine]).all():
        inside = f"{100 * np.mean(np.abs(error) <= found.half_width[mine]):.0f} %"
    sizes = error.mean(), np.sqrt(np.mean(error**2)), np.median(np.abs(error)), np.abs(error).max()
    return f"{pad} {name}", str(len(error)), *(number_text(float(size), 2) for size in sizes), inside


def _coverage(found: Evaluation) -> str:
    """Coverage of the intervals, of all presses and of each third of force; empty without intervals."""
    s = found.summary()
    if "coverage" not in s:
        return ""
    thirds = [f"{name} {100 * s[f'coverage_{name}']:.0f} %" for name in FORCE_THIRDS if f"coverage_{name}" in s]
    return f"{100 * s['coverage']:.0f} % of all presses; thirds of the force: {', '.join(thirds)}."


def _levels(force: np.ndarray) -> str:
    low, high = f"{force.min():.3g}", f"{force.max():.3g}"
    return f"about {low} N" if low == high else f"{low} to {high} N"


def _places(evaluation: Evaluation) -> int:
    return len(np.unique(np.round(evaluation.position, 6), axis=0))


def _results(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> str:
    groups = {
        f"{name}: {len(e.force)} presses, {e.held_out}": _method_rows(e)
        for name, e in _all(calibration, evaluations).items()
    }
    if calibration.skin.name == PAPERS_SKIN:
        groups[_PAPER] = [(FORCE_METHODS[name], cv, *["—"] * 4) for name, cv in _PAPER_CV.items()]
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
    return f"<h2>Results</h2>{html_table(head, groups)}<p class='small'>{escape(about)}</p>"


PAPERS_SKIN = "testbed"  # the skin of the paper's 225 presses
_PAPER = "the paper: 225 presses on hardware"
_PAPER_CV = {"eit": "0.31", "hybrid": "0.14"}


def _all(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> dict[str, Evaluation]:
    return {"this calibration": calibration.evaluation, **evaluations}


def _method_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    """Evenness and errors of each method of estimating the total force on one session."""
    return [
        (
            method.label,
            with_error(method.cv, method.cv_error, 3),
            number_text(method.rmse, 2),
            number_text(method.percent, 1),
            number_text(method.mean_absolute, 2),
            number_text(method.worst, 2),
        )
        for method in evaluation.by_method()
    ]


def _left_out(evaluation: Evaluation) -> str:
    """Errors with a pad, an indenter or a session left out; a sentence where there is only one of a kind."""
    rows = [
        (
            split.by,
            str(split.parts),
            str(split.presses),
            f"{number_text(split.rmse, 2)} ({number_text(split.low, 2)} to {number_text(split.high, 2)})",
            number_text(split.worst, 2),
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
    table = f"{html_table(head, {'': rows})}<p class='small'>{about}</p>" if rows else ""
    return f"<h2>Beyond what was pressed</h2>{table}<ul>{notes}</ul>" if rows or notes else ""


def _choice(calibration: Calibration) -> str:
    """Reason for the choice of curve and field, if there were several candidates."""
    why = calibration.provenance.get("choice", "")
    if not why:
        return ""
    about = "Chosen by cross-validation over places, each predicted by fits that had not seen it: "
    return f"<h2>Choice of the model</h2><p>{escape(about + why)}.</p>{_tried(calibration)}"


_PARTS = {"location": "correction by location", "curve and location": "curve, correction by location"}


def _tried(calibration: Calibration) -> str:
    """Table of all candidates and their errors; empty for a file of an early version."""
    parts = dict.fromkeys(candidate.part for candidate in calibration.tried)
    groups = {_PARTS.get(p, p): [_candidate(c) for c in calibration.tried if c.part == p] for p in parts}
    head = [
        "candidate",
        "effective coefficients",
        "held-out RMSE, N",
        "with the error of its difference from the best, N",
        "",
    ]
    return html_table(head, groups) if groups else ""


def _candidate(tried: Candidate) -> tuple[str, ...]:
    if tried.rmse is None or tried.low is None or tried.high is None:
        return tried.name, str(tried.size), "not determined", "—", ""
    about = f"{number_text(tried.low, 2)} to {number_text(tried.high, 2)}"
    return tried.name, str(tried.size), number_text(tried.rmse, 2), about, "chosen" if tried.chosen else ""


def _localisation(found: Mapping[str, Evaluation], papers_skin: bool) -> str:
    groups = {name: _localisation_rows(e) for name, e in found.items()}
    if papers_skin:
        groups[_PAPER] = [("not stated", "6.9", "—", "—", "—")]
    head = ["estimator", "mean, mm", "median, mm", "95th percentile, mm", "inward bias, mm"]
    used = {name for e in found.values() for name in e.estimated}
    meaning = "; ".join(f"{name}: {text}" for name, text in ESTIMATOR_MEANING.items() if name in used)
    return (
        f"<h2>Localisation by estimator</h2>{html_table(head, groups)}<p class='small'>{escape(meaning)}. Inward bias: "
        "how much nearer to the centre of the sheet the estimate lies than the truth.</p>"
    )


def _localisation_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    s = evaluation.summary()
    out = []
    for name in sorted(evaluation.estimated, key=[*ESTIMATOR_MEANING, *evaluation.estimated].index):
        mean, error, *rest = (1e3 * value for value in localisation_errors(s, name))
        out.append((name, with_error(mean, error, 1), *(number_text(value, 1) for value in rest)))
    return out


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
        f"<h2>Pads</h2>{html_table(head, {'': rows})}<p class='small'>Curve: {kind}. After ±: standard error, from the "
        "scatter between places. Residual RMS: of all samples fitted, not held out. Outside the pressures fitted a "
        "force is marked as not valid.</p>"
    )


def _pad_row(calibration: Calibration, number: int) -> tuple[str, ...]:
    fitted = calibration.curves.pad(number)
    values, errors = np.asarray(fitted.parameters, float), np.asarray(fitted.standard_errors, float)
    low, high = np.asarray(fitted.pressure_range, float)
    return (
        f"{number} {calibration.skin.pads[number].name}",
        *(f"{significant_text(v, 5)}{PLUS_MINUS}{significant_text(e, 2)}" for v, e in zip(values, errors, strict=True)),
        f"{number_text(low, 0)} to {number_text(high, 0)}",
        str(int(fitted.n)),
        str(int(fitted.n_groups)),
        number_text(float(fitted.residual_rms), 2),
        fitted.message(),
    )


def _notes(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> str:
    notes = list(calibration.notes) + [f"{name}: {note}" for name, e in evaluations.items() for note in e.notes]
    items = "".join(f"<li>{escape(note)}</li>" for note in notes) or "<li>none</li>"
    return f"<h2>Notes</h2><ul>{items}</ul>"


def _provenance(calibration: Calibration) -> str:
    rows = [(key.replace("_", " "), value) for key, value in calibration.provenance.items() if value]
    return f"<h2>Provenance</h2>{html_table(['what', 'value'], {'': rows}, 'provenance')}"
