"""Contacts followed through simulated frames, and the filter against a joint normal distribution."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from jaxeit.imaging import InverseError
from jaxeit.tracking import TrackerSettings, prepare_tracker
from jaxeit.tracking.belief.contact_filter import TAIL_WIDTH_RATIO, active_indices, informative_pads, predict
from jaxeit.tracking.belief.frame_update import update
from jaxeit.tracking.belief.state import CONTACT_SIZE, LOAD_SIZE, Pads

from .conftest import SECONDS, SETTINGS, in_double_precision, load, with_filter


def silent(tracker):
    pads = tracker.filter.sheet.pad_area.shape[1]
    return Pads(jnp.zeros(pads), jnp.full(pads, jnp.inf))


@pytest.fixture(scope="module")
def followed(tracker, frame_of):
    """A press that slides; from the eighth frame on a second one 30 mm from it; the first lifts, then both are gone."""
    states, truths, now = [], [], tracker.start()
    for k in range(28):
        first = load(0.06 + 0.0005 * k, 0.08, 12.0)
        second = load(0.06 + 0.0005 * k, 0.11, 9.0)
        truth = [one for one, there in ((first, 2 <= k < 18), (second, 8 <= k < 24)) if there]
        now = tracker.step(now, frame_of(truth or [load(0.1, 0.1, 1e-6)]), SECONDS)
        states.append(now)
        truths.append(np.array(truth).reshape(-1, 6))
    return states, truths


def test_contacts_are_born_and_die_and_keep_their_numbers(followed):
    states, truths = followed
    numbers = [state.numbers for state in states]
    late = 2  # frames until a contact that has lifted is gone
    assert numbers[:2] == [(), ()]
    assert numbers[2:8] == [(1,)] * 6
    assert numbers[8:18] == [(1, 2)] * 10
    assert numbers[18 + late : 24] == [(2,)] * (6 - late)
    assert numbers[24 + late :] == [()] * (4 - late)
    assert len(truths) == len(states)


def test_places_and_forces_are_those_that_were_simulated(followed):
    for state, truth in zip(*followed, strict=True):
        if len(truth) != len(state.tracks):
            continue
        for track, own in zip(state.tracks, truth, strict=True):
            assert np.linalg.norm(track.position - own[:2]) < 1.5e-3
            assert abs(np.log(track.force) - own[3]) < 0.35  # without pads the gain of the layer is not known
            assert np.linalg.norm(track.half) == 0


def test_velocity_is_that_of_the_slide(followed):
    velocity = followed[0][17].tracks[0].velocity
    assert abs(velocity[0] - 0.05) < 0.03
    assert abs(velocity[1]) < 0.03


def test_covariances_stay_symmetric_and_definite(followed):
    for state in followed[0]:
        covariance = np.asarray(state.belief.covariance)
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance / np.sqrt(np.outer(*2 * [np.diag(covariance)]))).min() > 0


def test_the_gain_is_learned_where_contacts_were_and_stays_unknown_elsewhere(tracker, followed):
    variance = np.diag(tracker.learned(followed[0][-1]).covariance)[1:]
    distance = np.linalg.norm(np.asarray(tracker.filter.places)[1:] - [0.065, 0.09], axis=1)
    assert variance[distance.argmin()] < 0.95
    assert variance[distance.argmax()] == pytest.approx(1, abs=1e-3)


def test_pads_tell_the_force(tracker, frame_of):
    """An image alone confuses force and gain; a pad with an error of 1 % does not."""
    truth = np.array([load(0.05, 0.05, 12.0)])
    sheet = tracker.filter.sheet
    near = sheet.neighbourhood(jnp.asarray(truth))
    forces = np.asarray(
        sheet.predict_measurement(jnp.asarray(truth), jnp.zeros(len(tracker.filter.places)), jnp.array([0]), near).pads
    )
    now = tracker.start()
    for _ in range(3):
        now = tracker.step(now, frame_of(truth), SECONDS, forces, np.full(4, 0.1))
    (track,) = now.tracks
    assert track.force == pytest.approx(12, rel=0.03)
    assert track.log_force_error < 0.03


def test_a_tail_on_the_pad_beside_moves_no_contact(tracker, frame_of):
    """A load of another shape lies on the pad beside by 8 % more than the contact believes, 16 mm from its border."""
    frames = [frame_of([load(0.084, 0.05, max(force, 1e-6), 0.008)]) for force in (0.0, *4 * [10.0])]
    away = []
    for one in (with_filter(tracker, tail=0.0), tracker):
        now = one.start()
        for frame, force in zip(frames, (0.0, *4 * [10.0]), strict=True):
            now = one.step(now, frame, SECONDS, force * np.array([0.9, 0.1, 0.0, 0.0]) + 1e-9, np.full(4, 0.1))
        (track,) = now.tracks
        away.append(np.linalg.norm(track.position - [0.084, 0.05]))
        assert track.force == pytest.approx(10, rel=0.12)
    assert away[1] < 0.5e-3 < away[0]


@pytest.mark.slow
def test_a_drift_that_is_noise_begins_no_contact(model, skin, blank, tracker):
    """The noise of the readings may be a covariance: of a gain that all share, as amplifiers warm."""
    v0, noise = blank
    rng, drift = np.random.default_rng(3), 0.02 * v0  # some twenty times the noise
    covariance = np.diag(noise**2) + np.outer(drift, drift)
    patient = prepare_tracker(model, skin, SETTINGS, noise=covariance, sigma=model.background)
    for one, contacts in ((tracker, True), (patient, False)):
        now = one.start()
        for share in np.linspace(0, 1, 10):
            now = one.step(now, share * drift + noise * rng.normal(size=noise.size), SECONDS)
        assert (now.begun > 0) is contacts


def test_pads_err_by_what_they_would_bear_of_a_wider_load(tracker):
    """Of a load 12 mm from their border, whose integral is known."""
    width, away, given = 0.008, 0.012, np.array([0.3, 0.4, 0.5, np.inf])
    contacts = jnp.array([[*load(0.1 - away, 0.05, 10.0, width), 0.0, 0.0]])
    near = tracker.filter.sheet.neighbourhood(contacts[:, :LOAD_SIZE])
    found = informative_pads(tracker.filter, contacts, near, Pads(jnp.zeros(4), jnp.asarray(given))).error
    beyond = norm.sf(away / np.array([width, TAIL_WIDTH_RATIO * width])) * norm.cdf(
        0.05 / np.array([width, TAIL_WIDTH_RATIO * width])
    )
    expected = np.hypot(given[1], TrackerSettings().tail * 10 * np.diff(beyond)[0])
    assert found[1] == pytest.approx(expected, rel=0.15)  # pixels, and what lies beyond those that are near
    assert found[2] == pytest.approx(given[2], rel=0.05)
    assert np.isinf(found[3])
    same = informative_pads(tracker.filter, contacts.at[0, 3].set(-20.0), near, Pads(jnp.zeros(4), jnp.asarray(given)))
    np.testing.assert_allclose(same.error, given, rtol=1e-6)


@pytest.mark.parametrize(("wanders", "told"), [(True, True), (False, False)])
def test_a_gain_that_changes_during_a_press_does_not_bend_its_force(tracker, frame_of, wanders, told):
    """As a layer touches late the gain grows by a tenth from the first newton to the last."""
    if not wanders:
        tracker = with_filter(tracker, gain_rate=0.0)
    now, errors, rise = tracker.start(), [], np.linspace(0, 1, 25) ** 2
    for share in (0.0, *rise[1:], *np.ones(25)):
        force, gain = max(15 * share, 1e-6), 0.9 + 0.1 * share
        pads = force * np.array([1.0, 0.0, 0.0, 0.0]) + 1e-9
        now = tracker.step(now, frame_of([load(0.05, 0.06, force)], gain), 0.02, pads, np.hypot(0.1, 0.05 * pads))
        if share > 0.5:
            (track,) = now.tracks
            errors.append(np.log(track.force / force) / track.log_force_error)
    assert bool(np.mean(np.abs(errors) < norm.ppf(0.95)) > 0.85) is told
    assert bool(abs(np.log(now.tracks[0].force / 15)) < 0.02) is told


def test_missing_readings_are_left_out(tracker, frame_of, followed):
    """A frame that lacks a tenth of its readings moves a contact by no more than its error."""
    before = followed[0][7]
    frame = frame_of([load(0.064, 0.08, 12.0)])
    lacking = frame.copy()
    lacking[::10] = np.nan
    whole, part = (tracker.step(before, f, SECONDS).tracks[0] for f in (frame, lacking))
    assert np.isfinite(part.position).all()
    assert np.linalg.norm(whole.position - part.position) < 3 * np.sqrt(np.trace(part.covariance))


def test_an_update_is_the_conditional_normal_distribution(tracker, followed):
    """At a frame as it is expected: the covariance given the frame, by dense algebra."""
    filter_, belief = map(in_double_precision, (tracker.filter, followed[0][6].belief))
    belief = predict(filter_, belief, jnp.asarray(SECONDS))
    active = np.asarray(active_indices(filter_, belief.contacts))
    contacts = belief.contacts[:, :LOAD_SIZE]
    modes, near = jnp.asarray(active[LOAD_SIZE:] - CONTACT_SIZE), filter_.sheet.neighbourhood(contacts)
    predicted = filter_.sheet.predict_measurement(contacts, belief.gain, modes, near)
    y, compress = np.asarray(predicted.readings), np.asarray(filter_.compress)
    frame = np.linalg.lstsq(compress, y)[0]
    np.testing.assert_allclose(compress @ frame, y, atol=1e-9)
    found = update(filter_, belief, frame, silent(tracker), jnp.asarray(1e3)).belief
    np.testing.assert_allclose(found.contacts, belief.contacts, atol=1e-9)
    slopes, prior = np.zeros((len(y), len(belief.covariance))), np.asarray(belief.covariance)
    slopes[:, active] = np.asarray(predicted.reading_slopes).T
    variance = 1 + float(filter_.error_share) * (y @ y) / len(y)
    gain = np.linalg.solve(slopes @ prior @ slopes.T + variance * np.eye(len(y)), slopes @ prior).T
    wanted = prior - gain @ slopes @ prior
    scale = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose((np.asarray(found.covariance) - wanted) / np.outer(scale, scale), 0, atol=1e-9)


def test_a_belief_moves_by_the_integrated_random_walk(tracker, followed):
    belief, filter_ = followed[0][10].belief, tracker.filter
    steps = belief
    for _ in range(4):
        steps = predict(filter_, steps, jnp.asarray(SECONDS / 4))
    once = predict(filter_, belief, jnp.asarray(SECONDS))
    np.testing.assert_allclose(steps.contacts, once.contacts, rtol=1e-12)
    np.testing.assert_allclose(steps.covariance, once.covariance, rtol=1e-6, atol=1e-16)
    np.testing.assert_allclose(steps.gain, once.gain, rtol=1e-6)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"dv": np.zeros(3)}, "550 readings"),
        ({"dv": np.ma.masked_equal(np.zeros(550), 0)}, "dv is a masked array"),
        ({"pad_forces": np.ma.masked_equal(np.ones(4), 1), "pad_errors": np.ones(4)}, "pad_forces is a masked array"),
        ({"seconds": 0.0}, "above zero"),
        ({"pad_forces": np.zeros(4), "pad_errors": np.zeros(4)}, "standard error zero"),
        ({"pad_forces": np.zeros(3), "pad_errors": np.ones(3)}, r"give \(4,\)"),
        ({"pad_forces": np.zeros(4)}, r"give \(4,\)"),
    ],
)
def test_wrong_frames_are_refused(tracker, given, said):
    arguments = {"dv": np.zeros(550), "seconds": SECONDS} | given
    with pytest.raises(InverseError, match=said):
        tracker.step(tracker.start(), **arguments)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"level": 0.0}, {"tail": -0.1}, {"gain_rate": np.nan}, {"most": 0}, {"persistence": np.inf}),
        *({"birth_rate": -1.0}, {"forgetting": -0.1}, {"forgetting": np.inf}, {"forgetting": 1.0}),
        {"forgetting": 0.1, "learn": False},
    ],
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(InverseError, match=next(iter(wrong))):
        TrackerSettings(**wrong)


@pytest.mark.slow
def test_pixels_beside_a_sheet_that_is_no_rectangle_have_no_response(cornered):
    sheet = cornered.filter.sheet
    beside = np.asarray(sheet.pad_area).sum(1) == 0
    assert beside.any()
    assert np.isfinite(sheet.pixel_response).all()  # NaN here loses the contacts near the corner
    assert not np.asarray(sheet.pixel_response)[beside].any()
