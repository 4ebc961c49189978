"""Lagrange triangles and edges as tables: what differs between P1 and P2 is data, not code.

The reference triangle has corners (0,0), (1,0), (0,1) and barycentric coordinates
``l0 = 1 - x - y``, ``l1 = x``, ``l2 = y``.  A straight triangle with corners ``p0, p1, p2`` in the
plane *or in space* has the 2x2 metric ``g = J^T J`` with ``J = [p1 - p0, p2 - p0]``, so that

    integral of grad(phi_i) . grad(phi_j) dA = area * 2 * sum_ab inv(g)_ab * S_ab,ij

with the reference tensor ``S_ab,ij = integral of d_a phi_i d_b phi_j`` over the reference triangle
(area 1/2).  The same line therefore serves flat and curved sheets.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import factorial

from .mesh import Mesh


@dataclass(frozen=True, eq=False)
class Lagrange:
    """A Lagrange element of one order.

    | meaning                                   | shape        | unit |
    |-------------------------------------------|--------------|------|
    | order                                     | ()           | 1    |
    | stiffness: reference tensor S             | (2, 2, k, k) | 1    |
    | mass: per unit area of a triangle         | (k, k)       | 1    |
    | edge_mass: per unit length of an edge     | (e, e)       | 1    |

    ``k`` is 3 (P1) or 6 (P2: corners, then the midpoints of edges 01, 12, 20); ``e`` is 2 or 3
    (ends, then the midpoint).
    """

    order: int
    stiffness: np.ndarray
    mass: np.ndarray
    edge_mass: np.ndarray


# A polynomial is a map from exponents of (l0, l1, l2) to a coefficient.
_Poly = dict[tuple[int, int, int], float]
_P1: list[_Poly] = [{(1, 0, 0): 1.0}, {(0, 1, 0): 1.0}, {(0, 0, 1): 1.0}]
_P2: list[_Poly] = [
    {(2, 0, 0): 2.0, (1, 0, 0): -1.0},
    {(0, 2, 0): 2.0, (0, 1, 0): -1.0},
    {(0, 0, 2): 2.0, (0, 0, 1): -1.0},
    {(1, 1, 0): 4.0},
    {(0, 1, 1): 4.0},
    {(1, 0, 1): 4.0},
]
_EDGE = {1: [0, 1], 2: [0, 1, 3]}  # the functions that do not vanish on edge 01


def _product(p: _Poly, q: _Poly) -> _Poly:
    out: _Poly = {}
    for (a, b, c), x in p.items():
        for (d, e, f), y in q.items():
            key = (a + d, b + e, c + f)
            out[key] = out.get(key, 0.0) + x * y
    return out


def _along(p: _Poly, axis: int) -> _Poly:
    """Derivative with respect to x (axis 0) or y (axis 1): d/dl_(axis+1) - d/dl_0."""
    out: _Poly = {}
    for powers, coefficient in p.items():
        for index, sign in ((axis + 1, 1.0), (0, -1.0)):
            if powers[index]:
                lower = list(powers)
                lower[index] -= 1
                key = (lower[0], lower[1], lower[2])
                out[key] = out.get(key, 0.0) + sign * coefficient * powers[index]
    return out


def _integral(p: _Poly) -> float:
    """Over the reference triangle: integral of l0^a l1^b l2^c = a! b! c! / (a + b + c + 2)!."""
    return sum(x * np.prod(factorial(key)) / factorial(sum(key) + 2) for key, x in p.items())


def _edge_integral(p: _Poly) -> float:
    """Along edge 01 of unit length: integral of l0^a l1^b = a! b! / (a + b + 1)!."""
    return sum(x * factorial(a) * factorial(b) / factorial(a + b + 1) for (a, b, c), x in p.items() if c == 0)


def _lagrange(order: int, functions: list[_Poly]) -> Lagrange:
    slopes = [[_along(p, axis) for p in functions] for axis in (0, 1)]
    stiffness = [[[[_integral(_product(p, q)) for q in sb] for p in sa] for sb in slopes] for sa in slopes]
    mass = [[2.0 * _integral(_product(p, q)) for q in functions] for p in functions]
    ends = [functions[i] for i in _EDGE[order]]
    edge_mass = [[_edge_integral(_product(p, q)) for q in ends] for p in ends]
    return Lagrange(order, np.array(stiffness), np.array(mass), np.array(edge_mass))


P1 = _lagrange(1, _P1)
P2 = _lagrange(2, _P2)
BY_ORDER = {1: P1, 2: P2}


@dataclass(frozen=True, eq=False)
class Space:
    """Continuous piecewise polynomials on a mesh.

    | meaning                                            | shape             | unit |
    |----------------------------------------------------|-------------------|------|
    | points: where the degrees of freedom sit           | (dofs, 2 or 3)    | m    |
    | chart: the same in the sheet's flat coordinates    | (dofs, 2)         | m    |
    | dofs of each triangle                              | (elements, k)     |      |
    | boundary_dofs of each boundary edge                | (boundary, e)     |      |
    | stiffness of each triangle at unit conductivity    | (elements, k, k)  | 1    |
    """

    mesh: Mesh
    element: Lagrange
    points: np.ndarray
    chart: np.ndarray
    dofs: np.ndarray
    boundary_dofs: np.ndarray
    stiffness: np.ndarray

    def element_mass(self, elements: np.ndarray) -> np.ndarray:
        """Mass matrices of the given triangles, (len, k, k) in m^2."""
        return self.mesh.areas[elements, None, None] * self.element.mass

    def edge_mass(self, edges: np.ndarray) -> np.ndarray:
        """Mass matrices of the given boundary edges, (len, e, e) in m."""
        ends = self.mesh.nodes[self.mesh.boundary_edges[edges]]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
        return length[:, None, None] * self.element.edge_mass


def function_space(mesh: Mesh, order: int) -> Space:
    """The Lagrange space of ``order`` 1 or 2 on ``mesh``; P2 adds one node per mesh edge."""
    element = BY_ORDER[order]
    points, chart, dofs, boundary = mesh.nodes, mesh.chart, mesh.triangles, mesh.boundary_edges
    if order == 2:
        index = _edge_index(mesh.edges)
        middle = len(points) + np.arange(len(mesh.edges))
        points = np.concatenate([points, points[mesh.edges].mean(1)])
        chart = np.concatenate([chart, chart[mesh.edges].mean(1)])
        sides = [index(dofs[:, [i, (i + 1) % 3]]) for i in range(3)]
        dofs = np.concatenate([dofs, middle[np.stack(sides, 1)]], 1)
        boundary = np.concatenate([boundary, middle[index(boundary)][:, None]], 1)
    return Space(mesh, element, points, chart, dofs, boundary, _stiffness(mesh, element))


def _edge_index(edges: np.ndarray):
    """A lookup from pairs of nodes, in either order, to the row of ``edges`` that joins them."""
    size = edges.max() + 1
    keys = np.sort(edges, 1) @ np.array([size, 1], dtype=np.int64)
    order = np.argsort(keys)

    def lookup(pairs: np.ndarray) -> np.ndarray:
        wanted = np.sort(pairs, 1) @ np.array([size, 1], dtype=np.int64)
        return order[np.searchsorted(keys[order], wanted)]

    return lookup


def _stiffness(mesh: Mesh, element: Lagrange) -> np.ndarray:
    corners = mesh.nodes[mesh.triangles]
    jacobian = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)
    (a, b), (_, d) = np.moveaxis(np.swapaxes(jacobian, 1, 2) @ jacobian, 0, -1)
    determinant = a * d - b * b  # = (2 area)^2, positive for a mesh that passed its check
    inverse = np.array([[d, -b], [-b, a]]) / determinant
    scale = 2.0 * mesh.areas
    return np.einsum("abe,abij,e->eij", inverse, element.stiffness, scale)
