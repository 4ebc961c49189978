"""The outlines of electrodes: a point, a disc or a polygon in the sheet, a part of its rim; each is one class."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..geometry.shapes import Domain, Polygon
from .footprints import (
    NO_POINTS,
    AbstractFootprint,
    Feature,
    cycle,
    require_centre_inside,
    require_disc_inside,
    require_position,
    sides_cross,
)
from .sizes import SizeField, divide_rim, narrow_places
from .triangles import MeshError, place

MAX_OUTLINE_EDGES = 2000
"""Largest number of edges around one polygon: checks of an outline compare all pairs of its sides."""

MAX_EDGE_EXCESS = 1.3
"""Largest edge of a round outline, over the wanted length; above it the number of edges is doubled."""


DISC_SPACING = 0.4
"""Least distance of free nodes from a disc, over the wanted edge length."""


@dataclass(frozen=True)
class PointFootprint(AbstractFootprint):
    """A node exactly at ``position``, (2,) m."""

    position: tuple[float, float]

    def __post_init__(self) -> None:
        require_position("PointFootprint", self.position)

    @property
    def label(self) -> str:
        return f"point at {place(np.asarray(self.position))}"

    @property
    def corners(self) -> np.ndarray:
        return np.asarray([self.position], float)

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(points - self.corners, axis=1))

    def require_inside(self, domain: Domain, name: str) -> None:
        require_centre_inside(domain, name, self.position)

    def rim_positions(self, domain: Domain) -> list[float]:
        return domain.boundary_coordinate(self.corners).tolist() if self._is_on_rim(domain) else []

    def features(self, domain: Domain, longest: float, shortest: float) -> list[Feature]:
        return [Feature(self.corners[0], 0.0, shortest)]

    def nodes(self, domain: Domain) -> np.ndarray:
        return NO_POINTS if self._is_on_rim(domain) else self.corners

    def _is_on_rim(self, domain: Domain) -> bool:
        return bool(domain.boundary_distance(self.corners)[0] <= domain.tolerance)


@dataclass(frozen=True)
class DiscFootprint(AbstractFootprint):
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

    def __post_init__(self) -> None:
        require_position("DiscFootprint", self.position)
        if not (np.isfinite(self.radius) and self.radius > 0):
            raise ValueError(f"DiscFootprint: radius is {self.radius}; give a positive length in metres")
        if not _halves_to_a_hub(self.segments):
            raise ValueError(
                f"DiscFootprint: segments is {self.segments}; give 6 to 12 times a power of two, "
                "such as 12, 16, 24 or 32, so that the rings inside can halve their nodes"
            )

    @property
    def label(self) -> str:
        return f"disc at {place(np.asarray(self.position))}"

    @property
    def corners(self) -> np.ndarray:
        return np.asarray([self.position], float)

    @property
    def reach(self) -> float:
        return polygon_radius(self.radius, self.segments)

    @property
    def rim(self) -> np.ndarray:
        """Corners (segments, 2) m of the polygon, counter-clockwise from angle 0."""
        return np.asarray(self.position) + self.reach * _regular_polygon(self.segments)

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(points - self.position, axis=1) - self.reach)

    def require_inside(self, domain: Domain, name: str) -> None:
        require_disc_inside(domain, name, self.position, self.radius, self.reach)

    def subdivided(
        self, domain: Domain, others: Sequence[AbstractFootprint], edge_length: float, slope: float
    ) -> "DiscFootprint":
        room = min([self.rim_gap(domain), *map(self.gap, others)])
        return replace(self, segments=enough_segments(self.radius, self.segments, min(edge_length, room)))

    def features(self, domain: Domain, longest: float, shortest: float) -> list[Feature]:
        return [Feature(self.corners[0], self.reach, min(2 * np.pi * self.radius / self.segments, longest))]

    def nodes(self, domain: Domain) -> np.ndarray:
        """Rings from the polygon inward, each with half the nodes of the ring around it, and a node at the centre."""
        count, radius, rings = self.segments, self.reach, []
        while True:
            rings.append(radius * _regular_polygon(count))
            if count <= 8 or count % 2:
                break
            # A gap as wide as an edge of the ring balances the angles of the triangles on either side.
            radius, count = radius * (1 - 2.0 * np.sin(np.pi / count)), count // 2
        return np.asarray(np.asarray(self.position) + np.concatenate([*rings, np.zeros((1, 2))]))

    def edges(self) -> np.ndarray:
        return cycle(self.segments)

    def leaves_room(self, points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        return self.distance(points) > DISC_SPACING * wanted


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


def _regular_polygon(count: int) -> np.ndarray:
    """Corners (count, 2) of the regular polygon on the unit circle, counter-clockwise from angle 0."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def enough_segments(radius: float, segments: int, edge: float) -> int:
    """The number of segments, doubled until those of a circle are about as short as ``edge``; lengths in m."""
    while 2 * np.pi * radius / segments > MAX_EDGE_EXCESS * edge:
        segments *= 2
    return segments


@dataclass(frozen=True)
class ArcFootprint(AbstractFootprint):
    """Nodes exactly at both ends of the rim from arc length ``start`` to ``stop`` > start, m.

    ``stop`` may exceed the perimeter: the arc then runs on past the origin.
    """

    start: float
    stop: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.start) and np.isfinite(self.stop) and self.start < self.stop):
            raise ValueError(
                f"ArcFootprint: runs from {self.start} to {self.stop} m; give finite arc lengths, "
                "start before stop (an arc across the origin stops past the perimeter)"
            )

    @property
    def label(self) -> str:
        return f"arc {1e3 * self.start:.2f} to {1e3 * self.stop:.2f} mm"

    @property
    def corners(self) -> np.ndarray:
        return NO_POINTS

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.full(len(points), np.inf)

    def require_inside(self, domain: Domain, name: str) -> None:
        if self.stop - self.start > domain.perimeter * (1 - 1e-6):
            raise ValueError(
                f"{name} is longer than the rim, {1e3 * domain.perimeter:.2f} mm; leave a gap (arc lengths are metres)"
            )

    def rim_positions(self, domain: Domain) -> list[float]:
        return [self.start, self.stop]

    def covers_rim(self, domain: Domain, s: float) -> bool:
        """Ends are included, since electrodes that touch would share a node."""
        slack = 2 * domain.tolerance
        return (s - self.start + slack) % domain.perimeter <= self.stop - self.start + 2 * slack

    def features(self, domain: Domain, longest: float, shortest: float) -> list[Feature]:
        # At least two edges lie under an arc, because the current crowds at its ends.
        size = min(shortest, 0.5 * (self.stop - self.start))
        return [Feature(end, 0.0, size) for end in domain.boundary_point([self.start, self.stop])]


@dataclass(frozen=True)
class PolygonFootprint(AbstractFootprint):
    """Edges along the sides of ``outline``, m, nodes at its corners, and triangles inside.

    ``segments`` is the least number of edges around the polygon, distributed by length; each side has at least
    one.  Raises ValueError unless it is positive.
    """

    outline: Polygon
    segments: int = 16

    def __post_init__(self) -> None:
        if not self.segments > 0:
            raise ValueError(f"PolygonFootprint: segments is {self.segments}; give a positive number of edges")

    @property
    def label(self) -> str:
        return f"polygon from {place(self.corners[0])}"

    @property
    def corners(self) -> np.ndarray:
        return self.outline.corner_points

    @property
    def is_closed(self) -> bool:
        return True

    def distance(self, points: np.ndarray) -> np.ndarray:
        away = self.outline.boundary_distance(points)
        return np.where(self.outline.contains(points), -away, away)

    def require_inside(self, domain: Domain, name: str) -> None:
        rim = domain.boundary_point(domain.corners)
        inside = domain.contains(self.corners).all() and not sides_cross(rim, self.corners)
        if not inside or self.rim_gap(domain) <= domain.tolerance:
            raise ValueError(
                f"{name} reaches the rim; move it inward or make it smaller so that it is wholly inside the domain "
                "(coordinates are metres), or give a mesh of your own whose edges follow it"
            )

    def subdivided(
        self, domain: Domain, others: Sequence[AbstractFootprint], edge_length: float, slope: float
    ) -> "PolygonFootprint":
        """The polygon with a corner at each node that the mesh has on it."""
        among = _CrowdedPolygon(self.outline.vertices, domain, others)
        longest = min(edge_length, self.outline.perimeter / self.segments)
        places, widths = narrow_places(among, longest, slope)
        size = SizeField(places, np.zeros(len(widths)), widths, slope, longest)
        around = among.boundary_point(np.linspace(0, among.perimeter, MAX_OUTLINE_EDGES))
        edges = among.perimeter * np.mean(1 / size(around))
        if edges > MAX_OUTLINE_EDGES:
            raise MeshError(
                f"triangulate: the {self.label} needs {edges:.0f} edges around it, above the limit of "
                f"{MAX_OUTLINE_EDGES}; use a longer edge_length, or make it wider and move what is near it away"
            )
        s = divide_rim(among, among.corners, size)
        return PolygonFootprint(Polygon(among.boundary_point(s)), len(s))

    def features(self, domain: Domain, longest: float, shortest: float) -> list[Feature]:
        return [Feature(corner, 0.0, longest) for corner in self.corners]

    def edges(self) -> np.ndarray:
        return cycle(len(self.corners))


@dataclass(frozen=True)
class _CrowdedPolygon(Polygon):
    """A polygon whose clearance includes the distances to the rim of the domain and to other outlines."""

    domain: Domain
    others: Sequence[AbstractFootprint]

    def clearance(self, s: ArrayLike) -> np.ndarray:
        points = self.boundary_point(s)
        room = [super().clearance(s), self.domain.boundary_distance(points)]
        return np.asarray(np.min(room + [other.distance(points) for other in self.others], axis=0))
