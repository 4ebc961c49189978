"""Triangle meshes of the sheet: element sizes, generation, smoothing, and the Lagrange elements on them."""

from .elements import Lagrange, Space, function_space
from .footprints import AbstractFootprint
from .generation import TrianglePattern, structured, triangulate
from .triangles import Mesh, MeshError

__all__ = [
    "AbstractFootprint",
    "Lagrange",
    "Mesh",
    "MeshError",
    "Space",
    "TrianglePattern",
    "function_space",
    "structured",
    "triangulate",
]
