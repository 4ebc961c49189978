"""Skins on simulated robots: contact forces become readings of the skin and pressures of its pads, step by step.

Nothing here imports a simulator. `calib.simulators.mujoco` reads the contacts of MuJoCo; for another simulator give
places and forces to `place_contacts`.

Example:
    import jax
    import numpy as np

    import jaxeit as je
    from calib import simulators

    jax.config.update("jax_enable_x64", True)

    effects = (
        je.effects.LoadSpreading(),
        je.effects.ContactPiezoresistance(),
        je.effects.PadLeak(20.0),
    )
    scene = je.Scene(je.load_skin("testbed"), effects)
    skin = simulators.prepare_skin(
        scene, rate=50.0, fidelity=je.Fidelity.draft(), frames=simulators.Polarised()
    )
    state = skin.start(seed=0)
    step = je.bind(simulators.step, skin)
    for k in range(3):  # in the loop of your simulator
        # m, N, in space
        points, forces = np.array([[0.06 + 0.001 * k, 0.13, 0.0]]), np.array([[0.0, 0.0, -5.0]])
        placed = simulators.place_contacts(scene.skin, points, forces)
        state, readings = step(state, placed.contacts)
        print(f"{readings.load:.2f} N on the sheet, {readings.pressure} Pa, {readings.frame[0]:.4f} V")
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
