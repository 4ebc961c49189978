"""The gain of the contact layer in a calibration: its file, where it is learned, and where it is used."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.calibration import layer as layer_module, procedure
from calib.calibration.layer import FORGETTING_FACTOR, learn_layer, render_layer
from calib.calibration.localisation import contact_tracks
from calib.calibration.localisation.contact_tracks import NotFollowed, quiet_tracker
from calib.calibration.press_examples import PressExamples
from calib.cli import main
from calib.live.follower import LiveFollower
from calib.live.recalibrator import LiveRecalibrator
from calib.session import SessionError
from jaxeit.contacts.loads.settings import LoadSettings
from jaxeit.tracking import GainField, LearnedLayer, Smoother, Track, Tracker, Tracking

from ..helpers import stand_in
from .damage import damage

PLACES = np.array([[0.05, 0.05], [0.15, 0.05], [0.05, 0.15], [0.15, 0.15], [0.1, 0.05]])
FORCE = np.full(5, 10.0)
CONTACTS = 3  # that a tracker begins while a session lasts


@pytest.fixture(scope="module")
def layer():
    """Learned from seven contacts."""
    rng = np.random.default_rng(0)
    corners = np.array([[0.0, 0.0], [0.2, 0.2]])
    field = GainField.on_sheet(corners, rng.uniform(0, 0.2, (50, 2)), LoadSettings(gain_length=0.05), level=0.3)
    field = replace(field, sheet_error=0.1 * rng.normal(size=(len(field.places), 4)), mesh_error=0.02)
    half = np.eye(len(field.places)) - 0.2
    return LearnedLayer.normal(field, rng.normal(size=len(half)), half @ half.T / len(half), 7)


class FakeTracker(Tracker):
    """Three contacts begin with the first frame and tell the gain that is given.

    `started` holds the layers before, and `asked` those before presses that are told by their readings alone.
    """

    def __init__(self, tells):
        self.tells, self.started, self.asked, self.steps = tells, [], [], 0
        self.field = stand_in(GainField, depth=0.0094)

    def start(self, layer=None):
        self.started.append(layer)
        return stand_in(Tracking, tracks=(), begun=0, backlog=None, layer=layer)

    def step(self, now, change, seconds, force, error, whole=True):
        self.steps += 1
        return stand_in(Tracking, tracks=(), begun=CONTACTS, backlog=None, layer=now.layer)

    def press(self, dv, forces=None, errors=None, *, layer=None):
        """Readings alone tell the force that the pads told last."""
        if forces is None:
            self.asked.append(layer)
        else:
            self.started.append(layer)
            self.force = float(np.sum(forces))
        track = Track(1, np.zeros(2), np.eye(2), 0.012, self.force, 0.1, np.zeros(2), np.zeros(2))
        return stand_in(Tracking, tracks=(track,), begun=1, layer=layer)

    def told_by_pads(self, tracks, errors=None):
        return np.full(len(tracks), errors is not None)

    def learned(self, now):
        return replace(self.tells, contacts=now.begun + (0 if now.layer is None else now.layer.contacts))


def better_with_contacts(tracker, dv, forces, errors, layer):
    """Presses are the more probable the more contacts a layer was learned from."""
    return np.full(len(dv), 0.0 if layer is None else float(layer.contacts))


@pytest.fixture
def tracker(layer, monkeypatch):
    tracker = FakeTracker(layer)
    for user in (contact_tracks, layer_module):
        monkeypatch.setattr(user, "prepare_calibrated_tracker", lambda *_: tracker)
    monkeypatch.setattr(je.tracking, "press_evidence", better_with_contacts)
    monkeypatch.setattr(Smoother, "__init__", lambda *_: None)
    monkeypatch.setattr(Smoother, "add", lambda *_: [])
    monkeypatch.setattr(Smoother, "end", lambda _: [])
    return tracker


@pytest.fixture(scope="module")
def presses(later, tmp_path_factory):
    """A session that tells its presses and the force of a load cell."""
    return later.record(tmp_path_factory.mktemp("bench") / "bench.h5", PLACES, FORCE, load_cell=FORCE)


@pytest.fixture(scope="module")
def session(presses, tmp_path_factory):
    """The same as ordinary use, which tells no presses."""
    use = Path(shutil.copy(presses, tmp_path_factory.mktemp("use") / "use.h5"))
    with h5py.File(use, "r+") as file:
        del file["presses"]
    return use


def test_a_calibration_keeps_the_layer(calibration, layer, tmp_path):
    layer = replace(layer, means=layer.means + layer.evidence[:, None])  # one for each variance
    replace(calibration, layer=layer).save(tmp_path / "c.h5")
    found = calib.load_calibration(tmp_path / "c.h5").layer
    for name in ("means", "covariances", "contacts", "evidence"):
        np.testing.assert_array_equal(getattr(found, name), getattr(layer, name))
    points = np.random.default_rng(1).uniform(0, 0.2, (20, 2))
    np.testing.assert_array_equal(found.at(points), layer.at(points))
    calibration.save(tmp_path / "none.h5")
    assert calib.load_calibration(tmp_path / "none.h5").layer is None


def test_a_layer_of_an_early_version_is_read(calibration, layer, tmp_path):
    """It holds one normal distribution, and nothing of how far presses differ from it."""
    path = tmp_path / "c.h5"
    replace(calibration, layer=layer).save(path)
    for name, change in (("mean", lambda a: a[0]), ("covariance", lambda a: a[0]), ("evidence", lambda a: None)):
        damage(path, f"layer/{name}", change)
    found = calib.load_calibration(path).layer
    for name in ("means", "covariances", "contacts", "evidence"):
        np.testing.assert_array_equal(getattr(found, name), getattr(layer, name))


def test_a_layer_without_errors_of_sheet_and_mesh_is_read(calibration, layer, tmp_path):
    path = tmp_path / "c.h5"
    replace(calibration, layer=layer).save(path)
    for name in ("sheet_error", "mesh_error"):
        damage(path, f"layer/{name}", lambda a: None)
    found = calib.load_calibration(path).layer
    assert found.field.errors().sum() == 0
    np.testing.assert_array_equal(found.covariance, layer.covariance)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("covariance", lambda a: a - 2 * np.eye(a.shape[-1]), "is no covariance"),
        ("covariance", lambda a: a[0], "layer/covariance is float64 of shape"),
        (
            "mean",
            lambda a: np.where(np.arange(a.shape[1]) == 3, np.nan, a),
            "layer/mean holds a number that is not finite",
        ),
        ("places", lambda a: a[1:], "layer/places is float64 of shape"),
        ("evidence", lambda a: a * np.nan, "layer/evidence holds a number that is not finite"),
        ("evidence", lambda a: a[1:], "layer/evidence is float64 of shape"),
        ("sheet_error", lambda a: a[1:], "layer/sheet_error is float64 of shape"),
        ("sheet_error", lambda a: a * np.nan, "layer/sheet_error holds a number that is not finite"),
        ("mesh_error", lambda a: -a, "layer/mesh_error holds -0.02, below zero"),
        ("length", lambda a: 0 * a, "layer/length holds a number that is not finite, or zero or less"),
        ("contacts", lambda a: a - 100, "layer/contacts is -93; nothing is learned from less than none"),
    ],
)
def test_a_damaged_layer_is_refused(calibration, layer, tmp_path, name, change, message):
    path = tmp_path / "c.h5"
    replace(calibration, layer=layer).save(path)
    damage(path, f"layer/{name}", change)
    with pytest.raises(SessionError, match=message):
        calib.load_calibration(path)


def test_learning_starts_from_what_was_learned_before_less_a_part(calibration, session, tracker, layer):
    with calib.open_session(session) as use:
        once = learn_layer(calibration, use)
        twice = learn_layer(once, use)
    first, second = tracker.started
    assert first is None
    np.testing.assert_allclose(second.mean, (1 - FORGETTING_FACTOR) * layer.mean)
    assert (once.layer.contacts, twice.layer.contacts) == (CONTACTS, 2 * CONTACTS)
    assert tracker.steps > 2 * 100


def test_each_press_that_a_session_tells_is_one_contact(calibration, presses, tracker, layer):
    """It begins with what those before it told, and no frame is followed."""
    with calib.open_session(presses) as bench:
        once = learn_layer(calibration, bench)
        again = learn_layer(once, bench)
    assert tracker.steps == 0
    assert [id(one) for one in tracker.asked] == [id(one) for one in tracker.started]
    assert (once.contact_law.contacts, again.contact_law.contacts) == (len(PLACES), 2 * len(PLACES))
    contacts = [None if one is None else one.contacts for one in tracker.started]
    assert contacts == [None, *range(1, 2 * len(PLACES))]
    np.testing.assert_allclose(tracker.started[len(PLACES)].mean, (1 - FORGETTING_FACTOR) * layer.mean)
    assert (once.layer.contacts, again.layer.contacts) == (len(PLACES), 2 * len(PLACES))


def test_a_session_that_tells_nothing_is_refused(calibration, session, tracker, monkeypatch):
    with calib.open_session(session) as use:
        monkeypatch.setattr(FakeTracker, "step", lambda self, now, *_, **__: now)
        with pytest.raises(SessionError, match=r"use\.h5: nothing touched the skin; press it in many places"):
            learn_layer(calibration, use)

        def unknown(*_):
            raise NotFollowed("no frames without contact tell the noise")

        monkeypatch.setattr(contact_tracks, "prepare_calibrated_tracker", unknown)
        with pytest.raises(SessionError, match=r"use\.h5: no frames .* noise; record a second without contact"):
            learn_layer(calibration, use)


def test_a_layer_under_which_the_calibrations_presses_are_less_probable_is_refused(
    calibration, session, tracker, monkeypatch
):
    readings = calibration.recon.readings
    probes = PressExamples(np.zeros((2, readings)), np.full((2, 4), 500.0), np.full((2, 2), 0.05), np.full(2, 5.0))
    asked = []

    def evidence(tracker, dv, forces, errors, layer):
        asked.append(layer)
        return np.array([0.0, 0.0]) if layer is None else np.array([5.0, -6.0])

    monkeypatch.setattr(je.tracking, "press_evidence", evidence)
    with (
        calib.open_session(session) as use,
        pytest.raises(
            SessionError, match=r"use\.h5: the presses .* less probable .*; calibrate again, press it in more"
        ),
    ):
        learn_layer(replace(calibration, probes=probes), use)
    assert [layer is None for layer in asked] == [False, True]
    with calib.open_session(session) as use:
        fitted = calibration.provenance | {"sessions": f"{use.hash}  use.h5"}
        with pytest.raises(SessionError, match=r"than without; press it in more places"):
            learn_layer(replace(calibration, probes=probes, provenance=fitted), use)


def test_the_commands_learn_keep_and_use_the_layer(calibration, presses, tracker, tmp_path, capsys):
    old, new, out = (str(tmp_path / name) for name in ("old.h5", "new.h5", "out.h5"))
    calibration.save(old)
    assert main(["recalibrate", old, str(presses), "-o", new, "--learn-layer"]) == 0
    told = capsys.readouterr().out
    assert f"learned from {len(PLACES)} contacts" in told
    assert f"force without pads: as the model tells it; {len(PLACES)} contacts do not speak for another law" in told
    assert main(["apply", new, str(presses), "-o", out, "--track"]) == 0
    assert tracker.started[-1].contacts == len(PLACES)
    with h5py.File(out) as file:
        assert file["tracks/depth"][()] == tracker.field.depth
    assert main(["recalibrate", new, str(presses), "-o", out, "--learn-layer", "--json"]) == 2
    assert "has moved this calibration before" in capsys.readouterr().err
    later = shutil.copy(presses, tmp_path / "later.h5")
    with h5py.File(later, "r+") as file:
        file.attrs["title"] = np.bytes_(b"on the day after")
    assert main(["recalibrate", new, str(later), "-o", out, "--learn-layer", "--json"]) == 0
    assert calib.load_calibration(out).layer.contacts == 2 * len(PLACES)


@pytest.mark.slow
def test_calibrate_learns_from_all_its_sessions(tracker, bundled, tmp_path, monkeypatch, capsys):
    recipe = calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft(), learn_layer=True)
    stages = []
    with calib.open_session(bundled[0]) as session, calib.open_session(bundled[1]) as other:
        found = calib.calibrate([session, other], recipe=recipe, progress=stages.append, ignore_errors=True)
        presses = len(session.presses) + len(other.presses)
    assert found.layer.contacts == presses
    assert stages[-1] == "learning the contact layer"
    monkeypatch.setattr(procedure, "calibrate", lambda *_, **__: found)
    out = str(tmp_path / "calibration.h5")
    assert main(["calibrate", *map(str, bundled), "-o", out, "--learn-layer"]) == 0
    assert f"learned from {presses} contacts" in capsys.readouterr().out
    assert calib.load_calibration(out).layer.contacts == presses


def test_live_goes_on_with_the_layer_and_writes_it(calibration, tracker, layer, tmp_path):
    known = replace(calibration, layer=layer)
    follower = LiveFollower(known, lambda *_: tracker)
    assert follower.learned() is follower.layer is layer
    follower._tracker = tracker
    follower.step(np.zeros(calibration.recon.readings), np.zeros(4), np.ones(4), 10**9)
    assert tracker.started[-1] is layer
    assert follower.layer is layer  # before the contacts of now
    follower.restart()
    assert follower.layer.contacts == layer.contacts + CONTACTS
    assert follower.learned().contacts == layer.contacts + CONTACTS  # a new zero forgets contacts, and not the layer
    LiveRecalibrator(known, tmp_path / "live.h5", layer=follower.learned).save()
    assert calib.load_calibration(tmp_path / "live.h5").layer.contacts == layer.contacts + CONTACTS
    LiveRecalibrator(calibration, tmp_path / "nothing.h5").save()
    LiveRecalibrator(calibration, tmp_path / "nothing.h5", layer=lambda: LearnedLayer.unknown(layer.field)).save()
    assert not (tmp_path / "nothing.h5").exists()


def test_a_line_tells_how_much_is_known(calibration, layer):
    size = len(layer.mean)
    exact = replace(layer.field, sheet_error=np.zeros((size, 0)), mesh_error=0.0)
    known = LearnedLayer.normal(exact, layer.mean, 0.25 * np.eye(size), 7)
    line = render_layer(known, calibration.recon)
    assert "learned from 7 contacts; its uncertainty is 50 % of that before any contact" in line
    deep = replace(known, field=replace(known.field, depth=0.0094))
    assert "7 contacts, whose loads spread as at a depth of 9.4 mm; its" in render_layer(deep, calibration.recon)


def test_frames_without_rest_are_not_followed(calibration, session):
    with calib.open_session(session), pytest.raises(NotFollowed):
        quiet_tracker(calibration, [])


def test_the_documentation_names_the_option():
    assert "--learn-layer" in Path("docs/commands.md").read_text()
