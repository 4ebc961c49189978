"""The simulated bench: its motion, its frames from few solves, its blocks, its presets."""

import dataclasses
import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest

import calib
import jaxeit as je
from calib.bench import (
    Bench,
    BenchError,
    Companion,
    Timing,
    grid,
    load_bench,
    measure_costs,
    presets,
    render_costs,
    simulate,
    simulate_contacts,
    simulation,
    streams,
)
from calib.bench.interpolation import ParameterBox, enclosing_boxes, interpolant
from calib.bench.motion import loads_at, planned_motion
from calib.bench.resolution import force_shares
from calib.bench.streams import simulated_streams

DRAFT = je.Fidelity.draft()
QUICK = Timing(rest=0.1, ramp=0.3, hold=0.3, release=0.2, recovery=0.1)
SHEET = (je.effects.LoadSpreading(), je.effects.ContactPiezoresistance())


def _bench(skin, *effects, sites=((0.06, 0.07), (0.13, 0.1)), **changes):
    given = {"timing": QUICK, "blank": 0.2, "eit_rate": 50.0, "pad_rate": 100.0, "toml": "x"} | changes
    return Bench(je.Scene(skin, effects), np.array(sites), given.pop("forces", np.array([10.0, 20.0])), **given)


def _all(recording, blocks=None):
    """A stream from its first block to the last."""
    state, out = recording.start(), []
    for number in range(recording.blocks if blocks is None else blocks):
        samples, state = recording.block(number, state)
        out.append(samples)
    return streams.SampleBlock(*(np.concatenate(parts) for parts in zip(*out, strict=True)))


def test_a_tip_goes_down_slides_and_comes_up(skin):
    bench = _bench(skin, slide=(0.05, 0.0), companions=(Companion((0.0, 0.03), 5.0, delay=0.1),))
    assert bench.period == pytest.approx(1.1)
    start = 0.2 + 1.1
    now = loads_at(planned_motion(bench), start + np.array([0.0, 0.1, 0.25, 0.4, 0.55, 0.7, 0.8, 0.9, 1.0]))
    np.testing.assert_allclose(now.load[:, 0], [0, 0, 10, 20, 20, 20, 10, 0, 0], atol=1e-9)
    np.testing.assert_allclose(now.load[:, 1], [0, 0, 2.5 - 2.5 * np.cos(np.pi / 6), 3.75, 5, 5, 5, 2.5, 0], atol=1e-9)
    np.testing.assert_allclose(now.progress[[3, 4, 5], 0], [0, 0.5, 1], atol=1e-12)
    assert (np.diff(now.phase) >= 0).all()


def test_rest_loading_hold_and_unloading_share_a_box():
    low = np.array([[0, 0], [0.1, 0], [20, 0], [0.2, 0], [0, 0], [np.inf] * 2], float)
    high = np.array([[0, 0], [19, 0], [20, 0], [20, 0], [0, 0], [-np.inf] * 2], float)
    found, owner = enclosing_boxes(low, high, np.array([20.0, 1.0]))
    assert len(found) == 1
    np.testing.assert_array_equal(owner[:5], 0)
    np.testing.assert_array_equal([found[0].low, found[0].high], [[0, 0], [20, 0]])


def test_a_slide_has_a_box_of_its_own():
    low = np.array([[0, 0], [0, 0], [20, 0], [0, 1]], float)
    high = np.array([[0, 0], [20, 0], [20, 1], [20, 1]], float)
    found, owner = enclosing_boxes(low, high, np.array([20.0, 1.0]))
    assert len(found) == 3
    assert owner[0] == owner[1] != owner[2] != owner[3]


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_interpolants_keep_their_tolerance(tolerance):
    """Against the function itself, smooth in two numbers with one at rest."""

    def exact(q):
        return np.stack([1 / (1 + q[:, 0] / 7), np.exp(-q[:, 2]) * np.sqrt(3 + q[:, 0]), 0 * q[:, 0] + 2], 1)

    box = ParameterBox(np.array([0.0, 5.0, -0.5]), np.array([20.0, 5.0, 1.0]))
    rest = exact(np.zeros((1, 3)))[0]
    made = interpolant(box, exact, rest, tolerance)
    q = box.low + np.random.default_rng(0).random((200, 3)) * (box.high - box.low)
    change = np.abs(exact(q) - rest).max()
    assert np.abs(made(q[:, None]) - exact(q)).max() < 2 * tolerance * change
    each = made(np.stack([q, q[::-1], q], 1))  # readings at times of their own
    np.testing.assert_allclose(each[:, 0], made(q[:, None])[:, 0], rtol=1e-12)
    np.testing.assert_allclose(each[:, 1], made(q[::-1, None])[:, 1], rtol=1e-12)
    assert made.solves < 600


def _reciprocal(slopes, weights):
    """Steepest at low parameters, where a load begins to act, and more so where several are low."""
    return lambda q: (1 / (1 + q @ slopes.T)) @ weights - weights.sum(0)


def _symmetric(slopes, weights):
    """Even about the middle of all ranges, as a slide over the middle of a sheet."""
    return lambda q: np.exp(-2 * ((q - 0.5) ** 2) @ slopes.T) @ weights


@pytest.mark.parametrize("kind", [_reciprocal, _symmetric])
@pytest.mark.parametrize("variables", [1, 2, 3])
def test_interpolants_do_not_underestimate_their_error(kind, variables):
    rng = np.random.default_rng([7, variables])
    for _ in range(5):
        exact = kind(rng.uniform(0.2, 1.5, (5, variables)), rng.normal(size=(5, 20)))
        box = ParameterBox(np.zeros(variables), np.ones(variables))
        made = interpolant(box, exact, np.zeros(20), 1e-4)
        q = rng.random((500, variables))
        error, change = np.abs(made(q[:, None]) - exact(q)).max(), np.abs(exact(q)).max()
        assert error < min(made.error, 1e-4 * change)


def test_noise_of_the_solver_is_not_interpolated():
    """In single precision, whose rounding errors are above the tolerance."""
    rng, box = np.random.default_rng(5), ParameterBox(np.zeros(2), np.ones(2))
    rest = np.ones(20, np.float32)

    def solve(q):
        exact = 1 + 0.01 * q.prod(1, keepdims=True) * np.ones(20)
        return (exact + rng.uniform(-50, 50, exact.shape) * np.finfo(np.float32).eps).astype(np.float32)

    assert interpolant(box, solve, rest, 1e-4).solves < 40


def test_a_sheet_at_rest_is_solved_once():
    box = ParameterBox(np.array([0.0, 2.0]), np.array([0.0, 2.0]))
    made = interpolant(box, lambda q: q + 1, np.zeros(2), 1e-4)
    np.testing.assert_array_equal(made(np.tile(box.low, (3, 2, 1))), [[1, 3]] * 3)
    assert (made.solves, made.error) == (1, 0)


def test_frames_from_few_solves_are_those_of_a_solve_each(skin):
    """With a tip that slides, a second one, hysteresis, and readings taken one after the other."""
    few = dataclasses.replace(skin.protocol, pattern=skin.protocol.pattern[::100], reading_time=1e-3)
    second = Companion((0.05, 0.0), 8.0, delay=0.3)
    bench = _bench(
        dataclasses.replace(skin, protocol=few), *SHEET, je.effects.Hysteresis(), je.effects.ScanSkew(),
        slide=(0.02, 0.01), companions=(second,), sites=((0.06, 0.07),), eit_rate=25.0,
    )  # fmt: skip
    joined = simulated_streams(bench, DRAFT).eit
    each = simulated_streams(bench, dataclasses.replace(DRAFT, interpolation=0)).eit
    got, exact = _all(joined).values, _all(each).values
    assert np.abs(got - exact).max() < 1e-4 * np.abs(exact - exact[0]).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sliding", "two_contacts", "hot_day"])
def test_presses_of_shipped_scenes_keep_the_tolerance(name):
    """At random loads, places and temperatures, against a solve each; the estimated error is never too small."""
    bench = load_bench(name)
    bench = dataclasses.replace(bench, sites=bench.sites[:3], eit_rate=10.0, blank=1.0)
    eit = simulated_streams(bench, DRAFT).eit
    rng, low, high = np.random.default_rng(3), *eit._extents()
    for press in range(3):
        errors, changes = [], []
        for phase in np.flatnonzero(np.isfinite(low[press, :, 0])):
            points = low[press, phase] + rng.random((12, low.shape[-1])) * (high - low)[press, phase]
            exact, where = eit._solve(press, points), np.ones((12, 1), int)
            got = eit._frames(press * where, phase * where, points[:, None])
            errors.append(np.abs(got - exact).max())
            changes.append(np.abs(exact - eit.resting).max())
        assert max(errors) < 1e-4 * max(changes)
        assert max(errors) < max(made.error for made in eit._frames.polynomials(press))


def test_a_press_takes_few_solves(skin):
    quick = replace(skin, protocol=replace(skin.protocol, reading_time=1e-6))
    made = simulated_streams(_bench(quick, *SHEET, je.effects.Hysteresis(), eit_rate=500.0), DRAFT).eit
    _all(made)
    assert made.samples > 1000
    assert made.solves == 7 + 8


@pytest.mark.slow
def test_a_scan_takes_its_readings_one_after_the_other(skin):
    """Reading m of a skewed frame is reading m of a frame taken at its own time."""
    skewed = simulated_streams(_bench(skin, *SHEET, je.effects.ScanSkew()), DRAFT).eit
    plain = simulated_streams(_bench(skin, *SHEET), DRAFT).eit
    at = np.array([0.45])
    some = [0, 200, 549]
    late = [plain.quantity(0, at + m * skin.protocol.reading_time, ())[0][0, m] for m in some]
    got, frame = skewed.quantity(0, at, ())[0][0], plain.quantity(0, at, ())[0][0]
    size = np.abs(frame - plain.resting).max()
    np.testing.assert_allclose(got[some], late, rtol=0, atol=1e-9 * size)
    assert np.abs(got - frame).max() > 2e-2 * size


def test_pads_and_load_cell_feel_all_tips(skin):
    bench = _bench(skin, je.effects.LoadSpreading(width=0.02), companions=(Companion((0.0, 0.08), 5.0),))
    made = simulated_streams(bench, DRAFT)
    force, pads = _all(made.force).values, _all(made.pressure).values
    assert force.max() == pytest.approx(25.0)
    # An ideal pad holds the load on it over its area; the tips stand whole on pads of 0.01 m2.
    np.testing.assert_allclose(pads.sum(1), force[:, 0] / skin.pads[0].area, rtol=0.03, atol=1.0)


def test_the_converter_holds_what_the_skin_reads(skin, tmp_path):
    """A step of the converter that the scene leaves open suits a sheet of any resistance."""
    resistive = dataclasses.replace(skin, sheet_resistance=40 * skin.sheet_resistance)
    bench = _bench(resistive, *SHEET)
    with calib.open_session(simulate(bench, tmp_path / "session.h5", fidelity=DRAFT)) as session:
        recorded = session.streams["eit"].read()
    exact = _all(simulated_streams(bench, DRAFT).eit).values
    np.testing.assert_allclose(recorded, exact, rtol=0, atol=1e-4 * np.abs(exact).max())


def test_effects_of_the_stage_and_the_clock_reach_the_file(skin, tmp_path):
    unsteady = je.effects.StageError(position=1e-3, jitter=0.0, ripple=0.0)
    bench = _bench(skin, unsteady, je.effects.DropOut(probability=0.2), je.effects.ClockError(jitter=0.01))
    with calib.open_session(simulate(bench, tmp_path / "s.h5", fidelity=DRAFT)) as session:
        eit = session.stream("eit")
        moved = session.truth["contact_position"] - bench.sites
        assert 1e-5 < np.abs(moved).max() < 5e-3
        assert len(eit) < bench.duration * 50
        gaps = (eit.status() & int(calib.session.Status.gap_before)) > 0
        device = eit.time_device.astype(float) * 1e-6
        assert gaps[1:].sum() > 2
        np.testing.assert_array_equal(gaps[1:], np.diff(device) > 1.5 / 50)
        late = eit.time * 1e-9 - device / (1 + 50e-6)
        assert late.min() >= 0.0009
        assert len(session.stream("force")) == int(bench.duration * 100)


class _Killed(Exception):
    pass


def _stop_after(count):
    def progress(work):
        for number, item in enumerate(work):
            if number == count:
                raise _Killed
            yield item

    return progress


def test_a_run_that_was_killed_goes_on_and_gives_the_same_file(skin, tmp_path, monkeypatch):
    monkeypatch.setattr(streams, "BLOCK_ROWS", 16)
    effects = (
        *SHEET,
        je.effects.Hysteresis(),
        je.effects.PadLeak(time=1.0),
        je.effects.BaselineDrift(rate=0.01),
        je.effects.Noise(std=1e-5),
    )
    bench = _bench(skin, *effects, sites=((0.06, 0.07),))
    whole = simulate(bench, tmp_path / "whole.h5", fidelity=DRAFT).read_bytes()
    made = []
    for count in (3, 5, 9):
        with pytest.raises(_Killed):
            simulate(bench, tmp_path / "cut.h5", fidelity=DRAFT, progress=_stop_after(count))
        assert not (tmp_path / "cut.h5").exists()
        made.append({p.name: p.stat().st_mtime_ns for p in (tmp_path / "cut.h5.part").iterdir()})
    assert made[0].items() <= made[1].items() <= made[2].items()  # nothing was made twice
    assert simulate(bench, tmp_path / "cut.h5", fidelity=DRAFT).read_bytes() == whole
    assert {p.name for p in tmp_path.iterdir()} == {"whole.h5", "cut.h5"}


@pytest.mark.slow
def test_the_remains_of_another_scene_are_not_used(skin, tmp_path):
    first, second = (_bench(skin, *SHEET, sites=((x, 0.07),)) for x in (0.06, 0.1))
    with pytest.raises(_Killed):
        simulate(first, tmp_path / "s.h5", fidelity=DRAFT, progress=_stop_after(2))
    path = simulate(second, tmp_path / "s.h5", fidelity=DRAFT)
    assert path.read_bytes() == simulate(second, tmp_path / "t.h5", fidelity=DRAFT).read_bytes()


def test_benches_of_one_file_that_differ_make_recordings_that_differ(skin, tmp_path):
    ids = []
    for x in (0.06, 0.1):
        with calib.open_session(
            simulate(_bench(skin, sites=((x, 0.07),)), tmp_path / f"{x}.h5", fidelity=DRAFT)
        ) as one:
            ids.append(one.session_id)
    assert ids[0] != ids[1]


class Breaks(je.effects.AbstractReadoutEffect):
    """A user's effect that divides by a pressure that is zero at rest."""

    stream: ClassVar[je.effects.StreamKind] = je.effects.StreamKind.PRESSURE

    def __call__(self, series, state, inputs):
        return series / jnp.abs(series), state


def test_an_effect_that_makes_no_numbers_ends_the_simulation(skin, tmp_path):
    with pytest.raises(BenchError, match="block 0 of pressure has samples that are no finite numbers; an effect"):
        simulate(_bench(skin, Breaks(), sites=((0.06, 0.07),)), tmp_path / "s.h5", fidelity=DRAFT)
    assert not (tmp_path / "s.h5").exists()


def test_a_folder_in_the_way_is_left_alone(skin, tmp_path):
    (tmp_path / "s.h5.part").mkdir()
    (tmp_path / "s.h5.part" / "thesis.txt").write_text("dear reader")
    with pytest.raises(BenchError, match="exists and was not made by this program"):
        simulate(_bench(skin), tmp_path / "s.h5", fidelity=DRAFT)
    assert (tmp_path / "s.h5.part" / "thesis.txt").exists()


def test_a_session_that_the_disk_cannot_hold_is_not_begun(skin, tmp_path):
    with pytest.raises(BenchError, match=r"the session takes .* GB are free; most of it is pressure: lower its rate"):
        simulate(_bench(skin, pad_rate=1e13), tmp_path / "s.h5", fidelity=DRAFT)
    assert not list(tmp_path.iterdir())


def test_blocks_of_an_earlier_run_take_no_further_space(skin, tmp_path, monkeypatch):
    monkeypatch.setattr(simulation.shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    made, part = simulated_streams(_bench(skin), DRAFT), tmp_path / "s.h5.part"
    with pytest.raises(BenchError, match="0 GB are free"):
        simulation._require_space(made, part)
    part.mkdir()
    (part / "eit-000000.npz").write_bytes(bytes(10_000_000))  # more than the whole session
    simulation._require_space(made, part)


@pytest.mark.slow
def test_blocks_do_not_show(skin, monkeypatch):
    """Histories handed from block to block are those of one run; only the draws of chance differ."""
    bench = _bench(
        skin,
        *SHEET,
        je.effects.Hysteresis(),
        je.effects.Creep(),
        je.effects.PadLeak(time=1.0),
        je.effects.GasRelaxation(),
    )
    whole = simulated_streams(bench, DRAFT)
    expected = [_all(recording).values for _, recording in whole]
    monkeypatch.setattr(streams, "BLOCK_ROWS", 16)
    for (_, recording), values in zip(simulated_streams(bench, DRAFT), expected, strict=True):
        scale = np.abs(values).max()
        np.testing.assert_allclose(_all(recording).values, values, rtol=0, atol=1e-9 * scale)


@pytest.mark.slow
def test_warmth_is_simulated_where_it_is_felt(skin):
    bench = _bench(
        skin, *SHEET, je.effects.SheetTemperature(coefficient=0.01), sites=((0.06, 0.07),), temperature_rate=5.0
    )
    warm = simulated_streams(bench, DRAFT).eit
    assert warm._feels_warmth
    frames = _all(warm).values
    last = 5.0 * (warm.samples - 1) / 50
    expected = je.forward(warm.model, je.conductivity(warm.model, None, last))
    np.testing.assert_allclose(frames[-1], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    unmoved = simulated_streams(_bench(skin, *SHEET, temperature_rate=5.0), DRAFT).eit
    assert not unmoved._feels_warmth


@pytest.mark.parametrize("name", presets())
def test_presets_are_benches(name):
    bench = load_bench(name)
    assert bench.scene.skin.name == ("chest" if name.startswith("chest") else "testbed")
    assert bench.duration < 3600
    assert (name == "ideal") == (not bench.scene.effects)


def test_every_preset_asked_for_is_there():
    on_testbed = {"ideal", "paper_bench", "rolling", "sliding", "two_contacts", "hot_day", "broken_electrode"}
    assert on_testbed | {"chest_bench", "chest_two_contacts"} <= set(presets())


@pytest.mark.slow
def test_the_chest_from_scene_to_force_map(tmp_path):
    """Every third press of the shipped scene is calibrated; two contacts of the other scene are mapped."""
    bench, pair = load_bench("chest_bench"), load_bench("chest_two_contacts")
    bench = dataclasses.replace(bench, sites=bench.sites[::3], eit_rate=10.0, pad_rate=20.0, blank=5.0)
    grid = simulate(bench, tmp_path / "grid.h5", fidelity=DRAFT)
    recipe = calib.Recipe(fidelity=DRAFT)
    with calib.open_session(grid) as session:
        calibration = calib.calibrate([session], recipe=recipe)
    assert calibration.evaluation.summary()["localisation_half_mean"] < 0.02
    calib.write_report(calibration, tmp_path / "report.html")
    assert (tmp_path / "report_curved.png").exists()
    short = dataclasses.replace(pair, sites=pair.sites[:1], eit_rate=10.0, blank=2.0)
    with calib.open_session(simulate(short, tmp_path / "pair.h5", fidelity=DRAFT)) as session:
        calib.apply(calibration, session, tmp_path / "map.h5")
    found = calib.session.read_archive(tmp_path / "map.h5", "skin-forcemap").arrays
    assert found["pad_force"].sum(1).max() == pytest.approx(25, rel=0.3)  # 15 N and 10 N, without a correction


def test_a_grid_of_presses_keeps_what_an_l_shaped_sheet_holds(tmp_path):
    corners = [[0, 0], [0.18, 0], [0.18, 0.06], [0.09, 0.06], [0.09, 0.12], [0, 0.12]]
    (tmp_path / "skin.toml").write_text(
        'format = "jaxeit-skin"\nversion = 1\nname = "l"\n'
        f'[sheet]\nshape = "polygon"\nvertices = {corners}\nsheet_resistance = 200.0\n'
        '[electrodes]\nkind = "point"\npositions = [[0.02, 0.02], [0.1, 0.02], [0.16, 0.04], [0.04, 0.1]]\n'
        '[protocol]\npattern = "adjacent"\ncurrent = 1e-3\n[[pads]]\nname = "a"\nrectangle = [0.0, 0.0, 0.09, 0.06]\n'
    )
    scene = (
        'format = "jaxeit-scene"\nversion = 1\ntitle = "t"\nskin = "skin.toml"\nseed = 1\n'
        "[bench]\ncolumns = 9\nrows = 6\nmargin = MARGIN\nforces = [3.0]\neit_rate = 5.0\n"
    )
    (tmp_path / "scene.toml").write_text(scene.replace("MARGIN", "0.012"))
    x, y = load_bench(str(tmp_path / "scene.toml")).sites.T
    assert len(x) > 20
    assert (np.maximum(x - 0.168, y - 0.108) <= 1e-9).all()
    assert (np.minimum(x - 0.078, y - 0.048) <= 1e-9).all()  # at least the margin from the sides that turn inwards
    (tmp_path / "scene.toml").write_text(scene.replace("MARGIN", "12"))
    with pytest.raises(je.toml.TomlError, match=r"is 12 m, .*; give less than half of its shorter side, in m"):
        load_bench(str(tmp_path / "scene.toml"))
    (tmp_path / "scene.toml").write_text(scene.replace("MARGIN", "0.059"))
    with pytest.raises(je.toml.TomlError, match=r"margin: is 0.059 m, and no place of the 9 x 6 grid is so far inside"):
        load_bench(str(tmp_path / "scene.toml"))


def test_a_skin_without_pads_makes_no_session(skin, tmp_path):
    scene = je.Scene(replace(skin, pads=()), effects=())
    bare = calib.bench.Bench(scene, sites=np.array([[0.1, 0.1]]), forces=np.array([5.0]))
    with pytest.raises(calib.bench.BenchError, match=r"the skin 'testbed' has no pads for a session to hold; add"):
        calib.simulate(bare, tmp_path / "s.h5")


def test_the_ending_of_a_scene_file_is_missed(tmp_path):
    (tmp_path / "mine.toml").touch()
    with pytest.raises(calib.bench.BenchError, match=r"mine: no such scene file .*; did you mean .*mine\.toml\?"):
        calib.load_bench(tmp_path / "mine")


def test_an_unknown_preset_is_named():
    with pytest.raises(ValueError, match=r"papr_bench: no such scene file or preset; presets: .*paper_bench"):
        load_bench("papr_bench")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"slide": (0.3, 0.0)}, "after its slide"),
        ({"companions": (Companion((0.0, 0.2), 1.0),)}, "of a companion"),
        ({"sites": ((0.3, 0.1),)}, "site 0 at"),
        ({"forces": np.array([5.0, -3.0])}, r"forces are \[5.0, -3.0\] N; give one or more, above 0"),
        ({"forces": np.array([])}, r"forces are \[\] N"),
        ({"forces": np.array([np.nan])}, r"forces are \[nan\] N"),
        ({"tip_diameter": 0.5}, "a tip of 0.5 m is wider than the sheet"),
        ({"eit_rate": 200.0}, r"a scan of this skin takes 0.0055 s; give at most 181.8 Hz"),
        ({"pad_rate": 0.01}, "pad_rate is 0.01 Hz: no sample in the blank or in a hold"),
    ],
)
def test_what_a_stage_cannot_do_is_refused(skin, change, message):
    with pytest.raises(BenchError, match=message):
        _bench(skin, **change)


@pytest.mark.slow
def test_explain_names_each_effect_in_its_stage(skin):
    whole = (
        je.effects.StageError(),
        je.effects.PadEdgeDip(),
        je.effects.ScanSkew(),
        je.effects.DropOut(),
        je.effects.IntermittentElectrode(),
    )
    effects = (*SHEET, *whole, je.effects.ContactScatter(), je.effects.PadLeak(), je.effects.Noise(std=1e-5))
    bench = _bench(skin, *effects, sites=((0.06, 0.07),))
    parts = measure_costs(bench, DRAFT)
    by_name = {part.name: part for part in parts}
    for effect in effects:
        (part,) = (p for name, p in by_name.items() if name.split(" ")[0] == type(effect).__name__)
        assert part.stage == effect.stage
        assert part.seconds > 0
    assert by_name["the sheet itself"].runs == 7
    text = render_costs(bench, parts)
    assert "LoadSpreading" in text
    assert "Quantisation" not in text
    shares = [float(line.split("%")[0].split()[-1]) for line in text.splitlines() if "%" in line]
    assert sum(shares) == pytest.approx(100, abs=0.1 * len(shares))


@pytest.mark.slow
def test_chance_is_of_the_seed_and_of_nothing_else(skin):
    noise, sites = je.effects.Noise(std=1e-5), ((0.06, 0.07),)
    first, again = (_all(simulated_streams(_bench(skin, noise, sites=sites), DRAFT).eit).values for _ in range(2))
    other = _all(simulated_streams(_bench(skin, noise, sites=sites, seed=1), DRAFT).eit).values
    more = _all(simulated_streams(_bench(skin, noise, je.effects.PadLeak(), sites=sites), DRAFT).eit).values
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, more)
    assert np.abs(first - other).std() > 1e-6


@pytest.mark.slow
def test_the_data_set_is_one_solve_each(skin):
    model = je.discretise(je.Scene(skin), DRAFT)
    places, amplitudes = grid(skin, 3, 2), np.array([0.0, 0.5, 1.0])
    voltages = simulate_contacts(model, places, amplitudes)
    assert voltages.shape == (6, 3, 550)
    square = ((np.asarray(model.centroids) - places[4]) ** 2).sum(1)
    sigma = model.background * (1 + 0.5 * np.exp(-0.5 * square / 0.012**2))
    np.testing.assert_allclose(voltages[4, 1], je.forward(model, sigma), rtol=0, atol=1e-12 * np.abs(voltages).max())
    np.testing.assert_allclose(voltages[:, 0], np.tile(je.forward(model), (6, 1)), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_data_set_is_shared_out_over_devices(tmp_path):
    """Two devices give what one gives."""
    code = (
        "import sys, jax; jax.config.update('jax_enable_x64', True)\n"
        "import numpy as np, jaxeit as je\n"
        "from calib.bench import grid, simulate_contacts\n"
        "skin = je.load_skin('testbed')\n"
        "model = je.discretise(je.Scene(skin), je.Fidelity.draft())\n"
        "np.save(sys.argv[1], simulate_contacts(model, grid(skin, 2, 2), np.array([0.0, 1.0])))\n"
        "print(jax.device_count())"
    )
    found = []
    for count in (1, 2):
        path = tmp_path / f"{count}.npy"
        flags = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={count}"}
        done = subprocess.run(
            [sys.executable, "-c", code, path], env=flags, capture_output=True, text=True, check=False
        )
        assert done.stdout.strip() == str(count), done.stderr
        found.append(np.load(path))
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("width", [2e-4, 1e-12])
def test_a_load_between_the_elements_is_refused(width, tmp_path):
    """The force of the stage would be whole, and the skin would feel none of it."""
    scene = je.Scene(je.load_skin("testbed"), effects=(je.effects.LoadSpreading(width=width),))
    bench = Bench(scene, np.array([[0.05, 0.05], [0.15, 0.06]]), np.array([5.0]))
    with pytest.raises(BenchError, match=r"% of the force of a tip of 0.02 m arrives on the mesh.* finer fidelity"):
        simulate(bench, tmp_path / "s.h5", fidelity=je.Fidelity.draft())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("diameter", [0.02, 0.05])
def test_the_force_that_arrives_is_that_of_the_integral(skin, model, diameter):
    """The ideal tip has a closed form: a circle within the sheet, half of one on its edge."""
    places = np.array([[0.06, 0.13], [0.1, 0.1]])
    tip = np.array([float(model.areas @ je.model.load_spread(model, place, diameter)) for place in places])
    np.testing.assert_allclose(force_shares(model, skin.domain, places, diameter), tip, rtol=0.02)
    edge = np.array([[0.1, 0.0]])
    half = float(model.areas @ je.model.load_spread(model, edge[0], diameter)) / 0.5
    np.testing.assert_allclose(force_shares(model, skin.domain, edge, diameter), half, rtol=0.05)
