"""`jaxeit design`: the skin it writes, and a session that is simulated and checked with it."""

import re
import signal

import numpy as np
import pytest

import calib
import jaxeit as je
from calib.cli import main
from calib.cli.signals import Terminated
from calib.report.figures import parts

SKIN = """
format = "jaxeit-skin"
version = 1
name = "mine"          # a comment that stays

[sheet]
shape = "rectangle"
size = [0.12, 0.08]
sheet_resistance = 150.0

[electrodes]
kind = "point"
positions = [[0.02, 0.02], [0.06, 0.02], [0.1, 0.02], [0.1, 0.06], [0.06, 0.06], [0.02, 0.06]]

[protocol]
pattern = "adjacent"   # eighteen readings
current = 1e-3

[[pads]]
name = "all"
rectangle = [0.0, 0.0, 0.12, 0.08]
"""
SCENE = """
format = "jaxeit-scene"
version = 1
title = "designed"
skin = "better.toml"
seed = 1

[bench]
columns = 2
rows = 2
margin = 0.025
forces = [8.0]
blank = 3.0
rest = 1.0
ramp = 0.2
hold = 1.0
release = 0.2
recovery = 0.5
eit_rate = 20.0
pad_rate = 50.0

[[effects]]
type = "ContactPiezoresistance"

[[effects]]
type = "Noise"
stream = "eit"
std = 1e-5
"""


def test_a_designed_skin_is_simulated_and_checked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(SKIN)
    assert main(["design", "mine.toml", "-o", "better.toml", "--readings", "12", "--picture", "map.png"]) == 0
    told = capsys.readouterr().out
    better = je.load_skin("better.toml")
    assert better.protocol.readings == 12
    assert '"mine"          # a comment that stays' in better.toml
    before, after = map(float, re.search(r"error of place, mean, mm +(\S+) +(\S+)", told).groups())
    assert after < before
    bound = float(re.search(r"less than (\S+) mm", told)[1])
    assert bound <= float(re.search(r"by the criterion (\S+) mm", told)[1])
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    (tmp_path / "scene.toml").write_text(SCENE)
    assert main(["simulate", "scene.toml", "-o", "session.h5"]) == 0
    assert main(["check", "session.h5"]) == 0
    told = capsys.readouterr().out
    assert "reciprocity not tested" in told
    assert "Nothing wrong was found" in told
    with calib.open_session("session.h5") as session:
        np.testing.assert_array_equal(je.skin.parse_skin(session.skin_toml).protocol.pattern, better.protocol.pattern)


@pytest.mark.slow
def test_a_design_for_several_sense_channels(tmp_path, monkeypatch, capsys):
    """Six times of a reading, three readings at once; the session's readings have the times that the skin says."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(SKIN)
    assert main(["design", "mine.toml", "-o", "better.toml", "--readings", "6", "--sense-channels", "3"]) == 0
    told = capsys.readouterr().out
    assert re.search(r"times of reading, 3 at once +6 +6\n", told)
    assert re.search(r"frames per second +16,667 +16,667\n", told)
    better = je.load_skin("better.toml")
    assert (better.protocol.sense_channels, better.protocol.readings) == (3, 18)
    assert better.protocol.frame_time == pytest.approx(6e-5)
    (tmp_path / "scene.toml").write_text(SCENE)
    assert main(["simulate", "scene.toml", "-o", "session.h5"]) == 0
    with calib.open_session("session.h5") as session:
        np.testing.assert_allclose(session.offset, np.repeat(np.arange(6) * 1e-5, 3))
    assert main(["design", "better.toml", "-o", "again.toml", "--sense-channels", "1", "--readings", "12"]) == 0
    assert "sense_channels" not in (tmp_path / "again.toml").read_text()


@pytest.mark.slow
def test_a_design_moves_electrodes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(SKIN)
    options = ["--readings", "12", "--move", "--margin", "0.012", "--keep-out", "0.06,0.04,0.01"]
    assert main(["design", "mine.toml", "-o", "better.toml", *options, "--picture", "map.png"]) == 0
    told = capsys.readouterr().out
    before, after = je.load_skin("mine.toml"), je.load_skin("better.toml")
    far = np.linalg.norm(after.electrode_positions - before.electrode_positions, axis=1)
    assert f"electrodes moved by {1e3 * far.mean():.3g} mm on average" in told
    assert after.protocol.readings == 12
    first, second = map(float, re.search(r"error of place, mean, mm +(\S+) +(\S+)", told).groups())
    assert second < 0.6 * first
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_a_design_that_is_ended_during_its_picture_writes_nothing(tmp_path, monkeypatch, capsys):
    def ended(*_):
        raise Terminated(signal.SIGTERM)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(parts, "write_figure", ended)
    (tmp_path / "mine.toml").write_text(SKIN)
    assert main(["design", "mine.toml", "-o", "better.toml", "--readings", "12", "--picture", "map.png"]) == 143
    told = capsys.readouterr()
    assert "nothing was written" in told.err
    assert "written after" not in told.out
    assert {path.name for path in tmp_path.iterdir()} == {"mine.toml"}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["design", "testbed", "-o", "b.toml", "--relative-noise", "7"],
            "--relative-noise: 7: give a number from 0 to 1",
        ),
        (
            ["recalibrate", "c.h5", "s.h5", "-o", "n.h5", "--drift", "1e9"],
            "--drift: 1e9: give a number above zero, at m",
        ),
    ],
)
def test_parts_and_percents_are_no_multiples(capsys, words, said):
    with pytest.raises(SystemExit, match="2"):
        main(words)
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--margin", "0.01"], "--margin is about electrodes that move; add --move"),
        (["--asymmetric"], "--asymmetric is about electrodes that move; add --move"),
        (["--move", "--distance", "0.05"], "the electrodes break the limits where they sit now, by 10 mm"),
        (["--readings", "46"], "there are 45 candidates"),
        (["--rate", "1e6"], "a reading alone takes 1e-05 s; give a lower rate"),
        (["--criterion", "best"], '--criterion: no criterion \'best\'; give one of "place-error", "d-optimal"'),
        (["--criterion", "place-error:power=-1"], "power"),
        (["--readings", "46", "--switch", "0", "--relative-noise", "0"], "there are 45 candidates"),
        (["--readings", "12", "--width", "1e-9"], "--width 1e-09: too narrow for the model's mesh; give at least 0.00"),
        (["--readings", "12", "--width", "0.09"], "--width 0.09: wider than the sheet, which measures 0.08 m; give"),
        (["--readings", "12", "--noise", "1"], "--noise 1: more than the largest reading, 0.0"),
        (["--readings", "12", "--noise", "0.03"], "a scan of 12 readings would have a mean error of place of 1"),
        (["--switch", "1e9"], "--switch 1e+09: a frame then has the time of 6e+09 readings, and there are 45"),
        (["--rate", "1"], "--rate 1: a frame then has the time of 100000 readings, and there are 45; give more, or"),
        (["--readings", "12", "--picture", "dx.toml"], "dx.toml: give a name that ends in .png, .pdf or .svg"),
        (["--readings", "9", "--switch", "9"], "before one drive has settled"),
    ],
)
def test_a_wrong_design_is_one_line(tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(SKIN)
    assert main(["design", "mine.toml", "-o", "better.toml", *options]) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not (tmp_path / "better.toml").exists()
