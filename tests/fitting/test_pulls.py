"""Pulls of simulated calibrations: the error of a predicted force over its stated error has mean 0 and deviation 1.

Every curve that can be chosen is fitted without a field, and every field beside a straight line. The truth is of the
same kind as what is fitted, so that a pull tells whether the stated error is true, and not how well the kind fits.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from calib.fitting.curves import CURVES, Linear
from calib.fitting.fields import FIELDS, geometry_of, single_places
from calib.fitting.losses import SoftL1
from calib.fitting.pads import LocatedPresses, PadModel, fit_pads, predict
from calib.presses.pooled import PressData

TRIALS, PRESSES, STEPS = 200, 196, 24
SCATTER, NOISE = 0.03, 0.02  # of a press, of its force; of a reading, N
RISE = np.linspace(0.05, 1, STEPS // 2)
RAMP = np.concatenate([RISE, RISE[::-1]])


def owner(place):
    return (place[:, 0] > 0.1) + 2 * (place[:, 1] > 0.1)


def presses_at(place, peak, rng, force_of):
    """Ramps to pressures `peak` (n,) Pa and back at places (n, 2) m; `force_of` pressures and places is their force."""
    count, own = len(place), np.eye(4)[owner(place)]
    pressure = (own[:, None] * (peak[:, None] * RAMP)[..., None]).reshape(-1, 4)
    press = np.repeat(np.arange(count), STEPS)
    force = force_of(pressure, place[press]) * np.exp(rng.normal(0, SCATTER, count))[press]
    force = force + rng.normal(0, NOISE, len(force))
    top = np.arange(count) * STEPS + STEPS // 2
    return PressData(
        sample_pressure=pressure.T.copy(),
        sample_force=force,
        sample_press=press,
        mask=own[press].T > 0,
        pressure=pressure[top],
        force=force[top],
        place=np.arange(count),
        reach=np.array([[0.01, 0.01], [0.19, 0.19]]),
    )


def forces(model, pressure, place):
    return np.asarray(predict(model, jnp.asarray(pressure), single_places(place, 4)).force).sum(1)


def places(rng):
    return rng.uniform(0.012, 0.188, (PRESSES, 2))


def truth(skin, curve, field):
    """The response that a fit finds to a law that stiffens, on pads whose gain dips by 30 % towards their edges."""
    rng = np.random.default_rng(0)
    place = places(rng)

    def law(pressure, place):
        total = pressure.sum(1)
        dip = np.exp(-np.min([place % 0.1, 0.1 - place % 0.1], axis=(0, 2)) / 0.01) if field is not None else 0.0
        return 0.01 * total * (1 + 0.2 * total / 2000) * (1 - 0.3 * dip)

    data = presses_at(place, rng.uniform(1500, 2000, PRESSES), rng, law)
    return fit_pads(curve, field, LocatedPresses(data, geometry_of(skin), single_places(place, 4)), SoftL1())


def fits(skin, true, curve, field):
    """Fits to `TRIALS` simulations of the true model."""
    for trial in range(TRIALS):
        rng = np.random.default_rng([2, trial])
        place = places(rng)
        data = presses_at(place, rng.uniform(1500, 2000, PRESSES), rng, partial(forces, true))
        known = LocatedPresses(data, geometry_of(skin), single_places(place, 4))
        model = fit_pads(curve, field, known, SoftL1())
        assert (np.asarray(model.curves.result) == 0).all()
        assert isinstance(model, PadModel)
        yield model


def pulls(skin, curve, field):
    """Errors over stated errors of fits to `TRIALS` simulations, (trials, samples), at loads of all pads."""
    true = truth(skin, curve, field)
    where = np.array([[0.03, 0.06], [0.17, 0.02], [0.05, 0.13], [0.13, 0.19]])
    rng = np.random.default_rng(1)
    new = presses_at(where, np.full(4, 1700.0), rng, partial(forces, true))
    at = single_places(where[new.sample_press], 4)
    own = new.mask.T & (new.sample_pressure.T > 0.1 * 1700)  # below, the force falls to that of a pad at rest
    pressure = jnp.asarray(new.sample_pressure.T)
    expected = np.asarray(predict(true, pressure, at).force)[own]
    found = []
    for model in fits(skin, true, curve, field):
        seen = predict(model, pressure, at)
        found.append((np.asarray(seen.force)[own] - expected) / np.asarray(seen.standard_error)[own])
    return np.array(found)


def judge(found, bias):
    """`bias` is the largest mean at one sample: 4 standard errors, and more where a prior or memory leaves some."""
    error = 1 / np.sqrt(2 * TRIALS)
    assert abs(found.mean()) < 0.2  # samples of one fit err together, so that it is hardly less than that of one
    assert np.abs(found.mean(0)).max() < bias
    assert 0.9 < found.std() < 1 + 2 * error


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVES)
def test_pulls_of_every_curve(name, skin):
    judge(pulls(skin, CURVES.make(name), None), 0.7 if CURVES.make(name).path else 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIELDS)
def test_pulls_of_every_field(name, skin):
    """A prior draws a field to zero: the truth is fixed here, so that the mean errs, and the deviation is less."""
    judge(pulls(skin, Linear(), FIELDS.make(name)), 0.8)


@pytest.mark.slow
def test_pulls_of_a_curve_that_bends_with_a_field(skin):
    judge(pulls(skin, CURVES.make("polynomial"), FIELDS.make("edge")), 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["edge", "edge-spline", "bilinear"])
def test_pulls_of_the_total_of_presses_across_walls(name, skin):
    """Of pads that share a field, independent errors had pulls of 1.2; of pads with fields of their own, errors that
    add up had pulls of 0.65."""
    field = FIELDS.make(name)
    true, at = truth(skin, Linear(), field), np.array([[0.1, 0.05], [0.1, 0.15], [0.05, 0.1], [0.17, 0.1]])
    parts = np.array([[0.5, 0.5, 0, 0], [0, 0, 0.7, 0.3], [0.5, 0, 0.5, 0], [0, 0.5, 0, 0.5]])
    pressure, where = jnp.asarray(1700 * parts), single_places(at, 4)
    expected, found = forces(true, pressure, at), []
    for model in fits(skin, true, Linear(), field):
        seen = predict(model, pressure, where)
        found.append((np.asarray(seen.force).sum(1) - expected) / np.sqrt(seen.total_variance))
    assert 0.75 < np.std(found) < 1.1
