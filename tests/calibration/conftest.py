"""The skin of `weeks`, whose pads move, and its calibration."""

import pytest

from .weeks import Skin


@pytest.fixture(scope="session")
def later(model, pixels):
    return Skin(model, pixels)


@pytest.fixture(scope="session")
def calibration(later):
    return later.calibration()
