"""Honest recordings are not accused: simulated sessions of all scenes, and real logs of others."""

import dataclasses
from datetime import UTC, datetime

import numpy as np
import pytest

import jaxeit as je
from benchmarks.bench_real import insole_counts
from calib.bench import load_bench, presets, simulate
from calib.check import Severity, check_session, transfer_matrix
from calib.cli import main
from calib.session import SessionFacts, StreamFacts, open_session

from ..helpers import REAL_DATA
from .honest import honest_bench, sixteen_presses
from .recording import SECOND, Recording, Samples

TRUE_WARNINGS = {
    "DropOut": ("lost", "gap"),
    "IntermittentElectrode": ("noisier than most", "median SNR"),
    "ElectrodeFault": ("noisier than most", "all that drive through electrode"),
}
"""What an effect of a scene makes of a recording, and what may therefore be read of it."""


@pytest.fixture(scope="module")
def transfers():
    """Transfer matrices by the name of the skin, computed once."""
    return {name: transfer_matrix(je.load_skin(name)) for name in ("testbed", "chest")}


@pytest.mark.slow
@pytest.mark.parametrize("number", range(200))
def test_an_honest_session_is_not_accused(number, transfers, tmp_path):
    bench = honest_bench(number)
    path = simulate(bench, tmp_path / "s.h5", fidelity=je.Fidelity.draft(edge_length=0.05))
    with open_session(path) as session:
        report = check_session(session, transfer=transfers[bench.scene.skin.name])
    allowed = [words for e in bench.scene.effects for words in TRUE_WARNINGS.get(type(e).__name__, ())]
    raised = [f for f in report.findings if f.severity > Severity.OK]
    assert report.ok, raised
    assert [f for f in raised if not any(words in f.what for words in allowed)] == []


def test_a_quick_honest_session_is_not_accused(transfers, tmp_path):
    test_an_honest_session_is_not_accused(3, transfers, tmp_path)


TOUCHED = [name for name in presets() if name != "ideal"]  # whose readings never change
SHIPPED = [name if name == "sliding" else pytest.param(name, marks=pytest.mark.slow) for name in TOUCHED]


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_scene_is_not_accused(name, transfers, tmp_path):
    """At lower rates. The strokes of `sliding` end on the pad under the site five rows later."""
    bench = dataclasses.replace(load_bench(name), eit_rate=10.0, pad_rate=50.0)
    path = simulate(bench, tmp_path / "s.h5", fidelity=je.Fidelity.draft(edge_length=0.05))
    with open_session(path) as session:
        report = check_session(session, transfer=transfers[bench.scene.skin.name])
    assert report.ok, [f for f in report.findings if f.severity is Severity.ERROR]


@pytest.fixture(scope="module")
def middle():
    """A testbed whose electrodes are in its middle, and reach less than half of the sheet."""
    text = je.load_skin("testbed").toml.replace("pitch = 0.04", "pitch = 0.025")
    text = text.replace("columns = 5", "columns = 4").replace("rows = 5", "rows = 4")
    return je.skin.parse_skin(text.replace("origin = [0.02, 0.02]", "origin = [0.0625, 0.0625]"))


def checked(skin, sites, forces, folder):
    """The report on presses at ``sites`` (presses, 2) m with ``forces`` in turn, N."""
    bench = sixteen_presses(skin, blank=3.0, pad_rate=100.0)
    bench = dataclasses.replace(bench, sites=np.asarray(sites), forces=np.asarray(forces))
    path = simulate(bench, folder / "s.h5", fidelity=je.Fidelity.draft(edge_length=0.05))
    with open_session(path) as session:
        return check_session(session)


def test_presses_that_eit_hardly_sees_are_not_those_of_another_time(middle, tmp_path):
    """Nine presses of varied force, most far from the electrodes, resemble the presses next to them by chance."""
    sites = np.random.default_rng(6).uniform(0.012, 0.188, (9, 2)).round(4)
    report = checked(middle, sites, [3.0, 6.0, 10.0], tmp_path)
    assert report.ok, report.findings


def test_places_beyond_the_electrodes_are_not_compared(middle, tmp_path):
    """EIT sees these presses, and places them nearer to the electrodes than they are."""
    x, y = np.meshgrid([0.013, 0.1, 0.187], [0.013, 0.07, 0.13, 0.187])
    report = checked(middle, np.stack([x.ravel(), y.ravel()], 1), [20.0], tmp_path)
    assert not [f for f in report.findings if "places" in f.what and f.severity > Severity.OK], report.findings


def real(name):
    """A file of a real recording; the test skips where it is not at hand."""
    path = REAL_DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not at hand; set JAXEIT_REAL_DATA to its folder")
    return path


@pytest.mark.parametrize("name", ["Circle_1bar", "Circle_5bar", "O-ring257_3bar", "Stadium_1bar"])
def test_a_pneumatic_cylinder_is_not_accused(name, tmp_path, capsys):
    """Its friction lets the pressure rise late, and its pressure falls as the force rises in some of them."""
    source = real(f"pneumatic_actuator/{name}.csv.gz")
    streams = ["--stream", "pressure=5:bar", "--stream", "force=6:N"]
    assert main(["import", "csv", str(source), "--time", "0:ms", *streams, "-o", str(tmp_path / "s.h5")]) == 0
    with open_session(tmp_path / "s.h5") as session:
        report = check_session(session)
    capsys.readouterr()
    warnings = [f for f in report.findings if f.severity > Severity.OK]
    assert report.ok, warnings
    assert all("gap" in f.what for f in warnings), warnings  # of up to 0.28 s; there are


def test_a_magnetic_skin_is_not_accused(tmp_path, capsys):
    source = real("eflesh/20250401_014340_probe/states.csv")
    words = ["import", "csv", str(source), "--time", "0:s", "--stream", "force=4:g", "--missing", "-1"]
    assert main([*words, "-o", str(tmp_path / "s.h5")]) == 0
    with open_session(tmp_path / "s.h5") as session:
        report = check_session(session)
    capsys.readouterr()
    raised = [f for f in report.findings if f.severity > Severity.OK]
    assert report.ok, raised
    assert all("irregularly" in f.what or "missing" in f.what for f in raised), raised  # both are true


@pytest.mark.slow
def test_an_insole_in_a_chamber_is_accused_of_its_faulty_taxels_only(tmp_path):
    """Its reference starts under load and is never negative."""
    counts, chamber = insole_counts(real("insole_plenum").parent)
    time = (np.arange(len(counts)) * (SECOND / 48.7)).astype(np.int64)
    streams = {
        "pressure": Samples(StreamFacts("counts", units="1", channels=280, rate_hz=48.7), time, counts),
        "force": Samples(StreamFacts("force", units="N", channels=1, rate_hz=48.7), time, chamber.reshape(-1, 1)),
    }
    path = Recording(SessionFacts(epoch=datetime(2023, 1, 1, tzinfo=UTC)), streams, None).write(tmp_path / "s.h5")
    with open_session(path) as session:
        report = check_session(session)
    raised = [f for f in report.findings if f.severity > Severity.OK]
    assert report.ok, raised
    assert all("of 280 channels" in f.what or f.where == "/presses" for f in raised), raised
    assert any("(stuck)" in f.what for f in raised)
    assert any("(saturated)" in f.what for f in raised)
