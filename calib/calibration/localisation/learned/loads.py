"""What the presses that a calibration kept tell of loads: law of pressure, texture of the gain, error of the model."""

from typing import Any

import numpy as np

import jaxeit as je
from jaxeit.contacts import LoadSettings
from jaxeit.contacts.loads import scaled_law

from ...calibration import Calibration
from .probes import depth_of_loads

MIN_PRESSES, MAX_PRESSES = 12, 16  # presses from which loads are learned; more take longer and hardly tell more


def learned_loads(calibration: Calibration, model: je.Model, known: dict[str, Any]) -> tuple[LoadSettings | None, str]:
    """Settings of loads by the presses that the calibration kept (`jaxeit.contacts.learn_loads`), and a line of them.

    No settings, and why not, where it kept too few that are whole, as one of an early version, or where fits of them do
    not converge.

    Args:
        known: noise, sigma and channels of the frames whose loads are to be fitted.
    """
    probes = calibration.probes
    if probes is None:
        return None, "nothing, as the calibration kept no presses; calibrate anew"
    # Each press is far from those before it.
    whole = np.flatnonzero(np.isfinite(probes.dv[:, known["channels"]]).all(1))[:MAX_PRESSES]
    if len(whole) < MIN_PRESSES:
        count = f"{len(whole)} presses of the calibration lack no reading"
        return None, f"nothing, as {count}, and {MIN_PRESSES} are needed"
    frames, places, forces = probes.dv[whole], probes.position[whole], probes.force[whole]
    try:
        usual = LoadSettings(depth=depth_of_loads(calibration, model, known))
        learned = je.contacts.learn_loads(model, frames, places, forces, usual, gain=calibration.layer, **known)
    except je.imaging.InverseError as error:
        return None, f"nothing by the presses of the calibration: {error}"
    return learned, render_loads(learned)


def render_loads(loads: LoadSettings) -> str:
    """What was learned of loads, in one line."""
    line = f"pressure adds {_law_text(loads.law)}"
    if any(loads.forces.logs):
        line += f", and for the forces told {_law_text(scaled_law(loads.law, loads.forces.logs))}"
    if loads.depth:
        line += f"; loads spread as at a depth of {1e3 * loads.depth:.1f} mm"
    return f"{line}; texture {loads.texture:.2f}, model error {100 * loads.model_error:.1f} %"


def _law_text(law: je.effects.ContactPiezoresistance) -> str:
    return (
        f"up to {100 * float(law.amplitude):.0f} % of conductivity, half of that at "
        f"{1e-3 * float(law.half_pressure):.0f} kPa (exponent {float(law.exponent):.2f})"
    )
