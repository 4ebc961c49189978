"""Which parameters are above zero: against active sets by SciPy, however badly the problem is conditioned."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import lsq_linear, nnls

from jaxeit.least_squares import DenseProblem, DiagonalProblem, DualNewton, InteriorPoint
from jaxeit.least_squares.non_negative import positive_by_interior_point, positive_by_newton

by_newton = jax.jit(lambda problem: problem.solution(positive_by_newton(problem, 40)))
by_interior_point = jax.jit(lambda problem: problem.solution(positive_by_interior_point(problem, 60)))


def problem_of(weight, seed=0):
    """Data of 15 for 24 parameters, whose singular values fall to a thousandth."""
    rng = np.random.default_rng(seed)
    left, _, right = np.linalg.svd(rng.normal(size=(15, 24)), full_matrices=False)
    jacobian = left * np.geomspace(1, 1e-3, 15) @ right
    return DiagonalProblem(jnp.asarray(jacobian), jnp.full(24, weight), jnp.asarray(rng.normal(size=15)))


def stacked(problem):
    """The same as plain least squares."""
    matrix = np.concatenate([problem.jacobian, np.diag(np.sqrt(problem.weight))])
    return matrix, np.append(problem.data, np.zeros(len(problem.weight)))


@pytest.mark.parametrize("weight", [1.0, 1e-2, 1e-6, 1e-12])
@pytest.mark.parametrize("seed", [0, 1])
def test_solutions_are_those_of_active_sets(weight, seed):
    problem = problem_of(weight, seed)
    expected = nnls(*stacked(problem))[0]
    assert 0 < np.count_nonzero(expected) < 24
    scale = expected.max()
    np.testing.assert_allclose(by_newton(problem), expected, atol=max(1e-11, 1e-15 / weight) * scale)
    np.testing.assert_allclose(by_interior_point(problem.dense()), expected, atol=1e-7 * scale)
    bounded = lsq_linear(*stacked(problem), (0, np.inf), tol=1e-13).x
    np.testing.assert_allclose(by_interior_point(problem.dense()), bounded, atol=1e-3 * scale)


@pytest.mark.parametrize("weight", [1.0, 1e-6])
def test_solutions_meet_their_conditions(weight):
    """Where x is zero the objective rises with it, elsewhere its slope vanishes."""
    dense = problem_of(weight).dense()
    x = np.asarray(by_interior_point(dense))
    slope = np.asarray(dense.hessian) @ x - np.asarray(dense.linear)
    assert np.abs(slope[x > 0]).max() < 1e-12
    assert slope[x == 0].min() > 0


def solved(problem, solver, start, objective, steps):
    return optx.minimise(objective, solver, start, problem, max_steps=steps, throw=False)


def test_newton_ends_by_itself_where_the_problem_is_easy():
    problem = problem_of(1.0)
    found = solved(problem, DualNewton(), jnp.zeros(15), lambda a, p: p.dual(a), 40)
    assert found.result == optx.RESULTS.successful
    assert found.stats["num_steps"] < 10
    np.testing.assert_array_equal(found.state.positive, by_newton(problem) > 0)
    np.testing.assert_allclose(found.value, problem.data - problem.jacobian @ by_newton(problem), atol=1e-12)


def test_the_interior_point_divides_the_gap_by_ten_whatever_the_condition():
    for weight in (1.0, 1e-6):
        dense = problem_of(weight).dense().of_order_one()
        found = solved(dense, InteriorPoint(0.0, 1e-12), jnp.ones(24), lambda x, p: p.value(x), 40)
        assert found.result == optx.RESULTS.successful
        assert 12 <= found.stats["num_steps"] < 25
        assert float(jnp.mean(found.value * found.state)) <= 1e-12


def test_a_wrong_set_gives_nothing_negative():
    """As of a search that was not finished."""
    problem = problem_of(1.0)
    for each in (problem, problem.dense()):
        assert np.asarray(each.solution(jnp.ones(24, bool))).min() == 0


def test_nothing_is_explained_by_nothing():
    problem = problem_of(0.1)
    nothing = DiagonalProblem(problem.jacobian, problem.weight, jnp.zeros(15))
    assert not np.asarray(by_newton(nothing)).any()
    dense = DenseProblem(problem.dense().hessian, jnp.zeros(24))
    assert not np.asarray(by_interior_point(dense)).any()
