"""Triangle meshes of the sheet: element sizes, generation, smoothing, and the Lagrange elements on them.

Example:
    import numpy as np

    import jaxeit as je

    sheet = je.Rectangle(0.12, 0.08)  # m
    bolts = [je.AreaPatch((x, 0.04), radius=0.003) for x in (0.03, 0.09)]
    mesh = je.meshing.triangulate(sheet, [bolt.footprint(16) for bolt in bolts], edge_length=0.008)
    print(f"{len(mesh.nodes)} nodes, smallest angle {mesh.min_angles.min():.0f} degrees")
    je.meshing.write_mesh("patch.vtu", mesh, smallest_angle=mesh.min_angles)  # for ParaView

    regular = je.meshing.structured(sheet, 12, 8, pattern=je.meshing.TrianglePattern.CROSSED)
    space = je.meshing.function_space(regular, order=2)  # a node on each edge, too
    mass = space.element_mass(np.arange(len(regular.triangles)))  # m^2
    print(f"{len(space.points)} unknowns of order {space.element.order} on {1e4 * mass.sum():.0f} cm^2")
"""

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
