"""A log a week later: gain and offset of a sensor without EIT, from known force, with honest errors."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

import calib
from calib.calibration import assess_log, recalibrate_log
from calib.calibration.fitted_sessions import SAME_NOTE
from calib.calibration.logs.procedure import calibrate_logs, evaluate_log
from calib.calibration.logs.shift import fit_shift, shift_prior
from calib.cli import main
from calib.fitting.curves import Affine
from calib.fitting.gain_update import GainDrift
from calib.live.engine import ReceivedFrame
from calib.live.log_engine import LogEngine
from calib.session import SessionError, open_session

from .test_logs import RATE, write_log

GAIN, OFFSET = 1.12, 0.8  # N
N = 3000


def forces(seed):
    phase = np.arange(N) / RATE + seed
    return 10 * (1 + np.sin(phase)) * (1 + 0.3 * np.sin(phase / 7))


def log(seed, gain=1.0, offset=0.0, bend=0.0):
    """Force, and a channel of 100 Pa/N with errors of 0.1 N that keep for about 15 samples."""
    force, rng = forces(seed), np.random.default_rng(seed)
    error = signal.lfilter([1.0], [1.0, -0.93], rng.normal(size=N + 200))[200:] * np.sqrt(1 - 0.93**2)
    read = gain * force + offset + bend * force**2 / 20 + 0.1 * error
    return force, 100 * read[:, None]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A calibration, its file, a later log of the moved sensor, and another one."""
    folder = tmp_path_factory.mktemp("weeks")
    path = write_log(folder / "log.h5", *log(0))
    with open_session(path) as session:
        found = calibrate_logs([session], calib.Recipe(curve=Affine()))
    found.save(folder / "c.h5")
    return found, folder / "c.h5", *(write_log(folder / f"{k}.h5", *log(k, GAIN, OFFSET)) for k in (1, 2))


def errors(calibration, path):
    with open_session(path) as session:
        return evaluate_log(calibration, session).summary()


def test_a_force_in_kg_moves_no_calibration(made, tmp_path):
    force, values = log(3)
    with open_session(write_log(tmp_path / "kg.h5", force / 9.80665, values)) as session:
        with pytest.raises(SessionError, match=r"far beyond the drift of 14 %.*check the units"):
            recalibrate_log(made[0], session)
        shift = recalibrate_log(made[0], session, ignore_errors=True).shift
    assert shift.gain == pytest.approx(9.80665, rel=0.02)


def test_gain_and_offset_are_found_and_taken_off(made):
    calibration, _, later, other = made
    with open_session(later) as session:
        moved = recalibrate_log(calibration, session)
    shift = moved.shift
    assert shift.gain == pytest.approx(GAIN, abs=4 * shift.errors[0])
    assert shift.offset == pytest.approx(OFFSET, abs=4 * shift.errors[1])
    assert 0 < shift.errors[0] < 0.01
    before, after = errors(calibration, other), errors(moved, other)
    assert before["force_rmse"] > 1.5
    assert after["force_rmse"] < 0.13
    assert 0.85 < after["coverage"] < 0.97
    assert "recalibrate" in shift.health
    assert "reads +11.9 % +- 0.1 %" in shift.health


def test_errors_of_gain_and_offset_are_honest():
    """Pulls over 200 logs with errors that keep for many samples; what is within the prior counts too."""
    pulls, prior = [], shift_prior(None, 20.0, GainDrift())
    rng = np.random.default_rng(0)
    for seed in range(200):
        gain, offset = 1 + rng.normal(0, 0.05), rng.normal(0, 1.0)
        force, values = log(seed, gain, offset)
        block = np.arange(N) * 20 // N
        fit = fit_shift(force, values[:, 0] / 100, np.full(N, 0.1), block, prior)
        pulls.append((fit.mean - [gain, offset]) / np.sqrt(np.diag(fit.covariance)))
        assert fit.determined
    spread = np.std(pulls, 0)
    assert np.all(np.abs(np.mean(pulls, 0)) < 3 * spread / np.sqrt(200))
    assert np.all((spread > 0.85) & (spread < 1.2))


def test_a_second_recalibration_starts_from_the_first(made):
    calibration, _, later, other = made
    with open_session(later) as session, open_session(other) as second:
        moved = recalibrate_log(calibration, session)
        again = recalibrate_log(moved, second)
    np.testing.assert_allclose(again.shift.before, [moved.shift.gain, moved.shift.offset])
    assert "no need to recalibrate" in again.shift.health
    assert len(again.provenance["recalibrations"].splitlines()) == 2


def test_a_log_that_a_calibration_was_fitted_to_is_named(made):
    calibration, _, later, _ = made
    with open_session(later) as session:
        own = replace(calibration, provenance=calibration.provenance | {"sessions": f"{session.hash}  log.h5"})
        assert SAME_NOTE in recalibrate_log(own, session).shift.notes
        assert SAME_NOTE not in recalibrate_log(calibration, session).shift.notes


def test_a_log_at_rest_does_not_tell_the_gain(made, tmp_path):
    force, values = log(3, GAIN, OFFSET)
    path = write_log(tmp_path / "rest.h5", 0 * force, values - 100 * GAIN * force[:, None])
    with open_session(path) as session:
        found = assess_log(made[0], session, ignore_errors=True)
        assert not found.determined
        assert "press with several forces" in found.health
        with pytest.raises(SessionError):
            recalibrate_log(made[0], session)
    # By the offset alone, with what may have drifted of the gain.
    assert found.offset == pytest.approx(OFFSET, abs=0.1)
    assert found.errors[0] == pytest.approx(np.hypot(0.1, 0.1), rel=0.05)


def test_a_sensor_that_bends_is_to_be_calibrated_again(made, tmp_path):
    path = write_log(tmp_path / "bent.h5", *log(4, 0.8, 0.0, bend=0.3))
    with open_session(path) as session:
        assert "calibrate again" in assess_log(made[0], session).health


@pytest.mark.parametrize("lost", ["noise", "columns exchanged"])
def test_a_sensor_that_does_not_follow_the_force_is_refused_and_nothing_is_written(lost, made, tmp_path, capsys):
    """A torn tube: its gain is none that could be taken off, so that no file holds it."""
    force, values = log(6)
    noise = 1000 + np.random.default_rng(6).normal(0, 5, (N, 1))
    given = (force, noise) if lost == "noise" else (values[:, 0], force[:, None] + 500)
    path, new = write_log(tmp_path / "torn.h5", *given), tmp_path / "new.h5"
    assert main(["recalibrate", str(made[1]), str(path), "-o", str(new), "--force"]) == 2
    assert "torn.h5: /streams/pressure: does not follow the force" in capsys.readouterr().err
    assert not new.exists()
    with open_session(path) as session:
        assert "calibrate again" in assess_log(made[0], session, ignore_errors=True).health


def test_a_short_log_is_refused(made, tmp_path):
    force, values = log(5)
    path = write_log(tmp_path / "short.h5", force[:4], values[:4])
    with open_session(path) as session, pytest.raises(SessionError, match=r"short\.h5: .* record a longer log"):
        recalibrate_log(made[0], session, ignore_errors=True)


def test_the_command_line_writes_what_every_command_opens(made, tmp_path, capsys):
    _, c, later, other = made
    new, out = tmp_path / "new.h5", tmp_path / "out.h5"
    assert main(["recalibrate", str(c), str(later), "-o", str(new)]) == 0
    assert "gain    1.0000 -> 1.1" in capsys.readouterr().out
    assert main(["recalibrate", str(c), str(later), "-o", str(tmp_path / "j.h5"), "--json"]) == 0
    body = json.loads(capsys.readouterr().out)
    assert (body["format"], body["advice"], body["determined"]) == ("log-recalibration", "recalibrate", True)
    assert main(["evaluate", str(new), str(other)]) == 0
    assert "force RMSE 0.09" in capsys.readouterr().out
    assert main(["apply", str(new), str(other), "-o", str(out)]) == 0
    assert main(["check", str(other), "--calibration", str(new)]) == 0
    assert "no need to recalibrate" in capsys.readouterr().out
    assert main(["recalibrate", str(c), str(later), "-o", str(tmp_path / "u.h5"), "--from", "use"]) == 2
    assert "only known force can move" in capsys.readouterr().err
    loaded = calib.load_calibration(new)
    engine = LogEngine(loaded)
    found = engine.step(ReceivedFrame(np.array([1000.0]), np.zeros(0), 0))
    assert found.force[0] == pytest.approx((10 - OFFSET) / GAIN, abs=0.1)
