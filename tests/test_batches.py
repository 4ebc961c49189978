"""Batches are the loop: over conductivities, and over skins of one shape."""

import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je

from .helpers import skin_of
from .test_docs import blocks

ROOT = Path(__file__).parents[1]
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


def _many(count):
    """Conductivities of a model, (count, elements), all different."""
    model = _model(SHEETS[0], SOLVERS[0])
    return model, np.asarray(model.background) * np.linspace(0.5, 2, count)[:, None]


@pytest.mark.parametrize("count", [1, 5, 13])
def test_many_samples_are_the_loop(count):
    """The last batch, of whichever size, too."""
    model, sigmas = _many(count)
    found = je.bind_many(je.forward, model, together=4)(sigmas)
    np.testing.assert_allclose(found, np.stack([je.forward(model, sigma) for sigma in sigmas]), rtol=1e-12)


def test_many_samples_may_be_pytrees_and_give_pytrees():
    def both(model, given):
        v = je.forward(model, given["sigma"])
        return {"scaled": given["factor"] * v, "size": jnp.max(jnp.abs(v))}

    model, sigmas = _many(6)
    found = je.bind_many(both, model, together=2)({"sigma": jnp.asarray(sigmas), "factor": np.arange(6.0)})
    for n, sigma in enumerate(sigmas):
        np.testing.assert_allclose(found["scaled"][n], n * je.forward(model, sigma), rtol=1e-12)
        np.testing.assert_allclose(found["size"][n], jnp.abs(je.forward(model, sigma)).max(), rtol=1e-12)


def test_many_samples_under_jit_and_grad_are_part_of_the_program():
    model, sigmas = _many(5)
    voltages = je.bind_many(je.forward, model, together=2)

    def energy(sigmas):
        return jnp.sum(voltages(sigmas) ** 2)

    each = jnp.stack([jax.grad(lambda sigma: jnp.sum(je.forward(model, sigma) ** 2))(sigma) for sigma in sigmas])
    np.testing.assert_allclose(jax.jit(jax.grad(energy))(jnp.asarray(sigmas)), each, rtol=1e-9)


def test_a_bad_sample_spoils_its_own_readings_only():
    model, sigmas = _many(5)
    voltages, whole = je.bind_many(je.forward, model, together=4), sigmas.copy()
    sigmas[2] = np.nan
    found, kept = np.asarray(voltages(sigmas)), [0, 1, 3, 4]
    assert np.isnan(found[2]).all()
    np.testing.assert_array_equal(found[kept], np.asarray(voltages(whole))[kept])


def test_models_that_differ_in_their_numbers_share_the_program_of_many(compilations):
    (model, sigmas), other = _many(4), _model(SHEETS[1], SOLVERS[0])
    je.bind_many(je.forward, model)(sigmas)
    seen = len(compilations)
    found = je.bind_many(je.forward, other)(sigmas)
    assert len(compilations) == seen
    np.testing.assert_allclose(found[0], je.forward(other, sigmas[0]), rtol=1e-12)


def test_samples_that_do_not_fit_are_refused():
    model, sigmas = _many(4)
    with pytest.raises(ValueError, match=r"shapes \(4, 200\), \(3,\); give arrays with equally many samples"):
        je.bind_many(lambda model, sigma, factor: factor * je.forward(model, sigma), model)(sigmas, np.ones(3))
    with pytest.raises(ValueError, match=r"shapes \(0, 200\); give arrays"):
        je.bind_many(je.forward, model)(sigmas[:0])
    with pytest.raises(ValueError, match="shapes none; give arrays"):
        je.bind_many(je.forward, model)()
    with pytest.raises(ValueError, match="together is 0; give the number of samples"):
        je.bind_many(je.forward, model, together=0)


@pytest.mark.slow
@pytest.mark.parametrize("devices", [1, 3])
def test_the_program_of_the_page_shares_samples_out_over_devices(devices):
    """Also where a device gets none; the readings are those of single solutions."""
    ((language, _, program),) = blocks(ROOT / "docs" / "speed.md")
    assert language == "python"
    checks = (
        f"assert jax.local_device_count() == {devices}\n"
        "for n in (0, 66, 67, 133, 199):\n"
        "    np.testing.assert_allclose(voltages[n], je.forward(model, sigmas[n]), rtol=1e-10)\n"
        "np.testing.assert_allclose(je.bind_many(je.forward, model)(sigmas[:1])[0], voltages[0], rtol=1e-10)\n"
    )
    code = program.replace("os.cpu_count()", str(devices)) + checks
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
