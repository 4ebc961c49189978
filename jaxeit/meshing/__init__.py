"""Triangle meshes of the sheet: element sizes, generation, smoothing, and the Lagrange elements on them."""

from .elements import Lagrange, Space, function_space
from .footprints import AbstractFootprint
from .foreign import flat_mesh, read_mesh, write_mesh
from .generation import TrianglePattern, structured, triangulate
from .triangles import Mesh, MeshError

__all__ = [
    "AbstractFootprint",
    "Lagrange",
    "Mesh",
    "MeshError",
    "Space",
    "TrianglePattern",
    "flat_mesh",
    "function_space",
    "read_mesh",
    "structured",
    "triangulate",
    "write_mesh",
]
