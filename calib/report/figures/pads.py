"""Figures of the pads: curves with their residuals, loading and unloading, and gain by location."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

import jaxeit as je

from ...calibration.calibration import Calibration
from ...calibration.evaluation import Evaluation
from ...fitting.fields import FittedField, log_gain, single_places
from ...presses.means import dominant_pad
from .parts import (
    BLUE,
    GREY,
    MARKS,
    MM,
    RED,
    ReportError,
    cell_edges,
    colour_reach,
    draw_sheet,
    label_y_once,
    new_figure,
    plain_label,
    value_map,
)

try:  # an extra: without it everything but the figures works
    from matplotlib.patches import Polygon
except ImportError:
    Polygon = None  # type: ignore[assignment,misc]

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def curves_figure(calibration: Calibration, evaluations: Mapping[str, Evaluation] = MappingProxyType({})) -> "Figure":
    """Curve and 95 % band of each pad with its presses; residuals by place, by force and over time.

    Residuals are estimated minus true force of held-out presses. The last two panels also show other sessions
    (``evaluations``, by name). Time is the number of the press.

    Raises:
        ReportError: matplotlib is not installed.
    """
    pads = len(calibration.skin.pads)
    columns = min(max(pads, 1), 4)
    rows = -(-pads // columns)
    figure = new_figure(9.6, 2.9 * rows + 5.2, calibration.simulated)
    halves: Any = figure.subfigures(2, 1, height_ratios=[2.9 * rows, 5.2], hspace=0.04)
    top, bottom = halves
    if pads:
        _curve_panels(top, calibration, rows, columns)
    panels = bottom.subplot_mosaic([["place", "force"], ["place", "order"]], width_ratios=[1.15, 1])
    layout: Any = figure.get_layout_engine()
    layout.set(w_pad=0.09)
    _residual_map(bottom, panels["place"], calibration)
    residuals_by(panels["force"], lambda found: found.force, calibration.evaluation, evaluations)
    panels["force"].set(xlabel="true force, N", xlim=(0, None))
    panels["force"].set_title("Force error by force", fontsize=10)
    residuals_by(panels["order"], lambda found: np.arange(len(found.force)), calibration.evaluation, evaluations)
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
            curve_panel(axes, calibration, number, owner == number)
        else:
            axes.set_visible(False)
    figure.supxlabel("pad pressure, kPa", fontsize=10)
    figure.supylabel("force, N", fontsize=10)


def curve_panel(axes: Any, calibration: Calibration, number: int, mine: np.ndarray) -> None:
    """Draw a pad's curve with its 95 % band and its presses, ``mine`` (presses,) bool."""
    fitted, found = calibration.curves.pad(number), calibration.evaluation
    axes.plot(found.pressure[mine, number] / 1e3, found.force[mine], "o", ms=3, color="black", alpha=0.5)
    low, high = np.asarray(fitted.pressure_range, float)
    if np.isfinite([low, high]).all():
        pressure = np.linspace(low, high, 101)
        predicted = fitted.predict(jnp.asarray(pressure))
        force = np.asarray(predicted.force, float)
        half = 1.96 * np.asarray(predicted.standard_error, float)
        axes.fill_between(pressure / 1e3, force - half, force + half, color=BLUE, alpha=0.3, lw=0)
        axes.plot(pressure / 1e3, force, color=BLUE, lw=1.5)
    title = f"pad {number} {plain_label(calibration.skin.pads[number].name)}"
    axes.set_title(f"{title}\n{np.count_nonzero(mine)} presses", fontsize=9.5)
    axes.grid(alpha=0.25)


def _residual(evaluation: Evaluation) -> np.ndarray:
    """Estimated minus true force, (presses,) N."""
    return np.asarray(evaluation.total_force - evaluation.force)


def _residual_map(figure: Any, axes: Any, calibration: Calibration) -> None:
    residual = _residual(calibration.evaluation)
    reach = colour_reach(residual)
    draw_sheet(axes, calibration.skin)
    position = calibration.evaluation.position
    drawn = value_map(axes, position, residual, -reach, reach, "RdBu_r")
    figure.colorbar(drawn, ax=axes, shrink=0.85, extend="both").set_label("estimated − true force, N")
    axes.set_title("Force error by place", fontsize=10)


def residuals_by(
    axes: Any, cause: Callable[[Evaluation], np.ndarray], own: Evaluation, evaluations: Mapping[str, Evaluation]
) -> None:
    """Force errors over a quantity that may explain them, (presses,) of each evaluation."""
    axes.axhline(0, color=GREY, lw=1)
    axes.plot(
        cause(own),
        _residual(own),
        "o",
        ms=3,
        alpha=0.5,
        color="black",
        label=f"this calibration, {plain_label(own.held_out)}",
    )
    for number, (name, other) in enumerate(evaluations.items()):
        colour = MARKS[number % len(MARKS)]
        axes.plot(cause(other), _residual(other), "D", ms=5, color=colour, label=plain_label(name))
    axes.set_ylabel("estimated − true, N")
    axes.grid(alpha=0.25)


def loops_figure(calibration: Calibration) -> "Figure":
    """Force against pressure along one complete press of each pad, loading and unloading, with the fitted curve.

    The curve is multiplied by the gain at the place of the press. A curve with hysteresis is drawn as a loop.

    Raises:
        ReportError: the calibration holds no presses with unloading, or matplotlib is not installed.
    """
    if not has_loops(calibration):
        raise ReportError("this calibration holds no loading and unloading; calibrate from presses that were released")
    pads = len(calibration.skin.pads)
    columns = min(pads, 4)
    rows = -(-pads // columns)
    figure = new_figure(9.6, 2.9 * rows + 0.7, calibration.simulated)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for number, axes in enumerate(panels.flat):
        if number < pads:
            loop_panel(axes, calibration, number)
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
    """Whether the calibration holds a press with loading and unloading."""
    loops = calibration.loops
    return loops is not None and any(map(loops.unloads, range(len(calibration.skin.pads))))


def loop_panel(axes: Any, calibration: Calibration, number: int) -> None:
    """Draw loading and unloading of a pad, with its fitted law."""
    loops, fitted = calibration.loops, calibration.curves.pad(number)
    assert loops is not None
    pressure, force, top = loops.of(number)
    width = "no press of its own"
    if len(pressure):
        law = loops.gain[number] * np.asarray(fitted.predict(jnp.asarray(pressure)).force, float)
        for part, colour, name in ((slice(0, top + 1), BLUE, "loading"), (slice(top, None), RED, "unloading")):
            axes.plot(pressure[part] / 1e3, force[part], ".-", ms=3, lw=0.8, color=colour, label=name)
        axes.plot(pressure / 1e3, law, color="black", lw=1.3, label="fitted law")
        found = loops.width(number)
        width = f"loading − unloading {found:.2f} N" if np.isfinite(found) else "not unloaded"
    axes.set_title(f"pad {number} {plain_label(calibration.skin.pads[number].name)}\n{width}", fontsize=9.5)
    axes.grid(alpha=0.25)


def gain_figure(calibration: Calibration) -> "Figure":
    """Maps of each pad's gain over the place pressed, and of its standard error with the fitted places.

    Raises:
        ReportError: the calibration has no correction by location, or matplotlib is not installed.
    """
    field = calibration.field
    if field is None:
        raise ReportError("this calibration has no correction by location; calibrate with --location")
    skin = calibration.skin
    figure = new_figure(9.6, 4.8, calibration.simulated)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    x, y, gain, error = zip(*(pad_gain(field, i, pad.outline) for i, pad in enumerate(skin.pads)), strict=True)
    reach = symmetric_limit(np.stack(gain) - 1)
    _gain_map(figure, panels[0], skin, zip(x, y, gain, strict=True), (1 - reach, 1 + reach, "RdBu_r"), "gain")
    shades = (0, symmetric_limit(np.stack(error)), "Purples")
    _gain_map(figure, panels[1], skin, zip(x, y, error, strict=True), shades, "standard error of the gain, %")
    place = calibration.evaluation.estimated.get("fitted", np.empty((0, 2))) * MM
    panels[1].plot(*place.T, ".", ms=2.5, color="black", zorder=3)
    panels[0].set_title("Gain by place", fontsize=10)
    panels[1].set_title("Its standard error, and the places of the presses", fontsize=10)
    label_y_once(panels)
    return figure


CELLS = 48  # along each side of a pad


def pad_gain(field: FittedField, number: int, outline: np.ndarray) -> tuple[np.ndarray, ...]:
    """Centres of cells x, y (m) over a pad's box, and there (y, x) its gain and the gain's standard error, %."""
    low, high = outline.min(0), outline.max(0)
    x, y = (low + (high - low) * (np.arange(CELLS)[:, None] + 0.5) / CELLS).T
    position = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    places = single_places(jnp.asarray(position, field.coefficients.dtype), field.geometry.pads)
    mean, variance = (np.asarray(part, float)[:, number].reshape(len(y), len(x)) for part in log_gain(field, places))
    return x, y, np.exp(mean), 100 * np.sqrt(variance)


def symmetric_limit(deviation: np.ndarray) -> float:
    """Upper end of a symmetric colour scale for all values; not zero even if all values are."""
    return max(float(np.abs(deviation).max()), 0.01)


def pad_maps(
    axes: Any, skin: je.Skin, cells: Iterable[Sequence[np.ndarray]], scale: tuple[float, float, str]
) -> list[Any]:
    """Draw values on each pad (x, y, values) as cells cut along its outline, with their scale (low, high, colours)."""
    low, high, colours = scale
    options = {"vmin": low, "vmax": high, "cmap": colours, "zorder": 0}
    out = []
    for pad, (x, y, values) in zip(skin.pads, cells, strict=True):
        drawn = axes.pcolormesh(cell_edges(x) * MM, cell_edges(y) * MM, values, **options)
        drawn.set_clip_path(Polygon(pad.outline * MM, transform=axes.transData))
        out.append(drawn)
    return out


def _gain_map(
    figure: Any,
    axes: Any,
    skin: je.Skin,
    cells: Iterable[Sequence[np.ndarray]],
    scale: tuple[float, float, str],
    label: str,
) -> None:
    drawn = pad_maps(axes, skin, cells, scale)
    figure.colorbar(drawn[-1], ax=axes, shrink=0.85).set_label(label)
    axes.use_sticky_edges = False
    draw_sheet(axes, skin)
