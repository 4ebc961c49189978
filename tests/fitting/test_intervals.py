"""The noise law of held-out residuals: what it recovers, and what its intervals cover on new places."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr

from calib.fitting.cross_validation.held_out import Folds, folds_by_place
from calib.fitting.cross_validation.neighbourhoods import error_scale, with_error_scale
from calib.fitting.curves import Linear
from calib.fitting.curves.fitted import Prediction
from calib.fitting.fields import PadEdge, geometry_of, single_places
from calib.fitting.fields.fitted import LogGain
from calib.fitting.intervals import NORMAL_MULTIPLE, NoiseLaw, fit_noise
from calib.fitting.losses import SoftL1
from calib.fitting.pad_gains import PadGains
from calib.fitting.pad_predictions import with_gain
from calib.fitting.pads import LocatedPresses, PadModel, fit_pads, forces, pad_forces
from calib.fitting.response import fit_response, fold_presses, hold_out_response
from calib.presses.pooled import MIN_SHARE, PressData
from jaxeit.geometry.shapes import Polygon

from ..helpers import require_identical

PADS, PLACES, SAMPLES = 3, 60, 30


def residuals(rng, *, floor=0.05, fraction=0.06, heavy=False, rough_pad=1.0):
    """Residuals of presses on single pads: an error of each place proportional to force, and noise of the floor."""
    own = rng.integers(PADS, size=PLACES)
    place = fraction * (rng.standard_t(3, PLACES) if heavy else rng.normal(size=PLACES))
    place = place * np.where(own == 0, rough_pad, 1)
    group = np.repeat(np.arange(PLACES), SAMPLES)
    force = np.zeros((PLACES * SAMPLES, PADS))
    load = rng.uniform(0, 20, len(group))
    force[np.arange(len(group)), own[group]] = load
    return place[group] * load + floor * rng.normal(size=len(group)), force, group


def test_the_floor_and_the_fraction_are_recovered():
    laws = [fit_noise(r, f, np.zeros(len(r)), g) for r, f, g in map(residuals, map(np.random.default_rng, range(20)))]
    # The floor is shared by the pads of a press, of which only one is loaded.
    assert np.mean([law.floor for law in laws]) * np.sqrt(PADS) == pytest.approx(0.05, rel=0.1)
    assert np.mean([law.fraction for law in laws]) == pytest.approx(0.06, rel=0.1)


def test_a_pad_with_larger_errors_has_a_larger_scale():
    law = fit_noise(*_with_variance(residuals(np.random.default_rng(0), rough_pad=4.0)))
    assert law.scale[0] > 1.7 * max(law.scale[1:])


def _with_variance(parts):
    residual, force, group = parts
    return residual, force, np.zeros(len(residual)), group


@pytest.mark.parametrize("heavy", [False, True], ids=["normal", "heavy tails"])
def test_ninety_percent_intervals_cover_new_places_in_each_third_of_force(heavy):
    covered = []
    for seed in range(40):
        rng = np.random.default_rng([7, seed])
        law = fit_noise(*_with_variance(residuals(rng, heavy=heavy)))
        residual, force, _ = residuals(rng, heavy=heavy)
        half = law.multiple * np.sqrt(law.variance(jnp.asarray(force)).sum(1))
        third = np.minimum(3 * force.sum(1) / 20, 2).astype(int)
        covered.append([np.mean(np.abs(residual) <= half, where=third == k) for k in range(3)])
    np.testing.assert_allclose(np.mean(covered, 0), 0.9, atol=0.05)


def test_residuals_of_few_places_get_the_normal_multiple():
    law = fit_noise(np.array([0.1, -0.1]), np.ones((2, 1)), np.zeros(2), np.arange(2))
    assert float(law.multiple) == pytest.approx(1.645, abs=1e-3)


def test_residuals_of_zero_give_a_law_of_zero():
    law = fit_noise(np.zeros(9), np.ones((9, 2)), np.zeros(9), np.arange(9))
    assert float(law.floor) == 0
    assert np.isfinite(law.variance(jnp.ones((1, 2)))).all()


def presses(rng, *, reading=0.3, places=40, samples=20):
    """Presses on pads of 0.01 N/Pa at 5, 10 and 20 N: 2 % of scatter from press to press, and noise of each reading."""
    own = np.eye(4)[np.arange(places) % 4].repeat(3, 0)
    force = np.tile([5.0, 10.0, 20.0], places) * np.exp(rng.normal(0, 0.02, 3 * places))
    pressure = own * (np.tile([5.0, 10.0, 20.0], places) / 0.01)[:, None]
    press = np.repeat(np.arange(3 * places), samples)
    load = force[press] + reading * rng.normal(size=len(press))
    mean = np.bincount(press, load) / samples
    return PressData(
        sample_pressure=pressure[press].T,
        sample_force=load,
        sample_press=press,
        mask=own[press].T > 0,
        pressure=pressure,
        force=mean,
        place=np.arange(places).repeat(3),
        reach=np.array([[0.01, 0.01], [0.19, 0.19]]),
    )


def test_means_over_holds_have_intervals_of_their_own(skin):
    """Noise of the readings is four times that of the means: one law for both covers all means."""
    covered = []
    for seed in range(12):
        rng = np.random.default_rng([11, seed])
        data, new = presses(rng), presses(rng)
        known = LocatedPresses(data, geometry_of(skin))
        held = Folds(known, SoftL1(), folds_by_place(data.place, 5)).hold_out(Linear(), None)
        model = fit_pads(Linear(), None, known, SoftL1())
        model = PadModel(model.curves, noise=held.noise(data), hold_noise=held.hold_noise(data))
        force, half = model.hold_forces(new.pressure)
        inside = np.abs(force.sum(1) - new.force) <= half
        everything = pad_forces(model, jnp.asarray(new.sample_pressure.T))
        wide = model.multiple * np.sqrt(everything.total_variance)
        sampled = np.abs(everything.force.sum(1) - new.sample_force) <= wide
        covered.append([*(inside[k::3].mean() for k in range(3)), sampled.mean()])
    np.testing.assert_allclose(np.mean(covered, 0), 0.9, atol=0.05)


def crosstalk_of(part):
    """Crosstalk between four pads, of which each shows in the channels of the others by about a part, unevenly."""
    return jnp.asarray(np.eye(4) + part * np.random.default_rng(3).uniform(0.5, 1.5, (4, 4)) * (1 - np.eye(4)))


def noisy_model(skin, crosstalk, gains=None):
    """Pads of 0.01 N/Pa whose sensors are noisy, without any noise about the model."""
    curves = fit_pads(
        Linear(), None, LocatedPresses(presses(np.random.default_rng(0)), geometry_of(skin)), SoftL1()
    ).curves
    none = NoiseLaw(jnp.zeros(()), jnp.zeros(()), jnp.ones(4), jnp.asarray(NORMAL_MULTIPLE))
    return PadModel(curves, None, crosstalk, none, gains=gains, sensor=jnp.array([20.0, 5.0, 20.0, 40.0]))


def scattered(model, readings):
    """Standard deviation of the forces of 20,000 noisy readings, and that which one reading states, (pads,) N."""
    noise = np.asarray(model.sensor) * np.random.default_rng(1).normal(size=(20_000, 4))
    one = jnp.asarray(readings)[None]
    known, error = forces(model, one).standard_error[0], model.pad_forces(one)[1][0]
    return np.std(forces(model, one + noise).force, 0), np.sqrt(error**2 - known**2)


@pytest.mark.parametrize("gains", [None, [0.3, -0.3, 0.0, 0.1]], ids=["as fitted", "moved"])
@pytest.mark.parametrize("part", [None, 0.0, 0.1, 0.2])
def test_noise_of_the_sensors_is_that_of_readings_with_crosstalk(skin, part, gains):
    """Pads whose noise was added at once, with the signs of the crosstalk, had half of the noise that they show."""
    moved = None if gains is None else PadGains(jnp.asarray(gains), jnp.zeros((4, 4)))
    model = noisy_model(skin, None if part is None else crosstalk_of(part), moved)
    shown, stated = scattered(model, [1500.0, 700.0, 0.0, 300.0])
    np.testing.assert_allclose(stated, shown, rtol=0.02)
    np.testing.assert_allclose(model.idle_noise, scattered(model, np.zeros(4))[0], rtol=0.02)


def test_a_pad_without_a_reading_adds_no_noise_to_the_others(skin):
    shown, stated = scattered(noisy_model(skin, crosstalk_of(0.2)), [1500.0, np.nan, 0.0, 300.0])
    np.testing.assert_allclose(stated, shown, rtol=0.02)  # NaN for the pad itself
    assert np.isfinite(stated[[0, 2, 3]]).all()


@pytest.mark.parametrize("common", [0.0, 0.04], ids=["of each pad", "of all pads"])
def test_the_total_holds_gains_that_pads_have_in_common(skin, common):
    """Errors of all pads together sum up; as independent ones they would have half of the scatter of the total."""
    covariance = 1e-4 * np.eye(4) + common**2
    readings = jnp.array([[1500.0, 1000.0, 1200.0, 1400.0]])
    unmoved = noisy_model(skin, None)
    draws = np.random.default_rng(4).multivariate_normal(np.zeros(4), covariance, 20_000)
    total = np.asarray(forces(unmoved, readings * jnp.exp(jnp.asarray(-draws))).force).sum(1)
    found = forces(noisy_model(skin, None, PadGains(jnp.zeros(4), jnp.asarray(covariance))), readings)
    of_gains = np.sqrt(found.total_variance - forces(unmoved, readings).total_variance)
    np.testing.assert_allclose(of_gains, total.std(), rtol=0.02)


@pytest.mark.parametrize("shared", [True, False])
def test_errors_of_a_field_add_up_where_pads_share_it(skin, shared):
    """The curves' own errors, of a quarter of the field's, are independent in either case."""
    curves = Prediction(jnp.array([[3.0, 4.0]]), jnp.array([[0.05, 0.06]]), jnp.ones((1, 2), bool))
    gain = LogGain(jnp.array([[0.1, -0.1]]), jnp.array([[0.06**2, 0.07**2]]))
    found, rng = with_gain(curves, gain, shared), np.random.default_rng(6)
    of_field = np.repeat(rng.normal(size=(400_000, 1)), 2, 1) if shared else rng.normal(size=(400_000, 2))
    force = np.asarray(curves.force) + np.asarray(curves.standard_error) * rng.normal(size=(400_000, 2))
    scatter = np.exp(np.asarray(gain.mean)) * (force + curves.force * np.sqrt(np.asarray(gain.variance)) * of_field)
    np.testing.assert_allclose(found.standard_error[0], scatter.std(0), rtol=0.01)
    np.testing.assert_allclose(np.sqrt(found.total_variance[0]), scatter.sum(1).std(), rtol=0.01)


def pressed(skin, sites, rng, dip, width, spread):
    """Presses of 3 to 20 N on pads that are stiff near their walls and lose the part of a load beside them."""
    force = rng.uniform(3, 20, len(sites))
    felt = []
    for pad in skin.pads:
        (low, high), outline = (pad.outline.min(0), pad.outline.max(0)), Polygon(pad.outline)
        borne = np.prod(ndtr((high - sites) / spread) - ndtr((low - sites) / spread), axis=1)
        away = np.where(outline.contains(sites), outline.boundary_distance(sites), 0)
        felt.append(100 * borne * (1 - dip * np.exp(-away / width)))
    pressure = np.array(felt).T * force[:, None] * np.exp(0.005 * rng.normal(size=(len(sites), len(skin.pads))))
    press, load = np.arange(len(sites)).repeat(3), np.tile([0.4, 0.7, 1.0], len(sites))
    share = pressure / pressure.sum(1, keepdims=True)
    return PressData(
        sample_pressure=(pressure[press] * load[:, None]).T,
        sample_force=force[press] * load,
        sample_press=press,
        mask=(share[press] >= MIN_SHARE).T,
        pressure=pressure,
        force=force,
        place=np.arange(len(sites)),
        reach=np.stack([sites.min(0), sites.max(0)]),
    )


@pytest.mark.slow
def test_intervals_hold_between_the_places_of_a_grid_that_is_aligned_with_the_walls(skin):
    """Presses of the grid have few distances to walls, so that those of one distance predict each other well."""
    lines = np.linspace(0.01, 0.19, 12)
    grid = np.stack(np.meshgrid(lines, lines), -1).reshape(-1, 2)
    by_places, covered, widened = [], [], []
    for seed in range(8):
        rng = np.random.default_rng([13, seed])
        pads = rng.uniform(0.3, 0.5), rng.uniform(0.007, 0.013), rng.uniform(0.005, 0.01)
        data, sites = pressed(skin, grid, rng, *pads), rng.uniform(0.01, 0.19, (300, 2))
        new, known = pressed(skin, sites, rng, *pads), single_places(grid, 4)
        folds = fold_presses(skin, data, known, SoftL1(), 5)
        response = fit_response(folds, skin, (Linear(),), (PadEdge(),))
        found = hold_out_response(folds, response, {}, data.force)
        narrow = replace(response.model, noise=found.noise, hold_noise=found.hold_noise)
        wide = with_error_scale(narrow, found.error_scale)
        widths = [_covered(model, new, sites, result) for model, result in ((narrow, by_places), (wide, covered))]
        widened.append(widths[1] / widths[0])
    assert np.mean(by_places) < 0.87  # what held-out places alone tell
    assert (np.mean(covered, 0) > 0.87).all()
    assert (np.mean(covered, 0) < 0.97).all()  # whole neighbourhoods are farther away than the places between them
    assert np.mean(widened) < 2


def _covered(model, new, sites, result):
    """Mean half width of the intervals; what they cover in each third of force is appended to the result."""
    force, half = model.hold_forces(new.pressure, single_places(sites, 4))
    inside = np.abs(force.sum(1) - new.force) <= half
    third = np.minimum(3 * new.force / 20, 2).astype(int)
    result.append([inside[third == k].mean() for k in range(3)])
    return half.mean()


@pytest.mark.slow
def test_a_scale_moves_no_force_and_ends_at_the_errors_of_an_unknown_place(skin):
    rng = np.random.default_rng(5)
    sites = rng.uniform(0.01, 0.19, (60, 2))
    folds = fold_presses(skin, pressed(skin, sites, rng, 0.4, 0.01, 0.008), single_places(sites, 4), SoftL1(), 5)
    model = fit_response(folds, skin, (Linear(),), (None,)).model
    assert error_scale(folds, Linear(), model, fit_noise(*_with_variance(residuals(rng)))) == 1
    assert with_error_scale(model, 3.0) is model
    field = fit_pads(Linear(), PadEdge(), folds.presses, SoftL1())
    near, far = (with_error_scale(field, scale).field.log_gain(single_places(sites, 4)) for scale in (1.0, 1e6))
    require_identical(near.mean, far.mean)
    most = np.maximum(near.variance, max(field.field.spread**2 - field.field.noise**2, 0))
    np.testing.assert_allclose(far.variance, most)  # never less known than at an unknown place
