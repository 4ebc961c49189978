"""Shapes of the sheet: flat outlines, and the surfaces in space that the sheet is laid on."""

from .shapes import Disc, Domain, Polygon, Rectangle
from .surfaces import AbstractSurface, Cylinder, Plane, Projection, Sphere, SurfaceError

__all__ = [
    "AbstractSurface",
    "Cylinder",
    "Disc",
    "Domain",
    "Plane",
    "Polygon",
    "Projection",
    "Rectangle",
    "Sphere",
    "SurfaceError",
]
