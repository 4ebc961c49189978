"""A disk that is really full: a small file system of its own, where that can be had. One line, not 0, nothing half."""

import contextlib
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from calib import open_session
from calib.cli import main
from calib.record.device import SimulatedDevice, frame_packets

S = 1_000_000_000
SCENE = """
format = "jaxeit-scene"
version = 1
skin = "testbed"
title = "a few presses"
seed = 1
[bench]
sites = [[0.043, 0.052]]
tip_diameter = 0.02
forces = [20.0]
blank = 1.0
eit_rate = 100.0
pad_rate = 200.0
[[effects]]
type = "Noise"
stream = "eit"
std = 1e-6
"""


@pytest.fixture
def small(tmp_path):
    """Make a file system of some kB, at a folder; skip where only root may."""
    with contextlib.ExitStack() as stack:

        def make(kilobytes):
            folder = tmp_path / "small"
            folder.mkdir()
            command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(folder)]
            try:
                done = subprocess.run(command, capture_output=True, check=False, timeout=20)
            except OSError:
                pytest.skip("there is no mount")
            if done.returncode:
                pytest.skip("a file system cannot be mounted here")
            stack.callback(subprocess.run, ["umount", str(folder)], check=True, timeout=20)
            return folder

        yield make


def said(*arguments):
    """Status and standard error of a command, alone in a process."""
    command = [sys.executable, "-m", "calib.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    return done.returncode, done.stderr.splitlines()


def test_a_recording_ends_when_the_disk_is_full_and_is_all_there(small, tmp_path, hard):
    folder = small(300)
    times = [n * S // 1000 for n in range(20_000)]
    stream = frame_packets(2, times, (np.full(64, n, "f4") for n in range(len(times))))
    with SimulatedDevice([stream]) as device:
        url = f"{device.urls[0]}?channels=64"
        status, lines = said("record", "--pressure", url, "-o", folder / "s.h5", "--seconds", 30)
    assert (status, len(lines)) == (2, 1), lines
    assert "No space left" in lines[0]
    assert "jaxeit recover" in lines[0]
    assert os.listdir(folder) == ["s.h5.part"]
    output = tmp_path / "recovered.h5"
    assert main(["recover", str(folder / "s.h5.part"), "-o", str(output)]) == 0
    with open_session(output) as session:
        stream = session.stream("pressure")
        seq = stream.seq.astype(int)
        assert len(seq) > 500
        assert (np.diff(seq) == 1).all()
        np.testing.assert_array_equal(stream.read()[:, 0], seq)
    told = "one line, exit 2, every record written before is recovered"
    hard("fault 4: disk full while recording", "a file system of 300 kB", beyond=told)


def test_a_recording_does_not_begin_in_a_folder_that_is_read_only(small, hard):
    folder = small(300)
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True, timeout=20)
    status, lines = said("record", "--pressure", "tcp://127.0.0.1:1?channels=4", "-o", folder / "s.h5", "--wait", 1)
    assert (status, len(lines)) == (2, 1), lines
    assert "cannot be written" in lines[0]
    assert os.listdir(folder) == []
    hard("fault 4: read-only folder", "a file system mounted so", beyond="one line, exit 2, before it begins")


@pytest.mark.slow
def test_a_simulation_that_the_disk_cannot_hold_is_not_begun_and_is_made_when_it_can(small, tmp_path):
    folder, scene = small(40_000), tmp_path / "scene.toml"
    scene.write_text(SCENE)
    filler = folder / "filler"
    filler.write_bytes(bytes(40_000 * 1024 - 300_000))
    status, lines = said("simulate", scene, "-o", folder / "s.h5")
    assert (status, len(lines)) == (2, 1), lines
    assert re.search(r"the session takes [\d.]+ GB, and [\d.]+ GB are free", lines[0])
    assert os.listdir(folder) == ["filler"]
    filler.unlink()
    assert said("simulate", scene, "-o", folder / "s.h5")[0] == 0
    assert os.listdir(folder) == ["s.h5"]


@pytest.mark.slow
def test_a_calibration_that_does_not_fit_leaves_the_old_one(small, bundled):
    folder = small(200)
    output = folder / "c.h5"
    output.write_bytes(b"the old one")
    status, lines = said("calibrate", bundled[0], "-o", output, "--pixels", "20")
    assert (status, len(lines)) == (2, 1), lines
    assert "No space left" in lines[0]
    assert output.read_bytes() == b"the old one"
    assert os.listdir(folder) == ["c.h5"]
