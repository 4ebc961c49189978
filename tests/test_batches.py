"""Batches are the loop: over conductivities, and over skins of one shape."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je

from .helpers import skin_of

CELLS = 10
PLACES = np.array([(0.2, 0.2), (0.7, 0.5), (0.5, 0.7), (0.2, 0.6), (0.8, 0.2)])  # of electrodes, in widths and heights
PATTERN = [[0, 1, 2, 3], [0, 2, 1, 4], [3, 4, 0, 1]]
SHEETS = [(0.2, 0.2, 1.0), (0.25, 0.15, 3.0), (0.16, 0.22, 0.5)]  # width, height, ohm
MIDDLE = CELLS // 2 * (CELLS + 2)  # the ground: by default the node nearest the middle, which other shapes may move
SOLVERS = [je.linalg.NestedDissection(), je.linalg.Dense()]


def _model(sheet, solver, bend=0.0):
    """Electrodes on the same nodes whatever the size; ``bend`` moves nodes off the lines of the grid."""
    width, height, resistance = sheet
    size, unit = np.array([width, height]), je.meshing.structured(je.Rectangle(1.0, 1.0), CELLS, CELLS)
    points = [je.PointElectrode(tuple(p)) for p in (size * _bent(PLACES, bend)).tolist()]
    skin = skin_of(je.Rectangle(width, height), points, PATTERN, sheet_resistance=resistance)
    mesh = je.meshing.Mesh(size * _bent(unit.nodes, bend), unit.triangles)
    return je.discretise(je.Scene(skin), je.Fidelity(solver=solver), mesh=mesh, ground=MIDDLE)


def _bent(places, amount):
    x, y = places.T
    bump = amount * np.sin(np.pi * x) * np.sin(np.pi * y)
    return np.stack([x + bump * np.cos(3 * y), y - bump * np.sin(4 * x)], 1)


def _stack(models):
    """Models of equal shapes as one, with a leading axis on every array."""
    arrays, rest = zip(*(eqx.partition(model, eqx.is_array) for model in models), strict=True)
    return eqx.combine(jax.tree.map(lambda *leaves: jnp.stack(leaves), *arrays), rest[0])


def _uneven(model):
    return model.background * (1 + 0.3 * jnp.sin(jnp.arange(model.background.size)))


def _slope(model, sigma):
    """Of a weighed sum of the readings, with respect to the conductivity."""
    return jax.grad(lambda s: jnp.array([1.0, -2.0, 0.5]) @ je.forward(model, s))(sigma)


def _same(together, alone):
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12 * np.abs(other).max())


@pytest.mark.slow
def test_conductivities_together():
    model = _model(SHEETS[1], SOLVERS[0])
    sigma = jnp.stack([model.background, _uneven(model), 2 * _uneven(model)[::-1]])
    readings, image = [je.forward(model, s) for s in sigma], je.Pixels(6).on(model)
    _same(jax.vmap(lambda s: je.forward(model, s))(sigma), readings)
    _same(jax.vmap(lambda s: je.jacobian(model, s, image))(sigma), [je.jacobian(model, s, image) for s in sigma])


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS, ids=["nested", "dense"])
def test_skins_of_one_shape_together(solver):
    """Stretched skins of different sheet resistance; nested dissection cuts all of them alike."""
    models = [_model(sheet, solver) for sheet in SHEETS]
    _skins_are_the_loop(models)


@pytest.mark.slow
def test_bent_skins_together_share_one_plan():
    """Nested dissection cuts by coordinates, so plans differ; as the pattern is the same, either serves both."""
    models = [_model(sheet, SOLVERS[0], bend) for sheet, bend in zip(SHEETS, (0.0, 0.02, 0.04), strict=True)]
    with pytest.raises(ValueError, match="same shape"):
        _stack(models)
    plan = models[0].system.plan
    for model in models:
        np.testing.assert_array_equal([model.system.plan.rows, model.system.plan.cols], [plan.rows, plan.cols])
    alike = [eqx.tree_at(lambda m: m.system.plan, model, plan) for model in models]
    _skins_are_the_loop(alike)
    _same([je.forward(model) for model in alike], [je.forward(model) for model in models])


def _skins_are_the_loop(models):
    stacked, sigma = _stack(models), [_uneven(model) for model in models]
    together, alone = eqx.filter_vmap(je.forward)(stacked), [je.forward(model) for model in models]
    _same(together, alone)
    assert np.all(np.ptp(alone, axis=0) > 0.1 * np.abs(alone).max(0))  # they are skins, not one thrice
    slope, pairs = eqx.filter_jit(_slope), zip(models, sigma, strict=True)
    _same(eqx.filter_vmap(slope)(stacked, jnp.stack(sigma)), [slope(*pair) for pair in pairs])
