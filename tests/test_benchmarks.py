"""The benchmarks' work is what they say it is, and their smoke runs; no assertion is about time."""

import json

import numpy as np
import pytest

import jaxeit as je
from benchmarks import _common as common
from benchmarks import bench_forward, bench_jacobian
from benchmarks.peers import adjoint, cholmod, eidors, pyeit, superlu

from .oracles.rectangle import four_point

pytestmark = pytest.mark.filterwarnings("default")  # peers' own warnings are theirs


@pytest.fixture(scope="module")
def problem():
    return common.Problem(10)


def test_the_pattern_is_every_pair_of_neighbours_without_a_common_electrode(problem):
    steps = np.abs(problem.points[problem.pairs[:, 0]] - problem.points[problem.pairs[:, 1]]).sum(1)
    assert steps == pytest.approx(common.PITCH)
    assert len(np.unique(problem.pairs, axis=0)) == 40
    assert problem.pattern.shape == (1372, 4)
    assert all(len(set(row)) == 4 for row in problem.pattern.tolist())


def test_a_mesh_without_nodes_at_the_electrodes_is_refused():
    with pytest.raises(ValueError, match="multiple of 10"):
        _ = common.Problem(12).electrode_nodes


def test_exact_voltages(problem):
    """Against the oracle along one axis only, whose 4,000 terms leave an error of about 1e-4."""
    exact = bench_forward.exact(problem)
    for row in (0, 500, 1371):
        points = [problem.points[k] for k in problem.pattern[row]]
        assert exact[row] == pytest.approx(four_point(0.2, 0.2, *points), rel=1e-3)


@pytest.mark.parametrize("peer", [superlu, cholmod, pyeit, eidors])
def test_peers_and_jaxeit_agree(problem, peer):
    if peer.missing():
        pytest.skip(peer.missing())
    ours = bench_forward.ours(problem)(problem.sigma)
    assert common.difference(peer.prepare(problem)(problem.sigma), ours) < 1e-11


def test_a_tool_that_computes_something_else_is_not_timed(capsys):
    outputs = {"a": np.ones(3), "b": np.array([1, 1, 1 + 1e-8])}
    with pytest.raises(SystemExit, match="b disagrees with a"):
        common.require_agreement(outputs, "a", {})
    assert common.require_agreement(outputs, "a", {"b": 1e-7})["b"] == pytest.approx(1e-8)
    assert "1.0e-08" in capsys.readouterr().out


def test_jacobians_agree(problem):
    by_hand = adjoint.prepare(problem)(problem.sigma)
    assert common.difference(bench_jacobian.ours(problem, False)(problem.sigma), by_hand) < 1e-11
    pixels = bench_jacobian.pixel_matrix(problem)
    assert common.difference(adjoint.prepare(problem, pixels)(problem.sigma), by_hand @ pixels) < 1e-11
    if not pyeit.missing():
        assert common.difference(pyeit.prepare_jacobian(problem)(problem.sigma), by_hand) < 1e-9


with_eidors = pytest.mark.skipif(bool(eidors.missing()), reason=str(eidors.missing()))


@with_eidors
@pytest.mark.parametrize("pixels", [False, True])
def test_jacobian_of_eidors(problem, pixels):
    matrix = bench_jacobian.pixel_matrix(problem) if pixels else None
    tool = eidors.prepare_jacobian(problem, matrix)
    assert common.difference(tool(problem.sigma), adjoint.prepare(problem, matrix)(problem.sigma)) < 1e-11
    assert tool.last_seconds > 0
    tool.close()


@with_eidors
def test_quadratic_elements_of_eidors(problem):
    ours = common.as_tool(common.compiled(je.forward, problem.model(order=2)))
    tool = eidors.prepare_quadratic(problem)
    assert common.difference(tool(problem.sigma), ours(problem.sigma)) < 1e-11
    tool.close()


@with_eidors
def test_what_octave_said_last_is_told_when_it_stops(problem):
    tool = eidors.prepare(problem)
    with pytest.raises(RuntimeError, match="error:"):
        tool(np.ones(3))
    tool.close()


def test_eidors_missing(monkeypatch, tmp_path):
    monkeypatch.setattr(eidors.shutil, "which", lambda name: name)
    monkeypatch.setenv("EIDORS", str(tmp_path))
    assert "startup.m" in eidors.missing()
    (tmp_path / "startup.m").touch()
    assert eidors.missing() is None
    monkeypatch.setattr(eidors.shutil, "which", lambda name: name if name == "octave-cli" else None)
    assert "mkoctfile" in eidors.missing()
    (tmp_path / "arch/octave/any").mkdir(parents=True)
    (tmp_path / "arch/octave/any/eidors_var_id.mex").touch()
    assert eidors.missing() is None
    monkeypatch.setattr(eidors.shutil, "which", lambda name: None)
    assert "octave-cli" in eidors.missing()
    assert eidors.versions() == {}


def test_the_clock_of_a_tool_in_another_process_counts():
    class Elsewhere:
        last_seconds = 123.0

        def __call__(self, sigma):
            return sigma

    assert common.interleaved({"a": Elsewhere()}, np.ones(3), 2, budget=1e3) == {"a": [123.0, 123.0]}


def test_a_slow_tool_stops_after_its_budget():
    ticks = common.interleaved({"quick": np.copy, "slow": np.copy}, np.ones(3), 4, budget=0.0)
    assert {name: len(times) for name, times in ticks.items()} == {"quick": 0, "slow": 0}
    ticks = common.interleaved({"quick": np.copy}, np.ones(3), 4, budget=60.0)
    assert common.spread(ticks["quick"])["repeats"] == 4


def test_results_keep_other_sections(tmp_path):
    common.write("forward", {"rows": [1]}, tmp_path)
    path = common.write("jacobian", {"rows": [2]}, tmp_path)
    assert json.loads(path.read_text()) == {"forward": {"rows": [1]}, "jacobian": {"rows": [2]}}
    assert path.stem == common.machine()


@pytest.mark.slow
@pytest.mark.parametrize("bench", [bench_forward, bench_jacobian])
def test_smoke(bench, capsys):
    rows = bench.main(["--smoke"])["rows"]
    assert {row["nodes"] for row in rows} == {961}
    assert all(row["min_ms"] <= row["median_ms"] <= row["max_ms"] for row in rows)
    assert capsys.readouterr().out.count("961 nodes |") == 1
