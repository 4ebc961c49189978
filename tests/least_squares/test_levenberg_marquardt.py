"""The least squares that contacts, curves and images are fitted with, on problems of a few numbers."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxeit.contacts.fit import SOLVER, TRIAL_STEPS
from jaxeit.least_squares import BoundedDescent, Cholesky, ImplicitStep, LevenbergMarquardt, normal_equations
from jaxeit.least_squares.adjoint import conjugate_gradients
from jaxeit.least_squares.searches import inverse_scale, normal_inverse

ALIKE = jnp.array([[1.0, 0.9], [0.0, 0.5], [0.3, 0.3]])
WIDE = jnp.full(2, 1e6)


@partial(jax.jit, static_argnames=("function", "steps"))
def fitted(function, y, start, low=-WIDE, high=WIDE, steps=20, **options):
    return optx.least_squares(
        lambda x, y: y - function(x),
        SOLVER,
        start,
        y,
        {"lower": low, "upper": high, **options},
        max_steps=steps + 1,  # the first evaluates the start
        adjoint=ImplicitStep(),
        throw=False,
    )


def test_what_has_no_slope_has_a_scale():
    assert np.isfinite(inverse_scale(jnp.array([0.0, 4.0]))).all()
    assert np.isfinite(inverse_scale(jnp.zeros(2))).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_columns_that_are_alike_share_a_step(dtype):
    """Without damping too."""
    one = jnp.ones(2, dtype)
    step = normal_inverse(jnp.ones((2, 2), dtype), one > 0)(one)
    np.testing.assert_allclose(step, 0.5, rtol=1e-3)
    assert float(step @ one) == pytest.approx(1, rel=1e-3)


def test_a_number_pushed_against_its_bound_rests_there_and_the_other_goes_on():
    y = 1e3 * (ALIKE @ jnp.array([-1.0, 2.0]))
    fit = fitted(ALIKE.__matmul__, y, jnp.ones(2), low=jnp.zeros(2))
    alone = float(ALIKE[:, 1] @ y / (ALIKE[:, 1] @ ALIKE[:, 1]))
    np.testing.assert_allclose(fit.value, [0, alone], rtol=1e-3)
    assert (fit.value >= 0).all()


def test_upper_bounds_hold_too():
    y = 1e3 * (ALIKE @ jnp.array([1.0, -2.0]))
    fit = fitted(ALIKE.__matmul__, y, -jnp.ones(2), high=jnp.zeros(2))
    alone = float(ALIKE[:, 1] @ y / (ALIKE[:, 1] @ ALIKE[:, 1]))
    np.testing.assert_allclose(fit.value, [0, alone], rtol=1e-3)
    assert (fit.value <= 0).all()


def test_a_step_out_of_the_box_ends_at_the_bound_and_the_other_takes_what_is_best_then():
    """Of a quadratic, in one step: the whole step is (-1, 1.5), and along the bound the best is 0.5."""
    normal, gradient = jnp.array([[1.0, 0.5], [0.5, 1.0]]), jnp.array([0.25, -1.0])
    quadratic = normal_equations(jnp.zeros(2), jnp.eye(2))
    quadratic = type(quadratic)(quadratic.f, gradient, type(quadratic.hessian)(normal))
    at = jnp.array([0.5, 0.0])
    for low, expected in ((-WIDE, [-1.0, 1.5]), (jnp.zeros(2), [-0.5, 1.25])):
        descent = BoundedDescent().within(low, WIDE)
        step, _ = descent.step(jnp.asarray(1e12), descent.query(at, quadratic, descent.init(at, quadratic)))
        np.testing.assert_allclose(step, expected, rtol=1e-9)


def arctan(x):
    return 1e3 * jnp.arctan(x)


def test_a_step_that_leads_uphill_is_not_taken():
    """Newton's own steps from here double the distance."""
    fit = fitted(arctan, jnp.zeros(2), jnp.array([3.0, -2.0]))
    np.testing.assert_allclose(fit.value, 0, atol=1e-3)


def banana(x):
    return 1e3 * jnp.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


AWAY = jnp.array([-1.2, 1.0])


def test_a_descent_that_leads_nowhere_is_given_up():
    whole, few, hopeless = (
        fitted(banana, jnp.zeros(2), AWAY, **how) for how in ({}, {"steps": TRIAL_STEPS}, {"aim": jnp.zeros(())})
    )
    np.testing.assert_array_equal(hopeless.value, few.value)
    assert whole.state.square < 0.2 * few.state.square
    assert few.result == optx.RESULTS.nonlinear_max_steps_reached
    assert hopeless.result == optx.RESULTS.nonlinear_divergence


def test_a_descent_goes_on_from_where_it_was_left():
    begun = fitted(banana, jnp.zeros(2), AWAY, steps=TRIAL_STEPS)
    after = fitted(banana, jnp.zeros(2), begun.value, state=begun.state, steps=80)
    whole = fitted(banana, jnp.zeros(2), AWAY, steps=80)
    assert whole.result == after.result == optx.RESULTS.successful
    np.testing.assert_allclose(after.value, whole.value, rtol=1e-12)
    assert after.state.steps == whole.state.steps


def test_the_square_of_a_solution_is_that_of_its_residuals():
    """To first order: the last step is taken without an evaluation."""
    fit = fitted(banana, jnp.array([10.0, -20.0]), AWAY, steps=80)
    left = jnp.array([10.0, -20.0]) - banana(fit.value)
    assert fit.state.converged
    assert float(fit.state.square) == pytest.approx(float(left @ left), rel=1e-3, abs=1e-2)


def steep(x, y):
    """Residuals of order one, some of which are left over."""
    return jnp.sinh(0.5 * jnp.array([[1.0, 0.9], [0.0, 0.5], [0.3, -0.3]]) @ x) - y


def best(y, low, solver=None):
    solver = LevenbergMarquardt(1e-10, 1e-10) if solver is None else solver
    bounds = {} if low is None else {"lower": low}
    return optx.least_squares(steep, solver, jnp.ones(2), y, bounds, adjoint=ImplicitStep()).value


DATA = jnp.array([0.8, -0.4, 0.9])


@pytest.mark.parametrize("low", [None, jnp.zeros(2)], ids=["free", "bounded"])
def test_derivatives_are_those_of_the_minimum(low):
    """A number on its bound stays there; residuals that are left over bend the objective."""
    step = 1e-5 * jnp.eye(3)
    change = jnp.stack([(best(DATA + h, low) - best(DATA - h, low)) / 2e-5 for h in step], 1)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(best))(DATA, low), change, atol=1e-7)
    np.testing.assert_allclose(jax.jacrev(best)(DATA, low), change, atol=1e-7)
    assert (np.asarray(change) == 0).all(1).any() == (low is not None)


def test_second_derivatives_too():
    def size(y):
        return jnp.sum(best(y, None) ** 2)

    step = 1e-5 * jnp.eye(3)
    change = jnp.stack([(jax.grad(size)(DATA + h) - jax.grad(size)(DATA - h)) / 2e-5 for h in step])
    np.testing.assert_allclose(jax.hessian(size)(DATA), change, atol=1e-6)


def test_parts_of_optimistix_take_the_places_of_ours():
    newton = optx.NewtonDescent(linear_solver=Cholesky())
    solver = LevenbergMarquardt(1e-10, 1e-10, descent=newton, search=optx.BacktrackingArmijo())
    np.testing.assert_allclose(best(DATA, None, solver), best(DATA, None), rtol=1e-8)
    solver = LevenbergMarquardt(1e-10, 1e-10, search=optx.ClassicalTrustRegion())
    np.testing.assert_allclose(best(DATA, None, solver), best(DATA, None), rtol=1e-8)


def test_bounds_are_refused_by_a_descent_that_knows_none():
    solver = LevenbergMarquardt(1e-10, 1e-10, descent=optx.NewtonDescent(linear_solver=Cholesky()))
    with pytest.raises(ValueError, match="NewtonDescent knows no bounds"):
        best(DATA, jnp.zeros(2), solver)


def test_an_option_of_another_name_is_refused():
    with pytest.raises(ValueError, match=r"no option 'lowr'; did you mean 'lower'\?"):
        fitted(ALIKE.__matmul__, jnp.ones(3), jnp.ones(2), lowr=jnp.zeros(2))


def test_conjugate_gradients_solve_what_is_well_conditioned():
    matrix = jnp.diag(jnp.geomspace(1, 100, 30)) + 0.1
    right = jnp.sin(jnp.arange(30.0))
    found = jax.jit(partial(conjugate_gradients, matrix.__matmul__, near_inverse=lambda v: v / jnp.diagonal(matrix)))(
        right
    )
    np.testing.assert_allclose(found, jnp.linalg.solve(matrix, right), rtol=1e-8)
    np.testing.assert_array_equal(conjugate_gradients(matrix.__matmul__, jnp.zeros(30), lambda v: v), 0)


def test_conjugate_gradients_that_do_not_end_give_no_number():
    stiff = jnp.geomspace(1, 1e8, 400)
    assert np.isnan(conjugate_gradients(lambda v: stiff * v, jnp.ones(400), lambda v: v)).all()
