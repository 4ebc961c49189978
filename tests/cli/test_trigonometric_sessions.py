"""A scan through all electrodes at once, by the command line: simulated, checked, calibrated, applied, evaluated."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.cli import main
from calib.record import PlanError, SimulatedDevice, StopRequest, frame_packets, plan_recording, record_session
from calib.record.plan import plan_from_json
from calib.session import SessionError, read_archive

RING = 0.06 + 0.047 * np.stack([np.cos(a := 2 * np.pi * np.arange(12) / 12), np.sin(a)], 1)
SKIN = f"""
format = "jaxeit-skin"
version = 1
name = "ring"

[sheet]
shape = "rectangle"
size = [0.12, 0.12]
sheet_resistance = 150.0

[electrodes]
kind = "bolt"
radius = 0.003
contact = 1e-6
positions = {RING.round(6).tolist()}

[protocol]
pattern = "SCAN"
current = 1e-3
reading_time = 1e-5

[pressure_sensor]
maximum = 34474.0
accuracy = 86.0

[[pads]]
name = "left"
rectangle = [0.0, 0.0, 0.06, 0.12]

[[pads]]
name = "right"
rectangle = [0.06, 0.0, 0.12, 0.12]
"""
SCENE = """
format = "jaxeit-scene"
version = 1
title = "a scan through all electrodes"
skin = "SCAN.toml"
seed = 3

[bench]
columns = 6
rows = 6
margin = 0.022
forces = [6.0, 12.0]
tip_diameter = 0.02
eit_rate = 10.0
pad_rate = 20.0
hold = 1.0

[[effects]]
type = "LoadSpreading"
width = 0.012

[[effects]]
type = "ContactPiezoresistance"
amplitude = 1.0
half_pressure = 20e3
exponent = 1.0

[[effects]]
type = "Noise"
stream = "eit"
std = 1e-5

[[effects]]
type = "Noise"
stream = "pressure"
std = 5.0
"""
SCANS = ("trigonometric", "adjacent")


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """The folder of one scene simulated with both scans, from the command line."""
    folder = tmp_path_factory.mktemp("scans")
    for scan in SCANS:
        (folder / f"{scan}.toml").write_text(SKIN.replace("SCAN", scan))
        (folder / f"scene-{scan}.toml").write_text(SCENE.replace("SCAN", scan))
        assert main(["simulate", str(folder / f"scene-{scan}.toml"), "-o", str(folder / f"{scan}.h5")]) == 0
    return folder


def calibrate(sessions, name, *options):
    """Calibrate both sessions from the command line, and return their folder."""
    for scan in SCANS:
        assert (
            main(["calibrate", str(sessions / f"{scan}.h5"), "-o", str(sessions / f"{name}-{scan}.h5"), *options]) == 0
        )
    return sessions


@pytest.fixture(scope="module")
def calibrated(sessions):
    """The folder, with calibrations ``cal`` on coarse images."""
    return calibrate(sessions, "cal", "--pixels", "20", "--fidelity", "draft")


@pytest.fixture(scope="module")
def finely_calibrated(sessions):
    """The folder, with calibrations ``fine`` by the default recipe."""
    return calibrate(sessions, "fine")


def test_a_session_holds_the_scan(sessions):
    skin = je.load_skin(sessions / "trigonometric.toml")
    with calib.open_session(sessions / "trigonometric.h5") as session:
        assert session.attrs["format_version"] == "1.1"
        assert session.readings == session.stream("eit").channels == 12 * 11
        np.testing.assert_array_equal(session.pattern, skin.protocol.pattern)
        np.testing.assert_array_equal(session.mixing.toarray(), skin.protocol.mixing.toarray())
    with calib.open_session(sessions / "adjacent.h5") as session:
        assert session.attrs["format_version"] == "1.0"
        assert session.mixing is None


def test_a_device_is_recorded(sessions, tmp_path):
    skin = je.load_skin(sessions / "trigonometric.toml")
    times = range(0, 200_000_000, 10_000_000)  # ns
    frames = 1e-3 * np.random.default_rng(0).standard_normal((20, 132)).astype("f4")  # V
    with SimulatedDevice([frame_packets(1, times, frames)], wait_for=1) as device:
        plan, sources = plan_recording({"eit": device.urls[0]}, skin=skin, title="all electrodes")
        record_session(plan, sources, tmp_path / "recorded.h5", seconds=0.4, stop_request=StopRequest())
    with calib.open_session(tmp_path / "recorded.h5") as session:
        np.testing.assert_array_equal(session.mixing.toarray(), skin.protocol.mixing.toarray())
        found = session.stream("eit").read()
        np.testing.assert_allclose(found, frames[: len(found)], rtol=1e-6)
        assert len(found) > 10


def test_plans_of_journals_keep_the_scan_and_old_ones_open(sessions):
    skin = je.load_skin(sessions / "trigonometric.toml")
    plan, _ = plan_recording({"eit": "tcp://127.0.0.1:1"}, skin=skin, title="all electrodes")
    again = plan_from_json(plan.to_json())
    assert again == plan
    np.testing.assert_array_equal(again.mixing_matrix().toarray(), skin.protocol.mixing.toarray())
    pairs = je.load_skin(sessions / "adjacent.toml")
    old = json.loads(plan_recording({"eit": "tcp://127.0.0.1:1"}, skin=pairs, title="pairs")[0].to_json())
    del old["mixing"]
    assert plan_from_json(json.dumps(old).encode()).mixing is None
    with pytest.raises(PlanError, match="mixing: names no reading from 0 on, or no row of the 132"):
        replace(plan, mixing=((0, 132, 1.0),))


def test_a_scan_too_long_for_a_journal_is_refused(sessions):
    skin = je.load_skin(sessions / "trigonometric.toml")
    plan, _ = plan_recording({"eit": "tcp://127.0.0.1:1"}, skin=skin, title="all electrodes")
    with pytest.raises(PlanError, match="25,001 terms is too long for a journal"):
        replace(plan, mixing=((0, 0, 1.0),) * 25_001)


@pytest.mark.slow
def test_forces_are_as_with_the_adjacent_scan(calibrated, capsys):
    """The pads tell the force with either scan; that of the image alone is as good, and so is the place."""
    found, sessions = {}, calibrated
    for scan in SCANS:
        session, calibration = str(sessions / f"{scan}.h5"), str(sessions / f"cal-{scan}.h5")
        assert main(["check", session]) == 0
        told = capsys.readouterr().out
        assert "reciprocity not tested" in told if scan == "trigonometric" else "reciprocity error" in told
        assert main(["evaluate", calibration, session, "--json"]) == 0
        found[scan] = json.loads(capsys.readouterr().out)[f"{scan}.h5"]
        assert main(["apply", calibration, session, "-o", str(sessions / f"map-{scan}.h5")]) == 0
        capsys.readouterr()
        assert np.isfinite(read_archive(sessions / f"map-{scan}.h5", "skin-forcemap").arrays["force"]).all()
    assert main(["export", "c", str(sessions / "cal-trigonometric.h5"), "-o", str(sessions / "skin.h")]) == 2
    assert "readings of many electrodes" in capsys.readouterr().err
    assert not (sessions / "skin.h").exists()
    through_all, pairs = (found[scan] for scan in SCANS)
    assert through_all["force_rmse"] == pytest.approx(pairs["force_rmse"], rel=0.05)
    assert through_all["force_eit_rmse"] < 1.2 * pairs["force_eit_rmse"]
    assert through_all["localisation_half_mean"] < pairs["localisation_half_mean"]


@pytest.mark.slow
def test_errors_of_forces_hold_the_noise_of_single_readings(calibrated):
    """Curves are fitted to means over parts of presses, which scatter less than readings do."""
    model = calib.load_calibration(calibrated / "cal-adjacent.h5")
    with calib.open_session(calibrated / "adjacent.h5") as session:
        readings = session.stream("pressure")
        raw = readings.read()[readings.time < session.presses.t_press.min()]
    force, error, _ = model.pad_forces(raw - raw.mean(0))
    assert 0.87 < np.mean(np.abs(force) <= model.pads.multiple * error) < 0.97
    assert (np.abs(force) < 3 * np.asarray(model.pads.idle_noise)).mean() > 0.99  # idle pads do not count as loaded


@pytest.mark.slow
@pytest.mark.parametrize("seed", [61, 62, 63])
@pytest.mark.parametrize("scan", SCANS)
def test_each_press_is_one_contact(finely_calibrated, tmp_path, scan, seed):
    """Ten frames a second: between two frames of its onset the force of a press grows severalfold."""
    few = {"seed = 3": f"seed = {seed}", "columns = 6": "columns = 4", "rows = 6": "rows = 4", "[6.0, 12.0]": "[12.0]"}
    text = SCENE.replace("SCAN.toml", str(finely_calibrated / f"{scan}.toml"))
    for old, new in few.items():
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "scene.toml").write_text(text)
    session, output = tmp_path / "session.h5", tmp_path / "map.h5"
    assert main(["simulate", str(tmp_path / "scene.toml"), "-o", str(session)]) == 0
    assert main(["apply", str(finely_calibrated / f"fine-{scan}.h5"), str(session), "-o", str(output), "--track"]) == 0
    found = read_archive(output, "skin-forcemap").arrays
    with calib.open_session(session) as recorded:
        begin, end = recorded.presses.t_press, recorded.presses.t_release
    numbers = [
        set(found["tracks/number"][(found["tracks/time"] >= a) & (found["tracks/time"] <= b)].tolist())
        for a, b in zip(begin, end, strict=True)
    ]
    assert numbers == [{k} for k in range(1, 17)]


def test_damaged_terms_are_refused(sessions, tmp_path):
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes((sessions / "trigonometric.h5").read_bytes())
    with h5py.File(damaged, "r+") as file:
        file["device/eit_protocol/term_row"][0] = 999
    with pytest.raises(SessionError, match="no row of the 132 of the pattern"):
        calib.open_session(damaged)


@pytest.mark.parametrize("lost", ["row_pattern", "term_reading", "term_row", "term_share"])
def test_terms_are_not_read_in_part(sessions, tmp_path, lost):
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes((sessions / "trigonometric.h5").read_bytes())
    with h5py.File(damaged, "r+") as file:
        del file[f"device/eit_protocol/{lost}"]
    with pytest.raises(SessionError, match=f"{lost}: missing"):
        calib.open_session(damaged)


def test_rows_of_sums_are_no_readings(sessions, tmp_path):
    """The scan has as many rows as readings: a reader that does not know of sums would take one for the other."""
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes((sessions / "trigonometric.h5").read_bytes())
    with h5py.File(damaged, "r+") as file:
        protocol = file["device/eit_protocol"]
        assert "pattern" not in protocol
        assert len(protocol["row_pattern"]) == file["streams/eit/voltage"].shape[1]
        protocol["pattern"] = protocol["row_pattern"][()]
    with pytest.raises(SessionError, match="holds pattern and row_pattern"):
        calib.open_session(damaged)


def test_no_proposal_is_trained(sessions, tmp_path, capsys):
    """It would learn to lack an electrode, through which nearly all readings of this scan are driven."""
    assert main(["train", str(sessions / "trigonometric.toml"), "-o", str(tmp_path / "proposal.npz")]) == 2
    assert "a proposal needs one pair that drives" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
