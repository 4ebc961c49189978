"""Samples of pressure and force as a fit takes them, made from the arrays of users."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxeit.messages.kinds import require_unmasked

from ..results import FitError

Numbers = ArrayLike | Sequence[Any]
"""Numbers from a user: an array, a number, or a list of either."""


class Samples(eqx.Module):
    """Samples of one pad, or of several with a leading pad axis. Values that are not `valid` are ignored.

    | field    | meaning                                    | shape | unit |
    |----------|--------------------------------------------|-------|------|
    | pressure | baseline removed (or `AbstractCurve.seen`) | (n,)  | Pa   |
    | force    | baseline removed                           | (n,)  | N    |
    | sigma    | relative (or absolute) noise of the force  | (n,)  | 1, N |
    | valid    | use this sample                            | (n,)  |      |
    | group    | press of the sample, from 0                | (n,)  |      |
    """

    pressure: Float[Array, "..."]
    force: Float[Array, "*pads n"]
    sigma: Float[Array, "*pads n"]
    valid: Bool[Array, "*pads n"]
    group: Int[Array, "*pads n"]


def bucket(n: int) -> int:
    """The least of the lengths 64, 96, 128, 192, 256, ... that holds n, so that compiled programs are reused."""
    power = 1 << max(n - 1, 63).bit_length()
    return power * 3 // 4 if n <= power * 3 // 4 else power


def by_rows(program: Callable[..., Any], *rows: Any, before: tuple[Any, ...] = ()) -> Any:
    """``program(*before, *rows)`` on the host, of arrays whose rows belong together and whose results do too.

    The last row is repeated up to a `bucket`, so that sessions with other numbers of presses share compiled programs;
    one row stays alone, as live readings come.
    """
    count = len(jax.tree.leaves(rows)[0])
    index = np.arange(count) if count < 2 else np.minimum(np.arange(bucket(count)), count - 1)
    wide = jax.device_put(jax.tree.map(lambda part: np.asarray(part)[index], rows))
    return jax.tree.map(lambda part: np.asarray(part)[:count], program(*before, *wide))


def make_samples(
    pressures: Any, forces: Any, *, mask: Any = None, groups: Any = None, sigma: Any = None, dtype: Any = None,
    length: int | None = None,
) -> tuple[Samples, int]:  # fmt: skip
    """Host arrays -> `Samples` with a leading pad axis, and the number of groups (0: none given).

    Args:
        groups: integers or labels of any kind; they are numbered from 0 in sorted order.
        length: number of samples to fill up to, with samples that are not valid.
    """
    p = _numbers(pressures, "pressures", dtype)
    if p.ndim != 2:
        raise FitError(f"pressures must be (pads, samples), not {p.shape}.")
    shape = p.shape
    f = _broadcast(_numbers(forces, "forces", dtype), shape, "forces")
    s = _broadcast(_numbers(1.0 if sigma is None else sigma, "sigma", dtype), shape, "sigma")
    if not (np.isfinite(s) & (s > 0)).all():
        raise FitError("sigma must be finite and above zero for every sample; use mask to leave samples out.")
    valid = np.isfinite(p) & np.isfinite(f) if mask is None else _broadcast(np.asarray(mask, bool), shape, "mask")
    labels, index = np.unique(np.zeros(1) if groups is None else groups, return_inverse=True)
    group = _broadcast(index.reshape(np.shape(groups) or (1,)).astype(np.int32), shape, "groups")
    extra = max((length or 0) - shape[1], 0)
    own = p.dtype
    parts = (p, 0), (f.astype(own), 0), (s.astype(own), 1), (valid, False), (group, 0)
    wide = (np.pad(part, ((0, 0), (0, extra)), constant_values=filler) for part, filler in parts)
    return Samples(*jax.device_put(tuple(wide))), 0 if groups is None else len(labels)


def _numbers(values: Any, what: str, dtype: Any) -> np.ndarray:
    """An array of `dtype` (None: the precision of the values). A silent loss of precision is refused."""
    if dtype is not None and jax.dtypes.canonicalize_dtype(dtype) != np.dtype(dtype):
        raise FitError("dtype is float64 but JAX has 64-bit numbers off; set JAX_ENABLE_X64=1 or give float32.")
    require_unmasked({what: values}, FitError)
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise FitError(f"{what} must be numbers, not {array.dtype}.")
    own = np.float64 if array.dtype.kind in "iu" else array.dtype
    return array.astype(jax.dtypes.canonicalize_dtype(own if dtype is None else dtype), copy=False)


def _broadcast(array: np.ndarray, shape: tuple[int, ...], what: str) -> np.ndarray:
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise FitError(f"{what} has shape {array.shape}; pressures have (pads, samples) = {shape}.") from None
