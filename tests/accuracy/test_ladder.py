"""What accuracy costs: errors against an oracle, the front, what is recommended and what is refused; no assertion is
about time."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import calib.cli
import jaxeit as je
from benchmarks import ladder as benchmark
from calib.cli.commands.skins.bench_command import bench_scene
from calib.report.figures.accuracy import ladder_figure
from jaxeit.accuracy.image_quality import misplaced
from jaxeit.accuracy.recommendation import Reference, Times
from jaxeit.accuracy.settings import default_touches, refined
from jaxeit.accuracy.solutions import Readings, bump, extrapolated, touched
from jaxeit.linalg import Dense

from ..helpers import skin_of
from ..oracles.rectangle import green

POINTS = [(x, y) for y in (0.04, 0.1, 0.16) for x in (0.04, 0.1, 0.16)]
PATTERN = [[0, 4, 1, 2], [0, 8, 3, 6], [1, 7, 2, 5], [3, 5, 0, 6], [2, 6, 4, 8], [8, 0, 5, 7]]
COARSE = je.Fidelity(edge_length=0.12, order=2, electrode_segments=8, growth=1.6)
TOUCHES = (je.accuracy.Touch("near", (0.07, 0.08), 0.03), je.accuracy.Touch("far", (0.13, 0.14), 0.03))


@pytest.fixture(scope="module")
def scene():
    pads = (je.Pad("all", np.array([[0, 0], [0.2, 0], [0.2, 0.2], [0, 0.2]])),)
    return je.Scene(skin_of(je.Rectangle(0.2, 0.2), [je.PointElectrode(p) for p in POINTS], PATTERN, pads=pads))


def fidelity(factor, order=2, dtype=np.float64):
    """Of one family; dense, since that compiles quickest."""
    return replace(refined(COARSE, factor), order=order, dtype=np.dtype(dtype), solver=Dense())


@pytest.fixture(scope="module")
def found(scene):
    choices = (
        je.accuracy.Choice("coarse", fidelity(1), None),
        je.accuracy.Choice("middle", fidelity(1.4), je.Imaging(je.Pixels(12))),
        je.accuracy.Choice("single", fidelity(1.4, dtype=np.float32), None),
    )
    return je.ladder(scene, choices, touches=TOUCHES, reference=(fidelity(1.7), fidelity(2.2)), budget=0.0)


@pytest.mark.slow
def test_errors_fall_at_least_with_the_square_of_the_edge(found):
    coarse, middle = found.rungs[:2]
    for name in ("voltage_error", "difference_error"):
        assert np.log(getattr(coarse, name) / getattr(middle, name)) / np.log(1.4) > 1.7, name


def exact(a, b):
    """Along the axis in which the points lie farther apart, where the series is quick."""
    flip = slice(None, None, -1 if abs(a[0] - b[0]) > abs(a[1] - b[1]) else 1)
    return green(0.2, 0.2, a[flip], b[flip])


def test_the_reference_is_as_near_to_the_exact_solution_as_it_says(found):
    rows = [[POINTS[i] for i in row] for row in PATTERN]
    want = np.array([exact(p, a) - exact(m, a) - exact(p, b) + exact(m, b) for a, b, p, m in rows])
    off = np.linalg.norm(found.reference.voltages - want) / np.linalg.norm(want)
    assert off < found.reference.voltage_uncertainty < 1e-4
    assert found.rungs[1].voltage_error > 3 * off


def test_the_extrapolation_of_what_is_of_second_order_is_exact():
    want, wants = np.array([1.0, -2.0, 3.0]), np.array([[0.1, 0.2, -0.3]])

    def readings(edge):
        return Readings(je.Fidelity(edge_length=edge), 7, want * (1 + edge**3), wants * (1 - 3 * edge**2))

    reference = extrapolated(readings(0.1), readings(0.04))
    np.testing.assert_allclose(reference.voltages, want, rtol=1e-14)
    np.testing.assert_allclose(reference.differences, wants, rtol=1e-14)
    assert reference.voltage_uncertainty > 0.04**3  # more cautious than its order
    assert reference.difference_uncertainty == pytest.approx(3 * 0.04**2)


def test_single_precision_is_a_rung_of_its_own(found):
    coarse, single = found.rungs[1:]
    assert coarse.unknowns == single.unknowns
    assert single.memory < coarse.memory
    assert single.difference_error == pytest.approx(coarse.difference_error, rel=0.02)
    assert single.difference_error != coarse.difference_error


def test_images_are_judged_where_they_are_asked_for(found):
    assert [rung.image is None for rung in found.rungs] == [True, False, True]
    image = found.rungs[1].image
    assert 0 < image.localisation <= image.worst < 0.05
    assert 0 < image.misplaced < 0.8
    assert found.image_front() == (found.rungs[1],)


@pytest.mark.parametrize("pads", [True, False])
def test_a_perfect_image_misplaces_nothing(scene, pads):
    skin = scene.skin if pads else replace(scene.skin, pads=())
    pixels = je.Pixels(12).on(je.discretise(scene, fidelity(1)))
    true = np.stack(
        [np.exp(-0.5 * np.sum((pixels.centres - np.array(t.position)) ** 2, 1) / t.width**2) for t in TOUCHES]
    )
    assert misplaced(skin, pixels, jnp.asarray(true), TOUCHES) == pytest.approx(0, abs=1e-12)
    beside = jnp.asarray(np.roll(true.reshape(2, 12, 12), 3, 1).reshape(2, -1))
    assert (misplaced(skin, pixels, beside, TOUCHES) > 0.5).all()


def test_a_touch_is_the_same_on_every_mesh(scene):
    touch = je.accuracy.Touch("small", (0.09, 0.1), 0.012)
    for factor in (1, 2):
        model = je.discretise(scene, fidelity(factor))
        total = float(np.asarray(model.areas) @ bump(model, touch))
        assert total == pytest.approx(2 * np.pi * touch.width**2, rel=2e-3)


def test_a_touch_is_a_pressure_where_something_answers_to_it(scene):
    bare = je.discretise(scene, fidelity(1))
    raised = jnp.asarray(bump(bare, TOUCHES[0]))
    np.testing.assert_allclose(touched(bare, bare.background, TOUCHES[0]), 1 + 0.5 * raised)
    coated = je.discretise(je.Scene(scene.skin, (je.effects.HomogenisedIslands(),)), fidelity(1))
    pressed = je.conductivity(coated, 5e4 * raised)
    np.testing.assert_array_equal(touched(coated, je.conductivity(coated), TOUCHES[0]), pressed)
    assert float(jnp.max(pressed / coated.background)) > 1.01


@pytest.mark.parametrize("name", je.skin.shipped_skins())
def test_touches_lie_on_the_sheet_of_every_skin(name):
    skin = je.load_skin(name)
    touches = default_touches(skin)
    assert [t.name for t in touches] == ["middle", "by a pad's edge", "by the rim", "between electrodes"]
    assert skin.domain.contains(np.array([t.position for t in touches])).all()


def test_finer_is_finer_everywhere():
    for base in (je.Fidelity.draft(), je.Fidelity.reference()):
        for factor in (1.1, 1.5, 2, 3):
            finer = refined(base, factor)
            assert finer.edge_length == pytest.approx(base.edge_length / factor)
            assert finer.electrode_segments == pytest.approx(base.electrode_segments * factor, rel=0.1)
            assert finer.growth < base.growth
            je.AreaPatch((0, 0), 1e-3, 0.0).footprint(finer.electrode_segments)  # refuses counts it cannot halve


# --- choosing --------------------------------------------------------------------------------------------------------


def made(*costs, uncertainty=1e-4):
    """A ladder of float64 rungs with these difference errors and times in ms, named by their place."""
    rungs = []
    for number, (error, ms) in enumerate(costs):
        times = Times(1e-3 * ms, 1e-3 * ms, 1e-3 * ms, 3)
        choice = je.accuracy.Choice(f"rung {number}", je.Fidelity(edge_length=0.01 + 1e-3 * number), None)
        rungs.append(je.accuracy.Rung(choice, 10, 9, error / 2, error, 0.1, 0.2, times, times, None, None))
    pair = (je.Fidelity(edge_length=0.004), je.Fidelity(edge_length=0.002))
    reference = Reference(pair, (100, 200), np.ones(2), np.ones((1, 2)), 1e-5, uncertainty)
    return je.accuracy.Ladder("test", (), "cpu", TOUCHES, reference, tuple(rungs))


def test_the_quickest_within_the_error_and_the_best_within_the_time():
    ladder = made((1e-2, 1), (4e-3, 4), (3e-3, 3), (1e-3, 20))
    assert ladder.recommend(error=5e-3).choice.label == "rung 2"
    assert ladder.recommend(budget_ms=10).choice.label == "rung 2"
    assert ladder.recommend(budget_ms=2).choice.label == "rung 0"
    assert ladder.recommend(budget_ms=30, error=2e-3).choice.label == "rung 3"
    assert "has 0.003 in 3 ms\n    jaxeit.Fidelity(edge_length=0.012, order=1" in ladder.advice(error=5e-3)


@pytest.mark.parametrize(
    ("wish", "said"),
    [
        ({}, "give budget_ms, error or both"),
        ({"error": 1e-5}, "the best, rung 1, has 0.0001 in 4 ms: allow more"),
        ({"budget_ms": 0.5}, "the quickest, rung 0, has 0.01 in 1 ms: give more time"),
        ({"budget_ms": 2, "error": 1e-3}, "in 2 ms; the best, rung 0"),
        ({"error": float("nan")}, "error is nan"),
        ({"budget_ms": -1}, "budget_ms is -1"),
    ],
)
def test_what_no_rung_fulfils_is_refused_in_a_line(wish, said):
    with pytest.raises(je.accuracy.LadderError) as caught:
        made((1e-2, 1), (1e-7, 4)).recommend(**wish)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_error_is_promised_below_the_references_own():
    ladder = made((1e-6, 9), (5e-5, 2), (1e-3, 1))
    assert ladder.recommend(budget_ms=100).choice.label == "rung 1"  # as good as rung 0 for all we know, and quicker
    assert [r.choice.label for r in ladder.front()] == ["rung 1", "rung 2"]
    assert "< 0.01 %" in ladder.table()


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(st.floats(1e-3, 1), st.floats(0.1, 100)), min_size=1, max_size=8))
def test_the_front_is_what_nothing_beats(costs):
    ladder = made(*costs)
    front = {int(rung.choice.label.split()[1]) for rung in ladder.front()}
    ms = [1e3 * rung.forward.median for rung in ladder.rungs]
    for i, (error, _) in enumerate(costs):
        better = [j for j, (e, _) in enumerate(costs) if e <= error and ms[j] <= ms[i] and (e, ms[j]) != (error, ms[i])]
        assert (i in front) == (not better)


def test_a_fidelity_is_listed_once_in_the_order_asked_for():
    ladder = made((1e-2, 1), (1e-3, 4), (1e-4, 9))
    again = replace(ladder.rungs[0], choice=je.accuracy.Choice("images", ladder.rungs[0].choice.fidelity))
    ladder = replace(ladder, rungs=(*ladder.rungs, again))
    assert [r.choice.label for r in ladder.fidelities()] == ["rung 0", "rung 1", "rung 2"]


@pytest.mark.parametrize(
    ("choices", "more", "said"),
    [
        ((), {}, "there are no rungs"),
        ((je.accuracy.Choice("a", COARSE),) * 2, {}, "labels"),
        ((je.accuracy.Choice("a", COARSE),), {"touches": ()}, "no touches"),
        (
            (je.accuracy.Choice("a", COARSE),),
            {"reference": (refined(COARSE, 2), refined(COARSE, 1.5))},
            "must be finer",
        ),
        ((je.accuracy.Choice("a", COARSE),), {"reference": (COARSE, refined(COARSE, 2))}, "would judge itself"),
    ],
)
def test_rungs_that_cannot_be_compared_are_refused(scene, choices, more, said):
    with pytest.raises(je.accuracy.LadderError, match=said):
        je.ladder(scene, choices, **more)


def test_a_touch_without_width_is_refused():
    with pytest.raises(je.accuracy.LadderError, match="above zero"):
        je.accuracy.Touch("none", (0.0, 0.0), 0.0)


# --- telling ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [60, 80, 140])
def test_the_table_fits_the_terminal(found, width):
    lines = found.table(width).splitlines()
    assert max(map(len, lines)) <= width
    assert sum("solve ms" in line for line in lines) == 1
    assert sum(line.split()[:2] == ["*", "middle"] or line.split()[:1] == ["middle"] for line in lines) == 2
    assert all(any(label in line for line in lines) for label in ("coarse", "single"))


def test_the_summary_is_json_and_draws(found):
    numbers = json.loads(json.dumps(found.summary(), allow_nan=False))
    assert [rung["label"] for rung in numbers["rungs"]] == ["coarse", "middle", "single"]
    assert numbers["rungs"][1]["image"]["frame"]["repeats"] == 3
    assert numbers["rungs"][2]["fidelity"]["dtype"] == "float32"
    for rung, least, error in zip(numbers["rungs"], (2e-3, 1e-3, 1e-2), (3e-2, 2e-2, 1e-2), strict=True):
        rung |= {"least_ms": least, "difference_error": error}
    figure = ladder_figure([numbers, numbers])
    assert [axes.get_title() for axes in figure.axes] == ["test", "test"]
    (limit,) = (line for line in figure.axes[1].lines if line.get_linestyle() == ":")
    np.testing.assert_allclose(limit.get_xydata(), [(1e-3, 2), (1e-2, 1)])  # the first rung takes longer and errs more


def test_the_command_prints_recommends_and_draws(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(je, "ladder", lambda *args, **more: made((1e-2, 1), (1e-3, 4)))
    picture = tmp_path / "new" / "ladder.png"
    assert calib.cli.main(["bench", "--error", "2e-3", "-o", str(picture)]) == 0
    out = capsys.readouterr().out
    assert "recommended: rung 1" in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert calib.cli.main(["bench", "chest", "--json", "--budget-ms", "2"]) == 0
    assert json.loads(capsys.readouterr().out)["recommended"] == "rung 0"
    assert calib.cli.main(["bench", "--json", "--error", "1e-9"]) == 2
    told = capsys.readouterr()
    assert len(json.loads(told.out)["rungs"]) == 2  # the work is not lost
    begins, refusal = told.err.splitlines()
    assert begins.endswith("mesh nodes: this takes a while")
    assert refusal.startswith("jaxeit: no rung has an error of 1e-09")


@pytest.mark.parametrize("what", ["nonesuch", "nonesuch.toml"])
def test_an_unknown_skin_is_one_line_that_names_those_there_are(what, capsys):
    assert calib.cli.main(["bench", what]) == 2
    error = capsys.readouterr().err
    assert f"{what}: no such file, skin or scene; shipped are chest, testbed" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(("line", "said"), [('format = "jaxeit-skim"', "is 'jaxeit-skim'"), ("", "missing")])
def test_a_file_of_neither_kind_is_told_which_there_are(line, said, tmp_path, capsys):
    path = tmp_path / "mine.toml"
    path.write_text(f"{line}\nversion = 1\n")
    assert calib.cli.main(["bench", str(path)]) == 2
    assert f'{path}: format: {said}; give "jaxeit-skin" or "jaxeit-scene"' in capsys.readouterr().err


def test_scenes_and_skins_are_told_apart(tmp_path, root, skin):
    (tmp_path / "mine.toml").write_text(skin.toml)
    assert bench_scene(str(tmp_path / "mine.toml")).effects == ()
    scene = bench_scene(str(root / "data" / "sessions" / "testbed_grid.toml"))
    assert scene.skin.name == "testbed"
    assert scene.effects


def test_a_wrong_number_or_place_is_refused_before_the_work(capsys, tmp_path):
    with pytest.raises(SystemExit) as caught:
        calib.cli.main(["bench", "--error", "-1"])
    assert caught.value.code == 2
    assert "give a number above zero" in capsys.readouterr().err
    assert calib.cli.main(["bench", "-o", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err


@pytest.mark.slow
def test_the_benchmark_smokes():
    data = benchmark.main(["--smoke"])
    (found,) = data["ladders"]
    assert [rung["label"] for rung in found["rungs"]] == [choice.label for choice in je.accuracy.few_choices()]
    assert found["rungs"][0]["least_ms"] > 0
    assert "least_ms" not in found["rungs"][1]  # float32
    assert 0 < found["reference"]["difference_uncertainty"] < found["rungs"][0]["difference_error"]


def test_a_name_and_a_skin_are_no_scene(skin):
    with pytest.raises(je.model.SceneError, match=r"str is not a scene; make one, such as jaxeit.Scene\(skin, effects"):
        je.ladder("testbed")
    with pytest.raises(je.model.SceneError, match="Skin is not a scene"):
        je.ladder(skin)
