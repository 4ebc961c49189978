"""What is known of the sheet before a touch: its conductivity, or a frame of the untouched skin."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..messages.kinds import stated
from ..model.discretisation import Model
from ..model.sheet_conductivity import CoatedSheet
from . import absolute  # which is imported on first use, since its solvers take a tenth of a second
from .inputs import InverseError, as_flags, require_real


def background_of(
    model: Model,
    untouched: Float[ArrayLike, " readings"] | None,
    sigma: Float[Array, " elements"] | None,
    channels: Bool[ArrayLike, " readings"] | None,
) -> Float[Array, " elements"] | None:
    """The conductivity of the untouched sheet, (elements,) S, from what is known of it; None: it is even.

    Raises:
        InverseError: if both a frame and a conductivity are given, or no coating explains the frame.
    """
    if sigma is not None and not hasattr(sigma, "shape") and not isinstance(sigma, CoatedSheet):
        raise InverseError(f"sigma is {stated(sigma)}; give the conductivity of each element, S, as an array")
    frame = untouched_frame(model, untouched, sigma, channels)
    return sigma if frame is None else absolute.untouched_sheet(model, frame)[0]


def untouched_frame(
    model: Model,
    untouched: Float[ArrayLike, " readings"] | None,
    sigma: Float[Array, " elements"] | None,
    channels: Bool[ArrayLike, " readings"] | None,
) -> Float[Array, "..."] | None:
    """The frame to which the sheet is fitted, with NaN for readings that are not used; None without a frame.

    Raises:
        InverseError: if both a frame and a conductivity are given.
    """
    flags = None if channels is None else as_flags(channels, model.readings)
    if untouched is None:
        return None
    if sigma is not None:
        raise InverseError("untouched and sigma both tell the sheet; give one of them")
    require_real(untouched=untouched)
    frame = jnp.asarray(untouched, model.dtype)
    return frame if flags is None or frame.shape != flags.shape else jnp.where(flags, frame, jnp.nan)
