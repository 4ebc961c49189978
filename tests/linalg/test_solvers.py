"""Linear solvers against SuperLU and dense algebra, on the shapes that break orderings."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from jaxeit._compile import compiler_options
from jaxeit.linalg import (
    ConjugateGradient,
    Dense,
    NestedDissection,
    PatternError,
    Single,
    SparsityPattern,
    default_solver,
    inverse_columns,
    matvec,
    solve_spd,
)

SOLVERS = [
    Dense(),
    NestedDissection(leaf_size=6),
    ConjugateGradient(),
    ConjugateGradient(Single(NestedDissection(leaf_size=6))),
]


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


def laplacian(edges, weights, n, grounds=((0, 1.0),)):
    """Graph Laplacian with some unknowns tied to ground: positive definite by construction."""
    i, j = np.asarray(edges).reshape(-1, 2).T
    at, g = np.array([node for node, _ in grounds]), np.array([g for _, g in grounds])
    rows = np.concatenate([i, j, i, j, at])
    cols = np.concatenate([i, j, j, i, at])
    values = np.concatenate([weights, weights, -weights, -weights, g])
    return sp.csc_array((values, (rows, cols)), shape=(n, n))


def mesh_edges(nx, ny):
    index = np.arange(nx * ny).reshape(ny, nx)
    pairs = (index[:, :-1], index[:, 1:]), (index[:-1], index[1:]), (index[:-1, :-1], index[1:, 1:])
    return np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in pairs])


def square_sheet(side, contrast, conductances, seed=0):
    """P1 stiffness of a structured square (edge weights; a diagonal edge carries the jump between
    its triangles), electrodes coupled to twenty nodes each, and coordinates."""
    rng = np.random.default_rng(seed)
    edges = mesh_edges(side, side)
    weights = 10.0 ** rng.uniform(-contrast, contrast, len(edges))
    xy = np.stack(np.divmod(np.arange(side**2), side)[::-1], 1).astype(float)
    for number, g in enumerate(conductances):
        near = np.argsort(((xy - rng.uniform(0, side, 2)) ** 2).sum(1))[:20]
        edges = np.concatenate([edges, np.stack([near, np.full_like(near, side**2 + number)], 1)])
        weights = np.concatenate([weights, np.full(near.size, g / near.size)])
    n = side**2 + len(conductances)
    coords = np.concatenate([xy, np.full((len(conductances), 2), np.nan)])
    return laplacian(edges, weights, n), coords


def as_pattern(matrix, coords=None, root=()):
    lower = sp.tril(matrix).tocoo()
    pattern = SparsityPattern(matrix.shape[0], lower.row, lower.col, coords, np.asarray(root, int))
    return pattern, jnp.asarray(lower.data)


def solution(solver, pattern, values, rhs):
    return np.asarray(SOLVE(solver, solver.analyse(pattern), values, jnp.asarray(rhs)))


# These programs run once each: what the compiler would gain it never earns back.
quick = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0, **compiler_options()})
SOLVE = quick(solve_spd)


def relative(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


def star(n=40):
    return laplacian([(0, k) for k in range(1, n)], np.linspace(1, 2, n - 1), n), None


def strip():
    index = np.arange(3 * 41)
    return laplacian(mesh_edges(41, 3), np.ones(282), index.size), np.stack([index % 41, index // 41], 1).astype(float)


def islands():
    a, b = mesh_edges(5, 5), mesh_edges(4, 3) + 25
    edges = np.concatenate([a, b])
    return laplacian(edges, np.ones(len(edges)), 38, ((0, 1.0), (30, 2.0), (37, 3.0))), None


def same_place():
    matrix, coords = strip()
    return matrix, np.zeros_like(coords)


def solid():
    index = np.arange(4 * 5 * 6).reshape(4, 5, 6)
    pairs = (
        (index[:-1], index[1:]),
        (index[:, :-1], index[:, 1:]),
        (index[..., :-1], index[..., 1:]),
    )
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in pairs])
    coords = np.stack(np.unravel_index(index.ravel(), index.shape), 1).astype(float)
    return laplacian(edges, np.ones(len(edges)), index.size), coords


def full():
    edges = np.stack(np.triu_indices(13, 1), 1)
    return laplacian(edges, np.ones(len(edges)), 13), np.random.default_rng(1).normal(size=(13, 2))


SHAPES = {
    "one": lambda: (laplacian([], np.zeros(0), 1, ((0, 2.0),)), None),
    "diagonal": lambda: (sp.csc_array(np.diag(np.arange(1.0, 18))), None),
    "below a leaf": lambda: (
        laplacian([(0, 1), (1, 2)], np.ones(2), 3),
        np.arange(6.0).reshape(3, 2),
    ),
    "star": star,
    "strip": strip,
    "islands": islands,
    "coincident": same_place,
    "solid": solid,
    "full": full,
    "sheet": lambda: square_sheet(13, 1, np.ones(3)),
    "sheet without places": lambda: (square_sheet(13, 1, np.ones(3))[0], None),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_solution_is_that_of_superlu(shape):
    matrix, coords = SHAPES[shape]()
    pattern, values = as_pattern(matrix, coords)
    solver = NestedDissection(leaf_size=max(1, pattern.n // 4))
    rhs = np.random.default_rng(2).normal(size=(pattern.n, 3))
    found = solution(solver, pattern, values, rhs)
    assert relative(found, splu(matrix).solve(rhs)) < 1e-11


def test_dense_solution_is_that_of_superlu():
    matrix, _ = SHAPES["sheet"]()
    rhs = np.random.default_rng(2).normal(size=(matrix.shape[0], 3))
    found = solution(Dense(), *as_pattern(matrix), rhs)
    assert relative(found, splu(matrix).solve(rhs)) < 1e-11


@pytest.mark.parametrize("shape", ["star", "sheet"])
def test_neither_numbering_nor_entry_order_matters(shape):
    matrix, coords = SHAPES[shape]()
    rng = np.random.default_rng(3)
    p = rng.permutation(matrix.shape[0])
    rhs = rng.normal(size=(p.size, 2))
    solver = NestedDissection(leaf_size=30)
    moved = as_pattern(matrix[p][:, p], None if coords is None else coords[p])
    found = solution(solver, *moved, rhs[p])
    assert relative(found, solution(solver, *as_pattern(matrix, coords), rhs)[p]) < 1e-12


def test_root_unknowns_are_eliminated_last():
    matrix, coords = square_sheet(13, 1, np.ones(3))
    root = [4, 20, 100]
    plan = NestedDissection(leaf_size=4).analyse(as_pattern(matrix, coords, root)[0])
    top = np.asarray(plan.gather[: plan.levels[0].pivots])
    assert {*root, 169, 170, 171} <= {*top.tolist()}


def test_separators_of_a_square_are_its_narrowest_lines():
    matrix, coords = square_sheet(16, 0, np.ones(0))
    plan = NestedDissection(leaf_size=16).analyse(as_pattern(matrix, coords)[0])
    assert [shape[2] for shape in plan.panel_shapes][:3] == [16, 8, 8]


def test_contacts_over_24_decades_lose_nothing_against_dense():
    """Where conductances bury each other no elimination keeps every digit (compare residuals, row
    by row, with the dense ones on the same matrix)."""
    rng = np.random.default_rng(6)
    matrix, coords = square_sheet(14, 4, 10.0 ** rng.uniform(-12, 12, 25))
    pattern, values = as_pattern(matrix, coords)
    rhs = rng.normal(size=(pattern.n, 4))

    def residual(solver):
        x = solution(solver, pattern, values, rhs)
        return np.abs(matrix @ x - rhs).max() / (abs(matrix) @ np.abs(x) + np.abs(rhs)).max()

    assert residual(NestedDissection()) < 10 * residual(Dense()) + 1e-15
    assert residual(NestedDissection()) < 1e-14


def test_weak_contacts_keep_the_solution():
    matrix, coords = square_sheet(14, 2, 10.0 ** np.linspace(-12, 0, 25))
    pattern, values = as_pattern(matrix, coords)
    rhs = np.eye(pattern.n)[:, -25:]
    found = solution(NestedDissection(), pattern, values, rhs)
    columns = np.abs(found - splu(matrix).solve(rhs)).max(0) / np.abs(found).max(0)
    assert columns.max() < 1e-9


@pytest.mark.parametrize("solver", [Dense(), NestedDissection()], ids=str)
def test_single_precision_stays_within_1e_4(solver):
    """A leaky sheet: of one grounded at a point alone, rounding the entries moves the ground."""
    sheet, coords = square_sheet(20, 0, np.ones(9))
    matrix = (sheet + 0.01 * sp.eye_array(409)).tocsc()
    pattern, values = as_pattern(matrix, coords)
    rhs = np.eye(pattern.n)[:, -9:]
    found = solution(solver, pattern, values.astype(jnp.float32), rhs.astype(np.float32))
    assert found.dtype == np.float32
    assert relative(found, splu(matrix).solve(rhs)) < 1e-4


@pytest.fixture(scope="module")
def small():
    with jax.enable_x64(True):
        matrix, coords = square_sheet(4, 0.5, np.ones(1))
        pattern, values = as_pattern(matrix, coords)
        rhs = jnp.asarray(np.random.default_rng(4).normal(size=(pattern.n, 2)))
        return pattern, values, rhs


def dense_solve(pattern, values, rhs):
    lower = jnp.zeros((pattern.n, pattern.n)).at[pattern.rows, pattern.cols].set(values)
    return jnp.linalg.solve(lower + jnp.tril(lower, -1).T, rhs)


TRANSFORMS = {
    "jacfwd": lambda f: jax.jacfwd(f, (0, 1)),
    "jacrev": lambda f: jax.jacrev(f, (0, 1)),
    "hessian": lambda f: jax.hessian(lambda v, b: jnp.sum(f(v, b) ** 2), (0, 1)),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(lambda v, b: jnp.sum(f(v, b) ** 3))),
    "reverse over forward": lambda f: jax.grad(lambda v, b: jnp.sum(jax.jvp(f, (v, b), (v**2, b**2))[1] ** 2)),
}


@pytest.mark.slow
@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_derivatives_are_those_of_dense_autodiff(solver, transform, small):
    pattern, values, rhs = small
    plan = solver.analyse(pattern)
    wrap = TRANSFORMS[transform]
    found = quick(wrap(lambda v, b: solve_spd(solver, plan, v, b)))(values, rhs)
    expected = quick(wrap(lambda v, b: dense_solve(pattern, v, b)))(values, rhs)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert relative(ours, theirs) < 1e-10


def test_derivatives_reuse_the_factorisation(small):
    pattern, values, rhs = small
    solver = NestedDissection(leaf_size=100)
    plan = solver.analyse(pattern)
    jacobian = jax.jit(jax.jacrev(lambda v: solve_spd(solver, plan, v, rhs)))
    assert jacobian.lower(values).as_text().count("potrf") == 1


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_vmap_is_the_loop(solver, small):
    pattern, values, rhs = small
    plan = solver.analyse(pattern)
    batch = values * jnp.asarray([[1.0], [3.0], [0.5]])
    gradient = jax.grad(lambda v, b: jnp.sum(solve_spd(solver, plan, v, b) ** 2))
    found = quick(jax.vmap(gradient, (0, None)))(batch, rhs)
    one = quick(gradient)
    expected = jnp.stack([one(v, rhs) for v in batch])
    assert relative(found, expected) < 1e-12


def test_factor_survives_vmap_and_serves_many_loads(small):
    pattern, values, rhs = small
    solver = NestedDissection(leaf_size=4)
    plan = solver.analyse(pattern)
    factors = quick(jax.vmap(solver.factor, (None, 0)))(plan, jnp.stack([values, 2 * values]))
    found = quick(jax.vmap(solver.solve, (0, None)))(factors, rhs)
    single = SOLVE(solver, plan, values, rhs)
    assert relative(found, jnp.stack([single, single / 2])) < 1e-13


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_new_values_retrace_nothing(solver, small):
    pattern, values, rhs = small
    traces = []

    @quick
    def run(plan, v, b):
        traces.append(1)
        return solve_spd(solver, plan, v, b)

    for scale in (1.0, 2.0):
        run(solver.analyse(pattern), scale * values, rhs)
    assert len(traces) == 1


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_root_of_the_inverse(solver):
    matrix, coords = square_sheet(9, 1, np.ones(2))
    root = [81, 82, 4, 40]
    pattern, values = as_pattern(matrix, coords, root)
    expected = np.linalg.inv(matrix.toarray())[:, root]
    plan = solver.analyse(pattern)
    corner = quick(solver.corner)(plan, values)
    columns = quick(partial(inverse_columns, solver))(plan, values)
    assert relative(corner, expected[root]) < 1e-10
    assert relative(columns, expected) < 1e-10


@pytest.mark.parametrize("solver", SOLVERS, ids=str)
def test_root_without_unknowns(solver):
    matrix, coords = square_sheet(5, 1, np.ones(0))
    pattern, values = as_pattern(matrix, coords)
    assert quick(solver.corner)(solver.analyse(pattern), values).shape == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS[:2], ids=str)
@pytest.mark.parametrize("transform", ["jacfwd", "reverse over reverse", "reverse over forward"])
def test_derivatives_of_the_columns(solver, transform, small):
    """Forward mode is exact in values; higher ones go through the factor kept for them."""
    pattern, values, rhs = small
    root = np.array([3, 16])
    pattern = SparsityPattern(pattern.n, pattern.rows, pattern.cols, pattern.coords, root)
    plan = solver.analyse(pattern)
    unit = jnp.zeros((pattern.n, 2)).at[root, jnp.arange(2)].set(1)
    wrap = TRANSFORMS[transform]
    found = quick(wrap(lambda v, b: inverse_columns(solver, plan, v) * b))(values, rhs)
    expected = quick(wrap(lambda v, b: dense_solve(pattern, v, unit) * b))(values, rhs)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert relative(ours, theirs) < 1e-9


@pytest.mark.slow
def test_wide_fronts_are_eliminated_in_halves():
    """A solid has wide separators: the recursion meets odd widths at several depths."""
    rng = np.random.default_rng(8)
    n = 150
    matrix = laplacian(np.stack(np.triu_indices(n, 1), 1), rng.uniform(0.5, 2, n * (n - 1) // 2), n)
    pattern, values = as_pattern(matrix, rng.normal(size=(n, 2)), [7, 140])
    rhs = rng.normal(size=(n, 3))
    assert relative(solution(NestedDissection(), pattern, values, rhs), splu(matrix).solve(rhs)) < 1e-11
    corner = NestedDissection().corner(NestedDissection().analyse(pattern), values)
    assert relative(corner, np.linalg.inv(matrix.toarray())[np.ix_([7, 140], [7, 140])]) < 1e-11


SEVERAL_AT_ONCE = """
import jax, numpy as np
from tests.linalg.test_solvers import as_pattern, square_sheet
from jaxeit.linalg import NestedDissection
matrix, coords = square_sheet(60, 1, np.ones(2))
pattern, values = as_pattern(matrix, coords, [3600, 3601])
solver = NestedDissection()
plan = solver.analyse(pattern)
several = jax.jit(lambda plan, v: [solver.corner(plan, k * v) for k in (1.0, 2.0, 3.0, 4.0)])
for _ in range(20):
    found = jax.block_until_ready(several(plan, values))
print(float(found[0][0, 0] / found[3][0, 0]))
"""


@pytest.mark.slow
def test_several_solves_in_one_program_do_not_wait_for_each_other_for_ever():
    """What LAPACK calls of jaxlib 0.10 do once each of its threads has to wait for another (`jaxeit.linalg.lapack`)."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "JAX_ENABLE_X64": "1"}
    environment.pop("OPENBLAS_NUM_THREADS", None)  # as users have it
    command = [sys.executable, "-c", SEVERAL_AT_ONCE]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(4, rel=1e-4)


def test_iteration_that_does_not_converge_is_nan():
    matrix, coords = square_sheet(9, 3, np.ones(2))
    pattern, values = as_pattern(matrix, coords)
    found = solution(ConjugateGradient(max_steps=3), pattern, values, np.ones((pattern.n, 2)))
    assert np.isnan(found).all()


def test_iteration_leaves_a_column_of_zeros_alone():
    matrix, coords = square_sheet(9, 1, np.ones(2))
    pattern, values = as_pattern(matrix, coords)
    rhs = np.stack([np.ones(pattern.n), np.zeros(pattern.n)], 1)
    found = solution(ConjugateGradient(), pattern, values, rhs)
    assert relative(found[:, 0], splu(matrix).solve(rhs[:, 0])) < 1e-8
    assert not found[:, 1].any()


def test_iteration_does_not_mind_the_units_of_unknowns():
    matrix, coords = square_sheet(9, 1, np.ones(2))
    unit = sp.diags_array(10.0 ** np.random.default_rng(3).uniform(-4, 4, matrix.shape[0]))
    pattern, values = as_pattern((unit @ matrix @ unit).tocsc(), coords)
    rhs = np.ones((pattern.n, 1))
    found = unit @ solution(ConjugateGradient(), pattern, values, unit @ rhs)
    assert relative(found, splu(matrix).solve(rhs)) < 1e-8


def test_single_precision_factors_reach_double_accuracy_in_a_few_steps():
    matrix, coords = square_sheet(20, 1, np.ones(9))
    pattern, values = as_pattern(matrix, coords)
    rhs = np.eye(pattern.n)[:, -9:]
    solver = ConjugateGradient(Single(NestedDissection()), max_steps=8)
    assert relative(solution(solver, pattern, values, rhs), splu(matrix).solve(rhs)) < 1e-10


def test_matvec_is_the_symmetric_product():
    matrix, coords = square_sheet(7, 1, np.ones(2))
    pattern, values = as_pattern(matrix, coords)
    x = np.random.default_rng(5).normal(size=(pattern.n, 3))
    found = matvec(Dense().analyse(pattern), values, jnp.asarray(x))
    assert relative(found, matrix @ x) < 1e-14


def test_indefinite_matrix_is_nan_not_a_number():
    pattern, values = as_pattern(*strip())
    found = solution(NestedDissection(leaf_size=4), pattern, -values, np.ones((pattern.n, 1)))
    assert np.isnan(found).all()


def test_analysis_of_a_large_sheet_holds_what_theory_says():
    """Entries of the factor of a square grow as (31/4) n log2 n (George 1973); padding and the
    squared-off pivots may cost no more than four times that."""
    matrix, coords = square_sheet(100, 0, np.ones(9))
    plan = NestedDissection().analyse(as_pattern(matrix, coords)[0])
    stored = sum(int(np.prod(shape)) for shape in plan.panel_shapes)
    assert stored < 4 * 31 / 4 * plan.n * np.log2(plan.n)


@pytest.mark.parametrize(
    ("rows", "cols", "extra", "message"),
    [
        ([0, 1, 0], [0, 1, 1], {}, "mirror"),
        ([0, 1, 2], [0, 1, 2], {}, "mirror"),
        ([0, 1, 1], [0, 1, 1], {}, "twice"),
        ([0, 1], [0, 0], {}, "diagonal"),
        ([[0, 1]], [[0, 1]], {}, "vectors"),
        ([0, 1], [0, 1], {"coords": np.zeros((3, 2))}, "one row for each"),
        ([0, 1], [0, 1], {"root": np.array([2])}, "0..1"),
        ([0, 1], [0, 1], {"root": np.array([1, 1])}, "distinct"),
    ],
)
def test_bad_patterns_are_refused(rows, cols, extra, message):
    with pytest.raises(PatternError, match=message):
        SparsityPattern(2, np.array(rows), np.array(cols), **extra)


def test_default_solver_goes_by_size():
    assert isinstance(default_solver(50), Dense)
    assert isinstance(default_solver(5000), NestedDissection)
