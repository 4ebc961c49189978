"""Maps of what was learned of the contact layer's gain."""

from typing import TYPE_CHECKING

import numpy as np

import jaxeit as je
from jaxeit.tracking import ContactLaw, LearnedLayer

from ....calibration import Calibration
from ...html_parts import number_text
from ..pads import symmetric_limit
from ..panels import FigurePanel, panel, sheet_axes
from ..parts import draw_pixels, draw_sheet, label_y_once, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLES = "Gain of the contact layer", "Its standard deviation"
LABELS = "gain", "standard deviation of the gain, %"


def layer_maps(layer: LearnedLayer, recon: je.imaging.AbstractReconstructor) -> tuple[np.ndarray, np.ndarray]:
    """The gain of the layer in each pixel, (rows, columns), and its standard deviation, %; NaN off the sheet."""
    mean, deviation = layer.at(np.asarray(recon.centres, float))
    there = np.asarray(recon.areas) > 0
    gain, spread = np.where(there, np.exp(mean), np.nan), np.where(there, 100 * deviation, np.nan)
    return gain.reshape(recon.shape), spread.reshape(recon.shape)


def layer_panels(calibration: Calibration) -> list[FigurePanel]:
    """The two maps, a panel each."""
    out = []
    for k, (values, scale) in enumerate(_drawn(calibration)):
        figure, axes, bar = sheet_axes(calibration.skin, bar=True, simulated=calibration.simulated)
        limits = axes.get_xlim(), axes.get_ylim()
        drawn = draw_pixels(axes, calibration.recon, values, scale)
        figure.colorbar(drawn, cax=bar).set_label(LABELS[k])
        axes.set(xlim=limits[0], ylim=limits[1], title=TITLES[k])
        out.append(panel(figure, axes, f"layer{k}"))
    return out


def layer_figure(calibration: Calibration) -> "Figure":
    """Both maps side by side."""
    figure = new_figure(9.6, 4.4, calibration.simulated)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for k, (axes, (values, scale)) in enumerate(zip(panels, _drawn(calibration), strict=True)):
        drawn = draw_pixels(axes, calibration.recon, values, scale)
        figure.colorbar(drawn, ax=axes, shrink=0.85).set_label(LABELS[k])
        draw_sheet(axes, calibration.skin)
        axes.set_title(TITLES[k], fontsize=10)
    label_y_once(panels)
    return figure


def about_layer(layer: LearnedLayer, law: ContactLaw | None) -> tuple[str, str]:
    """Alternative text and caption; with the law of contacts, if one was learned."""
    alt = "Two maps of the sheet: the gain of the contact layer, and its standard deviation."
    level = number_text(100 * layer.field.deviation, 0)
    caption = (
        f"How strongly the contact layer answers to pressure, as told by {layer.contacts} contacts whose forces the "
        "pads knew; 1 is the layer of the model. Contacts and loads are placed with it. Where nobody pressed, the "
        f"standard deviation is that of a layer of which nothing is known, {level} % or more: press there."
    )
    return alt, caption if law is None else f"{caption} Force where no pad tells it: {law.render()}."


def _drawn(calibration: Calibration) -> list[tuple[np.ndarray, tuple[float, float, str]]]:
    """The maps with their scales of colour."""
    assert calibration.layer is not None
    gain, spread = layer_maps(calibration.layer, calibration.recon)
    reach = symmetric_limit(np.nan_to_num(gain - 1))
    return [(gain, (1 - reach, 1 + reach, "RdBu_r")), (spread, (0.0, float(np.nanmax(spread)), "Purples"))]
