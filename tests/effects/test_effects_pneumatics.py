"""Effects in the pads, each against the physics it stands for, solved another way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.signal import lsim

import jaxeit as je
from jaxeit import effects as fx

from ..histories import after, presses

STEP = 0.005
TIMES = np.arange(1200) * STEP
AIR = {"temperature": 0.5 * TIMES, "barometer": 100 * np.sin(TIMES)}
FAMILY = [kind() for kind in je.effects.EFFECTS.values() if issubclass(kind, fx.AbstractPneumaticEffect)]
NAMES = [type(effect).__name__ for effect in FAMILY]


@pytest.mark.parametrize(
    "effect",
    [
        je.effects.PadCrosstalk(fraction=0.0),
        je.effects.TpuRelaxation(shares=(0.0, 0.0), times=(0.1, 1.0)),
        je.effects.TpuRelaxation(gas_share=1.0),
        je.effects.GasLaw(compliance=1e6),
        je.effects.GasRelaxation(heat_ratio=1.0),
        je.effects.GasRelaxation(gas_share=1.0),
        je.effects.GasRelaxation(time=0.0),
        je.effects.PadTemperature(sensitivity=0.0, barometer=0.0),
        je.effects.PadLeak(time=jnp.inf),
        je.effects.SensorError(offset=0.0, span=0.0),
    ],
    ids=lambda effect: type(effect).__name__,
)
def test_without_its_cause_the_pad_is_ideal(effect):
    series = presses(len(TIMES), 4)
    np.testing.assert_allclose(after(effect, series, **AIR), series, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("effect", FAMILY, ids=NAMES)
def test_blocks_make_the_whole_and_float32_stays(effect):
    series = presses(len(TIMES), 4)
    whole = after(effect, series, **AIR)
    assert np.abs(whole - series).max() > 1  # it does something
    np.testing.assert_allclose(after(effect, series, cuts=(400, 800), **AIR), whole, rtol=1e-12, atol=1e-9)
    single = after(effect, series.astype(np.float32), **AIR)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, whole, atol=0.05)


def test_crosstalk_is_a_fraction_of_the_mean_of_the_others():
    effect = je.effects.PadCrosstalk(fraction=0.3)
    mixed = after(effect, np.eye(4) * 10.0)
    np.testing.assert_allclose(mixed, 10 * np.eye(4) + 1.0 * (1 - np.eye(4)), rtol=1e-12)
    np.testing.assert_array_equal(after(effect, np.ones((3, 1))), 1.0)


@pytest.mark.parametrize("compliance", [0.0, 7e-10, 1e-8])
def test_the_gas_law_balances_the_load(compliance):
    """The structure's spring and Boyle's gas carry the load together: solved for the volume by bisection."""
    p0, v0 = 101325.0, 70e-6
    stiffness = 1 / compliance if compliance else 1e25  # Pa/m3; a rigid structure imposes the volume
    ideal = np.array([-3000.0, 1e-3, 2000.0, 34474.0])

    def gas(squeezed):
        return p0 * squeezed / (v0 - squeezed)

    expected = []
    for p in ideal:
        load = p * (1 + stiffness * v0 / p0)  # what makes the ideal, linear pad show p
        at = brentq(lambda v, load=load: gas(v) + stiffness * v - load, -v0, 0.9 * v0, xtol=1e-20, rtol=1e-14)
        expected.append(gas(at))
    shown = after(je.effects.GasLaw(volume=v0, compliance=compliance), ideal[:, None])[:, 0]
    np.testing.assert_allclose(shown, expected, rtol=1e-8)
    assert abs(float(shown[1]) / ideal[1] - 1) < 1e-6  # a small signal is the ideal one


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9])
def test_gas_relaxes_as_the_first_law_has_it(share):
    """Gas that is compressed, warms and cools: the full equations in volume and temperature, for a small load."""
    p0, t0, gamma, tau, size = 101325.0, 293.0, 1.4, 0.31, 5.0
    times = np.arange(601) * STEP

    def ideal(t):
        return size * np.interp(t, [0.1, 0.3, 2.3, 2.5], [0, 1, 1, 0])

    def squeezed(t, warmth):
        """Of the volume, from the balance of load, gas and structure."""

        def excess(y):
            return share * ((1 + warmth / t0) / (1 - y) - 1) + (1 - share) * y - ideal(t) / p0

        return brentq(excess, -0.1, 0.1, xtol=1e-16, rtol=1e-14)

    def first_law(t, state):
        """Warming is the work of compression less what goes to the walls, over the heat capacity."""
        warmth, h = state[0], 1e-5
        y = squeezed(t, warmth)
        by_time = (squeezed(t + h, warmth) - squeezed(t - h, warmth)) / (2 * h)
        by_warmth = (squeezed(t, warmth + h) - squeezed(t, warmth - h)) / (2 * h)
        work = (gamma - 1) * (t0 + warmth) / (1 - y)
        return [(work * by_time - warmth / tau) / (1 - work * by_warmth)]

    solution = solve_ivp(first_law, (0, times[-1]), [0.0], t_eval=times, max_step=0.02, rtol=1e-7, atol=1e-10)
    warmths = solution.y[0]
    gas = [p0 * ((1 + w / t0) / (1 - squeezed(t, w)) - 1) for t, w in zip(times, warmths, strict=True)]
    shown = after(je.effects.GasRelaxation(gas_share=share), ideal(times)[:, None])[:, 0]
    np.testing.assert_allclose(shown, gas, atol=1e-3 * size)


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_gas_is_adiabatic_at_first_and_isothermal_in_the_end(share):
    effect = je.effects.GasRelaxation(gas_share=share)
    step = np.vstack([[0.0], np.full((4000, 1), 100.0)])
    quick = after(effect, step, interval=1e-6)
    assert float(quick[1, 0]) == pytest.approx(100 * 1.4 / (share * 1.4 + 1 - share), rel=1e-5)
    assert float(after(effect, step)[-1, 0]) == pytest.approx(100, rel=1e-9)


def test_gas_relaxation_is_exact_for_ramps_of_any_sampling():
    """Against SciPy's first-order hold, at steps longer than the relaxation."""
    effect, interval = je.effects.GasRelaxation(time=0.31, heat_ratio=1.4, gas_share=0.25), 0.7
    series = presses(60, 2, interval)
    stiffer = 1 + 0.25 * 0.4
    system = ([stiffer * 0.31 + 0.75 * 0.4 * 0.31, 1], [stiffer * 0.31, 1])
    expected = [lsim(system, p, np.arange(60) * interval)[1] for p in series.T]
    np.testing.assert_allclose(after(effect, series, interval=interval), np.transpose(expected), atol=1e-9)


def _structure(effect, series, interval):
    """The pad with a Maxwell structure by its transfer function: P / p = 1 / (s + (1 - s) E(.) / E(inf))."""
    (g0, g1), (t0, t1), gas = effect.shares.tolist(), effect.times.tolist(), float(effect.gas_share)
    pole0, pole1, rest = np.poly1d([t0, 1]), np.poly1d([t1, 1]), 1 - g0 - g1
    modulus = rest * pole0 * pole1 + g0 * np.poly1d([t0, 0]) * pole1 + g1 * np.poly1d([t1, 0]) * pole0
    system = ((pole0 * pole1).coeffs, (gas * pole0 * pole1 + (1 - gas) / rest * modulus).coeffs)
    return np.transpose([lsim(system, p, np.arange(len(series)) * interval)[1] for p in series.T])


def test_the_structure_relaxes_by_its_prony_series():
    effect = je.effects.TpuRelaxation(shares=(0.2, 0.1), times=(0.05, 2.0), gas_share=0.3)
    errors = []
    for interval in (0.02, 0.01, 0.005):
        series = presses(round(6 / interval), 2, interval)
        error = np.abs(after(effect, series, interval=interval) - _structure(effect, series, interval)).max()
        errors.append(error / np.abs(series).max())
    assert errors[-1] < 2e-4
    assert errors[0] / errors[1] > 3.5  # second order in the interval
    assert errors[1] / errors[2] > 3.5


def test_pressure_creeps_up_while_a_press_is_held():
    effect = je.effects.TpuRelaxation(shares=(0.2, 0.05), times=(0.1, 1.0), gas_share=0.5)
    step = np.vstack([[0.0], np.full((4000, 1), 100.0)])
    shown = after(effect, step, interval=1e-7)[1, 0], after(effect, step)[1:, 0]
    assert shown[0] == pytest.approx(100 / (0.5 + 0.5 / 0.75), rel=1e-5)  # the structure is 1 / 0.75 as stiff at first
    assert (np.diff(shown[1]) >= 0).all()
    assert shown[1][-1] == pytest.approx(100, rel=1e-6)


def test_a_pad_gains_with_heat_and_loses_with_the_barometer():
    still = np.zeros((3, 4))
    shown = after(je.effects.PadTemperature(), still, temperature=[0, 1.0, 1.0], barometer=[0, 0, 100.0])
    np.testing.assert_allclose(shown, [[0.0] * 4, [346.0] * 4, [246.0] * 4])
    assert float(je.effects.PadTemperature().sensitivity) == pytest.approx(101325 / 293, rel=1e-3)


def test_a_leak_empties_by_its_time_whatever_the_sampling():
    for interval in (0.005, 7.0):
        times = np.arange(200) * interval
        held = after(je.effects.PadLeak(time=20.0), 1.0 * (times > 0)[:, None], interval=interval)
        first = (1 - np.exp(-interval / 20)) * 20 / interval  # what is left of the rise, over one interval
        np.testing.assert_allclose(held[1:, 0], first * np.exp(-(times[1:] - interval) / 20), rtol=1e-9)
        ramp = after(je.effects.PadLeak(time=20.0), 3 * times[:, None], interval=interval)
        np.testing.assert_allclose(ramp[:, 0], 60 * (1 - np.exp(-times / 20)), rtol=1e-9, atol=1e-9)


def test_what_heat_does_leaks_away_whatever_the_order_in_the_scene():
    hot = jnp.ones(4000)
    shown = []
    for effects in (
        (je.effects.PadLeak(time=1.0), je.effects.PadTemperature()),
        (je.effects.PadTemperature(), je.effects.PadLeak(time=1.0)),
    ):
        mine = fx.chosen(effects, fx.AbstractPneumaticEffect)
        start = fx.history_start(mine, jnp.zeros(1))
        line = fx.HistoryInputs(jax.random.key(0), jnp.asarray(STEP), hot, 0 * hot, jnp.zeros((0, 4), int))
        shown.append(fx.history(mine, jnp.zeros((4000, 1)), start, line)[0][:, 0])
    np.testing.assert_array_equal(*shown)
    assert float(shown[0][0]) > 300
    assert float(shown[0][-1]) == pytest.approx(0, abs=1e-4)


def test_sensors_differ_from_each_other_and_not_in_time():
    series = np.vstack([np.zeros(20000), np.full(20000, 1000.0), np.zeros(20000)])
    shown = after(je.effects.SensorError(offset=86.0, span=0.0025), series, cuts=(2,))
    np.testing.assert_array_equal(shown[0], shown[2])
    assert shown[0].std() == pytest.approx(86, rel=0.03)
    span = (shown[1] - shown[0]) / 1000 - 1
    assert span.std() == pytest.approx(0.0025, rel=0.03)
    assert abs(np.corrcoef(span, shown[0])[0, 1]) < 0.03
    others = after(je.effects.SensorError(seed=1), series[:1])
    gains = after(je.effects.GainError(), np.ones((1, 20000)))  # of the same seed, of another kind
    assert abs(np.corrcoef(others[0], shown[0])[0, 1]) < 0.03
    assert abs(np.corrcoef(gains[0], shown[0])[0, 1]) < 0.03
