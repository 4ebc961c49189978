"""Tables of forces read back are the force maps, to the last bit."""

import csv
import shutil

import numpy as np
import pytest

import calib
from calib.cli import main
from calib.export import csv_tables, export_csv
from calib.session import ArchiveWriter, SessionError

PADS = ("left, arm", "right")
FRAMES = 5


def archive(path, kind="skin-forcemap", **more):
    """A file of forces with these further arrays, and what it holds."""
    rng = np.random.default_rng(0)
    arrays = {"time": np.array([-1_500_000_000, 0, 1, 10**18, 10**18 + 1])}
    if kind == "skin-forcemap":
        arrays |= {name: rng.normal(5, 2, (FRAMES, 2)) for name in ("pad_force", "pad_force_se")}
        arrays |= {"pad_valid": rng.integers(0, 2, (FRAMES, 2)).astype("u1"), "pad_names": np.array(PADS)}
        arrays["pad_force"][2, 0] = np.nan
    else:
        arrays |= {name: rng.normal(5, 2, FRAMES) for name in ("force", "standard_error", "low", "high")}
        arrays |= {"valid": np.array([1, 0, 1, 0, 0], "u1")}
    arrays |= more
    with ArchiveWriter(path, kind, {"time_epoch_utc": "2026-01-31T12:00:00Z"}) as writer:
        for name, values in arrays.items():
            writer.add(name, values, "1")
    return arrays


def table(path):
    """Head and columns of a table; an empty cell is NaN."""
    with open(path, encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    return head, np.array([[float(cell or "nan") for cell in row] for row in rows]).reshape(len(rows), len(head)).T


@pytest.mark.parametrize("block", [2, 4096])
def test_forces_and_contacts_of_each_frame(tmp_path, monkeypatch, capsys, block):
    monkeypatch.setattr(csv_tables, "BLOCK", block)
    place, force = np.full((FRAMES, 2, 2), np.nan), np.full((FRAMES, 2), np.nan)
    place[1, 1], force[1, 1], place[4] = (0.1, 0.2), 7.0, [[0.01, 0.02], [0.03, 0.04]]
    held = archive(tmp_path / "map.h5", contact_position=place, contact_force=force)
    assert main(["export", "csv", str(tmp_path / "map.h5"), "-o", str(tmp_path / "forces.csv")]) == 0
    assert "5 rows, one for each frame\nforces-contacts.csv: 3 rows" in capsys.readouterr().out
    head, columns = table(tmp_path / "forces.csv")
    assert head[:5] == ["time_s", "total_N", "left, arm force_N", "left, arm standard_error_N", "left, arm valid"]
    np.testing.assert_array_equal(columns[1], held["pad_force"].sum(1))
    for k, name in enumerate(("pad_force", "pad_force_se", "pad_valid")):
        np.testing.assert_array_equal(columns[2 + k :: 3].T, held[name], name)
    assert (tmp_path / "forces.csv").read_text().splitlines()[1].startswith("-1.500000000,")
    assert (tmp_path / "forces.csv").read_text().splitlines()[5].startswith("1000000000.000000001,")
    head, columns = table(tmp_path / "forces-contacts.csv")
    assert head == ["time_s", "number", "x_m", "y_m", "force_N"]
    np.testing.assert_array_equal(columns[1:4].T, [[1, 0.1, 0.2], [0, 0.01, 0.02], [1, 0.03, 0.04]])
    np.testing.assert_array_equal(columns[4], [7, np.nan, np.nan])


def test_a_line_break_in_the_name_of_a_pad_splits_no_head(tmp_path):
    archive(tmp_path / "map.h5", pad_names=np.array(["left\nlower", "right\ttop"]))
    calib.export_csv(tmp_path / "map.h5", tmp_path / "f.csv")
    lines = (tmp_path / "f.csv").read_text().splitlines()
    assert len(lines) == FRAMES + 1
    assert lines[0].startswith("time_s,total_N,left?lower force_N,")


def test_contacts_that_are_followed_keep_their_numbers(tmp_path):
    rng = np.random.default_rng(1)
    tracks = {"tracks/time": np.array([0, 0, 1]), "tracks/number": np.array([3, 4, 3])}
    tracks |= {"tracks/position": rng.normal(size=(3, 2))}
    tracks |= {f"tracks/{name}": rng.normal(size=3) for name in ("force", "force_se")}
    archive(tmp_path / "map.h5", **tracks)
    assert calib.export_csv(tmp_path / "map.h5", tmp_path / "f.csv").contacts == {"f-contacts.csv": 3}
    head, columns = table(tmp_path / "f-contacts.csv")
    assert head == ["time_s", "number", "x_m", "y_m", "force_N", "standard_error_N"]
    named = ("number", "position", "force", "force_se")
    np.testing.assert_array_equal(columns[1:].T, np.column_stack([tracks[f"tracks/{name}"] for name in named]))


def test_forces_of_a_log(tmp_path):
    held = archive(tmp_path / "log.h5", "log-forces")
    assert export_csv(tmp_path / "log.h5", tmp_path / "f.csv").contacts == {}
    head, columns = table(tmp_path / "f.csv")
    assert head == ["time_s", "force_N", "standard_error_N", "low_N", "high_N", "valid"]
    for name, column in zip(("force", "standard_error", "low", "high", "valid"), columns[1:], strict=True):
        np.testing.assert_array_equal(column, held[name])


def test_what_holds_no_forces_is_refused_and_nothing_is_left(tmp_path, capsys):
    archive(tmp_path / "other.h5", "skin-calibration")
    with ArchiveWriter(tmp_path / "bare.h5", "skin-forcemap", {}) as writer:
        writer.add("time", np.arange(3), "ns")
    for name, said in {
        "other.h5": "is 'skin-calibration'; name a force map of `jaxeit apply`",
        "bare.h5": "pad_names: missing; write the force map again",
    }.items():
        with pytest.raises(SessionError, match=said):
            export_csv(tmp_path / name, tmp_path / "f.csv")
    assert main(["export", "csv", str(tmp_path / "other.h5"), "-o", str(tmp_path / "other.h5")]) == 2
    assert "other.h5" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bare.h5", "other.h5"]


def test_neither_the_force_map_nor_a_session_is_replaced(tmp_path, bundled):
    archive(tmp_path / "map.h5")
    session = tmp_path / "session.h5"
    shutil.copy(bundled[0], session)
    for output, words in ((tmp_path / "map.h5", "is also an input"), (session, "holds a session")):
        before = output.read_bytes()
        with pytest.raises(SessionError, match=f"{output.name}: file: {words}.*, which would be lost; give another"):
            export_csv(tmp_path / "map.h5", output)
        assert output.read_bytes() == before


@pytest.mark.parametrize("name", ["log.csv", "log-contacts.csv"])
def test_only_tables_of_forces_are_replaced(name, tmp_path, capsys):
    """The second table, which nobody names, takes the place of no other file either."""
    place, force = np.full((FRAMES, 1, 2), 0.1), np.full((FRAMES, 1), 7.0)
    archive(tmp_path / "map.h5", contact_position=place, contact_force=force)
    command = ["export", "csv", str(tmp_path / "map.h5"), "-o", str(tmp_path / "log.csv")]
    assert main(command) == main(command) == 0
    (tmp_path / name).write_text("t,f\n0,1\n")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    capsys.readouterr()
    assert main(command) == 2
    said = f"{name}: file: is no table of forces, and would be lost; give another name for the output"
    assert said in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
