"""The crosstalk matrix: found from presses far from a pad, with standard errors that hold, and removed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calib.presses.crosstalk import Crosstalk, fit_crosstalk, own_pressures


def pressed(rng, skin, places, *, noise=2.0):
    """Own pressures (n, pads) Pa of presses on a grid: the load is shared where its foam reaches over an edge."""
    low, high = (np.array([f(p.outline, 0) for p in skin.pads]) for f in (np.min, np.max))
    beside = np.maximum(np.maximum(low - places[:, None], places[:, None] - high), 0)
    reach = np.exp(-((np.linalg.norm(beside, axis=2) / 8e-3) ** 2))
    load = rng.uniform(500, 2000, len(places))[:, None]
    return reach / reach.sum(1, keepdims=True) * load + noise * rng.normal(size=reach.shape)


def grid():
    x, y = np.meshgrid(np.linspace(0.01, 0.19, 8), np.linspace(0.01, 0.19, 8))
    return np.column_stack([x.ravel(), y.ravel()])


def mixing(rng, size):
    matrix = rng.uniform(-0.02, 0.1, (4, 4)) * size
    np.fill_diagonal(matrix, 1)
    return matrix


def test_a_matrix_is_found_with_true_standard_errors(skin):
    pulls = []
    for seed in range(60):
        rng = np.random.default_rng([11, seed])
        matrix = mixing(rng, 1.0)
        found = fit_crosstalk(pressed(rng, skin, grid()) @ matrix.T, grid(), skin.pads)
        used = (found.matrix != 0) & ~np.eye(4, dtype=bool)
        pulls.append(((found.matrix - matrix) / found.standard_error)[used])
    pulls = np.concatenate(pulls)
    assert abs(pulls.mean()) < 0.25
    assert 0.8 < pulls.std() < 1.4  # elements below their significance are left out, and 32 places are few


def test_presses_of_separate_pads_give_no_crosstalk(skin):
    alarms = [
        fit_crosstalk(pressed(np.random.default_rng([13, k]), skin, grid()), grid(), skin.pads).present
        for k in range(40)
    ]
    assert np.mean(alarms) < 0.05


def test_one_bad_press_does_not_move_the_matrix(skin):
    rng = np.random.default_rng(5)
    matrix = mixing(rng, 1.0)
    reading = pressed(rng, skin, grid()) @ matrix.T
    reading[3] = [9e3, -4e3, 7e3, 100.0]
    found = fit_crosstalk(reading, grid(), skin.pads)
    np.testing.assert_allclose(found.matrix, matrix, atol=0.01)


def test_few_places_determine_nothing(skin):
    places = grid()[[0, 7, 56]]
    reading = pressed(np.random.default_rng(0), skin, places) @ mixing(np.random.default_rng(1), 1.0).T
    found = fit_crosstalk(reading, places, skin.pads)
    assert not found.present
    assert np.isnan(found.standard_error).all()


def test_own_pressures_invert_the_mixing_and_survive_a_dead_channel():
    matrix = mixing(np.random.default_rng(2), 1.0)
    own = np.array([[1000.0, 0, 20, -5], [3, 500, 0, 0]])
    np.testing.assert_allclose(Crosstalk(matrix, np.zeros((4, 4))).own(own @ matrix.T), own, atol=1e-9)
    dead = (own @ matrix.T) * [1, 1, np.nan, 1]
    found = np.asarray(own_pressures(jnp.asarray(matrix), jnp.asarray(dead)))
    assert np.isnan(found[:, 2]).all()
    np.testing.assert_allclose(found[:, [0, 1, 3]], own[:, [0, 1, 3]], rtol=0.01, atol=5.0)


def test_own_pressures_work_under_vmap_and_grad():
    matrix = jnp.asarray(mixing(np.random.default_rng(3), 1.0))
    rows = jnp.asarray(np.random.default_rng(4).normal(size=(5, 4)))
    each = jax.vmap(lambda row: own_pressures(matrix, row[None])[0])(rows)
    np.testing.assert_allclose(each, own_pressures(matrix, rows), rtol=1e-12)
    slope = jax.grad(lambda p: own_pressures(matrix, p[None]).sum())(rows[0])
    np.testing.assert_allclose(slope, np.linalg.solve(np.asarray(matrix).T, np.ones(4)), rtol=1e-10)


@pytest.mark.parametrize("pads", [1, 2])
def test_a_skin_of_few_pads(skin, pads):
    rng = np.random.default_rng(6)
    whole = pressed(rng, skin, grid())[:, :pads]
    found = fit_crosstalk(whole, grid(), skin.pads[:pads])
    assert found.matrix.shape == (pads, pads)
    assert not found.present
