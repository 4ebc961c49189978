"""EIT images, force maps and contacts of some presses, over the outlines of sheet and pads."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...calibration.application.force_maps import force_map
from ...calibration.calibration import Calibration
from ...calibration.localisation.ellipses import INSIDE_90, confidence_ellipse
from ..example_contacts import example_contacts, half_axes
from ..html_parts import number_text
from .parts import MM, RED, draw_pixels, draw_sheet, label_y_once, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ExampleMaps:
    """Images (n, pixels) S, force maps (n, pixels) N and contacts of a calibration's examples.

    An example is a press with one tip: one contact is looked for, as in the fit. The search for several would be
    another program, which takes seconds to compile.
    """

    def __init__(self, calibration: Calibration):
        shown, recon = calibration.examples, calibration.recon
        assert shown is not None
        self.calibration, self.shown = calibration, shown
        self.image = np.asarray(recon(np.asarray(shown.dv, recon.dtype)))
        locator = None if calibration.locator is None else calibration.locator.single()
        of_one = replace(calibration, locator=locator)
        self.force = np.asarray(force_map(of_one, shown.dv, shown.pressure).map.force)
        self.contacts = example_contacts(calibration, self.image)
        self.larger = self.contacts.magnification(calibration.skin)

    @property
    def density(self) -> np.ndarray:
        """Force per area (n, pixels), kPa."""
        areas = np.asarray(self.calibration.recon.areas)
        return np.where(areas > 0, self.force / np.where(areas > 0, areas, 1), 0.0) / 1e3

    def rows(self) -> list[tuple[str, ...]]:
        """Of each press its number, true place, contact, half axes of its ellipse of 90 %, force and sum of the map."""

        def place(at: np.ndarray) -> str:
            return ", ".join(number_text(x * MM, 1) for x in at)

        each = zip(self.shown.position, self.contacts.position, self.contacts.covariance, strict=True)
        texts = [(place(true), place(found), place(half_axes(covariance))) for true, found, covariance in each]
        forces = zip(self.shown.force, self.force.sum(1), strict=True)
        return [
            (f"press {k + 1}", *text, number_text(float(force), 2), number_text(float(total), 2))
            for k, (text, (force, total)) in enumerate(zip(texts, forces, strict=True))
        ]


def maps_figure(maps: ExampleMaps) -> "Figure":
    """The image of each example above its force map with the contact; a cross marks the true place."""
    calibration, shown = maps.calibration, maps.shown
    count = len(shown.force)
    figure = new_figure(2.6 * count + 1.2, 6.0, calibration.simulated)
    panels = figure.subplots(2, count, sharex=True, sharey=True, squeeze=False)
    _row(figure, panels[0], calibration, maps.image, "RdBu_r", "change of conductivity, S", symmetric=True)
    _row(figure, panels[1], calibration, maps.density, "viridis", "force per area, kPa", symmetric=False)
    for k, (above, below) in enumerate(panels.T):
        above.set_title(f"{shown.force[k]:.3g} N", fontsize=9.5)
        below.set_title(f"map: {maps.force[k].sum():.3g} N", fontsize=9.5)
        for axes in (above, below):
            axes.plot(*(shown.position[k] * MM), "+", color=RED, ms=9)
        draw_contact(below, maps.contacts.position[k], maps.contacts.covariance[k], maps.larger)
    for row in panels:
        label_y_once(row)
    return figure


def draw_contact(axes: Any, position: np.ndarray, covariance: np.ndarray, larger: float) -> None:
    """Draw the ellipse of 90 % of a contact (m, m^2), so many times larger; nothing where it is not known."""
    if np.isfinite(position).all() and np.isfinite(covariance).all():
        points = confidence_ellipse(position, covariance, larger * INSIDE_90) * MM
        axes.plot(*points.T, color="#ffffff", lw=2.6, zorder=5)
        axes.plot(*points.T, color=RED, lw=1.4, zorder=6, gid="ellipse")


def _row(
    figure: Any, panels: Any, calibration: Calibration, values: np.ndarray, colours: str, label: str, *, symmetric: bool
) -> None:
    """One row of pictures (n, pixels) with a common colour scale."""
    high = float(np.nanmax(np.abs(values))) or 1.0
    scale = (-high if symmetric else 0.0, high, colours)
    for axes, picture in zip(panels, values, strict=True):
        drawn = draw_pixels(axes, calibration.recon, picture, scale, interpolation=None)
        draw_sheet(axes, calibration.skin)
    figure.colorbar(drawn, ax=panels, shrink=0.8, pad=0.02).set_label(label)
