"""The law of contacts in a calibration: its file, how sessions teach it, and where forces follow it."""

from dataclasses import replace

import numpy as np
import pytest

import calib
import jaxeit as je
from calib.calibration.localisation import contact_tracks
from calib.calibration.localisation.contact_tracks import ContactTracks
from calib.calibration.localisation.learned.law_lessons import ContactLawLearner
from calib.live.follower import LiveFollower
from calib.session import SessionError
from jaxeit.tracking import ContactLaw, GainField, LearnedLayer, TimedTracks, Track, Tracker, TrackerSettings, Tracking

from ..helpers import stand_in
from .damage import damage

PLACE, WIDTH, SECOND = np.array([0.05, 0.05]), 0.012, 10**9
WEAKER = 0.5  # true force over that of readings alone
CORNERS = np.array([[0.0, 0.0], [0.2, 0.2]])
LAYER = LearnedLayer.unknown(
    GainField.on_sheet(CORNERS, CORNERS, je.contacts.LoadSettings(gain_length=0.05), level=0.3)
)


def track(force, number=1, place=PLACE):
    return Track(number, place, 1e-6 * np.eye(2), WIDTH, force, 0.3, np.zeros(2), np.zeros(2))


def known_law(seed, count=20):
    """A law after contacts that readings tell twice too strong."""
    law = ContactLaw.unknown()
    for force in np.random.default_rng(seed).uniform(4, 25, count):
        law = law.told(track(force / WEAKER), force)
    return law


class FakeTracker(Tracker):
    """A frame holds the force of the one contact; without pads it counts for twice as much. `layers` are those begun
    with, `presses` the frames that are asked by themselves."""

    def __init__(self):
        self._settings, self.layers, self.presses = TrackerSettings(), [], []

    def start(self, layer=None):
        self.layers.append(layer)
        return stand_in(Tracking, tracks=(), begun=0, backlog=None)

    def step(self, now, dv, seconds, pad_forces=None, pad_errors=None, *, whole=True):
        force, told = float(dv[0]), pad_errors is not None and bool(np.isfinite(pad_errors).any())
        if not force:
            return stand_in(Tracking, tracks=(), begun=now.begun, backlog=None)
        begun = now.begun if now.tracks else now.begun + 1
        tracks = (track(force if told else force / WEAKER, begun),)
        return stand_in(Tracking, tracks=tracks, begun=begun, backlog=None)

    def press(self, dv, pad_forces=None, pad_errors=None, *, layer=None):
        assert pad_errors is None
        self.presses.append(float(dv[0]))
        return self.step(self.start(layer), dv, 0.5)

    def learned(self, now):
        return replace(LAYER, contacts=now.begun)

    def told_by_pads(self, tracks, pad_errors=None):
        told = pad_errors is not None and bool(np.isfinite(pad_errors).any())
        return np.full(len(tracks), told)


def followed(forces, *, pads=True, law=None, watch=lambda *_: None, tracker=None):
    """Rows of a contact with these forces, frame by frame."""
    tracks = ContactTracks(tracker or FakeTracker(), smooth=False, law=law, watch=watch)
    change = np.array(forces, float)[:, None]
    known = np.where(pads, 1.0, np.nan) * np.ones((len(change), 4))
    return tracks.add(SECOND // 10 * np.arange(len(change)), change, known, known)


def test_a_calibration_keeps_the_law_and_one_without_opens(calibration, tmp_path):
    law = known_law(401)
    replace(calibration, contact_law=law).save(tmp_path / "c.h5")
    found = calib.load_calibration(tmp_path / "c.h5").contact_law
    for name in ContactLaw._fields:
        np.testing.assert_array_equal(getattr(found, name), getattr(law, name))
    assert found.applied(track(9.0)).force == law.applied(track(9.0)).force
    calibration.save(tmp_path / "none.h5")
    assert calib.load_calibration(tmp_path / "none.h5").contact_law is None


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("covariance", lambda a: a - 99 * np.eye(3), "is no covariance"),
        ("mean", lambda a: a * np.nan, "contact_law/mean holds a number that is not finite"),
        ("rate", lambda a: 0 * a, "contact_law/rate holds a number that is not finite, or zero or less"),
        ("shape", lambda a: 0 * a + 1, "contact_law/shape is one or less"),
        ("low", lambda a: a[:1], r"contact_law/low is float64 of shape \(1,\)"),
        ("contacts", lambda a: a - 100, "contact_law/contacts is -80; nothing is learned from less than none"),
    ],
)
def test_a_damaged_law_is_refused(calibration, tmp_path, name, change, message):
    path = tmp_path / "c.h5"
    replace(calibration, contact_law=known_law(402)).save(path)
    damage(path, f"contact_law/{name}", change)
    with pytest.raises(SessionError, match=message):
        calib.load_calibration(path)


def test_each_contact_teaches_its_largest_force_by_a_frame_of_its_own():
    """With the layer that was known before the contact began."""
    tracker = FakeTracker()
    lessons = ContactLawLearner(tracker, None, None)
    followed([0, 4, 10, 6, 0, 0, 20, 12, 0], watch=lessons, tracker=tracker)
    law = lessons.law()
    assert law.contacts == 2
    np.testing.assert_allclose(np.exp([law.low[0], law.high[0]]), [10, 20])
    assert [layer.contacts for layer in tracker.layers[1:]] == [0, 1]
    assert tracker.presses == [10, 20]


def test_contacts_that_no_pad_tells_teach_nothing():
    lessons = ContactLawLearner(FakeTracker(), None, None)
    followed([0, 4, 10, 0], pads=False, watch=lessons)
    assert lessons.law().contacts == 0


def test_forces_follow_the_law_where_no_pad_tells_them():
    law = known_law(403)
    without, by_law = (followed([10, 10], pads=False, law=one) for one in (None, law))
    np.testing.assert_allclose(without["force"], 10 / WEAKER)
    np.testing.assert_allclose(by_law["force"], 10, rtol=0.1)
    assert (by_law["force_se"] < without["force_se"]).all()
    told = followed([10, 10], law=law)
    np.testing.assert_array_equal(told["force"], 10)


class Late:
    """Gives each frame back after the next one, as a smoother of lag one."""

    def __init__(self, tracker):
        self.frames = []

    def add(self, time, now, seconds):
        self.frames.append(TimedTracks(time, now.tracks))
        return [self.frames[-2]] if len(self.frames) > 1 else []

    def end(self):
        return self.frames[-1:]


def test_smoothed_forces_follow_the_law_by_the_pads_of_their_own_frame(monkeypatch):
    """No pad tells anything in the second of three frames."""
    monkeypatch.setattr(contact_tracks, "Smoother", Late)
    tracks, known = ContactTracks(FakeTracker(), law=known_law(405)), np.array([1.0, np.nan, 1.0])[:, None] * np.ones(4)
    rows = [tracks.add(SECOND // 10 * np.arange(3), np.full((3, 1), 10.0), known, known), tracks.end()]
    force = np.concatenate([each["force"] for each in rows])
    np.testing.assert_array_equal(force[[0, 2]], 10)
    assert force[1] == pytest.approx(10, rel=0.1)
    assert force[1] != 10


def test_live_follows_the_law(calibration):
    follower = LiveFollower(replace(calibration, contact_law=known_law(404)), lambda *_: FakeTracker())
    follower._tracker = FakeTracker()
    dark, lit = np.full(4, np.nan), np.ones(4)
    change = np.full(calibration.recon.readings, 10.0)
    (alone,) = follower.step(change, dark, dark, SECOND)
    (told,) = follower.step(change, lit, lit, 2 * SECOND)
    assert alone.force == pytest.approx(10, rel=0.1)
    assert told.force == 10
