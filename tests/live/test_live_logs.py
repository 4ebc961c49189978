"""Live forces of sensors without EIT: the command line, lines of JSON, the zero, places, and what is refused."""

import json

import numpy as np
import pytest

import calib
from calib.calibration.logs.procedure import calibrate_logs
from calib.cli import main
from calib.fitting.curves import AffinePlay, Linear, MonotonePolynomial
from calib.fitting.fields import GaussianProcess
from calib.fitting.logs import LogTracker
from calib.live.engine import ReceivedFrame
from calib.live.log_engine import LogEngine
from calib.live.views.page import page_scene
from calib.session import open_session

from ..place_logs import place_log, write_place_log

S = 10**9


def calibrated(path, recipe):
    with open_session(path) as session:
        return calibrate_logs([session], recipe)


@pytest.fixture(scope="module")
def log():
    """Times, channel, force and place of 49 presses."""
    return place_log(0)


@pytest.fixture(scope="module")
def files(tmp_path_factory, log):
    """The log, and its calibrations without and with the place."""
    folder = tmp_path_factory.mktemp("logs")
    path = write_place_log(folder / "log.h5", log)
    calibrated(path, calib.Recipe(curve=Linear())).save(folder / "plain.h5")
    calibrated(path, calib.Recipe(curve=MonotonePolynomial(), location=GaussianProcess())).save(folder / "placed.h5")
    return folder


@pytest.mark.parametrize("name", ["plain", "placed"])
def test_forces_from_the_command_line_are_those_of_the_calibration(files, log, name, capsys):
    url = f"replay://{files / 'log.h5'}?speed={20 if name == 'plain' else 8}"
    words = ["--pressure", url, "--json", "--port", "0", "--seconds", "3"]
    words += ["--stage", url] if name == "placed" else []
    assert main(["live", "--calibration", str(files / f"{name}.h5"), *words]) == 0
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(found) > 50
    calibration, (time, values, _, place) = calib.load_calibration(files / f"{name}.h5"), log
    forces = calibration.predict(time, values, place).force
    seen = np.array([row["force"][0] for row in found])
    assert all(row["low"][0] <= row["force"][0] <= row["high"][0] for row in found)
    # Of the stage, the mean since the frame before counts; on a busy machine it holds some of the way between presses.
    nearest = np.abs(seen[:, None] - forces).min(1)
    assert np.mean(nearest < 1e-4) > (0.99 if name == "plain" else 0.5)


def test_the_zero_is_that_of_the_calibration_until_another_one_is_measured(files, log):
    engine = LogEngine(calib.load_calibration(files / "plain.h5"), rest=1.0)
    frames = [ReceivedFrame(np.array([value]), np.zeros(0), k * S // 10) for k, value in enumerate([5.0] * 20)]
    first = engine.step(frames[0])
    assert first.force[0] == pytest.approx(engine._calibration.predict(np.zeros(1), np.array([[5.0]])).force[0])
    engine.tare()
    assert "measuring the zero" in engine.state
    assert [engine.step(frame) for frame in frames[1:12]] == [None] * 11
    after = engine.step(frames[12])
    assert after.force[0] == pytest.approx(0.0, abs=1e-9)
    assert after.high[0] - after.low[0] == pytest.approx(first.high[0] - first.low[0])
    assert engine.state == "running"


def test_a_zero_is_not_measured_while_the_force_changes(files):
    engine = LogEngine(calib.load_calibration(files / "plain.h5"), rest=1.0)
    engine.tare()
    rising = [ReceivedFrame(np.array([0.5 * k]), np.zeros(0), k * S // 10) for k in range(12)]
    assert [engine.step(frame) for frame in rising] == [None] * 12
    assert "waiting for the sensor to be at rest" in engine.state
    still = [ReceivedFrame(np.array([5.5]), np.zeros(0), k * S // 10) for k in range(12, 60)]
    found = [one for one in map(engine.step, still) if one is not None]
    assert found[-1].force[0] == pytest.approx(0.0, abs=0.1)


def test_readings_that_arrive_together_are_taken_one_after_the_other(files):
    """One read of a link may bring several readings, which then have one time of arrival."""
    engine = LogEngine(calib.load_calibration(files / "plain.h5"))
    found = [engine.step(ReceivedFrame(np.array([5.0]), np.zeros(0), host)).force[0] for host in (S, S, S + 1, 2 * S)]
    np.testing.assert_allclose(found, found[0])


def test_a_missing_reading_has_no_force(files):
    engine = LogEngine(calib.load_calibration(files / "plain.h5"))
    found = engine.step(ReceivedFrame(np.array([np.nan]), np.zeros(0), 0))
    line = json.loads(found.to_json())
    assert (line["force"], line["valid"], line["missing"]) == ([None], [False], 1)


def test_wrong_streams_are_refused_with_what_to_give(files, capsys):
    url = f"replay://{files / 'log.h5'}"
    for name, words, message in (
        ("plain", ["--eit", url, "--pressure", url], "the calibration of a log; give --pressure and no other stream"),
        ("plain", ["--pressure", url, "--stage", url], "give --pressure and no other stream"),
        ("placed", ["--pressure", url], "the calibration of a log; give --pressure and --stage"),
        ("plain", ["--pressure", f"{url}?channels=3"], "3 channels, but this calibration is for 1"),
        ("plain", ["--pressure", url, "--event-driven"], "need a skin with EIT"),
    ):
        assert main(["live", "--calibration", str(files / f"{name}.h5"), "--port", "0", *words]) == 2
        assert message in capsys.readouterr().err


def test_the_page_of_a_log_has_no_map(files):
    assert page_scene(calib.load_calibration(files / "plain.h5")) == {
        "skin": "pressure",
        "simulated": False,
        "pads": ["pressure"],
    }


@pytest.mark.slow
def test_a_curve_with_hysteresis_follows_one_reading_after_the_other_in_bounded_time(files, log):
    """What is remembered does not grow with the time that has passed."""
    found = calibrated(files / "log.h5", calib.Recipe(curve=AffinePlay()))
    tracker = LogTracker(found.model)
    rng = np.random.default_rng(0)
    for k in range(300):
        tracker.step(k * S / 20, np.array([5 + 4 * np.sin(k / 9) + 0.05 * rng.normal()]))
    assert len(tracker._past) < 40
    assert tracker._past[-1, 0] == pytest.approx(5 + 4 * np.sin(299 / 9), abs=0.3)
