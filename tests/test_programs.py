"""The programs in the docstrings, which the pages of names show, run as they stand."""

import os
import re
import shutil
import sys
from datetime import UTC, datetime
from functools import reduce
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.session import SessionFacts, SessionWriter, StreamFacts

from .helpers import bound_maps
from .record.test_recorder import both, journal
from .tanks.instrument_files import goe_get
from .tanks.rods import tank_with_rod
from .tanks.tank_files import write_csv, write_ktc, write_mat, write_sciospec

ROOT = Path(__file__).parents[1]
CONTENTS = re.findall(r"^ +- api/(.*)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
FIRST = ("calib.bench", "calib")
"""Rooms whose programs write the recordings and the calibration that the slow ones of other rooms read."""

SLOW = {
    "calib.calibration",
    "calib.check",
    "calib.export",
    "calib.fitting",
    "calib.fitting.logs",
    "calib.learning",
    "calib.live",
    "calib.tanks",
    "jaxeit.accuracy",
    "jaxeit.contacts",
    "jaxeit.effects",
    "jaxeit.imaging",
    "jaxeit.least_squares",
    "jaxeit.metrics",
    "jaxeit.scan",
    "jaxeit.tracking",
    *FIRST,
}
"""Rooms whose programs take more than a few seconds."""

SLOW_NAMES = {"jaxeit.bind", "jaxeit.compiler_options", "jaxeit.verb"}
"""Names of other rooms whose programs do."""


@pytest.fixture(scope="module")
def site():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs" / "site"))
        yield import_module("public_names")


def write_log(path, gain):
    """A sensor of one channel under a load that rises and falls, with the load beside it."""
    time = 10_000_000 * np.arange(2000)  # ns
    force = 10 * np.sin(np.pi * time / 4e9) ** 2  # N
    noise = np.random.default_rng(0).normal(0, 20, time.size)  # Pa
    streams = {"pressure": ("Pa", gain * force + noise), "force": ("N", force)}
    with SessionWriter(path, SessionFacts(epoch=datetime(2026, 1, 1, tzinfo=UTC), title="a log")) as writer:
        for name, (unit, values) in streams.items():
            writer.add_stream(name, StreamFacts(name, units=unit, channels=1, rate_hz=100))
            writer.append(name, time, values[:, None])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The working directory, with the files that programs open."""
    folder, before = tmp_path_factory.mktemp("programs"), Path.cwd()
    for name, bundled in (("session", "testbed_grid"), ("other", "testbed_presses")):
        shutil.copy(ROOT / "data" / "sessions" / f"{bundled}.h5", folder / f"{name}.h5")
    write_log(folder / "log.h5", 400)
    write_log(folder / "later.h5", 420)
    journal(folder / "crashed.h5.part", both(), end=False)
    os.chdir(folder)
    yield folder
    os.chdir(before)


@pytest.fixture(scope="module")
def tanks(folder):
    """The same folder, with recordings of tanks."""
    tank = tank_with_rod()
    write_mat(folder / "model.mat", tank)
    write_csv(folder / "table.csv", tank.frames)
    write_ktc(folder)
    (folder / "sciospec").mkdir()
    write_sciospec(folder / "sciospec", tank)
    (folder / "chest.get").write_bytes(goe_get(tank.frames))


def run(site, room, skipped=frozenset()):
    """Run the programs of a page from top to bottom, each with what the ones above it defined."""
    names = {"__name__": "__main__"}
    for name, program in site.programs_of(room):
        if f"{room}.{name}" not in skipped:
            exec(compile(program, f"{room} {name}", "exec"), names)


@pytest.fixture(scope="module")
def calibrated(site, tanks):
    """The same folder, with a short recording and its calibration, by the programs that make them."""
    for room in FIRST:
        run(site, room)


@pytest.mark.parametrize("room", [room for room in CONTENTS if room not in SLOW])
def test_quick_programs_of_a_room(site, folder, room):
    run(site, room, SLOW_NAMES)


def test_names_in_programs_exist(site):
    """Of the slow programs, too."""
    for room in CONTENTS:
        for name, program in site.programs_of(room):
            for path in sys.modules["programs"].dotted_names(program, site.room_program(room)):
                assert reduce(getattr, path[1:], import_module(path[0])) is not None, (room, name, path)


def test_programs_import_from_rooms_that_have_a_page(site):
    """So does a reader who goes on from a program."""
    pages = [path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]]
    texts = [program for page in pages for program in re.findall(r"```python.*?```", page, re.DOTALL)]
    texts += [path.read_text(encoding="utf-8") for path in (ROOT / "examples").glob("*.py")]
    texts += [program for room in CONTENTS for _, program in site.programs_of(room)]
    imported = {
        name for text in texts for name in re.findall(r"^ *(?:from|import) ((?:calib|jaxeit)[\w.]*)", text, re.M)
    }
    assert imported > {"calib", "jaxeit"}
    assert imported <= {*CONTENTS, "calib.simulators.mujoco"}  # which needs MuJoCo


def follow(page, names):
    """The programs of a page, which go on from what is given."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    for program in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        exec(compile(program, page, "exec"), names)
    return names


@pytest.mark.slow
def test_programs_of_pages_that_go_on_from_a_calibration(calibrated, tmp_path, monkeypatch):
    calibration = calib.load_calibration("calibration.h5")
    with calib.open_session("other.h5") as session:
        moved = follow("a-week-later.md", {"calib": calib, "calibration": calibration, "session": session})["moved"]
    assert np.isfinite(moved.recalibration.log_gain).all()
    for name in ("log.h5", "later.h5"):
        shutil.copy(name, tmp_path)
    monkeypatch.chdir(tmp_path)  # where the page writes another calibration.h5
    with calib.open_session("later.h5") as later:
        time, values = later.stream("pressure").time, later.stream("pressure").read()
    found = follow("logs.md", {"calib": calib, "time": time, "values": values})["found"]
    assert found.force.shape == found.valid.shape == time.shape
    assert 9 < np.nanmax(found.force) < 12


@pytest.mark.slow
@pytest.mark.parametrize("room", ["jaxeit", *(room for room in CONTENTS if room in SLOW and room not in FIRST)])
def test_slow_programs_of_a_room(site, calibrated, room):
    run(site, room)
    bound_maps()
