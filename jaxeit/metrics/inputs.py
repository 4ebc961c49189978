"""What figures of merit are given: images with the places of their pixels, and positions on the sheet."""

from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from ..linalg.array_libraries import real_array
from ..messages.kinds import stated

Places: TypeAlias = Float[ArrayLike, "... 2"] | Sequence[float]
"""Positions on the flat sheet, m; a single position may be a list or tuple."""


class MetricError(ValueError):
    """Images that cannot be compared, or a setting out of range."""


@runtime_checkable
class Pictured(Protocol):
    """An object that states the places of the pixels of an image: a reconstructor, a basis map or a picture.

    | meaning                                              | shape       | unit |
    |------------------------------------------------------|-------------|------|
    | centres in the sheet's flat coordinates              | (pixels, 2) | m    |
    | areas on the sheet; zero for a pixel that misses it  | (pixels,)   | m^2  |
    | shape: (rows, columns) of a picture                  |             |      |
    """

    @property
    def centres(self) -> Float[Array, "pixels 2"]:
        """Centres of the pixels in the sheet's flat coordinates, (pixels, 2) m."""

    @property
    def areas(self) -> Float[Array, " pixels"]:
        """Areas of the pixels on the sheet, (pixels,) m^2; zero for a pixel that misses it."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the picture."""


def on_pixels(image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... pixels"]:
    """The image, (..., pixels); MetricError unless it is one of the pixels of ``recon``."""
    if not hasattr(recon, "centres"):
        raise MetricError(f"{stated(recon)} has no pixels; give a reconstructor, or Pixels(20).on(model)")
    image, pixels = real_array("image", image, MetricError), len(recon.centres)
    if image.shape[-1:] != (pixels,):
        raise MetricError(f"image of shape {image.shape}; give (..., {pixels}), one number for each pixel of recon")
    return image


def floating_type(array: Real[Array, "..."]) -> np.dtype[Any]:
    """Type of the array if that is a floating one; else JAX's default."""
    return array.dtype if jnp.issubdtype(array.dtype, jnp.floating) else jnp.result_type(float)
