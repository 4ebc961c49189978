"""The functions of `calib` that take any calibration, given that of a log, as the command line is."""

import re
from dataclasses import replace

import numpy as np
import pytest

import calib
import jaxeit as je
from calib import calibration as room
from calib.calibration.logs.procedure import FORCE_FORMAT
from calib.calibration.procedure import FITTING_LOGS
from calib.report.log_document import write_log_report
from calib.session import SessionError, open_session, read_archive

from .test_logs import AFFINE, write_log


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A log of a sensor of one channel, open, and its calibration."""
    phase = np.arange(1500) / 50
    force = 10 * (1 + np.sin(2 * phase)) * (1 + 0.3 * np.sin(phase / 7))
    noise = np.random.default_rng(0).normal(0, 5, (1500, 1))
    path = write_log(tmp_path_factory.mktemp("log") / "log.h5", force, 100 * force[:, None] + noise)
    with open_session(path) as session:
        yield session, room.calibrate_logs(session, AFFINE)


def test_the_calibration_of_a_log_is_evaluated_applied_and_moved_as_that_of_a_skin(log, tmp_path):
    session, sensor = log
    assert calib.evaluate(sensor, session).summary() == room.evaluate_log(sensor, session).summary()
    told = []
    written = read_archive(calib.apply(sensor, session, tmp_path / "forces.h5", tell=told.append), FORCE_FORMAT)
    np.testing.assert_array_equal(written.arrays["force"], room.apply_log(sensor, session, tmp_path / "again.h5").force)
    moved = calib.recalibrate(sensor, session, room.KnownForces())
    assert moved.shift.gain == room.recalibrate_log(sensor, session).shift.gain


def test_a_log_goes_through_the_verbs_of_a_skin(log, tmp_path):
    session, sensor = log
    stages = []
    made = calib.calibrate(session, recipe=AFFINE, progress=stages.append)
    assert isinstance(made, calib.calibration.LogCalibration)
    assert stages == [FITTING_LOGS]
    np.testing.assert_array_equal(made.model.curve.parameters, sensor.model.curve.parameters)
    stream = session.stream(sensor.stream)
    for given, expected in zip(
        calib.force_map(made, stream.time, stream.read()), sensor.predict(stream.time, stream.read()), strict=True
    ):
        np.testing.assert_array_equal(given, expected)
    found = calib.evaluate(made, session)
    written = calib.write_report(made, tmp_path / "page.html", evaluations={"again": found})
    assert written == [tmp_path / "page.html"]
    write_log_report(sensor, tmp_path / "same.html", evaluations={"again": found})
    assert _without_dates(written[0]) == _without_dates(tmp_path / "same.html")


def _without_dates(page):
    return re.sub(r"\d{4}-\d\d-\d\dT[0-9:+]*", "", page.read_text())


def test_logs_and_sessions_of_a_skin_are_not_mixed(log, grid):
    session, _ = log
    with open_session(grid) as other, pytest.raises(SessionError, match=r"log.h5: /streams/eit: missing.*grid.*apart"):
        calib.calibrate([other, session])


def test_what_a_recipe_asks_of_images_is_noted(log):
    session, sensor = log
    asked = room.calibrate_logs(session, replace(AFFINE, learn_layer=True, fit_electrodes=True))
    assert "the recipe's fit_electrodes, learn_layer: for sessions with EIT, left out" in asked.notes
    assert not any("EIT" in note for note in sensor.notes)


def test_what_a_log_has_not_is_named_with_what_to_do(log, tmp_path):
    session, sensor = log
    refused = [
        (
            lambda: calib.calibrate(session, je.load_skin("testbed")),
            "calibrate: skin is about EIT, and the sessions are logs; leave out skin",
        ),
        (lambda: calib.force_map(sensor, [0], [1.0], gate=0.5), "force_map: gate is about EIT.*leave out gate"),
        (lambda: calib.force_map(sensor, [0], [1.0], before=np.ones((1, 1))), "force_map: before is about EIT"),
        (lambda: room.assess(sensor, session), "assess: the calibration is of a log.*assess_log"),
        (lambda: calib.recalibrate(sensor, session, room.OrdinaryUse()), "OrdinaryUse is not evidence for a log"),
        (
            lambda: calib.write_report(sensor, tmp_path / "r.html", evaluations={"b.h5": sensor}),
            "evaluations: b.h5: LogCalibration is not an evaluation of the calibration of a log; give calib.evaluate",
        ),
        (lambda: calib.apply(sensor, session, tmp_path / "f.h5", track=True), "apply: track is about EIT.*leave out"),
        (lambda: calib.apply(sensor, session, tmp_path / "f.h5", loads=1.0), "apply: loads is about EIT"),
        (lambda: calib.evaluate(sensor, session, calib.presses.Processing()), "evaluate: processing is about EIT"),
        (
            lambda: room.evaluate_log("cal.h5", session),
            r"evaluate_log: 'cal.h5' is not the calibration of a log; give c",
        ),
        (lambda: room.calibrate_logs([]), "calibrate_logs: no session given"),
    ]
    for call, said in refused:
        with pytest.raises(SessionError, match=said):
            call()
