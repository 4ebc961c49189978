"""What images are made from: frames, flags and numbers of a noise, refused where they are none."""

from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from .._compile import is_traced
from ..messages.kinds import require_unmasked, stated
from ..registry.limits import NO_NUMBERS


class InverseError(ValueError):
    """Settings from which no reconstruction can be made."""


class ConvergenceError(InverseError):
    """A fit that does not find its end."""


def known_flags(channels: Any, readings: int) -> np.ndarray:
    """One flag per reading, whose values decide shapes and so must be known."""
    if is_traced(channels):
        raise InverseError(
            "jit, grad or vmap hides the values of channels, which decide the shapes of a reconstruction; give them as "
            "a NumPy array from outside the transformed function, or use Reconstructor.without"
        )
    return np.asarray(as_flags(channels, readings))


def as_flags(channels: Any, readings: int) -> Any:
    """One flag per reading; of JAX where it traces them, else of NumPy. Indices of readings are no flags."""
    require_unmasked({"channels": channels}, InverseError, "False")
    flags = channels if is_traced(channels) else _array_of(channels)
    if flags.dtype != bool:
        raise InverseError(
            f"channels is {flags.dtype} of shape {flags.shape}; give booleans, one for each of {readings} readings: of "
            f"indices np.isin(np.arange({readings}), channels), of zeros and ones channels.astype(bool)"
        )
    if flags.shape != (readings,):
        raise InverseError(
            f"channels has shape {flags.shape}; this model has {readings} readings: give a boolean for each"
        )
    return flags


def require_frames(dv: Float[ArrayLike, "..."], readings: int) -> None:
    """Refuse arrays that are not frames of so many real readings."""
    if np.shape(dv)[-1:] != (readings,):
        raise InverseError(f"dv has shape {np.shape(dv)}; its last axis must hold {readings} readings")
    require_real(dv=dv)


def require_real(**frames: Any) -> None:
    """Refuse frames of texts, masked frames, and complex ones: a conversion to float would leave out the mask, or the
    imaginary part, silently."""
    require_unmasked(frames, InverseError)
    for name, frame in frames.items():
        if not hasattr(frame, "dtype") and is_traced(frame):
            continue  # a list of hidden numbers
        kind = (frame if hasattr(frame, "dtype") else _array_of(frame)).dtype.kind
        if kind == "c":
            raise InverseError(f"{name} is complex, and a model is real; give {name}.real, or {name}.imag by itself")
        if kind in NO_NUMBERS + "b":
            raise InverseError(f"{name} is {stated(frame)}; give real numbers, V")


def real_numbers(name: str, values: Any, unit: str) -> np.ndarray:
    """Values that are known, as an array of float64; refused unless they are real numbers, none of them masked."""
    require_unmasked({name: values}, InverseError)
    found = _array_of(values)
    if found.dtype.kind in NO_NUMBERS:
        kind = "complex" if found.dtype.kind == "c" else stated(values)
        raise InverseError(f"{name} is {kind}; give real numbers, {unit}")
    return found.astype(float, copy=False)


def _array_of(values: Any) -> np.ndarray:
    """Known values as an array; one of objects where their rows have unequal lengths."""
    try:
        return np.asarray(values)
    except ValueError:
        return np.array(None)


def require_some(used: Any) -> Any:
    """Refuse flags none of which is set; flags whose values JAX hides pass."""
    if not is_traced(used) and not np.any(used):
        raise InverseError("every channel is left out: there is nothing to reconstruct from")
    return used
