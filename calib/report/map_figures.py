"""EIT images and force maps of some presses, over the outlines of sheet and pads."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..calibration.calibration import Calibration
from ..calibration.force_maps import force_map
from .figures import MM, RED, draw_sheet, label_y_once, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def maps_figure(calibration: Calibration) -> "Figure":
    """The image of each example above its force map; a cross marks the true place. The calibration has examples."""
    shown = calibration.examples
    assert shown is not None
    found, recon = force_map(calibration, shown.dv, shown.pressure), calibration.recon
    image = np.asarray(recon(np.asarray(shown.dv, recon.dtype)))
    force = np.asarray(found.map.force)
    count, areas = len(shown.force), np.asarray(recon.areas)
    figure = new_figure(2.6 * count + 1.2, 6.0, calibration.simulated)
    panels = figure.subplots(2, count, sharex=True, sharey=True, squeeze=False)
    density = np.where(areas > 0, force / np.where(areas > 0, areas, 1), 0.0) / 1e3
    _row(figure, panels[0], calibration, image, "RdBu_r", "change of conductivity, S", symmetric=True)
    _row(figure, panels[1], calibration, density, "viridis", "force per area, kPa", symmetric=False)
    for number, (above, below) in enumerate(panels.T):
        above.set_title(f"{shown.force[number]:.3g} N", fontsize=9.5)
        below.set_title(f"map: {force[number].sum():.3g} N", fontsize=9.5)
        for axes in (above, below):
            axes.plot(*(shown.position[number] * MM), "+", color=RED, ms=9)
    for row in panels:
        label_y_once(row)
    return figure


def _row(
    figure: Any, panels: Any, calibration: Calibration, values: np.ndarray, colours: str, label: str, *, symmetric: bool
) -> None:
    """One row of pictures (n, pixels) with a common colour scale."""
    recon = calibration.recon
    high = float(np.nanmax(np.abs(values))) or 1.0
    low = -high if symmetric else 0.0
    extent = np.asarray(recon.extent, float) * MM
    for axes, picture in zip(panels, values, strict=True):
        drawn = axes.imshow(
            picture.reshape(recon.shape), origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high
        )
        draw_sheet(axes, calibration.skin)
    figure.colorbar(drawn, ax=panels, shrink=0.8, pad=0.02).set_label(label)
