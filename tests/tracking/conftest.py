import numpy as np
import pytest

import jaxeit as je
from jaxeit.tracking import TrackerSettings, prepare_tracker

SETTINGS = TrackerSettings(most=2, unknowns=64, modes=8, pixels=250, columns=40)


@pytest.fixture(scope="session")
def blank(model):
    """Readings of the untouched testbed, V, and the noise of one, V."""
    v0 = np.asarray(je.forward(model))
    return v0, np.full(v0.size, 1e-3 * np.sqrt(np.mean(v0**2)))


@pytest.fixture(scope="session")
def tracker(model, skin, blank):
    """Of the testbed at draft fidelity, for two contacts at most."""
    return prepare_tracker(model, skin, SETTINGS, noise=blank[1])
