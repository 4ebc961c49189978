"""The gain of the contact layer: its prior against the kernel, and what is kept of it from one run to another."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import eigh

import jaxeit as je
from jaxeit.contacts.loads.settings import LoadSettings
from jaxeit.imaging import InverseError
from jaxeit.tracking import GainField, LearnedLayer, TrackerSettings, prepare_tracker
from jaxeit.tracking.belief.apparent_gain import apparent_gain
from jaxeit.tracking.belief.layer import MAX_FILTER_VARIANCE, OUTLIER_PROBABILITY, PRESS_VARIANCES
from jaxeit.tracking.belief.programs import MIN_START_DISTANCE
from jaxeit.tracking.belief.response import Neighbourhood, load_pressure
from jaxeit.tracking.preparation import with_sheet_errors
from jaxeit.tracking.tracker import MAX_GAIN, bound_gain

from .conftest import GAUSSIAN, SECONDS, load, with_filter, with_settings

STRONGER = 1.3  # the true gain of the layer, everywhere
FORCES = np.array([10.0, 0.0, 0.0, 0.0])  # N on the pads under a press at (0.05, 0.06) m
PLACES = [(0.05, 0.06), (0.06, 0.05), (0.045, 0.045)]


@pytest.mark.slow
def test_a_gain_beyond_all_belief_is_forgotten_and_the_contacts_stay(tracker, frame_of):
    now = tracker.start()
    for _ in range(3):
        now = tracker.step(now, frame_of([load(0.08, 0.08, 10.0)]), SECONDS)
    assert bound_gain(now) is now
    wrong = replace(now, belief=now.belief._replace(gain=now.belief.gain.at[5].set(-MAX_GAIN - 1)))
    found = bound_gain(wrong).belief
    np.testing.assert_array_equal(found.contacts, now.belief.contacts)
    np.testing.assert_array_equal(found.covariance[:8, :8], now.belief.covariance[:8, :8])
    np.testing.assert_array_equal(found.covariance[8:, 8:], now.layer.before_press)
    assert not found.gain.any()
    assert not found.covariance[:8, 8:].any()


@pytest.fixture(scope="module")
def layer(tracker, frame_of):
    """Learned from three presses of known force on a layer that is stronger than was thought."""
    now = tracker.start()
    for x, y in PLACES:
        for force in (0.0, 0.0, 10.0, 10.0, 10.0, 10.0, 0.0, 0.0):
            frame = frame_of([load(x, y, max(force, 1e-6))], STRONGER)
            now = tracker.step(now, frame, SECONDS, FORCES * force / 10 + 1e-9, np.full(4, 0.2))
    return tracker.learned(now)


def press(tracker, frame_of, layer, x, y):
    """The contact of a press of 10 N that no pad tells of, after four frames."""
    now = tracker.start(layer)
    for force in (0.0, 10.0, 10.0, 10.0, 10.0):
        now = tracker.step(now, frame_of([load(x, y, max(force, 1e-6))], STRONGER), SECONDS)
    (track,) = now.tracks
    return track


def test_the_field_has_the_covariance_of_the_kernel():
    rng = np.random.default_rng(0)
    points = rng.uniform(0.03, 0.17, (40, 2))
    loads = LoadSettings()
    field = GainField.on_sheet(np.array([[0.0, 0.0], [0.2, 0.2]]), points, loads, level=0.3)
    modes = field.modes_at(points)
    square = ((points[:, None] - points) ** 2).sum(-1)
    expected = 0.3**2 + loads.gain**2 * np.exp(-square / (2 * loads.gain_length**2))
    np.testing.assert_allclose(modes @ modes.T, expected, atol=0.04 * loads.gain**2)


def test_nothing_learned_is_the_prior(tracker):
    layer = LearnedLayer.unknown(tracker.field)
    mean, deviation = layer.at(np.array([[0.1, 0.1], [0.05, 0.12]]))
    np.testing.assert_array_equal(mean, 0)
    np.testing.assert_allclose(deviation, np.hypot(tracker.settings.level, tracker.settings.loads.gain), rtol=0.02)
    np.testing.assert_array_equal(tracker.start(layer).belief.covariance, tracker.start().belief.covariance)


@pytest.mark.slow
def test_presses_of_known_force_tell_the_gain_where_they_are(layer):
    at = np.array([*PLACES, (0.15, 0.15)])
    mean, deviation = layer.at(at)
    assert layer.contacts == len(PLACES)
    assert (np.abs(mean - np.log(STRONGER)) < 2.5 * deviation).all()
    assert (np.abs(mean[:3] - np.log(STRONGER)) < 0.15).all()
    assert deviation[:3].max() < 0.5 * deviation[3]


@pytest.mark.slow
def test_presses_one_by_one_tell_the_gain_too(tracker, frame_of):
    """Frames by themselves, at the same places: the gain is told within what is stated, and then the force."""
    known = None
    for x, y in PLACES:
        now = tracker.press(frame_of([load(x, y, 10.0)], STRONGER), FORCES + 1e-9, np.full(4, 0.2), layer=known)
        assert len(now.tracks) == now.begun == 1
        assert np.linalg.norm(now.tracks[0].position - [x, y]) < 1e-3
        known = tracker.learned(now)
    assert known.contacts == len(PLACES)
    mean, deviation = known.at(np.array(PLACES))
    assert (np.abs(mean - np.log(STRONGER)) < 2 * deviation).all()
    frame = frame_of([load(0.05, 0.055, 10.0)], STRONGER)
    errors = [abs(tracker.press(frame, layer=one).tracks[0].force / 10 - 1) for one in (None, known)]
    assert errors[1] < min(0.5 * errors[0], 0.06)


@pytest.mark.slow
def test_a_press_states_what_shapes_may_cause(tracker, frame_of):
    """As contacts that are followed do; what unknown shapes add grows with the square of their moments."""
    frame, added = frame_of([load(0.08, 0.07, 10.0)]), []
    for shape in (0.0, 0.1, 0.2):
        now = with_filter(tracker, shape=shape).press(frame)
        (track,) = now.tracks
        added.append(track.covariance - np.asarray(now.belief.covariance)[:2, :2])
    np.testing.assert_allclose(added[2] - added[0], 4 * (added[1] - added[0]), rtol=0.01, atol=1e-12)
    assert np.linalg.eigvalsh(added[1] - added[0]).min() > (5e-5) ** 2


@pytest.mark.slow
def test_a_press_between_the_wrong_bolts_is_begun_elsewhere(tracker, frame_of, monkeypatch):
    """The best atom may be 20 mm off; from there the fit ends off the sheet, or with another width."""
    true = np.array([0.15, 0.12])
    frame = frame_of([load(*true, 20.0)])
    starts = tracker.programs._starts
    wrong = starts[np.argmax(np.linalg.norm(starts - true, axis=1))]
    best = tracker.programs.matched_positions
    monkeypatch.setattr(tracker.programs, "matched_positions", lambda left: iter([wrong]))
    assert np.linalg.norm(tracker.press(frame).tracks[0].position - true) > 0.02
    monkeypatch.setattr(tracker.programs, "matched_positions", lambda left: iter([wrong, *best(left)]))
    assert np.linalg.norm(tracker.press(frame).tracks[0].position - true) < 1e-3


def test_places_where_a_contact_may_begin_are_apart(tracker, frame_of):
    left = tracker.programs.innovation(
        tracker.start().belief, tracker.frame(frame_of([load(0.1, 0.1, 9.0)])), tracker.pads(None, None)
    )
    places = np.array(list(tracker.programs.matched_positions(left)))
    np.testing.assert_array_equal(places[0], tracker.programs.matched_position(left))
    away = np.linalg.norm(places[:, None] - places, axis=-1)
    assert away[np.triu_indices(len(places), 1)].min() >= MIN_START_DISTANCE


def told_directions(tracker, seed, count):
    """Pulls of the gain under presses along the directions that each press tells, (n,).

    Gain, place, width and force are drawn anew for each press, and the readings are those that the model of the tracker
    has of the whole sheet, with its noise and its model error.
    """
    sheet, rng, size = tracker.filter.sheet, np.random.default_rng([702, seed]), len(tracker.field.places)
    elements, pixels = len(sheet.sigma), len(sheet.pixels)
    every = (jnp.arange(elements), jnp.arange(len(sheet.sheet.green)), jnp.arange(pixels))
    whole = Neighbourhood(*every, jnp.ones(elements, bool), jnp.ones(pixels, bool))
    shown = jax.jit(lambda contact, gain: sheet.predict_measurement(contact, gain, jnp.zeros(0, jnp.int32), whole))
    frame_of = np.linalg.pinv(np.asarray(tracker.filter.compress))
    before = tracker.start(known_variance(0.0, tracker.field))
    for _ in range(count):
        gain, place = rng.normal(size=size), rng.uniform(0.02, 0.18, 2)
        one = load(*place, rng.uniform(4, 25), np.hypot(rng.uniform(0.008, 0.018), 0.006))
        true = shown(jnp.asarray([one]), jnp.asarray(gain))
        model_error = tracker.settings.loads.model_error * np.sqrt(np.mean(true.readings**2))
        y = true.readings + np.hypot(1, model_error) * rng.normal(size=len(true.readings))
        errors = np.hypot(0.03 * np.asarray(true.pads), 0.1)
        pads = tracker.pads(true.pads + errors * rng.normal(size=len(errors)), errors)
        found = tracker.press_update(before.belief, tracker.frame(frame_of @ y), pads).belief
        covariance = np.asarray(found.covariance, float)[-size:, -size:]
        left, along = eigh(covariance, subset_by_value=(-np.inf, 0.9))
        yield along.T @ (np.asarray(found.gain) - gain) / np.sqrt(left)


@pytest.mark.slow
def test_a_press_states_the_error_of_the_gain_under_it(model, skin, blank):
    """Where the model is right, in intervals of 90 %, with the reach that trackers have.

    A fit of the elements, pixels and modes around the place where it began covers 60 %: it takes what it leaves out for
    gain.
    """
    tracker = prepare_tracker(model, skin, noise=blank[1], sigma=model.background)
    pulls = np.concatenate([pull for seed in (1, 2) for pull in told_directions(tracker, seed, 20)])
    assert len(pulls) > 200
    assert 0.85 < np.mean(np.abs(pulls) < INTERVAL) < 0.95
    assert 0.8 < np.mean(pulls**2) < 1.5


def test_the_effect_of_a_press_does_not_move_contacts_and_is_in_the_error_of_forces(tracker, frame_of):
    """Presses that differ by a variance of ten: readings hardly tell a force, pads do, and places stay as they are."""
    layers = [known_variance(variance, tracker.field) for variance in (MAX_FILTER_VARIANCE, 10.0)]
    frames = [frame_of([load(0.05, 0.06, max(force, 1e-6))]) for force in (0.0, 10.0, 10.0)]
    states = [tracker.start(layer) for layer in layers]
    for frame in frames:
        states = [tracker.step(now, frame, SECONDS) for now in states]
    ((few,), (many,)) = (now.tracks for now in states)
    np.testing.assert_allclose(many.position, few.position, rtol=1e-9)
    np.testing.assert_allclose(many.covariance, few.covariance, rtol=1e-9)
    added = np.sqrt((many.log_force_error**2 - few.log_force_error**2) / (10.0 - MAX_FILTER_VARIANCE))
    assert 0.8 < added / np.hypot(tracker.field.level, tracker.field.deviation) < 1.1
    now = tracker.start(layers[1])
    for frame, force in zip(frames, (0.0, 1.0, 1.0), strict=True):
        now = tracker.step(now, frame, SECONDS, FORCES * force + 1e-9, np.full(4, 0.2))
    assert now.tracks[0].log_force_error < 0.05


@pytest.mark.slow
def test_the_gain_for_fits_of_loads_is_that_of_the_next_press(layer):
    """Its covariance is that of the layer and an effect of the press."""
    points = np.array(PLACES)
    mean, modes, covariance = layer.distribution(points)
    of_layer, deviation = layer.at(points)
    np.testing.assert_array_equal(mean, of_layer)
    of_readings = replace(layer, field=replace(layer.field, mesh_error=0.0)).at(points)[1]
    assert (deviation > of_readings).all()  # what the mesh errs by tells forces as gain does
    effect = layer.press_variance * (modes**2).sum(1)
    np.testing.assert_allclose(((modes @ covariance) * modes).sum(1), of_readings**2 + effect)


def test_what_was_learned_tells_the_force_without_pads(tracker, frame_of, layer):
    """The skin goes on working when no pad tells the force: at most half of the error without learning."""
    errors = [np.log(press(tracker, frame_of, known, 0.052, 0.055).force / 10) for known in (None, layer)]
    assert abs(errors[1]) < 0.5 * abs(errors[0])


def test_the_tail_of_a_load_on_other_pads_tells_no_force(tracker, frame_of):
    """The pad under the contact is dead; the one beside it feels more than of the load that is believed."""
    now, without = tracker.start(), tracker.start()
    for force in (0.0, 10.0, 10.0, 10.0):
        frame = frame_of([load(0.05, 0.06, max(force, 1e-6))])
        felt = np.array([np.nan, 0.3 * force, 0.1 * force, 0.0])
        now = tracker.step(now, frame, SECONDS, felt, np.full(4, 0.1))
        without = tracker.step(without, frame, SECONDS)
    (track,), (alone,) = now.tracks, without.tracks
    assert not tracker.told_by_pads(now.tracks, np.array([np.inf, 0.1, 0.1, 0.1])).any()
    assert track.force == pytest.approx(alone.force, rel=1e-6)
    assert track.position == pytest.approx(alone.position, abs=1e-8)


def test_learning_goes_on_where_it_ended(tracker, layer):
    now = tracker.start(layer)
    again = tracker.learned(now)
    np.testing.assert_allclose(again.mean, layer.mean, rtol=1e-6)
    np.testing.assert_allclose(again.covariance, layer.covariance, atol=1e-7)
    assert again.contacts == layer.contacts


def some_layer(field, contacts=7):
    """A layer that tells something else of each mode, under each variance of the effect of a press."""
    rng, size = np.random.default_rng(708), len(field.places)
    half = np.eye(size) - 0.05 * rng.normal(size=(len(PRESS_VARIANCES), size, size))
    covariances = half @ half.mT / np.linalg.norm(half, 2, axis=(1, 2))[:, None, None] ** 2
    means = 0.1 * rng.normal(size=(len(PRESS_VARIANCES), size))
    return LearnedLayer(field, means, covariances, -PRESS_VARIANCES, contacts)


def assert_same_layer(found, expected):
    """Every number is the same, bit by bit."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_layer_that_is_not_to_learn_stays_while_contacts_are_followed(tracker, frame_of):
    frozen, start, pressed = with_settings(tracker, learn=False), some_layer(tracker.field), 0
    now = frozen.start(start)
    for force in (0.0, 10.0, 10.0, 0.0, 0.0, 12.0, 12.0, 0.0, 0.0):
        frame = frame_of([load(0.05, 0.06, max(force, 1e-6))])
        now = frozen.step(now, frame, SECONDS, FORCES * force / 10 + 1e-9, np.full(4, 0.2))
        pressed += len(now.tracks)
        assert_same_layer(now.layer, start)
        assert_same_layer(frozen.learned(now), start)
    assert pressed >= 4
    assert now.begun == now.taught == 2
    np.testing.assert_array_equal(now.belief.covariance, frozen.start(start).belief.covariance)


def test_by_default_a_contact_that_has_lifted_teaches_the_layer(tracker):
    begin = tracker.start(some_layer(tracker.field))
    bent = begin.belief._replace(gain=begin.belief.gain + 0.1, covariance=0.5 * begin.belief.covariance)
    lifted = replace(begin, belief=bent, begun=1)
    for learn, way in ((True, tracker), (False, with_settings(tracker, learn=False))):
        found = way._learn_after_lift(lifted)
        assert found.taught == 1
        assert found.layer.contacts == begin.layer.contacts + learn
        assert np.array_equal(found.layer.means, begin.layer.means) is not learn
        np.testing.assert_array_equal(found.belief.gain, way.start(found.layer).belief.gain)


def test_a_layer_has_its_trackers_own_errors_of_sheet_and_mesh(tracker, layer):
    """It may have been learned with another fit of the sheet, or under another model error."""
    other = replace(layer, field=replace(layer.field, mesh_error=0.5))
    assert tracker.start(other).layer.field is tracker.field


def test_ageing_leads_back_to_the_prior(layer):
    half, gone = layer.aged(0.5), layer.aged(1.0)
    np.testing.assert_allclose(half.means, 0.5 * layer.means)
    np.testing.assert_allclose(gone.covariance, np.eye(len(layer.mean)), atol=1e-14)
    variances = [np.diag(one.covariance) for one in (layer, half, gone)]
    assert (variances[0] <= variances[1] + 1e-12).all()
    assert np.linalg.eigvalsh(half.covariance).min() > 0
    with pytest.raises(InverseError, match="give 0 to 1"):
        layer.aged(1.5)


def assert_aged(found, start, hours, forgetting):
    """An Ornstein-Uhlenbeck process about the prior, of variance one and mean zero, for each variance of the effect."""
    kept, unit = (1 - forgetting) ** hours, np.eye(start.means.shape[1])
    np.testing.assert_allclose(found.covariances, unit + kept * (start.covariances - unit), atol=1e-13)
    np.testing.assert_allclose(found.means, np.sqrt(kept) * start.means, atol=1e-13)
    assert np.linalg.eigvalsh(found.covariances).max() <= 1 + 1e-12
    assert found.contacts == start.contacts


@pytest.mark.parametrize("steps", [1, 6])
def test_an_hour_of_use_gives_back_a_part_of_the_variance(steps):
    start = found = some_layer(SMALL)
    for _ in range(steps):
        found = found.after_use(3 * 3600.0 / steps, 0.2)
    assert_aged(found, start, 3, 0.2)
    simulated, rate = start.covariances[4], -np.log(1 - 0.2)  # dP/dt = -rate (P - 1), by small steps
    for _ in range(30_000):
        simulated = simulated - 1e-4 * rate * (simulated - np.eye(8))
    np.testing.assert_allclose(found.covariances[4], simulated, atol=1e-4)


@pytest.mark.parametrize(
    ("seconds", "forgetting"), [(-1.0, 0.1), (np.nan, 0.1), (np.inf, 0.1), (1.0, 1.0), (1.0, np.nan)]
)
def test_time_and_forgetting_that_cannot_be_are_refused(seconds, forgetting):
    with pytest.raises(InverseError, match=r"(seconds|forgetting) is .*; give"):
        some_layer(SMALL).after_use(seconds, forgetting)


def test_the_layer_ages_while_nothing_touches_the_skin(tracker):
    """No time is lost, neither of short frames nor of a contact, and the next contact begins with the layer."""
    ageing, still = with_settings(tracker, forgetting=0.2), np.zeros(tracker.filter.finder.readings)
    start = now = ageing.start(some_layer(tracker.field))
    for _ in range(30):
        now = ageing.step(now, still, 7.0)
    assert now.unaged == 21.0
    assert_aged(now.layer, start.layer, 189 / 3600, 0.2)
    np.testing.assert_array_equal(now.belief.covariance, ageing.start(now.layer).belief.covariance)
    np.testing.assert_array_equal(now.belief.gain, ageing.start(now.layer).belief.gain)
    touched = replace(now, numbers=(1,))
    assert (ageing._aged(touched, 600.0).layer, ageing._aged(touched, 600.0).unaged) == (now.layer, 621.0)
    later = ageing._aged(replace(ageing._aged(touched, 600.0), numbers=()), 979.0)
    assert later.unaged == 0
    assert_aged(later.layer, start.layer, 1789 / 3600, 0.2)


def test_without_forgetting_no_number_of_the_layer_changes(tracker):
    begin = tracker.start(some_layer(tracker.field))
    now = tracker.step(begin, np.zeros(tracker.filter.finder.readings), 36_000.0)
    assert now.layer is begin.layer
    assert now.unaged == 0
    assert TrackerSettings().forgetting == 0


def test_a_layer_of_another_sheet_is_refused(tracker, layer):
    moved = replace(layer.field, places=layer.field.places + 0.01)
    for field in (moved, replace(layer.field, deviation=0.2)):
        with pytest.raises(InverseError, match="learned on another sheet or under other settings"):
            tracker.start(replace(layer, field=field))


SMALL = GainField(
    places=np.concatenate([np.full((1, 2), np.inf), np.zeros((7, 2))]),
    length=0.015,
    level=0.3,
    deviation=0.12,
    norm=1.0,
    sheet_error=np.zeros((8, 0)),
    mesh_error=0.0,
)
NOISE = 0.05  # of what a press tells of the gain under it
SEEDS, INTERVAL = 40, 1.645  # layers, and standard deviations in half a 90 % interval


def after_presses(rng, counts, variance):
    """Layers after presses of which each tells three directions of the gain under it; their true gain, told so far."""
    layer, true = LearnedLayer.unknown(SMALL), rng.normal(size=8)
    for number in range(max(counts)):
        under, rows = true + np.sqrt(variance) * rng.normal(size=8), rng.normal(size=(3, 8))
        seen = rows @ under + NOISE * rng.normal(size=3)
        before = layer.before_press
        gain = before @ rows.T @ np.linalg.inv(rows @ before @ rows.T + NOISE**2 * np.eye(3))
        layer = layer.told(layer.mean + gain @ (seen - rows @ layer.mean), before - gain @ rows @ before, 1)
        if number + 1 in counts:
            yield layer, true


def known_variance(variance, field=SMALL):
    """Nothing is learned but how far presses differ."""
    return replace(LearnedLayer.unknown(field), evidence=np.where(variance == PRESS_VARIANCES, 0.0, -1e3))


def test_without_an_effect_of_the_press_the_layer_is_the_belief_of_the_press():
    """Directions of which a press takes away less than a hundredth of the variance are left out."""
    gain, covariance = np.array([0.1, *np.zeros(7)]), np.diag([0.2, *np.ones(7)])
    layer = known_variance(0.0).told(gain, covariance, 2)
    assert (layer.press_variance, layer.contacts) == (0.0, 2)
    np.testing.assert_allclose(layer.mean, gain, atol=1e-12)
    np.testing.assert_allclose(layer.covariance, covariance, atol=1e-12)


def test_a_press_that_tells_nothing_changes_nothing():
    layer = LearnedLayer.unknown(SMALL)
    again = layer.told(layer.mean, layer.before_press, 1)
    np.testing.assert_array_equal(again.covariances, layer.covariances)
    np.testing.assert_allclose(again.probabilities, layer.probabilities)


@pytest.mark.parametrize("variance", [0.0, 0.01, 0.1, 0.3, 0.5, 1.0, 3.0])
def test_how_far_presses_differ_is_learned_and_the_layer_states_its_error(variance):
    """Intervals of 90 % hold, of layers from few presses and from many; normalised errors have a square of about one.

    They are a little narrow after few presses, which are believed to differ less, and between two `PRESS_VARIANCES`.
    """
    covered, squares = [], []
    for seed in range(SEEDS):
        for layer, true in after_presses(np.random.default_rng([701, seed]), (6, 30), variance):
            error = layer.mean - true
            covered.append(np.abs(error) < INTERVAL * np.sqrt(np.diag(layer.covariance)))
            squares.append(error @ np.linalg.solve(layer.covariance, error) / len(error))
        assert 0.5 * variance <= layer.press_variance <= 2 * variance + 0.005
    assert 0.83 < np.mean(covered) < 0.95
    assert 0.7 < np.mean(squares) < 1.4


def test_errors_that_all_presses_share_are_in_the_deviation():
    """Sheet and mesh look like gain: presses tell the sum, and intervals of 90 % are to hold the gain itself."""
    rng = np.random.default_rng(705)
    field = replace(SMALL, sheet_error=0.2 * rng.normal(size=(8, 3)), mesh_error=0.3 * SMALL.deviation)
    points = np.stack([np.linspace(0, 0.02, 5), np.zeros(5)], 1)
    told = SMALL.modes_at(points)
    found = []
    for seed in range(3 * SEEDS):
        errors = field.errors() @ np.random.default_rng([706, seed]).normal(size=3 + 7)
        for layer, shown in after_presses(np.random.default_rng([707, seed]), (30,), 0.01):
            for known in (SMALL, field):  # without these errors, and with them
                mean, deviation = replace(layer, field=known).at(points)
                found.append(np.abs(mean - told @ (shown - errors)) < INTERVAL * deviation)
    without, covered = np.mean(found[::2]), np.mean(found[1::2])
    assert without < 0.7
    assert 0.85 < covered < 0.95


def test_errors_of_sheet_and_mesh_do_not_matter_where_nothing_was_told():
    field = replace(SMALL, sheet_error=np.ones((8, 2)), mesh_error=0.1)
    layer = LearnedLayer.unknown(field)
    np.testing.assert_allclose(layer.true_covariance, np.eye(8), atol=1e-14)
    flat = replace(field, deviation=0.0)
    np.testing.assert_array_equal(flat.errors(), np.concatenate([np.ones((8, 2)), np.zeros((8, 7))], 1))


@pytest.mark.slow
def test_a_sheet_that_is_wrong_looks_like_gain(model, tracker):
    """The true gain is one everywhere. On one side of the sheet the conductivity is 2 % higher than the tracker's sheet
    has it, and as much lower on the other. Presses of known force then teach the gain that is foreseen."""
    tracker = with_filter(tracker, tail=0.0)  # loads are as they are believed, so that pads tell their forces exactly
    error, sheet = 0.02 * np.sin(np.pi * (np.asarray(model.centroids)[:, 0] - 0.1) / 0.2), tracker.filter.sheet
    loads, true = tracker.settings.loads, model.background * jnp.exp(error)

    @jax.jit
    def change(one):
        pressed = true * loads.law.factor(load_pressure(one, model.centroids, GAUSSIAN))
        return je.forward(model, pressed) - je.forward(model, true)

    before = tracker.start(known_variance(0.0, tracker.field))
    layer, at = before.layer, np.stack(np.meshgrid(*2 * [np.linspace(0.04, 0.16, 5)]), -1).reshape(-1, 2)
    for place in at:
        one = jnp.array(load(*place, loads.force, loads.width))
        on_pads = np.asarray(sheet.pad_loads(one[None], tracker.press_filter.sheet.neighbourhood(one[None])))[0]
        layer = tracker.learned(tracker.press(np.asarray(change(one)), on_pads, np.full(4, 0.05), layer=layer))
    usual = np.log([loads.width, loads.force])
    foreseen = apparent_gain(tracker.filter, with_sheet_errors(sheet, model, error[:, None]), usual, loads.gain_length)
    expected, (mean, _) = tracker.field.modes_at(at) @ foreseen[:, 0], layer.at(at)
    mean = mean - mean.mean()  # the mesh errs by about as much everywhere
    assert np.corrcoef(mean, expected)[0, 1] > 0.9
    assert np.linalg.norm(mean - expected) < 0.4 * np.linalg.norm(mean)


def test_no_single_press_rules_a_variance_out():
    ((layer, _),) = after_presses(np.random.default_rng(704), (10,), 0.0)
    wild = layer.told(layer.mean + 100, 0.5 * layer.before_press, 1)
    assert (wild.evidence - layer.evidence).min() >= np.log(OUTLIER_PROBABILITY) - 1e-9
    assert np.ptp(wild.evidence - layer.evidence) > 1


@pytest.mark.slow
def test_after_a_press_the_next_one_has_an_effect_of_its_own(tracker, frame_of):
    """The gain with which the next press begins is the layer and the effect; and no press, no lesson."""
    start = replace(LearnedLayer.unknown(tracker.field), evidence=np.linspace(-30, 0, len(PRESS_VARIANCES)))
    now = tracker.start(start)
    for force in (0.0, 10.0, 10.0, 10.0, 0.0, 0.0):
        now = tracker.step(
            now, frame_of([load(0.05, 0.06, max(force, 1e-6))]), SECONDS, FORCES * force / 10 + 1e-9, np.full(4, 0.2)
        )
    known = tracker.learned(now)
    assert not now.numbers
    assert now.taught == now.begun == known.contacts == 1
    np.testing.assert_allclose(now.belief.covariance, known.before_press)
    assert np.trace(known.covariance) < np.trace(start.covariance)
    again = tracker.start(start)
    assert tracker.learned(again) is again.layer
