"""Files that an earlier version wrote still open, and mean what they meant.

``early/`` holds a session of twelve presses that version 0.1 simulated at commit 53fec27^, the last one before modules
were sorted into rooms; the calibration that this version made of it, with a correction by location; and two frames with
the forces and maps that this version found in them.
"""

from pathlib import Path

import numpy as np
import pytest

import calib

EARLY = Path(__file__).parent / "early"


@pytest.fixture(scope="module")
def calibration():
    return calib.load_calibration(EARLY / "calibration.h5")


def test_an_early_session_holds_what_was_recorded():
    with calib.open_session(EARLY / "session.h5") as session:
        assert {name: stream.channels for name, stream in session.streams.items()} == {
            "eit": 18,
            "pressure": 2,
            "force": 1,
        }
        assert session.simulated
        presses, force = session.presses, session.stream("force")
        held = [
            np.median(force.read()[(force.time > start) & (force.time < end)])
            for start, end in zip(presses.t_hold0, presses.t_hold1, strict=True)
        ]
    np.testing.assert_allclose(held, np.full(12, 20.0), atol=0.1)


def test_an_early_calibration_finds_the_forces_that_it_found(calibration):
    known = np.load(EARLY / "forces.npz")
    assert calibration.field is not None
    found = calib.force_map(calibration, known["dv"], known["dp"])
    np.testing.assert_allclose(found.force, known["force"], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.map.force, known["map"], rtol=1e-5, atol=1e-9)


def test_an_early_calibration_is_evaluated_and_saved_anew(calibration, tmp_path):
    calibration.save(tmp_path / "now.h5")
    with calib.open_session(EARLY / "session.h5") as session:
        before, after = (
            calib.evaluate(each, session).summary()["force_rmse"]
            for each in (calibration, calib.load_calibration(tmp_path / "now.h5"))
        )
    assert before == after < 2.0  # N, of 20
