"""Factors and solves that stay safe under vmap: values and derivatives against JAX's own, done one by one."""

import importlib.util
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsp
import numpy as np
import pytest

from jaxeit.linalg import lapack

from ..helpers import large_stacks, spread_stacks

rng = np.random.default_rng(0)
of_lapack = pytest.mark.skipif(jax.devices()[0].platform != "cpu", reason="only CPUs have LAPACK")


def _positive(*shape):
    a = rng.normal(size=shape)
    return jnp.asarray(a @ np.swapaxes(a, -1, -2) + shape[-1] * np.eye(shape[-1]))


SIDES = jnp.asarray(rng.normal(size=(4, 3)))


def _solution(trans, lower, b):
    return lambda of, a: of.solve_triangular(a + b[0], b, trans=trans, lower=lower)


FUNCTIONS = {
    "cholesky": lambda of, a: of.cholesky(a),
    "cholesky, lower": lambda of, a: of.cholesky(a, lower=True),
    "cho_solve": lambda of, a: of.cho_solve(of.cho_factor(a), SIDES),
    "cho_solve, lower, one": lambda of, a: of.cho_solve(of.cho_factor(a, lower=True), jnp.sin(a[1])),
    **{
        f"solve_triangular {trans} {lower}": _solution(trans, lower, SIDES[:, :1] * jnp.ones(4))
        for trans in (0, 1)
        for lower in (False, True)
    },
    "solve_triangular of one": lambda of, a: of.solve_triangular(a, jnp.sin(a[0])),
    "solve": lambda of, a: (jnp.linalg if of is jsp else of).solve(a + jnp.triu(a), SIDES),
    "eigh": lambda of, a: (jnp.linalg if of is jsp else of).eigh(a),
    "svd": lambda of, a: (jnp.linalg if of is jsp else of).svd(a + jnp.triu(a) * SIDES[:, 0]),
    "qr": lambda of, a: (jnp.linalg if of is jsp else of).qr(jnp.concatenate([a + jnp.triu(a), jnp.sin(a[:2])])),
}


def _symmetric(name, of):
    """A function of a symmetric matrix, and of nothing but it: signs of vectors do not count."""

    def function(a):
        out = FUNCTIONS[name](of, (a + a.T) / 2)
        if name == "eigh":
            left, vectors = out
            return jnp.concatenate([left[None], (vectors * jnp.cos(left)) @ vectors.T])
        if name == "svd":
            u, s, vt = out
            return jnp.concatenate([s[None], (u * jnp.cos(s)) @ vt, (u * jnp.sin(s)) @ u.T])
        if name == "qr":
            return jnp.concatenate(out)
        return out

    return function


_ALIKE = ("solve_triangular 0 True", "solve_triangular 1 False", "cholesky, lower")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in _ALIKE else name for name in FUNCTIONS]
)
def test_values_and_derivatives_are_those_of_jax(name):
    """Alone, and stacked by two vmaps."""
    ours, theirs = (_derivatives(_symmetric(name, of)) for of in (lapack, jsp))
    stack = jnp.stack([_positive(4, 4) for _ in range(6)])
    alone = [jax.jit(theirs)(a) for a in stack]
    expected = [np.stack(each) for each in zip(*alone, strict=True)]
    one, many = jax.jit(ours)(stack[0]), jax.jit(jax.vmap(jax.vmap(ours)))(stack.reshape(2, 3, 4, 4))
    for found, first, wanted in zip(many, one, expected, strict=True):
        close = {"rtol": 1e-9, "atol": 1e-11 * np.abs(wanted).max()}
        np.testing.assert_allclose(first, wanted[0], **close)
        np.testing.assert_allclose(np.reshape(found, wanted.shape), wanted, **close)


def _derivatives(function):
    """Value, both first derivatives, both second ones along a direction, and that of a stack as a whole."""
    along = jnp.cos(jnp.arange(16.0)).reshape(4, 4)

    def total(a):
        return jnp.sum(jnp.sin(function(a)))

    def in_a_stack(a):
        return jnp.sum(jnp.sin(jax.vmap(function)(jnp.stack([a, a + along]))))

    def all_of(a):
        slope = jax.grad(total)
        return (
            function(a),
            jax.jvp(function, (a,), (along,))[1],
            slope(a),
            jax.jvp(slope, (a,), (along,))[1],
            jax.grad(lambda a: jnp.sum(slope(a) * along))(a),
            jax.grad(in_a_stack)(a),
        )

    return all_of


BIG = {
    "cho_solve": lambda a: lapack.cho_solve(lapack.cho_factor(a), a[:, :2]),
    "solve": lambda a: lapack.solve(a + jnp.triu(a), a[:, :2]),
    "eigh": lapack.eigh,
    "svd": lapack.svd,
    "qr": lambda a: lapack.qr(jnp.concatenate([a, a[:3]])),
}


@pytest.mark.parametrize("name", BIG)
@pytest.mark.parametrize("stack", [(3, 40, 30), (1, 2, 90), (5, 200, 3)])
def test_no_stack_is_spread_however_it_is_made(name, stack):
    """However many vmaps, of whatever size; and what comes of it is right in every place."""
    a = _positive(*stack, stack[-1])
    program = jax.jit(jax.vmap(jax.vmap(BIG[name])))
    assert not spread_stacks(program.lower(a).as_text())
    found = jax.tree.map(np.asarray, program(a))
    a = np.asarray(a)
    if name == "cho_solve":
        whole, expected = a @ found, a[..., :2]
    elif name == "solve":
        whole, expected = (a + np.triu(a)) @ found, a[..., :2]
    elif name == "eigh":
        whole, expected = (found[1] * found[0][..., None, :]) @ np.swapaxes(found[1], -1, -2), a
    elif name == "qr":
        whole, expected = found[0] @ found[1], np.concatenate([a, a[..., :3, :]], -2)
    else:
        whole, expected = (found[0] * found[1][..., None, :]) @ found[2], a
    np.testing.assert_allclose(whole, expected, atol=1e-10 * np.abs(a).max())


@of_lapack
def test_a_stack_that_is_spread_would_be_seen():
    a = jax.ShapeDtypeStruct((3, 156, 156), jnp.float64)
    for function, count in ((jnp.linalg.cholesky, 1), (jnp.linalg.eigh, 1), (jnp.linalg.svd, 1), (jnp.linalg.qr, 2)):
        assert len(large_stacks(jax.jit(jax.vmap(function)).lower(a).as_text())) >= count
        assert not large_stacks(jax.jit(function).lower(jax.ShapeDtypeStruct((156, 156), jnp.float64)).as_text())
    assert not large_stacks(jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((9, 4, 4), jnp.float64)).as_text())


def test_one_matrix_for_many_right_hand_sides_is_one_call():
    a, b = _positive(20, 20), jnp.asarray(rng.normal(size=(50, 20)))
    program = jax.jit(jax.vmap(lambda b: lapack.cho_solve(lapack.cho_factor(a), b)))
    assert "while" not in program.lower(b).as_text()
    np.testing.assert_allclose(program(b), np.linalg.solve(a, b.T).T, rtol=1e-10)


def test_what_is_not_positive_is_nan_in_its_own_place():
    a = np.stack([np.eye(3), -np.eye(3), 4 * np.eye(3)])
    found = jax.vmap(lapack.cholesky)(jnp.asarray(a))
    assert np.isnan(found[1]).any()
    np.testing.assert_allclose(found[::2], [np.eye(3), 2 * np.eye(3)])


@pytest.mark.parametrize(
    ("version", "spreads"),
    [
        ("0.9.2", True),
        ("0.10.2", True),
        ("0.10.3.dev20260801", True),
        ("0.11.0", False),
        ("0.11.0rc1", False),
        ("1.0", False),
    ],
)
def test_versions_that_spread_stacks(version, spreads):
    assert lapack.spreads_stacks(version) == spreads


@pytest.fixture
def safe(monkeypatch):
    """The module as it is with a jaxlib that spreads no stack."""
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.11.0")
    spec = importlib.util.spec_from_file_location("jaxeit.linalg.lapack_of_a_safe_jaxlib", lapack.__file__)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@of_lapack
def test_a_jaxlib_that_is_safe_gets_its_stacks_whole(safe):
    a = _positive(3, 40, 30, 30)
    for function in (safe.cholesky, safe.eigh, safe.svd, safe.qr, lambda a: safe.solve(a, a)):
        assert large_stacks(jax.jit(jax.vmap(jax.vmap(function))).lower(a).as_text())
    whole = safe.portioned(lambda left, right: (left @ right,))(a[0], a[1])
    np.testing.assert_allclose(whole[-1], a[0] @ a[1])
    np.testing.assert_array_equal(whole[0], a[0])
    assert safe.portion_of(40, 300, 300) == 40


@pytest.mark.parametrize("name", ["cholesky", "cho_solve", "solve", "eigh", "svd", "qr"])
def test_derivatives_are_the_same_with_a_safe_jaxlib(safe, name):
    stack = jnp.stack([_positive(4, 4) for _ in range(3)])
    found, expected = (_derivatives(_symmetric(name, of)) for of in (safe, lapack))
    for one, other in zip(*(jax.jit(jax.vmap(f))(stack) for f in (found, expected)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11 * np.abs(other).max())


STACKS = """
import faulthandler
faulthandler.dump_traceback_later(100, exit=True)
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from jaxeit.linalg.lapack import cholesky

def each(a):
    factor = cholesky(a)
    return (2 * factor) @ factor.T

program = jax.jit(lambda *stacks: [jax.vmap(each)(stack) for stack in stacks])
stacks = [np.stack([n * np.eye(156)] * 2) for n in range(1, 9)]
for _ in range(200):
    found = jax.block_until_ready(program(*stacks))
print(all(np.allclose(f, 2 * s) for f, s in zip(found, stacks)))
"""


def test_stacks_beside_each_other_do_not_wait_for_ever(hard):
    """jaxlib 0.10's own do, where they are as many as it has threads: here eight, on two threads."""
    environment = {**os.environ, "NPROC": "2"}
    command = [sys.executable, "-c", STACKS]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == ["True"]
    hard(
        "stacks of matrices beside each other",
        "eight vmaps of a Cholesky factor and a product, 2 x 156 rows each, in one program on two threads",
        beyond="the program ends with the right result; with JAX's own Cholesky it deadlocks",
    )
