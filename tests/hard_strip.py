"""A strip that reads the same on any mesh.

Between electrodes along its short ends the field is linear in x, which linear elements hold exactly, whatever the
triangles: (R_s L + z1 + z2) / W from end to end, and R_s / W times their distance in x between two points.
"""

from dataclasses import dataclass

import numpy as np

import jaxeit as je
from jaxeit.linalg import Dense
from jaxeit.meshing.outlines import ArcFootprint, PointFootprint

from .helpers import skin_of

LENGTH, WIDTH, SHEET_RESISTANCE, CONTACT = 0.2, 0.1, 50.0, 0.5
STRIP = je.Rectangle(LENGTH, WIDTH)
ENDS = [(LENGTH, LENGTH + WIDTH), (2 * LENGTH + WIDTH, 2 * (LENGTH + WIDTH))]  # at x = LENGTH, at x = 0
PLACES = [(0.05, 0.03), (0.15, 0.06)]


@dataclass(frozen=True, eq=False)
class Unchecked(je.meshing.Mesh):
    """A mesh that says of itself that it is sound."""

    def check(self, min_angle: float = 0.0) -> je.meshing.Mesh:
        return self


def strip_error(mesh: je.meshing.Mesh, dtype: str = "float64") -> float:
    """The larger error of the two readings, relative to each."""
    electrodes = [je.BoundaryPatch(*end, CONTACT) for end in ENDS] + [je.PointElectrode(p) for p in PLACES]
    skin = skin_of(STRIP, electrodes, [[0, 1, 0, 1], [0, 1, 3, 2]], sheet_resistance=SHEET_RESISTANCE)
    model = je.discretise(je.Scene(skin), je.Fidelity(dtype=dtype, solver=Dense()), mesh=mesh)
    drive = (SHEET_RESISTANCE * LENGTH + 2 * CONTACT) / WIDTH
    between = SHEET_RESISTANCE * (PLACES[1][0] - PLACES[0][0]) / WIDTH
    return float(np.abs(np.asarray(je.forward(model), float) / [drive, between] - 1).max())


def graded(finest: float) -> je.meshing.Mesh:
    """Edges of this length at two points, of 20 mm away from them."""
    footprints = [*(ArcFootprint(*end) for end in ENDS), *(PointFootprint(p) for p in PLACES)]
    return je.meshing.triangulate(STRIP, footprints, 0.02, growth=1.6, electrode_edge=finest)


def capped(height: float) -> Unchecked:
    """A regular mesh with a node more over the middle of an edge, at this part of its triangle's height."""
    mesh = je.meshing.structured(STRIP, 20, 10)
    a, b, c = mesh.triangles[200]
    middle = 0.5 * (mesh.nodes[a] + mesh.nodes[b])
    d = len(mesh.nodes)
    triangles = np.concatenate([np.delete(mesh.triangles, 200, 0), [[a, b, d], [b, c, d], [c, a, d]]])
    return Unchecked(np.concatenate([mesh.nodes, [middle + height * (mesh.nodes[c] - middle)]]), triangles)


def in_single_precision(mesh: je.meshing.Mesh) -> Unchecked:
    """The mesh as a program that keeps its nodes in float32 sees it."""
    return Unchecked(mesh.nodes.astype(np.float32), mesh.triangles)
