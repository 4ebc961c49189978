"""Meshes of other programs: arrays in any numbering, and the files that meshio reads and writes."""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from .smoothing import doubled_areas
from .triangles import Mesh, MeshError


def flat_mesh(
    nodes: Float[np.ndarray, "n d"], triangles: Integer[np.ndarray, "m 3"]
) -> tuple[Mesh, Integer[np.ndarray, " n"]]:
    """The mesh of triangles in a plane, from nodes and triangles in any order.

    Args:
        nodes: (n, 2) m, or (n, 3) with one height for all.
        triangles: node numbers, counted from 0, clockwise or counter-clockwise.

    Returns:
        The mesh, counter-clockwise and without nodes that belong to no triangle, and the number in it of each of
        ``nodes``, -1 for one that is left out.

    Raises:
        MeshError: for nodes that lie in no such plane, or triangles that name others.

    Example:
        # m, all at one height
        corners = np.array([[0, 0, 0.5], [0.1, 0, 0.5], [0.1, 0.1, 0.5], [0, 0.1, 0.5]])
        # one is clockwise
        square, numbers = je.meshing.flat_mesh(corners, np.array([[0, 2, 1], [0, 2, 3]]))
    """
    if nodes.shape[1] not in (2, 3) or not (nodes[:, 2:] == nodes[:1, 2:]).all():
        raise MeshError(
            "mesh: its nodes are at different heights; a sheet is flat, or is given as Mesh(nodes, triangles, chart)"
        )
    if not triangles.size or triangles.min() < 0 or triangles.max() >= len(nodes):
        raise MeshError(f"mesh: its triangles name nodes outside 0 to {len(nodes) - 1}, or there is no triangle")
    used, inverse = np.unique(triangles, return_inverse=True)
    numbers = inverse.reshape(triangles.shape)
    plane = nodes[used, :2].astype(float)
    flipped = doubled_areas(plane[numbers]) < 0
    numbers[flipped] = numbers[flipped][:, [0, 2, 1]]
    number = np.full(len(nodes), -1)
    number[used] = np.arange(len(used))
    return Mesh(plane, numbers), number


def read_mesh(path: str | Path) -> Mesh:
    """The triangles of a flat mesh in a file: Gmsh, VTK, XDMF, Abaqus and what else meshio reads, lengths in m.

    Other cells, such as lines and points, are left out. Install ``jaxeit[meshes]``.

    Raises:
        MeshError: if meshio is not installed or cannot read the file, or it has no flat triangles.

    Example:
        # degrees; the error names the worst triangle
        mesh = je.meshing.read_mesh("patch.vtu").check(min_angle=15)
    """
    found = _meshio(path, "read", path)
    triangles = [block.data for block in found.cells if block.type == "triangle"]
    if not triangles:
        raise MeshError(f"{path}: has no triangles, but {sorted({block.type for block in found.cells})}")
    try:
        return flat_mesh(np.asarray(found.points, float), np.concatenate(triangles).astype(int))[0]
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None


def write_mesh(path: str | Path, mesh: Mesh, **values: Float[Any, " m"]) -> None:
    """Write a mesh, with values on its triangles by name, for ParaView (.vtu, .vtk) and other programs.

    The mesh of a model is ``model.mesh``. Install ``jaxeit[meshes]``.

    Raises:
        MeshError: if meshio is not installed or cannot write the file, or values do not fit the mesh.

    Example:
        je.meshing.write_mesh("patch.vtu", mesh, smallest_angle=mesh.min_angles)  # for ParaView
    """
    data = {name: np.asarray(array, float) for name, array in values.items()}
    wrong = [name for name, array in data.items() if array.shape != (len(mesh.triangles),)]
    if wrong:
        raise MeshError(f"{wrong[0]} has shape {data[wrong[0]].shape}; the mesh has {len(mesh.triangles)} triangles")
    points = np.pad(mesh.nodes, ((0, 0), (0, 3 - mesh.nodes.shape[1])))
    cells = {name: [array] for name, array in data.items()}
    _meshio(path, "write_points_cells", path, points, [("triangle", mesh.triangles)], cell_data=cells)


def _meshio(path: str | Path, function: str, *given: Any, **named: Any) -> Any:
    try:
        meshio = import_module("meshio")  # an extra, and only imported for a file
    except ImportError:
        raise MeshError("files of meshes need meshio, which is not installed; install jaxeit[meshes]") from None
    try:
        return getattr(meshio, function)(*given, **named)
    except OSError:
        raise
    except (Exception, SystemExit) as error:  # meshio ends the program where no reader of an ending succeeds
        said = "" if isinstance(error, SystemExit) else f": {' '.join(str(error).split())}"
        raise MeshError(f"{path}: meshio cannot {function.split('_')[0]} it{said}") from None
