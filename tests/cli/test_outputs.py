"""Nothing that cannot be made again is lost: outputs take the place of no input and of no recording."""

import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.calibration.fitted_sessions import is_fitted, require_each_once
from calib.cli import main
from calib.session import SessionError, file_hash, open_session


@pytest.fixture(scope="module")
def calibration(bundled):
    with open_session(next(path for path in bundled if path.stem == "testbed_grid")) as session:
        recipe = calib.Recipe(imaging=je.Imaging(basis=je.Pixels(10)), fidelity=je.Fidelity.draft())
        return calib.calibrate([session], recipe=recipe)


@pytest.fixture
def files(bundled, tmp_path):
    """A folder with a session, a calibration, a skin, a scene and a log; commands run in it."""
    session = next(path for path in bundled if path.stem == "testbed_presses")
    shutil.copy(session, tmp_path / "session.h5")
    with open_session(session) as opened:
        (tmp_path / "skin.toml").write_text(opened.skin_toml)
        (tmp_path / "scene.toml").write_text(opened.scene)
    for name in ("calibration.h5", "log.csv", "tank.npz"):
        (tmp_path / name).write_bytes(b"of another kind")
    return tmp_path


@pytest.mark.parametrize(
    ("words", "lost"),
    [
        ("calibrate session.h5 -o session.h5", "session.h5"),
        ("calibrate session.h5 -o new.h5 --report ./session.h5", "session.h5"),
        ("calibrate session.h5 -o new.h5 --test calibration.h5 --report calibration.h5", "calibration.h5"),
        ("apply calibration.h5 session.h5 -o calibration.h5", "calibration.h5"),
        ("apply calibration.h5 session.h5 -o link.h5", "session.h5"),
        ("recalibrate calibration.h5 session.h5 -o calibration.h5", "calibration.h5"),
        ("design skin.toml -o skin.toml", "skin.toml"),
        ("design skin.toml -o new.toml --picture skin.toml", "skin.toml"),
        ("simulate scene.toml -o scene.toml", "scene.toml"),
        ("image tank.npz --skin skin.toml -o skin.toml", "skin.toml"),
        ("import csv log.csv --time 0:ms --stream force=1:N -o log.csv", "log.csv"),
        ("export c calibration.h5 -o calibration.h5", "calibration.h5"),
        ("train skin.toml -o skin.toml", "skin.toml"),
    ],
)
def test_no_output_takes_the_place_of_an_input(words, lost, files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    (files / "link.h5").symlink_to(files / "session.h5")
    before = file_hash(files / lost)
    assert main(words.split()) == 2
    assert "give another name" in capsys.readouterr().err
    assert file_hash(files / lost) == before


def test_no_output_takes_the_place_of_a_device(files, monkeypatch, capsys, calibration):
    monkeypatch.chdir(files)
    assert main(["calibrate", "session.h5", "-o", "/dev/null"]) == 2
    assert "/dev/null: is a device or a pipe; give a file name" in capsys.readouterr().err
    with pytest.raises(SessionError, match="is a device or a pipe"):
        calibration.save("/dev/null")
    assert Path("/dev/null").is_char_device()


@pytest.mark.parametrize("length", [240, 300])
def test_a_name_that_is_too_long_is_said_before_the_work_begins(length, files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    assert main(["calibrate", "session.h5", "-o", length * "x"]) == 2
    said = f"jaxeit: {40 * 'x'}...: is too long for the name of a file; give a shorter one\n"
    assert capsys.readouterr().err == said


def test_no_two_outputs_have_one_name(files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    assert main(["calibrate", "session.h5", "-o", "new.h5", "--report", "./new.h5"]) == 2
    assert "new.h5: is given for two outputs; give two names" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "calibrate session.h5 -o other.h5",
        "apply calibration.h5 session.h5 -o other.h5",
        "design skin.toml -o other.h5",
        "bench testbed -o other.h5",
    ],
)
def test_no_result_takes_the_place_of_a_session(words, files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    shutil.copy("session.h5", "other.h5")
    before = file_hash("other.h5")
    assert main(words.split()) == 2
    assert "other.h5: file: holds a session, which would be lost; give another name" in capsys.readouterr().err
    assert file_hash("other.h5") == before


def test_a_simulated_session_takes_the_place_of_a_simulated_one_only(files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    command = ["simulate", "scene.toml", "-o", "session.h5"]
    with h5py.File("session.h5", "r+") as file:
        file.attrs["simulated"] = np.uint8(0)
    assert main(command) == 2
    assert "session.h5: file: holds a recording, which would be lost; give another name" in capsys.readouterr().err
    with h5py.File("session.h5", "r+") as file:
        file.attrs["simulated"] = np.uint8(1)
    assert main(command) == 0


def test_an_import_takes_the_place_of_an_import_but_of_no_recording(files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    Path("log.csv").write_text("t,f\n" + "\n".join(f"{k / 100},{k % 7}" for k in range(200)) + "\n")
    command = ["import", "csv", "log.csv", "--time", "t:s", "--stream", "force=f:N", "-o"]
    assert main([*command, "imported.h5"]) == 0
    assert main([*command, "imported.h5"]) == 0
    capsys.readouterr()
    with h5py.File("session.h5", "r+") as file:
        file.attrs["simulated"] = np.uint8(0)
    before = file_hash("session.h5")
    assert main([*command, "session.h5"]) == 2
    assert "session.h5: file: holds a recording, which would be lost; give another name" in capsys.readouterr().err
    assert file_hash("session.h5") == before


def test_a_calibration_is_shown_in_one_line(calibration):
    form = r"Calibration\('testbed', 225 presses, '.+', held out by location, RMSE [\d.]+ N\)"
    assert re.fullmatch(form, repr(calibration))


def test_a_calibration_is_not_saved_over_a_session(calibration, files):
    with pytest.raises(SessionError, match="holds a session, which would be lost; give another name"):
        calibration.save(files / "session.h5")
    calibration.save(files / "calibration.h5")
    calibration.save(files / "calibration.h5")
    calib.load_calibration(files / "calibration.h5")


def test_a_recording_is_given_once(files, monkeypatch, capsys):
    """A copy would be held out by its original, and its places by themselves."""
    monkeypatch.chdir(files)
    shutil.copy("session.h5", "copy.h5")
    for again in ("session.h5", "copy.h5"):
        assert main(["calibrate", "session.h5", again, "-o", "new.h5"]) == 2
        assert f"{again}: is the recording of session.h5 again" in capsys.readouterr().err


def renamed(path, copy):
    """A copy of a session with another identity, as one that is written or imported again has."""
    shutil.copy(path, copy)
    with h5py.File(copy, "r+") as file:
        file.attrs["session_id"] = np.bytes_("another one")
    return str(copy)


def test_a_recording_of_another_identity_is_given_once(files, monkeypatch, capsys):
    monkeypatch.chdir(files)
    assert main(["calibrate", "session.h5", renamed("session.h5", "copy.h5"), "-o", "new.h5"]) == 2
    said = "copy.h5: holds the samples of session.h5 again under another session_id; give each recording once"
    assert said in capsys.readouterr().err


def test_presses_that_were_fitted_are_known_in_a_copy_of_another_identity(calibration, bundled, tmp_path):
    for path in bundled:
        with open_session(renamed(path, tmp_path / "copy.h5")) as copy:
            assert calib.evaluate(calibration, copy).held_out_by == ("" if path.stem == "testbed_grid" else "session")


def test_sessions_of_one_bench_are_no_copies(bundled):
    with open_session(bundled[0]) as one, open_session(bundled[1]) as two:
        require_each_once([one, two])


def test_presses_that_were_fitted_are_not_called_held_out(calibration, bundled, capsys, tmp_path):
    calibration.save(tmp_path / "c.h5")
    with open_session(bundled[0]) as one, open_session(bundled[1]) as two:
        fitted = [path for path, s in zip(bundled, (one, two), strict=True) if is_fitted(calibration.provenance, s)]
    (own,) = fitted
    assert main(["evaluate", str(tmp_path / "c.h5"), *map(str, bundled)]) == 0
    told = dict(zip(bundled, capsys.readouterr().out.split("SIMULATED")[1:], strict=True))
    for path, text in told.items():
        assert ("forces not held out" in text) == (path == own)
        assert ("fitted to this session" in text) == (path == own)
        assert ("held out by session" in text) == (path != own)
