"""Distances to the walls of pads at which nothing was pressed, though a field of these distances bends there.

Presses on a grid that is aligned with the walls have few distances to walls. Between these a field follows its basis
and not the pads, and so do its errors: on a simulated testbed with a grid of 12 x 12, whose presses lie 10 and 24 mm
from the walls, forces 14 to 18 mm from a wall were 5 to 11 % too large, and 90 % intervals covered 70 % of them.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .fields import FittedField, PadEdge
from .fields.geometry import distance, nearest_points, onto_pads
from .pads import LocatedPresses

# Octaves between two distances that are worth a word: the grid above has 0.68 to 0.71, one of 15 x 15, whose intervals
# hold, 0.60, and scattered presses have 0.1 to 0.2. And the octave from which on walls hardly matter.
WIDE, FAR = 0.65, 2.0
FEW = 0.03  # part of the presses that may lie between, because their places are estimates
WHOLE = 0.9  # part of a press on one pad, from which the press tells of its walls


def unpressed_note(field: FittedField | None, presses: LocatedPresses) -> str:
    """What the operator should know of distances to walls without presses, in one line; empty for nothing."""
    if field is None or not isinstance(field.field, PadEdge) or presses.places is None:
        return ""
    width = float(field.field.width)
    metres = np.sort(wall_distances(presses))
    octaves, few = np.log2(1 + metres / width), max(1, round(FEW * len(metres)))
    gaps = np.where(octaves[:-few] < FAR, octaves[few:] - octaves[:-few], 0)
    if gaps.max(initial=0) < WIDE:
        return ""
    low, high = 1e3 * metres[[gaps.argmax(), gaps.argmax() + few]]
    return (
        f"hardly a press lies {low:.0f} to {high:.0f} mm from the walls of its pad, where the correction by location "
        "bends most: forces there may err by more than is stated; press also at places on no grid along the walls"
    )


def wall_distances(presses: LocatedPresses) -> Float[np.ndarray, " m"]:
    """Distance of each press that rests on one pad to the nearest side of that pad, m."""
    assert presses.places is not None
    geometry, share = presses.geometry, np.asarray(presses.data.share)
    place = onto_pads(geometry, presses.places.position[:, 0])
    to_sides = distance(nearest_points(place, geometry.start, geometry.end), place[..., None, :])
    real = jnp.any(geometry.start != geometry.end, -1)
    nearest = np.asarray(jnp.min(jnp.where(real, to_sides, jnp.inf), -1))
    own = nearest[np.arange(len(share)), np.nan_to_num(share).argmax(1)]
    found: np.ndarray = own[(share >= WHOLE).any(1) & np.isfinite(own)]
    return found
