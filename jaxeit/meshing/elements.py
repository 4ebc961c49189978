"""Lagrange triangles and edges as tables: what differs between P1 and P2 is data, not code.

The reference triangle has corners (0,0), (1,0), (0,1) and barycentric coordinates
``l0 = 1 - x - y``, ``l1 = x``, ``l2 = y``.  A straight triangle with corners ``p0, p1, p2`` in the
plane *or in space* has the metric ``[[a, b], [b, d]] = J^T J`` with ``J = [p1 - p0, p2 - p0]``.  In
the orthonormal frame whose first axis points along the first edge, a slope (s, t) on the reference
triangle becomes ``(s / |a|, (a t - b s) / (|a| 2 area))`` with ``|a| = sqrt(a)``.  Taken at the points
of a quadrature rule that is exact here, and times the roots of its weights, these are the *slopes*
of an element, of which its stiffness is the square:

    integral of grad(phi_i) . grad(phi_j) dA = sum_r slopes_ir slopes_jr.

The same code serves flat and curved sheets.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Array, Float
from scipy.special import factorial

from .triangles import Mesh


@dataclass(frozen=True, eq=False)
class Lagrange:
    """A Lagrange element of one order.

    | meaning                                   | shape        | unit |
    |-------------------------------------------|--------------|------|
    | order                                     | ()           | 1    |
    | derivatives at the quadrature points      | (q, 2, k)    | 1    |
    | weights of the points; they sum to one    | (q,)         | 1    |
    | mass: per unit area of a triangle         | (k, k)       | 1    |
    | edge_mass: per unit length of an edge     | (e, e)       | 1    |

    ``k`` is 3 (P1) or 6 (P2: corners, then the midpoints of edges 01, 12, 20); ``e`` is 2 or 3
    (ends, then the midpoint).
    """

    order: int
    derivatives: np.ndarray
    weights: np.ndarray
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
EDGE_FUNCTIONS = {1: [0, 1], 2: [0, 1, 3]}  # the functions that do not vanish on edge 01
# Barycentric points of equal weight: these rules are exact for products of two slopes.
QUADRATURE_POINTS = {1: np.full((1, 3), 1 / 3), 2: np.array([[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]])}


def _product(p: _Poly, q: _Poly) -> _Poly:
    out: _Poly = {}
    for (a, b, c), x in p.items():
        for (d, e, f), y in q.items():
            key = (a + d, b + e, c + f)
            out[key] = out.get(key, 0.0) + x * y
    return out


def _derivative(p: _Poly, axis: int) -> _Poly:
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


def _value(p: _Poly, at: np.ndarray) -> float:
    """The polynomial at a point with barycentric coordinates (3,)."""
    return float(sum(x * np.prod(at ** np.array(key)) for key, x in p.items()))


def _integral(p: _Poly) -> float:
    """Integral over the reference triangle, from the integral of l0^a l1^b l2^c = a! b! c! / (a + b + c + 2)!."""
    return float(sum(x * np.prod(factorial(key)) / factorial(sum(key) + 2) for key, x in p.items()))


def _edge_integral(p: _Poly) -> float:
    """Integral along edge 01 of unit length, from the integral of l0^a l1^b = a! b! / (a + b + 1)!."""
    return float(sum(x * factorial(a) * factorial(b) / factorial(a + b + 1) for (a, b, c), x in p.items() if c == 0))


def _lagrange(order: int, functions: list[_Poly]) -> Lagrange:
    points = QUADRATURE_POINTS[order]
    derivatives = [[[_value(_derivative(p, axis), at) for p in functions] for axis in (0, 1)] for at in points]
    weights = np.full(len(points), 1 / len(points))
    mass = [[2.0 * _integral(_product(p, q)) for q in functions] for p in functions]
    ends = [functions[i] for i in EDGE_FUNCTIONS[order]]
    edge_mass = [[_edge_integral(_product(p, q)) for q in ends] for p in ends]
    return Lagrange(order, np.array(derivatives), weights, np.array(mass), np.array(edge_mass))


P1 = _lagrange(1, _P1)
P2 = _lagrange(2, _P2)
BY_ORDER = {1: P1, 2: P2}


@dataclass(frozen=True, eq=False)
class Space:
    """Continuous piecewise polynomials on a mesh.

    | meaning                                            | shape             | unit |
    |----------------------------------------------------|-------------------|------|
    | mesh: the triangles                                |                   |      |
    | element of each triangle                           |                   |      |
    | points: where the degrees of freedom sit           | (dofs, 2 or 3)    | m    |
    | chart: the same in the sheet's flat coordinates    | (dofs, 2)         | m    |
    | dofs of each triangle                              | (elements, k)     |      |
    | boundary_dofs of each boundary edge                | (boundary, e)     |      |
    | slopes of each triangle, weighted                  | (elements, k, r)  | 1    |

    The weighted slopes S of a triangle give its stiffness at unit conductivity, ``S S^T``.
    """

    mesh: Mesh
    element: Lagrange
    points: np.ndarray
    chart: np.ndarray
    dofs: np.ndarray
    boundary_dofs: np.ndarray
    slopes: np.ndarray

    @property
    def stiffness(self) -> np.ndarray:
        """Stiffness of each triangle at unit conductivity, (elements, k, k)."""
        return np.asarray(self.slopes @ self.slopes.transpose(0, 2, 1))

    def element_mass(self, elements: np.ndarray) -> np.ndarray:
        """Mass matrices of the given triangles, (len, k, k) in m^2."""
        return np.asarray(self.mesh.areas[elements, None, None] * self.element.mass)

    def edge_mass(self, edges: np.ndarray) -> np.ndarray:
        """Mass matrices of the given boundary edges, (len, e, e) in m."""
        ends = self.mesh.nodes[self.mesh.boundary_edges[edges]]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
        return np.asarray(length[:, None, None] * self.element.edge_mass)


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
    slopes = element_slopes(mesh.nodes[mesh.triangles], mesh.areas, element)
    return Space(mesh, element, points, chart, dofs, boundary, np.asarray(slopes))


def _edge_index(edges: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """A lookup from pairs of nodes, in either order, to the row of ``edges`` that joins them."""
    size = edges.max() + 1
    keys = np.sort(edges, 1) @ np.array([size, 1], dtype=np.int64)
    order = np.argsort(keys)

    def lookup(pairs: np.ndarray) -> np.ndarray:
        wanted = np.sort(pairs, 1) @ np.array([size, 1], dtype=np.int64)
        return order[np.searchsorted(keys[order], wanted)]

    return lookup


def element_slopes(
    corners: Float[np.ndarray | Array, "elements 3 d"], areas: Float[np.ndarray | Array, " elements"], element: Lagrange
) -> Float[np.ndarray | Array, "elements k r"]:
    """Weighted slopes (see `Space`) of triangles with these corners, m, and areas, m^2; in NumPy or in JAX."""
    xp: Any = corners.__array_namespace__()
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length, along, twice = xp.sqrt(xp.sum(first**2, -1)), xp.sum(first * second, -1), 2 * areas
    zero = xp.zeros_like(length)
    to_frame = xp.stack([1 / length, zero, -along / (length * twice), length / twice], -1).reshape(-1, 2, 2)
    derivatives, weights = (xp.asarray(table, dtype=corners.dtype) for table in (element.derivatives, element.weights))
    slopes = xp.einsum("ecd,qdk,eq->ekqc", to_frame, derivatives, xp.sqrt(areas[:, None] * weights))
    flat: np.ndarray | Array = slopes.reshape(*slopes.shape[:2], -1)
    return flat
