"""Paths in the place of sessions, calibrations, benches and lists: the message names the call that opens the file."""

from pathlib import Path

import jax
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.bench import BenchError
from calib.export.errors import ExportError
from calib.session import SessionError, importers
from calib.session.argument_checks import sessions_of


def test_a_path_in_the_place_of_a_session_is_told_how_to_open_it(calibration):
    calls = {
        "check_session": lambda: calib.check_session("s.h5"),
        "calibrate": lambda: calib.calibrate(["s.h5"]),
        "evaluate": lambda: calib.evaluate(calibration, "s.h5"),
        "apply": lambda: calib.apply(calibration, "s.h5", "f.h5"),
        "recalibrate": lambda: calib.recalibrate(calibration, "s.h5"),
        "assess": lambda: calib.calibration.assess(calibration, "s.h5"),
        "calibrate_logs": lambda: calib.calibration.calibrate_logs("s.h5"),
    }
    for name, call in calls.items():
        with pytest.raises(
            SessionError, match=rf"^{name}: 's.h5' is not a Session; give calib.open_session\('s.h5'\)$"
        ):
            call()
    with pytest.raises(SessionError, match=r"calibrate: 's.h5' is not a Session; give calib.open_session\('s.h5'\)"):
        calib.calibrate(Path("s.h5"))
    with pytest.raises(SessionError, match=r"calibrate: NoneType is not a Session; give calib.open_session\(path\)"):
        calib.calibrate(None)


def test_a_path_in_the_place_of_a_calibration_is_told_how_to_load_it(grid):
    with calib.open_session(grid) as session:
        calls = {
            "evaluate": lambda: calib.evaluate("c.h5", session),
            "apply": lambda: calib.apply("c.h5", session, "f.h5"),
            "force_map": lambda: calib.force_map("c.h5", [0.0], [0.0]),
            "recalibrate": lambda: calib.recalibrate("c.h5", session),
            "export_c": lambda: calib.export_c("c.h5", "c.h"),
            "write_report": lambda: calib.write_report("c.h5", "r.html"),
        }
        said = r"'c.h5' is not a Calibration; give calib.load_calibration\('c.h5'\)"
        for name, call in calls.items():
            with pytest.raises(SessionError, match=f"^{name}: {said}$"):
                call()


def test_a_calibration_is_used_in_its_precision(grid, calibration):
    """JAX would lower it to float32 without a word, or fail in the middle of a fit."""
    with calib.open_session(grid) as session, jax.enable_x64(False):
        for name, call in {
            "evaluate": lambda: calib.evaluate(calibration, session),
            "force_map": lambda: calib.force_map(calibration, [0.0], [0.0]),
        }.items():
            with pytest.raises(je.model.FidelityError, match=f"^{name}: the calibration is of float64, but JAX is"):
                call()


def test_a_path_in_the_place_of_a_list_of_paths_is_put_into_one():
    said = r"'f.h5' is a path, and not a list of paths; give \['f.h5'\]"
    with pytest.raises(SessionError, match=f"calibrate_many: {said}"):
        calib.calibrate_many("f.h5", "out")
    with pytest.raises(ExportError, match=f"export_lerobot: {said}"):
        calib.export_lerobot("f.h5", "dataset")


def test_a_path_in_the_place_of_a_bench_is_told_how_to_load_it(skin):
    with pytest.raises(BenchError, match=r"simulate: 'b.toml' is not a Bench; give calib.load_bench\('b.toml'\)"):
        calib.simulate("b.toml", "s.h5")
    with pytest.raises(BenchError, match="simulate: Scene is not a Bench"):
        calib.simulate(je.Scene(skin), "s.h5")
    with pytest.raises(
        BenchError, match=r"write_training_frames: 'paper' is not a FrameSet; give calib.bench.FrameSet"
    ):
        calib.write_training_frames("paper", "frames")


def test_one_session_and_a_generator_are_calibrated_as_a_list_is(grid):
    with calib.open_session(grid) as session:
        assert sessions_of(session, "calibrate") == [session]
        with pytest.raises(SessionError, match=r"is the recording of grid\.h5 again"):  # the generator is read
            calib.calibrate(one for one in [session, session])


def test_the_path_of_a_table_may_be_a_text():
    spec = importers.FileSpec("a.csv", "t", "ms", (), following=("b.csv",))
    assert spec.paths == (Path("a.csv"), Path("b.csv"))
    with pytest.raises(SessionError, match=r"following: 'b.csv' is a path, and not a list of paths; give \['b.csv'\]"):
        importers.FileSpec("a.csv", "t", "ms", (), following="b.csv")


def test_forces_of_no_frames_are_no_rows(calibration):
    readings = calibration.recon.readings
    found = calib.force_map(calibration, np.zeros((0, readings)), np.zeros((0, 4)))
    assert found.force.shape == found.valid.shape == (0, 4)
    assert found.map.force.shape == (0, 400)
    assert found.map.areas.shape == (400,)


def test_what_is_no_change_of_frames_and_pads_is_named(calibration):
    frames, pads = np.zeros((2, calibration.recon.readings)), np.zeros((2, 4))
    with pytest.raises(ValueError, match=r"frames hold complex128: give real numbers; of complex frames give the real"):
        calib.force_map(calibration, frames + 1j, pads)
    with pytest.raises(ValueError, match=r"pressures is a masked array"):
        calib.force_map(calibration, frames, np.ma.masked_equal(pads, 0))
    with pytest.raises(ValueError, match=r"before \(3, 3\) do not fit this calibration: give \(n, 4\) Pa"):
        calib.force_map(calibration, frames, pads, before=np.zeros((3, 3)))
    with pytest.raises(je.fusion.FusionError, match=r"gate is -3"):
        calib.force_map(calibration, frames, pads, gate=-3)
    for of in (calibration.pad_forces, calibration.own_pressures):
        with pytest.raises(ValueError, match=r"pressures \(1, 3\) do not fit this calibration: give \(n, 4\) Pa"):
            of(np.ones(3))


def test_what_only_logs_have_is_refused_for_a_skin(calibration, tmp_path):
    frames, pads = np.zeros((1, calibration.recon.readings)), np.zeros((1, 4))
    with pytest.raises(SessionError, match="force_map: the place of contact is that of the frames; leave out place"):
        calib.force_map(calibration, frames, pads, np.zeros((1, 2)))
    with pytest.raises(SessionError, match=r"evaluations: b\.h5: Calibration is not an evaluation of .* a skin; give"):
        calib.write_report(calibration, tmp_path / "r.html", evaluations={"b.h5": calibration})


def test_pressures_of_one_time_are_one_row(calibration):
    force, error, valid = calibration.pad_forces(np.full(4, 500.0))
    assert force.shape == error.shape == valid.shape == (1, 4)
    np.testing.assert_array_equal(force, calibration.pad_forces(np.full((1, 4), 500.0))[0])
    np.testing.assert_array_equal(calibration.own_pressures(np.full(4, 500.0)), np.full((1, 4), 500.0))
