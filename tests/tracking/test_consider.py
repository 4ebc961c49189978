"""What unknown shapes of loads and an unknown coat make contacts err by: ellipses that hold the places."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

import jaxeit as je
from jaxeit.contacts.loads.pressure import LoadForm, line_shapes, shape_directions
from jaxeit.model.gaussian_field import field_modes
from jaxeit.tracking import prepare_tracker
from jaxeit.tracking.belief.consider import ConsiderErrors
from jaxeit.tracking.belief.response import MIN_HALF_LENGTH, load_pressure
from tests.compiled import compiled

from .conftest import GAUSSIAN, SECONDS, SETTINGS, load

DRAWS, FRAMES = 12, 20
SHAPE = 0.1


def test_moments_of_a_round_load_are_those_of_single_frames():
    """And they change neither force nor place."""
    one = jnp.array(load(0.1, 0.1, 5.0))
    points = jnp.stack(jnp.meshgrid(jnp.linspace(0, 0.2, 81), jnp.linspace(0, 0.2, 81)), -1)
    found = line_shapes(one, points, MIN_HALF_LENGTH)
    wanted = shape_directions(one[None], jnp.array([LoadForm.ROUND]), points)
    np.testing.assert_allclose(found, wanted, atol=1e-3 * float(jnp.abs(wanted).max()))
    area = 0.0025**2
    np.testing.assert_allclose(found.sum((0, 1)) * area, 0, atol=5e-3)
    np.testing.assert_allclose(jnp.einsum("xyk,xyd->kd", found, points - 0.1) * area, 0, atol=1e-5)


@pytest.fixture(scope="module")
def followed(model, tracker, blank):
    """Places of tips of random shapes and where they were told, after some frames at rest, with what was known."""
    v0, noise = blank
    rng = np.random.default_rng(11)

    @jax.jit
    def readings(one, moments):
        points = model.centroids
        round_load = load_pressure(one, points, GAUSSIAN)
        pressure = jnp.maximum(round_load + line_shapes(one, points, MIN_HALF_LENGTH) @ moments, 0)
        return je.forward(model, model.background * (1 + pressure / (20e3 + pressure)))

    told = []
    while len(told) < DRAWS:
        place = rng.uniform(0.05, 0.15, 2)
        dv = np.asarray(readings(jnp.array(load(*place, 10.0)), SHAPE * rng.normal(size=6))) - v0
        now = tracker.start()
        for _ in range(FRAMES):
            now = tracker.step(now, dv + noise * rng.normal(size=noise.size), SECONDS)
        if len(now.tracks) == 1:  # some shapes look like two contacts
            told.append((place, now))
    return told


def _held(place, track, covariance):
    away = track.position - place
    return away @ np.linalg.solve(covariance, away) < chi2.ppf(0.9, 2)


@pytest.mark.slow
def test_ellipses_hold_the_places_of_tips_of_any_shape(followed):
    """Those of the belief alone do not."""
    tracks = [(place, now.tracks[0], np.asarray(now.belief.covariance)[:2, :2]) for place, now in followed]
    assert np.mean([_held(place, track, track.covariance) for place, track, _ in tracks]) >= 0.8
    assert np.mean([_held(place, track, alone) for place, track, alone in tracks]) < 0.7


def test_frames_do_not_lessen_what_an_unknown_shape_causes(followed):
    for _, now in followed:
        (track,) = now.tracks
        least = now.considered.covariance[0, :2, :2]
        assert (np.linalg.eigvalsh(track.covariance - least) > 0).all()
        assert 1e-4 < np.sqrt(np.trace(least)) < 5e-3


def test_what_was_found_for_other_contacts_is_not_added():
    found = ConsiderErrors((3,), np.zeros((1, 6)), np.eye(6)[None])
    np.testing.assert_array_equal(found.add_to(2, np.zeros((8, 8))), np.zeros((8, 8)))
    np.testing.assert_array_equal(np.diag(found.add_to(3, np.zeros((8, 8)))), [1, 1, 1, 1, 1, 1, 0, 0])
    still = np.zeros((1, 8))
    assert found.is_valid_for((3,), still)
    assert not found.is_valid_for((4,), still)
    assert not found.is_valid_for((3,), still + 0.01)


# --- a sheet that is taken for even

COATS, REST = 12, 60


@pytest.fixture(scope="module")
def even_tracker(model, skin, blank):
    """Of a sheet that is not known, for one Gaussian load that hardly moves: else it might err since it has moved."""
    still = replace(SETTINGS, most=1, acceleration=0.01, width_rate=0.05, force_rate=0.5, persistence=0.1)
    settings = replace(still, loads=replace(still.loads, shape=0.0))
    return prepare_tracker(model, skin, settings, noise=blank[1])


@pytest.fixture(scope="module")
def coats(model):
    """Modes of the log conductivity of a coat, (elements, modes)."""
    return 0.15 * field_modes(np.asarray(model.centroids), 0.03)


@pytest.mark.slow
def test_slopes_in_the_coat_are_those_of_the_forward_map(model, even_tracker, coats):
    """But for the few unknowns that are solved anew."""
    sheet, one = even_tracker.filter.sheet, jnp.array(load(0.08, 0.11, 15.0))
    gain = jnp.zeros(len(even_tracker.filter.places))
    found = compiled(sheet.coat_slopes, one[None], gain, sheet.neighbourhood(one[None]))
    drawn = coats @ np.random.default_rng(1).normal(size=coats.shape[1])
    pressure = load_pressure(one, model.centroids, GAUSSIAN)

    def change(part):
        sigma = model.background * jnp.exp(part * drawn)
        loaded = sigma * (1 + pressure / (20e3 + pressure))
        return even_tracker.filter.compress @ (je.forward(model, loaded) - je.forward(model, sigma))

    wanted = (change(1e-3) - change(-1e-3)) / 2e-3
    along = np.linalg.lstsq(np.asarray(sheet.coat), drawn, rcond=None)[0]
    assert jnp.linalg.norm(wanted) > 50
    assert jnp.linalg.norm(along @ found - wanted) < 0.25 * jnp.linalg.norm(wanted)


@pytest.mark.slow
def test_a_sheet_that_is_known_has_no_unknown_coat(model, skin, blank, tracker, even_tracker):
    """Nor has one of which the settings say so."""
    assert 0.08 < float(even_tracker.filter.coat_error) < 0.16
    settings = replace(SETTINGS, loads=replace(SETTINGS.loads, coat=0.0))
    for known in (tracker.filter, prepare_tracker(model, skin, settings, noise=blank[1]).filter):
        assert known.sheet.coat.shape[1] == 0
        assert float(known.coat_error) == 0


@pytest.fixture(scope="module")
def on_coats(model, even_tracker, blank, coats):
    """Places of tips on sheets of random coats, and what a tracker that does not know them tells after some rest."""
    noise, rng = blank[1], np.random.default_rng(12)

    @jax.jit
    def readings(one, coat):
        sigma, pressure = model.background * jnp.exp(coat), load_pressure(one, model.centroids, GAUSSIAN)
        return je.forward(model, sigma * (1 + pressure / (20e3 + pressure))) - je.forward(model, sigma)

    told = []
    for _ in range(COATS):
        place = rng.uniform(0.04, 0.16, 2)
        dv = np.asarray(readings(jnp.array(load(*place, 12.0)), coats @ rng.normal(size=coats.shape[1])))
        now = even_tracker.start()
        for _ in range(REST):
            now = even_tracker.step(now, dv + noise * rng.normal(size=noise.size), SECONDS)
        told.append((place, now))
    return told


@pytest.mark.slow
def test_ellipses_hold_places_on_a_sheet_of_unknown_coat(on_coats):
    """Those of the belief alone do not."""
    assert all(len(now.tracks) == 1 for _, now in on_coats)
    tracks = [(place, now.tracks[0], np.asarray(now.belief.covariance)[:2, :2]) for place, now in on_coats]
    assert np.mean([_held(place, track, track.covariance) for place, track, _ in tracks]) >= 0.8
    assert np.mean([_held(place, track, alone) for place, track, alone in tracks]) < 0.7
