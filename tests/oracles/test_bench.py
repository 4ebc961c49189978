"""The second simulator: its physics against closed forms, its sheet against ours, its sessions through calibration."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import bmat, csc_matrix
from scipy.sparse.linalg import spsolve

import calib
import jaxeit as je
from calib.check import Severity

from .bench import Bench, Faults, contact, motion, pads, simulate, write
from .bench.__main__ import main
from .bench.mesh import doubled_areas, make_mesh
from .bench.sheet import assemble, green, make_sheet, mean_potentials, readings, touched
from .bench.skin import CHEST, read_skin

COARSE = 5e-3


def uneven(places):
    x, y = np.asarray(places).T
    return (1 + 0.4 * np.sin(40 * x) * np.cos(25 * y)) / 150


@pytest.fixture(scope="module")
def testbed():
    return read_skin()


@pytest.fixture(scope="module")
def mesh(testbed):
    return make_mesh(testbed, testbed.bolts, COARSE)


@pytest.fixture(scope="module")
def sheet(mesh, testbed):
    return make_sheet(mesh, uneven(mesh.points[mesh.triangles].mean(1)), testbed.contact)


def test_the_description_is_read_as_the_library_reads_it(testbed, skin):
    np.testing.assert_array_equal(testbed.pattern, skin.protocol.pattern)
    np.testing.assert_allclose(testbed.bolts, [e.position for e in skin.electrodes], atol=1e-12)


def test_a_bent_sheet_with_bolts_in_a_list_is_read_as_the_library_reads_it():
    chest, ours = read_skin(CHEST), je.load_skin("chest")
    np.testing.assert_array_equal(chest.pattern, ours.protocol.pattern)
    np.testing.assert_array_equal(chest.bolts, ours.electrode_positions)
    mesh = make_mesh(chest, chest.bolts, COARSE)
    sheet = make_sheet(mesh, uneven(mesh.points[mesh.triangles].mean(1)), chest.contact)
    found = readings(sheet.untouched, chest.pattern, chest.current)
    model = je.discretise(je.Scene(ours), je.Fidelity.draft())
    error = np.asarray(je.forward(model, uneven(model.centroids))) - found
    assert np.linalg.norm(error) < 2e-2 * np.linalg.norm(found)


def test_the_mesh_covers_the_sheet_and_the_bolts(mesh, testbed):
    area = doubled_areas(mesh.points[mesh.triangles]) / 2
    assert area.min() > 0
    assert area.sum() == pytest.approx(0.04, rel=1e-12)
    np.testing.assert_allclose(np.bincount(mesh.bolt[mesh.bolt >= 0], area[mesh.bolt >= 0]), np.pi * 3e-3**2)


def test_two_independent_solvers_agree_on_an_uneven_sheet(sheet, testbed, skin):
    ours = je.discretise(je.Scene(skin), je.Fidelity.standard())
    found = readings(sheet.untouched, testbed.pattern, testbed.current)
    error = np.asarray(je.forward(ours, uneven(ours.centroids))) - found
    assert np.linalg.norm(error) < 5e-3 * np.linalg.norm(found)
    assert np.abs(error).max() < 5e-3 * np.abs(found).max()


def test_patches_by_woodbury_equal_a_sheet_assembled_with_them(mesh, testbed, sheet):
    layer = contact.make_layer(testbed, testbed.bolts, 0.3, np.random.default_rng(5))
    near = np.flatnonzero(np.linalg.norm(layer.places - [0.07, 0.06], axis=1) < 0.012)
    patches = mean_potentials(mesh, contact.samples(layer)[near])
    joined = contact.joined(contact.conductances(layer, np.full(len(layer.gain), 0.1))[near], layer.island[near])
    found = touched(sheet, *green(sheet, patches), joined)
    matrix, count = assemble(mesh, uneven(mesh.points[mesh.triangles].mean(1)), testbed.contact), len(mesh.points)
    added = patches @ csc_matrix(joined) @ patches.T
    whole = (matrix + bmat([[added, None], [None, csc_matrix((25, 25))]])).tolil()
    np.testing.assert_allclose(found, _transfer(whole, count), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found, found.T, rtol=1e-9)
    assert (np.diag(found)[:-1] < np.diag(sheet.untouched)[:-1]).all()  # protrusions can only help the current


def _transfer(matrix, count):
    """Transfer matrix of the bolts, the last one grounded, from the whole system."""
    currents = np.zeros((count + 24, 24))
    currents[count + np.arange(24), np.arange(24)] = 1
    found = np.zeros((25, 25))
    found[:24, :24] = spsolve(csc_matrix(matrix)[:-1, :-1], csc_matrix(currents)).toarray()[count:]
    return found


def test_each_protrusion_touches_from_a_load_of_its_own(testbed):
    layer = contact.make_layer(testbed, testbed.bolts, 0.2, np.random.default_rng(1))
    loads = np.outer([0.002, 0.005, 0.01, 0.02, 0.05], np.ones(len(layer.gain)))
    conductance = contact.conductances(layer, loads)
    share = (conductance > 0).mean(1) / (layer.gain > 0).mean()
    assert share[0] < 0.01 < share[1] < 0.4 < share[2] < 0.6 < share[3] < share[4]
    assert (np.diff(conductance, axis=0) >= 0).all()
    joined = contact.joined(conductance[-1], layer.island)
    np.testing.assert_allclose(joined.sum(0), 0, atol=1e-15)  # a protrusion floats


@pytest.mark.parametrize("shape", ["flat", "hertz", "ring", "tilted", "ellipse"])
def test_the_sheet_carries_the_whole_load_of_every_tip(testbed, shape):
    layer = contact.make_layer(testbed, testbed.bolts, 0.0, np.random.default_rng(1))
    share = contact.shares(layer, np.array([0.1, 0.1]), shape, 0.02, 5.0)
    assert share.sum() == pytest.approx(1)
    middle = share @ layer.places - 0.1
    assert (middle[0] > 1e-3) == (shape == "tilted")
    assert abs(middle[1]) < 1e-9


def test_a_sphere_spreads_with_its_load_and_an_ellipse_is_long():
    width = [np.sqrt(w @ p**2) for p, w in (contact.tip_points("hertz", 0.02, f) for f in (2.5, 20.0))]
    np.testing.assert_allclose(width[1] / width[0], 2)
    points, weights = contact.tip_points("ellipse", 0.02, 5.0)
    np.testing.assert_allclose(np.sqrt(weights @ points**2), [5e-3, 2.5e-3])  # a / 2 of an even disc


def test_the_cell_obeys_gas_law_and_wall():
    load = np.array([0.0, 1.0, 20.0, 60.0])
    pressure = pads.cell_pressure(load)
    volume = pads.VOLUME * pads.AMBIENT / (pads.AMBIENT + pressure)
    travel = (pads.VOLUME + pads.BULGE * pressure - volume) / pads.AREA
    wall = pads.STIFFNESS * travel * (1 + (travel / pads.STIFFENING) ** 2)
    np.testing.assert_allclose(pads.AREA * pressure + wall, load, atol=1e-9)
    assert 0.5 * 2000 < pressure[2] < 2000  # between half and all of 20 N over 100 cm2


def test_other_pads_are_silent_without_crosstalk_and_show_its_share_with():
    pressure = np.array([[0.0, 0.0, 0.0, 0.0], [2000.0, 0.0, 0.0, 0.0]])
    for crosstalk in (0.0, 0.05):
        cells = replace(pads.make_pads(4, crosstalk, np.random.default_rng(0)), gain=np.ones(4))
        rise = np.diff(pads.sensed(cells, pressure, np.zeros((2, 4))), axis=0)[0]
        np.testing.assert_allclose(rise, 2000 * np.array([1.0, *3 * [crosstalk]]), atol=pads.STEP)


def test_a_load_by_the_rim_of_its_pad_is_felt_less_and_by_no_other(testbed):
    reach = pads.load_matrix(testbed, np.array([[0.05, 0.05], [0.05, 0.093], [0.05, 0.0999]]))
    assert (reach[1:] == 0)[:2].all()
    assert reach[0, 0] > 0.98
    assert reach[0, 1] == pytest.approx(1 - pads.RIM_SHARE / 2)
    assert reach[0, 2] == pytest.approx(1 - pads.RIM_SHARE, rel=1e-3)


@pytest.mark.parametrize("opening", [0.0, 0.1])
def test_loops_are_as_wide_as_asked_and_do_not_depend_on_the_rate(opening):
    there = np.concatenate([np.linspace(0, 20, 41), np.linspace(20, 0, 41)[1:]])[:, None]
    load = np.concatenate([there, there[1:]])  # the second round is closed
    found = pads.yielding(load, opening)
    up, down = found[80:121, 0], found[120:161, 0][::-1]
    area = np.sum(down[1:] + down[:-1] - up[1:] - up[:-1]) / 2 * 0.5
    assert (area > 0) == (opening > 0)
    assert (down - up).max() == pytest.approx(20 * opening, rel=0.1)
    fine = np.interp(np.arange(0, 160.25, 0.25), np.arange(161), load[:, 0])[:, None]
    np.testing.assert_allclose(pads.yielding(fine, opening)[::4], found, atol=1e-9)


def test_creep_comes_late_and_warmth_leaks_away():
    load = np.ones((20 * 3000, 1))
    found = pads.late(load, 20.0, 0.1)[:, 0]
    assert found[0] == pytest.approx(0.9, abs=0.01)
    assert (np.diff(found) >= 0).all()
    assert found[-1] == pytest.approx(1)
    warm = pads.warmed(np.where(np.arange(60000) > 0, 1.0, 0.0), 20.0)
    assert warm[1] == pytest.approx(343, abs=1)  # P0 / T0 per kelvin
    assert abs(warm[-1]) < 0.1


def test_the_stage_holds_the_asked_forces_where_it_says(testbed):
    presses = motion.plan(testbed.size, 4, [5.0, 10.0], np.random.default_rng(0))
    held = motion.BLANK + motion.PERIOD * np.arange(8) + motion.REST + motion.RAMP + 0.5
    moment = motion.moments(presses, held)
    np.testing.assert_allclose(moment.force, presses.forces)
    np.testing.assert_allclose(motion.stage(presses, moment)[:, :2], presses.places)
    assert not motion.moments(presses, np.arange(0, motion.BLANK, 0.1)).force.any()


def test_check_accepts_the_session(tmp_path):
    bench = Bench(Faults(temperature=1.0), places=4, levels=(10.0, 20.0), spacing=8e-3)
    write(tmp_path / "session.h5", simulate(bench))
    with calib.open_session(tmp_path / "session.h5") as session:
        report = calib.check_session(session)
        assert set(session.streams) == {"eit", "pressure", "force", "stage", "temperature"}
        assert len(session.presses.x) == 8
    assert [each for each in report.findings if each.severity > Severity.OK] == []


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A session to calibrate from and one of other places, forces and noise, on one skin."""
    folder = tmp_path_factory.mktemp("oracle")
    bench = Bench(places=16, spacing=COARSE)
    for name, each in {"first": bench, "second": replace(bench, seed=2, places=9, levels=(15.0,))}.items():
        write(folder / f"{name}.h5", simulate(each))
    return folder


IMAGES = calib.Recipe(location=calib.PadEdge(), locator=calib.calibration.ImageCentroid())
CONTACTS = calib.Recipe(location=calib.PadEdge())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "estimator", "mean", "worst"), [(IMAGES, "half", 5e-3, 15e-3), (CONTACTS, "fitted", 1.5e-3, 5e-3)]
)
def test_calibration_holds_on_a_second_session(recorded, recipe, estimator, mean, worst):
    with calib.open_session(recorded / "first.h5") as first, calib.open_session(recorded / "second.h5") as second:
        found = calib.evaluate(calib.calibrate([first], recipe=recipe), second)
    away = np.linalg.norm(found.estimated[estimator] - found.position, axis=1)
    error = found.total_force - found.force
    assert away.mean() < mean
    assert away.max() < worst
    assert np.sqrt(np.mean(error**2)) < 0.06 * 15
    assert np.abs(error).max() < 0.15 * 15


def test_the_command_writes_what_its_options_say(tmp_path):
    out = tmp_path / "one.h5"
    main([str(out), "--places", "1", "--levels", "10", "--spacing", "8e-3", "--crosstalk", "0.1"])
    with calib.open_session(out) as session:
        assert len(session.presses.x) == 1
        pressure = session.streams["pressure"].read()
    rise = pressure.max(0) - pressure[:200].mean(0)
    assert rise.min() > 0.08 * rise.max()


def test_faults_change_what_they_name():
    plain = Bench(places=1, levels=(4.0,), spacing=8e-3, faults=Faults(noise=0, drift=0))
    base = simulate(plain).streams
    changed = {
        "crosstalk": (0.05, {"pressure"}), "hysteresis": (0.1, {"pressure"}), "creep": (0.05, {"pressure", "eit"}),
        "misplaced": (1e-3, {"eit"}), "coating": (0.1, {"eit"}), "temperature": (1.0, {"pressure", "eit"}),
        "moved_gain": (0.05, {"pressure"}), "shape": ("ring", {"pressure", "eit"}), "moved_layer": (0.1, {"eit"}),
    }  # fmt: skip
    for name, (value, streams) in changed.items():
        found = simulate(replace(plain, faults=replace(plain.faults, **{name: value}))).streams
        assert {key for key in base if not np.array_equal(base[key][2], found[key][2])} == streams, name


def test_later_sessions_of_a_skin_are_moved_alike():
    """Sessions of other lengths and seeds: levels at rest differ by the drift, not by the move."""
    faults = Faults(noise=0, drift=0, moved_offset=50.0)
    sessions = [Bench(faults, seed=seed, places=seed, levels=(4.0,), spacing=8e-3) for seed in (1, 2)]
    first, second = (simulate(one).streams["pressure"][2][0] for one in sessions)
    rest = simulate(replace(sessions[0], faults=replace(faults, moved_offset=0.0))).streams["pressure"][2][0]
    np.testing.assert_allclose(first, second, rtol=1e-12)
    assert np.count_nonzero(first - rest) >= 3  # of four; a sensor tells steps of 10.5 Pa
