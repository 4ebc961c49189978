"""Electrodes around the rim of a tank, by their number or their angles."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...budget import require
from ...geometry.shapes import Domain
from .base import ElectrodeError, require_contact
from .edges import BoundaryPatch
from .points import PointElectrode

RAY = 4096  # points on a ray from the middle of the sheet to beyond its rim, before the crossing is bisected


def rim_electrodes(
    domain: Domain,
    places: int | Sequence[float] | Float[np.ndarray, " electrodes"],
    width: float | None = None,
    contact: float = 1e-3,
    *,
    start: float = 0.0,
    clockwise: bool = False,
) -> tuple[BoundaryPatch | PointElectrode, ...]:
    """Electrodes around the rim, in the order of their numbers.

    Args:
        domain: the sheet, such as a `Disc` or a `Polygon`.
        places: number of electrodes at equal distances along the rim, or the angle of each, rad.
        width: along the rim, m; 0: `PointElectrode`; default: half of the distance between electrodes.
        contact: contact impedance of each, ohm m; not for points.
        start: angle of electrode 0, or the angle that ``places`` are counted from, rad. Angles are seen from the middle
            of the sheet, 0 along +x and pi / 2 along +y.
        clockwise: whether electrodes or angles follow each other clockwise.

    Raises:
        ElectrodeError: if there is no electrode, if electrodes overlap, or the middle of the sheet does not lie
            inside it.
    """
    turn = -1.0 if clockwise else 1.0
    if isinstance(places, (int, np.integer)):
        if places < 1:
            raise ElectrodeError(f"{places} electrodes around the rim; give 1 or more")
        require("electrodes", int(places), "rim_electrodes", ElectrodeError)
        pitch = domain.perimeter / places
        middles = _at_angle(domain, start) + turn * pitch * np.arange(places)
    else:
        middles = np.array([_at_angle(domain, start + turn * float(angle)) for angle in places])
        pitch = _least_gap(middles, domain.perimeter)
    width = 0.5 * pitch if width is None else width
    if not 0 <= width < _least_gap(middles, domain.perimeter):
        raise ElectrodeError(
            f"electrodes of {width:.4g} m do not fit {pitch:.4g} m apart along the rim; give a smaller width or fewer"
        )
    require_contact(contact, "ohm m")
    if width == 0:
        return tuple(PointElectrode((float(x), float(y))) for x, y in domain.boundary_point(middles))
    starts = (middles - 0.5 * width) % domain.perimeter
    return tuple(BoundaryPatch(float(s), float(s + width), contact) for s in starts)


def _least_gap(middles: np.ndarray, perimeter: float) -> float:
    around = np.sort(middles % perimeter)
    return float(np.diff(around, append=around[:1] + perimeter).min())


def _at_angle(domain: Domain, angle: float) -> float:
    """Arc length of the outermost rim point that is seen from the middle of the sheet at this angle, m."""
    low, high = np.array(domain.bounds)
    middle, along = (low + high) / 2, np.array([np.cos(angle), np.sin(angle)])
    if not np.isfinite(angle) or not domain.contains(middle[None])[0]:
        raise ElectrodeError(
            f"no place on the rim is seen at {angle} rad from the middle of the sheet, {middle.tolist()} m, which must "
            "lie inside; place electrodes by BoundaryPatch(start, stop)"
        )
    reach = np.linspace(0, np.hypot(*(high - low)), RAY)
    last = int(np.flatnonzero(domain.contains(middle + reach[:, None] * along))[-1])
    inside, outside = reach[last], reach[last + 1]
    for _ in range(50):
        half = (inside + outside) / 2
        inside, outside = (half, outside) if domain.contains((middle + half * along)[None])[0] else (inside, half)
    return float(domain.boundary_coordinate((middle + inside * along)[None])[0])
