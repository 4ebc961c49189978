"""Frames of fits through the full forward map: what is checked of them, and the errors of their readings."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..._compile import is_traced, verb
from ..inputs import InverseError, require_real

# Smallest error of a reading, as a fraction of the root mean square of all: no reading is modelled better.
ERROR_FLOOR = 1e-3
# Largest fraction of the readings that may stay unexplained. A larger one means another skin, another order of the
# readings or a wrong polarity.
MAX_UNEXPLAINED = 0.1


def checked_frame(name: str, values: Any, even: Float[Array, " readings"]) -> Float[Array, " readings"]:
    """The frame that was given as an argument of this name, in the precision of ``even``, the model's readings.

    Raises:
        InverseError: with the name of the argument, unless it is one frame of real readings, some finite and not zero.
    """
    require_real(**{name: values})
    frame = jnp.asarray(values, even.dtype)
    require_frame(name, frame, even)
    return frame


def require_frame(name: str, frame: Float[Array, "..."], even: Float[Array, " readings"]) -> None:
    """Raise InverseError unless a frame has the readings of the model, ``even``, and tells something."""
    if frame.shape != even.shape:
        raise InverseError(f"{name} has shape {frame.shape}; give the {len(even)} readings of one frame")
    if not is_traced(frame) and not np.any(np.nan_to_num(frame, posinf=0, neginf=0)):
        raise InverseError(f"{name} has no reading that is finite and not zero")


def checked_errors(name: str, values: Any, even: Float[Array, " readings"]) -> Float[Array, " readings"]:
    """Standard errors of the readings, in the precision of ``even``, the model's readings.

    An error that is not finite leaves its reading out. One of zero or less that JAX hides does so too.

    Raises:
        InverseError: with the name of the argument, unless there is one for each reading, none of zero or less.
    """
    require_real(**{name: values})
    errors = jnp.asarray(values, even.dtype)
    if errors.shape != even.shape:
        raise InverseError(f"{name} has shape {errors.shape}; give the standard error of each of {len(even)} readings")
    if not is_traced(errors) and np.any(wrong := np.asarray(errors) <= 0):
        raise InverseError(
            f"{name} of reading {int(np.argmax(wrong))} is {errors[np.argmax(wrong)]:g} V; give a standard error above "
            "zero, or NaN to leave the reading out"
        )
    return errors


def sheet_level(name: str, frame: Float[Array, " readings"], even: Float[Array, " readings"]) -> Float[Array, ""]:
    """Conductivity of the even sheet nearest to a frame, over that of the model; ``even``: the model's readings.

    Raises:
        InverseError: with the name of the argument, if the frame has the opposite sign.
    """
    level: Float[Array, ""] = _level(frame, even)
    if not is_traced(level) and not float(level) > 0:
        raise InverseError(f"{name} has the opposite sign of the model's readings; reverse its polarity")
    return level


@verb
def _level(v0: Float[Array, " readings"], even: Float[Array, " readings"]) -> Float[Array, ""]:
    there = jnp.isfinite(v0)
    return jnp.sum(jnp.where(there, even**2, 0)) / (even @ jnp.where(there, v0, 0))


@verb
def frame_error(v0: Float[Array, " readings"], model_error: Float[ArrayLike, ""]) -> Float[Array, " readings"]:
    """Standard error of each reading of an untouched frame: a part of itself, and a thousandth of their rms."""
    there = jnp.isfinite(v0)
    known = jnp.where(there, v0, 0)
    floor = ERROR_FLOOR * jnp.sqrt(known @ known / jnp.sum(there, dtype=known.dtype))
    return jnp.hypot(model_error * known, floor)


def require_positive(**values: Any) -> None:
    """Raise InverseError, with the name of the value, unless every value that is known is above zero."""
    for name, value in values.items():
        if not is_traced(value) and not 0 < value < np.inf:
            raise InverseError(f"{name} is {value}; give a number above zero")


def require_steps(steps: int, tolerance: Any = 0.0) -> None:
    """Raise InverseError unless a fit of so many steps, to such a tolerance, can be made."""
    if not isinstance(steps, int | np.integer) or isinstance(steps, bool) or steps < 1:
        raise InverseError(f"steps is {steps}; give a whole number above zero")
    if not is_traced(tolerance) and not 0 <= tolerance < np.inf:
        raise InverseError(f"tolerance is {tolerance}; give a number of zero or more, such as 2e-3")


@verb
def _relative_misfit(
    found: Float[Array, " readings"], known: Float[Array, " readings"], there: Bool[Array, " readings"]
) -> Float[Array, ""]:
    left: Array = jnp.linalg.norm(jnp.where(there, found - known, 0)) / jnp.linalg.norm(known)
    return left


def require_explained(
    name: str,
    what: str,
    found: Float[Array, " readings"],
    known: Float[Array, " readings"],
    there: Bool[Array, " readings"],
    hint: Callable[[], str] = str,
) -> None:
    """Raise InverseError if too much of a frame is left by the readings that were found for it.

    Args:
        name: of the argument that is the frame.
        what: kind of content that was fitted.
        hint: what ends the message, asked for where there is one.
    """
    left: Array = _relative_misfit(found, known, there)
    if not is_traced(left) and not float(left) < MAX_UNEXPLAINED:
        raise InverseError(
            f"no {what} explains {name}: {left:.0%} of it is left; give a frame of this skin, readings in the order of "
            f"the skin's protocol{hint()}"
        )
