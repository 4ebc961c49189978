"""From a simulated bench to newtons and back, and what is said when something is wrong."""

import multiprocessing
import re
import shutil
import sys
import time
from dataclasses import replace
from datetime import datetime

import equinox as eqx
import h5netcdf
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtri

import calib
import jaxeit as je
from calib.bench import simulate
from calib.calibration.application.force_maps import force_model, fused
from calib.calibration.archives.storage import SEAL, to_archive
from calib.calibration.evaluation import render_table
from calib.calibration.localisation.locators import ROWS, CentroidLocator, locate, locator_from_numbers, locator_numbers
from calib.calibration.localisation.press_images import fit_untouched_sheet
from calib.calibration.procedure import _not_predicted
from calib.fitting.curves import CURVES
from calib.fitting.curves.play_operators import play, remembered
from calib.fitting.fields import Places, geometry_of
from calib.fitting.pads import LocatedPresses, fit_pads
from calib.presses.contradictions import drifting_pads, outlying_presses, place_errors
from calib.presses.pooled import pool_presses
from calib.presses.table import PressMeasurements, measure
from calib.report import document as report
from calib.session import PressTable, StreamFacts

from ..helpers import stand_in
from ..kill_worker import write_all, write_for_ever
from .quick_bench import QUICK, SITES, bench


@pytest.fixture(scope="session")
def two(skin, folder):
    """Two presses, both on the lower left pad."""
    return simulate(bench(skin, SITES[:2]), folder / "two.h5", fidelity=je.Fidelity.draft(edge_length=0.05))


@pytest.fixture(scope="session")
def calibration(grid):
    with calib.open_session(grid) as session:
        return calib.calibrate([session], recipe=QUICK)


@pytest.fixture(scope="session")
def pressed(skin, grid):
    """What curves are fitted to."""
    with calib.open_session(grid) as session:
        return pool_presses([session], skin).data


def test_recovers_the_pads(calibration):
    """Without effects in the pads, force = pressure x area wherever the whole load is on one pad."""
    slope = np.asarray(calibration.curves.parameters)[:, 0]
    np.testing.assert_allclose(slope, 0.01, rtol=0.02)


def test_results_are_sane(calibration):
    s = calibration.evaluation.summary()
    assert s["presses"] == 16
    assert s["localisation_half_mean"] < 0.01  # of the size of a pixel
    assert s["force_rmse"] < 0.5
    assert s["cv_hybrid_ddof1"] < 0.03 < s["cv_eit_ddof1"]
    assert calibration.simulated


def test_saved_and_loaded_it_is_the_same(calibration, folder):
    path = folder / "calibration.h5"
    calibration.save(path)
    loaded = calib.load_calibration(path)
    assert loaded.evaluation.summary() == calibration.evaluation.summary()
    assert loaded.provenance == calibration.provenance
    dv = np.random.default_rng(0).normal(size=(3, 550)) * 1e-4
    pressures = np.array([[500.0, 0, 0, 100.0], [0, 0, 0, 0], [2000.0, 1, 2, 3]])
    first, second = (calib.force_map(c, dv, pressures) for c in (calibration, loaded))
    np.testing.assert_array_equal(first.map.force, second.map.force)
    np.testing.assert_array_equal(first.standard_error, second.standard_error)


def test_a_press_that_the_others_contradict_is_named(calibration, grid, tmp_path):
    """A log of the stage with a slip in one force: 60 % more than its pressure tells."""
    assert not any("contradict" in note for note in calibration.notes)
    path = tmp_path / "slip.h5"
    shutil.copy(grid, path)
    with h5py.File(path, "r+") as file:
        table, cell = file["presses"], file["streams/force"]
        during = (cell["time"][:] >= table["t_press"][5]) & (cell["time"][:] <= table["t_release"][5])
        cell["force"][...] = np.where(during[:, None], 1.6 * cell["force"][:], cell["force"][:])
    with calib.open_session(path) as session:
        notes = calib.calibrate(session, recipe=QUICK).notes
    (named,) = [note for note in notes if "contradict" in note]
    assert re.search(
        r"^slip.h5: the other presses contradict the force of press 5: [\d.]+ N stated, [\d.]+ N by", named
    )


def test_contradicted_places_and_many_contradictions(skin, grid):
    with calib.open_session(grid) as session:
        pooled = pool_presses([session], skin)
    exact, near = pooled.data.force, pooled.position + 1e-3 * np.sin(np.arange(32.0)).reshape(16, 2)
    assert outlying_presses(pooled, exact, near) == ()
    assert outlying_presses(pooled, np.full(16, np.nan), np.full((16, 2), np.nan)) == ()
    elsewhere = np.where(np.arange(16)[:, None] == 7, near[::-1], near)
    (line,) = outlying_presses(pooled, exact, elsewhere)
    assert f"the place of press 7: ({1e3 * pooled.position[7, 0]:.0f}, " in line
    others = exact * np.where(np.arange(16) % 4, 1.0, 2.0)  # a quarter of the presses: then the fit is to blame
    assert outlying_presses(pooled, others) == ()


@pytest.fixture(scope="module")
def sixty_four(skin, grid):
    """Presses in a random order of places, a quarter of them on each pad."""
    with calib.open_session(grid) as session:
        pooled = pool_presses([session], skin)
    rng, count = np.random.default_rng(3), 64
    position, pad = rng.uniform(0.02, 0.18, (count, 2)), rng.permutation(count) % 4
    pressure = np.where(np.arange(4) == pad[:, None], 1000.0, 5.0)
    data = replace(pooled.data, pressure=pressure, force=np.full(count, 10.0), place=np.arange(count))
    (recording,) = pooled.recordings
    listed = stand_in(PressTable, t_hold0=10**10 * np.arange(count), accepted=np.ones(count, bool))
    groups = {name: np.zeros(count, int) for name in pooled.groups}
    recordings = (stand_in(PressMeasurements, presses=listed, session=recording.session),)
    return replace(pooled, data=data, position=position, groups=groups, recordings=recordings)


def told_forces(presses, factor=1.0, error=0.03):
    """Forces by the pads, a part `factor` (presses,) of the stated ones, with errors."""
    noise = np.exp(error * np.random.default_rng(5).normal(size=len(presses.data.force)))
    return presses.data.share * (factor * noise * presses.data.force)[:, None]


@pytest.mark.parametrize("by_place", [True, False])
def test_pads_that_read_less_and_less_are_named(sixty_four, by_place):
    names = ["a", "b", "c", "d"]
    assert drifting_pads(sixty_four, names, told_forces(sixty_four), by_place=by_place) == ()
    along = np.linspace(0, 1, 64)
    own = sixty_four.data.share[:, 1] > 0.5
    leaks = told_forces(sixty_four, np.where(own, np.exp(-0.7 * along), 1.0))
    leaks[own.nonzero()[0][3]] *= 1.8  # one press that is wrong by itself
    (line,) = drifting_pads(sixty_four, names, leaks, by_place=by_place)
    (part,) = map(int, re.findall(r"'b' (-\d+) %", line))
    assert part == pytest.approx(100 * np.expm1(-0.7), abs=6)
    (line,) = drifting_pads(sixty_four, names, told_forces(sixty_four, np.exp(0.3 * along)), by_place=by_place)
    assert re.findall(r"'(\w)' \+\d+ %", line) == names


def test_a_drift_that_places_may_explain_is_not_named(sixty_four):
    """Without a correction by location, where the stage went from one side to the other as time went on."""
    order = np.argsort(sixty_four.position[:, 1])
    swept = replace(sixty_four, position=sixty_four.position[order])
    part = told_forces(swept, np.exp(-0.7 * np.linspace(0, 1, 64)))
    assert drifting_pads(swept, ["a", "b", "c", "d"], part, by_place=True)
    assert drifting_pads(swept, ["a", "b", "c", "d"], part, by_place=False) == ()


def test_presses_without_places_tell_of_drifts_by_a_correction_only(sixty_four):
    nowhere = replace(sixty_four, position=np.full((64, 2), np.nan))
    part = told_forces(nowhere, np.exp(-0.7 * np.linspace(0, 1, 64)))
    assert drifting_pads(nowhere, ["a", "b", "c", "d"], part, by_place=True)
    assert drifting_pads(nowhere, ["a", "b", "c", "d"], part, by_place=False) == ()
    assert place_errors(nowhere, sixty_four.position) == ()


@pytest.mark.parametrize(
    ("listed", "said"),
    [
        (lambda p: p, None),
        (lambda p: p + np.array([0.01, -0.006]), r"\+10 mm in x and -6 mm in y at the middle; check origin"),
        (lambda p: 0.1 + 0.8 * (p - 0.1), "-2[45] % of x in x, -2[45] % of y in y; check"),
        (lambda p: p + 0.2 * (p[:, ::-1] - 0.1) * [1, 0], r"\+(19|20|21) % of y in x; check"),
    ],
)
def test_places_that_lie_aside_as_a_whole_are_named(sixty_four, listed, said):
    seen = sixty_four.position + 1e-3 * np.random.default_rng(7).normal(size=(64, 2))
    seen[5], seen[40] = [0.03, 0.17], np.nan  # a press that slipped, and one without a contact
    lines = place_errors(replace(sixty_four, position=listed(sixty_four.position)), seen)
    assert len(lines) == (said is not None)
    assert all(re.search(said, line) for line in lines)


@pytest.mark.parametrize("curve", [calib.PowerLaw(), calib.Affine()], ids=lambda c: type(c).__name__)
def test_every_curve_survives_the_file(calibration, pressed, folder, curve):
    curves = fit_pads(
        curve, None, LocatedPresses(pressed, geometry_of(calibration.skin)), calib.fitting.SoftL1()
    ).curves
    assert (np.asarray(curves.result) == 0).all()
    found = replace(calibration, curves=curves, provenance=calibration.provenance | {"curve": CURVES.name_of(curve)})
    found.save(folder / "one.h5")
    pressures = np.linspace(0, 2000, 7)[:, None] * np.ones(4)
    again = calib.load_calibration(folder / "one.h5").pad_forces(pressures)
    for mine, theirs in zip(found.pad_forces(pressures), again, strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.fixture(scope="session")
def located(grid):
    """With a correction by location, the place from the image."""
    with calib.open_session(grid) as session:
        return calib.calibrate(
            [session],
            recipe=replace(
                QUICK, location=calib.fitting.Bilinear(nodes=2, shared=True), locator=calib.calibration.ImageCentroid()
            ),
        )


def test_a_correction_by_location_is_kept_in_the_file_beside_the_papers_recipe(located, calibration, folder):
    located.save(folder / "located.h5")
    loaded = calib.load_calibration(folder / "located.h5")
    assert loaded.provenance["location"] == "bilinear"
    summary = loaded.evaluation.summary()
    assert summary == located.evaluation.summary()
    for method in ("eit", "hybrid", "calibrated", "true_place"):
        assert f"cv_{method}_ddof1" in summary
    plain = calibration.evaluation.summary()
    assert summary["cv_hybrid_ddof1"] == pytest.approx(plain["cv_hybrid_ddof1"], rel=1e-6)
    assert summary["force_eit_rmse"] > summary["force_rmse"]
    text = render_table(loaded.evaluation, "t")
    assert all(word in text for word in ("EIT only", "calibrated (linear, bilinear)", "true place", "fitted"))
    dv = np.random.default_rng(0).normal(size=(3, 550)) * 1e-4
    pressures = np.array([[500.0, 0, 0, 100.0], [0, 0, 0, 0], [2000.0, 1, 2, 3]])
    first, second = (calib.force_map(c, dv, pressures) for c in (located, loaded))
    np.testing.assert_array_equal(first.map.force, second.map.force)
    np.testing.assert_array_equal(first.standard_error, second.standard_error)
    np.testing.assert_allclose(np.asarray(first.map.force).sum(1), first.force.sum(1), rtol=1e-12)


def test_a_calibration_of_before_is_still_read(calibration, folder):
    """Written without the arrays that came later."""
    attrs, arrays = to_archive(calibration)
    old = {k: v for k, v in arrays.items() if not k.startswith(("baseline/", "presses/force_"))}
    later = ("image_gain", "provenance_location", "evaluation_recipe", SEAL)
    attrs = {k: v for k, v in attrs.items() if k not in later}
    calib.session.write_archive(folder / "old.h5", "skin-calibration", attrs, old)
    loaded = calib.load_calibration(folder / "old.h5")
    assert loaded.field is None
    assert loaded.evaluation.summary()["force_rmse"] == calibration.evaluation.summary()["force_rmse"]
    del arrays["pads/parameters"]
    calib.session.write_archive(folder / "old.h5", "skin-calibration", attrs, arrays)
    with pytest.raises(calib.SessionError, match="pads/parameters: missing"):
        calib.load_calibration(folder / "old.h5")


def test_a_calibration_whose_pads_were_exchanged_is_refused(calibration, folder):
    """Well-formed numbers of one pad in the place of another's: only the seal tells."""
    attrs, arrays = to_archive(calibration)
    values, *about = arrays["pads/parameters"]
    changed = arrays | {"pads/parameters": (values[::-1], *about)}
    calib.session.write_archive(folder / "changed.h5", "skin-calibration", attrs, changed)
    with pytest.raises(calib.SessionError, match="changed after the calibration was saved"):
        calib.load_calibration(folder / "changed.h5")


def test_an_estimator_of_contacts_is_kept_in_the_file(model, calibration, folder):
    """With every array and setting it has; what it leaves out, such as the shares of mixed readings, is left out."""
    locator = calib.calibration.FittedContact(columns=7, widths=(0.012, 0.02))
    made = locator.prepare(model, np.full(550, 1e-5), np.ones(550, bool))
    assert made.finder.whitening.shares is None
    again = locator_from_numbers(locator_numbers(made), model.dtype)
    assert jax.tree.structure(again) == jax.tree.structure(made)
    assert all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (made, again)), strict=True))
    arrays = {name: (array, "", "") for name, array in locator_numbers(made).items()}
    calib.session.write_archive(folder / "locator.h5", "skin-calibration", {}, arrays)
    kept = calib.session.read_archive(folder / "locator.h5", "skin-calibration").arrays
    assert kept.keys() == arrays.keys()


@pytest.mark.slow
def test_a_fitted_contact_is_stored_as_numbers_and_finds_the_presses(model, calibration, grid):
    locator = calib.calibration.FittedContact(columns=21, widths=(0.008, 0.03))
    made = locator.prepare(model, np.full(550, 1e-5), np.ones(550, bool))
    again = locator_from_numbers(locator_numbers(made), model.dtype)
    assert all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (made, again)), strict=True))
    with calib.open_session(grid) as session:
        found = measure(session, calibration.skin)
    places = calib.calibration.locate(again.single(), found.dv, calibration.recon, calibration.masks)
    error = np.linalg.norm(np.asarray(places.position)[:, 0] - found.position, axis=1)
    assert error.mean() < 0.006  # a draft mesh, and a table to match


@pytest.mark.parametrize("part", [0, 1])
def test_what_a_curve_remembers_of_the_past_is_enough(part):
    """A random walk, and its running sum, which goes on in one direction by steps that grow."""
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(0, 1, (540, 2)), 0)
    walk = walk if part == 0 else np.cumsum(rng.normal(0, 1, (540, 2)) + 0.1 * np.sin(walk), 0)
    past, now = walk[:500], walk[500:]
    few = remembered(past)
    assert len(few) < 60
    widths = jnp.array([0.5, 2.0, 8.0, 20.0])
    for pad in range(2):
        whole = play(jnp.asarray(np.r_[past[:, pad], now[:, pad]]), widths)[500:]
        short = play(jnp.asarray(np.r_[few[:, pad], now[:, pad]]), widths)[len(few) :]
        np.testing.assert_allclose(short, whole, atol=1e-12)


def test_places_of_any_number_of_frames_take_one_program(calibration):
    recon, rng, rows = calibration.recon, np.random.default_rng(0), []

    class Counted(CentroidLocator):
        def __call__(self, dv, *others):
            rows.append(len(dv))
            return super().__call__(dv, *others)

    frames = rng.normal(0, 1e-4, (130, recon.readings))
    found = [locate(Counted(je.LevelCentroid(0.5)), frames[:n], recon, calibration.masks) for n in (3, 70, 130)]
    assert rows == [ROWS] * (1 + 2 + 3)
    for some in found[:2]:
        np.testing.assert_allclose(some.position, np.asarray(found[2].position)[: len(some.position)], atol=1e-9)


def test_force_maps_sum_to_the_pads_and_know_their_limits(calibration):
    pressures = np.array([[1000.0, 0.0, 0.0, 500.0], [9000.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    found = calib.force_map(calibration, np.zeros((3, 550)), pressures)
    np.testing.assert_allclose(np.asarray(found.map.force).sum(1), found.force.sum(1), rtol=1e-12)
    assert found.valid[0].all()
    assert not found.valid[1, 0]  # beyond what was calibrated
    assert (found.standard_error > 0).all()
    with pytest.raises(ValueError, match=r"give \(n, 550\) V and \(n, 4\) Pa"):
        calib.force_map(calibration, np.zeros((3, 3)), pressures)


def test_contacts_share_what_their_pad_carries(located):
    """By the integrals of their bumps; one across the border of two pads has its part of both."""
    forces, recon = force_model(located), located.recon
    position = jnp.array([[[0.03, 0.05], [0.075, 0.05]], [[0.1, 0.05], [jnp.nan, jnp.nan]]])
    width, amplitude = jnp.array([[0.01, 0.01], [0.01, jnp.nan]]), jnp.array([[3.0, 1.0], [1.0, 0.0]])
    share = je.fusion.contact_shares(position, width, amplitude, recon.centres, located.masks).share
    image = jnp.exp(-0.5 * jnp.sum((position[:, :1] - recon.centres) ** 2, -1) / 0.03**2)
    pressures = jnp.array([[1600.0, 0.0, 20.0, 20.0], [500.0, 500.0, 20.0, 20.0]])  # the others': crosstalk
    found = eqx.filter_jit(fused)(forces, image, pressures, Places(position, share, width, amplitude), None, 0.6)
    np.testing.assert_allclose(found.map.force.sum(1), found.force.sum(1), rtol=1e-12)
    touched = jnp.array([[True, False, False, False], [True, True, False, False]])
    np.testing.assert_allclose(found.contact_force.sum(1), jnp.where(touched, found.force, 0).sum(1), rtol=1e-12)
    ratio = np.asarray(found.contact_force)[0] / np.asarray(found.force)[0, 0]
    np.testing.assert_allclose(ratio, [0.75, 0.25], atol=0.01)
    assert found.contact_force[1, 1] == 0
    assert found.map.standard_error.shape == (2, 400)
    found = calib.force_map(located, np.zeros((3, 550)), np.concatenate([pressures, pressures[:1]]))
    assert found.contact_force.shape == (3, 1)


@pytest.mark.parametrize("part", [0.04, 0.07, 0.12])
def test_no_force_of_pads_is_lost_between_contacts(located, part):
    """A contact that has a share of the map of a pad has the same share of the pad's force."""
    forces, width, amplitude = force_model(located), jnp.full((1, 2), 0.015), jnp.array([[2.0, 1.0]])
    position = jnp.array([[[0.1 + 0.015 * ndtri(part), 0.05], [0.15, 0.05]]])  # the first has such a part on pad 1
    shares = je.fusion.contact_shares(position, width, amplitude, forces.recon.centres, forces.masks)
    np.testing.assert_allclose(shares.lies[0, 0, 1], part, atol=0.005)
    places, pressures = Places(position, shares.share, width, amplitude), jnp.array([[1600.0, 800.0, 0.0, 0.0]])
    found = eqx.filter_jit(fused)(forces, jnp.ones((1, 400)), pressures, places, None, 0.6)
    np.testing.assert_allclose(found.contact_force[0], shares.share[0, :, :2] @ found.force[0, :2], rtol=1e-9)
    np.testing.assert_allclose(found.contact_force.sum(), found.force.sum(), rtol=1e-9)


def test_a_reading_across_a_wall_has_the_interval_by_which_presses_are_evaluated(located):
    """The pads share their field, so that the total errs by more than independent errors of the pads."""
    forces, (position, width) = force_model(located), (jnp.array([[[0.1, 0.05]]]), jnp.array([[0.01]]))
    share = je.fusion.contact_shares(position, width, jnp.ones((1, 1)), forces.recon.centres, forces.masks).share
    places, pressures = Places(position, share, width, jnp.ones((1, 1))), jnp.array([[500.0, 500.0, 0.0, 0.0]])
    forces = replace(forces, pads=replace(forces.pads, hold_noise=None, sensor=None))
    found = eqx.filter_jit(fused)(forces, jnp.ones((1, 400)), pressures, places, None, 0.6)
    np.testing.assert_allclose(forces.pads.multiple * found.total_error, forces.pads.hold_forces(pressures, places)[1])
    assert found.total_error[0] > np.sqrt(np.sum(found.standard_error[0] ** 2))


def test_evaluate_on_another_session(calibration, skin, folder):
    sites = np.array([[0.05, 0.05], [0.15, 0.14]])
    path = simulate(bench(skin, sites, seed=7), folder / "other.h5", fidelity=je.Fidelity.draft(edge_length=0.05))
    with calib.open_session(path) as session:
        found = calib.evaluate(calibration, session)
        assert found.held_out_by == "session"
        assert found.summary()["force_rmse"] < 0.5
        np.testing.assert_allclose(found.position, sites)


def test_apply_writes_the_force_of_every_frame(calibration, grid, folder):
    out = folder / "forcemap.h5"
    with calib.open_session(grid) as session:
        calib.apply(calibration, session, out)
        frames = len(session.stream("eit"))
    with h5netcdf.File(out, "r") as file:  # as xarray opens it
        axes = {name: file.variables[name].dimensions for name in ("force", "pad_force", "centres", "x")}
        time, epoch = file.variables["time"].attrs["units"], file.attrs["time_epoch_utc"]
        axes |= {name: file.variables[name].dimensions for name in ("points", "pad_names", "pad_normals")}
    named = {"force": ("time", "pixel"), "pad_force": ("time", "pad"), "centres": ("pixel", "axis"), "x": ("pixel",)}
    named |= {"points": ("pixel", "space"), "pad_names": ("pad",), "pad_normals": ("pad", "space")}
    assert axes == named
    assert np.bytes_(time).decode() == f"nanoseconds since {np.bytes_(epoch).decode()}"
    archive = calib.session.read_archive(out, "skin-forcemap")
    np.testing.assert_array_equal(archive.arrays["points"][:, :2], archive.arrays["centres"])
    assert archive.arrays["pad_names"].tolist() == [pad.name for pad in calibration.skin.pads]
    bag = calib.export_mcap(out, folder / "bag")
    assert bag.topics["/skin/pads/upper_left/wrench"] == ("geometry_msgs/msg/WrenchStamped", frames)
    force, pads = archive.arrays["force"], archive.arrays["pad_force"]
    assert force.shape == (frames, 400)
    np.testing.assert_allclose(force.sum(1), pads.sum(1), atol=1e-4)
    with calib.open_session(grid) as session:
        middle = (session.presses.t_hold0[3] + session.presses.t_hold1[3]) // 2
    held = np.argmin(np.abs(archive.arrays["time"] - middle))
    assert pads[held].sum() == pytest.approx(20.0, rel=0.1)
    assert archive.arrays["shape_valid"][held].any()
    assert np.abs(pads[:8].sum(1)).max() < 0.5  # the blank
    np.testing.assert_allclose(archive.arrays["force_se"].sum(1), archive.arrays["pad_force_se"].sum(1), rtol=1e-5)
    with calib.open_session(grid) as session:
        known = session.stream("force")
        reference = np.interp(archive.arrays["time"], known.time, known.read()[:, 0])
    total, half = archive.arrays["total_force"], archive.arrays["total_force_half"]
    np.testing.assert_allclose(total, pads.sum(1))
    assert np.mean(np.abs(total - reference)[reference > 1] <= half[reference > 1]) > 0.85
    each = archive.arrays["pad_force_half"]  # independent without a field
    np.testing.assert_allclose(half, np.sqrt((each**2).sum(1)))
    assert "contact_force" not in archive.arrays  # without a correction by location no contact is looked for


def test_a_failed_apply_leaves_no_file(calibration, grid, folder):
    out = folder / "never.h5"

    def break_off(blocks):
        yield from list(blocks)[:1]
        raise KeyboardInterrupt

    with calib.open_session(grid) as session, pytest.raises(KeyboardInterrupt):
        calib.apply(calibration, session, out, progress=break_off)
    assert not out.exists()
    assert not list(folder.glob("*never*"))


KILLS = 100


@pytest.mark.slow
def test_100_kills_leave_the_old_result_or_a_complete_new_one(calibration, tmp_path, monkeypatch):
    """Of the calibration and of each file of its report; what a kill leaves beside them is hidden."""
    known, ready, drawn = {}, [], {}
    draw = report.calibration_pictures
    monkeypatch.setattr(report, "calibration_pictures", lambda calibration, evaluations: drawn[calibration.notes])
    for mark in ("old", "new"):
        (tmp_path / mark).mkdir()
        ready.append(tmp_path / f"{mark}.h5")
        replace(calibration, notes=(mark,)).save(ready[-1])
        version = calib.load_calibration(ready[-1])
        drawn[version.notes] = draw(version, {})
        write_all(version, tmp_path / mark)
        for path in (tmp_path / mark).iterdir():
            known.setdefault(path.name, []).append(path.read_bytes())
    out, rng, halves, cycle = tmp_path / "out", np.random.default_rng(0), 0, 0.0
    out.mkdir()
    context = multiprocessing.get_context("forkserver")  # a fork before JAX has threads: 100 starts in a minute
    context.set_forkserver_preload(["tests.kill_worker"])
    for kill in range(KILLS + 1):
        begun = context.Event()
        worker = context.Process(target=write_for_ever, args=(ready, drawn, out, begun))
        worker.start()
        assert begun.wait(120)
        if kill:
            time.sleep(rng.uniform(0, 1.5 * cycle))
        else:  # how long a fresh process takes to write them all
            start = time.monotonic()
            while not {*known} <= {p.name for p in out.iterdir()}:
                assert time.monotonic() < start + 120
                time.sleep(0.01)
            cycle = time.monotonic() - start
        worker.kill()
        worker.join()
        for path in out.iterdir():
            if path.name.startswith("."):
                halves += 1
                path.unlink()
            else:
                assert path.read_bytes() in known[path.name], path.name
                if not kill:
                    path.unlink()
    assert sorted(p.name for p in out.iterdir()) == sorted(known)
    assert halves > 0  # some of the kills did come in the middle of a file


def test_the_same_bench_makes_the_same_file(skin, two, folder):
    again = simulate(bench(skin, SITES[:2]), folder / "same.h5", fidelity=je.Fidelity.draft(edge_length=0.05))
    assert again.read_bytes() == two.read_bytes()


# --- what is said when something is wrong --------------------------------------------------------


def _rewritten(grid, path, change):
    """A copy of the session with its streams changed by ``change(name, values)``, in the place of an earlier one."""
    path.unlink(missing_ok=True)
    with calib.open_session(grid) as s:
        writer = calib.SessionWriter(
            path,
            calib.session.SessionFacts(
                title="t",
                skin_name=s.skin_name,
                skin_toml=s.skin_toml,
                pattern=s.pattern,
                current=s.current,
                frequency=s.frequency,
                epoch=datetime.fromisoformat(s.epoch),
            ),
        )
        with writer:
            for name, stream in s.streams.items():
                values = change(name, stream.read())
                writer.add_stream(
                    name,
                    StreamFacts(
                        stream.variable, units=stream.unit, channels=values.shape[1], rate_hz=stream.nominal_rate
                    ),
                )
                writer.append(name, stream.time, values)
            writer.set_presses(s.presses)
    return path


def test_a_dead_eit_channel_is_left_out_and_named(grid, folder):
    def kill(name, values):
        return np.where(np.arange(values.shape[1]) == 12, np.nan, values) if name == "eit" else values

    path = _rewritten(grid, folder / "dead.h5", kill)
    with calib.open_session(path) as session:
        found = calib.calibrate([session], recipe=QUICK)
    assert any("left out: 12" in note for note in found.notes)
    assert found.evaluation.summary()["localisation_half_mean"] < 0.01
    assert not found.simulated


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda n, v: v[:, :3] if n == "pressure" else v, "has 3 columns, the skin 'testbed' has 4 pads"),
        (
            lambda n, v: np.where(np.arange(v.shape[1]) == 2, np.nan, v) if n == "pressure" else v,
            "column 2, pad 'upper left', holds no finite sample",
        ),
        (lambda n, v: np.nan * v if n == "force" else v, "none of 16 presses can be used"),
    ],
)
def test_a_missing_pad_or_load_cell_is_one_clear_line(grid, folder, change, message):
    path = _rewritten(grid, folder / "broken.h5", change)
    with calib.open_session(path) as session, pytest.raises(calib.SessionError, match=message) as caught:
        calib.calibrate([session])
    assert str(caught.value).startswith("broken.h5: ")
    assert "\n" not in str(caught.value)


def test_another_skin_is_refused(grid, skin):
    other = replace(skin, protocol=je.Protocol(skin.protocol.pattern[::-1]))
    with calib.open_session(grid) as session, pytest.raises(calib.SessionError, match="is not that of the skin"):
        calib.calibrate([session], other)


def test_columns_of_errors_stand_below_their_heads_whatever_the_recipe_is_called(calibration):
    long = replace(calibration.evaluation, recipe="affine-play, tensor-product-splines")
    lines = render_table(long, "t").splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("  total force"))
    rows = [line for line in lines[start + 1 :] if line[4:5].strip() and not line.strip().startswith("in their")]
    named = [line for line in rows if re.search(r"\d\.\d{3}  \(", line)]
    assert len(named) > 2
    assert any("tensor-product-splines" in line for line in named)
    assert {re.search(r"\d\.\d{3}  \(", line).start() + 5 for line in named} == {lines[start].index("CV") + 2}


def test_a_skin_of_the_same_scan_and_of_other_pads_is_told_apart(calibration, grid, skin, folder):
    """A mirrored skin has as many readings and pads: each number is well formed, and belongs elsewhere."""
    text = skin.toml.replace("[0.0, 0.0, 0.1, 0.1]", "[0.0, 0.0, 0.1, 0.09]")
    other = replace(je.skin.parse_skin(text, "other"), name="other", toml=text)
    path = simulate(
        bench(other, np.array([[0.05, 0.05]]), seed=7),
        folder / "of_other.h5",
        fidelity=je.Fidelity.draft(edge_length=0.05),
    )
    with calib.open_session(path) as session, calib.open_session(grid) as first:
        found = calib.evaluate(calibration, session)
        assert "localisation_half_mean_se" not in found.summary()  # one place tells no standard error
        assert "0.00)" not in render_table(found, "t").split("total force")[0]
        assert any("the pads of the skin that the session describes ('other') differ" in note for note in found.notes)
        with pytest.raises(calib.SessionError, match=r"of_other.h5: another skin than that of .*: its pads differ"):
            calib.calibrate([first, session])
        assert not any("differ from those" in note for note in calib.evaluate(calibration, first).notes)


def test_a_low_pass_the_stream_cannot_carry_is_refused(grid):
    asked = calib.presses.Processing(corrections=(calib.presses.LowPass(50.0),))
    with calib.open_session(grid) as session, pytest.raises(ValueError, match=r"eit.*10"):
        calib.calibrate([session], recipe=calib.Recipe(processing=asked))


def test_presses_without_a_held_out_force_are_said(skin):
    """Four places a pad and a curve of two parameters: some fits without a place fail, and no error can be told."""
    force = np.ones((16, 4))
    assert _not_predicted(skin, force) == ()
    force[2:5, 1] = np.nan
    (line,) = _not_predicted(skin, force)
    assert line.startswith("3 of 16 presses have no held-out force")
    assert "curves of lower right could not be fitted" in line


def test_a_pad_that_was_never_pressed(two):
    with calib.open_session(two) as session, pytest.raises(ValueError, match=r"pad 1 .*lower right"):
        calib.calibrate([session], recipe=QUICK)


def test_no_session_at_all():
    with pytest.raises(calib.SessionError, match="no session"):
        calib.calibrate([])


def test_sites_outside_the_sheet(skin):
    with pytest.raises(ValueError, match="site 0"):
        bench(skin, np.array([[0.3, 0.1]]))


def test_bundled_sessions_say_that_they_are_simulated(bundled):
    for path in bundled:
        with calib.open_session(path) as session:
            assert session.simulated
            assert session.scene == path.with_suffix(".toml").read_text()
            assert session.seed == calib.load_bench(path.with_suffix(".toml")).seed
        with h5py.File(path) as file:
            assert file.attrs["simulated"] == 1


def test_an_untouched_frame_that_fits_no_sheet_is_said(model):
    """Images and contacts then are those of an even sheet."""
    v0 = np.asarray(je.forward(model))
    sigma, (note,) = fit_untouched_sheet(model, -v0, np.ones(len(v0), bool))
    assert sigma is None
    assert "taken for even" in note
    assert "polarity" in note


@pytest.mark.slow
def test_images_are_those_of_the_sheet_that_the_untouched_frames_show(bundled):
    """The bundled bench has an uneven coat; images then are nearer to the presses than those of an even sheet."""
    with calib.open_session(bundled[0]) as session:
        known, even = (
            calib.calibrate([session], recipe=replace(QUICK, even_sheet=e)).evaluation for e in (False, True)
        )
    for name, ratio in (("half", 1.0), ("positive", 0.7)):
        error, assumed = (np.linalg.norm(e.estimated[name] - e.position, axis=1).mean() for e in (known, even))
        assert error < ratio * assumed


OWN_CURVE = """
from calib.fitting import Linear


class Straight(Linear):
    pass
"""


def test_a_calibration_with_a_curve_of_ones_own(grid, tmp_path, monkeypatch):
    """Whoever has imported the curve opens it; for others the file imports nothing, and the error says what to do."""
    (tmp_path / "curve_of_ones_own.py").write_text(OWN_CURVE)
    monkeypatch.syspath_prepend(tmp_path)
    recipe = replace(QUICK, curve=CURVES.make("curve_of_ones_own:Straight", allow_import=True))
    with calib.open_session(grid) as session:
        made = calib.calibrate([session], recipe=recipe)
    assert made.provenance["curve"] == "curve_of_ones_own:Straight"
    made.save(tmp_path / "c.h5")
    again = calib.load_calibration(tmp_path / "c.h5")
    assert type(again.curves.curve) is type(recipe.curve)
    np.testing.assert_array_equal(again.curves.parameters, made.curves.parameters)
    monkeypatch.delitem(sys.modules, "curve_of_ones_own")
    with pytest.raises(
        calib.SessionError,
        match=r"^c\.h5: .*curve 'curve_of_ones_own:Straight' is code outside jaxeit, which a data file cannot import; "
        "import curve_of_ones_own first, or install it with an entry point of the group 'calib.curves'$",
    ):
        calib.load_calibration(tmp_path / "c.h5")
    assert "curve_of_ones_own" not in sys.modules
