"""Recursive least squares against the batch solution, wind-up, and an hour of drift followed by the pads."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calib.fitting.fields import Places, geometry_of, single_places
from calib.fitting.fields.fitted import pad_features
from calib.fitting.recursive import Estimate, RecursiveLeastSquares, SensitivityTracker, Touched, follow, follow_frames


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_weighted_least_squares(dtype):
    rng = np.random.default_rng(0)
    features = rng.normal(size=(200, 3)).astype(dtype)
    targets = (features @ [1.0, -2.0, 0.5] + rng.normal(0, 1, 200)).astype(dtype)
    rls = RecursiveLeastSquares(forgetting=0.97, cap=1e6)
    start = rls.start(jnp.zeros(3, dtype), 10.0)
    state, history = follow(rls, start, features, targets)
    weight = 0.97 ** np.arange(199, -1, -1)
    normal = (features.T * weight) @ features + 0.97**200 / 100 * np.eye(3)
    expected = np.linalg.solve(normal, (features.T * weight) @ targets)
    rtol = 1e-8 if dtype == np.float64 else 2e-3
    np.testing.assert_allclose(state.theta, expected, rtol=rtol)
    np.testing.assert_allclose(state.covariance, np.linalg.inv(normal), rtol=10 * rtol, atol=1e-6)
    assert state.theta.dtype == dtype
    np.testing.assert_array_equal(history[-1], state.theta)


def test_idling_winds_nothing_up():
    rls, n = RecursiveLeastSquares(forgetting=0.99, cap=0.5), 100_000
    rng = np.random.default_rng(1)
    start, _ = follow(rls, rls.start(jnp.ones(4), 0.1), rng.normal(size=(50, 4)), np.ones(50))
    zero = np.zeros((n, 4))
    faint = zero.copy()
    faint[:, 0] = 1e-3  # a contact that says next to nothing, and of one coefficient only
    for features, use in ((zero, None), (rng.normal(size=(n, 4)), np.zeros(n, bool)), (faint, None)):
        state, _ = follow(rls, start, features, features @ np.ones(4), use)
        assert np.isfinite(state.covariance).all()
        assert np.trace(state.covariance) <= 0.5 * 4 * (1 + 1e-9)
        assert np.linalg.eigvalsh(state.covariance).min() > 0
        if features is not faint:
            np.testing.assert_array_equal(state.covariance, start.covariance)


def test_a_sample_that_is_not_finite_changes_nothing():
    rls = RecursiveLeastSquares()
    start = rls.start(jnp.ones(2), 1.0)
    for features, target in (([np.nan, 1.0], 1.0), ([1.0, 1.0], np.inf)):
        state, _ = follow(rls, start, np.array([features]), np.array([target]))
        assert eqx.tree_equal(state, start)
    alone = rls.start(jnp.ones(1), 1.0)  # here its news would be infinite, and so more than nothing
    assert eqx.tree_equal(rls.update(alone, jnp.array([np.inf]), jnp.array(1.0)), alone)


@pytest.fixture(scope="module")
def tracker(skin):
    return SensitivityTracker(geometry_of(skin), image_gain=2e4)


def touches(tracker, time, seed):
    """Presses all over the sheet while the sensitivity of the sheet drifts, more on the right than on the left."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(0.012, 0.188, (len(time), 2))
    force = rng.uniform(3, 20, len(time))
    drift = 1 + 0.4 * (time / 3600) * position[:, 0] / 0.2
    own = np.eye(4)[(position[:, 0] > 0.1) + 2 * (position[:, 1] > 0.1)]
    image_sum = force / float(tracker.image_gain) / drift
    noisy = force * (1 + rng.normal(0, 0.03, len(time)))
    frames = Touched(
        image_sum=jnp.asarray(image_sum),
        places=single_places(position, 4),
        pad_force=jnp.asarray(own * noisy[:, None]),
        standard_error=jnp.asarray(own * 0.1 + 0.01),
        valid=jnp.ones((len(time), 4), bool),
    )
    return frames, force, own


@pytest.mark.slow
def test_an_hour_of_drift_is_followed(tracker):
    time = np.arange(0, 3600, 3.0)
    frames, _, _ = touches(tracker, time, 0)
    state, _, use = follow_frames(tracker, tracker.start(), frames)
    assert use.all()
    after, true, own = touches(tracker, np.full(200, 3600.0), 1)
    told, error = (np.asarray(a)[own > 0] for a in tracker.forces(state, after.image_sum, after.places))
    before, _ = tracker.forces(tracker.start(), after.image_sum, after.places)
    blind = np.asarray(before)[own > 0] / true - 1
    assert np.sqrt(np.mean(blind**2)) > 0.15
    assert np.sqrt(np.mean((told / true - 1) ** 2)) < 0.03
    assert (error < 0.1 * true).all()


def test_blocks_of_any_length_give_the_same_and_one_frame_at_a_time_too(tracker):
    frames, _, _ = touches(tracker, np.linspace(0, 3600, 24), 2)
    whole, history, _ = follow_frames(tracker, tracker.start(), frames)
    state = tracker.start()
    for k in range(24):
        state, _, _ = follow_frames(tracker, state, jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], frames))
    np.testing.assert_allclose(state.theta, whole.theta, rtol=1e-10)
    np.testing.assert_allclose(history[-1], whole.theta)


def test_only_single_confident_contacts_teach(tracker):
    frames, _, _ = touches(tracker, np.zeros(6), 3)
    two = np.asarray(frames.places.position).repeat(2, 1)
    one = two.copy()
    one[:, 1] = np.nan
    position = np.where(np.arange(6)[:, None, None] == 1, two, one)
    force, error = np.asarray(frames.pad_force).copy(), np.asarray(frames.standard_error).copy()
    valid = np.ones((6, 4), bool)
    force[2] = 5.0  # shared by the pads
    error[3] = 10.0
    valid[4] = False
    force[5] *= 0.01
    weight = np.broadcast_to(np.asarray(frames.places.weight), (6, 2, 4))
    places = Places(jnp.asarray(position), jnp.asarray(weight), jnp.full((6, 2), 0.01), jnp.ones((6, 2)))
    odd = Touched(frames.image_sum, places, force, error, valid)
    _, _, use = follow_frames(tracker, tracker.start(), odd)
    assert use.tolist() == [True, False, False, False, False, False]


def test_features_add_up_to_one(tracker):
    features = eqx.filter_jit(pad_features)(tracker.field, tracker.geometry, single_places(np.full((1, 2), 0.07), 4))
    np.testing.assert_allclose(features.sum(-1), 1)
    assert isinstance(tracker.start(), Estimate)
