"""Distances to the walls of pads at which nothing was pressed, though a field of these distances bends there.

Presses on a grid that is aligned with the walls have few distances to walls. Between these a field follows its basis
and not the pads, and so do its errors: on a simulated testbed with a grid of 12 x 12, whose presses lie 10 and 24 mm
from the walls, forces 14 to 18 mm from a wall were 5 to 11 % too large, and 90 % intervals covered 70 % of them.
`edge-spline` errs less there, unless the walls act on a shorter distance than the lines are apart: no grid tells that.
"""

import numpy as np
from jaxtyping import Array, Float

import jaxeit as je

from ..curves.samples import by_rows
from . import FittedField, Geometry, PadEdge, PadEdgeSpline, Places
from .geometry import onto_pads
from .pad_edge import wall_distances

# Least gap between two distances, in octaves, that is reported: the grid above has 0.68 to 0.71, one of 15 x 15, whose
# intervals hold, 0.60, and scattered presses have 0.1 to 0.2. Octave beyond which walls have little effect.
MIN_GAP_OCTAVES, MAX_WALL_OCTAVES = 0.65, 2.0
GAP_SHARE = 0.03  # of the presses that may lie in a gap, because their places are estimates
MIN_PAD_SHARE = 0.9  # least share of a pad in a press that informs on its walls


def unpressed_note(field: FittedField | None, places: Places | None, share: Float[np.ndarray, "n pads"]) -> str:
    """What the operator should know of distances to walls without presses, in one line; empty for nothing.

    Args:
        places: of the presses.
        share: of each pad in a press, (presses, pads).
    """
    if field is None or places is None or not isinstance(field.field, PadEdge):
        return ""
    metres = np.sort(_wall_distances(field.geometry, places, share))
    octaves, few = np.log2(1 + metres / float(field.field.width)), max(1, round(GAP_SHARE * len(metres)))
    gaps = np.where(octaves[:-few] < MAX_WALL_OCTAVES, octaves[few:] - octaves[:-few], 0)
    if gaps.max(initial=0) < MIN_GAP_OCTAVES:
        return ""
    better = "" if isinstance(field.field, PadEdgeSpline) else "calibrate with --location edge-spline, or "
    low, high = 1e3 * metres[[gaps.argmax(), gaps.argmax() + few]]
    return (
        f"hardly a press lies {low:.0f} to {high:.0f} mm from the walls of its pad, where the correction by location "
        f"bends most: forces there may err by more than is stated; {better}press also at places on no grid along the "
        "walls"
    )


def _wall_distances(geometry: Geometry, places: Places, share: Float[np.ndarray, "n pads"]) -> Float[np.ndarray, " m"]:
    """Distance of each press that rests on one pad to the nearest side of that pad, m."""
    own = by_rows(_side_distances, places.position[:, 0], before=(geometry,))[np.nan_to_num(share) >= MIN_PAD_SHARE]
    found: np.ndarray = own[np.isfinite(own)]
    return found


@je.verb
def _side_distances(geometry: Geometry, position: Float[Array, "n 2"]) -> Float[Array, "n pads"]:
    """Distance of each pad's nearest side to the point of the pad that is nearest to a position, m."""
    return wall_distances(geometry, onto_pads(geometry, position))[0].min(-1)
