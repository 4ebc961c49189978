"""What the live page is told once: outlines, electrodes, the grid of the map, and the fixed scales of colour.

What was learned of the contact layer it is told whenever that has changed.
"""

import base64
from dataclasses import replace

import numpy as np

import jaxeit as je
from jaxeit.tracking import LearnedLayer

from ...calibration.application.force_maps import force_map
from ...calibration.calibration import Calibration
from ...calibration.localisation.ellipses import INSIDE_90
from ...calibration.logs.calibration import LogCalibration

RIM_POINTS = 121
MANTISSAS = np.array([1, 1.5, 2, 3, 4, 5, 6, 8, 10])  # full colour is one of these times a power of ten
CONTACT_SHARE = 0.1  # of the smallest pad's area, which bears the largest force where no press was kept


def page_scene(calibration: Calibration | LogCalibration) -> dict[str, object]:
    """Fixed contents of the page, in m and Pa; of a sensor without EIT only its name."""
    if isinstance(calibration, LogCalibration):
        return {"skin": calibration.stream, "simulated": calibration.simulated, "pads": [calibration.stream]}
    skin, recon = calibration.skin, calibration.recon
    centres = np.asarray(recon.centres)
    pressure, change = full_scales(calibration)
    rim = np.union1d(np.linspace(0, skin.domain.perimeter, RIM_POINTS), skin.domain.corners)
    return {
        "skin": skin.name,
        "simulated": calibration.simulated,
        "rows": recon.shape[0],
        "columns": recon.shape[1],
        "low": centres.min(0).tolist(),
        "high": centres.max(0).tolist(),
        "areas": _base64(np.asarray(recon.areas)),
        "bounds": [list(map(float, corner)) for corner in skin.domain.bounds],
        "rim": _rounded(skin.domain.boundary_point(rim)),
        "pads": [pad.name for pad in skin.pads],
        "outlines": [_rounded(pad.outline) for pad in skin.pads],
        "electrodes": _rounded(np.asarray(skin.electrode_positions)[:, :2]),
        "electrode_outlines": electrode_outlines(skin),
        "full_pressure": pressure,
        "full_change": change,
        "radius": INSIDE_90,
    }


def layer_maps(layer: LearnedLayer, centres: np.ndarray) -> dict[str, object]:
    """What was learned of the contact layer, at the centres of the pixels (pixels, 2) m.

    The values of full colour do not depend on what was learned: the means reach to two standard deviations of the gain
    before any contact, in both directions, and their standard deviations to one.
    """
    mean, deviation = layer.at(centres)
    unknown = float(np.hypot(layer.field.level, layer.field.deviation))
    return {
        "contacts": layer.contacts,
        "mean": _base64(mean),
        "deviation": _base64(deviation),
        "full_mean": rounded_up(2 * unknown),
        "full_deviation": rounded_up(unknown),
    }


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.astype("<f4").tobytes()).decode()


def electrode_outlines(skin: je.Skin) -> list[list[list[float]]]:
    """The outlines that are drawn to scale: of a ring two, of an electrode that is drawn as a mark none."""
    drawings = (electrode.drawing(skin.domain) for electrode in skin.electrodes)
    return [_rounded(outline) for drawing in drawings for outline in drawing.outlines]


def _rounded(points: np.ndarray) -> list[list[float]]:
    """Points to the nearest hundredth of a millimetre, which no screen shows."""
    rows: list[list[float]] = np.round(np.asarray(points, float), 5).tolist()
    return rows


def full_scales(calibration: Calibration) -> tuple[float, float | None]:
    """Force per area (Pa) and change of sheet conductivity (S) that have the full colour, whatever a frame shows.

    They are the largest in the maps and images of the calibration's presses of nearly the largest force, rounded up.
    Each map sums to the force of the load cell, so that nothing needs to be located, which takes seconds to compile.
    Without such presses (a file of an early version): the largest calibrated force over a tenth of the smallest pad,
    and None.
    """
    recon, shown = calibration.recon, calibration.examples
    if shown is None:
        area = min(pad.area for pad in calibration.skin.pads)
        return rounded_up(float(np.max(calibration.evaluation.force)) / (CONTACT_SHARE * area)), None
    areas = np.asarray(recon.areas)
    unlocated = replace(calibration, field=None, locator=None)
    map_force = np.asarray(force_map(unlocated, shown.dv, shown.pressure).map.force)[:, areas > 0]
    total = map_force.sum(1)
    force = map_force * np.where(total > 0, shown.force / np.where(total > 0, total, 1), 0)[:, None]
    change = np.abs(np.asarray(recon(np.asarray(shown.dv, recon.dtype))))
    return rounded_up(float((force / areas[areas > 0]).max())), rounded_up(float(change.max()))


def rounded_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 4, 5, 6, 8 and 10 times a power of ten; 1 for what is not above zero."""
    if not value > 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * MANTISSAS[np.searchsorted(MANTISSAS, value / power * (1 - 1e-12))])
