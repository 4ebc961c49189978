"""A strip in one dimension: between its ends, and with area patches from edge to edge.

The sheet, of width W and sheet resistance R_s, carries the current ``I = -(W / R_s) u'`` along the
strip.  Between patches ``u'' = 0``; under a patch of potential U and specific contact resistance rho,

    u'' = (u - U) / L^2,        L = sqrt(rho / R_s)  (the transfer length),

whose solution over ``|x - m| <= h`` is  ``U + A cosh((x - m) / L) + B sinh((x - m) / L)``.  With u_a, I_a
at its left rim and u_b, I_b at its right one, the odd part gives what passes beneath the patch and
the even part what the patch feeds to both sides, ``J = I_b - I_a``:

    u_a - u_b           = (R_s / W) 2 L tanh(h / L) (I_a + I_b) / 2,
    U - (u_a + u_b) / 2 = (R_s / W) (L / 2) coth(h / L) J.

What flows in a gap is the sum of the currents driven in to its left, so the potentials follow by a
walk along the strip.  A patch without net current shunts the sheet: its drop falls from ``2 R_s h / W``
(no contact) to zero (a perfect one).
"""

from typing import NamedTuple

import numpy as np


class Patch(NamedTuple):
    """A patch across the whole strip, from ``start`` to ``stop``, of contact resistance rho (0: perfect)."""

    start: float
    stop: float
    rho: float


def between_ends(length: float, width: float, sheet_resistance: float, z1: float, z2: float) -> float:
    """Resistance between electrodes along both ends, of contact impedances z1 and z2 (ohm m)."""
    return sheet_resistance * length / width + (z1 + z2) / width


def between_two_patches(gap: float, size: float, width: float, sheet_resistance: float, rho: float) -> float:
    """Resistance between two area patches, each ``size`` long, with ``gap`` between their inner rims."""
    transfer = np.sqrt(rho / sheet_resistance)
    return sheet_resistance / width * (gap + 2 * transfer / np.tanh(size / transfer))


def potentials(patches: list[Patch], currents: list[float], width: float, sheet_resistance: float) -> np.ndarray:
    """Potential of each patch, up to a constant, for ``currents`` (sum zero) driven into them from left to right."""
    found, level, flow, end = [], 0.0, 0.0, patches[0].start
    for (start, stop, rho), current in zip(patches, currents, strict=True):
        level -= sheet_resistance / width * flow * (start - end)
        transfer, half = np.sqrt(rho / sheet_resistance), 0.5 * (stop - start)
        t = np.tanh(half / transfer) if rho else 1.0
        fall = sheet_resistance / width * 2 * transfer * t * (flow + current / 2)
        found.append(level - fall / 2 + sheet_resistance / width * transfer / (2 * t) * current)
        level, flow, end = level - fall, flow + current, stop
    return np.array(found)


def reading(patches: list[Patch], row: list[int], width: float, sheet_resistance: float) -> float:
    """Volts per ampere of one row (drive+, drive-, sense+, sense-)."""
    source, sink, plus, minus = row
    currents = [float(k == source) - float(k == sink) for k in range(len(patches))]
    u = potentials(patches, currents, width, sheet_resistance)
    return float(u[plus] - u[minus])
