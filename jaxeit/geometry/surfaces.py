"""Shapes in space that a sheet is laid on: from its flat coordinates to points in three dimensions, and back."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from ..messages.kinds import is_number, shown


class SurfaceError(ValueError):
    """A surface that cannot carry the sheet."""


Points = np.ndarray | Array


class Projection(NamedTuple):
    """Points in space as seen from a surface.

    | meaning                                                           | shape    | unit |
    |-------------------------------------------------------------------|----------|------|
    | chart: flat coordinates of the nearest point of the surface       | (..., 2) | m    |
    | height above the surface; negative: below                         | (...)    | m    |
    | normal of the surface there, of length one, away from its inside  | (..., 3) | 1    |
    """

    chart: Float[Points, "*points 2"]
    height: Float[Points, "*points"]
    normal: Float[Points, "*points 3"]


class AbstractSurface(ABC):
    """A map from the sheet's flat coordinates, (n, 2) m, to space, (n, 3) m."""

    @abstractmethod
    def __call__(self, chart: np.ndarray) -> np.ndarray:
        """Places in space, (n, 3) m, of points of the sheet, (n, 2) m."""

    def project(self, points: Float[Points, "*points 3"]) -> Projection:
        """The reverse map: points in space, (..., 3) m, in the sheet's flat coordinates; in NumPy or in JAX.

        Raises:
            SurfaceError: for a class that does not define it; only simulators of contacts need it.
        """
        raise SurfaceError(f"{type(self).__name__} maps to space only; define its method project for the reverse")


# Of half a round, by which a sheet that goes once around a cylinder may exceed it.
ROUNDING = 1e-9


def _require_radius(radius: float) -> None:
    if not (is_number(radius) and np.isfinite(radius) and radius > 0):
        raise SurfaceError(f"the surface's radius is {shown(radius)} m; give a length above zero")


@dataclass(frozen=True)
class Plane(AbstractSurface):
    """The flat sheet in the plane z = 0 of space, where a skin without a surface lies."""

    def __call__(self, chart: np.ndarray) -> np.ndarray:
        return np.column_stack([chart, np.zeros(len(chart))])

    def project(self, points: Float[Points, "*points 3"]) -> Projection:
        up = 0 * points + _upwards(points)
        return Projection(points[..., :2], points[..., 2], up)


@dataclass(frozen=True)
class Cylinder(AbstractSurface):
    """The sheet rolled around an axis along y, unstretched: its readings are those of the flat sheet.

    A sheet that reaches more than half a round to one side of the middle would lie over itself and is refused.

    | meaning                                         | shape | unit |
    |-------------------------------------------------|-------|------|
    | radius                                          | ()    | m    |
    | middle: the x that lies on top of the cylinder  | ()    | m    |
    """

    radius: float
    middle: float = 0.0

    def __post_init__(self) -> None:
        _require_radius(self.radius)

    def __call__(self, chart: np.ndarray) -> np.ndarray:
        x, y = np.asarray(chart).T
        angle = (x - self.middle) / self.radius
        reach = np.abs(angle).max(initial=0.0)
        if reach > np.pi * (1 + ROUNDING):
            raise SurfaceError(
                f"the sheet reaches {1e3 * reach * self.radius:.4g} mm from x = {self.middle:g} m, the top of a "
                f"cylinder; half a round is {1e3 * np.pi * self.radius:.4g} mm at radius {self.radius:g} m; give a "
                "larger radius, and the middle of the sheet as middle"
            )
        return np.stack([self.radius * np.sin(angle), y, self.radius * np.cos(angle)], 1)

    def project(self, points: Float[Points, "*points 3"]) -> Projection:
        xp: Any = points.__array_namespace__()
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        distance, normal = _outward(xp.stack([x, xp.zeros_like(y), z], -1))
        chart = xp.stack([self.middle + self.radius * xp.arctan2(x, z), y], -1)
        return Projection(chart, distance - self.radius, normal)


@dataclass(frozen=True)
class Sphere(AbstractSurface):
    """The sheet pressed onto a sphere; distances from its centre are kept (azimuthal equidistant).

    The sheet is stretched less than it would be flat: an arc around the centre is shorter by
    ``sin(d / radius) / (d / radius)``.

    | meaning                                     | shape | unit |
    |---------------------------------------------|-------|------|
    | radius                                      | ()    | m    |
    | centre: the point on top of the sphere      | (2,)  | m    |
    """

    radius: float
    centre: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        _require_radius(self.radius)

    def __call__(self, chart: np.ndarray) -> np.ndarray:
        offset = np.asarray(chart) - np.asarray(self.centre)
        angle = np.linalg.norm(offset, axis=1) / self.radius
        if angle.max(initial=0.0) > 0.9 * np.pi:
            raise SurfaceError(
                f"the sheet reaches {np.degrees(angle.max()):.0f} degrees around a sphere of radius "
                f"{self.radius} m; give a larger radius"
            )
        flat = offset * np.sinc(angle / np.pi)[:, None]  # sin(angle) / angle, which sinc evaluates at the centre too
        return np.column_stack([flat, self.radius * np.cos(angle)])

    def project(self, points: Float[Points, "*points 3"]) -> Projection:
        xp: Any = points.__array_namespace__()
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        aside, flat = _outward(xp.stack([x, y, xp.zeros_like(z)], -1))
        arc = self.radius * xp.arctan2(aside, z)
        # Above the centre, and below it, no direction is nearest; `flat` is upwards there and without x and y.
        chart = xp.stack([self.centre[k] + arc * flat[..., k] for k in range(2)], -1)
        distance, normal = _outward(points)
        return Projection(chart, distance - self.radius, normal)


def _upwards(like: Float[Points, "*points 3"]) -> Float[Points, "3"]:
    """The direction of z in the precision of these points."""
    xp: Any = like.__array_namespace__()
    up: Points = xp.asarray([0.0, 0.0, 1.0], dtype=like.dtype)
    return up


def _outward(vectors: Float[Points, "*points 3"]) -> tuple[Float[Points, "*points"], Float[Points, "*points 3"]]:
    """Lengths and directions of vectors; that of a vector without length is upwards."""
    xp: Any = vectors.__array_namespace__()
    length = xp.sqrt((vectors**2).sum(-1))
    short = length[..., None] == 0
    return length, xp.where(short, _upwards(vectors), vectors / xp.where(short, 1, length[..., None]))
