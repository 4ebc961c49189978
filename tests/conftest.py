import jax
import pytest

import jaxeit as je

jax.config.update("jax_enable_x64", True)


@pytest.fixture(scope="session")
def skin():
    return je.load_skin("testbed")


@pytest.fixture(scope="session")
def model(skin):
    """The ideal testbed at draft fidelity, float64."""
    return je.discretise(je.Scene(skin), je.Fidelity.draft())


@pytest.fixture(scope="session")
def pixels(model):
    return je.Pixels(20).on(model)
