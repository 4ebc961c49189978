"""Calibrations of logs: channels left out, files, evaluation, application, and logs of one sensor together."""

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.calibration.archives.storage import SEAL, seal
from calib.calibration.logs.calibration import FORMAT
from calib.calibration.logs.evaluation import log_evaluation, render_evaluation
from calib.calibration.logs.procedure import FORCE_FORMAT, apply_log, calibrate_logs, evaluate_log, render_log
from calib.calibration.logs.storage import CURVE_FIELDS
from calib.cli import main
from calib.fitting.curves import Affine, Linear
from calib.fitting.logs import BestChannel, BlendChannels, LogPrediction, SmoothChannels
from calib.fitting.results import FitError
from calib.session import (
    SessionError,
    SessionFacts,
    SessionWriter,
    StreamFacts,
    open_session,
    read_archive,
    write_archive,
)

RATE = 50.0  # Hz


LINEAR, AFFINE = calib.Recipe(curve=Linear()), calib.Recipe(curve=Affine())


def write_log(path, force, values):
    """A session of force and an array of channels."""
    time = np.rint(np.arange(len(force)) / RATE * 1e9).astype(np.int64)
    with SessionWriter(
        path, SessionFacts(title="a test", skin_name="", skin_toml="", epoch=datetime(2026, 1, 1, tzinfo=UTC))
    ) as writer:
        writer.add_stream("force", StreamFacts("force", units="N", channels=1, rate_hz=RATE))
        writer.append("force", time, force[:, None])
        writer.add_stream("pressure", StreamFacts("pressure", units="Pa", channels=values.shape[1], rate_hz=RATE))
        writer.append("pressure", time, values)
    return path


@pytest.fixture
def array():
    """Force (n,) N and ten channels (n, 10) that follow it."""
    rng = np.random.default_rng(0)
    phase = np.arange(3000) / RATE
    force = 10 * (1 + np.sin(phase)) * (1 + 0.3 * np.sin(phase / 7))
    return force, force[:, None] * np.linspace(50, 150, 10) + rng.normal(0, 5, (3000, 10))


def broken(values):
    out = values.copy()
    out[:, 2] = np.nan
    out[:, 5] = 77.0
    out[:, 8] = 500 + 100 * np.random.default_rng(1).normal(size=len(out))
    return out


def calibrated(path, recipe=LINEAR):
    with open_session(path) as session:
        return calibrate_logs([session], recipe)


@pytest.fixture
def one_way(monkeypatch):
    """Tests of what does not depend on how channels are combined do not compare the ways."""
    monkeypatch.setattr("calib.calibration.logs.procedure.ways_of", lambda *_: {"best channel": BestChannel()})


@pytest.mark.usefixtures("one_way")
def test_channels_without_information_are_left_out_with_a_note(array, tmp_path):
    force, values = array
    found = calibrated(write_log(tmp_path / "broken.h5", force, broken(values)))
    other = calibrated(write_log(tmp_path / "kept.h5", force, np.delete(values, [2, 5, 8], 1)))
    assert found.notes == ("channels left out: dead 2; stuck 5; silent 8",)
    assert other.notes == ()
    assert found.kept.tolist() == [0, 1, 3, 4, 6, 7, 9]
    np.testing.assert_allclose(found.evaluation.predicted, other.evaluation.predicted, rtol=1e-9)
    assert found.evaluation.summary()["force_rmse"] < 0.1
    assert "note: channels left out" in render_log("broken", found)


@pytest.mark.usefixtures("one_way")
def test_the_held_out_half_does_not_decide_which_channels_are_used(array, tmp_path):
    force, values = array
    late = values.copy()
    late[1600:, 3] = 101.0
    (note,) = calibrated(write_log(tmp_path / "late.h5", force, late)).notes
    assert "column 3 stands still" in note


def test_an_array_of_which_no_channel_follows_the_force_is_refused(array, tmp_path):
    force, values = array
    noise = np.random.default_rng(2).normal(size=values.shape)
    with pytest.raises(FitError, match=r"pressure: none of 10 channels follows the force; see jaxeit check"):
        calibrated(write_log(tmp_path / "noise.h5", force, noise))


# --- one file, opened by every command -------------------------------------------------------------------------------


@pytest.fixture
def few(array, tmp_path):
    """Files of two logs of one sensor with one channel."""
    force, values = array
    return [str(write_log(tmp_path / f"{k}.h5", k * force, k * values[:, :1])) for k in (1, 2)]


def test_a_file_gives_back_the_calibration_and_its_forces(few, tmp_path):
    made = calibrated(few[0])
    made.save(tmp_path / "c.h5")
    back = calib.load_calibration(tmp_path / "c.h5")
    assert isinstance(back, calib.calibration.LogCalibration)
    with open_session(few[1]) as session:
        stream = session.stream("pressure")
        ours, theirs = (one.predict(stream.time, stream.read()) for one in (made, back))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a, b)
    assert back.evaluation.summary() == made.evaluation.summary()
    assert back.provenance == made.provenance
    assert back.tried == made.tried
    # the second log reaches twice as far: its upper half is outside of what was calibrated
    assert 0.2 < np.mean(ours.valid) < 0.9
    assert not ours.valid[np.argmax(ours.force)]


@pytest.mark.parametrize("way", [BlendChannels(), SmoothChannels((2,), (3.0,))], ids=["blend", "gaussian process"])
def test_weights_of_combined_channels_are_kept(way, array, tmp_path, monkeypatch):
    force, values = array
    monkeypatch.setattr("calib.calibration.logs.procedure.ways_of", lambda *_: {"chosen": way})
    made = calibrated(write_log(tmp_path / "two.h5", force, values[:, :2]), AFFINE)
    assert made.units == ("N/N", "N")
    made.save(tmp_path / "c.h5")
    found = calib.load_calibration(tmp_path / "c.h5").predict(np.arange(3000) / RATE * 1e9, values[:, :2])
    assert np.sqrt(np.mean((found.force - force) ** 2)) < 0.1
    inside = (force >= found.low) & (force <= found.high)
    assert 0.8 < inside.mean() < 0.99


def test_a_changed_or_impossible_file_is_refused(few, tmp_path):
    calibrated(few[0]).save(tmp_path / "c.h5")
    archive = read_archive(tmp_path / "c.h5", FORMAT)
    own = {k: v for k, v in archive.attrs.items() if k not in ("format", "format_version", "Conventions", "complete")}

    def refused(why, sealed=True, **changed):
        arrays = dict(archive.arrays) | {k.replace("__", "/"): v for k, v in changed.items()}
        attrs = own | ({SEAL: seal(own, arrays)} if sealed else {})
        write_archive(tmp_path / "bad.h5", FORMAT, attrs, {k: (v, "", "") for k, v in arrays.items()})
        with pytest.raises(SessionError, match=why):
            calib.load_calibration(tmp_path / "bad.h5")

    refused("changed after the calibration was saved", sealed=False, curve__parameters=np.array([7.0]))
    refused("no covariance", curve__covariance=np.array([[-1.0]]))
    refused("outside of 1", channels__kept=np.array([1]))
    refused("lowest and highest", channels__reach=np.array([[1.0], [0.0]]))
    refused("below zero", noise__floor=np.array(-1.0))
    assert set(CURVE_FIELDS) <= {name.removeprefix("curve/") for name in archive.arrays}


def test_evaluate_and_apply_take_the_calibration_of_a_log(few, tmp_path, capsys):
    c, out, page = (str(tmp_path / name) for name in ("c.h5", "out.h5", "page.html"))
    assert main(["calibrate", few[0], "--curve", "linear", "-o", c, "--test", few[1], "--report", page]) == 0
    said = capsys.readouterr().out
    assert "second half, by the model of the first" in said
    assert "fitted to the whole recording" in said
    text = Path(page).read_text()
    assert text.index("Residuals") < text.index("Coverage of the intervals") < text.index("<svg")
    assert main(["evaluate", c, few[1]]) == 0
    assert "outside the calibrated range" in capsys.readouterr().out
    assert main(["apply", c, few[1], "-o", out]) == 0
    arrays = read_archive(out, FORCE_FORMAT).arrays
    assert set(arrays) == {"time", "force", "standard_error", "low", "high", "valid"}
    with open_session(few[1]) as session:
        np.testing.assert_array_equal(arrays["time"], session.stream("pressure").time)
        found = evaluate_log(calib.load_calibration(c), session)
    np.testing.assert_allclose(found.predicted, arrays["force"])
    assert main(["evaluate", c, few[1], "--low-pass", "5"]) == 2
    assert "--low-pass: for calibrations with EIT" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--fit-electrodes", "--learn-layer", "--even-sheet", "--fidelity=draft"])
def test_options_for_eit_are_refused_for_a_log(option, few, tmp_path, capsys):
    assert main(["calibrate", few[0], "-o", str(tmp_path / "c.h5"), option]) == 2
    assert f"{option.split('=')[0]}: for sessions with EIT" in capsys.readouterr().err
    assert not (tmp_path / "c.h5").exists()


MS = np.arange(3) * 1_000_000  # ns
COLUMN = np.full((3, 1), 500.0)
IMPOSSIBLE = [
    # times, values, what is said
    (MS, np.ones((3, 4)), r"pressure: 4 channels, but the calibration is of 1"),
    (MS, np.ones((3, 1, 1)), r"values: of shape \(3, 1, 1\); give a row of 1 channels for each time"),
    (MS[:2], COLUMN, r"time: of shape \(2,\) for 3 rows of values; give one time for each row"),
    (MS * [1.0, np.nan, 1.0], COLUMN, r"time: holds values that are not finite; give nanoseconds"),
    (MS[::-1], COLUMN, r"time: 1000000 in row 1 is not after 2000000; give nanoseconds that rise"),
    (np.zeros(3), COLUMN, r"time: 0.0 in row 1 is not after 0.0; give nanoseconds that rise"),
    (MS / 1e9, COLUMN, r"time: rises by 0.001 ns from row to row; are these seconds\? give nanoseconds"),
    (["a", "b", "c"], COLUMN, r"time: holds <U1; give nanoseconds"),
    (MS, [["a"], ["b"], ["c"]], r"values: no table of numbers; give floats"),
]


@pytest.fixture(scope="module")
def sensor(tmp_path_factory):
    """A calibration of one channel."""
    force = 10 * (1 + np.sin(np.arange(600) / RATE))
    values = 100 * force[:, None] + np.random.default_rng(0).normal(0, 5, (600, 1))
    return calibrated(write_log(tmp_path_factory.mktemp("sensor") / "log.h5", force, values))


@pytest.mark.parametrize(("time", "values", "said"), IMPOSSIBLE)
def test_impossible_readings_are_refused(time, values, said, sensor):
    with pytest.raises(SessionError, match=said):
        sensor.predict(time, values)


def test_lists_and_a_plain_row_of_one_channel_are_taken(sensor):
    expected = sensor.predict(MS, COLUMN).force
    np.testing.assert_array_equal(sensor.predict(MS.tolist(), COLUMN.tolist()).force, expected)
    np.testing.assert_array_equal(sensor.predict(MS, COLUMN[:, 0]).force, expected)
    with pytest.raises(SessionError, match=r"place: of shape \(2, 2\) for 3 rows of values; give x and y for each row"):
        sensor.predict(MS, COLUMN, np.zeros((2, 2)))


def test_a_tracker_refuses_impossible_readings_and_goes_on(sensor):
    tracker = sensor.tracker()
    first = tracker.step(0, [500.0])
    for time, values, said in [
        (MS[1], np.full(4, 500.0), "4 channels, but the calibration is of 1"),
        (0.02, [500.0], "time: 0.02 after 0, both in ns, is not later by 1 ns or more"),
        (-MS[1], [500.0], "is not later by 1 ns"),
        (np.nan, [500.0], "time: holds values that are not finite"),
        (MS[1], np.ones((1, 1)), r"values: of shape \(1, 1\); give the 1 channels of one reading"),
    ]:
        with pytest.raises(SessionError, match=said):
            tracker.step(time, values)
    second = tracker.step(MS[1], 500.0)  # one channel may come as a plain number
    np.testing.assert_allclose(np.concatenate([first.force, second.force]), sensor.predict(MS[:2], COLUMN[:2]).force)


def test_logs_of_one_sensor_are_pooled_and_others_refused(array, few, tmp_path):
    with open_session(few[0]) as one, open_session(few[1]) as two:
        both = calibrate_logs([one, two], LINEAR)
        assert re.fullmatch(r"LogCalibration\('.+' in Pa, channels=1 of 1, curve='linear'\)", repr(both))
        assert evaluate_log(both, two).valid.all()
        assert both.provenance["sessions"].count("\n") == 1
    other = write_log(tmp_path / "other.h5", array[0], array[1][:, :3])
    with open_session(few[0]) as one, open_session(other) as two:
        with pytest.raises(SessionError, match=r"other\.h5: .*3 channels .*calibrate logs of one sensor together"):
            calibrate_logs([one, two], LINEAR)
        with pytest.raises(SessionError, match=r"other\.h5: .*3 channels .*the calibration of this sensor"):
            apply_log(calibrated(few[0]), two, tmp_path / "out.h5")


def test_errors_and_coverage_by_hand():
    """Errors 1, 1 and -2 N; the second interval misses; the last sample is out of range, one has no force."""
    force = np.array([1.0, 2.0, np.nan, 4.0])
    predicted, low, high = np.array([[2.0, 3.0, 5.0, 2.0], [0.0, 2.5, 0.0, 0.0], [4.0, 4.0, 9.0, 9.0]])
    valid = np.array([True, True, True, False])
    found = LogPrediction(predicted, np.ones(4), low, high, valid)
    s = log_evaluation("by hand", np.arange(4.0), force, found).summary()
    assert s["force_rmse"] == pytest.approx(np.sqrt(6 / 3))
    assert s["force_bias"] == pytest.approx(0.0)
    assert s["force_mape"] == pytest.approx(100 * (1 + 0.5 + 0.5) / 3)
    assert s["force_worst"] == 2.0
    assert s["outside_share"] == 0.25
    assert s["coverage"] == 0.5
    assert (s["coverage_low"], s["coverage_high"]) == (1.0, 0.0)
    assert np.isnan(s["coverage_middle"])


def test_a_held_out_half_without_forces_is_named(tmp_path, capsys):
    """The load cell was unplugged half way: no error is known, which is said instead of nan."""
    force = 10 * (1 + np.sin(np.arange(600) / RATE * 3))
    values = 100 * force[:, None] + np.random.default_rng(0).normal(0, 5, (600, 1))
    force[300:] = np.nan
    log = write_log(tmp_path / "log.h5", force, values)
    assert main(["calibrate", str(log), "--curve", "linear", "-o", str(tmp_path / "c.h5")]) == 0
    said = capsys.readouterr().out
    assert "errors not known: no sample has a recorded force; record the load cell to the end" in said
    assert "nan" not in said


@pytest.mark.parametrize(
    ("force", "predicted", "said"),
    [
        ([1.0, 2.0], [np.nan, np.nan], "no sample has all channels"),
        ([1.0, np.nan], [np.nan, 2.0], "no sample has both"),
        ([1.0, np.nan], [1.0, np.nan], ""),
    ],
)
def test_what_is_missing_is_named(force, predicted, said):
    found = LogPrediction(np.array(predicted), *np.ones((3, 2)), np.ones(2, bool))
    missing = log_evaluation("by hand", np.arange(2.0), np.array(force), found).missing
    assert missing.startswith(said)
    assert bool(missing) == bool(said)


def test_errors_of_forces_that_are_all_zero_have_no_percentage():
    found = LogPrediction(np.ones(4), *np.ones((3, 4)), np.ones(4, bool))
    said = render_evaluation(log_evaluation("at rest", np.arange(4.0), np.zeros(4), found))
    assert "force RMSE 1.000 N, bias +1.000 N" in said
    assert "nan" not in said


@pytest.mark.parametrize(("error", "noted"), [(0.5, False), (3.0, True)])
def test_errors_as_large_as_the_forces_are_noted(error, noted):
    force = np.array([0.0, 4.0, 0.0, 4.0])
    found = LogPrediction(force + error * np.array([1, 1, -1, -1]), *np.ones((3, 4)), np.ones(4, bool))
    notes = log_evaluation("by hand", np.arange(4.0), force, found).notes
    assert [("the errors are as large as the forces vary" in note) for note in notes] == [True] * noted


@pytest.mark.slow
@pytest.mark.usefixtures("one_way")
def test_a_log_that_only_loads_says_that_hysteresis_is_not_in_its_intervals(tmp_path, capsys):
    """Filled in the first half and emptied in the second: neither direction is in what the other is tried on."""
    rng = np.random.default_rng(4)
    force = 10 * np.concatenate([np.linspace(0, 1, 1500), np.linspace(1, 0, 1500)])
    values = 100 * force[:, None] + rng.normal(0, 5, (3000, 1))
    both = calibrated(write_log(tmp_path / "both.h5", force, values), AFFINE)
    assert both.notes == ()
    assert any("the force falls by 10 N here" in note for note in both.evaluation.notes)

    filled = calibrated(write_log(tmp_path / "filled.h5", force[:1500], values[:1500]), AFFINE)
    assert any("the force rises and never falls" in note for note in filled.notes)
    filled.save(tmp_path / "calibration.h5")
    emptied = write_log(tmp_path / "emptied.h5", force[1500:], values[1500:])
    assert main(["evaluate", str(tmp_path / "calibration.h5"), str(emptied)]) == 0
    assert "note: the force falls by 10 N here" in capsys.readouterr().out
    assert main(["apply", str(tmp_path / "calibration.h5"), str(emptied), "-o", str(tmp_path / "f.h5")]) == 0
    assert "note: the force falls by 10" in capsys.readouterr().out
    assert "falls by 10" in read_archive(tmp_path / "f.h5", FORCE_FORMAT).attrs["note"]
