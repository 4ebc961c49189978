"""The noise law of held-out residuals: what it recovers, and what its intervals cover on new places."""

import jax.numpy as jnp
import numpy as np
import pytest

from calib.fitting.curves import Linear
from calib.fitting.fields import geometry_of
from calib.fitting.held_out import Folds, folds_by_place
from calib.fitting.intervals import fit_noise
from calib.fitting.losses import SoftL1
from calib.fitting.pads import LocatedPresses, PadModel, fit_pads
from calib.presses.pooled import PressData

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
        everything, error, _ = model.pad_forces(new.sample_pressure.T)
        wide = model.noise.multiple * np.sqrt((error**2).sum(1))
        sampled = np.abs(everything.sum(1) - new.sample_force) <= wide
        covered.append([*(inside[k::3].mean() for k in range(3)), sampled.mean()])
    np.testing.assert_allclose(np.mean(covered, 0), 0.9, atol=0.05)
