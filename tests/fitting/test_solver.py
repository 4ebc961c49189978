"""The least squares that curves are fitted with, against SciPy's and losses differentiated."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy import optimize

from calib.fitting.losses import AbstractLoss, Cauchy, Huber, SoftL1, Squared
from jaxeit.least_squares import LevenbergMarquardt

MATRIX = jnp.asarray(np.random.default_rng(0).normal([0, 0, 1, 1], 1, (40, 4)))
PUSHED = jnp.array([1.0, -0.5, 2.0, -3.0])
NONE = jnp.full(4, -jnp.inf)


@partial(jax.jit, static_argnames=("function", "max_steps"))
def found(function, start, args, lower, curvature=jnp.ones_like, max_steps=64):
    options = {"lower": lower, "curvature": curvature}
    solver = LevenbergMarquardt(1e-9, 1e-9)
    solution = optx.least_squares(function, solver, start, args, options, max_steps=max_steps, throw=False)
    return solution.value, solution.result == optx.RESULTS.successful, solution.stats["num_steps"]


def line(x, y):
    return MATRIX @ x - y


def test_parameters_pushed_against_their_bounds_rest_there_and_the_others_are_as_is_best():
    y = MATRIX @ PUSHED + jnp.sin(jnp.arange(40.0))
    got, ended, steps = found(line, jnp.ones(4), y, jnp.zeros(4))
    best = optimize.lsq_linear(np.asarray(MATRIX), np.asarray(y), (0, np.inf), tol=1e-14)
    assert ended
    assert steps < 15
    assert 0 < (best.active_mask == -1).sum() < 4
    np.testing.assert_allclose(got, best.x, atol=1e-7)


def test_one_that_starts_on_its_bound_leaves_it_where_that_is_better():
    got, ended, _ = found(line, jnp.zeros(4), MATRIX @ jnp.abs(PUSHED), jnp.zeros(4))
    assert ended
    np.testing.assert_allclose(got, jnp.abs(PUSHED), rtol=1e-9)


def steep(x, _):
    return jnp.arctan(x)


def test_a_step_that_leads_uphill_is_not_taken():
    """Newton's own steps from here double the distance."""
    got, ended, _ = found(steep, jnp.array([3.0, -2.0, 2.5, 1.0]), None, NONE)
    assert ended
    np.testing.assert_allclose(got, 0, atol=1e-9)


def nowhere(x, _):
    return jnp.where(jnp.arange(4) < 5, jnp.nan, x)


def test_what_is_not_finite_never_ends_well():
    got, ended, steps = found(nowhere, PUSHED, None, NONE, max_steps=7)
    assert not ended
    assert steps == 7
    np.testing.assert_array_equal(got, PUSHED)


OUTLIERS = MATRIX @ PUSHED + jnp.where(jnp.arange(40) % 5, 0.1, 30.0) * jnp.cos(jnp.arange(40.0))


def robust(x, loss: AbstractLoss):
    return loss.transform(line(x, OUTLIERS))


def test_with_the_losss_own_curvature_a_few_steps_suffice():
    slow, ended, many = found(robust, PUSHED, SoftL1(), NONE)
    quick, ended_too, few = found(robust, PUSHED, SoftL1(), NONE, SoftL1().curvature)
    assert ended
    assert ended_too
    assert few < 0.7 * many
    np.testing.assert_allclose(quick, slow, rtol=1e-7)


@pytest.mark.parametrize("loss", [Cauchy(), Huber(), SoftL1(), Squared()], ids=lambda loss: type(loss).__name__)
def test_curvature_is_the_second_derivative_over_that_of_gauss_and_newton(loss):
    r = jnp.asarray([-50.0, -2.7, -1.0, -1e-4, 1e-9, 0.3, 1.2, 2.0, 1e3])
    t, slope = jax.jvp(loss.transform, (r,), (jnp.ones_like(r),))
    np.testing.assert_allclose(loss.curvature(t), loss.dpsi(r) / slope**2, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dtype", ["f8", "f4"])
@pytest.mark.parametrize("loss", [Cauchy(), Huber(), SoftL1()], ids=lambda loss: type(loss).__name__)
def test_what_is_further_off_than_its_square_can_be_told_is_not_near(loss, dtype):
    """A step out of the range of numbers would be the best of all."""
    far = jnp.asarray([1e3, 1e30 if dtype == "f4" else 1e200], dtype)
    near, beyond = loss.transform(far)
    assert beyond > near
    assert np.isfinite(beyond)
