"""How public functions are compiled, and how they run."""

import ctypes
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial, wraps
from itertools import chain, pairwise
from math import prod
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer, eval_context
from jax.custom_batching import custom_vmap
from jax.extend.core import get_opaque_trace_state
from jaxtyping import Array, Float

# Products that `stacked_product` sums in one loop, as XLA unrolls so many, and multiplications from which on loops pay:
# below, threads wait for each other for longer.
_SUMMED = 16
_LOOPED = 500_000

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

# Numbers of an array that `bind` copies into one with others: to look at an argument takes a call half a microsecond,
# and its first touch more.
_SMALL = 1 << 16


def verb(function: F) -> F:
    """Compile ``function`` when it is called; inside another compiled function it is part of that.

    A decorator, for functions of yours too: like `equinox.filter_jit`, arrays are traced and the rest is static.

    By itself it gets the compiler options that suit its gathers best (`compiler_options`), which
    JAX takes for whole programs only.
    """
    inner = eqx.filter_jit(function)

    @cache
    def outer() -> Any:
        jit: Any = eqx.filter_jit  # its type leaves out what it hands on to jax.jit
        return jit(function, compiler_options=compiler_options())

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return (inner if _is_transformed(args, kwargs) else outer())(*args, **kwargs)

    return call  # type: ignore[return-value]


def bind(function: Callable[..., T], *first: Any, options: Mapping[str, Any] | None = None) -> Callable[..., T]:
    """``function(*first, ...)`` as one compiled function of the rest, which must be arrays or pytrees of them.

    For calls from a loop in Python: a model is many arrays, and looking through them anew takes longer than the forward
    solution of a small one. Small arrays are copied into one of each type. What of ``first`` is no array is static, as
    for `verb`. ::

        voltages = je.bind(je.forward, model)
        voltages(sigma)

    Args:
        options: for XLA; default: `compiler_options`.
    """
    leaves, static = eqx.partition(first, eqx.is_array)
    flat, structure = jax.tree.flatten(leaves)
    packed, unpacked = _packed(flat)

    @partial(jax.jit, compiler_options=compiler_options() if options is None else dict(options))
    def program(packed: list[Array], rest: tuple[Any, ...]) -> T:
        return function(*eqx.combine(jax.tree.unflatten(structure, unpacked(packed)), static), *rest)

    return lambda *rest: program(packed, rest)


def _packed(arrays: list[Array]) -> tuple[list[Array], Callable[[list[Array]], list[Array]]]:
    """The arrays, of which the small ones of a type are one, and the function that takes that apart again."""
    groups: dict[Any, list[int]] = {}
    for place, array in enumerate(arrays):
        small = array.size <= _SMALL and isinstance(array.dtype, np.dtype)  # and no random key
        groups.setdefault(array.dtype if small else place, []).append(place)
    order = np.argsort(list(chain(*groups.values())))
    shapes = [[arrays[place].shape for place in group] for group in groups.values()]

    def unpacked(packs: list[Array]) -> list[Array]:
        pieces = list(chain(*map(_cut, packs, shapes)))
        return [pieces[place] for place in order]

    return [_joined([arrays[place] for place in group]) for group in groups.values()], unpacked


def _joined(arrays: list[Array]) -> Array:
    if len(arrays) == 1:
        return arrays[0]
    joined: Array = jax.device_put(np.concatenate([np.asarray(array).ravel() for array in arrays]))
    return joined


def _cut(pack: Array, shapes: list[tuple[int, ...]]) -> list[Array]:
    if len(shapes) == 1:
        return [pack]
    pieces = jnp.split(pack, np.cumsum([prod(shape) for shape in shapes[:-1]]))
    return [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]


def is_traced(*values: Any) -> bool:
    """Whether jit, grad or vmap hides the numbers in any of these values, so that no check can look at them."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def require_known(name: str, error: type[Exception], *values: Any) -> None:
    """Refuse values that jit, grad or vmap hides, on behalf of a function that decides by looking at them."""
    if is_traced(*values, jnp.zeros(())):  # the last: inside jit all that is computed is hidden
        raise error(
            f"{name} decides by looking at values, which jit, grad or vmap hides; call it outside the transformed "
            "function and pass the result in"
        )


def _is_transformed(*values: Any) -> bool:
    """Whether another transformation is at work: on these values, or on whatever is computed now."""
    return is_traced(*values) or get_opaque_trace_state() != _untransformed_state()


@cache
def _untransformed_state() -> Any:
    """JAX's state outside any transformation."""
    with eval_context():
        return get_opaque_trace_state()


@cache
def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit` under which the sparse solver runs up to twice as fast on a CPU, and
    compiles in half the time; those that this version of XLA knows.

    Pass them to your own ``jax.jit(..., compiler_options=je.compiler_options())``.
    """
    options = {
        "xla_cpu_use_fusion_emitters": False,  # its gathers are slower
        "xla_cpu_experimental_ynn_fusion_type": "",  # small products wait for its threads
        "xla_cpu_enable_concurrency_optimized_scheduler": False,  # the levels are one chain
    }
    return {name: value for name, value in options.items() if _is_known({name: value})}


# What glibc's mallopt calls them, and the most that its int takes.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX, _LARGE = -1, -3, -8, 2**31 - 1


def reuse_memory() -> bool:
    """Have this process keep the memory that it frees; returns whether the system's C library can.

    glibc returns a block of over 32 MB to the system once it is freed. A program of XLA takes and frees its working
    memory at every call, so that with meshes of some 30,000 nodes or more it gets a new block each time, which the
    system clears page by page: a fifth of the time of a Jacobian. After this call the process keeps what it once
    needed, in one store for all threads, as one of a thread's own holds no block of over 64 MB. The commands do this;
    in a program of yours call it once, before the first computation.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    settings = {_MMAP_THRESHOLD: _LARGE, _TRIM_THRESHOLD: _LARGE, _ARENA_MAX: 1}
    return mallopt is not None and all(mallopt(name, value) for name, value in settings.items())


def _is_known(options: dict[str, Any]) -> bool:
    try:
        with eval_context():
            jax.jit(jnp.negative, compiler_options=options)(jnp.float32(1))
    except jax.errors.JaxRuntimeError:
        return False
    return True


def one_by_one(function: Callable[..., T]) -> Callable[..., T]:
    """``function``, which `jax.vmap` does one by one on a processor, so that each takes only its own way.

    In a batch a loop goes on for as long as one needs it, and both sides of a condition are computed: so on other
    devices, and where it is differentiated. Arguments and results are pytrees of arrays.
    """
    one = custom_vmap(function)

    @one.def_vmap
    def _(size: int, batched: Sequence[Any], *args: Any) -> tuple[T, Any]:
        moving, still = eqx.partition(args, tuple(batched))
        out = jax.lax.platform_dependent(
            moving,
            cpu=lambda moving: jax.lax.map(lambda each: one(*eqx.combine(each, still)), moving),
            default=jax.vmap(lambda each: function(*eqx.combine(each, still))),
        )
        return out, jax.tree.map(lambda _: True, out)

    @eqx.filter_custom_jvp
    def call(*args: Any) -> T:
        result: T = one(*args)
        return result

    call.def_jvp(lambda primals, tangents: eqx.filter_jvp(function, primals, tangents))
    return call


def stacked_product(left: Float[Array, "m k i"], right: Float[Array, "m k j"]) -> Float[Array, "m i j"]:
    """``left^T right`` of every pair of many small matrices."""
    by_library = partial(jnp.einsum, "mki,mkj->mij")
    unfused = jax.config.read("jax_disable_most_optimizations")  # every single product would be stored
    if unfused or left.size * right.shape[2] < _LOOPED:
        return by_library(left, right)
    product: Array = jax.lax.platform_dependent(left, right, cpu=_in_loops, default=by_library)
    return product


def _in_loops(left: Float[Array, "m k i"], right: Float[Array, "m k j"]) -> Float[Array, "m i j"]:
    """On processors jaxlib calls Eigen for each pair in turn, on one core and with the instructions of old machines.
    Loops that XLA compiles for this one take a third of the time, and for larger matrices no more."""
    cuts = np.linspace(0, left.shape[1], -(-left.shape[1] // _SUMMED) + 1).astype(int)
    sums = (jnp.sum(left[:, i:j, :, None] * right[:, i:j, None, :], 1) for i, j in pairwise(cuts))
    return sum(sums, start=jnp.zeros((), left.dtype))
