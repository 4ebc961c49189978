"""Nodes of a mesh on the rim of the sheet, the direction of the rim there, and its corners."""

import numpy as np

from .triangles import Mesh

# The cosine between rim edges that meet in a corner, which no electrode passes.
CORNER = np.cos(np.radians(30))


class RimNodes:
    """Which nodes lie on the rim (inside it), its direction at each of them, and its corners."""

    def __init__(self, mesh: Mesh) -> None:
        first, second = mesh.boundary_edges.T
        sides = mesh.chart[second] - mesh.chart[first]
        sides /= np.linalg.norm(sides, axis=1, keepdims=True)
        self.inside = np.zeros(len(mesh.nodes), bool)
        self.inside[first] = True
        out, into = np.zeros_like(mesh.chart), np.zeros_like(mesh.chart)
        out[first], into[second] = sides, sides
        self.corner = self.inside & ((out * into).sum(1) < CORNER)
        both = out + into
        self.tangent = both / np.maximum(np.linalg.norm(both, axis=1, keepdims=True), np.finfo(float).tiny)

    def direction(self, nodes: np.ndarray) -> np.ndarray:
        """The direction of the rim at an electrode, (2,)."""
        mean = self.tangent[nodes].mean(0)
        unit: np.ndarray = mean / np.linalg.norm(mean)
        return unit
