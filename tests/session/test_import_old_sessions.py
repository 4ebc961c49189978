"""Sessions that plain h5py or MATLAB wrote: refused in place, with the command that converts them; then converted."""

import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from calib.cli import main
from calib.session import SessionError, open_session
from calib.session.importers import child

TIME = np.arange(50) * 10_000_000
FORCE = np.sin(np.arange(50))[:, None]


@pytest.fixture
def here(monkeypatch):
    """Convert in this process: starting another takes most of the time of a test."""
    monkeypatch.setattr(child, "_asked", child.answer)


def written(path: Path, **options: str) -> Path:
    """A session as a user writes it with h5py by its description: oldest layout, texts of variable length."""
    root = {"format": "skin-session", "format_version": "1.0", "session_id": "mine", "title": "µ by hand"}
    root |= {"time_epoch_utc": "2025-01-31T12:00:00Z", "created_utc": "2025-01-31T12:00:00Z"}
    with h5py.File(path, "w", **options) as file:
        file.attrs.update(root | {"complete": True, "simulated": np.array([0]), "recovered": False})
        device = file.create_group("device")
        device.attrs.update({"skin": "", "skin_toml": ""})
        force = file.create_group("streams/force")
        force.attrs.update({"nominal_rate_hz": 100, "signal": "force", "clock": b"host", "transport": "h5py"})
        force["time"] = TIME[None] if options else TIME  # MATLAB has no vectors
        force["force"] = FORCE
        force["force"].attrs["units"] = "N"
        force["force"].attrs["long_name"] = "load"
        force["status"] = np.zeros(50, np.uint16)
        events = file.create_group("events")
        events["time"], events["code"] = TIME[:2], np.array([1, 2], np.uint16)
        events["label"] = ["begin", "Prüfung"]
    return path


@pytest.mark.parametrize("options", [{}, {"libver": ("v110", "v110")}], ids=["h5py", "MATLAB, current layout"])
def test_a_session_of_plain_h5py_is_refused_and_converted(options, tmp_path, capsys):
    path = written(tmp_path / "old.h5", **options)
    assert main(["check", str(path)]) == 2
    assert "jaxeit import hdf5" in capsys.readouterr().err
    assert main(["import", "hdf5", str(path), "-o", str(tmp_path / "new.h5")]) == 0
    said = capsys.readouterr().out
    assert "force: force in N, 50 x 1, about 100 Hz" in said
    assert "warning" not in said
    with open_session(tmp_path / "new.h5") as session:
        np.testing.assert_array_equal(session.streams["force"].read(), FORCE)
        np.testing.assert_array_equal(session.streams["force"].time, TIME)
        assert (session.title, session.complete, session.simulated) == ("µ by hand", True, False)
        assert session.events.label == ("begin", "Prüfung")


def test_nothing_outside_the_file_is_copied(here, tmp_path, capsys):
    path = written(tmp_path / "old.h5")
    with h5py.File(tmp_path / "secret.h5", "w") as other:
        other["force"] = FORCE
    (tmp_path / "raw").write_bytes(bytes(400))
    with h5py.File(path, "r+") as file:
        file["streams/stolen"] = h5py.ExternalLink("secret.h5", "/")
        file["streams/alias"] = h5py.SoftLink("/streams/force")
        file.create_dataset("truth", (50,), "f8", external=[(str(tmp_path / "raw"), 0, 400)])
        layout = h5py.VirtualLayout((50, 1), "f8")
        layout[...] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "force", (50, 1))
        file.create_virtual_dataset("borrowed", layout)
        file["pairs"] = np.zeros(3, [("a", "f8"), ("b", "f8")])
    assert main(["import", "hdf5", str(path), "-o", str(tmp_path / "new.h5")]) == 0
    said = capsys.readouterr().out
    for name in ("/streams/stolen", "/streams/alias", "/truth", "/borrowed", "/pairs"):
        assert f"warning: {name} was left out" in said
    with h5py.File(tmp_path / "new.h5") as file:
        assert set(file) == {"device", "events", "streams"}
        assert set(file["streams"]) == {"force"}


@pytest.mark.parametrize("damage", ["no session", "no units", "cut", "claims", "times back"])
def test_what_cannot_be_converted_ends_in_one_line(damage, here, tmp_path, capsys):
    path = written(tmp_path / "old.h5")
    with h5py.File(path, "r+") as file:
        if damage == "no session":
            del file.attrs["format"]
        if damage == "no units":
            del file["streams/force/force"].attrs["units"]
        if damage == "claims":
            file.create_dataset("huge", (2**40,), "f8", chunks=(2**16,))
        if damage == "times back":
            del file["streams/force/time"]
            file["streams/force/time"] = TIME.astype(float)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:3000])
    before = set(os.listdir(tmp_path))
    assert main(["import", "hdf5", str(path), "-o", str(tmp_path / "new.h5")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("jaxeit: old.h5: ")
    assert set(os.listdir(tmp_path)) == before


def test_the_errors_of_open_session_say_what_converts_a_file(tmp_path):
    with pytest.raises(SessionError, match=r"jaxeit import hdf5 old\.h5 -o session\.h5"):
        open_session(written(tmp_path / "old.h5"))
