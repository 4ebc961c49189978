"""How far estimated places are from the true ones, and how far towards the centre of the sheet."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._compile import verb
from ..linalg.array_libraries import real_array
from .inputs import MetricError, Places


def localisation_error(estimated: Places, true: Places) -> Float[Array, "..."]:
    """Distance between estimated and true positions, (..., 2) m each; (...) m, with a gradient of zero at zero.

    Raises:
        MetricError: if the positions are not pairs, or as many of them as fit each other.
    """
    found, wanted = (real_array("positions", each, MetricError) for each in (estimated, true))
    try:
        np.broadcast_shapes(found.shape, wanted.shape)
        pairs = found.shape[-1:] == wanted.shape[-1:] == (2,)
    except ValueError:
        pairs = False
    if not pairs:
        raise MetricError(
            f"positions of shapes {found.shape} and {wanted.shape}; give (..., 2) m, as many true as estimated ones"
        )
    return _distance(found, wanted)


@verb
def _distance(found: Float[Array, "..."], wanted: Float[Array, "..."]) -> Float[Array, "..."]:
    return length(found - wanted)


@verb
def length(vector: Float[Array, "... n"]) -> Float[Array, "..."]:
    """Euclidean length, with a gradient of zero (not NaN) at zero."""
    square = jnp.sum(vector**2, -1)
    return jnp.where(square == 0, 0, jnp.sqrt(jnp.where(square == 0, 1, square)))


def inward_bias(
    estimated: Places, true: Places, centre: Float[ArrayLike, "2"] | Sequence[float]
) -> Float[Array, "..."]:
    """Shift of the estimate towards the sheet's centre, m; negative if outward.

    The position error PE of the GREIT figures of merit, with the origin at ``centre``.

    Example:
        found = je.metrics.Peak()(images, recon)
        print(je.metrics.inward_bias(found, places, [0.1, 0.1]))  # m, above 0: inward
    """
    return localisation_error(true, centre) - localisation_error(estimated, centre)
