"""What an error of the untouched sheet makes of the gain of the contact layer that presses show.

Where the sheet is not as the model has it, a contact shows another signal, in all presses at that place alike. No press
tells this from gain: what is learned is the gain with which the model's sheet shows what was read. To first order the
modes of the gain err by B c, where c, standard normal, are the modes of the error of the sheet, and presses at places
all over the sheet tell the gain. With the slopes J of what they show in the modes of the gain and S in those of the
sheet's error, of which all that the place and the width of the contact explain is left out,

    B = (J^T J + 1)^-1 J^T S.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._compile import verb
from ...linalg import lapack
from .contact_filter import ContactFilter, active_indices
from .response import LoadedSheet
from .state import CONTACT_SIZE, LOAD_SIZE

# Distance of presses, in lengths of the field of the gain, and limits of their number along a side.
PITCH_RATIO, GRID_LIMITS = 1.6, (2, 12)
# Unknown parameters of a press: position and log width; pads tell the force.
UNKNOWN_SIZE = 3


def apparent_gain(
    contact_filter: ContactFilter, sheet: LoadedSheet, log_size: Float[np.ndarray, "2"], length: float
) -> Float[np.ndarray, "g c"]:
    """B of the modes of the gain, (g, c), in their standard deviations.

    Args:
        sheet: whose `coat` holds the modes of the sheet's error.
        log_size: log width and log force of a usual load.
        length: of the field of the gain, m.
    """
    modes = sheet.modes.shape[1]
    if not sheet.coat.shape[1]:
        return np.zeros((modes, 0))
    pixels, dtype = np.asarray(sheet.pixels, float), contact_filter.places.dtype
    low, high = pixels.min(0), pixels.max(0)
    counts = np.clip(np.ceil((high - low) / (PITCH_RATIO * length)), *GRID_LIMITS).astype(int)
    axes = [a + (b - a) * (np.arange(n) + 0.5) / n for a, b, n in zip(low, high, counts, strict=True)]
    places = np.stack(np.meshgrid(*axes), -1).reshape(math.prod(counts), 2)
    given = (jnp.asarray(values, dtype) for values in (places, log_size))
    return np.asarray(_apparent_modes(contact_filter, sheet, *given), float)


@verb
def _apparent_modes(
    contact_filter: ContactFilter, sheet: LoadedSheet, places: Float[Array, "n 2"], log_size: Float[Array, "2"]
) -> Float[Array, "g c"]:
    size = sheet.modes.shape[1]

    def normal_equations(place: Float[Array, "2"]) -> tuple[Int[Array, " b"], Float[Array, "b b"], Float[Array, "b c"]]:
        """Modes of the gain that a press informs, and J^T J and J^T S of these."""
        rest = jnp.zeros(CONTACT_SIZE - len(place) - len(log_size), place.dtype)
        contact = jnp.concatenate([place, log_size, rest])[None]
        modes, gain = active_indices(contact_filter, contact)[LOAD_SIZE:] - CONTACT_SIZE, jnp.zeros(size, place.dtype)
        near = sheet.neighbourhood(contact[:, :LOAD_SIZE])
        predicted = sheet.predict_measurement(contact[:, :LOAD_SIZE], gain, modes, near)
        square = predicted.readings @ predicted.readings / len(predicted.readings)
        scale = jnp.sqrt(1 + contact_filter.error_share * square)
        load_slopes = contact_filter.spread[:UNKNOWN_SIZE, None] * predicted.reading_slopes[:UNKNOWN_SIZE] / scale
        root = lapack.cholesky(load_slopes @ load_slopes.T + jnp.eye(UNKNOWN_SIZE, dtype=load_slopes.dtype), lower=True)
        gain_slopes = predicted.reading_slopes[LOAD_SIZE:] / scale
        projected = gain_slopes - (gain_slopes @ load_slopes.T) @ lapack.cho_solve((root, True), load_slopes)
        sheet_slopes = sheet.coat_slopes(contact[:, :LOAD_SIZE], gain, near) / scale
        return modes, projected @ gain_slopes.T, projected @ sheet_slopes.T

    modes, normal, right_side = jax.lax.map(normal_equations, places)
    matrix = jnp.eye(size, dtype=normal.dtype).at[modes[:, :, None], modes[:, None]].add(normal)
    right_side = jnp.zeros((size, right_side.shape[-1]), right_side.dtype).at[modes].add(right_side)
    found: Array = lapack.cho_solve((lapack.cholesky(matrix, lower=True), True), right_side)
    return found
