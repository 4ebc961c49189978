"""The report of a log's calibration: one self-contained HTML page. Residual statistics come first."""

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from types import MappingProxyType

import numpy as np

from ..calibration.logs.calibration import LogCalibration
from ..calibration.logs.evaluation import LOG_THIRDS, LogEvaluation
from ..session import replacing
from .figures.logs import place_panels, residual_figure, scatter_figure, time_figure
from .figures.panels import inline_svg
from .figures.parts import require_matplotlib
from .html_parts import PAGE, PLUS_MINUS, STYLE, html_table, number_text, significant_text

_NONE: Mapping[str, LogEvaluation] = MappingProxyType({})


def write_log_report(
    calibration: LogCalibration, path: str | Path, *, evaluations: Mapping[str, LogEvaluation] = _NONE
) -> Path:
    """Write the page, whole or not at all.

    Args:
        evaluations: of the calibration on other logs, by name.

    Raises:
        ReportError: matplotlib is not installed.
        SessionError, OSError: the file cannot be written.
    """
    require_matplotlib()
    page = Path(path)
    found = {"this recording": calibration.evaluation, **evaluations}
    text = _page(calibration, found)
    with replacing(page) as temporary:
        temporary.write_bytes(text.encode())
    return page


def _page(calibration: LogCalibration, found: Mapping[str, LogEvaluation]) -> str:
    heading = f"Calibration of the stream {calibration.stream}"
    mark = "SIMULATED: " if calibration.simulated else ""
    parts = [
        f"<h1>{escape(heading)}</h1>",
        _banner(calibration.simulated),
        f"<p>{escape(_lead(calibration))}</p>",
        _residuals(found),
        _coverage(found),
        *(_figures(number, name, one) for number, (name, one) in enumerate(found.items())),
        _gain(calibration),
        _health(calibration),
        _curve(calibration),
        _choice(calibration),
        _notes(calibration, found),
        _provenance(calibration),
    ]
    return PAGE.format(title=escape(mark + heading), style=STYLE, body="\n".join(filter(None, parts)))


def _banner(simulated: bool) -> str:
    if not simulated:
        return ""
    return (
        '<p class="banner" role="note"><strong>SIMULATED</strong> This calibration rests on simulated recordings.</p>'
    )


def _lead(calibration: LogCalibration) -> str:
    return (
        f"{len(calibration.kept)} of {calibration.columns} channels, {calibration.model.words}; curve: "
        f"{calibration.curve_name}. The errors of this recording are of a model that was chosen and fitted on the "
        "first part, and predicts the rest: the second half of each log or, with a correction by location, a third of "
        "the places. The calibration in the file is the same kind of model, fitted to the whole recording."
    )


def _residuals(found: Mapping[str, LogEvaluation]) -> str:
    head = [
        "residuals",
        "samples",
        "RMSE, N",
        "RMSE, % of largest",
        "bias, N",
        "mean absolute, N",
        "worst, N",
        "MAPE, %",
    ]
    keys = (
        "force_rmse",
        "force_rmse_percent_full_scale",
        "force_bias",
        "force_mean_absolute",
        "force_worst",
        "force_mape",
    )
    digits = (3, 1, 3, 3, 2, 1)
    rows = []
    for name, one in found.items():
        s = one.summary()
        numbers = (number_text(s[key], n) for key, n in zip(keys, digits, strict=True))
        rows.append((f"{name}: {one.title}", f"{s['samples']:.0f}", *numbers))
    return f"<h2>Residuals</h2>{html_table(head, {'': rows})}"


def _coverage(found: Mapping[str, LogEvaluation]) -> str:
    head = ["recording", "all", *(f"{name} third of force" for name in LOG_THIRDS), "outside the calibrated range"]
    keys = ("coverage", *(f"coverage_{name}" for name in LOG_THIRDS), "outside_share")
    rows = [(name, *(_percent(one.summary()[key]) for key in keys)) for name, one in found.items()]
    about = (
        "Share of the samples within the 90 % interval of a reading. An honest interval holds 85 to 95 %. Samples "
        "outside the calibrated range are not counted; their forces are marked as not valid."
    )
    return f"<h2>Coverage of the intervals</h2>{html_table(head, {'': rows})}<p class='small'>{about}</p>"


def _percent(share: float) -> str:
    return number_text(100 * share, 1) + (" %" if np.isfinite(share) else "")


def _figures(number: int, name: str, found: LogEvaluation) -> str:
    if not found.known.any():
        return ""
    pictures = (
        (
            "residuals over force",
            residual_figure(found),
            "Predicted minus recorded force. The band is the 90 % interval.",
        ),
        ("predicted and recorded force", scatter_figure(found), "On the line a prediction is right."),
        ("force over time", time_figure(found), "Recorded force, predicted force, and its 90 % interval."),
    )
    return "".join(
        _picture(f"{name}: {what}", [inline_svg(figure, f"recording{number}-{k}", f"{name}: {what}")], about)
        for k, (what, figure, about) in enumerate(pictures)
    )


def _picture(heading: str, panels: Sequence[str], caption: str) -> str:
    shown = f"<div class='panels few'>{''.join(panels)}</div>"
    return f"<h2>{escape(heading)}</h2><figure>{shown}<figcaption>{escape(caption)}</figcaption></figure>"


def _gain(calibration: LogCalibration) -> str:
    """Map of the gain over the place; nothing for a model without one."""
    location = calibration.model.location
    if location is None or location.gain is None:
        return ""
    about = (
        f"By the field {calibration.location_name}, over the box of the presses. The force is that of the curve times "
        "the gain; its geometric mean over the fitted places is 1."
    )
    return _picture("Gain by place", [one.html() for one in place_panels(location.gain, location.box)], about)


def _health(calibration: LogCalibration) -> str:
    """How the sensor has moved since the calibration; empty if it was never recalibrated."""
    found = calibration.shift
    if found is None:
        return ""
    gain, offset = found.errors
    rows = [
        ("gain", number_text(found.before[0], 4), f"{found.gain:.4f} {PLUS_MINUS} {gain:.4f}", ""),
        ("offset", number_text(found.before[1], 3), f"{found.offset:.3f} {PLUS_MINUS} {offset:.2g}", "N"),
    ]
    about = (
        "Results, figures and curve are those of the calibration itself; forces have this offset and gain taken off."
    )
    table = html_table(["", "before", "now", "unit"], {"": rows})
    return f"<h2>Calibration health</h2><p>{escape(found.health)}.</p>{table}<p class='small'>{escape(about)}</p>"


def _curve(calibration: LogCalibration) -> str:
    fitted = calibration.model.curve
    values, errors = np.asarray(fitted.parameters, float), np.asarray(fitted.standard_errors, float)
    rows = [
        (name, significant_text(v, 5) + PLUS_MINUS + significant_text(e, 2), unit)
        for name, v, e, unit in zip(fitted.curve.names, values, errors, calibration.units, strict=True)
    ]
    noise = calibration.model.noise
    about = (
        f"Standard errors are over {int(fitted.n_groups)} {calibration.groups}. A new reading deviates by "
        f"{float(noise.floor):.3g} N without force, by {100 * float(noise.fraction):.2g} % of a large force, and by "
        f"{float(noise.lag):.2g} s times the rate of a force that changes; half "
        f"the 90 % interval is {float(noise.multiple):.2f} standard deviations. These come from blocks "
        "that were held out."
    )
    table = html_table([f"{calibration.curve_name} curve", "value", "unit"], {"": rows})
    return f"<h2>Curve</h2>{table}<p class='small'>{escape(about)}</p>"


def _choice(calibration: LogCalibration) -> str:
    if not calibration.tried:
        return ""
    parts = dict.fromkeys(one.part for one in calibration.tried)
    groups = {
        part: [(c.name, "not determined" if c.rmse is None else number_text(c.rmse, 3), "chosen" if c.chosen else "")
               for c in calibration.tried if c.part == part]
        for part in parts
    }  # fmt: skip
    return f"<h2>Choice of the model</h2>{html_table(['candidate', 'held-out RMSE, N', ''], groups)}"


def _notes(calibration: LogCalibration, found: Mapping[str, LogEvaluation]) -> str:
    notes = [*calibration.notes, *(f"{name}: {note}" for name, one in found.items() for note in one.notes)]
    items = "".join(f"<li>{escape(note)}</li>" for note in dict.fromkeys(notes)) or "<li>none</li>"
    return f"<h2>Notes</h2><ul>{items}</ul>"


def _provenance(calibration: LogCalibration) -> str:
    rows = [(key.replace("_", " "), value) for key, value in calibration.provenance.items() if value]
    return f"<h2>Provenance</h2>{html_table(['what', 'value'], {'': rows}, 'provenance')}"
