"""How evenly a sheet responds to equal touches: the integral of an image, and the spread of such numbers."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._compile import full_precision, verb
from ..linalg.array_libraries import real_array
from ..messages.kinds import shown
from .inputs import MetricError
from .place_errors import length


@full_precision
def image_sum(image: Float[ArrayLike, "... pixels"], areas: Float[ArrayLike, " pixels"]) -> Float[Array, "..."]:
    """Integral of the image (..., pixels) S over the sheet, (...) S m^2, by the areas of the pixels (pixels,) m^2."""
    return jnp.asarray(image) @ jnp.asarray(areas)


def coefficient_of_variation(values: Float[ArrayLike, "... n"], *, ddof: int) -> Float[Array, "..."]:
    """Standard deviation over mean along the last axis.

    NaN where the mean is zero, and for a single value with ``ddof=1``, for which the standard deviation is undefined.

    Args:
        values: (..., n).
        ddof: degrees of freedom subtracted for the mean, 0 or 1; required, since results differ.

    Example:
        sums = je.metrics.image_sum(images, recon.areas)  # S m^2
        print(je.metrics.coefficient_of_variation(sums, ddof=1))  # of equal touches at several places
    """
    numbers = real_array("values", values, MetricError)
    if ddof not in (0, 1) or not numbers.shape[-1:] > (0,):
        raise MetricError(
            f"values of shape {numbers.shape} with ddof={shown(ddof)}; give (..., n) values, and 0 or 1 for ddof"
        )
    found: Array = _variation(numbers, ddof)
    return found


@verb
def _variation(values: Float[Array, "... n"], ddof: int) -> Float[Array, "..."]:
    mean = jnp.mean(values, -1)
    spread = length(values - mean[..., None]) / jnp.sqrt(values.shape[-1] - ddof)
    return jnp.where(mean == 0, jnp.nan, spread / jnp.where(mean == 0, 1, mean))
