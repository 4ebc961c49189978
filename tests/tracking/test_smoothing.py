"""Smoothing of contacts over time, against all frames at once, and on a contact that slides."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.tracking.belief.state import CONTACT_SIZE as SIZE
from jaxeit.tracking.smoothing import Smoother, State, Transition, smooth, transition_after

FRAMES, SEEN = 7, 3


def definite(rng, size, least=0.1):
    root = rng.normal(size=(size, size))
    return root @ root.T / size + least * np.eye(size)


@pytest.fixture
def toy():
    """Transitions, what is seen of a state, its noise, and what was seen in each frame; then the filter's states."""
    rng = np.random.default_rng(1)
    steps = [
        Transition(np.eye(SIZE) + 0.2 * rng.normal(size=(SIZE, SIZE)), definite(rng, SIZE)) for _ in range(FRAMES - 1)
    ]
    matrix, noise = rng.normal(size=(SEEN, SIZE)), definite(rng, SEEN)
    return steps, matrix, noise, rng.normal(size=(FRAMES, SEEN)), definite(rng, SIZE, 1.0)


def filtered(steps, matrix, noise, data, prior):
    mean, covariance, found = np.zeros(SIZE), prior, []
    for number, y in enumerate(data):
        if number:
            step = steps[number - 1]
            mean, covariance = step.matrix @ mean, step.matrix @ covariance @ step.matrix.T + step.walk
        gain = covariance @ matrix.T @ np.linalg.inv(matrix @ covariance @ matrix.T + noise)
        mean, covariance = mean + gain @ (y - matrix @ mean), covariance - gain @ matrix @ covariance
        found.append(State(mean, covariance))
    return found


def all_at_once(steps, matrix, noise, data, prior):
    """Mean and covariance of all states, by conditioning their joint normal distribution."""
    joint = np.zeros((FRAMES, SIZE, FRAMES, SIZE))
    joint[0, :, 0] = prior
    for n, step in enumerate(steps):
        joint[n + 1, :, : n + 1] = np.einsum("ab,bkc->akc", step.matrix, joint[n, :, : n + 1])
        joint[: n + 1, :, n + 1] = joint[n + 1, :, : n + 1].transpose(1, 2, 0)
        joint[n + 1, :, n + 1] = step.matrix @ joint[n, :, n] @ step.matrix.T + step.walk
    joint = joint.reshape(FRAMES * SIZE, FRAMES * SIZE)
    seen = np.kron(np.eye(FRAMES), matrix)
    gain = joint @ seen.T @ np.linalg.inv(seen @ joint @ seen.T + np.kron(np.eye(FRAMES), noise))
    return (gain @ data.ravel()).reshape(FRAMES, SIZE), joint - gain @ seen @ joint


def test_smoothed_states_are_those_given_all_frames_at_once(toy):
    states, steps = filtered(*toy), toy[0]
    mean, covariance = all_at_once(*toy)
    for n, (state, before) in enumerate(zip(smooth(states, steps), states, strict=True)):
        own = slice(SIZE * n, SIZE * (n + 1))
        np.testing.assert_allclose(state.mean, mean[n], rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(state.covariance, covariance[own, own], rtol=1e-8, atol=1e-10)
        assert np.linalg.eigvalsh(state.covariance)[0] > 0
        assert np.linalg.eigvalsh(before.covariance - state.covariance)[0] > -1e-12
    assert smooth(states[:1], []) == states[:1]


def test_later_frames_tell_nothing_across_a_jump(toy):
    states, steps = filtered(*toy), toy[0]
    ahead = steps[3].matrix @ states[3].covariance @ steps[3].matrix.T + steps[3].walk
    jump = State(states[4].mean + 5, ahead + 4 * np.eye(SIZE))
    after = filtered(steps[4:], *toy[1:3], toy[3][4:], jump.covariance)
    found = smooth([*states[:4], *after], steps)
    np.testing.assert_array_equal(found[3].mean, states[3].mean)
    np.testing.assert_array_equal(found[3].covariance, states[3].covariance)
    for state, alone in zip(found[:4], smooth(states[:4], steps[:3]), strict=True):
        np.testing.assert_array_equal(state.mean, alone.mean)


def test_covariances_stay_definite_where_next_to_nothing_changes(toy):
    """Steps so short that a covariance less another loses all its digits."""
    _, matrix, noise, data, prior = toy
    steps = [Transition(np.eye(SIZE), 1e-18 * np.eye(SIZE))] * (FRAMES - 1)
    for state in smooth(filtered(steps, matrix, noise, data, prior), steps):
        assert np.linalg.eigvalsh(state.covariance)[0] > 0


def test_the_transition_is_that_of_the_filter(tracker):
    """A place moves on by its velocity; a velocity that walks at random makes a place walk as its integral does."""
    found = transition_after(tracker, 0.1)
    start = np.arange(1.0, SIZE + 1)
    np.testing.assert_allclose(found.matrix @ start, start + 0.1 * np.array([7, 8, 0, 0, 0, 0, 0, 0]))
    drift = tracker.settings.acceleration**2
    np.testing.assert_allclose(found.walk[6, 6], drift * 0.1)
    np.testing.assert_allclose(found.walk[0, 6], drift * 0.1**2 / 2)
    np.testing.assert_allclose(found.walk[0, 0], drift * 0.1**3 / 3, rtol=1e-3)
    np.linalg.cholesky(found.walk)


class Slide:
    """A light contact of 1 N that slides over the sheet in noise, and what the filter and the smoother tell of it."""

    SECONDS, COUNT = 0.02, 40

    def __init__(self, model, tracker, blank):
        v0, noise = blank
        rng, law = np.random.default_rng(3), tracker.settings.loads.law
        self.places = np.linspace([0.06, 0.07], [0.14, 0.12], self.COUNT)
        points = np.asarray(model.centroids)
        now, smoother = tracker.start(), Smoother(tracker, lag=8)
        self.filtered, self.smoothed = [], []
        for number, place in enumerate(self.places):
            away = ((points - place) ** 2).sum(1)
            pressure = jnp.asarray(np.exp(-away / 2 / 0.012**2) / (2 * np.pi * 0.012**2))
            v = np.asarray(je.forward(model, model.background * law.factor(pressure)))
            dv = v - v0 + noise * rng.normal(size=v0.size)
            now = tracker.step(now, dv, self.SECONDS, np.array([0.3, 0.3, 0.3, np.nan]), np.full(4, 2.0))
            self.filtered.append(now.tracks)
            self.smoothed += smoother.add(number, now, self.SECONDS)
        self.settled = len(self.smoothed)
        self.smoothed += smoother.end()

    def errors(self, tracks):
        """Distances from the truth, m, once the contact has been there for some frames."""
        return np.array([np.linalg.norm(one[0].position - self.places[n]) for n, one in enumerate(tracks)])[4:]


@pytest.fixture(scope="module")
def slide(model, tracker, blank):
    return Slide(model, tracker, blank)


def test_a_slide_is_told_better_by_all_frames(slide):
    before, after = slide.errors(slide.filtered), slide.errors([one.tracks for one in slide.smoothed])
    assert np.sqrt(np.mean(after**2)) < 0.9 * np.sqrt(np.mean(before**2))
    true = (slide.places[1] - slide.places[0]) / slide.SECONDS
    before, after = (
        np.array([np.linalg.norm(one[0].velocity - true) for one in tracks])[4:]
        for tracks in (slide.filtered, [one.tracks for one in slide.smoothed])
    )
    assert np.sqrt(np.mean(after**2)) < np.sqrt(np.mean(before**2))
    for (old,), (_, (new,)) in zip(slide.filtered, slide.smoothed, strict=True):
        assert (old.number, new.number) == (1, 1)
        assert np.linalg.det(new.covariance) <= np.linalg.det(old.covariance) * (1 + 1e-9)


def test_frames_come_back_once_each_in_order_and_while_they_come(slide):
    assert [one.time for one in slide.smoothed] == list(range(slide.COUNT))
    assert slide.settled >= slide.COUNT - 2 * 8
