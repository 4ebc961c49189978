"""Tanks of others: files of EIDORS, the Kuopio challenge, PyEIDORS, instruments and NumPy; images of their frames.

Example:
    import jax
    import numpy as np

    import calib
    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    disc = je.Disc(0.1)  # m
    rim = je.skin.rim_electrodes(disc, 16)
    tank = je.Skin("tank", disc, 1.0, rim, je.Protocol(je.skin.adjacent(16), 1e-3))
    model = je.discretise(je.Scene(tank), je.Fidelity.draft(edge_length=0.05))
    rod = np.linalg.norm(model.centroids - np.array([0.04, 0.02]), axis=1) < 0.015
    # V
    frames = np.stack(
        [je.forward(model), je.forward(model, np.where(rod, 0.1, 1.0) * model.background)]
    )
    # a file as yours may be
    np.savez("tank.npz", frames=frames, pattern=tank.protocol.pattern, amplitude=1e-3)

    # the last frame less the first
    found = calib.tanks.difference_image(calib.tanks.load_tank("tank.npz", disc))
    place = je.LevelCentroid(0.5)(-found.change, found.recon)
    print(f"the rod is at {1e3 * place} mm")
"""

from .formats import load_eidors, load_instrument, load_ktc, load_npz, load_pyeidors, load_sciospec, load_tank
from .images import TankConductivity, TankImage, conductivity_image, difference_image, segmented_frame
from .recording import Tank, TankError

__all__ = [
    "Tank",
    "TankConductivity",
    "TankError",
    "TankImage",
    "conductivity_image",
    "difference_image",
    "load_eidors",
    "load_instrument",
    "load_ktc",
    "load_npz",
    "load_pyeidors",
    "load_sciospec",
    "load_tank",
    "segmented_frame",
]
