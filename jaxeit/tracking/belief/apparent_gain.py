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
from .filter import CONTACT_SIZE, SEEN_SIZE, ContactFilter, active_numbers
from .response import LoadedSheet

# Distance of the places, in lengths of the field of the gain, and their least and largest number along a side.
APART, ALONG = 1.6, (2, 12)
# Numbers of a contact that presses do not tell: place and log width; pads tell the force.
UNTOLD = 3


def apparent_gain(
    contact_filter: ContactFilter, sheet: LoadedSheet, usual: Float[np.ndarray, "2"], length: float
) -> Float[np.ndarray, "g c"]:
    """B of the modes of the gain, (g, c), in their standard deviations.

    Args:
        sheet: whose `coat` holds the modes of the sheet's error.
        usual: log width and log force of a usual load.
        length: of the field of the gain, m.
    """
    modes = sheet.modes.shape[1]
    if not sheet.coat.shape[1]:
        return np.zeros((modes, 0))
    pixels, exact = np.asarray(sheet.pixels, float), contact_filter.places.dtype
    low, high = pixels.min(0), pixels.max(0)
    counts = np.clip(np.ceil((high - low) / (APART * length)), *ALONG).astype(int)
    axes = [a + (b - a) * (np.arange(n) + 0.5) / n for a, b, n in zip(low, high, counts, strict=True)]
    places = np.stack(np.meshgrid(*axes), -1).reshape(math.prod(counts), 2)
    given = (jnp.asarray(values, exact) for values in (places, usual))
    return np.asarray(_apparent(contact_filter, sheet, *given), float)


@verb
def _apparent(
    contact_filter: ContactFilter, sheet: LoadedSheet, places: Float[Array, "n 2"], usual: Float[Array, "2"]
) -> Float[Array, "g c"]:
    size = sheet.modes.shape[1]

    def told(place: Float[Array, "2"]) -> tuple[Int[Array, " b"], Float[Array, "b b"], Float[Array, "b c"]]:
        """Modes that a press tells of, and J^T J and J^T S of these."""
        contact = jnp.concatenate([place, usual, jnp.zeros(CONTACT_SIZE - len(place) - len(usual), place.dtype)])[None]
        modes, none = active_numbers(contact_filter, contact)[SEEN_SIZE:] - CONTACT_SIZE, jnp.zeros(size, place.dtype)
        near = sheet.near(contact[:, :SEEN_SIZE])
        shown = sheet.shown(contact[:, :SEEN_SIZE], none, modes, near)
        square = shown.readings @ shown.readings / len(shown.readings)
        scale = jnp.sqrt(1 + contact_filter.error_share * square)
        own = contact_filter.spread[:UNTOLD, None] * shown.reading_slopes[:UNTOLD] / scale
        root = lapack.cholesky(own @ own.T + jnp.eye(UNTOLD, dtype=own.dtype), lower=True)
        of_gain = shown.reading_slopes[SEEN_SIZE:] / scale
        rest = of_gain - (of_gain @ own.T) @ lapack.cho_solve((root, True), own)
        by_sheet = sheet.coat_slopes(contact[:, :SEEN_SIZE], none, near) / scale
        return modes, rest @ of_gain.T, rest @ by_sheet.T

    modes, normal, towards = jax.lax.map(told, places)
    whole = jnp.eye(size, dtype=normal.dtype).at[modes[:, :, None], modes[:, None]].add(normal)
    right = jnp.zeros((size, towards.shape[-1]), towards.dtype).at[modes].add(towards)
    found: Array = lapack.cho_solve((lapack.cholesky(whole, lower=True), True), right)
    return found
