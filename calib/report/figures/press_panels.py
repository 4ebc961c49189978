"""Panels of a calibration: images, force maps and contacts of presses, places, sensitivity, curves, loops and gain."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

import jaxeit as je

from ...calibration.calibration import Calibration
from ...calibration.evaluation import Evaluation
from ...presses.means import dominant_pad
from .maps import ExampleMaps, draw_contact
from .pads import curve_panel, loop_panel, pad_gain, pad_maps, residuals_by, symmetric_limit
from .panels import WIDE_PANEL_WIDTH, FigurePanel, chart_axes, panel, share_limits, sheet_axes
from .parts import GREEN, MM, RED, colour_reach, draw_pixels, value_map
from .presses import localisation_panel, sensitivity_maps, sensitivity_title

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DARK = "#111111"  # marks on maps, whose colours do not follow those of the page


def map_panels(maps: ExampleMaps) -> list[FigurePanel]:
    """Of each press its image, and its force map with the contact; common scales of colour."""
    change, density = float(np.nanmax(np.abs(maps.image))) or 1.0, float(np.nanmax(maps.density)) or 1.0
    scale, unit = (1e3, "mS") if change > 1e-4 else (1e6, "µS")
    out = []
    for k, force in enumerate(maps.shown.force):
        image = maps.image[k] * scale, (-change * scale, change * scale, "RdBu_r"), f"change of conductivity, {unit}"
        pressure = maps.density[k], (0.0, density, "viridis"), "force per area, kPa"
        out.append(_map_panel(maps, k, f"Press {k + 1}: EIT image, {force:.3g} N", f"image{k}", *image))
        total = maps.force[k].sum()
        out.append(_map_panel(maps, k, f"Press {k + 1}: force map, {total:.3g} N", f"map{k}", *pressure, contact=True))
    return out


def _map_panel(
    maps: ExampleMaps,
    k: int,
    title: str,
    name: str,
    values: np.ndarray,
    scale: tuple[float, float, str],
    label: str,
    *,
    contact: bool = False,
) -> FigurePanel:
    calibration = maps.calibration
    figure, axes, bar = sheet_axes(calibration.skin, bar=True, simulated=calibration.simulated)
    limits = axes.get_xlim(), axes.get_ylim()
    drawn = draw_pixels(axes, calibration.recon, values, scale)
    axes.set(xlim=limits[0], ylim=limits[1])
    figure.colorbar(drawn, cax=bar).set_label(label)
    axes.plot(*(maps.shown.position[k] * MM), "+", color=RED, ms=9)
    if contact:
        draw_contact(axes, maps.contacts.position[k], maps.contacts.covariance[k], maps.larger)
    axes.set_title(title)
    return panel(figure, axes, name)


def localisation_panels(
    found: Evaluation, skin: je.Skin, *estimators: str, simulated: bool = False
) -> list[FigurePanel]:
    """True and estimated places, a panel for each estimator, with the numbers of the electrodes."""
    out = []
    for k, estimator in enumerate(estimators):
        figure, axes, _ = sheet_axes(skin, simulated=simulated, width=WIDE_PANEL_WIDTH)
        localisation_panel(axes, found, skin, estimator)
        number_electrodes(axes, skin)
        out.append(panel(figure, axes, f"places{k}"))
    return out


def number_electrodes(axes: Any, skin: je.Skin) -> None:
    """Write the number of each electrode beside it, from 0 as in the protocol."""
    for number, place in enumerate(skin.electrode_positions * MM):
        beside = {"xytext": (5, 3), "textcoords": "offset points", "color": GREEN, "fontsize": 7}
        axes.annotate(str(number), place[:2], **beside)


def sensitivity_panels(found: Evaluation, skin: je.Skin, *, simulated: bool = False) -> list[FigurePanel]:
    """Sensitivity over its mean at every place, a panel for each method, with one scale of colour."""
    maps, summary = sensitivity_maps(found), found.summary()
    reach = colour_reach(np.concatenate(list(maps.values())) - 1)
    return [
        _value_panel(
            skin,
            found.position,
            values,
            (1 - reach, 1 + reach, "sensitivity / its mean"),
            sensitivity_title(name, summary),
            f"sensitivity{k}",
            simulated,
        )
        for k, (name, values) in enumerate(maps.items())
    ]


def _value_panel(
    skin: je.Skin,
    position: np.ndarray,
    values: np.ndarray,
    scale: tuple[float, float, str],
    title: str,
    name: str,
    simulated: bool,
) -> FigurePanel:
    low, high, label = scale
    figure, axes, bar = sheet_axes(skin, bar=True, simulated=simulated)
    limits = axes.get_xlim(), axes.get_ylim()
    drawn = value_map(axes, position, values, low, high, "RdBu_r")
    axes.set(xlim=limits[0], ylim=limits[1])
    _as_raster(drawn)
    figure.colorbar(drawn, cax=bar, extend="both").set_label(label)
    axes.set_title(title)
    return panel(figure, axes, name)


def _as_raster(drawn: Any) -> None:
    """Draw a collection as a picture within the vector graphics: thousands of cells make a page slow."""
    drawn.set_rasterized(True)


def curve_panels(calibration: Calibration, evaluations: Mapping[str, Evaluation]) -> list[FigurePanel]:
    """Curve of each pad with its presses; errors of force by place, by force and over time."""
    owner, simulated = dominant_pad(calibration.evaluation.pressure), calibration.simulated
    pads = _charts(
        calibration,
        lambda axes, number: curve_panel(axes, calibration, number, owner == number),
    )
    residual = np.asarray(calibration.evaluation.total_force - calibration.evaluation.force)
    reach = colour_reach(residual)
    scale = -reach, reach, "estimated − true force, N"
    place = calibration.evaluation.position
    return [
        *(panel(figure, axes, f"curve{k}") for k, (figure, axes) in enumerate(pads)),
        _value_panel(calibration.skin, place, residual, scale, "Force error by place", "error-place", simulated),
        _residual_panel(calibration, evaluations, lambda found: found.force, "force", "true force, N"),
        _residual_panel(calibration, evaluations, lambda f: np.arange(len(f.force)), "time", "number of the press"),
    ]


def _residual_panel(
    calibration: Calibration,
    evaluations: Mapping[str, Evaluation],
    cause: Callable[[Evaluation], np.ndarray],
    name: str,
    label: str,
) -> FigurePanel:
    figure, axes = chart_axes(simulated=calibration.simulated)
    shown = [calibration.evaluation, *evaluations.values()]
    residuals_by(axes, cause, calibration.evaluation, evaluations)
    axes.set_xlabel(label)
    axes.set_xlim(left=0, right=1.05 * max(float(cause(one).max(initial=0)) for one in shown) or 1.0)
    if evaluations:
        axes.legend(fontsize=7.5, loc="best")
    axes.set_title(f"Force error {'by' if name == 'force' else 'over'} {name}")
    return panel(figure, axes, f"error-{name}")


def loop_panels(calibration: Calibration) -> list[FigurePanel]:
    """Force against pressure along one press of each pad."""
    found = _charts(calibration, lambda axes, number: loop_panel(axes, calibration, number))
    for _, axes in found:
        if axes.lines:
            axes.legend(fontsize=8, loc="upper left", frameon=False)
    return [panel(figure, axes, f"loop{k}") for k, (figure, axes) in enumerate(found)]


def _charts(calibration: Calibration, draw: Callable[[Any, int], None]) -> list[tuple["Figure", Any]]:
    """A chart of force over pressure for each pad, with common axes."""
    found = [chart_axes(simulated=calibration.simulated) for _ in calibration.skin.pads]
    for number, (_, axes) in enumerate(found):
        draw(axes, number)
        axes.set(xlabel="pad pressure, kPa", ylabel="force, N")
    if found:
        share_limits([axes for _, axes in found])
    return found


def gain_panels(calibration: Calibration) -> list[FigurePanel]:
    """Each pad's gain over the place pressed, and the gain's standard error with the places of the presses."""
    field, skin = calibration.field, calibration.skin
    assert field is not None
    x, y, gain, error = zip(*(pad_gain(field, i, pad.outline) for i, pad in enumerate(skin.pads)), strict=True)
    reach = symmetric_limit(np.stack(gain) - 1)
    scales = (1 - reach, 1 + reach, "RdBu_r"), (0.0, symmetric_limit(np.stack(error)), "Purples")
    titles = "Gain by place", "Its standard error, and the places of the presses"
    out = []
    for k, (values, label) in enumerate(((gain, "gain"), (error, "standard error of the gain, %"))):
        figure, axes, bar = sheet_axes(skin, bar=True, simulated=calibration.simulated, width=WIDE_PANEL_WIDTH)
        limits = axes.get_xlim(), axes.get_ylim()
        drawn = pad_maps(axes, skin, zip(x, y, values, strict=True), scales[k])
        for cells in drawn:
            _as_raster(cells)
        figure.colorbar(drawn[-1], cax=bar).set_label(label)
        if k:
            place = calibration.evaluation.estimated.get("fitted", np.empty((0, 2))) * MM
            axes.plot(*place.T, ".", ms=2.5, color=DARK, zorder=3)
        axes.set(xlim=limits[0], ylim=limits[1], title=titles[k])
        out.append(panel(figure, axes, f"gain{k}"))
    return out
