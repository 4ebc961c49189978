"""A round tank of 60 mm with 16 electrodes, and a conductive rod in it, whose place every file must give."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

import jaxeit as je
from calib.tanks import difference_image

from ..helpers import skin_of

COUNT, RADIUS, CURRENT = 16, 0.03, 5.5e-5
PLACE = np.array([0.012, 0.008])


def sees_the_rod(tank, tolerance=0.005):
    found = difference_image(tank, basis=je.Pixels(24))
    place = np.asarray(found.recon.centres)[np.argmax(found.change)]
    np.testing.assert_allclose(place, PLACE, atol=tolerance)
    assert found.correlation > 0.98
    return found


def tank_with_rod():
    """A tank with adjacent readings before and after a rod was put in, and potentials for any currents."""
    disc = je.Disc(RADIUS)
    rim = je.skin.rim_electrodes(disc, COUNT, contact=2e-3)
    skin = skin_of(disc, rim, je.skin.adjacent(COUNT), current=CURRENT)
    model = je.discretise(je.Scene(skin), je.Fidelity(edge_length=0.06))
    rod = jnp.linalg.norm(model.centroids - PLACE, axis=1) < 0.004
    frames = [je.forward(model, jnp.where(rod, gain, 1.0) * model.background) for gain in (1.0, 5.0)]
    return SimpleNamespace(skin=skin, model=model, frames=np.array(frames))
