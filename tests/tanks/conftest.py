import pytest

from .rods import tank_with_rod


@pytest.fixture(scope="package")
def bench():
    return tank_with_rod()
