"""The noise law of held-out residuals: what it recovers, and what its intervals cover on new places."""

import jax.numpy as jnp
import numpy as np
import pytest

from calib.fitting.intervals import fit_noise

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
