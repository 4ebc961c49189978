"""The stiffness of each coefficient of an image, against sums over the elements."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

import jaxeit as je
from jaxeit.linalg.small_matrices import product_by_loops, stacked_product
from jaxeit.model.matrix.stiffness import _balanced

from ..helpers import square_model

POINTS = [(0.05, 0.05), (0.15, 0.10), (0.10, 0.15), (0.05, 0.10)]
PATTERN = [[0, 1, 2, 3], [0, 2, 1, 3]]
PAIRS = np.triu_indices(3)
# In place of the little optimisation of `conftest`.
AS_USERS = {"xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False, **je.compiler_options()}


def _fields(model, offset=0.0):
    return offset + np.asarray(jax.random.normal(jax.random.key(4), (model.system.unknowns, 3)), float)


def _products(image, potential):
    """Under jit and in batches, as `jacobian` has it."""
    owner = None if image.single else image.coefficient
    pairs = tuple(map(jnp.asarray, PAIRS))
    return eqx.filter_jit(lambda i, p: i.stiffness.products(p, pairs, owner, i.size))(image, jnp.asarray(potential))


def _by_hand(model, image, potential):
    """sum_e w_e integral of grad u . grad v, element by element."""
    u, slopes = potential[np.asarray(model.system.dofs)], np.asarray(model.system.slopes)
    energies = np.einsum("ekr,eka,elr,elb->eab", slopes, u, slopes, u, optimize=True)[:, *PAIRS]
    out = np.zeros((image.size, len(PAIRS[0])))
    entries = np.asarray(image.weight)[..., None] * energies[np.asarray(image.element)]
    np.add.at(out, np.asarray(image.coefficient), entries.sum(1))
    return out


@pytest.fixture(scope="module", params=[1, 2])
def small(request):
    return square_model(POINTS, PATTERN, 12, order=request.param)


@pytest.mark.parametrize(
    "basis", [je.Pixels(4), je.Pixels(5), je.Elements(), je.Bumps(5, width=0.02)], ids=lambda basis: repr(basis)
)
def test_products_are_sums_over_the_elements(small, basis, monkeypatch):
    image, potential = basis.on(small), _fields(small)
    lines, rows, _ = image.stiffness.entry.shape
    assert lines > 5
    assert lines % 5  # batches of five lines, the last one not full
    monkeypatch.setattr("jaxeit.model.matrix.stiffness.BATCH_ROWS", 5 * rows)
    wanted = _by_hand(small, image, potential)
    np.testing.assert_allclose(_products(image, potential), wanted, atol=1e-13 * np.abs(wanted).max())


def test_electrodes_that_tie_their_nodes_together(model, pixels):
    """The testbed's bolts are one unknown each, which several corners of an element may be."""
    potential = _fields(model)
    wanted = _by_hand(model, pixels, potential)
    np.testing.assert_allclose(_products(pixels, potential), wanted, atol=1e-13 * np.abs(wanted).max())


def test_a_potential_common_to_all_changes_nothing(small):
    """Only differences enter: an offset costs the digits that it takes of the potentials, not their squares."""
    image = je.Pixels(4).on(small)
    plain, lifted = (np.asarray(_products(image, _fields(small, offset))) for offset in (0.0, 1e6))
    np.testing.assert_allclose(lifted, plain, atol=1e-8 * np.abs(plain).max())


def test_both_ways_to_multiply_agree(small, monkeypatch):
    image, potential = je.Elements().on(small), _fields(small)
    found = []
    for few in (0, 100):
        monkeypatch.setattr("jaxeit.model.matrix.stiffness.MAX_LOOPED_ENTRIES", few)
        monkeypatch.setattr("jaxeit.linalg.small_matrices.MIN_LOOPED_MULTIPLICATIONS", 0)
        found.append(np.asarray(_products(image, potential)))
    np.testing.assert_allclose(*found, atol=1e-14 * np.abs(found[0]).max())


@pytest.mark.parametrize(("terms", "columns"), [(1, 3), (7, 3), (16, 4), (17, 4), (50, 2)])
def test_stacked_products(terms, columns):
    keys = jax.random.split(jax.random.key(terms))
    left, right = (jax.random.normal(key, (5, terms, n)) for key, n in zip(keys, (6, columns), strict=True))
    wanted = np.asarray(left).transpose(0, 2, 1) @ np.asarray(right)
    for found in (stacked_product(left, right), jax.jit(product_by_loops)(left, right)):
        np.testing.assert_allclose(found, wanted, atol=1e-13)
    np.testing.assert_allclose(jax.vmap(product_by_loops)(left[None], right[None])[0], wanted, atol=1e-13)


def test_half_of_the_stiffness_has_few_entries_a_row(model):
    """Nodes have up to seven neighbours here, and themselves; shared out, no row of H holds more than four."""
    assert je.Pixels(10).on(model).stiffness.entry.shape[2] <= 4


def test_pairs_are_shared_out_evenly():
    rng = np.random.default_rng(0)
    count = 40
    first, second = np.divmod(rng.choice(count**2, 300, replace=False), count)
    found = _balanced(first, second, count)
    assert {frozenset(pair) for pair in zip(*found, strict=True)} == {
        frozenset(pair) for pair in zip(first, second, strict=True)
    }
    entries = np.bincount(found[0], minlength=count)
    assert (entries[found[0]] - entries[found[1]] <= 1).all()


def test_a_right_angle_leaves_no_entry():
    """On squares cut in two a node has no stiffness towards the one across: three entries a row, not four."""
    model = square_model(POINTS, PATTERN, 12)
    entry = np.asarray(je.Pixels(3).on(model).stiffness.entry)
    assert entry.shape[2] == 3
    assert np.abs(entry[entry != 0]).min() > 0.1


def test_a_basis_of_another_model_is_refused():
    coarse, quadratic = (square_model(POINTS, PATTERN, 8, order=order) for order in (1, 2))
    image = je.Pixels(4).on(coarse)
    with pytest.raises(ValueError, match=r"128 elements and 81 unknowns, this one has 128 and 289; make basis.on"):
        je.jacobian(quadratic, None, image)
    with pytest.raises(ValueError, match="this one has 512"):
        je.jacobian(square_model(POINTS, PATTERN, 16), None, image)


def test_what_users_compile_agrees_with_a_direct_solver():
    """With the loops of `stacked_product`: on a mesh that no other test has, so that its programs are traced here."""
    model = square_model(POINTS, PATTERN, 52, solver=je.linalg.NestedDissection())
    image = je.Pixels(13).on(model)
    program = jax.jit(lambda m, i: (je.forward(m), je.jacobian(m, None, i)), compiler_options=AS_USERS)
    assert "reduce_fusion" in program.lower(model, image).compile().as_text()
    voltages, slopes = program(model, image)

    stiffness = np.asarray(model.system.slopes) @ np.asarray(model.system.slopes).transpose(0, 2, 1)
    dofs = np.asarray(model.system.dofs)
    places = np.repeat(dofs, 3, 1).ravel(), np.tile(dofs, (1, 3)).ravel()
    matrix = sparse.csc_array((float(model.background[0]) * stiffness.ravel(), places))
    nodes = np.asarray(model.system.electrode_dof)
    unit = np.zeros((matrix.shape[0], len(nodes)))
    unit[nodes, np.arange(len(nodes))] = 1
    x = spsolve(matrix[1:, 1:], unit[1:])  # the first node is grounded
    x = np.concatenate([np.zeros((1, len(nodes))), np.asarray(x)])
    source, sink, plus, minus = np.asarray(model.pattern).T
    drive, sense = x[:, source] - x[:, sink], x[:, plus] - x[:, minus]
    current = float(model.current)
    np.testing.assert_allclose(voltages, current * (matrix @ drive * sense).sum(0), rtol=1e-9)
    by_element = -current * np.einsum("eim,eij,ejm->me", drive[dofs], stiffness, sense[dofs])
    wanted = np.stack([np.asarray(image.restrict(jnp.asarray(row))) for row in by_element])
    np.testing.assert_allclose(slopes, wanted, atol=1e-10 * np.abs(wanted).max())


def test_without_fusion_the_library_multiplies(monkeypatch):
    """Else each product of a loop would be stored."""
    monkeypatch.setattr("jaxeit.linalg.small_matrices.MIN_LOOPED_MULTIPLICATIONS", 0)
    left = jnp.ones((3, 5, 4))
    before = jax.config.read("jax_disable_most_optimizations")
    texts = []
    for off in (True, False):
        jax.config.update("jax_disable_most_optimizations", off)
        texts.append(str(jax.make_jaxpr(lambda a: stacked_product(a, a))(left)))
    jax.config.update("jax_disable_most_optimizations", before)
    assert "sum_by_loop" not in texts[0]
    assert "sum_by_loop" in texts[1]
