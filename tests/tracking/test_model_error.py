"""How far the model errs, fitted to presses: found where it is known, and what it does to a tracker."""

import jax
import numpy as np
import pytest
from scipy.stats import chi2

from jaxeit.contacts.loads.learned.model_error import ERROR_RATIO
from jaxeit.imaging import InverseError
from jaxeit.tracking import fit_model_error, model_error, press_evidence
from jaxeit.tracking.belief.programs import Programs
from jaxeit.tracking.belief.state import CONTACT_SIZE
from jaxeit.tracking.preparation import MESH_ERROR_RATIO

from .conftest import SECONDS, load

PLACES = np.random.default_rng(3).uniform(0.04, 0.16, (6, 2))
RADIUS = 0.020  # of a ring, m
WRONG = 0.05  # of the signal, by which a wrong model errs


def wrong(frame, rng):
    """A frame with independent errors that are a part of its signal."""
    return frame + WRONG * np.sqrt(np.mean(frame**2)) * rng.normal(size=frame.size)


@pytest.fixture(scope="module")
def presses(frame_of):
    return np.array([frame_of([load(x, y, 12.0)]) for x, y in PLACES])


@pytest.fixture(scope="module")
def humble(tracker, presses):
    rng = np.random.default_rng(4)
    return fit_model_error(tracker, np.array([wrong(frame, rng) for frame in presses]))


def test_a_model_that_is_right_keeps_the_least_error(tracker, presses):
    found = fit_model_error(tracker, presses).settings.loads.model_error
    assert tracker.settings.loads.model_error <= found < 2.1 * tracker.settings.loads.model_error


def test_the_error_that_was_made_is_found(tracker, humble, presses):
    """In units of the whitened frame, whose largest direction holds more of the signal than of the error."""
    unit = np.asarray(tracker.filter.compress)
    rng = np.random.default_rng(5)
    parts = [unit @ (wrong(frame, rng) - frame) for frame in presses], [unit @ frame for frame in presses]
    truth = np.median([np.linalg.norm(error) / np.linalg.norm(signal) for error, signal in zip(*parts, strict=True)])
    assert truth / ERROR_RATIO < humble.settings.loads.model_error < truth * ERROR_RATIO**2
    assert float(humble.filter.model_error) == pytest.approx(humble.settings.loads.model_error)
    assert humble.field.mesh_error == MESH_ERROR_RATIO * humble.settings.loads.model_error


def test_a_fit_that_begins_at_the_wrong_place_asks_for_no_error(tracker, presses, monkeypatch):
    """A press between bolts is found from another place: the model is right, and its error stays the least."""
    expected = fit_model_error(tracker, presses[:2]).settings.loads.model_error
    best = Programs.matched_positions
    wrong = np.array([0.02, 0.18])
    monkeypatch.setattr(Programs, "matched_position", lambda self, left: wrong)
    monkeypatch.setattr(Programs, "matched_positions", lambda self, left: iter([wrong, *best(self, left)]))
    assert fit_model_error(tracker, presses[:2]).settings.loads.model_error == expected


def test_frames_whose_fit_does_not_converge_are_left_out_or_refused(tracker, presses, monkeypatch):
    wild, whole = np.full(presses.shape[1], np.nan), model_error._evidence

    def evidence(tracker, frame, pads):
        return -np.inf if np.isnan(frame).all() else whole(tracker, frame, pads)

    monkeypatch.setattr(model_error, "_evidence", evidence)
    least = fit_model_error(tracker, presses[:2]).settings.loads.model_error
    assert fit_model_error(tracker, np.array([wild, *presses[:2]])).settings.loads.model_error == least
    with pytest.raises(InverseError, match=r"fitted to 1 of 3 frames, .* does not converge for frames \[0, 2\]"):
        fit_model_error(tracker, np.array([wild, presses[0], wild]))


def test_a_fit_that_has_not_converged_has_no_probability(tracker, presses, monkeypatch):
    frame, pads = tracker.frame(presses[0]), tracker.pads(None, None)
    assert np.isfinite(model_error._evidence(tracker, frame, pads))
    whole = tracker.programs.converge  # of the second fit, from the place that was found
    monkeypatch.setattr(tracker.programs, "converge", lambda belief, dv, pads, most: whole(belief, dv, pads, 1))
    assert model_error._evidence(tracker, frame, pads) == -np.inf


@pytest.mark.slow
def test_a_tracker_takes_no_error_of_the_model_for_a_second_contact(tracker, frame_of):
    """Each tip is a wide ring, which the model does not know."""
    angle = 2 * np.pi * np.arange(8) / 8
    rim = RADIUS * np.stack([np.cos(angle), np.sin(angle)], 1)

    def pressed(x, y):
        return frame_of([load(x + a, y + b, 2.0, width=0.006) for a, b in rim])

    humble = fit_model_error(tracker, np.array([pressed(x, y) for x, y in PLACES]))
    counts = []
    for one in (tracker, humble):
        now, seen = one.start(), []
        for x, y in PLACES:
            for pressing in [False] * 3 + [True] * 5 + [False] * 3:
                now = one.step(now, pressed(x, y) * pressing, SECONDS)
                seen.append(len(now.tracks))
        counts.append(np.bincount(seen, minlength=3))
    assert counts[0][2] >= 10
    assert counts[1][2] == 0
    assert counts[1][1] >= 5 * len(PLACES)


@pytest.mark.slow
def test_ellipses_hold_places_under_an_error_that_lasts_as_long_as_the_press(humble, presses):
    """No frame lessens it, and the filter by itself forgets it."""
    rng, by_filter, whole = np.random.default_rng(6), [], []
    for frame, place in zip(np.tile(presses, (2, 1)), np.tile(PLACES, (2, 1)), strict=True):
        seen, now = wrong(frame, rng), humble.start()
        for _ in range(60):
            now = humble.step(now, seen, 5 * SECONDS)
        track = min(now.tracks, key=lambda t, p=place: np.linalg.norm(t.position - p))
        own = CONTACT_SIZE * now.numbers.index(track.number) + np.arange(2)
        away = track.position - place
        for held, covariance in (
            (by_filter, np.asarray(now.belief.covariance)[np.ix_(own, own)]),
            (whole, track.covariance),
        ):
            held.append(away @ np.linalg.solve(covariance, away) < chi2.ppf(0.9, 2))
    assert np.mean(by_filter) < 0.7
    assert np.mean(whole) > 0.8


def test_pads_are_data_of_the_fit_too(tracker, presses):
    pads = np.zeros((len(presses), 4))
    assert fit_model_error(tracker, presses, pads + 3.0, pads + 1e3).settings.loads.model_error < 0.011


@pytest.mark.parametrize("dv", [np.zeros((0, 550)), np.zeros(550), np.zeros((2, 3))])
def test_frames_of_another_shape_are_refused(tracker, dv):
    with pytest.raises(InverseError, match="give one frame"):
        fit_model_error(tracker, dv)


def test_masked_frames_are_refused(tracker, presses):
    with pytest.raises(InverseError, match="dv is a masked array"):
        fit_model_error(tracker, np.ma.masked_invalid(presses))


@pytest.mark.parametrize("function", [fit_model_error, press_evidence])
def test_frames_that_jit_hides_are_refused(tracker, presses, function):
    with pytest.raises(InverseError, match=f"{function.__name__} decides by looking at values"):
        jax.jit(lambda dv: function(tracker, dv))(presses)
