"""Electrical effects, each against the circuit of every reading put together from its resistors and solved."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit import effects as fx
from jaxeit.model.forward_model import transfer
from jaxeit.model.sheet_conductivity import coefficients

from ..helpers import square_model

ELECTRODES = 5
CURRENT = 1e-3
# Drive and sense apart, the faulty electrode 2 in each place, and shared electrodes.
PATTERN = np.array([[0, 1, 3, 4], [2, 1, 3, 4], [0, 2, 3, 4], [0, 1, 2, 4], [0, 1, 3, 2], [2, 1, 2, 4], [0, 2, 3, 2]])


def _sheet(seed=0):
    """A network between electrodes, as conductances between its nodes, and its transfer matrix."""
    rng = np.random.default_rng(seed)
    links = np.triu(rng.uniform(1e-3, 1e-2, (ELECTRODES, ELECTRODES)), 1)
    links = links + links.T
    laplacian = np.diag(links.sum(1)) - links
    # Each column may have its own constant, and so may each row once a reading takes differences of both.
    return links, np.linalg.pinv(laplacian) + rng.normal(size=(1, ELECTRODES))


def _circuit(dtype=np.float64):
    return fx.Circuit(jnp.asarray(_sheet()[1], dtype), jnp.asarray(PATTERN), jnp.asarray(CURRENT, dtype))


@jax.jit
def _measured(effects, circuit):
    z, (source, sink, plus, minus) = circuit.z, circuit.pattern.T
    ideal = circuit.current * (z[plus, source] - z[minus, source] - z[plus, sink] + z[minus, sink])
    return fx.fold(effects, fx.AbstractTerminalEffect, ideal, circuit)


IDEAL = _measured([], _circuit())


def _by_nodes(lost, resistance, compliance, input_resistance):
    """Every reading by nodal analysis of electrodes and wires of the lost ones; the drive- wire is ground.  A source
    beyond its compliance is one of that voltage instead."""
    links, _ = _sheet()
    count = ELECTRODES + len(lost)
    wire = np.arange(ELECTRODES)
    wire[lost] = ELECTRODES + np.arange(len(lost))
    nodes, unit = np.zeros((count, count)), np.eye(count)
    nodes[:ELECTRODES, :ELECTRODES] = np.diag(links.sum(1)) - links
    for electrode in lost:
        ends = np.ix_([electrode, wire[electrode]], [electrode, wire[electrode]])
        nodes[ends] += np.array([[1, -1], [-1, 1]]) / resistance
    out = []
    for source, sink, plus, minus in wire[PATTERN]:
        matrix = nodes + (np.diag(unit[plus]) + np.diag(unit[minus])) / input_resistance
        matrix[sink] = unit[sink]
        u = np.linalg.solve(matrix, CURRENT * unit[source])
        if u[source] > compliance:
            matrix[source] = unit[source]
            u = np.linalg.solve(matrix, compliance * unit[source])
        out.append(u[plus] - u[minus])
    return np.array(out)


@pytest.mark.parametrize("compliance", [1e9, 5.0, 0.2])
@pytest.mark.parametrize(("resistance", "input_resistance"), [(1e3, 1e15), (1e5, 1e6), (1e6, 1e7), (1e6, 1e4)])
def test_a_lost_electrode_is_the_circuit_solved(resistance, compliance, input_resistance):
    effect = je.effects.ElectrodeFault(
        electrode=2, resistance=resistance, compliance=compliance, input_resistance=input_resistance
    )
    brute = _by_nodes([2], resistance, compliance, input_resistance)
    np.testing.assert_allclose(_measured([effect], _circuit()), brute, rtol=1e-9, atol=1e-15)


def test_electrodes_lost_together_are_one_circuit():
    effect = je.effects.ElectrodeFault(electrode=[0, 2], resistance=[1e5, 1e5], compliance=5.0, input_resistance=1e6)
    np.testing.assert_allclose(_measured([effect], _circuit()), _by_nodes([0, 2], 1e5, 5.0, 1e6), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("resistance", [0.0, 1e6])
def test_ideal_source_and_amplifier_do_not_see_an_open_electrode(resistance):
    """Four-terminal readings are the ideal ones to the last digit; shared electrodes have the wire in them."""
    effect = je.effects.ElectrodeFault(electrode=2, resistance=resistance, compliance=jnp.inf, input_resistance=jnp.inf)
    measured = np.asarray(_measured([effect], _circuit()))
    np.testing.assert_array_equal(measured[:5], IDEAL[:5])
    np.testing.assert_allclose(measured[5:] - np.asarray(IDEAL[5:]), CURRENT * resistance, rtol=1e-12)


def test_an_open_drive_takes_what_the_source_can_give():
    """1 V through 1 Mohm: a thousandth of the current, whatever the sheet."""
    effect = je.effects.ElectrodeFault(electrode=2, resistance=1e6, compliance=1.0, input_resistance=jnp.inf)
    measured = np.asarray(_measured([effect], _circuit()))
    np.testing.assert_allclose(measured[1:3], np.asarray(IDEAL)[1:3] * 1e-3, rtol=1e-3)
    np.testing.assert_array_equal(measured[[0, 3, 4]], IDEAL[np.array([0, 3, 4])])


def test_lost_electrodes_in_single_precision():
    """The megohm does not drown the sheet: readings are right to single precision."""
    effect = je.effects.ElectrodeFault(electrode=2)
    single = _measured([jax.tree.map(_single, effect)], _circuit(np.float32))
    assert single.dtype == jnp.float32
    exact = np.asarray(_measured([effect], _circuit()))
    np.testing.assert_allclose(single, exact, rtol=3e-5, atol=1e-6 * np.abs(np.asarray(IDEAL)).max())


def _single(leaf):
    return leaf.astype(jnp.float32) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


@pytest.mark.parametrize("limit", [5.0, jnp.inf])
def test_faults_have_slopes(limit):
    def total(effect, circuit):
        return _measured([effect], circuit).sum()

    effect = je.effects.ElectrodeFault(electrode=2, compliance=limit, input_resistance=1e6 * limit)
    slopes = jax.jit(jax.grad(total, allow_int=True, argnums=(0, 1)))(effect, _circuit())
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(slopes) if leaf.dtype == jnp.float64]
    assert len(leaves) == 5
    assert all(np.isfinite(leaf).all() for leaf in leaves)


def test_faults_in_a_batch():
    def lost(resistance):
        return _measured([je.effects.ElectrodeFault(electrode=2, resistance=resistance)], _circuit())

    resistances = jnp.array([0.0, 1e3, 1e6])
    np.testing.assert_allclose(jax.vmap(lost)(resistances), [lost(r) for r in resistances], rtol=1e-12)


def test_common_mode_is_the_mean_potential_above_ground():
    links, _ = _sheet()
    laplacian = np.diag(links.sum(1)) - links
    extra = []
    for source, sink, plus, minus in PATTERN:
        keep = np.arange(ELECTRODES) != sink
        u = np.zeros(ELECTRODES)
        u[keep] = np.linalg.solve(laplacian[keep][:, keep], CURRENT * (np.arange(ELECTRODES) == source)[keep])
        extra.append((u[plus] + u[minus]) / 2)
    added = _measured([je.effects.CommonMode(gain=0.1)], _circuit()) - IDEAL
    np.testing.assert_allclose(added, 0.1 * np.array(extra), rtol=1e-9)
    np.testing.assert_array_equal(_measured([je.effects.CommonMode(gain=0.0)], _circuit()), IDEAL)


def test_a_source_that_gives_less_gives_less_common_mode():
    effects = [
        je.effects.ElectrodeFault(electrode=2, compliance=1.0, input_resistance=jnp.inf),
        je.effects.CommonMode(gain=0.1),
    ]
    np.testing.assert_array_equal(_measured(effects, _circuit()), _measured(effects[::-1], _circuit()))
    both, common = (np.asarray(_measured(e, _circuit())) for e in (effects, effects[1:]))
    np.testing.assert_allclose(both[1:3], common[1:3] * 1e-3, rtol=1e-3)


def test_contacts_scatter_log_normally_and_perfect_ones_stay():
    scatter = jax.jit(lambda effect, contact: effect(contact))
    ones = jnp.ones(20000)
    log = np.log(scatter(je.effects.ContactScatter(std=0.5, seed=1), ones))
    assert log.mean() == pytest.approx(0, abs=0.015)
    assert log.std() == pytest.approx(0.5, rel=0.03)
    assert np.all(np.asarray(scatter(je.effects.ContactScatter(), jnp.zeros(7))) == 0)
    assert np.all(np.asarray(scatter(je.effects.ContactScatter(std=0.0), ones)) == 1)
    other = np.log(scatter(je.effects.ContactScatter(std=0.5, seed=2), ones))
    assert abs(np.corrcoef(log, other)[0, 1]) < 0.03
    assert scatter(je.effects.ContactScatter(), jnp.ones(3, jnp.float32)).dtype == jnp.float32


def test_terminals_act_on_the_forward_model():
    """Through `forward`, with the model's own matrix, protocol and current: two equations for its inputs."""
    points = [(0.06, 0.06), (0.14, 0.10), (0.10, 0.14), (0.06, 0.12)]
    bare = square_model(points, [[0, 1, 2, 3]], 10)
    fault = je.effects.ElectrodeFault(electrode=2, resistance=20.0, compliance=jnp.inf, input_resistance=30.0)
    model = eqx.tree_at(lambda m: m.effects, bare, (fault,), is_leaf=lambda x: x is bare.effects)
    z = np.array(transfer(bare, coefficients(bare, None))) + np.diag([0, 0, 20.0, 0])
    above = z - z[1] - z[:, 1:2] + z[1, 1]
    inputs = np.linalg.solve(np.eye(2) + above[2:, 2:] / 30.0, above[2:, 0])
    np.testing.assert_allclose(je.forward(model), float(bare.current) * (inputs[0] - inputs[1]), rtol=1e-9)


@pytest.mark.parametrize(("given", "message"), [(1.5, "whole number"), (-1, "whole number"), (True, "whole number")])
def test_an_electrode_of_a_scene_file_is_a_whole_number(given, message):
    table = {"type": "ElectrodeFault", "electrode": given}
    with pytest.raises(je.toml.TomlError, match=message):
        je.model.read_effects(je.toml.TomlTable({"effects": [table]}, "scene.toml"))


def test_effects_of_a_scene_file_have_their_types():
    table = {"type": "ElectrodeFault", "electrode": 7, "resistance": 10}
    (effect,) = je.model.read_effects(je.toml.TomlTable({"effects": [table]}, "scene.toml"))
    assert int(effect.electrode) == 7
    assert effect.electrode.dtype == jnp.asarray(0).dtype
    assert effect.resistance.dtype == jnp.asarray(0.0).dtype


def test_the_jacobian_is_that_of_what_the_terminals_see():
    """Against forward differentiation of `forward`, through a fault that limits the current."""
    points = [(0.06, 0.06), (0.14, 0.10), (0.10, 0.14), (0.06, 0.12)]
    effects = (
        je.effects.CommonMode(gain=0.01),
        je.effects.ElectrodeFault(electrode=0, resistance=50.0, compliance=20.0),
    )
    model = square_model(points, [[0, 1, 2, 3], [2, 3, 0, 1], [1, 2, 0, 3]], 10, effects=effects)
    expected = jax.jacfwd(lambda sigma: je.forward(model, sigma))(model.background)
    np.testing.assert_allclose(je.jacobian(model), expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    bare = square_model(points, [[0, 1, 2, 3], [2, 3, 0, 1], [1, 2, 0, 3]], 10)
    assert np.abs(je.jacobian(bare) - expected).max() > 0.1 * np.abs(expected).max()
    with pytest.raises(ValueError, match="ElectrodeFault acts between sheet and readings"):
        je.prepare(model)
