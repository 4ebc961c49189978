"""Live: frames to results as they arrive, and who is shown them."""

import base64
import http.client
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from inspect import unwrap
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from benchmarks import bench_live
from calib.bench import Bench, Timing, simulate
from calib.calibration.application.force_maps import ForceModel, fused
from calib.calibration.evaluation import Evaluation
from calib.calibration.localisation.contact_tracks import NotFollowed, prepare_calibrated_tracker
from calib.calibration.localisation.learned.probes import PAD_SHARE
from calib.check.placement import NOTE
from calib.cli import main
from calib.fitting.curves.fitted import FittedCurve
from calib.fitting.fields.places import single_places
from calib.fitting.pads import PadModel
from calib.live import engine as live_engine, loop as live_module
from calib.live.engine import PREPARING, Engine, ReceivedFrame, RestAverage
from calib.live.follower import PIECES, LiveFollower
from calib.live.frame_programs import FrameForces, FramePrograms
from calib.live.frame_queue import FrameQueue
from calib.live.loop import LiveControl, LiveError, LiveSettings, _tell_state, run_live
from calib.live.results import TouchEstimates
from calib.live.scan_control import ScanDirector, prepare_director
from calib.live.views.page import MAX_CONNECTIONS, Page
from calib.live.views.presentation import Presentation, present
from calib.record.broadcast import MAX_LISTENERS, Broadcaster, host_and_port
from calib.record.device import SimulatedDevice, frame_packets, recording_packets
from calib.record.plan import StreamPlan
from calib.record.planning import plan_recording
from calib.record.priority import PriorityError, real_time
from calib.record.recorder import Recorder, StopRequest, record_session
from calib.record.wire import encoding
from calib.record.wire.messages import Frame
from jaxeit import effects as fx
from jaxeit.tracking import LearnedLayer, Track, Tracker, Tracking
from tests.helpers import stand_in

S = 1_000_000_000
READINGS, PADS = 6, 2
CENTRES = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [0.1, 0.1]])
NOWHERE, SOMEWHERE = single_places([[np.nan, np.nan]], PADS), single_places([[0.05, 0.05]], PADS)


class FakePrograms(FramePrograms):
    """The change of pressure in newtons; on each pad spread over its two pixels as 1 to 3."""

    nowhere, searches = NOWHERE, False

    def __init__(self, law, most=0):
        self.searched, self.places = [], []

    def warm_up(self):
        pass

    def map(self, frame, pressure, places, before):
        self.places.append(places)
        share = np.array([0.25, 0.75])
        image = np.concatenate([pressure[0] * share, pressure[1] * share])
        loaded, negative = pressure > 2, pressure < -2
        return FrameForces(image, pressure, np.full(PADS, 0.1), pressure < 50, loaded, negative, 1e-3 * image)

    def search(self, frame):
        self.searched.append(frame)
        return SOMEWHERE, TouchEstimates(np.full((1, 2), 0.05), 1e-6 * np.eye(2)[None], np.array([True]), 0)


class SearchingPrograms(FakePrograms):
    """With contacts that are fitted."""

    searches = True


@pytest.fixture
def calibration(monkeypatch, skin):
    """What live needs of one, of two pads and four pixels, without a computation."""
    monkeypatch.setattr(unwrap(Engine.__init__), "__defaults__", (2.0, FakePrograms))
    monkeypatch.setattr(live_module, "rest_check", lambda calibration: None)
    recon = stand_in(
        je.Reconstructor,
        centres=CENTRES,
        areas=np.ones(4),
        readings=READINGS,
        channels=np.arange(READINGS) > 0,
        shape=(2, 2),
        factor=None,
    )
    protocol = stand_in(
        je.Protocol,
        readings=READINGS,
        pattern=np.tile([0, 1, 2, 3], (READINGS, 1)),
        current=1.0,
        frequency=0.0,
        reading_time=1e-5,
        mixing=None,
    )
    corners = 0.1 * np.array([[0, 0], [1, 0], [1, 2], [0, 2]])
    pads = [je.Pad("left", corners), je.Pad('<b>"right"', corners + np.array([0.1, 0.0]))]
    positions = np.array([[0.0, 0.0], [0.1, 0.1]])
    curves = stand_in(FittedCurve, curve=calib.PowerLaw())
    weights = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]])
    return stand_in(
        calib.Calibration,
        skin=stand_in(
            je.Skin,
            domain=je.Rectangle(0.2, 0.2),
            name="small",
            toml="",
            pads=pads,
            electrodes=(),
            electrode_positions=positions,
            protocol=protocol,
            sheet_resistance=150.0,
            pressure_sensor=je.skin.PressureSensor(),
            surface=None,
        ),
        recon=recon,
        masks=stand_in(je.fusion.PadMasks, weights=weights),
        simulated=True,
        pads=stand_in(PadModel, curves=curves, field=None, gains=None, multiple=1.6),
        curves=curves,
        locator=None,
        examples=None,
        evaluation=stand_in(Evaluation, force=np.array([10.0]), estimated={}),
        layer=None,
    )


def arrival(pressure, host=0, voltage=0.0):
    return ReceivedFrame(np.full(READINGS, float(voltage)), np.asarray(pressure, float), host)


def rested(calibration, programs=FakePrograms, **how):
    engine = Engine(calibration, 0.5, programs, **how)
    assert engine.step(arrival([10.0, 20.0], 0)) is None
    assert engine.step(arrival([12.0, 20.0], S)) is None
    assert not engine.resting
    return engine


# --- from frames to results ----------------------------------------------------------------------


def test_forces_are_those_above_the_resting_level(calibration):
    result = rested(calibration).step(arrival([11.0, 24.0], time.monotonic_ns()), dropped=7)
    np.testing.assert_allclose(result.force, [0.0, 4.0])
    np.testing.assert_allclose(result.map.sum(), 4.0)
    np.testing.assert_allclose(result.centre[1], [0.075, 0.1])
    assert np.isnan(result.centre[0]).all()
    assert (result.number, result.dropped, result.valid.tolist()) == (1, 7, [True, True])
    assert 0 <= result.latency < 1


def test_what_is_missing_stays_where_it_is(calibration):
    """A dead reading is taken as unchanged; a pad without pressure has no force, the other one keeps its own."""
    engine = rested(calibration)
    voltage = np.full(READINGS, np.nan)
    result = engine.step(ReceivedFrame(voltage, np.array([np.nan, 24.0]), 0))
    np.testing.assert_array_equal(result.force, [np.nan, 4.0])
    assert (result.missing, result.valid.tolist()) == (READINGS - 1, [False, True])
    assert np.isfinite(result.map).all()
    line = json.loads(result.to_json(image=True))
    assert line["force"] == [None, 4.0]
    for name in ("map", "image"):
        np.testing.assert_allclose(np.frombuffer(base64.b64decode(line[name]), "<f4"), getattr(result, name))


def test_levels_do_not_count_what_is_missing():
    resting = RestAverage(1.0)
    for n, value in enumerate([1.0, np.nan, 3.0]):
        resting.add(arrival([value, np.nan], n * S))
        if n:
            break
    np.testing.assert_array_equal(resting.levels[1], [1.0, np.nan])


def test_zero_may_be_set_again(calibration):
    engine = rested(calibration)
    engine.tare()
    assert engine.step(arrival([50.0, 50.0], 2 * S)) is None
    assert engine.step(arrival([50.0, 50.0], 3 * S)) is None
    np.testing.assert_allclose(engine.step(arrival([51.0, 50.0])).force, [1.0, 0.0])


def test_zero_waits_for_rest(calibration):
    """A skin that is pressed or released while zero is measured is not at rest."""
    engine = Engine(calibration, 1.0)
    for n in range(7):
        pressure = 60.0 if n < 5 else 10.0
        assert engine.step(arrival([pressure, 20.0], n * S // 2)) is None
        assert engine.restless == (n >= 5)  # the windows are frames 0 to 2, which are alike, and 3 to 5
        if n == 2:
            engine.tare()
    assert "at rest" in engine.state
    assert engine.step(arrival([10.0, 20.0], 7 * S // 2)) is None
    assert engine.state == "running"
    np.testing.assert_allclose(engine.step(arrival([11.0, 20.0], 5 * S)).force, [1.0, 0.0])


def test_a_zero_that_was_measured_in_mid_press_is_noticed_after_the_release(calibration):
    engine = Engine(calibration, 1.0)
    for n in range(3):
        engine.step(arrival([60.0, 20.0], n * S // 2))
    assert engine.state == "running"
    released = engine.step(arrival([10.0, 20.0], 2 * S))
    assert released.force[0] == -50.0
    assert released.valid.tolist() == [False, True]
    assert not engine.has_wrong_zero(2 * S + S // 2)
    engine.step(arrival([10.0, 30.0], 3 * S))  # pressed elsewhere: no time to measure zero
    assert not engine.has_wrong_zero(4 * S + S // 2)
    engine.step(arrival([10.0, 20.0], 4 * S))
    assert engine.has_wrong_zero(5 * S + S // 2)
    engine.tare()
    assert not engine.has_wrong_zero(9 * S)


def test_a_stop_while_live_compiles_leaves_out_the_rest(calibration, monkeypatch):
    """The steps that follow, and the devices."""
    show, made = LiveControl(), []
    monkeypatch.setattr(live_module, "rest_check", lambda calibration: show.stop.set())
    monkeypatch.setattr(live_module, "Engine", lambda *args, **options: made.append("engine"))
    monkeypatch.setattr(live_module, "Recorder", lambda *args: made.append("recorder"))
    with small_device() as device:
        assert run_live(calibration, *sources_of(device, calibration), [], show, LiveSettings(proposal=None)) == 0
    assert made == []
    assert show.state == "stopped before the devices were asked"


def test_live_that_is_joined_in_mid_press_finds_its_zero(calibration):
    """Joined while 10 N rest on the first pad, which are taken away after a second."""
    show, results, told = LiveControl(), [], []
    show.warn = told.append
    times = [n * S // 100 for n in range(10**5)]
    eit = frame_packets(1, iter(times), (np.zeros(READINGS, "f4") for _ in times))
    pressure = frame_packets(2, iter(times), (np.array([10.0 * (t < S), 0.0], "f4") for t in times))
    with SimulatedDevice([eit, pressure], wait_for=1) as device:

        def publish(result):
            results.append(result)
            if told and abs(result.force[0]) < 1:
                show.stop.set()

        settings = LiveSettings(rest=0.3, proposal=None)
        run_live(calibration, *sources_of(device, calibration), [publish], show, settings)
    assert results[-1].force[0] == 0.0
    assert min(result.force[0] for result in results) == -10.0
    assert not any(result.valid[0] for result in results if result.force[0] < -2)
    assert "zero" in told[0]


def test_frames_that_come_together_are_all_taken():
    inbox = FrameQueue(StreamPlan("eit", 1), StreamPlan("pressure", 1))
    inbox.put(1, Frame(2, 0, 0, 32, np.array([1.0])), 0)
    now = time.monotonic_ns()
    for number in range(3):
        inbox.put(0, Frame(1, 0, 0, 32, np.array([float(number)])), now)
    assert [inbox.take(0.0).values[0] for _ in range(3)] == [0.0, 1.0, 2.0]
    for number in range(50):
        inbox.put(0, Frame(1, 0, 0, 32, np.array([float(number)])), time.monotonic_ns())
    assert inbox.dropped >= 50 - 16


def test_the_newest_frame_is_taken_and_the_others_are_counted():
    inbox = FrameQueue(StreamPlan("eit", 2, scale=0.5), StreamPlan("pressure", 1))
    assert inbox.take(0.0) is None
    inbox.put(0, Frame(1, 0, 0, 32, np.array([2, 4], "<i2")), 5)
    assert inbox.take(0.0) is None  # no pressure yet
    for value in (1.0, 2.0, 6.0):
        inbox.put(1, Frame(2, 0, 0, 32, np.array([value])), 0)
    for number in range(3):
        inbox.put(0, Frame(1, 0, 0, 32, np.array([number, 4], "<i2")), number)
    found = inbox.take(0.0)
    assert (found.values.tolist(), found.beside.tolist(), found.host) == ([1.0, 2.0], [3.0], 2)
    assert inbox.dropped == 3
    assert inbox.take(0.0) is None
    inbox.put(0, Frame(1, 0, 0, 32, np.array([1, 4], "<i2")), 9)
    assert inbox.take(0.0).beside.tolist() == [3.0]  # held


# --- contacts, and readings that are missing -----


def test_contacts_are_fitted_when_there_is_time_and_serve_the_next_frames(calibration, monkeypatch):
    monkeypatch.setattr(live_engine, "MAX_PLACE_AGE", np.inf)  # however slow the machine
    engine = rested(calibration, SearchingPrograms)
    programs = engine._programs
    programs.places.clear()  # zero was measured with them too
    engine.step(arrival([11.0, 20.0]))
    engine.use_spare_time(1.0)
    assert programs.searched == []  # nothing is touched
    result = engine.step(arrival([31.0, 20.0], voltage=3.0))
    assert len(result.touches.position) == 0
    engine.use_spare_time(1.0)
    result = engine.step(arrival([31.0, 20.0], voltage=4.0))
    assert (result.touches.age, result.touches.sure.tolist()) == (1, [True])
    assert programs.places == [NOWHERE, NOWHERE, SOMEWHERE]
    np.testing.assert_array_equal(programs.searched[0], np.full(READINGS, 3.0))
    line = json.loads(result.to_json())
    assert line["contacts_age"] == 1
    contact = {"position": [0.05, 0.05], "standard_error": [0.001, 0.001], "sure": True}
    assert contact.items() <= line["contacts"][0].items()
    result = engine.step(arrival([11.0, 20.0]))  # let go
    assert (len(result.touches.position), result.touches.age) == (0, 0)
    assert programs.places[-1] is SOMEWHERE  # it may not be known yet that it was let go


def test_frames_without_time_for_their_contacts_are_counted(calibration, monkeypatch):
    engine = rested(calibration, SearchingPrograms)
    engine._search_time = 0.01
    engine._search_end = time.monotonic() + 1000  # as if some had just been fitted
    for _ in range(4):
        result = engine.step(arrival([31.0, 20.0]))
        engine.use_spare_time(0.005)
    assert result.unsearched == 3
    assert engine._programs.searched == []
    engine._search_end = 0.0  # long ago: now it is done at the cost of a frame
    engine.use_spare_time(0.005)
    assert len(engine._programs.searched) == 1


def test_a_network_tells_what_touches_the_skin(calibration):
    """It sees the change of the readings that are used and the forces, and nothing of a skin that nothing touches."""
    seen = []

    class Told(je.contacts.Proposal):
        def __call__(self, dv, pad_forces=None):
            seen.append((dv, pad_forces))
            loads = [np.zeros((rows, size)) for rows, size in ((1, 4), (2, 4), (1, 6), (3, 4))]
            return je.contacts.Proposed(np.array([0.0, 0.8, 0.15, 0.05, 0.0]), *loads, distance=np.array(1.5))

    tell = stand_in(Told)
    engine = rested(calibration, proposal=tell)
    assert engine.step(arrival([11.0, 20.0])).kinds is None
    result = engine.step(arrival([31.0, np.nan], voltage=3.0))
    assert len(seen) == 1
    np.testing.assert_array_equal(seen[0][0], [np.nan, *[3.0] * (READINGS - 1)])
    np.testing.assert_array_equal(seen[0][1], [20.0, np.nan])
    expected = {"none": 0.0, "one": 0.8, "two": 0.15, "edge": 0.05, "more": 0.0, "unlike": True}
    assert json.loads(result.to_json())["kinds"] == expected


def test_missing_readings_are_counted_of_those_that_are_used(calibration):
    engine = rested(calibration)
    broken = ReceivedFrame(np.where(np.isin(np.arange(READINGS), [0, 2]), np.nan, 1.0), np.array([11.0, 20.0]), 0)
    assert engine.step(broken).missing == 1  # the first is not used
    assert engine.step(arrival([11.0, 20.0])).missing == 0


class FollowingPrograms(FakePrograms):
    """With places of contacts that are followed."""

    def __init__(self, law, followed):
        super().__init__(law)
        self.followed = followed

    def placed(self, tracks):
        return single_places([tracks[0].position.tolist()], PADS) if tracks else NOWHERE


class FakeTracker(Tracker):
    """One contact while the first pad is pressed; a new one each time."""

    def __init__(self, untouched, noise):
        self.untouched, self.noise, self.steps, self.looks = untouched, noise, [], []

    def start(self, layer=None):
        self.layer = layer
        return stand_in(Tracking, tracks=(), begun=0)

    def learned(self, now):
        return self.layer

    def look(self, now):
        self.looks.append(now.backlog)
        return stand_in(Tracking, tracks=now.tracks, begun=now.begun, backlog=now.backlog - 1 or None)

    def step(self, now, change, seconds, force, error, *, whole):
        assert not whole
        self.steps.append((change, seconds, force, error))
        if not force[0] > 2:
            return stand_in(Tracking, tracks=(), begun=now.begun)
        begun = now.begun + (not now.tracks)
        place, half = np.array([0.02, 0.03]), np.array([0.01, 0.0])
        track = Track(begun, place, 4e-6 * np.eye(2), 0.01, float(force[0]), 0.1, half, np.zeros(2))
        return stand_in(Tracking, tracks=(track,), begun=begun, backlog=10)


@pytest.fixture
def following(calibration, monkeypatch):
    """An engine that follows contacts, at rest, and its tracker."""
    monkeypatch.setattr("calib.live.follower.compile_tracker", lambda tracker: compiled.append(tracker))
    monkeypatch.setattr("calib.live.follower.placement_note", lambda skin, frame, used: f"aside by {frame[0]:.3f}")
    compiled, made = [], []

    def prepare(calibration, untouched, noise):
        made.append(FakeTracker(untouched, noise))
        return made[-1]

    engine = Engine(calibration, 0.5, FollowingPrograms, follower=LiveFollower(calibration, prepare))
    for n in range(11):
        assert engine.step(arrival([10.0, 20.0], n * S // 20, voltage=n % 2)) is None
    assert engine.state == PREPARING
    assert engine.step(arrival([10.0, 20.0], S)) is None  # this frame is left out, and no later one
    assert engine.state == "running"
    assert compiled == made
    return engine, made[0]


def test_viewers_are_shown_the_layer_of_contacts_that_are_followed(following, calibration):
    layer, show, streams = stand_in(LearnedLayer, contacts=3), LiveControl(), stand_in(Recorder, receivers=())
    _tell_state(show, following[0], streams)
    assert show.layer is None  # nothing is known
    following[0]._follower._layer = layer
    _tell_state(show, following[0], streams)
    assert show.layer is layer
    _tell_state(show, rested(calibration), streams)
    assert show.layer is None  # contacts are not followed


def test_doubts_about_the_electrodes_are_told(following, calibration):
    """Of the first rest, where contacts are followed; otherwise those of the calibration, and to the operator once."""
    assert following[0].health == "aside by 0.455"
    noted = f"{NOTE}they seem to sit about 1 mm from where the skin's file says"
    object.__setattr__(calibration, "notes", ("another", noted))
    engine, show, told = rested(calibration), LiveControl(), []
    show.warn = told.append
    for _ in range(2):
        _tell_state(show, engine, stand_in(Recorder, receivers=()))
    assert (show.health, told) == (noted, [noted])


def test_the_tracker_knows_the_sheet_and_the_noise_of_the_rest(following):
    tracker = following[1]
    np.testing.assert_allclose(tracker.untouched, 5 / 11)
    np.testing.assert_allclose(tracker.noise, np.std(np.arange(11) % 2))


def test_each_frame_has_contacts_that_keep_their_numbers(following):
    engine, tracker = following
    assert len(engine.step(arrival([10.0, 20.0], 2 * S)).touches.position) == 0
    for host in (2 * S + S // 100, 3 * S):  # the second one late
        result = engine.step(arrival([31.0, 20.0], host, voltage=1.0))
        assert (result.touches.number.tolist(), result.touches.age) == ([1], 0)
    np.testing.assert_allclose([step[1] for step in tracker.steps], [0.01, 0.01, 0.99])
    np.testing.assert_allclose(tracker.steps[-1][0], 6 / 11)
    np.testing.assert_allclose(tracker.steps[-1][2], [21.0, 0.0])
    np.testing.assert_allclose(tracker.steps[-1][3], [np.hypot(0.1, PAD_SHARE * 21), 0.1])
    contact = json.loads(result.to_json())["contacts"][0]
    assert contact["number"] == 1
    np.testing.assert_allclose([contact["force"], contact["force_error"], *contact["half"]], [21, 2.1, 0.01, 0])
    np.testing.assert_allclose(engine._programs.places[-1].position, [[[0.02, 0.03]]])  # of the frame before
    engine.step(arrival([10.0, 20.0], 4 * S))
    assert engine.step(arrival([31.0, 20.0], 5 * S)).touches.number.tolist() == [2]


def test_an_unexpected_frame_is_looked_into_in_spare_time_and_by_a_bounded_number_of_pieces(following):
    engine, tracker = following
    engine.use_spare_time(9.0)
    engine.step(arrival([10.0, 20.0], 2 * S))
    engine.use_spare_time(9.0)
    assert not tracker.looks  # nothing is unexpected
    engine.step(arrival([31.0, 20.0], 3 * S))
    engine.use_spare_time(0.0)
    engine.use_spare_time(0.0)
    assert tracker.looks == [10]  # without spare time one piece, so that the look ends some time
    engine.use_spare_time(9.0)
    assert tracker.looks == [10 - n for n in range(1 + PIECES)]
    engine.use_spare_time(9.0)
    assert tracker.looks == [10 - n for n in range(10)]


def test_a_pad_without_pressure_tells_a_tracker_nothing(following):
    engine, tracker = following
    engine.step(ReceivedFrame(np.full(READINGS, np.nan), np.array([np.nan, 24.0]), 2 * S))
    change, _, force, error = tracker.steps[-1]
    assert np.isnan(change).all()
    np.testing.assert_array_equal(np.isnan([force, error]), [[True, False]] * 2)


def test_frames_that_arrive_at_once_are_followed(following):
    engine, tracker = following
    for _ in range(2):
        engine.step(arrival([31.0, 20.0], 2 * S))
    assert tracker.steps[-1][1] > 0


def test_contacts_are_forgotten_when_zero_is_set_again(following):
    engine, tracker = following
    engine.step(arrival([31.0, 20.0], 2 * S))
    engine.tare()
    for host in (3 * S, 4 * S):
        assert engine.step(arrival([10.0, 20.0], host)) is None
    assert engine.step(arrival([31.0, 20.0], 5 * S)).touches.number.tolist() == [1]
    assert len(tracker.steps) == 2


def test_contacts_that_have_left_the_sheet_are_not_shown(calibration, monkeypatch):
    low, high = (np.array(corner) for corner in calibration.skin.domain.bounds)
    places = [low - np.array([0.2, 0.0]), (low + high) / 2, high + np.array([0.0, 1e-3])]
    tracks = tuple(
        Track(k, place, np.eye(2), 0.01, 5.0, 0.1, np.zeros(2), np.zeros(2)) for k, place in enumerate(places)
    )
    monkeypatch.setattr(FakeTracker, "step", lambda *_, **options: stand_in(Tracking, tracks=tracks))
    follower = LiveFollower(calibration, lambda calibration, untouched, noise: FakeTracker(untouched, noise))
    follower._tracker = FakeTracker(None, None)
    shown = follower.step(np.zeros(READINGS), np.zeros(PADS), np.ones(PADS), S)
    assert [one.number for one in shown] == [1]


def test_frames_at_rest_without_noise_are_refused(calibration):
    follower = LiveFollower(calibration, lambda *a: prepare_calibrated_tracker(*a))
    with pytest.raises(NotFollowed, match="no frames"):
        follower.prepare(np.zeros((3, READINGS)))
    with pytest.raises(NotFollowed, match="no reading has noise"):
        follower.prepare(np.ones((20, READINGS)))


@pytest.mark.slow
def test_programs_for_one_frame_are_those_of_the_force_map(model, skin, pixels):
    """To rounding; also for frames that lack some readings, or most."""
    recon, rng = je.prepare(model, basis=pixels), np.random.default_rng(0)
    pressure = np.tile(np.linspace(0, 4000, 40), (len(skin.pads), 1))
    curves = calib.fit_curves(calib.Linear(), pressure, 5e-3 * pressure[0] + rng.normal(0, 0.1, 40))
    forces = ForceModel(recon, je.pad_masks(skin, recon), PadModel(curves), None)
    frame, pressed = rng.normal(0, 1e-3, recon.readings), np.array([3000.0, 0.0, 1000.0, 0.0])
    holes, few = (np.where(rng.random(recon.readings) < share, np.nan, frame) for share in (0.3, 0.9))
    programs = FramePrograms(forces)
    programs.warm_up()
    for lacking in (frame, holes, few):
        found = programs.map(lacking, pressed, programs.nowhere, np.zeros((1, 4)))
        other = fused(forces, recon(lacking[None]), jnp.asarray(pressed[None]), None, None, 0.6)
        np.testing.assert_allclose(found.map, other.map.force[0], rtol=1e-9, atol=1e-9 * abs(found.map).max())
        for mine, theirs in zip(found[1:4], other[1:4], strict=True):
            np.testing.assert_allclose(mine, theirs[0], rtol=1e-12)
        assert found.loaded.tolist() == [True, False, True, False]
        assert not found.negative.any()


# --- the whole -----------------------------------------------------------------------------------


def small_device(rate=100):
    """Pressure on the second pad rises by 5 N after a second."""
    times = [n * S // rate for n in range(10**5)]
    eit = frame_packets(1, iter(times), (np.zeros(READINGS, "f4") for _ in times))
    pressure = frame_packets(2, iter(times), (np.array([0.0, 5.0 * (t > S)], "f4") for t in times))
    return SimulatedDevice([eit, pressure], wait_for=1)


def sources_of(device, calibration):
    return plan_recording({"eit": device.urls[0], "pressure": device.urls[1]}, calibration.skin)


def test_results_come_as_frames_arrive(calibration):
    show, results = LiveControl(), []
    with small_device() as device:

        def publish(result):
            results.append(result)
            if result.force[1] > 4.5:
                show.stop.set()

        count = run_live(calibration, *sources_of(device, calibration), [publish], show, LiveSettings(rest=0.3))
    assert count == len(results) > 10
    assert [r.number for r in results] == list(range(1, count + 1))
    np.testing.assert_allclose(results[-1].force, [0.0, 5.0])
    assert show.state == "running"


def test_before_the_first_frame_viewers_are_told_what_is_waited_for(calibration, monkeypatch):
    """While programs are compiled, too, which no device has a part in."""
    show, told = LiveControl(), []
    make = Engine.__init__

    def compiling(engine, *args, **options):
        told.append(show.state)
        make(engine, *args, **options)

    def tell():
        told.append(show.state)
        show.stop.set()

    monkeypatch.setattr(Engine, "__init__", compiling)
    with small_device() as device:
        plan, sources = sources_of(device, calibration)
        run_live(calibration, plan, sources, [], show, LiveSettings(rest=0.1), begun=tell)
    assert told == [live_module.COMPILING, "waiting for the first frame of eit and pressure"]


def policies():
    return [os.sched_getscheduler(int(task)) for task in os.listdir("/proc/self/task")]


def test_a_live_show_may_go_before_all_ordinary_processes(calibration):
    """Its threads, old and new, while it lasts; none afterwards."""
    try:
        with real_time():
            pass
    except PriorityError as error:
        pytest.skip(str(error))
    show, seen = LiveControl(), []
    with small_device() as device:

        def publish(result):
            seen.extend(policies())
            show.stop.set()

        plan, sources = sources_of(device, calibration)
        run_live(calibration, plan, sources, [publish], show, LiveSettings(rest=0.1, realtime=True))
    assert len(seen) > 2
    assert set(seen) == {os.SCHED_FIFO}
    assert os.SCHED_FIFO not in policies()


def refuse(task, policy, parameters):
    raise PermissionError


@pytest.mark.parametrize(("system", "said"), [(refuse, "rtprio 1"), (None, "on Linux only")])
def test_a_priority_that_is_refused_is_said(monkeypatch, system, said):
    if system is None:
        monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    else:
        monkeypatch.setattr(os, "sched_setscheduler", system, raising=False)
    with pytest.raises(PriorityError, match=said), real_time():
        pytest.fail("must not go on")
    with real_time(False):
        pass


def test_a_priority_that_is_refused_is_said_before_anything_else(monkeypatch, capsys):
    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    streams = ["--eit", "tcp://127.0.0.1:1", "--pressure", "tcp://127.0.0.1:1"]
    assert main(["live", "--calibration", "nowhere.h5", *streams, "--realtime"]) == 2
    assert "leave out --realtime" in capsys.readouterr().err


def test_a_live_show_is_recorded(calibration, tmp_path):
    """Everything that came is in the session, also what came before the first result, and frames that were dropped."""
    show, output, told = LiveControl(), tmp_path / "s.h5", []
    with small_device() as device:
        present(
            calibration,
            *sources_of(device, calibration),
            show,
            Presentation(port=0, output=output),
            LiveSettings(rest=0.1),
            tell=told.append,
            also=[lambda result: show.stop.set() if result.number == 20 else None],
        )
    assert "complete" in told[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["s.h5"]
    with calib.open_session(output) as session:
        assert session.complete
        assert len(session.stream("eit")) >= 30
        assert not session.stream("eit").status().any()


def test_a_live_show_that_sees_nothing_leaves_nothing(calibration, tmp_path):
    plan, sources = plan_recording({"eit": "tcp://127.0.0.1:1", "pressure": "tcp://127.0.0.1:1"}, calibration.skin)
    with pytest.raises(LiveError, match="nothing answers"):
        present(
            calibration,
            plan,
            sources,
            LiveControl(),
            Presentation(port=0, output=tmp_path / "s.h5"),
            LiveSettings(wait=0.2),
        )
    assert list(tmp_path.iterdir()) == []


def test_a_port_in_use_is_named(calibration):
    plan, sources = plan_recording({"eit": "tcp://127.0.0.1:1", "pressure": "tcp://127.0.0.1:1"}, calibration.skin)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for option, where in (
            ("--port", Presentation(port=port)),
            ("--publish", Presentation(port=0, publish=port)),
        ):
            with pytest.raises(OSError, match=rf"^{option}: 127\.0\.0\.1:{port}: Address already in use; name another"):
                present(calibration, plan, sources, LiveControl(), where)


def small_scan():
    """Two readings at rest, two more for the pad that is pressed, every reading each 40 frames."""
    flags = jnp.eye(READINGS, dtype=bool)
    return je.scan.EventScan(
        idle=flags[0] | flags[1],
        by_pad=jnp.stack([flags[0] | flags[2], flags[4] | flags[5]]),
        by_place=(flags[0] | flags[4] | flags[5])[None],
        centres=jnp.zeros((1, 2)),
        pad_of=jnp.array([[False, True]]),
        onset=jnp.full(PADS, 2.0),
        release=jnp.full(PADS, 1.0),
        every=jnp.asarray(40),
    )


def test_pressure_says_what_the_device_reads_next(calibration, monkeypatch):
    """Over loopback: what is not asked for is missing, and the pads' forces are as ever."""

    monkeypatch.setattr(live_module, "prepare_director", lambda _, *told: ScanDirector(small_scan(), *told))
    show, results = LiveControl(), []
    with small_device() as device:

        def publish(result):
            results.append(result)
            if result.force[1] > 4.5 and result.number > results[0].number + 150:
                show.stop.set()

        run_live(
            calibration, *sources_of(device, calibration), [publish], show, LiveSettings(rest=0.3, event_driven=True)
        )
    idle = np.array([r.missing for r in results if r.force[1] < 0.5])
    pressed = np.array([r.missing for r in results if r.force[1] > 4.5])
    asked_of = READINGS - 1  # the first reading is not used by the reconstruction
    assert np.bincount(idle).argmax() == asked_of - 1
    assert np.bincount(pressed[5:]).argmax() == asked_of - 3
    assert (pressed == 0).any()  # a whole scan now and then
    np.testing.assert_allclose(results[-1].force, [0.0, 5.0])


def test_a_device_is_told_again_and_after_a_new_zero_reads_everything():
    said = []
    director = ScanDirector(small_scan(), 1, said.append)
    for _ in range(3):
        director.update(np.zeros(PADS), np.full((PADS, 2), np.nan))
    assert director.requested.sum() == 2
    before = len(said)
    time.sleep(0.35)
    director.update(np.zeros(PADS), np.full((PADS, 2), np.nan))
    assert len(said) == before + 1
    director.request_all()
    assert director.requested.all()
    _, found, _ = encoding.parse_requests(b"", said[-1])
    assert found[1][:READINGS].all()


class Accounts:
    """What became of every frame: a log that counts what arrived, and the inbox, engine and publisher behind it."""

    size = 0

    def __init__(self, monkeypatch):
        self.received, self.worked, self.results = 0, 0, []
        step = Engine.step

        def counted(engine, *arrival):
            self.worked += 1
            return step(engine, *arrival)

        def made(*plans):
            self.inbox = FrameQueue(*plans)
            return self.inbox

        monkeypatch.setattr(Engine, "step", counted)
        monkeypatch.setattr(live_module, "FrameQueue", made)

    def append(self, stream, flags, host, payload):
        self.received += stream == 0


def test_a_slow_listener_to_results_makes_nothing_late(calibration, monkeypatch):
    """Frames are worked on in order or dropped, and every one is accounted for."""
    show, accounts = LiveControl(), Accounts(monkeypatch)
    results = accounts.results
    with small_device(200) as device:

        def publish(result):
            results.append(result)
            time.sleep(0.05)
            if len(results) == 20:
                show.stop.set()

        found = sources_of(device, calibration)
        assert (
            run_live(calibration, *found, [publish], show, LiveSettings(rest=0.1), log=accounts) == len(results) == 20
        )
    assert results[-1].dropped > 50
    assert (np.diff([r.host for r in results]) >= 0).all()
    assert (np.diff([r.dropped for r in results]) >= 0).all()
    inbox = accounts.inbox
    assert accounts.received == accounts.worked + inbox.dropped + len(inbox._frames)
    assert accounts.worked > len(results)  # those from which the levels were taken


def test_streams_that_do_not_fit_or_do_not_come_are_said(calibration):
    plan, sources = plan_recording({"eit": "tcp://127.0.0.1:1", "pressure": "tcp://127.0.0.1:1"}, calibration.skin)
    with pytest.raises(LiveError, match="nothing answers"):
        run_live(calibration, plan, sources, [], LiveControl(), LiveSettings(wait=0.2))
    plan, sources = plan_recording({"eit": "tcp://h:1", "pressure": "tcp://h:1?channels=7"}, calibration.skin)
    with pytest.raises(LiveError, match="7 pressures"):
        run_live(calibration, plan, sources, [], LiveControl())


@pytest.mark.parametrize("urls", [("tcp://127.0.0.1:1", "tcp://127.0.0.1:1"), None])
def test_live_of_some_seconds_says_why_it_shows_nothing(calibration, urls):
    """Its time counts from the first frame, so that a device that does not begin is always named."""
    settings = LiveSettings(wait=0.3, rest=0.1, seconds=0.2, proposal=None)
    with small_device() as device:
        plan, sources = plan_recording(
            dict(zip(("eit", "pressure"), urls or device.urls[::-1], strict=True)), calibration.skin
        )
        with pytest.raises(LiveError, match="frames of other streams" if urls is None else "nothing answers"):
            run_live(calibration, plan, sources, [], LiveControl(), settings)


def test_live_counts_its_seconds_from_the_first_frame(calibration):
    results = []
    settings = LiveSettings(rest=0.2, seconds=0.6, proposal=None)
    with small_device() as device:
        count = run_live(calibration, *sources_of(device, calibration), [results.append], LiveControl(), settings)
    assert 10 < count == len(results) < 60


def test_live_that_ends_while_the_skin_is_not_at_rest_says_so(calibration):
    times = [n * S // 100 for n in range(10**5)]
    eit = frame_packets(1, iter(times), (np.zeros(READINGS, "f4") for _ in times))
    pressure = frame_packets(2, iter(times), (np.array([1e-7 * t, 0.0], "f4") for t in times))  # pressed ever more
    with (
        SimulatedDevice([eit, pressure], wait_for=1) as device,
        pytest.raises(LiveError, match="to be at rest") as said,
    ):
        run_live(
            calibration,
            *sources_of(device, calibration),
            [],
            LiveControl(),
            LiveSettings(rest=0.2, seconds=0.8, proposal=None),
        )
    assert "--seconds" in str(said.value)


def test_no_time_beside_the_rest_levels_is_refused(calibration):
    plan, sources = plan_recording({"eit": "tcp://127.0.0.1:1", "pressure": "tcp://127.0.0.1:1"}, calibration.skin)
    with pytest.raises(LiveError, match=r"rest levels take 100 s .*live ends after 5 s"):
        run_live(calibration, plan, sources, [], LiveControl(), LiveSettings(rest=100.0, seconds=5.0))


def test_a_link_that_is_opened_again_and_again_is_said(calibration, monkeypatch):
    """As that of a device that is slower than the time after which silence counts, and states no rate."""
    monkeypatch.setattr("calib.record.intake.FIRST_FRAME_TIMEOUT", 0.1)
    monkeypatch.setattr("calib.record.intake.MIN_TIMEOUT", 0.1)
    times = range(0, 10**5 * S, S // 2)
    show, told = LiveControl(), []
    show.warn = told.append
    eit = frame_packets(1, iter(times), (np.zeros(READINGS, "f4") for _ in times))
    pressure = frame_packets(2, iter(range(0, 1000 * S, S // 100)), (np.zeros(2, "f4") for _ in range(10**5)))
    settings = LiveSettings(rest=2.5, seconds=3.0, proposal=None)
    with SimulatedDevice([eit, pressure], wait_for=1) as device:
        plan, sources = sources_of(device, calibration)
        with pytest.raises(LiveError, match="without a result"):
            run_live(calibration, plan, sources, [], show, settings)
    (line,) = [line for line in told if "opened anew" in line]
    assert line.startswith("eit: no frame comes for 0.1 s")
    assert "?rate=" in line
    assert line in show.faults


def test_live_says_what_to_do_where_frames_at_rest_do_not_tell_the_noise(calibration):
    settings = LiveSettings(rest=0.01, track=True, proposal=None)
    with small_device() as device, pytest.raises(LiveError, match=r"tell.* untouched .*--rest"):
        run_live(calibration, *sources_of(device, calibration), [], LiveControl(), settings)


# --- the page and the lines ----------------------------------------------------------------------


def fetch(page, path, *, method="GET", headers=None):
    host, port = page.server_address[:2]
    link = http.client.HTTPConnection(host, port, timeout=5)
    link.request(method, path, headers=headers or {})
    reply = link.getresponse()
    body = reply.read() if path != "/results" else b""
    return link, reply, body


def events(reply, count):
    """Events of the page, as they are pushed."""
    out = []
    while len(out) < count:
        line = reply.readline()
        if line.startswith(b"data: "):
            out.append(json.loads(line[6:]))
    return out


@pytest.fixture
def page(calibration):
    with Page(calibration, LiveControl()) as found:
        yield found


def test_the_page_is_whole_and_asks_nothing_of_others(page):
    link, reply, body = fetch(page, "/")
    assert reply.status == 200
    assert b"http://" not in body.replace(b"http://www.w3.org", b"")
    assert b"https://" not in body
    policy = reply.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert reply.headers["X-Frame-Options"] == "DENY"
    link.close()
    link, reply, body = fetch(page, "/scene")
    scene = json.loads(body)
    assert (scene["rows"], scene["pads"], scene["simulated"]) == (2, ["left", '<b>"right"'], True)
    link.close()
    link, reply, _ = fetch(page, "/../etc/passwd")
    assert reply.status == 404
    link.close()


def test_a_viewer_is_given_the_newest_result_only(page, calibration):
    engine = rested(calibration)
    page.control.state = "running"
    link, reply, _ = fetch(page, "/results")
    results = [engine.step(arrival([11.0 + force, 20.0])) for force in range(200)]
    for result in results:
        page.show_result(result)
    found = events(reply, 2)
    assert found[-1]["about"] == {"state": "running", "health": "", "simulated": False, "lost": 0}
    last = [event["result"] for event in found if event["result"]][-1]
    assert last["number"] > 100
    assert len(base64.b64decode(last["map"])) == 16
    link.close()


def test_a_viewer_who_never_reads_delays_no_one(page, calibration):
    engine = rested(calibration)
    deaf = socket.create_connection(page.server_address[:2])
    deaf.sendall(f"GET /results HTTP/1.1\r\nHost: 127.0.0.1:{page.server_address[1]}\r\n\r\n".encode())
    begin = time.monotonic()
    for force in range(2000):
        page.show_result(engine.step(arrival([11.0 + force % 7, 20.0])))
    assert time.monotonic() - begin < 3
    deaf.close()


def test_only_our_own_page_may_ask(page):
    port = page.server_address[1]
    others = {"Host": f"evil.example:{port}"}
    assert fetch(page, "/", headers=others)[1].status == 403
    assert fetch(page, "/tare", method="POST", headers={"Origin": "http://evil.example"})[1].status == 403
    assert fetch(page, "/else", method="POST")[1].status == 403
    for site in ("cross-site", "same-site"):
        assert fetch(page, "/tare", method="POST", headers={"Sec-Fetch-Site": site})[1].status == 403
    assert not page.control.tare.is_set()
    own = {"Origin": f"http://127.0.0.1:{port}", "Sec-Fetch-Site": "same-origin"}
    assert fetch(page, "/tare", method="POST", headers=own)[1].status == 200
    assert page.control.tare.is_set()


def test_a_page_on_the_port_of_http_is_reached_by_its_bare_name(page, monkeypatch):
    """Browsers leave out port 80 in Host and Origin."""
    own = {"Host": "localhost", "Origin": "http://localhost"}
    assert fetch(page, "/", headers=own)[1].status == 403  # on any other port it is another site
    monkeypatch.setattr("calib.live.views.page.HTTP_PORT", page.server_address[1])
    assert fetch(page, "/", headers=own)[1].status == 200
    assert fetch(page, "/tare", method="POST", headers=own)[1].status == 200
    assert fetch(page, "/", headers={"Host": "[::1]"})[1].status == 200
    assert fetch(page, "/", headers={"Host": "evil.example"})[1].status == 403


def test_a_flood_of_connections_leaves_the_viewers_there_are(page, monkeypatch):
    monkeypatch.setattr(page.RequestHandlerClass, "timeout", 60.0)
    link, reply, _ = fetch(page, "/results")
    events(reply, 1)
    flood = [socket.create_connection(page.server_address[:2], timeout=20) for _ in range(2 * MAX_CONNECTIONS)]
    refused, _, _ = select.select(flood, [], [], 20)  # those beyond the limit; the others are waited for
    assert refused[0].recv(1) == b""
    events(reply, 1)
    for client in flood:
        client.close()
    link.close()


def test_a_viewer_beyond_the_limit_is_told_so(page, monkeypatch):
    monkeypatch.setattr(page.RequestHandlerClass, "timeout", 60.0)
    first = [socket.create_connection(page.server_address[:2], timeout=20) for _ in range(MAX_CONNECTIONS)]
    link, reply, body = fetch(page, "/")
    assert reply.status == 503
    assert b"32 viewers are connected; close one of their pages" in body
    for one in (*first, link):
        one.close()


def test_the_page_and_the_lines_listen_on_ipv6(calibration):
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 on this machine")
    with Page(calibration, LiveControl(), "::1") as page, Broadcaster("::1") as lines:
        port = page.server_address[1]
        assert page.url == f"http://[::1]:{port}/"
        link, reply, _ = fetch(page, "/scene", headers={"Host": f"[::1]:{port}"})
        assert reply.status == 200
        link.close()
        with socket.create_connection(lines.address, timeout=5) as client:
            lines.publish([b"1\n"])
            assert client.recv(2) == b"1\n"
    assert host_and_port(*lines.address) == f"[::1]:{lines.address[1]}"


def test_a_flood_of_listeners_leaves_those_there_are():
    with Broadcaster() as lines:
        first = socket.create_connection(lines.address, timeout=5)
        lines.publish([b"1\n"])
        flood = [socket.create_connection(lines.address, timeout=5) for _ in range(2 * MAX_LISTENERS)]
        lines.publish([b"2\n"])
        assert len(lines.listeners) == MAX_LISTENERS
        assert flood[-1].recv(1) == b""
        assert first.recv(10, socket.MSG_WAITALL | socket.MSG_DONTWAIT) == b"1\n2\n"
        for client in (first, *flood):
            client.close()


def listening(process="self"):
    """Addresses that a process listens at, as the system tells them: hexadecimal, with the port."""
    links = [os.readlink(link) for link in Path(f"/proc/{process}/fd").iterdir() if link.is_symlink()]
    tables = [Path(f"/proc/{process}/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    frame_packets = [line.split() for table in tables for line in table]
    return [row[1] for row in frame_packets if row[3] == "0A" and f"socket:[{row[9]}]" in links]


@pytest.mark.skipif(not os.path.exists("/proc/self/net/tcp"), reason="needs Linux")
def test_everything_listens_on_this_machine_only(calibration, hard):
    """What a live show opens, and the simulated device."""
    before, show, found = listening(), LiveControl(), []

    def publish(result):
        found.extend(set(listening()) - set(before))
        show.stop.set()

    with small_device() as device:
        present(
            calibration,
            *sources_of(device, calibration),
            show,
            Presentation(port=0, publish=0),
            LiveSettings(rest=0.1),
            also=[publish],
        )
    assert len(set(found)) == 4  # page, lines, two streams of the device
    assert all(address.startswith("0100007F:") for address in found)
    told = "127.0.0.1 only; with --host another address, and a line that warns who can see the results"
    hard("fault 14: what listens", "page, JSON lines, simulated device", beyond=told)


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/net/tcp"), reason="needs Linux")
def test_a_served_skin_listens_on_this_machine_only(bundled):
    session = next(path for path in bundled if "presses" in path.name)
    command = [sys.executable, "-m", "calib.cli", "simulate", "ideal", "-o", str(session), "--serve"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as serving:
        try:
            assert "serving" in serving.stdout.readline()
            found = listening(serving.pid)
            serving.send_signal(signal.SIGINT)
            assert serving.wait(20) == 0
        finally:
            serving.kill()
    assert len(found) == 3
    assert all(address.startswith("0100007F:") for address in found)


def test_results_are_published_as_lines_and_a_warning_precedes_an_open_door(calibration):
    show, told, lines = LiveControl(), [], []

    def tell(line):
        told.append(line)
        if line.startswith("lines"):
            port = line.rpartition(":")[2]
            threading.Thread(target=listen, args=("127.0.0.1", int(port)), daemon=True).start()

    def listen(host, port):
        with socket.create_connection((host, port), timeout=10) as link, link.makefile("rb") as file:
            lines.extend(json.loads(file.readline()) for _ in range(5))
        show.stop.set()

    with small_device() as device:
        present(
            calibration,
            *sources_of(device, calibration),
            show,
            Presentation(host="0.0.0.0", port=0, publish=0),
            LiveSettings(rest=0.1),
            tell=tell,
        )
    assert len(lines) == 5
    assert "anyone who can reach this machine" in told[-1]
    assert set(lines[0]) >= {"force", "standard_error", "valid", "centre", "latency_ms", "dropped"}


def test_lines_hold_the_maps_where_they_are_asked_for(calibration):
    show, lines = LiveControl(), []

    def tell(line):
        if line.startswith("lines"):
            threading.Thread(target=listen, args=(int(line.rpartition(":")[2]),), daemon=True).start()

    def listen(port):
        with socket.create_connection(("127.0.0.1", port), timeout=10) as link, link.makefile("rb") as file:
            lines.append(json.loads(file.readline()))
        show.stop.set()

    with small_device() as device:
        where = Presentation(port=0, publish=0, maps=True)
        present(calibration, *sources_of(device, calibration), show, where, LiveSettings(rest=0.1), tell=tell)
    assert lines[0]["shape"] == [2, 2]
    maps, images = (np.frombuffer(base64.b64decode(lines[0][name]), "<f4") for name in ("map", "image"))
    np.testing.assert_allclose(maps.reshape(2, 2).sum(1), lines[0]["force"], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(images, 1e-3 * maps, rtol=1e-5)


@pytest.mark.slow
def test_an_event_driven_scan_of_the_testbed_finds_the_contact_with_a_fraction_of_the_readings(model, skin, pixels):
    """A press appears where the whole scan sees it, from the readings of the director's own choice."""
    recon = je.prepare(model, basis=pixels)
    masks, owner = je.pad_masks(skin, recon), np.asarray(je.pad_masks(skin, recon).weights)
    curves = stand_in(FittedCurve, pressure_range=np.tile([0.0, 4000.0], (len(skin.pads), 1)))
    stood_in = stand_in(calib.Calibration, skin=skin, curves=curves, recon=recon)
    director = prepare_director(stood_in, 1, lambda data: None)
    place = np.array([0.06, 0.15])
    centres, v0 = np.asarray(model.centroids), np.asarray(je.forward(model))
    bump = 0.3 * np.exp(-0.5 * ((centres - place) ** 2).sum(1) / 0.012**2)
    dv = np.asarray(je.forward(model, model.background * (1 + bump))) - v0
    pad = int(np.argmax(owner @ np.exp(-((np.asarray(recon.centres) - place) ** 2).sum(1) / 1e-4)))
    pressure, centre = np.zeros(len(skin.pads)), np.full((len(skin.pads), 2), np.nan)
    director.update(pressure, centre)  # the first is a whole scan
    director.update(pressure, centre)
    assert director.requested.sum() < 0.1 * recon.readings
    pressure[pad] = 2000.0
    for _ in range(4):
        director.update(pressure, centre)
        image = recon(jnp.where(director.requested, dv, jnp.nan))
        force = np.asarray(je.fuse(image, masks, jnp.asarray(pressure)).force)
        centre[pad] = force @ np.asarray(recon.centres) / force.sum()
        assert director.requested.sum() < 0.3 * recon.readings
        assert np.linalg.norm(centre[pad] - place) < 0.015


@pytest.mark.parametrize("correlated", [False, True])
def test_an_event_driven_scan_uses_the_channels_and_the_noise_of_the_calibration(
    model, skin, pixels, monkeypatch, correlated
):
    std = np.linspace(1e-6, 3e-6, 550)  # V
    used = np.arange(550) % 9 > 0
    recon = je.prepare(model, basis=pixels, noise=np.diag(std**2) if correlated else std, channels=used)
    curves = stand_in(FittedCurve, pressure_range=np.tile([0.0, 4000.0], (len(skin.pads), 1)))
    given = {}
    monkeypatch.setattr(je.scan, "prepare_event_scan", lambda *_, **known: given.update(known) or small_scan())
    prepare_director(stand_in(calib.Calibration, skin=skin, curves=curves, recon=recon), 1, lambda data: None)
    np.testing.assert_array_equal(given["channels"], used)
    np.testing.assert_allclose(given["noise"][used], std[used], rtol=1e-9)


@pytest.mark.slow
def test_live_at_the_rate_of_the_paper_accounts_for_every_frame():
    """928 readings at 100 Hz, 1,000 pressures a second, recorded as well; how fast, is for bench_live to say."""
    found = bench_live.soaked(bench_live.made_up(), 20.0)
    assert found["lost"] == 0
    assert found["received"] == found["recorded"]
    assert found["recorded_gaps"] == [0, 0]
    assert found["complete"]
    assert found["received"][0] > found["shown"] + found["dropped"] > 0  # the others gave the levels


@pytest.mark.parametrize("limit", [0, 100, 150, 399, 1000, 10**6])
def test_the_highest_rate_is_found_by_doubling_and_bisection(limit):
    tried = []

    def sustains(rate):
        tried.append(rate)
        return rate <= limit

    found = bench_live.highest(sustains, 100, 6400)
    assert found <= limit
    assert len(tried) <= 12
    if limit == 10**6:
        assert found == 6400
    elif limit:
        refused = min(rate for rate in tried if rate > limit)
        assert found == max(rate for rate in tried if rate <= limit)
        assert refused <= bench_live.CLOSE * found


# --- end to end ----------------------------------------------------------------------------------

SITES = np.stack(np.meshgrid([0.035, 0.065, 0.135, 0.165], [0.035, 0.065, 0.135, 0.165]), -1).reshape(-1, 2)
TIMING = Timing(rest=0.6, ramp=0.6, hold=1.2, release=0.6, recovery=0.6)


def stage(bench):
    """Where the indenter stands, at 20 Hz: over the site of the press of the time."""
    times = np.arange(0, bench.duration, 0.05)
    press = np.clip((times - bench.blank) // bench.timing.period, 0, len(bench.sites) - 1).astype(int)
    return frame_packets(4, (times * S).astype(int).tolist(), bench.sites[press].astype("f4"))


@pytest.mark.slow
def test_from_a_simulated_skin_to_a_recording_a_calibration_and_live_forces(skin, tmp_path):
    """Everything over loopback, in real time: forces stay within the calibration's own error bars."""
    deviations = {fx.StreamKind.EIT: 1e-6, fx.StreamKind.PRESSURE: 2.0, fx.StreamKind.FORCE: 0.01}
    noise = [fx.Noise(std=std, stream=stream) for stream, std in deviations.items()]
    effects = (fx.ContactPiezoresistance(), *noise)
    bench = Bench(
        je.Scene(skin, effects),
        SITES,
        np.array([20.0]),
        timing=TIMING,
        blank=2.0,
        eit_rate=100.0,
        pad_rate=200.0,
        toml="simulated in a test",
    )
    simulate(bench, tmp_path / "skin.h5", fidelity=je.Fidelity.draft(edge_length=0.05))
    names = ["eit", "pressure", "force"]
    streams = [recording_packets(tmp_path / "skin.h5", [name]) for name in names]
    with SimulatedDevice([*streams, stage(bench)], wait_for=1) as device:
        urls = dict(zip([*names, "stage"], device.urls, strict=True))
        plan, sources = plan_recording({**urls, "stage": urls["stage"] + "?channels=2"}, skin, "end to end")
        summary = record_session(
            plan, sources, tmp_path / "recorded.h5", seconds=bench.duration - 0.5, stop_request=StopRequest()
        )
    assert summary.complete
    assert all(stream.lost == 0 for stream in summary.streams)
    with calib.open_session(tmp_path / "recorded.h5") as session:
        calibration = calib.calibrate(
            [session], recipe=calib.Recipe(imaging=je.Imaging(je.Pixels(20)), fidelity=je.Fidelity.draft())
        )
        force = session.stream("force")
        assert calibration.evaluation.summary()["force_rmse"] < 4.0
    show, results, told = LiveControl(), [], []
    show.warn = told.append
    with SimulatedDevice(
        [recording_packets(tmp_path / "skin.h5", [name]) for name in ("eit", "pressure")], wait_for=1
    ) as device:
        threading.Timer(20.0, show.stop.set).start()
        found = plan_recording({"eit": device.urls[0], "pressure": device.urls[1]}, skin)
        run_live(calibration, *found, [results.append], show, LiveSettings(rest=1.5))
    assert len(results) > 200
    assert not [line for line in told if line.startswith("EIT")]
    _, each = np.unique([result.host for result in results], return_index=True)  # of frames read together one
    results = [results[n] for n in each]
    total = np.array([result.force.sum() for result in results])
    error = np.array([np.linalg.norm(result.standard_error) for result in results])
    since = np.array([result.host - results[0].host for result in results]) / S + 1.5
    with calib.open_session(tmp_path / "recorded.h5") as session:
        force = session.stream("force")
        true = np.interp(since, (force.time - force.time[0]) / S, force.read()[:, 0])
    still = np.abs(np.gradient(true, since)) < 5
    assert np.mean(np.abs(total - true)[still] < 2 * error[still] + 0.1) > 0.9
    assert np.ptp(true) > 15
