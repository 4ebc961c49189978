"""Linear elements in exact rational arithmetic, in the potentials themselves: slow, and right to the last digit.

Unknowns are the potentials u of the nodes and U of the electrodes, the equations those of the energy
``sum sigma |grad u|^2 + sum_l g_l integral over E_l of (u - U_l)^2``, as the textbook has them.
"""

from collections.abc import Iterable, Sequence
from fractions import Fraction

import numpy as np

Piece = tuple[Sequence[int], int, Fraction]
"""Nodes of a triangle or an edge under an electrode, the electrode, and its contact conductance."""


def transfer_matrix(nodes, triangles, sigma, pieces: Iterable[Piece], electrodes: int) -> np.ndarray:
    """Potential of each electrode per ampere into each, node 0 grounded; (electrodes, electrodes) of `Fraction`.

    Edges must be parallel to an axis, so that their lengths are rational.
    """
    points = [(Fraction(x), Fraction(y)) for x, y in nodes]
    count = len(points)
    matrix = np.full((count + electrodes, count + electrodes), Fraction(0))
    for triangle, conductivity in zip(triangles, sigma, strict=True):
        matrix[np.ix_(triangle, triangle)] += Fraction(conductivity) * _stiffness([points[i] for i in triangle])
    for where, electrode, conductance in pieces:
        size, k = _size([points[i] for i in where]), len(where)
        mass = np.array([[1 + (i == j) for j in range(k)] for i in range(k)]) * (conductance * size / (k * (k + 1)))
        dofs = [*where, count + electrode]
        drop = np.concatenate([np.eye(k, dtype=int), -np.ones((k, 1), dtype=int)], 1)  # u - U, as rows
        matrix[np.ix_(dofs, dofs)] += drop.T @ mass @ drop
    return inverse_corner(matrix[1:, 1:], electrodes)


def _stiffness(corners) -> np.ndarray:
    (x0, y0), (x1, y1), (x2, y2) = corners
    slopes = np.array([[y1 - y2, x2 - x1], [y2 - y0, x0 - x2], [y0 - y1, x1 - x0]])
    return slopes @ slopes.T / (4 * _size(corners))


def _size(corners) -> Fraction:
    """Area of a triangle, or length of an edge parallel to an axis."""
    (x0, y0), (x1, y1), *rest = corners
    if not rest:
        return abs(x1 - x0) + abs(y1 - y0)
    return ((x1 - x0) * (rest[0][1] - y0) - (rest[0][0] - x0) * (y1 - y0)) / 2


def inverse_corner(matrix: np.ndarray, size: int) -> np.ndarray:
    """The last ``size`` rows and columns of the inverse, by eliminating all others and inverting what is left."""
    rest = matrix.copy()
    while len(rest) > size:
        near = np.flatnonzero(rest[0, 1:]) + 1
        rest[np.ix_(near, near)] -= np.outer(rest[near, 0], rest[0, near]) / rest[0, 0]
        rest = rest[1:, 1:]
    return _inverse(rest)


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """By Gauss and Jordan; positive definite, so that no pivot vanishes."""
    count = len(matrix)
    rows = np.concatenate([matrix, np.eye(count, dtype=int) * Fraction(1)], 1)
    for k in range(count):
        rows[k] = rows[k] / rows[k, k]
        for i in range(count):
            if i != k:
                rows[i] = rows[i] - rows[i, k] * rows[k]
    return rows[:, count:]
