"""The benchmarks' work is what they say it is, and their smoke runs; no assertion is about time."""

import json
from functools import partial

import numpy as np
import pytest

import jaxeit as je
from benchmarks import (
    bench_accuracy,
    bench_batch,
    bench_forward,
    bench_gpu,
    bench_inverse,
    bench_jacobian,
    clock,
    harness,
    problems,
    stability,
    tools,
)
from benchmarks.clock import difference
from benchmarks.peers import adjoint, cholmod, eidors, pyeit, superlu
from calib.report.figures.parts import write_figure

from .oracles.rectangle import four_point

pytestmark = pytest.mark.filterwarnings("default")  # peers' own warnings are theirs


@pytest.fixture(scope="module")
def problem():
    return problems.Problem(10)


def test_the_pattern_is_every_pair_of_neighbours_without_a_common_electrode(problem):
    steps = np.abs(problem.points[problem.pairs[:, 0]] - problem.points[problem.pairs[:, 1]]).sum(1)
    assert steps == pytest.approx(problems.PITCH)
    assert len(np.unique(problem.pairs, axis=0)) == 40
    assert problem.pattern.shape == (1372, 4)
    assert all(len(set(row)) == 4 for row in problem.pattern.tolist())


def test_a_mesh_without_nodes_at_the_electrodes_is_refused():
    with pytest.raises(ValueError, match="multiple of 10"):
        _ = problems.Problem(12).electrode_nodes


def test_exact_voltages(problem):
    """Against the oracle along one axis only, whose 4,000 terms leave an error of about 1e-4."""
    exact = problems.exact_rectangle(problem)
    for row in (0, 500, 1371):
        points = [problem.points[k] for k in problem.pattern[row]]
        assert exact[row] == pytest.approx(four_point(0.2, 0.2, *points), rel=1e-3)


def test_exact_voltages_of_the_disc_are_reciprocal():
    pattern = je.skin.adjacent(16)
    exact, other = problems.exact_disc(pattern), je.skin.reciprocal_rows(pattern)
    assert (other >= 0).all()
    np.testing.assert_allclose(exact[other], exact, atol=1e-12)


def _row(sheet, tool, order, error, ms, dtype="float64", mesh="regular"):
    labels = {"sheet": sheet, "tool": tool, "mesh": mesh, "order": order, "dtype": dtype}
    return labels | {"nodes": 1000, "unknowns": 999, "relative_error": error, "median_ms": ms}


def test_the_picture_has_a_curve_per_order_precision_and_grading(tmp_path):
    ours = [
        _row(sheet, "jaxeit", order, error, ms, dtype, f"growth {growth}")
        for sheet in ("rectangle", "disc")
        for order in (1, 2)
        for dtype in ("float64", "float32")
        for growth in bench_accuracy.GRADINGS
        for error, ms in ((1e-2, 1.0), (1e-3, 10.0))
    ]
    peers = [(cholmod.NAME, 1, 2e-3, 5.0), (f"{eidors.NAME} second order", 2, 2e-4, 500.0)]
    rows = [*ours, *(_row("rectangle", *peer) | {"nodes": 3721} for peer in peers)]
    rectangle, disc = bench_accuracy.picture({"rows": rows}).axes
    assert len(rectangle.lines) == len(disc.lines) + 2
    curves = [
        [line for line in axes.lines if len(line.get_xdata()) == 2 and line.get_marker() != "None"]
        for axes in (rectangle, disc)
    ]
    assert [len(lines) for lines in curves] == [12, 12]
    assert len({(line.get_color(), line.get_linestyle(), line.get_marker()) for line in curves[0]}) == 12
    write_figure(bench_accuracy.picture({"rows": rows}), tmp_path / "accuracy.png")
    assert (tmp_path / "accuracy.png").read_bytes().startswith(b"\x89PNG")


def test_float32_is_run_on_the_finest():
    assert bench_accuracy.with_precision((3, 2, 1)) == [(3, "float64"), (2, "float64"), (1, "float64"),
                                                        (3, "float32"), (1, "float32")]  # fmt: skip
    assert [size for size, dtype in bench_accuracy.with_precision((4, 3, 2, 1)) if dtype == "float32"] == [3, 1]


def test_nothing_to_draw(monkeypatch, tmp_path):
    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    with pytest.raises(SystemExit, match="measure first"):
        bench_accuracy.main(["--draw-only"])


@pytest.mark.parametrize("peer", [superlu, cholmod, pyeit, eidors])
def test_peers_and_jaxeit_agree(problem, peer):
    if peer.missing():
        pytest.skip(peer.missing())
    ours = tools.forward(problem)(problem.sigma)
    prepare = eidors.Eidors if peer is eidors else peer.prepare
    assert difference(prepare(problem)(problem.sigma), ours) < 1e-11


def test_a_tool_that_computes_something_else_is_not_timed(capsys):
    outputs = {"a": np.ones(3), "b": np.array([1, 1, 1 + 1e-8])}
    with pytest.raises(SystemExit, match="b disagrees with a"):
        clock.require_agreement(outputs, "a", {})
    assert clock.require_agreement(outputs, "a", {"b": 1e-7})["b"] == pytest.approx(1e-8)
    assert "1.0e-08" in capsys.readouterr().out


def test_jacobians_agree(problem):
    by_hand = adjoint.prepare(problem)(problem.sigma)
    assert difference(tools.jacobian(problem, False)(problem.sigma), by_hand) < 1e-11
    pixels = tools.projection(problem)
    assert difference(adjoint.prepare(problem, pixels)(problem.sigma), by_hand @ pixels) < 1e-11
    if not pyeit.missing():
        assert difference(pyeit.prepare_jacobian(problem)(problem.sigma), by_hand) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [False, True])
def test_reconstruction_matrices_agree(problem, pixels):
    by_hand = tools.inverse_by_hand(problem, pixels)(problem.sigma)
    others = {
        "image space": tools.inverse_by_hand(problem, pixels, tools.in_image_space),
        "ours": tools.Reconstruction(problem, pixels),
    }
    if not (pixels or pyeit.missing()):
        others["pyEIT"] = pyeit.prepare_inverse(problem, tools.strength(problem, pixels))
    for name, tool in others.items():
        assert difference(tool(problem.sigma), by_hand) < 1e-9, name
    assert others["ours"].last_seconds > 0


with_eidors = pytest.mark.skipif(bool(eidors.missing()), reason=str(eidors.missing()))


@with_eidors
@pytest.mark.parametrize("pixels", [False, True])
def test_jacobian_of_eidors(problem, pixels):
    matrix = tools.projection(problem, pixels)
    tool = tools.by_eidors(problem, pixels, "jacobian")
    assert difference(tool(problem.sigma), adjoint.prepare(problem, matrix)(problem.sigma)) < 1e-11
    assert tool.last_seconds > 0
    tool.close()


@with_eidors
@pytest.mark.parametrize("pixels", [False, True])
def test_reconstruction_matrix_of_eidors(problem, pixels):
    tool = tools.by_eidors(problem, pixels, "inverse")
    by_hand = tools.inverse_by_hand(problem, pixels)
    first = tool(problem.sigma)
    assert difference(first, by_hand(problem.sigma)) < 1e-9
    assert difference(tool(2 * problem.sigma), first) > 1e-2  # nothing is kept of the first
    tool.close()


@with_eidors
def test_quadratic_elements_of_eidors(problem):
    ours = tools.forward(problem, order=2)
    tool = eidors.Eidors(problem, order=2)
    assert difference(tool(problem.sigma), ours(problem.sigma)) < 1e-11
    tool.close()


@with_eidors
def test_what_octave_said_last_is_told_when_it_stops(problem):
    tool = eidors.Eidors(problem)
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

    assert clock.interleaved([(Elsewhere(), np.ones(3))], 2, budget=1e3) == [[(123.0, 123.0)] * 2]


def test_a_quick_tool_is_called_again_and_again_in_its_turn_and_the_last_call_counts(monkeypatch):
    monkeypatch.setattr(clock, "TURN_SECONDS", 0.15)
    calls = []

    class Tool:
        def __call__(self, sigma):
            calls.append(sigma[0])
            self.last_seconds = (0.08, 0.04, 0.05)[len(calls) % 3 - 1]

    (turns,) = clock.interleaved([(Tool(), np.ones(3))], 2, budget=1e3)
    assert turns == [(0.05, 0.08)] * 2
    assert len(set(calls)) == 6  # no conductivity twice


@pytest.mark.slow
def test_a_slow_tool_stops_after_its_budget():
    call = np.copy, np.ones(3)
    turns = clock.interleaved([call, call], 9, budget=0.0)
    assert [len(own) for own in turns] == [clock.MIN_TURNS, clock.MIN_TURNS]
    (turns,) = clock.interleaved([call], 9, budget=60.0)
    assert clock.spread([turn.last for turn in turns])["repeats"] == 9
    assert [len(own) for own in clock.in_turns({"a": int, "b": int}, 9, budget=0.0).values()] == [clock.MIN_TURNS] * 2


def test_results_keep_other_sections(tmp_path):
    harness.write("forward", {"rows": [1]}, tmp_path)
    path = harness.write("jacobian", {"rows": [2]}, tmp_path)
    assert json.loads(path.read_text()) == {"forward": {"rows": [1]}, "jacobian": {"rows": [2]}}
    assert path.stem == harness.machine()


@pytest.mark.parametrize("bench", [bench_forward, bench_jacobian])
def test_smoke(bench, capsys):
    rows = bench.main(["--smoke"])["rows"]
    assert {row["nodes"] for row in rows} == {121}
    assert all(row["min_ms"] <= row["median_ms"] <= row["max_ms"] for row in rows)
    assert capsys.readouterr().out.count("121 nodes |") == 1


def test_a_slow_way_of_application_stops_after_its_budget():
    ways = {name: bench_inverse.Way(lambda: np.ones(1), np.ones(1), 8, frames=2) for name in ("one", "other")}
    taken = bench_inverse.latencies(ways, calls=30, block=10, budget=60.0)
    assert [len(times) for times in taken.values()] == [30, 30]
    rows = list(bench_inverse.application_rows(ways, taken, byte_per_s=1e3))
    assert [row["least_ms"] for row in rows] == [4.0, 4.0]
    assert [row["above"] for row in rows] == [int(np.sum(times > 1e-4)) for times in taken.values()]
    assert all(row["min_ms"] <= row["p50_ms"] <= row["p99_ms"] <= row["max_ms"] for row in rows)
    assert not any(len(times) for times in bench_inverse.latencies(ways, 30, 10, budget=0.0).values())


def test_work_in_the_first_cache_is_repeated_until_it_takes_as_long():
    short, long = (bench_inverse.as_long_as(partial(sum, range(count))) for count in (2_000, 50_000))
    assert 1 <= 5 * short.args[0] < long.args[0]
    np.testing.assert_array_equal(long(), np.ones(1))


def test_frames_follow_one_another_or_other_work():
    """One call of each block does not count; after other work every one does."""
    done: list[str] = []
    ways = {name: bench_inverse.Way(partial(done.append, name), np.ones(1), 8) for name in "ab"}
    counted = bench_inverse.latencies(ways, calls=4, block=2, budget=60.0)
    assert "".join(done) == "aaabbb" * 2
    assert [len(times) for times in counted.values()] == [4, 4]
    done.clear()
    counted = bench_inverse.latencies(ways, 2, 1, 60.0, between=partial(done.append, " "))
    assert "".join(done) == " a b" * 2
    assert [len(times) for times in counted.values()] == [2, 2]


@pytest.mark.slow
def test_smoke_of_a_gpu_without_one(capsys):
    """Its parts on a CPU; in earnest they ask for a GPU."""
    data = bench_gpu.main(["--smoke"])
    assert all(
        row["per_s"] > 0 for part in ("singles", "batches", "gradients", "peers", "frames") for row in data[part]
    )
    with pytest.raises(SystemExit, match=r"jax\[cuda13\]"):
        bench_gpu.main([])


@pytest.mark.slow
def test_smoke_of_inverse(capsys):
    data = bench_inverse.main(["--smoke"])
    assert {row["nodes"] for row in data["rows"]} == {121}
    assert all(row["min_ms"] <= row["median_ms"] <= row["max_ms"] for row in data["rows"])
    for rows in data["application"].values():
        assert all(row["difference"] < (1e-4 if "float32" in row["way"] else 1e-9) for row in rows)
    assert "| jaxeit, on_host(), float32 |" in capsys.readouterr().out


@pytest.mark.slow
def test_smoke_of_accuracy(capsys):
    data = bench_accuracy.main(["--smoke"])
    ours = {(row["sheet"], row["mesh"], row["dtype"]) for row in data["rows"] if row["tool"] == "jaxeit"}
    meshes = (("rectangle", "regular"), ("rectangle", "growth 1.7"), ("disc", "growth 1.7"))
    assert ours == {(*mesh, dtype) for mesh in meshes for dtype in ("float64", "float32")}
    assert all(row["relative_error"] < 0.03 for row in data["rows"] if row["tool"] == "jaxeit")
    best = {(r["kind"], r["target"]): r["best"] for r in data["to_accuracy"]}
    assert best["jaxeit P2, regular", 1e-2] is not None
    assert "| rectangle | jaxeit |" in capsys.readouterr().out


def test_contacts_lie_all_over_the_sheet_and_raise_conductivity_by_half(problem):
    shapes = tools.contacts(problem)
    highest = problem.mesh.chart_centroids[np.argmax(shapes, 1)]
    np.testing.assert_allclose(highest[[0, -1]], [[0, 0], [0.2, 0.2]], atol=0.015)
    assert len(np.unique(shapes, axis=0)) == tools.CONTACTS
    assert 1.3 < shapes.max() <= 1.5
    assert shapes.min() == pytest.approx(1.0)


@pytest.mark.parametrize("batch", [1, 8])
def test_contacts_in_batches_are_those_one_by_one(problem, batch):
    by_hand = tools.one_by_one(superlu.prepare)(problem)(problem.sigma)
    assert by_hand.shape == (tools.CONTACTS, 1372)
    assert difference(tools.batched(problem, batch)(problem.sigma), by_hand) < 1e-11


def test_a_command_starts_anew_with_one_blas_thread(monkeypatch):
    started = []
    monkeypatch.setattr(harness.os, "execv", lambda path, command: started.append(command))
    monkeypatch.setattr(harness.sys, "argv", ["/any/bench_batch.py", "--smoke"])
    for threads in ("2", "1"):
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", threads)
        harness.with_one_blas_thread()
    assert [command[1:] for command in started] == [["-m", "benchmarks.bench_batch", "--smoke"]]


@pytest.mark.slow
def test_smoke_of_batches(capsys):
    data = bench_batch.main(["--smoke"])
    assert {row["tool"] for row in data["rows"]} >= {"jaxeit float64, batches of 8", superlu.NAME}
    assert all(row["min_ms"] <= row["median_ms"] <= row["max_ms"] for row in data["rows"])
    assert "forward solves a second" in capsys.readouterr().out


@pytest.mark.slow
def test_stability_holds_where_the_textbook_fails(tmp_path):
    """On two axes, the mildest and the hardest of each; all panels are drawn."""
    rows = stability.measure([stability.AXES[0], stability.AXES[-1]], 2)
    assert [row["severity"] for row in rows] == pytest.approx([1e-12, 1e8, 100, 0.01])
    assert max(row["float64"] for row in rows) < 1e-12
    assert max(row["float32"] for row in rows) < 1e-4
    assert min(row["naive"] for row in rows) > 1e-4
    rows[0]["naive"] = None
    write_figure(stability.picture({"rows": rows}), tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    titles = [axes.get_title() for axes in stability.picture({"rows": rows}).axes]
    assert titles == [axis.title for axis in stability.AXES]


@pytest.mark.slow
def test_smoke_of_stability(capsys):
    rows = stability.main(["--smoke"])["rows"]
    assert len(rows) == 2 * len(stability.AXES)
    assert capsys.readouterr().out.count("'naive'") == len(stability.AXES)
