"""What a mesh must follow at each electrode: a point, a disc or a polygon in the sheet, a stretch of the rim."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from .domain import Domain, Polygon, cross
from .triangles import place


@dataclass(frozen=True)
class PointFootprint:
    """A node exactly at ``position``, (2,) m."""

    position: tuple[float, float]

    def __post_init__(self):
        _require_position("PointFootprint", self.position)


@dataclass(frozen=True)
class DiscFootprint:
    """A regular polygon of the disc's exact area, filled with triangles, and a node at its centre.

    | meaning                                             | shape | unit |
    |-----------------------------------------------------|-------|------|
    | position of the centre                              | (2,)  | m    |
    | radius of the disc, not of the polygon              | ()    | m    |
    | segments: least number of sides; 6 to 12 times a power of two | () | |

    Raises ValueError for other values.
    """

    position: tuple[float, float]
    radius: float
    segments: int = 16

    def __post_init__(self):
        _require_position("DiscFootprint", self.position)
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise ValueError(f"DiscFootprint: radius is {self.radius}; give a positive length in metres")
        if not _halves_to_a_hub(self.segments):
            raise ValueError(
                f"DiscFootprint: segments is {self.segments}; give 6 to 12 times a power of two, "
                "such as 12, 16, 24 or 32, so that the rings inside can halve their nodes"
            )


@dataclass(frozen=True)
class ArcFootprint:
    """Nodes exactly at both ends of the rim from arc length ``start`` to ``stop`` > start, m.

    ``stop`` may exceed the perimeter: the arc then runs on past the origin.
    """

    start: float
    stop: float

    def __post_init__(self):
        if not (np.isfinite(self.start) and np.isfinite(self.stop) and self.start < self.stop):
            raise ValueError(
                f"ArcFootprint: runs from {self.start} to {self.stop} m; give finite arc lengths, "
                "start before stop (an arc across the origin stops past the perimeter)"
            )


@dataclass(frozen=True)
class PolygonFootprint:
    """Edges along the sides of ``outline``, m, nodes at its corners, and triangles inside.

    ``segments`` is how many edges go around it, shared out by length; they may be more, and each side has one or
    more.  Raises ValueError unless it is positive.
    """

    outline: Polygon
    segments: int = 16

    def __post_init__(self):
        if not self.segments > 0:
            raise ValueError(f"PolygonFootprint: segments is {self.segments}; give a positive number of edges")


Footprint = PointFootprint | DiscFootprint | ArcFootprint | PolygonFootprint


def _require_position(what: str, position: tuple[float, float]) -> None:
    if np.shape(position) != (2,) or not np.all(np.isfinite(position)):
        raise ValueError(f"{what}: position is {position}; give two finite numbers in metres")


def _halves_to_a_hub(segments: int) -> bool:
    if segments != int(segments) or segments < 6:
        return False
    while segments > 12 and segments % 2 == 0:
        segments //= 2
    return segments <= 12


def polygon_radius(radius: float, segments: int) -> float:
    """Circumradius in m of the regular polygon with the area of the disc of ``radius`` m."""
    sector = 2 * np.pi / segments
    return float(radius * np.sqrt(sector / np.sin(sector)))


def require_placed(domain: Domain, footprints: Sequence[Footprint]) -> None:
    """ValueError, naming electrodes by their place in the sequence, unless every footprint is
    wholly inside the domain (or on its rim) and apart from all others."""
    _require_inside(domain, footprints)
    _require_apart(domain, footprints)


def _name(index: int, footprint: Footprint) -> str:
    if isinstance(footprint, ArcFootprint):
        return f"electrode {index} (arc {1e3 * footprint.start:.2f} to {1e3 * footprint.stop:.2f} mm)"
    if isinstance(footprint, PolygonFootprint):
        return f"electrode {index} (polygon from {place(footprint.outline.corner_points[0])})"
    kind = "disc" if isinstance(footprint, DiscFootprint) else "point"
    return f"electrode {index} ({kind} at {place(np.asarray(footprint.position))})"


def reach(footprint: PointFootprint | DiscFootprint) -> float:
    """Radius of what is meshed around the position, m."""
    if isinstance(footprint, PointFootprint):
        return 0.0
    return polygon_radius(footprint.radius, footprint.segments)


def rim_gap(shape: Domain, footprint: PointFootprint | DiscFootprint | PolygonFootprint) -> float:
    """Distance in m from a shape's rim to a footprint that does not cross it, on either side."""
    if isinstance(footprint, PolygonFootprint):
        own, others = footprint.outline.corner_points, _corners(shape)
        back = footprint.outline.boundary_distance(others).min(initial=np.inf)
        return float(min(shape.boundary_distance(own).min(), back))
    return float(shape.boundary_distance([footprint.position])[0]) - reach(footprint)


def gap(a: Footprint, b: Footprint) -> float:
    """Distance in m between two footprints that are apart; infinite for arcs, which are of the rim."""
    if isinstance(a, ArcFootprint) or isinstance(b, ArcFootprint):
        return np.inf
    if isinstance(a, PolygonFootprint):
        return rim_gap(a.outline, b)
    if isinstance(b, PolygonFootprint):
        return rim_gap(b.outline, a)
    return float(np.linalg.norm(np.subtract(a.position, b.position))) - reach(a) - reach(b)


def _corners(shape: Domain) -> np.ndarray:
    return shape.boundary_point(shape.corners)


def _require_inside(domain: Domain, footprints: Sequence[Footprint]) -> None:
    for index, footprint in enumerate(footprints):
        if isinstance(footprint, ArcFootprint):
            _require_on_rim(domain, index, footprint)
            continue
        if isinstance(footprint, PolygonFootprint):
            _require_polygon_inside(domain, index, footprint)
            continue
        position = np.asarray([footprint.position], float)
        room = float(domain.boundary_distance(position)[0])
        if not domain.contains(position)[0]:
            raise ValueError(
                f"{_name(index, footprint)} is {1e3 * room:.2f} mm outside the domain; move it "
                "inside (coordinates are metres)"
            )
        if isinstance(footprint, DiscFootprint) and room <= 1.02 * reach(footprint):
            raise ValueError(
                f"{_name(index, footprint)} of radius {1e3 * footprint.radius:.2f} mm is only "
                f"{1e3 * room:.2f} mm from the rim; move it inward or make it smaller so that it "
                "is wholly inside the domain"
            )


def _require_polygon_inside(domain: Domain, index: int, polygon: PolygonFootprint) -> None:
    inside = domain.contains(polygon.outline.corner_points).all() and not _sides_cross(domain, polygon.outline)
    if not inside or rim_gap(domain, polygon) <= domain.tolerance:
        raise ValueError(
            f"{_name(index, polygon)} reaches the rim; move it inward or make it smaller so that it is wholly inside "
            "the domain (coordinates are metres), or give a mesh of your own whose edges follow it"
        )


def _require_on_rim(domain: Domain, index: int, arc: ArcFootprint) -> None:
    if arc.stop - arc.start > domain.perimeter * (1 - 1e-6):
        raise ValueError(
            f"{_name(index, arc)} is longer than the rim, {1e3 * domain.perimeter:.2f} mm; leave a "
            "gap (arc lengths are metres)"
        )


def _require_apart(domain: Domain, footprints: Sequence[Footprint]) -> None:
    for (i, a), (j, b) in combinations(enumerate(footprints), 2):
        if _overlap(domain, a, b):
            raise ValueError(f"{_name(i, a)} and {_name(j, b)} overlap or touch; move them apart")


def _overlap(domain: Domain, a: Footprint, b: Footprint) -> bool:
    if isinstance(a, ArcFootprint) and isinstance(b, ArcFootprint):
        return _in_arc(domain, a, b.start) or _in_arc(domain, b, a.start)
    if isinstance(a, ArcFootprint):
        return _overlap(domain, b, a)
    if isinstance(b, ArcFootprint):
        return _on_arc(domain, a, b)
    if isinstance(a, PolygonFootprint):
        return _in_polygon(a, b) or _too_close(domain, a, b)
    if isinstance(b, PolygonFootprint):
        return _overlap(domain, b, a)
    return _too_close(domain, a, b)


def _too_close(domain: Domain, a: Footprint, b: Footprint) -> bool:
    slack = 0.02 * sum(reach(f) for f in (a, b) if isinstance(f, DiscFootprint))
    return gap(a, b) <= slack + domain.tolerance


def _in_polygon(polygon: PolygonFootprint, other: PointFootprint | DiscFootprint | PolygonFootprint) -> bool:
    """Whether another footprint is inside the polygon, its sides cross it, or it holds the polygon."""
    outline = polygon.outline
    if not isinstance(other, PolygonFootprint):
        return bool(outline.contains([other.position])[0])
    nested = outline.contains(other.outline.corner_points).any() or other.outline.contains(outline.corner_points).any()
    return bool(nested) or _sides_cross(outline, other.outline)


def _sides_cross(a: Domain, b: Domain) -> bool:
    """Whether any straight sides of two shapes cross within both; merely to touch is not to cross."""
    p, q = _corners(a), _corners(b)
    along_p, along_q = np.roll(p, -1, 0) - p, np.roll(q, -1, 0) - q
    offset = q - p[:, None]
    beside_p, beside_q = cross(along_p[:, None], offset), cross(offset, along_q)
    return bool(((beside_p * np.roll(beside_p, -1, 1) < 0) & (beside_q * np.roll(beside_q, -1, 0) < 0)).any())


def _on_arc(domain: Domain, footprint: PointFootprint | DiscFootprint | PolygonFootprint, arc: ArcFootprint) -> bool:
    if isinstance(footprint, PolygonFootprint) or rim_gap(domain, footprint) > domain.tolerance:
        return False
    return _in_arc(domain, arc, float(domain.boundary_coordinate([footprint.position])[0]))


def _in_arc(domain: Domain, arc: ArcFootprint, s: float) -> bool:
    """Whether s is on the arc, ends included; neighbours that touch would share a node."""
    slack = 2 * domain.tolerance
    return (s - arc.start + slack) % domain.perimeter <= arc.stop - arc.start + 2 * slack
