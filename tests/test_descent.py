"""The least squares that contacts are fitted with, on problems of two numbers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxeit.descent import TRIAL, _damped, descend, scale_of

ALIKE = jnp.array([[1.0, 0.9], [0.0, 0.5], [0.3, 0.3]])
WIDE = jnp.full(2, 1e6)


def sloped(function):
    return lambda x: (function(x), jax.jacfwd(function)(x))


@partial(jax.jit, static_argnames=("function", "steps"))
def descended(function, y, start, low=-WIDE, high=WIDE, hope=jnp.inf, steps=20):
    return descend(sloped(function), y, start, low, high, hope, steps)


def test_what_has_no_slope_has_a_scale():
    assert np.isfinite(scale_of(jnp.array([0.0, 4.0]))).all()
    assert np.isfinite(scale_of(jnp.zeros(2))).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_columns_that_are_alike_share_a_step(dtype):
    """Without damping too."""
    one = jnp.ones(2, dtype)
    step, expected = _damped(jnp.ones((2, 2), dtype), one, one > 0, jnp.zeros((), dtype))
    np.testing.assert_allclose(step, 0.5, rtol=1e-3)
    assert float(expected) == pytest.approx(1, rel=1e-3)


def test_a_number_pushed_against_its_bound_rests_there_and_the_other_goes_on():
    y = 1e3 * (ALIKE @ jnp.array([-1.0, 2.0]))
    fit = descended(ALIKE.__matmul__, y, jnp.ones(2), low=jnp.zeros(2))
    alone = float(ALIKE[:, 1] @ y / (ALIKE[:, 1] @ ALIKE[:, 1]))
    np.testing.assert_allclose(fit.flat, [0, alone], rtol=1e-3)
    assert (fit.flat >= 0).all()


def test_a_step_that_leads_uphill_is_not_taken():
    """Newton's own steps from here double the distance."""
    fit = descended(lambda x: 1e3 * jnp.arctan(x), jnp.zeros(2), jnp.array([3.0, -2.0]))
    np.testing.assert_allclose(fit.flat, 0, atol=1e-3)


def test_a_descent_that_leads_nowhere_is_given_up():
    def banana(x):
        return 1e3 * jnp.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    start = jnp.array([-1.2, 1.0])
    whole, few, hopeless = (
        descended(banana, jnp.zeros(2), start, **how) for how in ({}, {"steps": TRIAL}, {"hope": jnp.zeros(())})
    )
    np.testing.assert_array_equal(hopeless.flat, few.flat)
    assert whole.square < 0.2 * few.square
