"""Shapes of the flat sheet, in metres: a rectangle, a disc, a simple polygon.

A domain answers questions about points (inside? how far from the rim?) and about its rim, which is
measured by the arc length s, counter-clockwise from an origin that each class states.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..messages.kinds import is_number, shown
from .plane_vectors import cross, signed_area
from .simple_polygons import BLOCK, TOLERANCE, require_polygon


class Domain(ABC):
    """A bounded, simply connected region of the plane, closed (its rim belongs to it)."""

    @property
    @abstractmethod
    def area(self) -> float:
        """Area in m^2."""

    @property
    @abstractmethod
    def perimeter(self) -> float:
        """Length of the rim in m."""

    @property
    def is_convex(self) -> bool:
        """Whether the domain is known to be convex."""
        return False

    @property
    @abstractmethod
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Lower-left and upper-right corner of the bounding box, ((x0, y0), (x1, y1)) in m."""

    @property
    @abstractmethod
    def corners(self) -> np.ndarray:
        """Arc lengths of the corners, (corners,) m, ascending; empty for a smooth rim."""

    @abstractmethod
    def boundary_point(self, s: ArrayLike) -> np.ndarray:
        """Points of the rim at arc lengths s (...) m; (..., 2) m.  The rim is periodic in s."""

    @abstractmethod
    def boundary_coordinate(self, points: ArrayLike) -> np.ndarray:
        """Arc length in [0, perimeter) of the rim point nearest to each of points (n, 2); (n,)."""

    @abstractmethod
    def clearance(self, s: ArrayLike) -> np.ndarray:
        """Distance from rim points at arc lengths s (n,) across to any part of the rim that is not
        on the same or an adjoining side; (n,) m, infinite where there is none."""

    @abstractmethod
    def _inside(self, points: np.ndarray) -> np.ndarray:
        """Whether each of points (n, 2) is in the interior; (n,) bool, of either value on the rim."""

    @property
    def tolerance(self) -> float:
        """Distance in m below which a point counts as being on the rim."""
        return TOLERANCE * float(np.hypot(*np.subtract(*self.bounds)))

    def boundary_distance(self, points: ArrayLike) -> np.ndarray:
        """Distance of points (n, 2) to the rim, whether inside or outside; (n,) m."""
        points = as_points(points)
        nearest = self.boundary_point(self.boundary_coordinate(points))
        return np.asarray(np.linalg.norm(points - nearest, axis=1))

    def contains(self, points: ArrayLike) -> np.ndarray:
        """Whether each of points (n, 2) is inside or, within `tolerance`, on the rim; (n,) bool."""
        points = as_points(points)
        return self._inside(points) | (self.boundary_distance(points) <= self.tolerance)


class _Polygonal(Domain):
    """A domain with straight sides; subclasses give `corner_points`."""

    @property
    @abstractmethod
    def corner_points(self) -> np.ndarray:
        """Corners in counter-clockwise order, the first at s = 0; (corners, 2) m."""

    @cached_property
    def _sides(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vectors, lengths and starting arc lengths (with the perimeter appended) of the sides."""
        vectors = np.roll(self.corner_points, -1, axis=0) - self.corner_points
        lengths = np.linalg.norm(vectors, axis=1)
        return vectors, lengths, np.concatenate([[0.0], np.cumsum(lengths)])

    @property
    def perimeter(self) -> float:
        return float(self._sides[2][-1])

    @property
    def corners(self) -> np.ndarray:
        return self._sides[2][:-1].copy()

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        low, high = self.corner_points.min(0), self.corner_points.max(0)
        return (float(low[0]), float(low[1])), (float(high[0]), float(high[1]))

    def boundary_point(self, s: ArrayLike) -> np.ndarray:
        vectors, lengths, starts = self._sides
        s = np.mod(np.asarray(s, float), self.perimeter)
        side = np.clip(np.searchsorted(starts, s, side="right") - 1, 0, len(lengths) - 1)
        along = ((s - starts[side]) / lengths[side])[..., None]
        return np.asarray(self.corner_points[side] + along * vectors[side])

    def boundary_coordinate(self, points: ArrayLike) -> np.ndarray:
        return _by_blocks(self._nearest_coordinate, as_points(points), len(self.corner_points))

    def _nearest_coordinate(self, points: np.ndarray) -> np.ndarray:
        along, squared = self._on_sides(points)
        side = np.argmin(squared, axis=1)
        _, lengths, starts = self._sides
        s = starts[side] + along[np.arange(len(points)), side] * lengths[side]
        return np.where(s >= self.perimeter, 0.0, s)

    def clearance(self, s: ArrayLike) -> np.ndarray:
        around = np.mod(np.asarray(s, float), self.perimeter)
        return _by_blocks(self._distance_across, around, len(self.corner_points))

    def _distance_across(self, s: np.ndarray) -> np.ndarray:
        count = len(self.corner_points)
        squared = self._on_sides(self.boundary_point(s))[1]
        own = np.clip(np.searchsorted(self._sides[2], s, side="right") - 1, 0, count - 1)
        apart = np.mod(np.arange(count) - own[:, None], count)
        across = (apart > 1) & (apart < count - 1)
        return np.asarray(np.sqrt(np.where(across, squared, np.inf).min(1)))

    def _on_sides(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest place on each side, as a fraction of the side, and squared distance, m^2; (n, sides) each."""
        vectors, lengths, _ = self._sides
        offset = points[:, None] - self.corner_points
        along = np.clip((offset * vectors).sum(-1) / lengths**2, 0.0, 1.0)
        return along, ((offset - along[..., None] * vectors) ** 2).sum(-1)

    def _inside(self, points: np.ndarray) -> np.ndarray:
        return _by_blocks(self._crosses_oddly, points, len(self.corner_points))

    def _crosses_oddly(self, points: np.ndarray) -> np.ndarray:
        """Even-odd rule: a point is inside if a ray to the right crosses the rim an odd number of
        times."""
        (vectors, _, _), start = self._sides, self.corner_points
        stop = np.roll(start, -1, axis=0)
        x, y = points[:, :1], points[:, 1:]
        spans = (start[:, 1] > y) != (stop[:, 1] > y)
        # A horizontal side spans no y, so that its slope is never used; 1 avoids a division by zero.
        slope = vectors[:, 0] / np.where(vectors[:, 1] == 0.0, 1.0, vectors[:, 1])
        crosses = x < start[:, 0] + (y - start[:, 1]) * slope
        return np.asarray((spans & crosses).sum(1) % 2 == 1)


@dataclass(frozen=True)
class Rectangle(_Polygonal):
    """A rectangle with its lower-left corner at the origin, where s = 0; s runs along the bottom.

    | meaning       | shape | unit |
    |---------------|-------|------|
    | width, along x  | () | m    |
    | height, along y | () | m    |

    Raises:
        ValueError: unless both are positive and finite.
    """

    width: float
    height: float

    def __post_init__(self) -> None:
        _require_positive("Rectangle", width=self.width, height=self.height)

    @property
    def is_convex(self) -> bool:
        return True

    @property
    def area(self) -> float:
        return float(self.width * self.height)

    @cached_property
    def corner_points(self) -> np.ndarray:
        w, h = float(self.width), float(self.height)
        return np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])


@dataclass(frozen=True)
class Disc(Domain):
    """A disc; s = 0 is its rightmost point (angle 0), so that s = radius * angle.

    | meaning | shape | unit |
    |---------|-------|------|
    | radius  | ()    | m    |
    | centre  | (2,)  | m    |

    Raises:
        ValueError: unless the radius is positive and all values are finite.
    """

    radius: float
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        _require_positive("Disc", radius=self.radius)
        if np.shape(self.centre) != (2,) or not all(is_number(x) and np.isfinite(x) for x in self.centre):
            raise ValueError(f"Disc: centre is {self.centre}; give two finite numbers in metres")
        object.__setattr__(self, "centre", (float(self.centre[0]), float(self.centre[1])))

    @property
    def is_convex(self) -> bool:
        return True

    @property
    def area(self) -> float:
        return float(np.pi * self.radius**2)

    @property
    def perimeter(self) -> float:
        return float(2 * np.pi * self.radius)

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        (x, y), a = self.centre, float(self.radius)
        return (x - a, y - a), (x + a, y + a)

    @property
    def corners(self) -> np.ndarray:
        return np.zeros(0)

    def boundary_point(self, s: ArrayLike) -> np.ndarray:
        angle = np.asarray(s, float) / self.radius
        unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.asarray(self.centre) + self.radius * unit

    def boundary_coordinate(self, points: ArrayLike) -> np.ndarray:
        offset = as_points(points) - self.centre
        s = self.radius * np.mod(np.arctan2(offset[:, 1], offset[:, 0]), 2 * np.pi)
        return np.where(s >= self.perimeter, 0.0, s)

    def boundary_distance(self, points: ArrayLike) -> np.ndarray:
        return np.asarray(np.abs(np.linalg.norm(as_points(points) - self.centre, axis=1) - self.radius))

    def clearance(self, s: ArrayLike) -> np.ndarray:
        return np.full(np.shape(s), np.inf)

    def _inside(self, points: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(points - self.centre, axis=1) < self.radius)


@dataclass(frozen=True)
class Polygon(_Polygonal):
    """A simple polygon; s = 0 is its first vertex.  Clockwise vertices are reversed.

    | meaning  | shape       | unit |
    |----------|-------------|------|
    | vertices | (corners, 2) | m   |

    Raises:
        ValueError: for fewer than three vertices, repeated ones, values that are not finite, and sides that cross,
            touch or fold back on each other.
    """

    vertices: ArrayLike

    def __post_init__(self) -> None:
        points = np.asarray(self.vertices, float)
        require_polygon(points)
        if signed_area(points) < 0:
            points = np.roll(points[::-1], 1, axis=0)
        object.__setattr__(self, "vertices", tuple((float(x), float(y)) for x, y in points))

    @property
    def area(self) -> float:
        return float(signed_area(self.corner_points))

    @cached_property
    def corner_points(self) -> np.ndarray:
        return np.array(self.vertices)

    @property
    def centroid(self) -> Float[np.ndarray, "2"]:
        """Centroid, m: the mean of the triangles that the sides form with the first corner, by their areas."""
        first = self.corner_points[0]
        sides = self.corner_points - first
        after = np.roll(sides, -1, 0)
        doubled = cross(sides, after)
        return np.asarray(first + doubled @ (sides + after) / (3 * doubled.sum()))


def as_points(points: ArrayLike) -> np.ndarray:
    """``points`` as a float64 array (n, 2); ValueError for any other shape."""
    array = np.asarray(points, float)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"points have shape {array.shape}; give an array of shape (n, 2)")
    return array


def _by_blocks(function: Callable[[np.ndarray], np.ndarray], values: np.ndarray, sides: int) -> np.ndarray:
    """``function`` of values (n, ...), each compared with ``sides`` sides, in blocks of bounded memory; (n,)."""
    rows = max(1, BLOCK // sides)
    if len(values) <= rows:
        return function(values)
    return np.concatenate([function(values[start : start + rows]) for start in range(0, len(values), rows)])


def _require_positive(what: str, **sizes: float) -> None:
    for name, value in sizes.items():
        if not (is_number(value) and np.isfinite(value) and value > 0):
            raise ValueError(f"{what}: {name} is {shown(value)}; give a positive length in metres")
