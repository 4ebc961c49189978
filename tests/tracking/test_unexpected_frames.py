"""Looks into unexpected frames, piece by piece: a bounded number of solves in each frame, and the same contacts."""

from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from jaxeit.tracking.belief.frame_update import MAX_STEPS, PIECE_STEPS
from jaxeit.tracking.belief.programs import MIN_START_DISTANCE, Programs
from jaxeit.tracking.belief.state import Pads
from jaxeit.tracking.events import allow_jumps
from jaxeit.tracking.tracks import MAX_PATIENCE, PATIENCE, Observation
from jaxeit.tracking.unexpected_frames import (
    MAX_WAIT,
    MAX_WAITING,
    advance_look,
    apply_update,
    begin_look,
    needs_recount,
    queue_frame,
)

from .conftest import SECONDS, load

PIECES = 6  # of a look, in each frame


class CountingPrograms(Programs):
    """Counts the evaluations of what contacts show."""

    evaluations = 0

    def predict_and_update(self, *args):
        found = super().predict_and_update(*args)
        self.evaluations += int(found[1].evaluations)
        return found

    def advance(self, belief, dv, pads, attempt):
        found = super().advance(belief, dv, pads, attempt)
        steps = [0 if one is None or one.state is None else int(one.state.steps) for one in (attempt, found)]
        self.evaluations += steps[1] - steps[0]
        return found

    def birth_position(self, *args):
        self.evaluations += 1
        return super().birth_position(*args)

    def excess_position(self, *args):
        self.evaluations += 1
        return super().excess_position(*args)


def truth(k):
    """A press that slides; from the eighth frame on a second one 30 mm from it; the first lifts, then both are gone."""
    first, second = load(0.06 + 0.0005 * k, 0.08, 12.0), load(0.06 + 0.0005 * k, 0.11, 9.0)
    return [one for one, there in ((first, 2 <= k < 48), (second, 8 <= k < 60)) if there]


@pytest.fixture(scope="module")
def followed(tracker, frame_of):
    """What is known after each frame and its pieces; evaluations in each frame, and in each piece."""
    counting, states, frames, pieces = CountingPrograms(tracker.filter), [], [], []
    kept, tracker.programs, now = tracker.programs, counting, tracker.start()
    for k in range(70):
        before = counting.evaluations
        now = tracker.step(now, frame_of(truth(k) or [load(0.1, 0.1, 1e-6)]), SECONDS, whole=False)
        frames.append(counting.evaluations - before)
        for _ in range(PIECES):
            before = counting.evaluations
            now = tracker.look(now)
            pieces.append(counting.evaluations - before)
        states.append(now)
    tracker.programs = kept
    return states, frames, pieces


def test_no_frame_does_more_than_a_bounded_number_of_solves(followed):
    _, frames, pieces = followed
    assert 0 < max(frames) <= MAX_STEPS
    assert PIECE_STEPS <= max(pieces) <= MAX_STEPS
    assert sum(pieces) > 60  # more than one frame may do: they were spread


def test_contacts_are_told_a_few_frames_later_and_keep_their_numbers(followed):
    """As many as were simulated, once a look has had time to end; each within 2 mm."""
    states, numbers = followed[0], [state.numbers for state in followed[0]]
    late = next(k for k in range(70) if len(numbers[k]) == 2)
    assert numbers[:2] == [()] * 2
    assert numbers[6:8] == [(1,)] * 2
    assert 8 < late < 8 + 35
    assert numbers[late:48] == [(1, 2)] * (48 - late)
    assert numbers[54:60] == [(2,)] * 6  # of the other, some force is believed in for a while
    assert numbers[-1] == ()
    for k in range(late + 2, 48):
        for track, own in zip(states[k].tracks, truth(k), strict=True):
            assert np.linalg.norm(track.position - own[:2]) < 2e-3


def test_a_look_ends_and_a_frame_is_looked_into_again_only_if_it_is_unexpected(followed):
    looking = [state.backlog is not None for state in followed[0]]
    assert looking[8]
    assert not all(looking[12:47])


def test_a_contact_that_is_elsewhere_keeps_its_number(tracker, frame_of):
    """Farther than a fit from its place would find it, and no second contact begins beside it."""
    now = tracker.start()
    for place in ((0.05, 0.06), (0.05, 0.06), (0.09, 0.12)):
        now = tracker.step(now, frame_of([load(*place, 8.0)]), SECONDS)
    (track,) = now.tracks
    assert track.number == now.begun == 1
    assert np.linalg.norm(track.position - place) < 1.5e-3


def two_contacts(tracker, frame, places, doubted=True):
    """Two contacts as a frame by itself leaves them, whose force may be hardly known."""
    belief = tracker.start().belief
    for place in places:
        belief = tracker.events.with_contact(belief, np.asarray(place))
    now = replace(tracker.start(), belief=belief, numbers=(1, 2), edges=(False,) * 2, faint=(0,) * 2, begun=2)
    now = apply_update(
        now, tracker.programs.single_frame_update(belief, tracker.frame(frame), tracker.pads(None, None))
    )
    return replace(now, belief=allow_jumps(now.belief) if doubted else now.belief, since=PATIENCE)


def test_two_contacts_that_are_one_are_counted_again(tracker, frame_of):
    now = two_contacts(tracker, frame_of([load(0.06, 0.08, 10.0)]), [(0.055, 0.078), (0.066, 0.084)], doubted=False)
    assert needs_recount(now)
    for _ in range(2):
        now = tracker.step(now, frame_of([load(0.06, 0.08, 10.0)]), SECONDS)
    (track,) = now.tracks
    assert track.number == 1
    assert np.linalg.norm(track.position - [0.06, 0.08]) < 1e-3


def test_two_contacts_that_are_counted_again_stay_two(tracker, frame_of):
    truth = [load(0.06, 0.08, 10.0), load(0.085, 0.08, 8.0)]
    now = two_contacts(tracker, frame_of(truth), [one[:2] for one in truth])
    assert needs_recount(now)
    assert not needs_recount(replace(now, since=0))
    now = tracker.step(now, frame_of(truth), SECONDS)
    assert now.numbers == (1, 2)
    assert now.since == 0  # they were counted


def test_what_no_event_explains_is_asked_about_less_and_less_often(tracker, frame_of):
    """What the model leaves of a press that is held does not pass; the press keeps its number."""
    rng = np.random.default_rng(4)
    compress, atoms = (np.asarray(part, float) for part in (tracker.filter.compress, tracker.filter.finder.atoms))
    hidden = np.linalg.svd(atoms)[2][-len(compress) // 3 :]  # what contacts show least of, so that none explains it
    left = 5 * rng.normal(size=len(hidden)) @ hidden
    strange = frame_of([load(0.06, 0.08, 12.0)]) + np.linalg.pinv(compress) @ left
    now, asked = tracker.start(), []
    for k in range(200):
        now = tracker.step(now, strange, SECONDS)
        if k >= 20 and now.since == 0:
            asked.append(k)
    assert now.numbers == (1,)
    between = np.diff(asked) - 1
    assert len(between) >= 2
    assert (between[1:] == np.minimum(2 * between[:-1], MAX_PATIENCE)).all()
    assert PATIENCE <= between[0] <= MAX_PATIENCE == between[-1]


def seen(number):
    return Observation(np.full(1, number), Pads(np.zeros(1), np.ones(1)), 1.0)


def test_frames_that_wait_are_thinned_and_no_second_is_lost(followed):
    backlog = next(state.backlog for state in followed[0] if state.backlog and state.backlog.look)
    backlog = replace(backlog, waiting=())
    for k in range(1, 50):
        backlog = queue_frame(backlog, seen(k))
        assert len(backlog.waiting) <= MAX_WAITING
        assert sum(frame.seconds for frame in backlog.waiting) == k
        assert backlog.waiting[-1].dv == k  # the newest frame is kept as it is
    count = len(backlog.waiting)
    backlog = queue_frame(replace(backlog, look=None), seen(50))
    assert len(backlog.waiting) == count  # while frames are followed, they do not become more
    assert sum(frame.seconds for frame in backlog.waiting) == 50


def test_contacts_begin_anew_after_an_update_that_is_not_finite(tracker, frame_of, followed):
    """The gain stays as it was learned, less the effect of this press."""
    now = next(state for state in followed[0] if state.numbers == (1, 2) and state.backlog is None)
    broken = np.array(now.belief.covariance)
    broken[2, 2] = -1.0
    now = replace(now, belief=now.belief._replace(covariance=jnp.asarray(broken)), backlog=None)
    lost = tracker.step(now, frame_of(truth(30)), SECONDS, whole=False)
    assert lost.numbers == ()
    known = tracker.learned(now)
    np.testing.assert_array_equal(lost.belief.gain, known.mean)
    np.testing.assert_array_equal(lost.belief.covariance, known.before_press)
    found = tracker.step(lost, frame_of(truth(31)), SECONDS)
    assert found.numbers
    assert min(found.numbers) == 3  # a number is never given twice


def test_without_spare_time_contacts_are_given_up_and_found_again_once_there_is_some(tracker, frame_of, followed):
    """A machine that is too slow for looks tells no contact, rather than one that has moved on unseen."""
    now = next(state for state in followed[0] if state.backlog is not None and state.numbers)
    still, quarter = frame_of(truth(55)), MAX_WAIT / 4  # one contact is left
    shown = []
    for _ in range(16):
        now = tracker.step(now, still, quarter, whole=False)
        shown.append(now.numbers)
    assert shown[0] != ()
    assert shown[-1] == ()
    for _ in range(40):
        now = tracker.step(now, still, SECONDS, whole=False)
        for _ in range(PIECES):
            now = tracker.look(now)
    assert len(now.numbers) == 1
    assert np.linalg.norm(now.tracks[0].position - truth(55)[0][:2]) < 2e-3


def test_without_spare_time_a_contact_that_rests_keeps_its_number(tracker, frame_of):
    """It explains the frame, whatever was asked of one before."""
    now, held = tracker.start(), [load(0.06, 0.08, 12.0)]
    for _ in range(20):
        now = tracker.step(now, frame_of(held), SECONDS)
    now = tracker.step(now, frame_of([*held, load(0.06, 0.12, 9.0)]), SECONDS, whole=False)
    assert now.backlog is not None
    for _ in range(16):
        now = tracker.step(now, frame_of(held), MAX_WAIT / 4, whole=False)
        assert now.numbers == (1,)
    assert now.backlog is None
    assert np.linalg.norm(now.tracks[0].position - held[0][:2]) < 1e-3


@pytest.mark.parametrize(
    ("place", "before", "after"), [((0.137, 0.022), 0.5, 25.0), ((0.098, 0.1), 0.5, 25.0), ((0.06, 0.08), 0.3, 12.0)]
)
def test_a_force_that_grows_fiftyfold_in_a_frame_is_one_contact(tracker, frame_of, place, before, after):
    """Beyond the few evaluations of an ordinary update; the look into the frame must not lose what it finds."""
    now, sheet = tracker.start(), tracker.filter.sheet
    for force in (before, after, after):
        loads = jnp.asarray([load(*place, force)])
        on_pads = np.asarray(sheet.pad_loads(loads, sheet.neighbourhood(loads))).sum(0)
        now = tracker.step(now, frame_of(loads.tolist()), 0.1, on_pads, np.hypot(0.05, 0.05 * on_pads))
        assert now.numbers == (1,)
    (track,) = now.tracks
    assert track.force == pytest.approx(force, rel=0.1)
    assert np.linalg.norm(track.position - place) < 2e-3


def test_with_a_piece_a_frame_no_frame_is_left_waiting(tracker, frame_of):
    """Each piece follows one frame; the last that waits and the new one are followed as one."""
    now, waited = tracker.start(), []
    for force in [0.5] * 40 + [1.3, 4.0] + [12.0] * 40:
        now = tracker.step(now, frame_of([load(0.137, 0.022, force)]), SECONDS, whole=False)
        now = tracker.look(now)
        waited.append(0 if now.backlog is None else len(now.backlog.waiting))
    assert now.numbers == (1,)
    assert max(waited[40:]) > 0
    assert waited[39] == waited[-1] == 0
    assert now.backlog is None


@pytest.mark.parametrize("second", [False, True])
def test_events_are_asked_about_only_where_contacts_leave_something(tracker, frame_of, second):
    """The contact before the frame explains it within noise, or there is a second one."""
    loads = [load(0.05, 0.05, 10.0)]
    before = tracker.step(tracker.start(), frame_of(loads), SECONDS)
    frame = frame_of([load(0.05, 0.05, 10.5), *[load(0.15, 0.15, 5.0)] * second])
    seen = Observation(tracker.frame(frame), tracker.pads(None, None), SECONDS)
    predicted, update = tracker.programs.predict_and_update(before.belief, *seen)
    look = begin_look(replace(before, belief=predicted), apply_update(before, update), seen)
    asked = False
    while look.after is None:
        look = advance_look(look, tracker.programs, tracker.events)
        asked = asked or look.trials is not None
    assert asked == second
    assert len(look.after.numbers) == 1 + second


def test_a_contact_may_begin_where_a_frame_shows_more_than_predicted(tracker, frame_of):
    """Not where it shows less, as under a contact that has lifted."""
    now, one, other = tracker.start(), load(0.06, 0.08, 10.0), load(0.06, 0.11, 20.0)
    for _ in range(4):
        now = tracker.step(now, frame_of([one]), SECONDS)
    show = partial(tracker.programs.excess_position, now.belief, pads=tracker.pads(None, None))
    assert np.linalg.norm(show(dv=tracker.frame(frame_of([one, other]))) - other[:2]) < MIN_START_DISTANCE
    assert show(dv=tracker.frame(frame_of([load(0.06, 0.08, 1e-6)]))) is None
