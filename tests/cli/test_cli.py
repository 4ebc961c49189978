"""The command line: what it prints, how it exits, and one clear line for every wrong input."""

import argparse
import html
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from calib.calibration import Calibration
from calib.cli import COMMANDS, main
from calib.cli.commands.calibrations import live_command
from calib.cli.terminal import say
from calib.presses import Processing
from calib.session import Session
from jaxeit import load_skin
from jaxeit.contacts import LoadSettings
from jaxeit.tracking import TrackerSettings

from ..helpers import stand_in


@pytest.fixture(scope="module")
def grid_file(bundled):
    return next(path for path in bundled if path.stem == "testbed_grid")


def test_the_command_is_also_a_module():
    done = subprocess.run([sys.executable, "-m", "jaxeit", "--version"], capture_output=True, text=True, check=True)
    assert re.fullmatch(r"jaxeit \d+\.\d+\.\d+\n", done.stdout)


@pytest.mark.parametrize(
    ("words", "status"), [("--version >&-", 0), ("check nothing.h5 2>&-", 2), ("check nothing.h5 <&- >&- 2>&-", 2)]
)
def test_closed_standard_streams_change_no_status(words, status):
    command = ["sh", "-c", f'"$0" -m jaxeit {words}', sys.executable]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert "Traceback" not in done.stderr + done.stdout


@pytest.fixture(scope="module")
def presses_file(bundled):
    return next(path for path in bundled if path.stem == "testbed_presses")


@pytest.fixture(scope="module")
def calibrated(grid_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    assert main(["calibrate", str(grid_file), "-o", str(folder / "new" / "calibration.h5"), "--pixels", "20"]) == 0
    return folder / "new" / "calibration.h5"


def test_evaluate_as_text_and_json(calibrated, presses_file, capsys):
    assert main(["evaluate", str(calibrated), str(presses_file)]) == 0
    text = capsys.readouterr().out
    assert "SIMULATED" in text
    assert "held out by session" in text
    assert main(["evaluate", str(calibrated), str(presses_file), "--json"]) == 0
    first = capsys.readouterr().out
    assert json.loads(first)["testbed_presses.h5"]["presses"] == 4
    main(["evaluate", str(calibrated), str(presses_file), "--json"])
    assert capsys.readouterr().out == first


def test_apply(calibrated, presses_file, tmp_path, capsys):
    assert main(["apply", str(calibrated), str(presses_file), "-o", str(tmp_path / "map.h5")]) == 0
    assert "4680 force maps" in capsys.readouterr().out
    assert (tmp_path / "map.h5").exists()


def test_a_log_without_eit(tmp_path, capsys):
    t = np.arange(0, 20, 0.01)
    force = 10 * (1 - np.cos(t))
    rows = np.column_stack([1e3 * t, force, force * 100 + np.random.default_rng(0).normal(size=len(t))])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",")
    log, session = str(tmp_path / "log.csv"), str(tmp_path / "log.h5")
    streams = ["--stream", "force=1:N", "--stream", "pressure=2:Pa"]
    assert main(["import", "csv", log, "--time", "0:ms", *streams, "-o", session]) == 0
    assert main(["calibrate", session, "-o", str(tmp_path / "curve.h5")]) == 0
    out = capsys.readouterr().out
    assert "slope 0.01 " in out
    assert "second half, by the model of the first: 1000 samples" in out
    assert main(["evaluate", str(tmp_path / "curve.h5"), session]) == 0
    assert "within the 90 % interval" in capsys.readouterr().out


def test_simulate_refuses_a_wrong_scene(tmp_path, root, capsys):
    text = (root / "data" / "sessions" / "testbed_grid.toml").read_text()
    (tmp_path / "scene.toml").write_text(text.replace("columns = 15", "colums = 15"))
    assert main(["simulate", str(tmp_path / "scene.toml"), "-o", str(tmp_path / "s.h5")]) == 2
    assert "columns: missing" in capsys.readouterr().err
    assert not (tmp_path / "s.h5").exists()


def _csv(path):
    path.write_text("1,2,3\n" * 100)


def _truncated(path, whole):
    path.write_bytes(whole.read_bytes()[:300_000])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p, w: None, "does not exist"),
        (lambda p, w: p.write_bytes(b""), "empty"),
        (lambda p, w: _truncated(p, w), ""),
        (lambda p, w: _csv(p), "jaxeit import csv"),
        (lambda p, w: p.mkdir(), "folder"),
    ],
    ids=["missing", "empty", "truncated", "foreign", "folder"],
)
@pytest.mark.parametrize("command", ["check", "calibrate"])
def test_a_file_that_is_no_session_is_one_line_and_status_2(make, message, command, grid_file, tmp_path, capsys):
    path = tmp_path / "session.h5"
    make(path, grid_file)
    extra = ["-o", str(tmp_path / "c.h5")] if command == "calibrate" else []
    assert main([command, str(path), *extra]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxeit: session.h5")
    assert error.count("\n") == 1
    assert message in error
    assert not (tmp_path / "c.h5").exists()


def test_a_session_is_not_a_calibration(grid_file, presses_file, capsys):
    assert main(["evaluate", str(grid_file), str(presses_file)]) == 2
    error = capsys.readouterr().err
    assert "skin-calibration" in error
    assert error.count("\n") == 1


def test_a_low_pass_beyond_the_frame_rate(grid_file, tmp_path, capsys):
    assert main(["calibrate", str(grid_file), "-o", str(tmp_path / "c.h5"), "--low-pass", "50"]) == 2
    error = capsys.readouterr().err
    assert "eit" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("simulat scene.toml", "argument COMMAND: no 'simulat'; did you mean 'simulate'? (jaxeit --help)"),
        ("calibrate s.h5 -o c.h5 --recipie=r.toml", "--recipie: not known; did you mean '--recipe'? (jaxeit calibrate"),
        ("export mcapp c.h5", "argument FORMAT: no 'mcapp'; did you mean 'mcap'? (jaxeit export --help)"),
        ("calibrate s.h5", "the following arguments are required: -o/--output (jaxeit calibrate --help)"),
        ("doctor thoroughly", "thoroughly: not known (jaxeit doctor --help)"),
    ],
)
def test_arguments_that_are_not_known_end_in_one_line(line, message, capsys):
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    error = capsys.readouterr().err
    assert ended.value.code == 2
    assert message in error
    assert error.count("\n") == 1


def test_check_of_a_skin_file(tmp_path, skin, capsys):
    path = tmp_path / "mine.toml"
    path.write_text(skin.toml)
    assert main(["check", str(path)]) == 0
    said = capsys.readouterr().out
    assert f"{path}: skin testbed, 200 x 200 mm" in said
    assert "25 electrodes; pads: lower left, lower right, upper left, upper right\n550 readings in 5.5 ms; " in said
    assert main(["check", str(path), "--json"]) == 2
    assert "leave out --json" in capsys.readouterr().err
    path.write_text(skin.toml.replace("radius = 0.003", "radius = 0.03", 1))
    assert main(["check", str(path)]) == 2
    assert f"{path}: electrode 0 (disc at (20.00, 20.00) mm) of radius 30.00 mm is" in capsys.readouterr().err


def test_check_of_a_skin_file_says_what_can_hardly_be(tmp_path, skin, capsys):
    rows = "rows = [[0, 1, 2, 3], [1, 2, 3, 4], [0, 1, 2, 3]]"
    aside = skin.toml.replace('pattern = "adjacent"', rows).replace("[0.1, 0.1, 0.2, 0.2]", "[0.05, 0.1, 0.2, 0.2]")
    (tmp_path / "mine.toml").write_text(aside)
    assert main(["check", str(tmp_path / "mine.toml")]) == 0
    said = capsys.readouterr().out
    assert "1 of 2 readings are taken more than once, as that of electrodes 0, 1, 2, 3" in said
    assert "50 % of pad 'upper left' or 'upper right' lie within the other one" in said
    assert "unless the pads do overlap: each then has an equal share of the image there" in " ".join(said.split())
    assert "Nothing wrong" not in said


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("sheet_resistance = ", "sheet_resistance = 1e9 # ", "no signal above 100 V"),
        ("sheet_resistance = ", "sheet_resistance = 1e-8 # ", "no signal below 1 nV"),
        ("current = ", "current = 1e6 # ", "no signal above 100 V"),
        ("current = ", "current = 1.0 # ", "the drive current is 1 A; scans of skins drive some milliamperes"),
    ],
)
def test_check_of_a_skin_file_warns_of_voltages_that_nothing_measures(old, new, said, tmp_path, skin, capsys):
    (tmp_path / "mine.toml").write_text(skin.toml.replace(old, new, 1))
    assert main(["check", str(tmp_path / "mine.toml")]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert said in told
    assert "Nothing wrong" not in told


def test_names_reach_the_terminal_without_control_characters(tmp_path, skin, capsys):
    name = r'name = "a\nb\u001b[31mred\u202e"'
    path = tmp_path / "mine.toml"
    path.write_text(skin.toml.replace('name = "testbed"', name, 1).replace('"lower left"', r'"le\nft\u001b"', 1))
    assert main(["check", str(path)]) == 0
    said = capsys.readouterr().out
    assert "skin a?b?[31mred?, 200 x 200 mm\n" in said
    assert "pads: le?ft?, lower right" in said
    assert main(["check", str(tmp_path / "no\nsuch\x1b.toml")]) == 2
    assert "no such?.toml: no such file" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["check", str(path), "--al\x1b\u202e"])
    assert "--al??: not known" in capsys.readouterr().err
    say("a skin\nb\x1b\u202e")
    assert capsys.readouterr().err == "jaxeit: a skin b??\n"


def test_a_comma_in_the_name_of_a_pad_does_not_look_like_two_pads(tmp_path, skin, capsys):
    path = tmp_path / "mine.toml"
    path.write_text(skin.toml.replace('"lower left"', '"left, lower"', 1))
    assert main(["check", str(path)]) == 0
    assert "pads: 'left, lower', 'lower right', 'upper left', 'upper right'" in capsys.readouterr().out
    page = html.unescape(load_skin(path)._repr_html_())
    assert "'left, lower', 'lower right', 'upper left', 'upper right'" in page


def test_the_empty_name_of_an_output_is_refused_before_the_work(capsys):
    assert main(["apply", "nowhere.h5", "nothing.h5", "-o", ""]) == 2
    assert "the name of an output is empty; give a file name" in capsys.readouterr().err


def test_a_full_disk_says_what_to_do_where_no_file_is_known():
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "calib.cli", "--version"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert "the output cannot be written (No space left on device); free space on the disk" in done.stderr


def test_check_of_the_bundled_sessions(bundled, capsys):
    assert main(["check", *map(str, bundled)]) == 0
    assert "SIMULATED" in capsys.readouterr().out


def test_an_output_that_cannot_be_written_is_said_at_once(grid_file, tmp_path, capsys):
    assert main(["calibrate", str(grid_file), "-o", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err
    scene = str(grid_file.with_suffix(".toml"))
    assert main(["simulate", scene, "-o", str(tmp_path)]) == 2
    assert main(["simulate", str(grid_file), "-o", str(tmp_path / "s.h5")]) == 2
    assert "is not text; give a TOML file" in capsys.readouterr().err


def test_no_command_prints_the_commands_as_an_error(capsys):
    assert main([]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert all(command in err for command in COMMANDS)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["ideal"], "give either -o SESSION.h5 to simulate, also with --serve, or"),
        (
            ["ideal", "--explain", "-o", "s.h5"],
            "give either -o SESSION.h5 to simulate, also with --serve, or",
        ),
        (["ideel", "--explain"], "ideel: no such scene file or preset; presets: broken_electrode"),
        (["testbed", "--data-set", "3", "--serve", "-o", "s.h5"], "--serve are for scenes"),
    ],
)
def test_simulate_says_what_it_needs(words, message, capsys):
    assert main(["simulate", *words]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_scene_served_as_a_device(presses_file, tmp_path):
    """A session that is there is played at local ports until interrupted; what listens there gets frames."""
    path = shutil.copy(presses_file, tmp_path / "s.h5")
    command = [sys.executable, "-m", "calib.cli", "simulate", "ideal", "-o", str(path), "--serve"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as serving:
        try:
            said = serving.stdout.readline()
            port = int(re.search(r"--eit tcp://127\.0\.0\.1:(\d+)", said)[1])
            with socket.create_connection(("127.0.0.1", port), timeout=10) as link:
                assert link.recv(4096)
            serving.send_signal(signal.SIGINT)
            assert serving.wait(20) == 0
        finally:
            serving.kill()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tracker", "most=0"], "TrackerSettings: most is 0; give at least 1, a whole number"),
        (["--tracker", "mots=5"], "--tracker mots=5: mots: unknown key; did you mean 'most'?"),
        (["--tracker", "5"], "--tracker 5: 5: unknown key; known: acceleration"),
        (["--no-learn"], "--no-learn: it is about contacts that are followed; add --track"),
        (["--forget", "0.1"], "--forget: it is about contacts that are followed; add --track"),
        (["--depth", "0.01"], "--depth: it is about contacts that are followed; add --track"),
        (["--track", "--depth", "-0.01"], "LoadSettings: depth is -0.01 m; give 0 to 1 m"),
        (["--track", "--forget", "1"], "TrackerSettings: forgetting is 1; give 0 to less than 1"),
        (["--track", "--forget", "nan"], "TrackerSettings: forgetting is nan; give 0 to less than 1"),
        (["--track", "--forget", "-0.1"], "TrackerSettings: forgetting is -0.1; give 0 to less than 1"),
        (["--track", "--forget", "0.1", "--no-learn"], "forgetting is 0.1, but a layer that is not to learn stays"),
        (["--tracker", "learn=no"], "learn"),
        (["--loads", "1", "--load-settings", "width=12"], "LoadSettings: width is 12 m"),
        (["--load-settings", "width=0.01"], "--load-settings: it is about fits of loads; add --loads"),
        (["--loads", "1", "--round-tips", "--load-settings", "width=0.01"], "give one of them"),
    ],
)
def test_settings_of_contacts_that_cannot_be(tmp_path, capsys, words, message):
    assert main(["apply", "c.h5", "s.h5", "-o", str(tmp_path / "f.h5"), *words]) == 2
    assert message in capsys.readouterr().err


def test_settings_of_contacts_reach_apply_and_live(tmp_path, monkeypatch):
    given = {}
    calibration = tmp_path / "c.h5"
    known = stand_in(Calibration, processing=Processing())
    monkeypatch.setattr("calib.calibration.load_calibration", lambda path: known)
    monkeypatch.setattr("calib.session.open_session", lambda path: nullcontext(stand_in(Session, stream=lambda *_: [])))
    monkeypatch.setattr("calib.calibration.apply", lambda *_, **options: given.update(options))
    words = ["--tracker", "most=5", "--loads", "1", "--load-settings", "width=0.01,coat=0.1"]
    assert main(["apply", str(calibration), "s.h5", "-o", str(tmp_path / "f.h5"), *words]) == 0
    assert given["track"] == TrackerSettings(most=5)
    assert given["load_settings"] == LoadSettings(width=0.01, coat=0.1)
    parser = argparse.ArgumentParser()
    live_command.add_arguments(parser)
    live = ["--calibration", "c.h5", "--pressure", "p"]
    deep = replace(TrackerSettings().loads, depth=0.009)
    follow = {
        (): False,
        ("--track",): True,
        ("--tracker", "most=4"): TrackerSettings(most=4),
        ("--track", "--no-learn"): TrackerSettings(learn=False),
        ("--tracker", "most=4,learn=false"): TrackerSettings(most=4, learn=False),
        ("--tracker", "most=4", "--no-learn"): TrackerSettings(most=4, learn=False),
        ("--track", "--forget", "0.2"): TrackerSettings(forgetting=0.2),
        ("--tracker", "most=4", "--depth", "0.009"): TrackerSettings(most=4, loads=deep),
        ("--tracker", "most=4,forgetting=0.3"): TrackerSettings(most=4, forgetting=0.3),
    }
    for more, track in follow.items():
        assert live_command._settings(parser.parse_args([*live, *more])).track == track
