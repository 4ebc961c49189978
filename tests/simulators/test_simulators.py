"""Contacts in space become loads on the sheet, and steps give what the simulated bench gives."""

import sys
from dataclasses import replace
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from calib import simulators
from calib.simulators import ContactPoints, SimulatorError
from jaxeit import effects as fx

SHEET = (fx.LoadSpreading(), fx.ContactPiezoresistance())
HISTORIES = (fx.Creep(), fx.Hysteresis(), fx.GasRelaxation(), fx.PadLeak(20.0), fx.Noise(2.0, fx.StreamKind.PRESSURE))
PLACES = np.array([[0.06, 0.07], [0.12, 0.15]])
RATE = 10.0  # Hz


@pytest.fixture(scope="module")
def plain(skin):
    """The testbed without anything that remembers."""
    return simulators.prepare_skin(je.Scene(skin, SHEET), RATE, je.Fidelity.draft())


def contacts(force, position=PLACES, diameter=0.02):
    return ContactPoints(np.asarray(position), np.asarray(force), np.full(np.shape(force), diameter))


def frame_under(model, places, forces):
    """Readings as the simulated bench computes them."""
    spread = [force * je.model.load_spread(model, place, 0.02) for place, force in zip(places, forces, strict=True)]
    return je.forward(model, je.conductivity(model, sum(spread)))


def test_a_step_reads_what_the_scene_gives(plain, skin):
    state, found = simulators.step(plain, plain.start(), contacts([12.0, 5.0]))
    expected = np.asarray(frame_under(plain.model, PLACES, [12.0, 5.0]))
    np.testing.assert_allclose(found.frame, expected, rtol=1e-12, atol=1e-14 * np.abs(expected).max())
    areas = np.array([pad.area for pad in skin.pads])
    assert found.load == pytest.approx(17.0, rel=0.01)  # what lies past the rim is lost
    assert found.pressure @ areas == pytest.approx(float(found.load), rel=1e-3)  # the pads cover the sheet
    assert found.pressure[0] * areas[0] == pytest.approx(12.0, rel=0.03)
    assert int(state.number) == 1
    _, rest = simulators.step(plain, state, contacts([0.0, -3.0]))  # empty rows
    np.testing.assert_array_equal(rest.frame, plain.resting)
    assert not np.any(rest.pressure)


def test_histories_continue_from_step_to_step(skin):
    """One contact that stays: memory of its load, as the bench computes it for a whole block."""
    felt = simulators.prepare_skin(je.Scene(skin, SHEET + HISTORIES), RATE, je.Fidelity.draft())
    loads = np.array([0.0, 8.0, 15.0, 15.0, 6.0, 0.0, 3.0])
    steps, state, found = je.bind(simulators.step, felt), felt.start(seed=3), []
    for load in loads:
        state, readings = steps(state, contacts([load], PLACES[:1]))
        found.append(readings)
    model, still = felt.model, jnp.zeros(len(loads))
    line = fx.HistoryInputs(jax.random.key(0), jnp.asarray(1 / RATE), still, still, model.pattern[:0])

    def series(family, values):
        mine = fx.chosen(model.effects, family)
        return np.asarray(
            fx.history(mine, jnp.asarray(values), fx.history_start(mine, jnp.zeros_like(values[0])), line)[0]
        )

    remembered = series(fx.AbstractMemoryEffect, loads[:, None])[:, 0]
    assert np.abs(remembered - loads).max() > 0.5
    for readings, load in zip(found, remembered, strict=True):
        np.testing.assert_allclose(readings.frame, frame_under(model, PLACES[:1], [load]), rtol=1e-9)
    ideal = loads[:, None] * np.asarray(felt.response @ je.model.load_spread(model, PLACES[0], 0.02))
    pads = series(fx.AbstractPneumaticEffect, ideal)
    assert np.abs(pads - ideal).max() > 50
    noise = np.array([readings.pressure for readings in found]) - pads
    assert 1.2 < noise.std() < 3  # 28 samples of a standard deviation of 2 Pa
    assert len(np.unique(noise)) == noise.size


def test_environments_do_not_see_each_other(plain):
    force = np.array([[12.0, 0.0], [3.0, np.nan], [4.0, 5.0]])
    batch = contacts(force, np.stack([PLACES, PLACES, PLACES[::-1]]))
    state, found = simulators.step(plain, plain.start(environments=3), batch, portion=2)
    assert np.isnan(found.frame[1]).all()
    for row in (0, 2):
        alone = simulators.step(plain, plain.start(), ContactPoints(*(part[row] for part in batch)))[1]
        np.testing.assert_allclose(found.frame[row], alone.frame, rtol=0, atol=1e-12 * np.abs(alone.frame).max())
        np.testing.assert_allclose(found.pressure[row], alone.pressure, rtol=1e-12)
    assert state.number.tolist() == [1, 1, 1]
    with pytest.raises(SimulatorError, match=r"position \(2, 2\).* do not fit a state of \(3,\)"):
        simulators.step(plain, state, contacts([1.0, 2.0]))


def test_frames_from_slopes_are_near_those_that_are_solved(plain, skin):
    """Exact to first order; at some newtons much nearer than the first order is."""
    quick = simulators.prepare_skin(je.Scene(skin, SHEET), RATE, je.Fidelity.draft(), simulators.Polarised())

    def change(of, force):
        return np.asarray(simulators.step(of, of.start(), contacts(force))[1].frame - plain.resting)

    for force, error in ((0.01, 1e-4), (3.0, 0.02), (10.0, 0.04)):
        exact = change(plain, [force, force])
        assert np.linalg.norm(change(quick, [force, force]) - exact) < error * np.linalg.norm(exact), force
    first_order = 1e3 * change(quick, [0.01, 0.01])
    assert np.linalg.norm(first_order - exact) > 0.1 * np.linalg.norm(exact)

    def total(force):
        return jnp.sum(simulators.step(quick, quick.start(), contacts([0.0, 0.0])._replace(force=force))[1].frame)

    force = jnp.array([3.0, 8.0])
    slope = jax.grad(total)(force)
    steps = 1e-3 * jnp.eye(2)
    by_steps = [(total(force + step) - total(force - step)) / 2e-3 for step in steps]
    np.testing.assert_allclose(slope, by_steps, rtol=1e-6)
    coated = je.Scene(skin, (fx.LoadSpreading(), fx.ContinuousCoating()))
    with pytest.raises(SimulatorError, match="choose Solved"):
        simulators.prepare_skin(coated, RATE, je.Fidelity.draft(), simulators.Polarised())


@pytest.mark.parametrize(
    ("effects", "rate", "message"),
    [
        (SHEET[1:], RATE, "add jaxeit.effects.LoadSpreading"),
        (SHEET[:1], RATE, "add jaxeit.effects.ContactPiezoresistance"),
        ((*SHEET, fx.ScanSkew()), RATE, "ScanSkew cannot act"),
        ((*SHEET, fx.DropOut()), RATE, "DropOut cannot act"),
        (SHEET, 0.0, "steps a second"),
    ],
)
def test_scenes_that_have_no_steps(skin, effects, rate, message):
    with pytest.raises(SimulatorError, match=message):
        simulators.prepare_skin(je.Scene(skin, effects), rate, je.Fidelity.draft())


def test_what_is_left_out_is_counted(skin):
    """On a sheet rolled over a cylinder of 0.1 m; the forces are along the normal, so that loads are known."""
    rolled = replace(skin, surface=je.Cylinder(0.1, middle=0.1))
    angle = np.array([-0.5, 0.3, 0.9, 1.1, 0.0, 0.0])
    normal = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)
    height = np.array([0.0, -0.004, 0.004, 0.0, 0.02, 0.0])
    points = (0.1 + height)[:, None] * normal + [0.0, 0.15, 0.0]
    friction = np.array([0.0, 5.0, 0.0])
    load = np.array([3.0, 4.0, 5.0, 6.0, 7.0, -8.0])  # the fourth is past the rim, the fifth above, the last pulls
    placed = simulators.place_contacts(rolled, points, friction - load[:, None] * normal, slots=3)
    np.testing.assert_allclose(placed.contacts.force, [3.0, 4.0, 5.0], rtol=1e-12)
    np.testing.assert_allclose(placed.contacts.position[:, 0], 0.1 + 0.1 * angle[:3], rtol=1e-12)
    assert (placed.off_sheet, placed.pulling) == (2, 1)
    batch = simulators.place_contacts(rolled, points, friction - load[:, None] * normal, [1, 0, 5])
    assert batch.contacts.force.sum(1) == pytest.approx([3.0, 0.0, 9.0])
    assert batch.off_sheet.tolist() == [0, 0, 2]
    with pytest.raises(SimulatorError, match="give slots=3"):
        simulators.place_contacts(rolled, points, -load[:, None] * normal, slots=2)
    with pytest.raises(SimulatorError, match="diverged"):
        simulators.place_contacts(rolled, points, np.full((6, 3), np.inf))


def test_mujoco_is_asked_for_by_name(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "calib.simulators.mujoco", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'jaxeit\[mujoco\]'"):
        import_module("calib.simulators.mujoco")
