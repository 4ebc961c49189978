"""Benchmarks of what accuracy costs beside solves: presses, readings, growth, start, the whole way; runs compared."""

import json
import os
import re
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from benchmarks import (
    bench_accuracy,
    bench_calibration,
    bench_contact_law,
    bench_growth,
    bench_half_space,
    bench_learning,
    bench_loads,
    bench_pipeline,
    bench_protocol,
    bench_start,
    bench_tracking,
    figures,
    hard_case_pictures,
    harness,
    problems,
    repeat,
    tables,
    tank_pictures,
    tools,
)
from benchmarks.__main__ import questions
from benchmarks.clock import difference
from benchmarks.markdown import cell
from benchmarks.memory import growth
from benchmarks.peers import eidors, pyeit
from benchmarks.rows import averaged, grouped
from calib.presses import PressData

pytestmark = pytest.mark.filterwarnings("default")  # peers' own warnings are theirs


@pytest.fixture
def positions():
    line = np.linspace(0.01, 0.19, 15)
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)


# --- presses


@pytest.mark.parametrize("side", bench_calibration.SIDES)
def test_a_grid_of_presses_is_even(positions, side):
    chosen = bench_calibration.on_grid(positions, side**2)
    assert chosen.sum() == side**2
    for column in positions[chosen].T:
        assert len(np.unique(column.round(9))) == side
    np.testing.assert_allclose(positions[chosen].mean(0), [0.1, 0.1], atol=0.5 * 0.18 / 14)


def test_scattered_presses_fill_the_sheet_better_than_drawn_ones(positions):
    def widest_gap(chosen):
        return np.linalg.norm(positions[:, None] - positions[chosen], axis=-1).min(1).max()

    scattered = bench_calibration.scattered(positions, 36)
    drawn = [np.random.default_rng(seed).permutation(225) < 36 for seed in range(10)]
    assert scattered.sum() == 36
    assert widest_gap(scattered) < min(map(widest_gap, drawn))
    np.testing.assert_array_equal(bench_calibration.scattered(positions, 225), np.ones(225, bool))


def test_force_levels_are_samples_on_the_way_up():
    up = np.concatenate([np.linspace(1, 20, 20), np.full(5, 20.0), np.linspace(19, 0, 20)])
    force = np.concatenate([up, up / 2])
    data = PressData(
        sample_pressure=np.ones((1, 90)),
        sample_force=force,
        sample_press=np.repeat([0, 1], 45),
        mask=np.ones((1, 90), bool),
        pressure=np.ones((2, 1)),
        force=np.array([20.0, 10.0]),
        place=np.array([0, 1]),
        reach=np.zeros((2, 2)),
    )
    for levels in (1, 2, 4):
        kept = np.flatnonzero(bench_calibration.at_levels(data, levels).mask[0])
        wanted = np.concatenate([top * (1 + np.arange(levels)) / levels for top in (20, 10)])
        np.testing.assert_allclose(force[kept], wanted)
        assert (kept % 45 < 25).all()
    assert bench_calibration.at_levels(data, None) is data


# --- the whole way


def _reached(tool, order, mesh, error, ms):
    row = {"tool": tool, "order": order, "mesh": mesh, "relative_error": error, "unknowns": 9, "min_ms": ms}
    return row | {"dtype": "float64"} | {"median_ms": ms, "max_ms": ms}


def test_the_quickest_mesh_that_reaches_the_accuracy():
    rows = [
        _reached("jaxeit", 2, "growth 1.7", 5e-4, 4.0),
        _reached("jaxeit", 2, "growth 1.4", 1e-4, 9.0),
        _reached("jaxeit", 1, "regular", 5e-3, 1.0),
        _reached("EIDORS first order", 1, "regular", 9e-3, 20.0),
    ]
    found = {(r["kind"], r["target"]): r["best"] for r in bench_accuracy.to_accuracy(rows)}
    assert [found["jaxeit P2, graded", t]["median_ms"] for t in bench_accuracy.TARGETS] == [4.0, 4.0, 9.0]
    assert found["EIDORS first order", 1e-3] is None
    page = tables.table("to-accuracy", {"to_accuracy": bench_accuracy.to_accuracy(rows)})
    assert "| jaxeit P1, regular | 1 (9) | not reached | not reached |" in page


@pytest.mark.slow
def test_all_tools_make_the_same_images_from_the_mesh():
    problem = problems.Problem(10)
    ways = {"by hand": tools.pipeline_by_hand, "jaxeit": tools.pipeline}
    ways |= {} if eidors.missing() else {"EIDORS": partial(tools.by_eidors, verb="pipeline")}
    for pixels in (True, False):
        images = {name: prepare(problem, pixels)(problem.sigma) for name, prepare in ways.items()}
        if not pyeit.missing() and not pixels:
            images["pyEIT"] = tools.pipeline_by_pyeit(problem)(problem.sigma)
        for name, image in images.items():
            assert difference(image, images["by hand"]) < 1e-7, name


# --- runs compared


def _run(*ms, low=0.9, high=1.1):
    tools = ("jaxeit float64", "EIDORS", "pyEIT")
    return [
        {"tool": tool, "nodes": 961, "median_ms": m, "min_ms": low * m, "max_ms": high * m}
        for tool, m in zip(tools, ms, strict=True)
    ]


def test_ratios_that_moved_more_than_the_spread_are_named():
    found = repeat.compared(_run(1, 10, 100), _run(2, 21, 300))
    assert [(one.what, one.agrees) for one in found] == [("EIDORS, 961 nodes", True), ("pyEIT, 961 nodes", False)]
    assert found[0].first == pytest.approx((10, 10 * 0.9 / 1.1, 10 * 1.1 / 0.9))
    assert not repeat.compared(_run(1, 10, 100), _run(1, 10.5, 100, low=0.99, high=1.01))[0].first.allows(
        repeat.Ratio(13, 12, 14)
    )


def test_the_page_says_how_far_the_ratios_it_quotes_moved():
    """Those of the table only: of the Jacobians not the ones onto elements, of the forward solves all the peers'."""
    onto = [f"{tool}, {image}" for tool in ("jaxeit float64", "EIDORS") for image in ("pixels", "elements")]
    jacobian, again = (
        [
            {"tool": tool, "nodes": 961, "median_ms": ms, "min_ms": 0.9 * ms, "max_ms": 1.1 * ms}
            for tool, ms in zip(onto, times, strict=True)
        ]
        for times in ((1, 1, 9, 9), (1, 1, 10, 90))
    )
    runs = [{"rows": rows} for rows in (_run(1, 10, 100), jacobian, _run(2, 21, 300), again)]
    said = tables.table("repeat", *runs)
    assert "2 of the 3 ratios" in said
    assert "50 %" in said


def test_rows_are_grouped_and_averaged():
    """Labels and whole numbers stay; None and NaN are no values; one value has no standard deviation."""
    errors = [(1.0, None), (3.0, float("nan")), (5.0, 4.0)]
    rows = [{"way": "a", "k": 7, "fit_mm": fit, "image_mm": image, "rate": fit} for fit, image in errors]
    mean = averaged(rows, sd_of="_mm")
    assert mean == {"way": "a", "k": 7, "fit_mm": 3.0, "fit_mm_sd": 2.0, "image_mm": 4.0, "rate": 3.0}
    assert averaged(rows[:1])["image_mm"] is None
    assert grouped(rows, "way") == {"a": rows}
    assert list(grouped(rows, "way", "fit_mm")) == [("a", 1.0), ("a", 3.0), ("a", 5.0)]


@pytest.mark.parametrize(
    ("template", "text"),
    [("{x:ms}", "123"), ("{x:.2f kilo}", "0.12"), ("{x:.1f %}", "12345.6 %"), ("{y:ms milli}", "1.23"), ("{z}", "")],
)
def test_a_cell_scales_its_number(template, text):
    assert cell(template, {"x": 123.456, "y": 1.234e-3}) == text


def test_curves_leave_out_rows_without_a_number():
    rows = [{"tool": tool, "x": x, "y": y} for tool, x, y in (("a", 1, 2.0), ("b", 1, None), ("a", 2, 3.0))]
    _, (axes,) = figures.panels(2, 2, 1, 1)
    figures.curves(axes, rows, "x", "y", ("tool",), lambda tool: {"label": tool})
    assert [(line.get_label(), line.get_xydata().tolist()) for line in axes.lines] == [("a", [[1, 2], [2, 3]])]


def test_two_files_are_compared(tmp_path, capsys):
    files = [tmp_path / "a.json", tmp_path / "b.json"]
    for file, again in zip(files, (100, 300), strict=True):
        file.write_text(json.dumps({"forward": {"rows": _run(1, 10, 100)}, "again": {"rows": _run(1, 10, again)}}))
    names = [str(file) for file in files]
    assert repeat.main(names) == 0
    assert "2 of 2 ratios" in capsys.readouterr().out
    assert repeat.main([*names, "forward", "again"]) == 1
    assert "NO" in capsys.readouterr().out


def test_nothing_stored(monkeypatch, tmp_path):
    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    with pytest.raises(SystemExit, match="measure first"):
        harness.stored("protocol_cost")
    (tmp_path / f"{harness.machine()}.json").write_text('{"start": {"rows": []}}')
    assert harness.stored("start") == {"rows": []}


# --- growth and start


def test_exponents_of_a_power_law():
    one = bench_growth.Series("work", "size", (), "2", "1", lambda size: (print, (), size))
    rows = [{"size": n, "median_ms": 3e-3 * n**2, "megabytes": 5.0 * n} for n in (10, 30, 200)]
    found = bench_growth.fits(one, rows)
    assert (found["time"]["exponent"], found["memory"]["exponent"]) == (2.0, 1.0)


def test_the_first_program_is_the_readmes():
    code = bench_start.program()
    assert code.startswith("import jax\n")
    assert "je.fuse" in code


# --- memory


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_growth_is_found_within_its_error(alike):
    """Also where a sample is much like the one before it, which plain least squares takes for many samples."""
    rng, pulls = np.random.default_rng(0), []
    time = np.arange(600.0)
    for _ in range(100):
        noise = rng.normal(0, 0.1, 600)
        for n in range(1, 600):
            noise[n] += alike * noise[n - 1]
        found = growth(np.stack([time, 50 + noise + 3.0 / 3600 * time], 1))
        pulls.append((found.slope - 3.0) / found.error)
    assert abs(np.mean(pulls)) < 0.4
    assert 0.8 < np.std(pulls) < (1.2 if alike == 0 else 1.6)


def test_growth_knows_a_page_at_best_and_leaves_out_the_start():
    time = np.arange(600.0)
    found = growth(np.stack([time, np.where(time < 290, time, 290.0)], 1))
    assert found.slope == 0
    assert found.error == pytest.approx(3600 * os.sysconf("SC_PAGE_SIZE") / 1e6 / 299)
    assert growth(np.ones((6, 2))).error == np.inf


# --- smoke


def test_every_question_is_listed_and_named_in_the_readme(root):
    readme = (root / "benchmarks" / "README.md").read_text(encoding="utf-8")
    assert set(re.findall(r"python -m benchmarks\.(\w+)", readme)) == set(questions())
    assert all(questions().values())


def test_the_pictures_of_hard_cases_follow_their_tables():
    cases = hard_case_pictures.rows(hard_case_pictures.PAGE.read_text(encoding="utf-8"))
    lies = sum(case.startswith("lie: ") for case in cases)
    assert sum(part.total() for part in hard_case_pictures.noticed(cases).values()) == lies > 100
    lasts = hard_case_pictures.seconds(cases)
    assert lasts["power cut: lost at most"] == 0.1
    cases["fault 2: power cut while recording"][-1] = "the last 250 ms lost at most"
    assert hard_case_pictures.seconds(cases)["power cut: lost at most"] == 0.25
    assert len(lasts) == len(hard_case_pictures.LASTS)


def test_the_images_of_a_tank_are_turned_alike():
    """Discs with a change at electrode 5, whose electrodes begin elsewhere and follow the other way round."""
    assert "mk_common_model" in tank_pictures.program("matlab")
    assert "JAC(" in tank_pictures.program("python", "tank_with_pyeit.py")
    images = {}
    for name, sense in (("one", 1), ("other", -1)):
        angle = 0.7 + sense * 2 * np.pi * np.arange(16) / 16
        nodes = np.concatenate([np.stack([np.cos(angle), np.sin(angle)], 1), np.zeros((1, 2))])
        triangles = np.stack([np.arange(16), np.roll(np.arange(16), -1), np.full(16, 16)], 1)
        images[name] = tank_pictures.Image(nodes, triangles, np.arange(16), (np.arange(16) == 4).astype(float))
    one, other, _ = tank_pictures.picture(images).axes
    for axes in (one, other):
        (numbered,) = [text for text in axes.texts if text.get_text() == "5"]
        np.testing.assert_allclose(numbered.get_position(), (0, 1.13), atol=1e-9)
    alike = [np.stack([path.vertices for path in axes.collections[0].get_paths()]) for axes in (one, other)]
    np.testing.assert_allclose(*alike, atol=1e-9)


def test_a_part_measured_again_leaves_the_others(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    count = iter(range(9))

    def part(run):
        yield {run.args.name: [{"time": next(count)}]}
        yield {run.args.name: [{"time": next(count)}]}

    def other(run):
        yield {"other": next(count)}

    main = harness.Question("work", "about", {"one": part, "two": other}, {"--name": {"default": "rows"}})
    assert main([])["rows"] == [{"time": 0}, {"time": 1}]
    main(["--only", "one"])
    again = harness.stored("work")
    assert (again["rows"], again["other"]) == ([{"time": 3}, {"time": 4}], 2)
    main(["--smoke"])
    assert harness.stored("work") == again
    assert "| 3 |" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["bench_fit", "bench_images", "bench_live", "bench_paper", "bench_scene", "bench_simulator", "paper_figures"],
)
def test_smoke_of_those_without_a_test_of_their_own(name, root):
    """As a command; nothing is written."""
    results = {path: path.stat().st_mtime_ns for path in harness.RESULTS.iterdir()}
    command = [sys.executable, "-m", f"benchmarks.{name}", "--smoke"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout
    assert {path: path.stat().st_mtime_ns for path in harness.RESULTS.iterdir()} == results


@pytest.mark.slow
def test_smoke_calibration():
    data = bench_calibration.main(["--smoke"])
    assert {row["presses"] for row in data["presses"]} == {25, 225}
    every = next(row for row in data["presses"] if row["presses"] == 225)
    assert 0 < every["hold_n"] < 2.0  # N of 20, corrected for the place that an image tells
    assert bench_calibration.picture(data | {"levels": []}).axes


@pytest.mark.slow
def test_smoke_protocol():
    data = bench_protocol.main(["--smoke"])
    errors = {row["way"]: row["fit_mm"] for row in data["rows"]}
    assert errors["D-optimal"] < 2
    assert data["events"]["rest"]["readings"] == 24
    assert len(bench_protocol.picture(data).axes) == 3


@pytest.mark.slow
def test_smoke_growth():
    data = bench_growth.main(["--smoke"])
    assert len(data["fits"]) == 3
    assert all(row["median_ms"] > 0 and row["megabytes"] > 0 for row in data["rows"])


@pytest.mark.slow
def test_smoke_loads():
    data = bench_loads.main(["--smoke"])
    for part in ("rows", "chest"):
        assert {row["touch"].split(",")[0] for row in data[part]} == {"one", "two", "edge", "three"}
        assert all(0 <= row["told"] <= 1 and row["error_mm"] > 0 for row in data[part])
    frames = sum(row["frames"] for row in data["rows"])
    assert sum(row["count"] for row in data["reliability"]) == 5 * frames  # kinds
    for part in ("coverage", "ellipses"):
        assert {row["case"].split(",")[0] for row in data[part]} == set(bench_loads.SHAPES)
    assert all(row["outside"] >= row["beyond"] >= 0 for row in data["ellipses_cases"])


@pytest.mark.slow
def test_smoke_half_space():
    data = bench_half_space.main(["--smoke"])
    for part, name in (("frames", "touch"), ("tracked", "scene")):
        assert {row[name].split(",")[0].split()[0] for row in data[part]} == {"one", "two", "edge"}
        assert {row["load"] for row in data[part]} == set(bench_half_space.WAYS)
        assert all(0 <= row["told"] <= 1 and row["error_mm"] > 0 for row in data[part])
    assert [row["contacts"] for row in data["times"]] == [1, 2]
    assert all(row["wall_ratio"] > 0 for row in data["times"])


@pytest.mark.slow
def test_smoke_of_the_law_of_contacts():
    data = bench_contact_law.main(["--smoke"])
    for scene in bench_contact_law.SCENES:
        first = data[scene][0]  # before anything is learned both ways are one
        assert first["presses"] == first["used"] == 0
        assert (first["gain error"], first["gain covered"]) == (first["law error"], first["law covered"])


def test_ranks_of_pulls_are_even_if_their_deviation_is_one():
    """Pulls that are too small heap in the middle, and those that are too large at the ends."""
    rng = np.random.default_rng(4200)
    for scale, low, high in ((1.0, 0.01, 1.0), (0.5, 0.0, 1e-6), (2.0, 0.0, 1e-6)):
        rows = [{"stated place": scale * rng.normal(size=2)} for _ in range(200)]
        found = bench_learning.ranked(rows, "stated", "place")
        shares = [int(share) for share in found["place shares"].split()]
        assert found["place ranks"] == 400
        assert low <= found["place p"] <= high
        assert (shares[0] + shares[-1] > shares[4] + shares[5]) == (scale > 1) or scale == 1


@pytest.mark.slow
def test_smoke_learning():
    data = bench_learning.main(["--smoke"])
    for shape in bench_learning.SHAPES:
        before, after, known, _ = data[shape]
        assert (before["presses"], after["presses"], known["presses"]) == (0, 2, bench_learning.KNOWN)
        assert before["mm worse"] == before["force worse"] == before["law used"] == 0
        assert before["force"] == before["law force"]
        assert 0 < known["mm"] < before["mm"] < 5
        assert {row["way"] for row in data[f"{shape} ranks"]} == {"belief", "stated"}


@pytest.mark.slow
def test_smoke_tracking():
    data = bench_tracking.main(["--smoke"])
    assert {row["scene"].split(",")[0] for row in data["scenes"]} == {"crossing at 40 mm", "two in sequence", "edge"}
    assert all(0 <= row["told"] <= 1 and row["error_mm"] > 0 for row in data["scenes"])
    assert {row["learned"] for row in data["presses"]} == {"yes", "no"}
    assert {row["schedule"] for row in data["schedules"]} == {"at once", f"{bench_tracking.PIECES} pieces a frame"}
    assert [row["contacts"] for row in data["times"]] == [1, 2]


@pytest.mark.slow
def test_smoke_start():
    data = bench_start.main(["--smoke"])
    assert {row["start"] for row in data["rows"]} == set(bench_start.COMMANDS)


@pytest.mark.slow
def test_smoke_pipeline():
    data = bench_pipeline.main(["--smoke"])
    assert {row["tool"] for row in data["rows"]} >= {"jaxeit float64, pixels", "jaxeit float64, elements"}
    assert all(row["median_ms"] > 0 for row in data["rows"])


# --- tables of the README


def _frame_row(way, ms):
    return {"way": way, "least_ms": 0.0629} | {f"{name}_ms": ms for name in ("p50", "p99", "max")}


def test_tables_of_the_pages(root):
    spread = {"median_ms": 1234.0, "min_ms": 1.0, "max_ms": 2e3}
    press = {"curve": "linear", "location": "none", "spread": "scattered", "minutes": 2.1}
    results = {
        "pipeline": {
            "rows": [{"tool": "EIDORS, pixels", "nodes": n, **spread} for n in (961, 3721)],
        },
        "accuracy": {
            "to_accuracy": bench_accuracy.to_accuracy([_reached("EIDORS first order", 1, "regular", 5e-4, 20.0)]),
        },
        "inverse": {
            "rows": [{"tool": "jaxeit float64, pixels", "nodes": n, **spread} for n in (961, 3721)],
            "application": {
                "single": [_frame_row("on_host", 0.0257), _frame_row("in a loop", 0.02)],
                "single, after other work": [_frame_row("on_host", 0.1346)],
                "stream": [_frame_row("on_host", 0.0257) | {"p99.9_ms": 0.0774, "calls": 100_000, "above": 28}],
                "batch": [_frame_row("on_host", 0.0055), _frame_row("of a batch only", 1.0)],
            },
        },
        "calibration_cost": {"presses": [press | {"presses": 25}, press | {"presses": 225, "hold_n": 3.014}]},
        "protocol_cost": {
            "rows": [
                {"way": "D-optimal", "readings": 40, "frames_per_s": 2500.0, "fit_mm": 0.213},
                {"way": "at random", "readings": 40, "frames_per_s": 2500.0, "fit_mm": None},
            ],
            "events": {
                name: {"readings": 24.0, "frames_per_s": 4e3, "frames_per_s_with_switching": 2e3}
                for name in ("rest", "first", "next")
            },
        },
        "scene": {
            "sessions": [{"scene": "ideal", "recording_s": 80, "frames": 1600, "second_s": 4.0, "times_real_time": 20}],
            "rows": [
                {"effects": "none"}
                | {f"{part}_{what}": 7.0 for part in ("frame", "block") for what in ("ms", "mflop", "operations")}
            ],
        },
        "growth": {
            "fits": [
                {"series": "forward", "of": "nodes", "sizes": [961, 3721]}
                | {name: {"exponent": 1.2, "theory": "1 to 1.5"} for name in ("time", "memory")}
            ]
        },
        "start": {
            "rows": [{"start": "import jaxeit", **spread}],
            "phases": [{"phase": "tracing", "no_cache_s": 0.5, "full_cache_s": 0.5, "both_s": 0.125}],
        },
    }
    stages = dict.fromkeys(("reading", "model and images", "fitting", "holding out", "all"), 0.125)
    results["fit"] = {"end_to_end": [{"session": "bundled", "location": "no", "call": "later"} | stages]}
    rung = {"nodes": 1681, "voltage_error": 0.0018, "difference_error": 2e-4, "image": None}
    rung |= {name: {"median": 5.93e-3} for name in ("forward", "jacobian")}
    image = {"localisation": 1.234e-3, "frame": {"median": 6e-5}}
    rungs = [
        rung | {"label": "standard", "front": True, "image": image},
        rung | {"label": "P1, 2 mm", "front": True},
        rung | {"label": "behind the front", "front": False},
    ]
    results["ladder"] = {"ladders": [{"rungs": rungs}, {"rungs": rungs[:1]}]}
    run = {"rate_hz": 100, "seconds": 600.0, "received": [60000, 600000], "lost": 0, "dropped": 3}
    run |= {f"{what}_ms_{p}": 1.234 for what in ("latency", "since_due", "woken") for p in ("p50", "p99", "max")}
    results["live"] = {
        "soak": run | {"memory_mb_per_hour": 0.123, "memory_mb_per_hour_error": 0.456},
        "soak_realtime": run | {"dropped": 1},
        "tenfold": {"rate_hz": 1000, "seconds": 60.0, "recorded": [59999, 1], "lost": [1, 0]},
        "rates": [run | {"rate_hz": hz, "sustained": ok} for hz, ok in ((100, True), (400, False), (400, True))],
        "highest_hz": 400,
    }
    one = {"what": "forward", "dtype": "float32", "nodes": 961, "batch": 1024, "median_ms": 2.0, "per_s": 512e3}
    results["gpu"] = {
        "singles": [one | {"batch": 1}],
        "batches": [one | {"compile_s": 6.25, "memory_mb": 240.0}],
        "gradients": [one | {"what": "gradient", "batch": 256}],
        "peers": [one | {"tool": "cuDSS", "per_s": 15e3}],
        "training": [{"steps_per_s": 100.0, "frames_per_s": 25600.0, "first_epoch_s": 4.5}],
        "ladder": [{"label": "standard", "forward": {"median": 0.8e-3}, "jacobian": {"median": 1.25e-3}}],
    }
    searched = one | {"what": "contacts", "per_s": 17e3, "memory_mb": 16.7e3, "compile_s": 55.0}
    results["gpu_h200"] = {
        "batches": [one | {"per_s": 600e3}],
        "frames": [one | {"what": "image", "batch": 1, "median_ms": 0.22}, searched],
    }
    pages = [(root / "docs" / name).read_text() for name in ("costs.md", "live.md")]
    marks = re.findall(r"<!-- end of ([\w-]+) -->", "".join(pages))
    assert set(marks) <= set(tables.FORMATS)
    page = "".join(f"<!-- {mark}: written -->\nold\n<!-- end of {mark} -->\n" for mark in (*marks, "speed"))
    page = tables.filled(page, results)
    assert page.count("\nold\n") == 1  # only the table of speed, whose benchmarks have not run
    text = {mark: page.split(f"<!-- {mark}:")[1].split(f"<!-- end of {mark}")[0] for mark in marks}
    assert "| **standard** | 1,681 | 0.18 % | 0.02 % | 5.93 | 5.93 | 0.8 | 1.25 | 1.23 | 0.06 |" in text["ladder"]
    assert "| **P1, 2 mm** | 1,681 | 0.18 % | 0.02 % | 5.93 | 5.93 |  |  |  |  |" in text["ladder"]
    assert "behind the front" not in text["ladder"]
    for line in (
        "jaxeit, batches of 1,024 | 512,000",
        "jaxeit on an H200, batches of 1,024 | 600,000",
        "cuDSS, batches of 1,024 | 15,000",
        "compilation, s | 6.2",
    ):
        assert f"| {line} |" in text["gpu-batches"]
    assert "| forward, one call, ms | 2.00 |" in text["gpu-verbs"]
    for line in ("one image, ms | 0.22", "frames searched for contacts a second, batches of 1,024 | 17,000"):
        assert f"| {line} |" in text["gpu-frames"]
    assert "100 steps a second on the H100, of 256 random frames" in text["gpu-training"]
    assert "| bundled | no | later | 0.12 | 0.12 | 0.12 | 0.12 | 0.12 |" in text["calibration-seconds"]
    assert "| **standard** |" in text["ladder-chest"]
    assert "| at rest | 24 |  |  | 4,000 | 2,000 |" in text["event-scan"]
    assert "| none | 7 | 7 | 7 | 7 | 7 | 7 |" in text["effects"]
    assert "| EIDORS, onto pixels | 1,234 | 1,234 |" in text["pipeline"]
    assert "| jaxeit float64, onto pixels | 1,234 | 1,234 |" in text["preparation"]
    assert "| on_host | 0.026 | 0.026 | 0.026 | 0.135 | 0.135 | 0.135 | 0.0055 | 0.063 |" in text["frame"]
    assert "| in a loop | 0.020 | 0.020 | 0.020 |  |  |  |  | 0.063 |" in text["frame"]
    assert "of a batch only" not in text["frame"]
    assert "| on_host | 100,000 | 0.026 | 0.026 | 0.077 | 28 |" in text["stream"]
    assert "| EIDORS first order | 20 (9) | 20 (9) | not reached |" in text["to-accuracy"]
    assert "| linear, location none | not determined | 3.01 |" in text["calibration-cost"]
    assert "40 readings, 2,500 frames/s" in text["measurement-cost"]
    assert "| at random |  |" in text["measurement-cost"]
    assert "| forward by nodes | 961 to 3,721 | 1.2 | 1 to 1.5 | 1.2 |" in text["growth"]
    assert "| import jaxeit | 1.23 |" in text["start"]
    assert (
        "| live and recorded, 100 Hz, 10 min | 60,000 | 0 | 3 | 1.23 | 1.23 | 1.23 | 1.23 | 1.23 | 0.12 ±"
        in text["live"]
    )
    assert "| live and recorded, 100 Hz, 10 min, `--realtime` | 60,000 | 0 | 1 |" in text["live"]
    assert "| recorded, 1000 Hz, 1 min | 59,999 | 1 |" in text["live"]
    assert text["live"].count("highest rate sustained: 400 Hz") == 1
