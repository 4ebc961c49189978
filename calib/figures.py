"""The pictures of a calibration: the paper's figures 5 and 6, the pads' curves with their residuals, and their gain.

Lengths are drawn in mm, pressures in kPa, forces in N. Nothing here touches matplotlib's global state.
"""

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxeit as je

from .calibration import Calibration
from .evaluation import CALIBRATED, Evaluation
from .location import FittedField, log_gain, single_places
from .presses import dominant_pad
from .session import replacing

try:  # an extra: without it everything but the figures works
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon
except ImportError:
    Figure = None  # type: ignore[assignment,misc]

_MM = 1e3
_DPI = 125
_RED, _GREEN, _BLUE, _GREY = "#c62828", "#2e7d32", "#1f5fa8", "#8a8a8a"
_SERIES = (_BLUE, _RED, _GREEN, "#7b3fa0", "#d9730d")
_MARKS = ("#d9730d", "#7b3fa0", "#00838f", "#6d4c41")
_LAST_IN_FONT = "\u052f"  # the font that comes with matplotlib has Latin, Greek and Cyrillic letters

ESTIMATOR_MEANING: Mapping[str, str] = MappingProxyType(
    {
        "peak": "largest pixel",
        "half": "centroid of the pixels at or above 1/2 of the maximum",
        "quarter": "centroid of the pixels at or above 1/4 of the maximum",
        "positive": "value-weighted centroid of the positive part",
        "fitted": "place that the correction by location goes by",
    }
)
"""What each named estimator of an evaluation takes as the position, for a person."""


class ReportError(ValueError):
    """A figure or a report cannot be made."""


def require_matplotlib() -> None:
    """Raise `ReportError` where matplotlib is not installed."""
    if Figure is None:
        raise ReportError("figures and reports need matplotlib, which is not installed; install jaxeit[report]")


def plain_numbers(axes: Any) -> None:
    """Numbers as people write them along logarithmic axes; on axes of little more than a decade also 2 and 5."""

    def between(axis, value):
        low, high = axis.get_view_interval()
        return f"{value:g}" if high < 100 * low and f"{value:e}"[0] in "25" else ""

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(lambda value, _, axis=axis: between(axis, value))


def write_figure(figure: "Figure", path: Path) -> None:
    """The figure as a PNG file at a path, whole or not at all."""
    with replacing(path) as new:
        new.write_bytes(png(figure))


def png(figure: "Figure") -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def localisation_figure(evaluation: Evaluation, skin: je.Skin, *estimators: str, simulated: bool = False) -> "Figure":
    """The paper's figure 5: true positions (black), estimated ones (red), a line between.

    Args:
        evaluation: of the presses.
        skin: for its outline, electrodes (green) and pads.
        estimators: of ``evaluation.estimated``, each in a panel of its own; left out, "quarter".
        simulated: say so in the picture.

    Raises:
        ReportError: no such estimator, or matplotlib is not installed.
    """
    estimators = estimators or ("quarter",)
    for unknown in set(estimators) - set(evaluation.estimated):
        known = ", ".join(evaluation.estimated) or "none"
        raise ReportError(f"no estimator {unknown!r} in this evaluation; there are: {known}")
    figure = _figure(*((6.6, 7.2) if len(estimators) == 1 else (9.6, 6.2)), simulated)
    panels = figure.subplots(1, len(estimators), sharex=True, sharey=True, squeeze=False)[0]
    for axes, estimator in zip(panels, estimators, strict=True):
        _localisation_panel(axes, evaluation, skin, estimator)
    _one_row(panels)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _localisation_panel(axes: Any, evaluation: Evaluation, skin: je.Skin, estimator: str) -> None:
    _sheet(axes, skin)
    _electrodes(axes, skin)
    true, estimated = evaluation.position * _MM, evaluation.estimated[estimator] * _MM
    axes.add_collection(LineCollection(list(np.stack([true, estimated], 1)), colors=_GREY, linewidths=0.8))
    axes.plot(*true.T, "o", ms=3.2, color="black", label="true", zorder=3)
    axes.plot(*estimated.T, "o", ms=3.2, color=_RED, label="estimated", zorder=4)
    axes.set_title(_localisation_title(evaluation, estimator), fontsize=10)


def _localisation_title(evaluation: Evaluation, estimator: str) -> str:
    estimate = evaluation.estimated[estimator]
    error = np.linalg.norm(estimate - evaluation.position, axis=1) * _MM
    found = np.isfinite(error)
    mean = f"{error[found].mean():.1f} mm" if found.any() else "unknown"
    lost = f", {np.count_nonzero(~found)} not found" if not found.all() else ""
    meaning = ESTIMATOR_MEANING.get(estimator, "")
    return f"Mean localisation error {mean} ({len(error)} presses{lost})\nestimator {_plain(estimator)}" + (
        f":\n{meaning}" if meaning else ""
    )


def sensitivity_figure(evaluation: Evaluation, skin: je.Skin, *, simulated: bool = False) -> "Figure":
    """The paper's figure 6: sensitivity over its mean at every place, EIT only and hybrid.

    The calibration itself has a third panel where it is more than the paper's recipe. All maps have one colour scale,
    symmetric about 1.

    Raises:
        ReportError: matplotlib is not installed.
    """
    maps = sensitivity_maps(evaluation)
    figure = _figure(9.6, 5.4 if len(maps) == 2 else 4.0, simulated)
    panels = figure.subplots(1, len(maps), sharex=True, sharey=True)
    summary = evaluation.summary()
    reach = _reach(np.concatenate(list(maps.values())) - 1)
    for axes, (name, values) in zip(panels, maps.items(), strict=True):
        _sheet(axes, skin)
        drawn = _value_map(axes, evaluation.position, values, 1 - reach, 1 + reach, "RdBu_r")
        axes.set_title(_sensitivity_title(name, summary), fontsize=10)
    _one_row(panels)
    bar = figure.colorbar(drawn, ax=panels, shrink=0.8, extend="both", pad=0.02)
    bar.set_label("sensitivity / its mean")
    return figure


def sensitivity_maps(evaluation: Evaluation) -> dict[str, np.ndarray]:
    """What figure 6 shows by method, (presses,) each over its mean."""
    maps = {"eit": evaluation.sensitivity_eit, "hybrid": evaluation.sensitivity_hybrid}
    calibrated = evaluation.sensitivity(CALIBRATED)
    if not np.array_equal(calibrated, maps["hybrid"]):
        maps[CALIBRATED] = calibrated
    return {name: values / values.mean() for name, values in maps.items()}


_SENSITIVITY_TITLE = {
    "eit": "EIT only: image sum / force",
    "hybrid": "Hybrid: estimated / true force",
    CALIBRATED: "Calibrated: estimated / true force",
}


def _sensitivity_title(name: str, summary: Mapping[str, float]) -> str:
    label = _SENSITIVITY_TITLE[name]
    if f"cv_{name}_ddof1" not in summary:
        return f"{label}\nCV needs two presses or more"
    cv, error = summary[f"cv_{name}_ddof1"], summary[f"cv_{name}_se"]
    return f"{label}\nCV {cv:.3f} ± {error:.3f} (SE), ddof 1"


def curves_figure(calibration: Calibration, evaluations: Mapping[str, Evaluation] = MappingProxyType({})) -> "Figure":
    """Each pad's curve and 95 % band with the presses it carried; residuals by place, by force and over time.

    Residuals are estimated minus true force of presses that the fit had not seen; those of other
    sessions (``evaluations``, by name) join the last two panels. Time is the number of the press.

    Raises:
        ReportError: matplotlib is not installed.
    """
    pads = len(calibration.skin.pads)
    columns = min(max(pads, 1), 4)
    rows = -(-pads // columns)
    figure: Any = _figure(9.6, 2.9 * rows + 5.2, calibration.simulated)
    top, bottom = figure.subfigures(2, 1, height_ratios=[2.9 * rows, 5.2], hspace=0.04)
    if pads:
        _curve_panels(top, calibration, rows, columns)
    panels = bottom.subplot_mosaic([["place", "force"], ["place", "order"]], width_ratios=[1.15, 1])
    figure.get_layout_engine().set(w_pad=0.09)
    _residual_map(bottom, panels["place"], calibration)
    _residuals_by(panels["force"], lambda found: found.force, calibration.evaluation, evaluations)
    panels["force"].set(xlabel="true force, N", xlim=(0, None))
    panels["force"].set_title("Force error by force", fontsize=10)
    _residuals_by(panels["order"], lambda found: np.arange(len(found.force)), calibration.evaluation, evaluations)
    panels["order"].set(xlabel="number of the press, in the order recorded")
    panels["order"].set_title("Force error over time", fontsize=10)
    if evaluations:
        panels["force"].legend(fontsize=8, loc="best")
    return figure


def _curve_panels(figure: Any, calibration: Calibration, rows: int, columns: int) -> None:
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    owner = dominant_pad(calibration.evaluation.pressure)
    for number, axes in enumerate(panels.flat):
        if number < len(calibration.skin.pads):
            _curve_panel(axes, calibration, number, owner == number)
        else:
            axes.set_visible(False)
    figure.supxlabel("pad pressure, kPa", fontsize=10)
    figure.supylabel("force, N", fontsize=10)


def _curve_panel(axes: Any, calibration: Calibration, number: int, mine: np.ndarray) -> None:
    fitted, found = calibration.curves.pad(number), calibration.evaluation
    axes.plot(found.pressure[mine, number] / 1e3, found.force[mine], "o", ms=3, color="black", alpha=0.5)
    low, high = np.asarray(fitted.pressure_range, float)
    if np.isfinite([low, high]).all():
        pressure = np.linspace(low, high, 101)
        predicted = fitted.predict(jnp.asarray(pressure))
        force = np.asarray(predicted.force, float)
        half = 1.96 * np.asarray(predicted.standard_error, float)
        axes.fill_between(pressure / 1e3, force - half, force + half, color=_BLUE, alpha=0.3, lw=0)
        axes.plot(pressure / 1e3, force, color=_BLUE, lw=1.5)
    title = f"pad {number} {_plain(calibration.skin.pads[number].name)}"
    axes.set_title(f"{title}\n{np.count_nonzero(mine)} presses", fontsize=9.5)
    axes.grid(alpha=0.25)


def _residual(evaluation: Evaluation) -> np.ndarray:
    """Estimated minus true force, (presses,) N."""
    return evaluation.total_force - evaluation.force


def _residual_map(figure: Any, axes: Any, calibration: Calibration) -> None:
    residual = _residual(calibration.evaluation)
    reach = _reach(residual)
    _sheet(axes, calibration.skin)
    position = calibration.evaluation.position
    drawn = _value_map(axes, position, residual, -reach, reach, "RdBu_r")
    figure.colorbar(drawn, ax=axes, shrink=0.85, extend="both").set_label("estimated − true force, N")
    axes.set_title("Force error by place", fontsize=10)


def _residuals_by(
    axes: Any, cause: Callable[[Evaluation], np.ndarray], own: Evaluation, evaluations: Mapping[str, Evaluation]
) -> None:
    """Force errors over what may explain them, (presses,) of each evaluation."""
    axes.axhline(0, color=_GREY, lw=1)
    axes.plot(
        cause(own),
        _residual(own),
        "o",
        ms=3,
        alpha=0.5,
        color="black",
        label=f"this calibration, held out by {_plain(own.held_out_by)}",
    )
    for number, (name, other) in enumerate(evaluations.items()):
        colour = _MARKS[number % len(_MARKS)]
        axes.plot(cause(other), _residual(other), "D", ms=5, color=colour, label=_plain(name))
    axes.set_ylabel("estimated − true, N")
    axes.grid(alpha=0.25)


def loops_figure(calibration: Calibration) -> "Figure":
    """Force against pressure along one whole press of each pad, loading and unloading, with the fitted law.

    The law is that of the pad times the gain at the place of the press; of a law with hysteresis, the law's own loop.

    Raises:
        ReportError: the calibration holds no presses with unloading, or matplotlib is not installed.
    """
    if not has_loops(calibration):
        raise ReportError("this calibration holds no loading and unloading; calibrate from presses that were released")
    pads = len(calibration.skin.pads)
    columns = min(pads, 4)
    rows = -(-pads // columns)
    figure = _figure(9.6, 2.9 * rows + 0.7, calibration.simulated)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for number, axes in enumerate(panels.flat):
        if number < pads:
            _loop_panel(axes, calibration, number)
        else:
            axes.set_visible(False)
    handles = {
        label: line for axes in panels.flat for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    for axes in panels[-1]:
        axes.set_xlabel("pad pressure, kPa")
    for axes in panels[:, 0]:
        axes.set_ylabel("force, N")
    return figure


def has_loops(calibration: Calibration) -> bool:
    """Whether there is a press with loading and unloading to be drawn."""
    loops = calibration.loops
    return loops is not None and any(map(loops.unloads, range(len(calibration.skin.pads))))


def _loop_panel(axes: Any, calibration: Calibration, number: int) -> None:
    loops, fitted = calibration.loops, calibration.curves.pad(number)
    assert loops is not None
    pressure, force, top = loops.of(number)
    width = "no press of its own"
    if len(pressure):
        law = loops.gain[number] * np.asarray(fitted.predict(jnp.asarray(pressure)).force, float)
        for part, colour, name in ((slice(0, top + 1), _BLUE, "loading"), (slice(top, None), _RED, "unloading")):
            axes.plot(pressure[part] / 1e3, force[part], ".-", ms=3, lw=0.8, color=colour, label=name)
        axes.plot(pressure / 1e3, law, color="black", lw=1.3, label="fitted law")
        found = loops.width(number)
        width = f"loading − unloading {found:.2f} N" if np.isfinite(found) else "not unloaded"
    axes.set_title(f"pad {number} {_plain(calibration.skin.pads[number].name)}\n{width}", fontsize=9.5)
    axes.grid(alpha=0.25)


def gain_figure(calibration: Calibration) -> "Figure":
    """Each pad's gain over the place pressed, and its standard error with the places from which it was fitted.

    Raises:
        ReportError: the calibration has no correction by location, or matplotlib is not installed.
    """
    field = calibration.field
    if field is None:
        raise ReportError("this calibration has no correction by location; calibrate with --location")
    skin = calibration.skin
    figure = _figure(9.6, 4.8, calibration.simulated)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    x, y, gain, error = zip(*(_pad_gain(field, i, pad.outline) for i, pad in enumerate(skin.pads)), strict=True)
    reach = _most(np.stack(gain) - 1)
    _pad_maps(figure, panels[0], skin, zip(x, y, gain, strict=True), (1 - reach, 1 + reach, "RdBu_r"), "gain")
    shades = (0, _most(np.stack(error)), "Purples")
    _pad_maps(figure, panels[1], skin, zip(x, y, error, strict=True), shades, "standard error of the gain, %")
    place = calibration.evaluation.estimated.get("fitted", np.empty((0, 2))) * _MM
    panels[1].plot(*place.T, ".", ms=2.5, color="black", zorder=3)
    panels[0].set_title("Gain by place", fontsize=10)
    panels[1].set_title("Its standard error, and the places of the presses", fontsize=10)
    _one_row(panels)
    return figure


_CELLS = 48  # along each side of a pad


def _pad_gain(field: FittedField, number: int, outline: np.ndarray) -> tuple[np.ndarray, ...]:
    """Centres of cells x, y (m) over a pad's box, and there (y, x) its gain and the gain's standard error, %."""
    low, high = outline.min(0), outline.max(0)
    x, y = (low + (high - low) * (np.arange(_CELLS)[:, None] + 0.5) / _CELLS).T
    position = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    places = single_places(jnp.asarray(position, field.coefficients.dtype), field.geometry.pads)
    mean, variance = (np.asarray(part, float)[:, number].reshape(len(y), len(x)) for part in log_gain(field, places))
    return x, y, np.exp(mean), 100 * np.sqrt(variance)


def _most(deviation: np.ndarray) -> float:
    """The end of a colour scale for all values; a field of none still has one."""
    return max(float(np.abs(deviation).max()), 0.01)


def _pad_maps(figure: Any, axes: Any, skin: je.Skin, cells: Iterable, scale: tuple, label: str) -> None:
    """Values on each pad (x, y, values) as cells cut along its outline, with their scale (low, high, colours)."""
    low, high, colours = scale
    options = {"vmin": low, "vmax": high, "cmap": colours, "zorder": 0}
    for pad, (x, y, values) in zip(skin.pads, cells, strict=True):
        drawn = axes.pcolormesh(_edges(x) * _MM, _edges(y) * _MM, values, **options)
        drawn.set_clip_path(Polygon(pad.outline * _MM, transform=axes.transData))
    figure.colorbar(drawn, ax=axes, shrink=0.85).set_label(label)
    axes.use_sticky_edges = False
    _sheet(axes, skin)


@dataclass(frozen=True, eq=False)
class ForceSeries:
    """Forces over time beside the truth.

    | meaning                                  | shape     | unit |
    |------------------------------------------|-----------|------|
    | title: what happens                      |           |      |
    | names of the contacts or pads            | (k,)      |      |
    | time                                     | (n,)      | s    |
    | true and estimated forces                | (n, k)    | N    |
    | events: name -> when                     |           | s    |
    """

    title: str
    names: tuple[str, ...]
    time: np.ndarray
    true: np.ndarray
    estimated: np.ndarray
    events: Mapping[str, float] = field(default_factory=dict)


def force_series_figure(series: Sequence[ForceSeries], *, simulated: bool = False) -> "Figure":
    """The paper's figure 8: force over time of contacts that come and go one by one, and below it the error.

    Raises:
        ReportError: matplotlib is not installed.
    """
    figure = _figure(9.6, 5.6, simulated)
    panels = figure.subplots(2, len(series), sharex="col", sharey="row", squeeze=False, height_ratios=[2, 1])
    for (above, below), one in zip(panels.T, series, strict=True):
        _series_panels(above, below, one)
    panels[0, 0].set_ylabel("force, N")
    panels[1, 0].set_ylabel("estimated − true, N")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _series_panels(above: Any, below: Any, one: ForceSeries) -> None:
    for k, name in enumerate(one.names):
        colour = _SERIES[k % len(_SERIES)]
        above.plot(one.time, one.true[:, k], "--", color=colour, lw=1.2)
        above.plot(one.time, one.estimated[:, k], color=colour, lw=1.4, label=_plain(name, 40))
        below.plot(one.time, one.estimated[:, k] - one.true[:, k], color=colour, lw=1.0)
    for name, when in one.events.items():
        for axes in (above, below):
            axes.axvline(when, color=_GREY, lw=0.7, zorder=0)
        at = {"xycoords": above.get_xaxis_transform(), "rotation": 90, "va": "top", "ha": "right"}
        above.annotate(_plain(name), (when, 0.98), fontsize=7.5, color="#555555", **at)
    above.plot([], [], "--", color="#333333", lw=1.2, label="true")
    above.set_title(_plain(one.title, 60), fontsize=10)
    above.grid(alpha=0.25)
    below.axhline(0, color=_GREY, lw=1)
    below.grid(alpha=0.25)
    below.set_xlabel("time, s")


# --- parts -----------------------------------------------------------------------------------------


def _figure(width: float, height: float, simulated: bool) -> "Figure":
    require_matplotlib()
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    if simulated:
        figure.suptitle("SIMULATED", color=_RED, fontsize=11, fontweight="bold")
    return figure


def _plain(text: str, limit: int = 24) -> str:
    """A name from a file as a label: on one line, never read as mathematics, in letters of the font."""
    known = "".join(c if c.isprintable() and c <= _LAST_IN_FONT else "?" for c in text)
    short = known if len(known) <= limit else known[: limit - 3] + "..."
    return short.replace("\\", "/").replace("$", r"\$")


def _reach(deviation: np.ndarray) -> float:
    """Half the span of a symmetric colour scale: nearly all values, so that one cannot wash out the rest."""
    size = np.abs(deviation[np.isfinite(deviation)])
    return float(max(np.percentile(size, 98), 1e-6)) if size.size else 1.0


def _sheet(axes: Any, skin: je.Skin) -> None:
    """The outlines of the sheet and its pads, and axes in mm."""
    rim = np.union1d(np.linspace(0, skin.domain.perimeter, 181), skin.domain.corners)
    axes.plot(*(skin.domain.boundary_point(rim) * _MM).T, color=_GREY, lw=1.2, zorder=1)
    for pad in skin.pads:
        axes.fill(*(pad.outline * _MM).T, fill=False, edgecolor="#555555", lw=0.9, zorder=2)
    axes.set_aspect("equal")
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")


def _electrodes(axes: Any, skin: je.Skin) -> None:
    """Polygons as they are, all others as circles of one size, for most are too small to see."""
    shapes = [e.outline.corner_points * _MM for e in skin.electrodes if isinstance(e, je.PolygonPatch)]
    round_ones = [not isinstance(e, je.PolygonPatch) for e in skin.electrodes]
    place = skin.electrode_positions[round_ones] * _MM
    if len(place):
        axes.plot(*place.T, "o", ms=9, mfc="none", mec=_GREEN, mew=1.6, label="electrode", zorder=2)
    label = None if len(place) else "electrode"
    axes.add_collection(PolyCollection(shapes, fc="none", ec=_GREEN, lw=1.6, label=label, zorder=2))


def _one_row(panels: Any) -> None:
    """Panels that share their axes: y is named once."""
    for axes in panels[1:]:
        axes.set_ylabel("")


def _value_map(axes: Any, position, values, low: float, high: float, colours: str) -> Any:
    """Values at places as coloured cells where the places form a grid, else as coloured marks."""
    options = {"vmin": low, "vmax": high, "cmap": colours}
    place, index = np.unique(np.round(position, 6), axis=0, return_inverse=True)
    index = index.ravel()
    mean = np.bincount(index, values) / np.bincount(index)
    x, y = np.unique(place[:, 0]), np.unique(place[:, 1])
    if min(len(x), len(y)) > 1 and len(x) * len(y) == len(place):
        cells = mean.reshape(len(x), len(y)).T
        return axes.pcolormesh(_edges(x) * _MM, _edges(y) * _MM, cells, zorder=0, **options)
    marks = {"s": 60, "edgecolors": "black", "linewidths": 0.5, "zorder": 3}
    return axes.scatter(*(place * _MM).T, c=mean, **marks, **options)


def _edges(centres: np.ndarray) -> np.ndarray:
    """Borders of cells about ascending centres."""
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])
