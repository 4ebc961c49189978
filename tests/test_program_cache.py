"""Programs that are kept: the same results, traced once, and found only where everything is the same."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

import jaxeit as je
from jaxeit import program_cache

TRACED: list[str] = []
COMPILED = "/jax/core/compile/backend_compile_duration"


class Layer(eqx.Module):
    """A pytree with a part that is no array."""

    gain: jax.Array
    name: str = eqx.field(static=True)
    parts: frozenset[str] = eqx.field(static=True, default=frozenset({"a", "b"}))


class Mark:
    """A value that equals itself only."""


MARK = Mark()


class Marked(eqx.Module):
    """A pytree of which only results of one process fit together."""

    value: jax.Array
    mark: Mark = eqx.field(static=True)


@je.verb
def scaled(layer, factor=2):
    TRACED.append(f"{layer.name} {factor!r}")
    return replace(layer, gain=layer.gain * factor), {"factor": factor}


@je.verb
def with_weak_types(x):
    TRACED.append("with weak types")
    return x, jnp.asarray(1.0), jnp.full(3, 2.0)


@je.verb
def operator(x):
    TRACED.append("operator")
    return lx.MatrixLinearOperator(jnp.diag(x), lx.positive_semidefinite_tag)


@je.verb
def marked(x):
    TRACED.append("marked")
    return Marked(x, MARK)


def squared(x):
    TRACED.append("squared")
    return x**2


slope = je.verb(jax.grad(squared))
"""A verb whose name is that of another function."""


def _of(module):
    """A class whose code nothing would notice a change of."""
    return type("Mine", (Layer,), {"__module__": module})


@pytest.fixture
def new_process(tmp_path, monkeypatch):
    """Forget what this process knows, as a new one would; functions of this module are known."""
    monkeypatch.setattr(program_cache, "_KNOWN", {*program_cache._KNOWN, "tests"})

    def begin():
        TRACED.clear()
        je.cache_programs(tmp_path)

    begin()
    yield begin
    je.cache_programs(None)


def _kept(folder):
    return sorted(folder.glob("programs-*/*"))


def test_a_program_is_traced_once_and_its_result_is_whole(new_process, tmp_path):
    layer = Layer(jnp.arange(3.0), "coat")
    expected, told = scaled(layer)
    assert TRACED == ["coat 2"]
    new_process()
    found, said = scaled(layer)
    assert TRACED == []
    assert (found.name, found.parts, said["factor"]) == (expected.name, expected.parts, told["factor"])
    assert found.gain.dtype == expected.gain.dtype
    np.testing.assert_array_equal(found.gain, [0.0, 2.0, 4.0])
    assert len(_kept(tmp_path)) == 1


def test_programs_of_bind_are_kept_and_those_of_the_verb(new_process, tmp_path):
    layer = Layer(jnp.arange(3.0), "coat")
    expected, _ = je.bind(scaled, layer)(jnp.asarray(2.0))
    new_process()
    np.testing.assert_array_equal(je.bind(scaled, layer)(jnp.asarray(2.0))[0].gain, expected.gain)
    np.testing.assert_array_equal(scaled(layer, jnp.asarray(2.0))[0].gain, expected.gain)
    assert TRACED == []
    assert len(_kept(tmp_path)) == 1
    assert je.bind(lambda layer, factor: factor * layer.gain, layer)(jnp.asarray(2.0)).shape == (3,)
    assert len(_kept(tmp_path)) == 1


def test_results_are_weakly_typed_as_without_a_cache(new_process):
    narrow = jnp.zeros(3, jnp.float32)
    expected = with_weak_types(narrow)
    new_process()
    found = with_weak_types(narrow)
    assert TRACED == []
    for one, other in zip(found, expected, strict=True):
        assert (one.weak_type, one.dtype, (one[..., None] + narrow).dtype) == (
            other.weak_type,
            other.dtype,
            (other[..., None] + narrow).dtype,
        )
    assert [one.weak_type for one in found] == [False, True, True]


def test_a_verb_is_compiled_once_for_arrays_of_any_origin(new_process, compilations):
    """Of the host, and of programs that were traced, kept and found."""
    layer = Layer(jnp.arange(3.0), "coat")
    kept, _ = scaled(layer)
    bound, _ = je.bind(scaled, layer)(jnp.asarray(2.0))
    scaled(kept)
    scaled(bound)
    new_process()
    found, _ = scaled(layer)
    compilations.clear()
    scaled(found)
    assert COMPILED not in compilations
    assert not any(one.gain.committed for one in (kept, bound, found))


def test_results_fit_together_with_results_that_were_traced(new_process, tmp_path):
    x = jnp.arange(1.0, 4.0)
    expected = operator(x)
    new_process()
    found = operator(x)
    assert TRACED == []
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    assert lx.is_positive_semidefinite(found)
    assert jax.tree.structure(marked(x)) == jax.tree.structure(marked(2 * x))
    assert len(_kept(tmp_path)) == 1  # a result that cannot be restored is not kept


@pytest.mark.parametrize(
    "call",
    [
        lambda layer: scaled(replace(layer, gain=jnp.ones(4))),
        lambda layer: scaled(replace(layer, gain=layer.gain.astype(jnp.float32))),
        lambda layer: scaled(replace(layer, gain=jnp.ones(3, int))),
        lambda layer: scaled(replace(layer, name="foam")),
        lambda layer: scaled(replace(layer, parts=frozenset({"a"}))),
        lambda layer: scaled(layer, 2.0),
        lambda layer: scaled(layer, factor=2),
        lambda layer: scaled(layer, jnp.asarray(2.0, float)),
    ],
    ids=["shape", "precision", "type", "part", "set", "1 is no 1.0", "by name", "array"],
)
def test_a_call_that_differs_has_a_program_of_its_own(new_process, call):
    layer = Layer(jnp.arange(3.0), "coat")
    scaled(layer)
    new_process()
    call(layer)
    assert len(TRACED) == 1


def test_a_setting_of_jax_or_another_source_has_programs_of_its_own(new_process, monkeypatch):
    layer = Layer(jnp.arange(3.0), "coat")
    scaled(layer)
    with jax.numpy_rank_promotion("raise"):
        scaled(layer)
    assert len(TRACED) == 2
    monkeypatch.setattr(program_cache, "_fingerprint", lambda: "another")
    new_process()
    scaled(layer)
    assert len(TRACED) == 1


def test_what_is_reported_does_not_matter(new_process):
    scaled(Layer(jnp.arange(3.0), "coat"))
    new_process()
    with jax.log_compiles(False):
        jax.config.update("jax_traceback_in_locations_limit", 5)
        try:
            scaled(Layer(jnp.arange(3.0), "coat"))
        finally:
            jax.config.update("jax_traceback_in_locations_limit", 0)
    assert TRACED == []


@pytest.mark.parametrize(
    "call",
    [
        lambda layer: jax.jit(lambda gain: scaled(replace(layer, gain=gain))[0].gain)(layer.gain),
        lambda layer: jax.vmap(lambda gain: scaled(replace(layer, gain=gain))[0].gain)(layer.gain),
        lambda layer: jax.grad(lambda gain: scaled(replace(layer, gain=gain))[0].gain.sum())(layer.gain),
        lambda layer: jax.vmap(je.bind(squared))(layer.gain),
        lambda layer: jax.jit(jax.grad(je.bind(squared, options={})))(layer.gain[1]),
        lambda layer: scaled(_of("my_module")(layer.gain, "coat")),
        lambda layer: scaled(_of("__main__")(layer.gain, "coat")),
        lambda layer: scaled(_of(__name__)(layer.gain, "coat")),
        lambda layer: slope(layer.gain[1]),
        lambda layer: je.verb(lambda x: 2 * x)(layer.gain),
        lambda layer: je.verb(partial(jnp.multiply, 2.0))(layer.gain),
        lambda layer: je.verb(jax.random.uniform)(jax.random.key(0)),
    ],
    ids=[
        "jit",
        "vmap",
        "grad",
        "vmap of bind",
        "grad of bind",
        "module",
        "main",
        "name",
        "other verb",
        "lambda",
        "partial",
        "random key",
    ],
)
def test_what_is_not_known_for_sure_is_not_kept(new_process, tmp_path, call):
    call(Layer(jnp.arange(3.0), "coat"))
    assert _kept(tmp_path) == []


def test_an_error_is_that_of_the_verb(new_process, tmp_path):
    with pytest.raises(TypeError, match="scalar"):
        scaled(Layer(jnp.arange(3.0), "coat"), "twice")
    assert _kept(tmp_path) == []


@pytest.mark.parametrize(
    "damage", [lambda text: text[:-9], lambda text: b"", lambda text: text[:99] + b"!" + text[100:]]
)
def test_a_damaged_file_is_replaced(new_process, tmp_path, damage):
    scaled(Layer(jnp.arange(3.0), "coat"))
    (path,) = _kept(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    new_process()
    np.testing.assert_array_equal(scaled(Layer(jnp.arange(3.0), "coat"))[0].gain, [0.0, 2.0, 4.0])
    assert len(TRACED) == 1
    new_process()
    scaled(Layer(jnp.arange(3.0), "coat"))
    assert TRACED == []


def test_a_folder_that_cannot_be_written_costs_time_only(new_process, tmp_path):
    folder = program_cache._folder
    folder.rmdir()
    folder.write_bytes(b"")
    np.testing.assert_array_equal(scaled(Layer(jnp.arange(3.0), "coat"))[0].gain, [0.0, 2.0, 4.0])


def test_programs_that_nothing_uses_any_more_are_removed(new_process, tmp_path):
    for name, days in (("programs-old", 31), ("programs-recent", 29), ("others", 99)):
        (tmp_path / name).mkdir()
        age = (program_cache.time.time() - 86400 * days,) * 2
        os.utime(tmp_path / name, age)
    new_process()
    assert {"programs-recent", "others"} < {path.name for path in tmp_path.iterdir()}
    assert not (tmp_path / "programs-old").exists()


IN_ANOTHER_PROCESS = """
import jax; jax.config.update("jax_enable_x64", True)
import jaxeit as je
je.cache_programs({folder!r})
model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
print(bytes(memoryview(je.forward(model))).hex())
"""


def test_another_process_finds_a_program(tmp_path):
    """Sets have another order there, and strings other places in memory."""
    code = IN_ANOTHER_PROCESS.format(folder=str(tmp_path))
    said, times = [], []
    for seed in "12":
        env = os.environ | {"PYTHONHASHSEED": seed, "JAXTYPING_DISABLE": "1"}
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
        said.append(done.stdout)
        times.append([path.stat().st_mtime_ns for path in _kept(tmp_path)])
    assert said[0] == said[1] != ""
    assert times[0] == times[1] != []


def test_the_lines_of_the_page_keep_programs(root, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = jax.config.jax_compilation_cache_dir
    (lines,) = re.findall(r"```python\n(.*?)```", (root / "docs" / "costs.md").read_text(encoding="utf-8"), re.DOTALL)
    try:
        exec(lines, {})
        je.metrics.localisation_error(jnp.zeros((1, 2)), jnp.ones((1, 2)))
        assert len(_kept(tmp_path / "programs")) == 1
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
        je.cache_programs(None)
