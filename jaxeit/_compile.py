"""How public functions are compiled, and how they run."""

import ctypes
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache, lru_cache, partial, wraps
from importlib import import_module
from itertools import chain
from math import prod
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer, eval_context
from jax.custom_batching import custom_vmap
from jax.extend.backend import backends
from jax.extend.core import get_opaque_trace_state
from jaxtyping import Array, Bool
from threadpoolctl import threadpool_limits

from .program_cache import changes_of_folder, keep, programs_folder, unbound

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

# Largest size of an array that `bind` packs with others. Each argument costs a call half a microsecond, and more at its
# first use; but a program takes packed arrays apart at each call, which for larger ones takes longer.
MAX_PACKED_SIZE = 1 << 14


def verb(function: F) -> F:
    """Compile ``function`` when it is called; inside another compiled function it becomes part of that function.

    A decorator, also for functions of your own: as with `equinox.filter_jit`, arrays are traced and the rest is static.

    A call outside other compiled functions uses the compiler options that suit its gathers best (`compiler_options`);
    JAX accepts options for whole programs only.

    Example:
        @je.verb
        def largest_change(model, sigma):
            return jnp.abs(je.forward(model, sigma) - je.forward(model)).max()


        print(largest_change(model, 1.1 * model.background))  # V
    """
    exact = full_precision(function)
    inner = eqx.filter_jit(exact)

    @lru_cache(maxsize=1)
    def outer(_changes: int) -> Any:
        jit: Any = eqx.filter_jit  # its type leaves out what it hands on to jax.jit
        return jit(keep(exact, call), compiler_options=compiler_options())

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if is_transformed(args, kwargs):
            return inner(*args, **kwargs)
        with _plain_precision():
            found = outer(changes_of_folder())(*args, **kwargs)
        return found if programs_folder() is None else unbound(found)

    return call  # type: ignore[return-value]


def full_precision(function: F) -> F:
    """``function``, whose products in single precision a GPU does not round to TF32, of 10 bits, as JAX lets it.

    Verbs are so. JAX traces rules of derivatives and of batches later, when the verb that they belong to is done.
    """

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return call  # type: ignore[return-value]


def _plain_precision() -> AbstractContextManager[Any]:
    """Within functions of full precision a verb is the program that it is elsewhere, since the verb says so itself."""
    settings: Any = jax.config  # its type leaves out the settings
    plain: AbstractContextManager[Any] = nullcontext()
    return jax.default_matmul_precision(None) if settings.jax_default_matmul_precision == "highest" else plain


def bind(function: Callable[..., T], *first: Any, options: Mapping[str, Any] | None = None) -> Callable[..., T]:
    """``function(*first, ...)`` as one compiled function of the rest, which must be arrays or pytrees of them.

    For calls from a loop in Python: a model is many arrays, and checking all of them at each call takes longer than the
    forward solution of a small model. Small arrays are packed into one array of each type. Parts of ``first`` that are
    no arrays are static, as for `verb`. Where ``first`` differs in its numbers only, nothing is compiled anew.

    Works under jit, vmap and grad, where it becomes part of the transformed function and has no options of its own.

    Args:
        options: for XLA; default: `compiler_options`.

    Example:
        voltages = je.bind(je.forward, model)
        for factor in (1.0, 1.1, 1.2):
            print(voltages(factor * model.background).max())  # V
    """
    flat, form = taken_apart(first)
    packs, layout = _pack_by_type(flat)
    flags = flags_of(options)
    key = function, form, layout
    inner = _bound(*key, (), None)  # JAX takes options for whole programs only
    if programs_folder() is None:
        outer = _bound(*key, flags, None)
        return lambda *rest: (inner if is_transformed(rest) else outer)(packs, rest)
    kept = _bound(*key, flags, changes_of_folder())
    return lambda *rest: inner(packs, rest) if is_transformed(rest) else unbound(kept(packs, rest))


class Form(NamedTuple):
    """What remains of bound arguments without their arrays; equal for models that differ in their numbers only."""

    arrays: Any
    others: Any
    static: tuple[tuple[type, Any], ...]  # with their types: 1 is no 1.0

    def with_arrays(self, arrays: list[Array]) -> tuple[Any, ...]:
        """The arguments."""
        static = jax.tree.unflatten(self.others, [leaf for _, leaf in self.static])
        found: tuple[Any, ...] = eqx.combine(jax.tree.unflatten(self.arrays, arrays), static)
        return found


def taken_apart(first: tuple[Any, ...]) -> tuple[list[Array], Form]:
    """The arrays of bound arguments, and the rest."""
    leaves, rest = eqx.partition(first, eqx.is_array)
    flat, arrays = jax.tree.flatten(leaves)
    static, others = jax.tree.flatten(rest)
    return flat, Form(arrays, others, tuple((type(leaf), leaf) for leaf in static))


def flags_of(options: Mapping[str, Any] | None) -> tuple[tuple[str, Any], ...]:
    """Options for XLA as a key; by default `compiler_options`."""
    return tuple(sorted((compiler_options() if options is None else options).items()))


@lru_cache(maxsize=256)
def _bound(
    function: Callable[..., T],
    form: "Form",
    layout: "_Layout",
    flags: Any,
    changes: int | None,
) -> Callable[..., T]:
    """The program of `bind`, which models that differ in their numbers only share.

    Args:
        changes: those of the folder where the program is kept. None: it is not kept, so that it can be transformed.
    """
    exact = full_precision(function)
    run = exact if changes is None else keep(exact, function)

    @partial(jax.jit, compiler_options=dict(flags))
    def program(packs: list[Array], rest: tuple[Any, ...]) -> T:
        found: T = run(*form.with_arrays(layout.unpack(packs)), *rest)
        return found

    compiled: Callable[..., T] = program
    return compiled


class _Layout(NamedTuple):
    """Where arrays lie in packs: the shapes of those in each pack, and the place of each array among all pieces."""

    shapes: tuple[tuple[tuple[int, ...], ...], ...]
    order: tuple[int, ...]

    def unpack(self, packs: list[Array]) -> list[Array]:
        """The arrays."""
        pieces = list(chain(*map(_split_pack, packs, self.shapes)))
        return [pieces[place] for place in self.order]


def _pack_by_type(arrays: list[Array]) -> tuple[list[Array], _Layout]:
    """Small arrays packed into one array of each type, large ones as they are."""
    groups: dict[Any, list[int]] = {}
    for place, array in enumerate(arrays):
        small = array.size <= MAX_PACKED_SIZE and isinstance(array.dtype, np.dtype)  # and no random key
        groups.setdefault(array.dtype if small else place, []).append(place)
    order = np.argsort(list(chain(*groups.values())))
    shapes = tuple(tuple(arrays[place].shape for place in group) for group in groups.values())
    return [_concatenated([arrays[place] for place in group]) for group in groups.values()], _Layout(
        shapes, tuple(order.tolist())
    )


def _concatenated(arrays: list[Array]) -> Array:
    """One flat array of several; a single array keeps its shape."""
    if len(arrays) == 1:
        return arrays[0]
    flat: Array = jax.device_put(np.concatenate([np.asarray(array).ravel() for array in arrays]))
    return flat


def _split_pack(pack: Array, shapes: tuple[tuple[int, ...], ...]) -> list[Array]:
    """The reverse of `_concatenated`."""
    if len(shapes) == 1:
        return [pack]
    pieces = jnp.split(pack, np.cumsum([prod(shape) for shape in shapes[:-1]]))
    return [piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)]


def is_traced(*values: Any) -> bool:
    """Whether jit, grad or vmap hides the numbers in any of these values, so that they cannot be checked."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))


def require_known(name: str, error: type[Exception], *values: Any) -> None:
    """Refuse values that jit, grad or vmap hides, for a function ``name`` that decides by looking at them."""
    if is_traced(*values, jnp.zeros(())):  # the zeros: inside jit every computed array is hidden
        raise error(
            f"{name} decides by looking at values, which jit, grad or vmap hides; call it outside the transformed "
            "function and pass the result in"
        )


def is_transformed(*values: Any) -> bool:
    """Whether a transformation of JAX is active: on these values, or on everything that is computed now."""
    return is_traced(*values) or get_opaque_trace_state() != _untransformed_state()


@cache
def _untransformed_state() -> Any:
    """JAX's state outside any transformation."""
    with eval_context():
        return get_opaque_trace_state()


@cache
def compiler_options() -> dict[str, Any]:
    """Options for `jax.jit` with which programs on a CPU compile in half the time and run up to a third faster.

    Options that this version of XLA does not know are left out. Pass them to your own
    ``jax.jit(..., compiler_options=je.compiler_options())``.

    Example:
        energy = jax.jit(
            lambda sigma: jnp.sum(je.forward(model, sigma) ** 2), compiler_options=je.compiler_options()
        )
        print(energy(model.background))
    """
    options = {
        "xla_cpu_use_fusion_emitters": False,  # its gathers are slower
        "xla_cpu_experimental_ynn_fusion_type": "",  # small products wait for its threads
        "xla_cpu_enable_concurrency_optimized_scheduler": False,  # the levels are one chain
    }
    if _is_known(options):
        return options
    return {name: value for name, value in options.items() if _is_known({name: value})}


# Parameter numbers of glibc's mallopt, and the largest value that its int holds: thresholds that no block reaches.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX, _INT_MAX = -1, -3, -8, 2**31 - 1


def reuse_memory() -> bool:
    """Let this process keep the memory that it frees; returns whether the system's C library can do so.

    glibc returns a block of over 32 MB to the system once the block is freed. A program of XLA takes and frees its
    working memory at every call, so that with meshes of some 30,000 nodes or more it gets a new block each time, which
    the system clears page by page: a fifth of the time of a Jacobian. After this call the process keeps the memory that
    it once needed, in one arena for all threads, because the arena of a single thread holds no block of over 64 MB. The
    commands do this; in a program of yours call it once, before the first computation.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    settings = {_MMAP_THRESHOLD: _INT_MAX, _TRIM_THRESHOLD: _INT_MAX, _ARENA_MAX: 1}
    return mallopt is not None and all(mallopt(name, value) for name, value in settings.items())


def limit_blas_threads(count: int = 1) -> None:
    """Limit the number of threads of the BLAS libraries of this process, from now on.

    On a CPU JAX gives small factorisations to the LAPACK of SciPy, which by default starts a thread for each core and
    makes the threads of XLA wait. A batch of forward solutions loses a third of its speed by that. The commands call
    this; in a program of yours call it once. It equals the environment variable ``OPENBLAS_NUM_THREADS``, which has to
    be set before NumPy and SciPy are imported.
    """
    import_module("scipy.linalg.cython_lapack")  # where JAX finds LAPACK; a library that is not loaded has no threads
    threadpool_limits(count, user_api="blas")


def _is_known(options: dict[str, Any]) -> bool:
    try:
        with eval_context():
            jax.jit(jnp.negative, compiler_options=options)(jnp.float32(1))
    except jax.errors.JaxRuntimeError:
        return False
    return True


def by_platform(*args: Any, cpu: Callable[..., T], default: Callable[..., T]) -> T:
    """`jax.lax.platform_dependent`. If JAX has no other device than CPUs, it traces the function for CPUs only.

    Nested choices would otherwise trace every combination of their functions.
    """
    if set(backends()) == {"cpu"}:
        return cpu(*args)
    chosen: T = jax.lax.platform_dependent(*args, cpu=cpu, default=default)
    return chosen


@custom_vmap
def _in_every_sample(holds: Bool[Array, ""]) -> Bool[Array, ""]:
    return holds


@_in_every_sample.def_vmap
def _(size: int, batched: Sequence[bool], holds: Bool[Array, " batch"]) -> tuple[Bool[Array, ""], bool]:
    return _in_every_sample(jnp.all(holds)), False


def usually(holds: Bool[Array, ""], usual: Callable[..., T], unusual: Callable[..., T], *args: Any) -> T:
    """`jax.lax.cond` for a condition that holds nearly always.

    `jax.vmap` of a condition computes both branches for all samples. Of this one it computes the usual branch alone
    where the condition holds in all samples of the batch. Otherwise a CPU takes one sample after the other, each with
    its own branch, unless derivatives are taken. Arguments and results are pytrees of arrays.
    """
    each = sequential_on_cpu(lambda holds, *args: jax.lax.cond(holds, usual, unusual, *args))
    found: T = jax.lax.cond(_in_every_sample(holds), lambda _, *args: usual(*args), each, holds, *args)
    return found


def sequential_on_cpu(function: Callable[..., T]) -> Callable[..., T]:
    """``function``, whose `jax.vmap` on a CPU is a loop over the batch, as `jax.custom_batching.sequential_vmap` makes.

    In a batched program a loop runs until its slowest sample ends, and both branches of a condition are computed; here
    each sample does only its own work. Other devices, and derivatives, use the batched program. Arguments and results
    are pytrees of arrays.
    """
    function = full_precision(function)
    single = custom_vmap(function)

    @single.def_vmap
    def _(size: int, batched: Sequence[Any], *args: Any) -> tuple[T, Any]:
        mapped, shared = eqx.partition(args, tuple(batched))
        out = by_platform(
            mapped,
            cpu=lambda mapped: jax.lax.map(lambda sample: single(*eqx.combine(sample, shared)), mapped),
            default=jax.vmap(lambda sample: function(*eqx.combine(sample, shared))),
        )
        return out, jax.tree.map(lambda _: True, out)

    @eqx.filter_custom_jvp
    def call(*args: Any) -> T:
        result: T = single(*args)
        return result

    call.def_jvp(lambda primals, tangents: eqx.filter_jvp(function, primals, tangents))
    return call
