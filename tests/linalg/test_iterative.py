"""Methods that work on each frame anew: their quick forms against the dense ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging.methods import Problem
from jaxeit.imaging.priors import AbstractPrior, Precision


class _Dense(AbstractPrior):
    """`Noser` as a matrix, whose diagonal form the methods do not see."""

    def precision(self, jacobian, picture, at=None):
        return Precision(je.Noser().precision(jacobian, picture).matrix())


@pytest.fixture(scope="module")
def problem(model):
    image = je.Pixels(12).on(model)
    scale = jnp.asarray(1e4)
    return lambda prior: Problem(
        je.jacobian(model, basis=image) * scale, jnp.asarray(550.0), jnp.asarray(0.1), prior, image.picture
    )


@pytest.fixture(scope="module")
def y(problem):
    jacobian = problem(je.Noser()).jacobian
    truth = np.zeros(144)
    truth[[40, 41, 100]] = [0.3, 0.2, 0.4]
    clean = np.asarray(jacobian) @ truth
    return jnp.asarray(clean + 0.01 * np.abs(clean).max() * np.random.default_rng(0).normal(size=550))


@pytest.mark.slow
def test_not_negative_in_data_space_is_the_interior_point_of_the_dense_form(problem, y):
    found = np.asarray(je.NonNegative().image(problem(je.Noser()), y))
    dense = np.asarray(je.NonNegative(60).image(problem(_Dense()), y))
    assert (found >= 0).all()
    assert 0 < np.count_nonzero(found) < 120
    np.testing.assert_allclose(found, dense, atol=1e-5 * dense.max())


def test_not_negative_meets_its_conditions_to_rounding(problem, y):
    """Where it is zero the gradient pushes down, elsewhere it vanishes."""
    noser = problem(je.Noser())
    x = je.NonNegative().image(noser, y)
    precision = noser.precision()
    square = noser.strength(precision.solve(noser.jacobian.T))
    slope = np.asarray(noser.jacobian.T @ (noser.jacobian @ x - y) + square * precision.times(x))
    size = float(jnp.max(jnp.abs(noser.jacobian.T @ y)))
    assert np.abs(slope[np.asarray(x) > 0]).max() < 1e-9 * size
    assert slope[np.asarray(x) == 0].min() > -1e-9 * size


@pytest.mark.slow
def test_not_negative_has_the_derivative_of_its_image(problem, y):
    noser, along = problem(je.Noser()), 1e-4 * y[::-1]
    image = jax.jit(lambda y: je.NonNegative().image(noser, y))
    change = (image(y + 1e-3 * along) - image(y - 1e-3 * along)) / 2e-3
    np.testing.assert_allclose(jax.jvp(image, (y,), (along,))[1], change, atol=1e-6 * float(jnp.max(jnp.abs(change))))
    what = jnp.arange(144.0)
    np.testing.assert_allclose(jax.grad(lambda y: image(y) @ what)(y) @ along, what @ change, rtol=1e-5)


def test_nothing_is_seen_in_nothing(problem):
    assert not np.asarray(je.NonNegative().image(problem(je.Noser()), jnp.zeros(550))).any()
