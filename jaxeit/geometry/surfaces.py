"""Shapes in space that a sheet is laid on: from its flat coordinates to points in three dimensions."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np


class SurfaceError(ValueError):
    """A surface that cannot carry the sheet."""


class AbstractSurface(ABC):
    """A map from the sheet's flat coordinates, (n, 2) m, to space, (n, 3) m."""

    @abstractmethod
    def __call__(self, chart: np.ndarray) -> np.ndarray:
        """Places in space, (n, 3) m, of points of the sheet, (n, 2) m."""


def _require_radius(radius: float) -> None:
    if not (np.isfinite(radius) and radius > 0):
        raise SurfaceError(f"the surface's radius is {radius} m; give a length above zero")


@dataclass(frozen=True)
class Cylinder(AbstractSurface):
    """The sheet rolled around an axis along y, unstretched: its readings are those of the flat sheet.

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
        return np.stack([self.radius * np.sin(angle), y, self.radius * np.cos(angle)], 1)


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
