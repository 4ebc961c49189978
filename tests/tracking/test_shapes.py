"""What unknown shapes of loads make contacts err by: ellipses that hold the places of tips of any shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

import jaxeit as je
from jaxeit.contacts.loads.pressure import Form, line_shapes, shape_directions
from jaxeit.tracking.response import SHORTEST, load_pressure
from jaxeit.tracking.shapes import ShapeErrors

from .conftest import SECONDS, load

DRAWS, FRAMES = 12, 20
SHAPE = 0.1


def test_moments_of_a_round_load_are_those_of_single_frames():
    """And they change neither force nor place."""
    one = jnp.array(load(0.1, 0.1, 5.0))
    points = jnp.stack(jnp.meshgrid(jnp.linspace(0, 0.2, 81), jnp.linspace(0, 0.2, 81)), -1)
    found = line_shapes(one, points, SHORTEST)
    wanted = shape_directions(one[None], jnp.array([Form.ROUND]), points)
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
        pressure = jnp.maximum(load_pressure(one, points) + line_shapes(one, points, SHORTEST) @ moments, 0)
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


def test_ellipses_hold_the_places_of_tips_of_any_shape(followed):
    """Those of the belief alone do not."""
    tracks = [(place, now.tracks[0], np.asarray(now.belief.covariance)[:2, :2]) for place, now in followed]
    assert np.mean([_held(place, track, track.covariance) for place, track, _ in tracks]) >= 0.8
    assert np.mean([_held(place, track, alone) for place, track, alone in tracks]) < 0.7


def test_frames_do_not_lessen_what_an_unknown_shape_causes(followed):
    for _, now in followed:
        (track,) = now.tracks
        least = now.shapes.covariance[0, :2, :2]
        assert (np.linalg.eigvalsh(track.covariance - least) > 0).all()
        assert 1e-4 < np.sqrt(np.trace(least)) < 5e-3


def test_what_was_found_for_other_contacts_is_not_added():
    found = ShapeErrors((3,), np.zeros((1, 6)), np.eye(6)[None])
    np.testing.assert_array_equal(found.added(2, np.zeros((8, 8))), np.zeros((8, 8)))
    np.testing.assert_array_equal(np.diag(found.added(3, np.zeros((8, 8)))), [1, 1, 1, 1, 1, 1, 0, 0])
    still = np.zeros((1, 8))
    assert found.holds((3,), still)
    assert not found.holds((4,), still)
    assert not found.holds((3,), still + 0.01)
