"""Logs of an array of channels: those that carry no information are left out, and named."""

from datetime import UTC, datetime

import numpy as np
import pytest

from calib.calibration.logs import fit_session, render_log, save_logs
from calib.fitting.curves import Linear
from calib.fitting.results import FitError
from calib.session import SessionFacts, SessionWriter, StreamFacts, open_session, read_archive

RATE = 50.0  # Hz


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


def test_channels_without_information_are_left_out_with_a_note(array, tmp_path):
    force, values = array
    kept = np.delete(values, [2, 5, 8], 1)
    with open_session(write_log(tmp_path / "broken.h5", force, broken(values))) as session:
        found = fit_session(session, [Linear()])
    with open_session(write_log(tmp_path / "kept.h5", force, kept)) as session:
        other = fit_session(session, [Linear()])
    assert found.note == "channels left out: dead 2; stuck 5; silent 8"
    assert other.note == ""
    assert found.fit.missing == 0
    np.testing.assert_allclose(found.fit.predicted, other.fit.predicted, rtol=1e-9)
    assert found.fit.held_out.rmse < 0.1
    assert "note: channels left out" in render_log("broken", found)
    save_logs({"broken": found}, tmp_path / "curves.h5")
    assert read_archive(tmp_path / "curves.h5", "pressure-force-curves").arrays["logs/0/parameters"].shape == (1,)


def test_the_held_out_half_does_not_decide_which_channels_are_used(array, tmp_path):
    force, values = array
    late = values.copy()
    late[1600:, 3] = 101.0
    with open_session(write_log(tmp_path / "late.h5", force, late)) as session:
        assert fit_session(session, [Linear()]).note == ""


def test_an_array_of_which_no_channel_follows_the_force_is_refused(array, tmp_path):
    force, values = array
    noise = np.random.default_rng(2).normal(size=values.shape)
    with (
        open_session(write_log(tmp_path / "noise.h5", force, noise)) as session,
        pytest.raises(FitError, match=r"pressure: none of 10 channels follows the force; see jaxeit check"),
    ):
        fit_session(session, [Linear()])
