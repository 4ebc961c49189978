"""Logs with a stage: gain over the place, held out by place, in files, reports and later logs."""

import numpy as np
import pytest

import calib
from calib.calibration.logs.procedure import calibrate_logs, evaluate_log
from calib.cli import main
from calib.fitting.curves import Affine, MonotonePolynomial
from calib.fitting.fields import GaussianProcess, PadEdge, RadialBasis, TensorSpline
from calib.fitting.logs.location import bounding_box, cluster_sites
from calib.fitting.results import FitError
from calib.session import SessionError, open_session, read_archive

from ...place_logs import SIDE, grid, place_log, true_gain, write_place_log

GAIN = calib.Recipe(curve=MonotonePolynomial(), location=GaussianProcess())


def calibrated(path, recipe):
    with open_session(path) as session:
        return calibrate_logs([session], recipe)


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    """A log of 49 places, its calibration with a field of gain, and a log of 100 other places."""
    folder = tmp_path_factory.mktemp("places")
    path = write_place_log(folder / "grid.h5", place_log(0))
    other = place_log(1, np.random.default_rng(5).uniform(0, SIDE, (100, 2)))
    return path, calibrated(path, GAIN), other, write_place_log(folder / "other.h5", other)


def test_the_gain_over_the_place_is_found(pressed):
    """Log-gain has the mean zero over the places, because the level belongs to the curve."""
    location = pressed[1].model.location
    true = np.log(true_gain(grid()))
    gain, variance = location.gains(grid())
    apart = np.log(gain) - (true - true.mean())
    assert np.sqrt(np.mean(apart**2)) < 0.02
    assert np.all(variance < 0.05**2)
    np.testing.assert_allclose(location.box, [[0, 0], [SIDE, SIDE]], atol=1e-9)


def test_errors_at_places_that_were_not_pressed_are_small_and_covered(pressed):
    _, found, (time, values, force, _), path = pressed
    assert found.evaluation.title == "a third of the places, by the others"
    own = found.evaluation.summary()
    with open_session(path) as session:
        later = evaluate_log(found, session).summary()
    blind = calibrated(pressed[0], calib.Recipe(curve=Affine()))
    assert later["force_mape"] < 3
    assert own["force_mape"] < 4
    plain = blind.predict(time, values).force
    loaded = force > 1
    assert np.mean(np.abs(plain / force - 1)[loaded]) > 0.08
    for name in ("coverage", "coverage_low", "coverage_middle", "coverage_high"):
        assert later[name] > 0.75  # the highest third has presses at a few places
    assert later["coverage"] < 0.985


def test_a_place_outside_the_presses_is_not_valid_and_an_unknown_one_less_certain(pressed):
    _, found, (time, values, force, place), _ = pressed
    there = found.predict(time, values, place)
    assert there.valid.mean() > 0.99
    beyond = found.predict(time, values, place + np.array([0.3 * SIDE, 0]))
    out = place[:, 0] + 0.3 * SIDE > 1.06 * SIDE
    assert not beyond.valid[out].any()
    unknown = found.predict(time, values, np.full_like(place, np.nan))
    loaded = force > 5
    assert not unknown.valid.any()
    assert np.all(unknown.standard_error[loaded] > 3 * there.standard_error[loaded])
    assert np.mean(((force > unknown.low) & (force < unknown.high))[loaded]) > 0.85


def test_a_later_log_without_a_stage_is_refused(pressed, tmp_path):
    _, found, log, _ = pressed
    blind = write_place_log(tmp_path / "blind.h5", log, stage=False)
    with (
        open_session(blind) as session,
        pytest.raises(SessionError, match=r"blind\.h5: /streams/stage: no x and y .*--location none"),
    ):
        evaluate_log(found, session)
    with pytest.raises(SessionError, match="depends on the place of contact"):
        found.predict(log[0], log[1])
    with open_session(blind) as session, pytest.raises(SessionError, match="/streams/stage"):
        calibrate_logs([session], GAIN)


def test_the_command_line_takes_a_location_and_the_file_keeps_it(pressed, tmp_path, capsys):
    c, out, page = (str(tmp_path / name) for name in ("c.h5", "out.h5", "page.html"))
    words = ["--curve", "polynomial", "--location", "gp", "--report", page]
    assert main(["calibrate", str(pressed[0]), "-o", c, *words]) == 0
    assert "gain by place gp" in capsys.readouterr().out
    assert "Gain by place" in (tmp_path / "page.html").read_text()
    back = calib.load_calibration(c)
    time, values, _, place = pressed[2]
    for ours, theirs in zip(pressed[1].predict(time, values, place), back.predict(time, values, place), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    assert main(["apply", c, str(pressed[3]), "-o", out]) == 0
    np.testing.assert_allclose(read_archive(out, "log-forces").arrays["force"], back.predict(time, values, place).force)


@pytest.mark.slow
def test_places_decide_between_gain_inputs_and_nothing(tmp_path):
    """A pad of one channel whose gain depends on the place, and one whose gain does not."""
    either = calib.Recipe(curve=MonotonePolynomial(), location=[None, RadialBasis(), TensorSpline()])
    found = calibrated(write_place_log(tmp_path / "gain.h5", place_log(2)), either)
    assert found.location_name != "none"
    assert {one.part for one in found.tried} == {"location"}
    even = place_log(3)
    log = (*even[:2], even[2] / true_gain(even[3]), even[3])
    assert calibrated(write_place_log(tmp_path / "even.h5", log), either).needs_place is False


@pytest.mark.slow
def test_a_pad_of_several_channels_whose_channels_see_the_place_differently(tmp_path):
    log, other = (place_log(k, channels=3, spread=0.3) for k in (4, 5))
    either = calib.Recipe(curve=Affine(), location=[None, GaussianProcess()])
    found = calibrated(write_place_log(tmp_path / "c.h5", log), either)
    assert found.needs_place
    found.save(tmp_path / "kept.h5")
    time, values, force, place = other
    forces = calib.load_calibration(tmp_path / "kept.h5").predict(time, values, place)
    assert np.mean(np.abs(forces.force / force - 1)[force > 1]) < 0.04


def test_too_few_places_and_walls_that_a_log_does_not_have(tmp_path):
    few = write_place_log(tmp_path / "few.h5", place_log(0, np.repeat(grid(2), 5, 0)))
    with pytest.raises(FitError, match=r"few\.h5: 4 places of contact by the stage, .* needs 8; press more places"):
        calibrated(few, GAIN)
    found = calibrated(few, calib.Recipe(curve=Affine(), location=[None, GaussianProcess()]))
    assert not found.needs_place
    assert found.notes == ("no correction by location: 4 places of contact by the stage, and a correction by location "
                           "needs 8",)  # fmt: skip
    with pytest.raises(FitError, match=r"--location edge: a log has no walls of a pad"):
        calibrated(few, calib.Recipe(curve=Affine(), location=PadEdge()))


def test_a_stage_that_stands_still_tells_one_place():
    """Stages at rest say numbers that differ in their last digits, of which no field of gain is made."""
    rng = np.random.default_rng(0)
    still = np.array([0.315, -0.1]) + rng.normal(0, 5e-6, (500, 2))
    assert len(np.unique(cluster_sites(still, np.full(500, 5.0)))) == 1
    small = grid() / 30  # a pad of 1 mm, pressed at 49 places 0.17 mm apart
    assert len(np.unique(cluster_sites(small, np.full(49, 5.0)))) == 49


def test_presses_at_one_place_are_told_from_those_at_others():
    place = np.array([[0, 0], [1, 0], [1, 0.001], [0.5, 0.5], [0, 1], [0, 0.01]]) * SIDE
    force = np.array([5.0, 5.0, 5.0, 0.01, 5.0, 5.0])
    site = cluster_sites(place, force)
    assert site[1] == site[2] == site[3]
    assert site[0] == site[5]
    assert len(set(site)) == 3
    line = bounding_box(np.array([[0.0, 0.0], [1.0, 0.0]]))
    np.testing.assert_allclose(line[1] - line[0], [1.0, 0.1])
