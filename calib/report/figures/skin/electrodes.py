"""The picture of electrodes that a calibration has placed: how far each sits from where the skin's file said."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ....calibration import Calibration
from ....calibration.localisation.electrode_places import PlacedElectrodes
from ....calibration.localisation.ellipses import INSIDE_90, confidence_ellipse
from ...html_parts import number_text
from ..panels import FigurePanel, panel, sheet_axes
from ..parts import GREEN, MM, RED, draw_sheet, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCALES = (1, 2, 5, 10, 20, 50)  # times that shifts are drawn larger
LONGEST = 0.4  # of the smallest distance between electrodes, that a drawn shift may cover


def electrodes_panels(calibration: Calibration) -> list[FigurePanel]:
    """The map, as a panel of the page."""
    figure, axes, _ = sheet_axes(calibration.skin, simulated=calibration.simulated)
    limits = axes.get_xlim(), axes.get_ylim()
    _draw(axes, calibration)
    axes.set(xlim=limits[0], ylim=limits[1])
    return [panel(figure, axes, "electrodes")]


def electrodes_figure(calibration: Calibration) -> "Figure":
    """The map, as a figure of its own."""
    figure = new_figure(6.6, 6.6, calibration.simulated)
    axes = figure.subplots()
    draw_sheet(axes, calibration.skin)
    _draw(axes, calibration)
    return figure


def about_electrodes(calibration: Calibration) -> tuple[str, str]:
    """Alternative text and caption."""
    placed, larger = calibration.electrodes, _larger(calibration)
    assert placed is not None
    size, error = (number_text(1e3 * float(np.sqrt(np.mean(v**2))), 2) for v in (placed.shift, placed.standard_error))
    alt = f"Map of the sheet with the shift of each electrode; root mean square {size} mm in each direction."
    caption = (
        "Where the electrodes sit: a circle is the place in the skin's file, a line leads to the place that untouched "
        f"frames and {placed.presses} presses tell, with the ellipse that holds it with 90 %"
        f"{f'; shifts and ellipses are drawn {larger} times larger' if larger > 1 else ''}. Standard error of a shift: "
        f"{error} mm (root mean square). What is left of the readings is {number_text(placed.misfit, 2)} of their "
        "errors. Lines that all point one way are a stage that is off; one long line is a bolt drilled aside, or two "
        "cables swapped."
    )
    return alt, caption


def _larger(calibration: Calibration) -> int:
    """Times that shifts are drawn larger than they are."""
    assert calibration.electrodes is not None
    positions = calibration.skin.electrode_positions
    gaps = np.linalg.norm(positions[:, None] - positions, axis=2)
    np.fill_diagonal(gaps, np.inf)
    reach = np.linalg.norm(calibration.electrodes.shift, axis=1) + INSIDE_90 * _radii(calibration.electrodes)
    return max(scale for scale in SCALES if scale == 1 or scale * reach.max() <= LONGEST * gaps.min())


def _blocks(placed: PlacedElectrodes) -> np.ndarray:
    """Covariance of each electrode's shift, (electrodes, 2, 2) m^2."""
    count, each = len(placed.shift), np.arange(len(placed.shift))
    return np.asarray(placed.covariance.reshape(count, 2, count, 2)[each, :, each])


def _radii(placed: PlacedElectrodes) -> np.ndarray:
    """Standard deviation of each electrode's shift in its worst direction, (electrodes,) m."""
    return np.sqrt(np.linalg.eigvalsh(_blocks(placed))[:, -1])


def _draw(axes: Any, calibration: Calibration) -> None:
    """Draw the places in the skin's file, the shifts and their ellipses."""
    placed, larger = calibration.electrodes, _larger(calibration)
    assert placed is not None
    before = calibration.skin.electrode_positions - placed.shift
    axes.plot(*before.T * MM, "o", ms=4, mfc="none", mec=GREEN, mew=1.2, zorder=3)
    for place, shift, covariance in zip(before, placed.shift, _blocks(placed), strict=True):
        there = place + larger * shift
        axes.plot(*np.stack([place, there], 1) * MM, color=RED, lw=1.4, zorder=4)
        axes.plot(*confidence_ellipse(there, covariance, larger * INSIDE_90).T * MM, color=RED, lw=0.8, zorder=4)
    axes.set_title(f"Shifts of the electrodes{f', {larger} times larger' if larger > 1 else ''}", fontsize=10)
