"""A scan through all electrodes at once, by the command line: simulated, checked, calibrated, applied, evaluated."""

import json

import h5py
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.cli import main
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


def test_forces_are_as_with_the_adjacent_scan(sessions, capsys):
    """The pads tell the force with either scan; that of the image alone is as good, and so is the place."""
    found = {}
    for scan in SCANS:
        session, calibration = str(sessions / f"{scan}.h5"), str(sessions / f"cal-{scan}.h5")
        assert main(["check", session]) == 0
        told = capsys.readouterr().out
        assert "reciprocity not tested" in told if scan == "trigonometric" else "reciprocity error" in told
        assert main(["calibrate", session, "-o", calibration]) == 0
        capsys.readouterr()
        assert main(["evaluate", calibration, session, "--json"]) == 0
        found[scan] = json.loads(capsys.readouterr().out)[f"{scan}.h5"]
        assert main(["apply", calibration, session, "-o", str(sessions / f"map-{scan}.h5")]) == 0
        capsys.readouterr()
        assert np.isfinite(read_archive(sessions / f"map-{scan}.h5", "skin-forcemap").arrays["force"]).all()
    through_all, pairs = (found[scan] for scan in SCANS)
    assert through_all["force_rmse"] == pytest.approx(pairs["force_rmse"], rel=0.05)
    assert through_all["force_eit_rmse"] < 1.2 * pairs["force_eit_rmse"]
    assert through_all["localisation_half_mean"] < pairs["localisation_half_mean"]


def test_damaged_terms_are_refused(sessions, tmp_path):
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes((sessions / "trigonometric.h5").read_bytes())
    with h5py.File(damaged, "r+") as file:
        file["device/eit_protocol/term_row"][0] = 999
    with pytest.raises(SessionError, match="no row of the 132 of the pattern"):
        calib.open_session(damaged)
