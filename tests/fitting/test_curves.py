"""Curves: bounds, inverses, gradients, starts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calib.fitting.curves import (
    CURVES,
    Affine,
    AffinePlay,
    Linear,
    MonotonePolynomial,
    MonotoneSpline,
    Play,
    PlaySpline,
    PowerLaw,
    fit_curves,
)
from calib.fitting.curves.base import Scale, resistant_line, scale_of
from calib.fitting.curves.play_operators import play
from calib.fitting.results import FitError

CASES = [
    (Linear(), [4e-3]),
    (Affine(), [4e-3, -2.0]),
    (PowerLaw(2000.0), [4e-3, 0.6]),
    (PowerLaw(2000.0), [4e-3, 1.7]),
    (MonotonePolynomial(4000.0), [2.0, 5.0, 12.0]),
    (MonotoneSpline(4000.0), [4e-3, 2e-3, 3e-3, 6e-3, 8e-3]),
    (Play([150.0, 400.0, 900.0]), [3e-3, 4e-3, 5e-3, 8e-3]),
    (AffinePlay([75.0, 150.0, 300.0]), [9e-3, 4e-3, 4e-3, 3e-3, -2.0]),
    (PlaySpline([75.0, 150.0, 300.0], 4000.0), [4e-3, 2e-3, 3e-3, 6e-3, 8e-3, 1.5, 0.7, 1.2, -2.0]),
]
MEMORYLESS = [case for case in CASES if not case[0].path]


def some_scale():
    return Scale(*(jnp.asarray(x) for x in (3000.0, 2000.0, 1500.0, 15.0, 4000.0)))


@pytest.mark.parametrize(("curve", "params"), CASES)
def test_inverse_undoes_the_curve(curve, params):
    pressure = jnp.linspace(10.0, 5000.0, 40)
    params = jnp.asarray(params)
    np.testing.assert_allclose(curve.inverse(params, curve(params, pressure)), pressure, rtol=1e-11)


@pytest.mark.parametrize(("curve", "params"), CASES)
def test_free_and_bound_are_inverses(curve, params):
    free = curve.free(jnp.asarray(params), some_scale())
    np.testing.assert_allclose(curve.bound(free, some_scale()), params, rtol=1e-12)
    assert np.abs(free).max() < 10


def test_the_order_of_curves_is_that_in_which_ties_are_broken():
    """`simplest` takes the earlier of two curves of one size, and a short log is fitted with the first of all."""
    names = list(CURVES)
    assert names[0] == "linear"
    for earlier, later in (("affine", "power"), ("spline", "hysteresis")):
        assert CURVES[earlier]().size == CURVES[later]().size
        assert names.index(earlier) < names.index(later)


@pytest.mark.parametrize("name", CURVES)
def test_every_curve_rises_whatever_its_free_parameters(name):
    curve = CURVES[name]().at(some_scale())
    pressure = jnp.linspace(1.0, 6000.0, 200)
    for free in np.random.default_rng(0).normal(0, 2, (20, curve.size)):
        params = curve.bound(jnp.asarray(free), some_scale())
        assert np.diff(curve(params, pressure)).min() > 0
    assert CURVES.name_of(curve) == name
    assert len(curve.names) == len(curve.units) == curve.size


def test_power_law_is_the_textbook_formula():
    pressure = np.linspace(1.0, 5000.0, 50)
    expected = 4e-3 * 2000.0 * (pressure / 2000.0) ** 0.6
    found = PowerLaw(2000.0)(jnp.array([4e-3, 0.6]), jnp.asarray(pressure))
    np.testing.assert_allclose(found, expected, rtol=1e-13)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("exponent", [0.3, 1.0, 2.5])
def test_power_law_is_zero_with_finite_gradients_at_and_below_zero(dtype, exponent):
    curve, params = PowerLaw(2000.0), jnp.array([4e-3, exponent], dtype)
    pressure = jnp.array([-1e5, -1e-30, 0.0, 1e-30, 1e-3], dtype)
    slopes = jax.jit(jax.vmap(jax.grad(curve, (0, 1)), (None, 0)))(params, pressure)
    force = curve(params, pressure)
    assert force.dtype == dtype
    assert (force[:3] == 0).all()
    assert force[4] > 0
    back = jax.jit(jax.vmap(jax.grad(curve.inverse, (0, 1)), (None, 0)))(params, jnp.array([-5.0, 0.0, 2.0], dtype))
    for part in (*slopes, *back, jax.jit(jax.hessian(curve))(params, pressure[2])):
        assert np.isfinite(part).all()


@pytest.mark.parametrize(("curve", "params"), MEMORYLESS)
def test_nan_pressure_gives_nan_force(curve, params):
    force = curve(jnp.asarray(params), jnp.array([1.0, jnp.nan]))
    assert np.isfinite(force[0])
    assert np.isnan(force[1])
    assert np.isnan(curve.inverse(jnp.asarray(params), jnp.array(jnp.nan)))


@pytest.mark.parametrize(("curve", "params"), CASES)
def test_start_is_near_and_not_moved_by_a_fifth_of_outliers(curve, params):
    pressure = jnp.asarray(np.random.default_rng(1).uniform(0, 4000, 400))
    force = curve(jnp.asarray(params), pressure).at[::5].add(200.0)
    valid = jnp.ones(400, bool)
    scale = scale_of(pressure, force, valid)
    start = curve.initial(pressure, force, valid, scale)
    error = curve(start, pressure) - curve(jnp.asarray(params), pressure)
    assert np.abs(error).max() < 0.3 * np.ptp(force[1::5])


@pytest.mark.parametrize("name", CURVES)
def test_start_is_finite_for_hopeless_samples(name):
    for force in (jnp.zeros(5), -jnp.arange(5.0), jnp.full(5, 7.0)):
        for valid in (jnp.ones(5, bool), jnp.zeros(5, bool)):
            pressure = jnp.linspace(-3.0, 3.0, 5)
            scale = scale_of(pressure, force, valid)
            curve = CURVES[name]().at(scale)
            free = curve.free(curve.initial(pressure, force, valid, scale), scale)
            assert np.isfinite(free).all()


def test_scale_ignores_a_spike_and_masked_samples():
    pressure, force = np.full(100, 1000.0), np.full(100, 5.0)
    pressure[0], force[0] = 1e12, 1e12
    valid = np.arange(100) < 60
    pressure[80:] = np.nan
    scale = scale_of(jnp.asarray(pressure), jnp.asarray(force), jnp.asarray(valid))
    assert float(scale.pressure) == 1000.0
    assert float(scale.force) == 5.0


def test_resistant_line_is_exact_on_a_line():
    x = jnp.linspace(-3.0, 9.0, 31)
    slope, intercept = resistant_line(x, 2.5 * x - 1, jnp.ones(31, bool))
    np.testing.assert_allclose([slope, intercept], [2.5, -1.0], rtol=1e-12)


def test_resistant_line_is_none_where_both_thirds_have_one_median():
    x, y = jnp.array([0.0, 0, 0, 0, 1]), jnp.array([0.0, 1, 2, 3, 9])
    assert np.isnan(resistant_line(x, y, jnp.ones(5, bool))).all()


@pytest.mark.parametrize("curve", [PowerLaw(), MonotonePolynomial(), MonotoneSpline(), Play(), AffinePlay()])
def test_a_curve_that_was_not_fitted_says_what_to_do(curve):
    with pytest.raises(ValueError, match="give"):
        curve(jnp.ones(curve.size), jnp.ones(3))


def test_polynomial_and_spline_are_their_formulas_and_straight_beyond():
    z = jnp.linspace(0, 1, 41)
    polynomial, spline = MonotonePolynomial(4000.0), MonotoneSpline(4000.0)
    power = np.polynomial.Polynomial([0, 6, 9, 4])  # rises of 2, 5 and 12 N in powers of z
    np.testing.assert_allclose(polynomial(jnp.array([2.0, 5.0, 12.0]), 4000 * z), power(z), atol=1e-12)
    slopes = np.array([4e-3, 2e-3, 3e-3, 6e-3, 8e-3])
    fine = np.linspace(0, 1, 40001)
    slope = np.interp(fine, np.linspace(0, 1, 5), slopes)
    integral = np.concatenate([[0], np.cumsum((slope[1:] + slope[:-1]) / 2 * 4000 / 40000)])
    np.testing.assert_allclose(spline(jnp.asarray(slopes), 4000 * z), integral[::1000], atol=1e-9)
    for curve, params in ((polynomial, [2.0, 5.0, 12.0]), (spline, slopes)):
        for at in (-400.0, 4400.0):
            ends = curve(jnp.asarray(params), jnp.array([at - 1, at, at + 1]))
            assert np.diff(ends, 2)[0] == pytest.approx(0, abs=1e-12)


def test_play_is_its_recursion_and_nan_holds_still():
    signal = np.cumsum(np.random.default_rng(0).normal(0, 1, 300))
    signal[50:55] = np.nan
    widths = np.array([0.5, 2.0, 8.0])
    y, expected = np.zeros(3), []
    for u in signal:
        y = y if np.isnan(u) else np.maximum(u - widths, np.minimum(u + widths, y))
        expected.append(y)
    np.testing.assert_allclose(play(jnp.asarray(signal), jnp.asarray(widths)), expected, atol=1e-12)


@pytest.mark.parametrize(("curve", "params"), [case for case in CASES if case[0].path])
def test_hysteresis_is_undone_by_its_inverse_on_any_way(curve, params):
    pressure = jnp.asarray(1500 * (1 + np.sin(np.arange(400) / 15) * np.linspace(1, 0.2, 400)))
    params = jnp.asarray(params)
    force = curve(params, pressure)
    np.testing.assert_allclose(curve.inverse(params, force), pressure, rtol=1e-9)
    up, down = np.diff(pressure) > 0, np.diff(pressure) < 0
    level = 1500.0
    rising = np.interp(level, pressure[1:40][up[:39]], force[1:40][up[:39]])
    falling = np.interp(level, pressure[25:70][down[24:69]][::-1], force[25:70][down[24:69]][::-1])
    assert abs(rising - falling) > 0.1


class WrongShape(Linear):
    def __call__(self, params, pressure):
        return jnp.ones(3)


class NotFinite(Linear):
    def __call__(self, params, pressure):
        return params[0] * jnp.sqrt(pressure - 100.0)


class Falling(Linear):
    def __call__(self, params, pressure):
        return -params[0] * pressure


class Nothing(Linear):
    def inverse(self, params, force):
        return None


class NotInverted(Linear):
    def inverse(self, params, force):
        return jnp.log(-force)


@pytest.mark.parametrize(
    ("curve", "said"),
    [
        (WrongShape(), r"^WrongShape\.__call__ returns a result of shape \(3,\) .*; return one number for each"),
        (
            NotFinite(),
            r"^NotFinite\.__call__ returns nan N at 50 Pa, with slope = .* N/Pa, .* to pad 0; return a finite",
        ),
        (
            Falling(),
            r"^Falling\.__call__ falls from -.* N at .* Pa to -.* N at .* Pa, .* to pad 0; a curve must rise",
        ),
        (Nothing(), r"^Nothing\.inverse returns a result of type NoneType"),
        (
            NotInverted(),
            r"^NotInverted\.inverse returns nan Pa at .* N, the force at 50 Pa, with .* to pad 0; return the",
        ),
    ],
)
def test_a_curve_of_a_users_own_is_named_with_its_method(curve, said):
    pressure = np.stack([np.linspace(50, 4000, 30), np.full(30, np.nan)])
    with pytest.raises(FitError, match=said):
        fit_curves(curve, pressure, 2e-3 * pressure)


class TurnsDown(Linear):
    """Rises at the start of a fit, and falls where the samples do."""

    def bound(self, free, scale):
        return free * scale.force / scale.pressure

    def free(self, params, scale):
        return params * scale.pressure / scale.force

    @property
    def positive(self):
        return np.array([False])


def test_the_message_of_a_fit_names_a_curve_of_a_users_own():
    pressure = np.linspace(10, 4000, 30)
    falling = fit_curves(TurnsDown(), pressure[None], -2e-3 * pressure).pad(0)
    assert falling.message().endswith("at more load levels; or TurnsDown.__call__ falls or is not finite")
    assert "PowerLaw" not in fit_curves(PowerLaw(), pressure[None], -2e-3 * pressure).pad(0).message()
