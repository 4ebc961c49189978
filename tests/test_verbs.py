"""Verbs compile themselves at the top, and become part of whatever program calls them."""

import os
import subprocess
import sys
from collections import Counter
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax  # noqa: F401, gives stop_gradient its transpose rule, as every use of optimistix does
import numpy as np
import pytest
from jax import monitoring

import jaxeit as je
from jaxeit import _compile as verbs


@verbs.verb
def double(x):
    return 2 * x


@pytest.fixture
def first_call():
    """As in a process that has called no verb yet."""
    verbs._untransformed_state.cache_clear()
    verbs.compiler_options.cache_clear()


@pytest.mark.parametrize(
    "around",
    [lambda f: f, jax.jit, jax.vmap, lambda f: jax.jit(jax.vmap(f)), lambda f: lambda x: jax.jvp(f, (x,), (x,))[1]],
    ids=["alone", "jit", "vmap", "jit of vmap", "jvp"],
)
def test_a_verb_is_the_same_wherever_it_is_called(around, first_call):
    assert float(around(double)(jnp.ones(1))[0]) == 2.0


@pytest.mark.parametrize(
    "around",
    [
        lambda f: f,
        jax.jit,
        jax.vmap,
        lambda f: jax.jit(jax.vmap(f)),
        lambda f: lambda x: 2 * jax.grad(lambda y: f(y).sum())(x) - 4 + f(x),
        lambda f: lambda x: jax.lax.scan(lambda carried, _: (carried, f(carried)), x, None, 2)[1][1],
    ],
    ids=["alone", "jit", "vmap", "jit of vmap", "grad", "scan"],
)
def test_a_bound_function_is_the_same_wherever_it_is_called(around, first_call):
    """Options are for whole programs only."""
    bound = je.bind(lambda scale, x: scale * x, jnp.asarray(2.0))
    assert float(around(bound)(jnp.ones(1))[0]) == 2.0


def test_a_verb_of_constants_inside_a_program(first_call):
    """No argument tells that a program is being made; options are for whole programs only."""
    constant = jnp.ones(3)
    assert float(jax.jit(lambda y: double(constant)[0] + y)(1.0)) == 3.0


def test_a_verb_is_one_program_within_functions_of_full_precision():
    compiled: list[str] = []

    def listen(event, _, **about):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(about["fun_name"])

    @verbs.verb
    def triple(x):
        return 3 * x

    monitoring.register_event_duration_secs_listener(listen)
    try:
        for function in (triple, verbs.full_precision(triple)):
            np.testing.assert_array_equal(function(jnp.ones(7)), 3)
    finally:
        monitoring.unregister_event_duration_listener(listen)
    assert compiled.count("jit(triple)") == 1


def test_options_that_xla_does_not_know_are_left_out(first_call, monkeypatch):
    def refuse(*_, **__):
        raise jax.errors.JaxRuntimeError("no such option")

    monkeypatch.setattr(jax, "jit", refuse)
    assert je.compiler_options() == {}
    verbs.compiler_options.cache_clear()


def test_options_are_asked_for_inside_a_program(first_call):
    assert float(jax.jit(lambda x: x + len(je.compiler_options()))(1.0)) >= 1.0


def test_a_bound_function_is_that_of_what_is_left(model):
    halved = 0.5 * model.background
    voltages = je.bind(je.forward, model)
    np.testing.assert_allclose(voltages(halved), je.forward(model, halved), rtol=1e-12)
    np.testing.assert_allclose(voltages(np.asarray(halved)), 2 * voltages(), rtol=1e-9)


def test_functions_bound_to_other_numbers_share_a_program(compilations):
    def power(base, exponent, factor):
        return factor * base**exponent

    x, other = jnp.arange(3.0), jnp.arange(1.0, 4.0)
    je.bind(power, x, 2)(x)
    seen = len(compilations)
    assert seen
    found = je.bind(power, other, 2)(x)
    assert len(compilations) == seen
    np.testing.assert_array_equal(found, [0, 4, 18])
    je.bind(power, x, 2.0)(x)  # 2.0 is no 2
    assert len(compilations) > seen


def test_bound_arrays_keep_their_values_types_and_shapes():
    key = jax.random.key(3)
    large = np.arange(verbs.MAX_PACKED_SIZE + 1)
    more = [jnp.float32(2), key, jax.random.split(key), large]
    given = {"floats": [np.arange(3.0), np.float64(7), np.zeros((0, 2))], "more": more, "no": 5}
    given = jax.tree.map(lambda v: jnp.asarray(v) if isinstance(v, np.ndarray | np.generic) else v, given)
    given["whole"] = jnp.arange(6, dtype=jnp.uint32).reshape(2, 3), jnp.array([True, False]), jnp.arange(4, 6)
    found = je.bind(lambda given, extra: (eqx.filter(given, eqx.is_array), extra), given)(jnp.arange(2.0))
    wanted = eqx.filter(given, eqx.is_array), jnp.arange(2.0)
    assert jax.tree.structure(found) == jax.tree.structure(wanted)
    assert eqx.tree_equal(found, wanted, typematch=True)


_FAULTS = """
import resource, sys
import jaxeit as je

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    bytearray(10**8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

given_back = max(faults() for _ in range(4))
can = je.reuse_memory()
faults()
print(can, given_back, max(faults() for _ in range(4)))
"""


def test_memory_is_used_again():
    """Counted in pages that the system had to supply; in a process of its own, as it cannot be taken back."""
    done = subprocess.run([sys.executable, "-c", _FAULTS], check=True, capture_output=True, text=True)
    can, given_back, kept = done.stdout.split()
    if can == "False":
        pytest.skip("not with this C library")
    assert int(given_back) > 20 * int(kept) + 100


_THREADS = """
import scipy.linalg
from threadpoolctl import threadpool_info
import jaxeit as je

je.limit_blas_threads()
print(sorted({library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}))
"""


def test_every_blas_of_a_process_is_limited_to_one_thread():
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    command = [sys.executable, "-c", _THREADS]
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    assert done.stdout.strip() == "[1]"


def _halved(seen):
    """Of x and a limit that all share: x halved until it is below, or the sine of what is so from the start."""

    def function(limit, x):
        held = jax.lax.stop_gradient(x)

        def again(steps):
            jax.debug.callback(lambda _: seen.append("halved"), held)
            return steps + 1

        def sine(x):
            jax.debug.callback(lambda _: seen.append("sine"), held)
            return jnp.sin(x)

        steps = jax.lax.while_loop(lambda steps: held * 0.5**steps > limit, again, jnp.asarray(0))
        return jax.lax.cond(x > limit, lambda x: x * 0.5**steps, sine, x), steps

    return function


def test_each_takes_only_its_own_way():
    """Where a vmap by itself goes both ways, and on for as long as one needs it."""
    x = jnp.array([[9.0, 0.5, 5.0], [0.3, 1.5, 0.2]])
    ours, theirs = [], []
    mapped = [
        jax.jit(jax.vmap(jax.vmap(function, (None, 0)), (None, 0)))(1.0, x)
        for function in (verbs.sequential_on_cpu(_halved(ours)), _halved(theirs))
    ]
    jax.effects_barrier()
    np.testing.assert_array_equal(mapped[0][0], mapped[1][0])
    np.testing.assert_array_equal(mapped[0][1], mapped[1][1])
    np.testing.assert_allclose(mapped[0][0], [[0.5625, np.sin(0.5), 0.625], [np.sin(0.3), 0.75, np.sin(0.2)]])
    own_way = (4 + 3 + 1, 3) if jax.devices()[0].platform == "cpu" else (6 * 4, 6)  # a GPU takes all at once
    assert (ours.count("halved"), ours.count("sine")) == own_way
    assert (theirs.count("halved"), theirs.count("sine")) == (6 * 4, 6)


def _squared(seen):
    """scale x^2, or scale x where x is negative; both ways tell when they are gone."""

    def told(name, x):
        jax.debug.callback(lambda _: seen.append(name), jax.lax.stop_gradient(x))
        return x

    def usual(scale, x):
        return scale * told("usual", x) ** 2

    def unusual(scale, x):
        return scale * told("unusual", x)

    return lambda scale, x: verbs.usually(x > 0, usual, unusual, scale, x)


@pytest.mark.parametrize(
    ("first", "ways"), [(4.0, {"usual": 4}), (-1.0, {"usual": 3, "unusual": 1})], ids=["all as usual", "one is not"]
)
def test_a_batch_takes_the_usual_way_alone_where_all_do(first, ways):
    seen, x = [], jnp.array([[first, 9.0], [1.0, 16.0]])
    squared = partial(_squared(seen), jnp.array(3.0))
    found = jax.jit(jax.vmap(jax.vmap(squared)))(x)
    jax.effects_barrier()
    np.testing.assert_allclose(found, 3 * jnp.where(x > 0, x**2, x), rtol=1e-12)
    if first > 0 or jax.devices()[0].platform == "cpu":  # a GPU goes both ways at once where one sample is not as usual
        assert Counter(seen) == ways
    for slopes in (
        jax.vmap(jax.vmap(jax.grad(squared))),
        jax.grad(lambda x: jnp.sum(jax.vmap(jax.vmap(squared))(x))),
    ):
        np.testing.assert_allclose(jax.jit(slopes)(x), jnp.where(x > 0, 6 * x, 3.0), rtol=1e-12)


def test_what_is_done_one_by_one_has_derivatives():
    one, x = verbs.sequential_on_cpu(_halved([])), jnp.array([9.0, 0.5, 1.5])
    slopes = [0.5**4, np.cos(0.5), 0.5]
    for many in (
        jax.vmap(jax.grad(lambda x: one(1.0, x)[0])),
        jax.grad(lambda x: jnp.sum(jax.vmap(one, (None, 0))(1.0, x)[0])),
        lambda x: jax.jvp(lambda x: jax.vmap(one, (None, 0))(1.0, x)[0], (x,), (jnp.ones(3),))[1],
        lambda x: jax.vmap(lambda x: jax.jvp(lambda x: one(1.0, x)[0], (x,), (1.0,))[1])(x),
    ):
        np.testing.assert_allclose(jax.jit(many)(x), slopes, rtol=1e-12)
