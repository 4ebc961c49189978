"""Batches in lanes are the single matrices: corners of the inverse, whole models, derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.backend import backends

import jaxeit as je
from jaxeit._compile import compiler_options
from jaxeit.linalg import NestedDissection, SparsityPattern
from jaxeit.linalg.multifrontal import batches, nested_dissection
from jaxeit.linalg.multifrontal.batches import MIN_BATCH, eliminated_lanes, lane_count, lane_plan, unrolled_levels

from ..helpers import skin_of
from .test_solvers import SHAPES, as_pattern, relative, square_sheet

SOLVER = NestedDissection(leaf_size=10)
COUNT = 37  # no multiple of a number of lanes
SQUARE = je.Rectangle(0.2, 0.2)

quick = partial(jax.jit, compiler_options=compiler_options())


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


corner = quick(SOLVER.corner)
corners = quick(jax.vmap(SOLVER.corner, (None, 0)))  # one program for all tests with these shapes


def one_by_one(plan, values):
    return jnp.stack([corner(plan, v) for v in values])


def strengths(count):
    return np.random.default_rng(1).uniform(0.5, 2, (count, 1))


def sheet(contrast=1.0, side=8):
    """A plan with complete electrodes at the root, and matrices that differ by more than a factor."""
    conductances = np.array([1e-2, 1.0, 1e4])
    several = [square_sheet(side, contrast, g * conductances) for g in strengths(COUNT)[:, 0]]
    pattern, _ = as_pattern(*several[0], side**2 + np.arange(3))
    return SOLVER.analyse(pattern), jnp.stack([as_pattern(matrix)[1] for matrix, _ in several])


@pytest.fixture
def sweeps(monkeypatch):
    """Numbers of lanes of the sweeps that have been traced."""
    lanes = []
    jax.clear_caches()

    def recorded(plan, values):
        lanes.append(values.shape[1])
        return eliminated_lanes(plan, values)

    monkeypatch.setattr(nested_dissection, "eliminated_lanes", recorded)
    return lanes


def trace(plan, values):
    """Trace the program for a batch, or a batch of batches, as often as it is asked."""
    program = jax.vmap(lambda plan, v: SOLVER.corner(plan, v), (None, 0))
    jax.eval_shape(program if values.ndim == 2 else jax.vmap(program, (None, 0)), plan, values)


@pytest.mark.parametrize("contrast", [0.5, 3.0])
def test_a_batch_is_its_matrices(contrast, sweeps):
    plan, values = sheet(contrast)
    trace(plan, values)
    assert lane_count(values.dtype) in sweeps
    assert len(sweeps) == len(backends())
    assert unrolled_levels(plan.levels) == 1
    assert relative(corners(plan, values), one_by_one(plan, values)) < 1e-9 * 10**contrast


def test_single_precision():
    plan, values = sheet()
    assert COUNT % lane_count(np.dtype("float32"))
    found = corners(plan, values.astype(jnp.float32))
    assert found.dtype == np.float32
    assert relative(np.asarray(found), np.asarray(one_by_one(plan, values))) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_shapes_that_break_orderings(shape):
    matrix, coords = SHAPES[shape]()
    root = np.unique([0, matrix.shape[0] - 1])
    pattern, values = as_pattern(matrix, coords, root)
    batch = values * strengths(MIN_BATCH)
    plan = SOLVER.analyse(pattern)
    expected = np.linalg.inv(matrix.toarray())[np.ix_(root, root)] / strengths(MIN_BATCH)[..., None]
    np.testing.assert_allclose(corners(plan, batch), expected, rtol=1e-10)


@pytest.mark.slow
def test_narrow_fronts_under_wide_ones():
    """The root and the level below it have more pivots than are written out; the others are done subtree by subtree."""
    matrix, coords = square_sheet(80, 0.5, np.ones(2))
    pattern, values = as_pattern(matrix, coords, [6400, 6401])
    plan = SOLVER.analyse(pattern)
    assert 1 < unrolled_levels(plan.levels) < len(plan.levels)
    assert lane_plan(plan.levels, plan.n).above
    assert lane_plan(plan.levels, plan.n).below
    batch = values * strengths(MIN_BATCH)
    expected = corner(plan, values) / strengths(MIN_BATCH)[..., None]
    assert relative(corners(plan, batch), expected) < 1e-11


def test_small_batches_and_wide_fronts_keep_the_plain_program(sweeps):
    plan, values = sheet()
    few = values[: MIN_BATCH - 1]
    assert relative(corners(plan, few), one_by_one(plan, few)) < 1e-10
    pairs, places = np.tril_indices(160), np.random.default_rng(2).normal(size=(160, 2))
    dense = NestedDissection(leaf_size=100).analyse(SparsityPattern(160, *pairs, places, np.array([3, 8])))
    assert unrolled_levels(dense.levels) == len(dense.levels) > 1
    entries = jnp.where(pairs[0] == pairs[1], 160.0, 1.0) * strengths(MIN_BATCH)
    assert relative(corners(dense, entries), one_by_one(dense, entries)) < 1e-10
    trace(plan, few)
    trace(dense, entries)
    assert not sweeps


@pytest.mark.parametrize("bad", ["indefinite", "singular", "not a number"])
def test_a_bad_matrix_leaves_its_neighbours_alone(bad):
    plan, values = sheet()
    lane = 5
    broken = {
        "indefinite": -values[lane],
        "singular": 0 * values[lane],
        "not a number": values[lane].at[40].set(jnp.nan),
    }
    good, spoiled = corners(plan, values), np.asarray(corners(plan, values.at[lane].set(broken[bad])))
    assert not np.isfinite(spoiled[lane]).any()
    others = np.arange(COUNT) != lane
    np.testing.assert_array_equal(spoiled[others], np.asarray(good)[others])


@pytest.mark.parametrize("place", ["leaf", "inside", "root"])
def test_a_pivot_that_is_negative_anywhere_spoils_its_lane(place):
    plan, values = sheet()
    level = {"leaf": -1, "inside": 2, "root": 0}[place]
    diagonal = np.diagonal(np.asarray(plan.levels[level].among), axis1=1, axis2=2)
    pivot = diagonal[diagonal < len(plan.rows)][-1]
    spoiled = np.asarray(corners(plan, values.at[3, pivot].set(-1.0)))
    assert not np.isfinite(spoiled[3]).any()
    assert np.isfinite(np.delete(spoiled, 3, 0)).all()


@pytest.mark.parametrize("shape", [pytest.param((2, 18), marks=pytest.mark.slow), (12, 3)])
def test_batches_of_batches(shape, sweeps):
    """All matrices form one batch, also where a batch within is small."""
    plan, values = sheet()
    nested = values[:36].reshape(*shape, -1)
    trace(plan, nested)
    assert sweeps
    found = quick(jax.vmap(jax.vmap(SOLVER.corner, (None, 0)), (None, 0)))(plan, nested)
    assert relative(found.reshape(36, *found.shape[2:]), one_by_one(plan, values[:36])) < 1e-9


@pytest.mark.slow
def test_batches_of_plans():
    plan, values = sheet()
    plans = jax.tree.map(lambda a: jnp.stack([a, a]), plan)
    few = values[:MIN_BATCH]
    found = quick(jax.vmap(jax.vmap(SOLVER.corner, (None, 0)), (0, None)))(plans, few)
    for half in found:
        assert relative(half, one_by_one(plan, few)) < 1e-10


def model_of(kind, dtype="float64"):
    """Electrodes of each kind on lines of a mesh of 16 cells a side."""
    corners = [(0.125, 0.05), (0.15, 0.05), (0.15, 0.075), (0.125, 0.075)]
    area, rim = je.PolygonPatch(je.Polygon(corners), 1e-3), je.BoundaryPatch(0.05, 0.1, 0.02)
    ideal = je.PolygonPatch(je.Polygon([(x - 0.075, y + 0.1) for x, y in corners]), 0.0)
    skin = skin_of(
        SQUARE, [rim, area, ideal, je.PointElectrode((0.15, 0.15))], [[0, 1, 2, 3], [0, 1, 0, 1], [2, 3, 0, 1]]
    )
    effects = (je.effects.ContinuousCoating(),) if kind == "coat" else ()
    fidelity = je.Fidelity(solver=SOLVER, dtype=dtype, order=2 if kind == "quadratic" else 1)
    return je.discretise(je.Scene(skin, effects), fidelity, mesh=je.meshing.structured(SQUARE, 16, 16))


def uneven(model, count=MIN_BATCH + 2):
    wave = jnp.sin(jnp.arange(model.background.size, dtype=model.dtype))
    return model.background * (1 + jnp.linspace(0, 0.5, count, dtype=model.dtype)[:, None] * wave)


@pytest.mark.parametrize("kind", ["linear", pytest.param("quadratic", marks=pytest.mark.slow)])
def test_conductivities_with_complete_electrodes(kind):
    model = model_of(kind)
    sigma = uneven(model).at[1].set(jnp.nan).at[2, 7].set(-1.0)
    found = np.asarray(jax.vmap(lambda s: je.forward(model, s))(sigma))
    expected = np.stack([je.forward(model, s) for s in sigma])
    assert not np.isfinite(found[1:3]).any()
    np.testing.assert_allclose(np.delete(found, (1, 2), 0), np.delete(expected, (1, 2), 0), rtol=1e-10)


@pytest.mark.slow
def test_a_metal_coat():
    model = model_of("coat")
    x, y = model.centroids.T
    near = 30 * jnp.exp(-((x - 0.1) ** 2 + (y - 0.1) ** 2) / 0.02**2)
    coupling = jnp.linspace(0, 1, MIN_BATCH)[:, None] * jnp.where(near > 0.5, near, 0)

    def voltages(coupling):
        return je.forward(model, je.model.CoatedSheet(model.background, jnp.asarray(20.0), coupling))

    found = jax.vmap(voltages)(coupling)
    assert relative(found, np.stack([voltages(c) for c in coupling])) < 1e-9


@pytest.mark.slow
def test_derivatives_of_batches():
    model = model_of("linear")
    sigma, direction = uneven(model), jnp.cos(jnp.arange(model.background.size)) * model.background

    def loss(s):
        return jnp.sum(je.forward(model, s) ** 2)

    def pushed(s):
        return jax.jvp(partial(je.forward, model), (s,), (direction,))[1]

    def curved(s):
        return jax.jvp(jax.grad(loss), (s,), (direction,))[1]

    for verb in (jax.grad(loss), pushed, curved, lambda s: je.jacobian(model, s, je.Pixels(4).on(model))):
        each = jax.jit(verb)
        assert relative(quick(jax.vmap(verb))(sigma), np.stack([each(s) for s in sigma])) < 1e-9
    mean = jax.jit(jax.grad(lambda many: jnp.mean(jax.vmap(loss)(many))))(sigma)
    assert relative(mean * len(sigma), np.stack([jax.jit(jax.grad(loss))(s) for s in sigma])) < 1e-9


@pytest.mark.slow
def test_single_precision_of_a_model():
    double, single = model_of("linear"), model_of("linear", "float32")
    together = jax.vmap(lambda s: je.forward(single, s))(uneven(single, 33))
    assert together.dtype == np.float32
    expected = np.stack([je.forward(double, s) for s in uneven(double, 33)])
    assert relative(np.asarray(together), expected) < 1e-4


def test_other_devices_eliminate_portions_of_bounded_memory(monkeypatch, sweeps):
    """The program that they get, on this one: no subtrees apart, and portions of equal width."""
    plan, values = sheet()
    expected = one_by_one(plan, values)
    monkeypatch.setattr(batches, "by_platform", lambda *args, cpu, default: default(*args))
    monkeypatch.setattr(batches, "PORTION_BYTES", values.nbytes // 2)
    found = jax.jit(jax.vmap(partial(SOLVER.corner, plan)))(values)
    assert sweeps == [-(-COUNT // 2)]
    assert relative(found, expected) < 1e-9
