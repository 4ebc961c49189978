"""Shapes of the sheet: flat outlines, and the surfaces in space that the sheet is laid on.

Example:
    import numpy as np

    import jaxeit as je

    palm = je.Polygon([(0, 0), (0.09, 0), (0.09, 0.06), (0.05, 0.1), (0, 0.1)])  # m, in any direction
    print(f"{1e4 * palm.area:.0f} cm^2, rim {1e3 * palm.perimeter:.0f} mm, box {palm.bounds}")
    print(palm.contains(np.array([[0.02, 0.05], [0.085, 0.095]])))  # inside, outside

    forearm = je.Cylinder(radius=0.04, middle=0.045)  # the sheet rolled around an axis along y
    touched = np.array([[0.01, 0.05, 0.039]])  # m in space, as a motion capture tells it
    for surface in (je.geometry.Plane(), forearm):
        seen = surface.project(touched)
        # m on the flat sheet, m above the surface
        print(type(surface).__name__, seen.chart[0], seen.height[0])
"""

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
