"""A short recording, and the skin of `weeks`, whose pads move, with its calibration."""

import pytest

import jaxeit as je
from calib.bench import simulate

from .quick_bench import SITES, bench
from .weeks import Skin


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("sessions")


@pytest.fixture(scope="session")
def grid(skin, folder):
    """16 presses, four on each pad."""
    return simulate(bench(skin, SITES), folder / "grid.h5", fidelity=je.Fidelity.draft(edge_length=0.05))


@pytest.fixture(scope="session")
def later(model, pixels):
    return Skin(model, pixels)


@pytest.fixture(scope="session")
def calibration(later):
    return later.calibration()
