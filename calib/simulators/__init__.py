"""Skins on simulated robots: contact forces become readings of the skin and pressures of its pads, step by step.

Nothing here imports a simulator. `calib.simulators.mujoco` reads the contacts of MuJoCo; for another simulator give
places and forces to `place_contacts`.
"""

from .contacts import ContactPoints, PlacedContacts, SimulatorError, place_contacts
from .frames import AbstractFrames, Polarised, Solved
from .skin import NOT_IN_A_STEP, SimulatedSkin, SkinReadings, SkinState, prepare_skin, step

__all__ = [
    "NOT_IN_A_STEP",
    "AbstractFrames",
    "ContactPoints",
    "PlacedContacts",
    "Polarised",
    "SimulatedSkin",
    "SimulatorError",
    "SkinReadings",
    "SkinState",
    "Solved",
    "place_contacts",
    "prepare_skin",
    "step",
]
