"""Functions of many samples at once, shared out over all devices of JAX."""

from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
from jaxtyping import Array

from ._compile import Form, flags_of, full_precision, is_transformed, taken_apart

T = TypeVar("T")

TOGETHER = 64  # samples that a device takes at a time


def bind_many(
    function: Callable[..., T], *first: Any, together: int = TOGETHER, options: Mapping[str, Any] | None = None
) -> Callable[..., T]:
    """``function(*first, ...)`` of many samples in one call, as one compiled function: `bind` for batches.

    The arguments of the new function are arrays, or pytrees of them, with the samples along their first axes; so is its
    result. The samples are shared out over all devices of JAX. Each device takes ``together`` of them at a time by
    `jax.vmap`, so that the working memory does not grow with the number of samples.

    To JAX a CPU is one device, and batches of forward solutions occupy one of its cores. To have a device for each
    core, write ``jax.config.update("jax_num_cpu_devices", os.cpu_count())`` before the first computation.

    A call with fewer samples than ``together`` for each device is compiled for their number, and other calls once.
    Parts of ``first`` that are no arrays are static, as for `verb`. Works under jit, vmap and grad, where it becomes
    part of the transformed function, on the devices of that.

    Args:
        together: 32 and more are quickest for forward solutions, 8 for Jacobians and gradients.
        options: for XLA; default: `compiler_options`.

    Raises:
        ValueError: from the new function, if its arguments have no sample, or not equally many.

    Example:
        voltages = je.bind_many(je.forward, model)
        sigmas = model.background * jnp.linspace(0.9, 1.1, 40)[:, None]  # (samples, elements) S
        print(voltages(sigmas).shape)  # (samples, readings)
    """
    if together < 1:
        raise ValueError(f"bind_many: together is {together}; give the number of samples that a device takes at a time")
    mesh = Mesh(np.array(jax.local_devices()), ("samples",))
    arrays, form = taken_apart(first)
    program = _program(function, form, flags_of(options), mesh)
    everywhere = jax.device_put(arrays, NamedSharding(mesh, P()))
    split = NamedSharding(mesh, P("samples"))

    def many(*rest: Any) -> T:
        count = _samples(rest)
        if is_transformed(rest):
            whole: T = jax.lax.map(lambda sample: function(*first, *sample), rest, batch_size=together)
            return whole
        size = min(together, -(-count // mesh.size)) * mesh.size
        parts = []
        for start in range(0, count, size):
            rows = np.minimum(np.arange(start, start + size), count - 1)  # the last sample fills up the last part
            part = rest if size == count else jax.tree.map(partial(_rows, rows), rest)
            some = jax.device_put(part, split)
            parts.append(jax.tree.map(np.asarray, program(everywhere, some)))
        joined: T = jax.tree.map(lambda *pieces: jnp.asarray(np.concatenate(pieces)[:count]), *parts)
        return joined

    return many


def _samples(rest: tuple[Any, ...]) -> int:
    """How many samples arguments have."""
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(rest)]
    counts = {shape[0] if shape else 0 for shape in shapes}
    if len(counts) != 1 or 0 in counts:
        given = ", ".join(map(str, shapes)) or "none"
        raise ValueError(f"arrays of shapes {given}; give arrays with equally many samples along their first axes")
    return counts.pop()


def _rows(rows: np.ndarray, array: Any) -> Any:
    return array[rows] if isinstance(array, jax.Array) else np.asarray(array)[rows]


@lru_cache(maxsize=64)
def _program(
    function: Callable[..., T], form: Form, flags: tuple[tuple[str, Any], ...], mesh: Mesh
) -> Callable[..., T]:
    """The program of `bind_many`, which models that differ in their numbers only share."""

    def share(arrays: list[Array], samples: tuple[Any, ...]) -> T:
        found: T = jax.vmap(partial(full_precision(function), *form.with_arrays(arrays)))(*samples)
        return found

    # Without the check of replication, because loops in the solver start from constants, which the check takes for
    # equal on all devices.
    shared = jax.shard_map(share, mesh=mesh, in_specs=(P(), P("samples")), out_specs=P("samples"), check_vma=False)
    compiled: Callable[..., T] = jax.jit(shared, compiler_options=dict(flags))
    return compiled
