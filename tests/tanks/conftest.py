from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je

from ..helpers import skin_of
from .rods import COUNT, CURRENT, PLACE, RADIUS


@pytest.fixture(scope="package")
def bench():
    """A tank with adjacent readings before and after a rod was put in, and potentials for any currents."""
    disc = je.Disc(RADIUS)
    rim = je.skin.rim_electrodes(disc, COUNT, contact=2e-3)
    skin = skin_of(disc, rim, je.skin.adjacent(COUNT), current=CURRENT)
    model = je.discretise(je.Scene(skin), je.Fidelity(edge_length=0.06))
    rod = jnp.linalg.norm(model.centroids - PLACE, axis=1) < 0.004
    frames = [je.forward(model, jnp.where(rod, gain, 1.0) * model.background) for gain in (1.0, 5.0)]
    return SimpleNamespace(skin=skin, model=model, frames=np.array(frames))
