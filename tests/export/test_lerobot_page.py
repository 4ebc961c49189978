"""The page on LeRobot does what it says, where LeRobot is installed."""

import re
import shlex
import socket
import subprocess
import sys
from contextlib import contextmanager

import h5py
import numpy as np
import pytest

from calib.cli import main
from tests.test_docs import blocks, follow_commands

FIRST_LINE = 300  # s until a live skin has compiled everything and has measured its rest levels


@pytest.fixture
def page(root, tmp_path, monkeypatch):
    """The blocks of the page by what they do, in a folder with the files that they open."""
    pytest.importorskip("lerobot.datasets.lerobot_dataset")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(root / "plugins" / "lerobot_camera_jaxeit"))
    sessions = root / "data" / "sessions"
    (tmp_path / "session.h5").symlink_to(sessions / "testbed_presses.h5")
    assert main(["calibrate", str(sessions / "testbed_grid.h5"), "-o", "calibration.h5", "--fidelity", "draft"]) == 0
    assert main(["apply", "calibration.h5", "session.h5", "-o", "another.h5"]) == 0
    texts = [text for *_, text in blocks(root / "docs" / "lerobot.md")]
    return dict(zip(("export", "read", "serve", "see"), texts, strict=True))


@contextmanager
def live(command):
    """The live skin of the page, which replays a recording; gives the port of its lines once it has sent one."""
    words = shlex.split(command.replace("URL", "replay://session.h5"))
    words[words.index("--publish") + 1] = "0"
    program = [sys.executable, "-m", "calib.cli", *words[1:], "--port", "0"]
    with subprocess.Popen(program, stderr=subprocess.PIPE, text=True) as process:
        try:
            port = int(
                re.search(r"lines of JSON at [\d.]+:(\d+)", process.stderr.readline() + process.stderr.readline())[1]
            )
            with socket.create_connection(("127.0.0.1", port), FIRST_LINE) as lines:
                assert lines.recv(1)
            yield port
        finally:
            process.terminate()
            process.wait(20)


def run(program, name):
    names: dict = {}
    exec(compile(program, name, "exec"), names)
    return names


@pytest.mark.slow
def test_a_dataset_is_written_and_lerobot_reads_it(page):
    follow_commands(page["export"], [])
    dataset = run(page["read"], "lerobot.md")["dataset"]
    assert dataset.num_episodes == 2
    with h5py.File("forcemap.h5") as file:
        forces = file["pad_force"][()].astype("f4")
    found = dataset[100]["observation.state"].numpy()
    assert (np.abs(forces - found).max(1) == 0).any()


@pytest.mark.slow
def test_a_live_skin_is_a_camera(page):
    cameras = pytest.importorskip("lerobot.cameras")
    draccus, yaml = pytest.importorskip("draccus"), pytest.importorskip("yaml")
    commands = page["serve"].replace("\\\n", " ")
    served = next(line for line in commands.splitlines() if line.startswith("jaxeit live"))
    with live(served) as port:
        names = run(page["see"].replace("8767", str(port)), "lerobot.md")
    assert names["picture"].ndim == 3
    assert names["picture"].dtype == np.uint8
    assert names["forces"].shape == (4,)
    given = yaml.safe_load(re.search(r'--robot\.cameras="(.*?)"', commands, re.DOTALL)[1])
    made = draccus.decode(dict[str, cameras.CameraConfig], given)
    assert made["skin"] == names["SkinCameraConfig"](
        **{key: value for key, value in given["skin"].items() if key != "type"}
    )
