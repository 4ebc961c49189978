"""The algebra of missing readings, in JAX and in NumPy, against least squares over the readings that are left."""

import numpy as np
import pytest

from jaxeit.imaging.readings.missing import DenseRows, Missing, PairRows, completed_sums, correlated, lost_by, removed
from jaxeit.linalg.array_libraries import JAX, NUMPY

READINGS, PAIRS, BASIS = 14, 7, 9
MISSING = np.array([2, 3, 11])
LEFT = np.setdiff1d(np.arange(READINGS), MISSING)


class Sensor:
    """P, W, a Jacobian of the pair sums and a prior precision."""

    def __init__(self, correlation: float):
        rng = np.random.default_rng(3)
        self.pairs = np.stack([rng.permutation(PAIRS)[:4] for _ in range(READINGS)])
        self.signs = 0.5 * np.array([1.0, -1.0, -1.0, 1.0])
        self.p = np.zeros((READINGS, PAIRS))
        np.add.at(self.p, (np.arange(READINGS)[:, None], self.pairs), self.signs)
        std = rng.uniform(0.5, 3, READINGS)
        place = np.arange(READINGS)
        self.noise = std[:, None] * std * correlation ** np.abs(place[:, None] - place)
        self.j, self.r = rng.normal(size=(PAIRS, BASIS)), np.diag(rng.uniform(0.5, 2, BASIS))
        self.dv = rng.normal(size=READINGS)

    def weight(self, readings):
        """The inverse noise of these readings, zero elsewhere."""
        weight = np.zeros((READINGS, READINGS))
        weight[np.ix_(readings, readings)] = np.linalg.inv(self.noise[np.ix_(readings, readings)])
        return weight

    def gram(self, readings):
        return self.p.T @ self.weight(readings) @ self.p

    def sums(self, readings):
        return self.p.T @ self.weight(readings) @ self.dv

    def factor(self, readings):
        return np.linalg.solve(self.j.T @ self.gram(readings) @ self.j + self.r, self.j.T)

    def image(self, readings):
        return self.factor(readings) @ self.sums(readings)

    def missing(self, library, rows):
        """The missing readings, and ``P^T W v`` with zeros in their place."""
        weight, known = self.weight(np.arange(READINGS)), np.where(np.isin(np.arange(READINGS), MISSING), 0, self.dv)
        array = library.namespace.asarray
        if rows == "correlated":
            block, residuals = weight[np.ix_(MISSING, MISSING)], (weight @ known)[MISSING]
            found = correlated(library, array((weight @ self.p)[MISSING]), array(block), array(residuals))
        else:
            few = {
                "pairs": PairRows(array(self.pairs[MISSING]), array(self.signs)),
                "dense": DenseRows(array(self.p[MISSING])),
            }[rows]
            found = Missing(few, array(np.diag(weight)[MISSING]), array(np.zeros(len(MISSING))))
        return found, array(self.p.T @ weight @ known)


@pytest.fixture(params=["pairs", "dense", "correlated"])
def rows(request):
    return request.param


@pytest.fixture
def sensor(rows):
    return Sensor(0.6 if rows == "correlated" else 0.0)


@pytest.fixture(params=[JAX, NUMPY], ids=["JAX", "NumPy"])
def library(request):
    return request.param


def test_a_completed_frame_gives_the_image_of_the_readings_left(sensor, rows, library):
    missing, sums = sensor.missing(library, rows)
    factor = sensor.factor(np.arange(READINGS))
    completed = completed_sums(library, missing, library.namespace.asarray(sensor.j @ factor), sums)
    np.testing.assert_allclose(factor @ np.asarray(completed), sensor.image(LEFT), rtol=1e-10)


@pytest.mark.parametrize("rows", ["dense", "correlated"], indirect=True)
def test_readings_removed_for_good_leave_the_reconstructor_of_the_others(sensor, rows, library):
    missing, sums = sensor.missing(library, rows)
    lost = lost_by(missing, sums)
    np.testing.assert_allclose(lost.gram, sensor.gram(np.arange(READINGS)) - sensor.gram(LEFT), atol=1e-12)
    np.testing.assert_allclose(lost.sums, sensor.sums(LEFT), rtol=1e-10)
    array, factor = library.namespace.asarray, sensor.factor(np.arange(READINGS))
    found = removed(library, array(lost.gram), array(sensor.j @ factor), array(factor))
    expected = sensor.factor(LEFT)
    np.testing.assert_allclose(found[0], sensor.j @ expected, atol=1e-12)
    np.testing.assert_allclose(found[1], expected, atol=1e-12)


def test_readings_added_to_none_give_their_own_image(library):
    sensor, array = Sensor(0.0), library.namespace.asarray
    weight = np.diag(sensor.weight(LEFT))[LEFT]
    prior = np.linalg.solve(sensor.r, sensor.j.T)
    added = Missing(PairRows(array(sensor.pairs[LEFT]), array(sensor.signs)), array(weight), array(sensor.dv[LEFT]))
    sums = completed_sums(library, added, array(-sensor.j @ prior), array(np.zeros(PAIRS)))
    np.testing.assert_allclose(prior @ np.asarray(sums), sensor.image(LEFT), rtol=1e-10)
