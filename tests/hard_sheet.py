"""A small sheet whose readings are known to the last digit, whatever its conductivities and contacts; and the
textbook's ways to compute them, kept to show where they fail.

A rectangle of 64 triangles with two electrodes on its rim and two patches in it; every pair of them drives, every
pair senses: drive, three-terminal and four-terminal readings.
"""

from fractions import Fraction
from functools import cache
from itertools import combinations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxeit as je
from jaxeit.linalg import AbstractLinearSolver
from jaxeit.model.forward_model import transfer
from jaxeit.model.sheet_conductivity import coefficients

from .helpers import skin_of
from .oracles.rational import Piece, transfer_matrix

SHEET = je.Rectangle(8.0, 4.0)
MESH = je.meshing.structured(SHEET, 8, 4)
EDGES = {0: (0.0, 1.0), 1: (13.0, 15.0)}  # arc lengths: under the sheet near a corner, over its middle
PATCHES = {2: (1.0, 2.0, 2.0, 3.0), 3: (5.0, 1.0, 7.0, 2.0)}  # corners of rectangles in it
PAIRS = list(combinations(range(4), 2))


@cache
def sheet_model(solver: AbstractLinearSolver, dtype: str = "float64") -> je.Model:
    electrodes: list = [je.BoundaryPatch(*EDGES[k], 1.0) for k in EDGES]
    for x0, y0, x1, y1 in PATCHES.values():
        electrodes.append(je.PolygonPatch(je.Polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]), 1.0))
    skin = skin_of(SHEET, electrodes, [[0, 1, 2, 3]])
    return je.discretise(je.Scene(skin), je.Fidelity(dtype=dtype, solver=solver), mesh=MESH)


def grounded(model: je.Model, node: int) -> je.Model:
    """The same model with this node as the only one that may be grounded."""
    dof = jnp.asarray([unknown_of(model, node)], model.system.ground.dtype)
    weight = jnp.ones(1, model.dtype)
    return eqx.tree_at(lambda m: (m.system.ground, m.system.ground_weight), model, (dof, weight))


def unknown_of(model: je.Model, node: int) -> int:
    """The unknown of linear elements at a node."""
    row, corner = np.argwhere(MESH.triangles == node)[0]
    return int(model.system.dofs[row, corner])


def found(model: je.Model, sigma, contacts) -> np.ndarray:
    """What jaxeit reads, float64."""
    theta = coefficients(model, jnp.asarray(sigma, model.dtype))
    z = transfer(model, theta._replace(contact=1 / jnp.asarray(contacts, model.dtype)))
    return paired(np.asarray(z, float))


def exact(sigma, contacts) -> np.ndarray:
    return _exact(tuple(np.asarray(sigma).tolist()), tuple(contacts))


@cache
def _exact(sigma, contacts):
    pieces = sheet_pieces([1 / Fraction(z) for z in contacts])
    return paired(transfer_matrix(MESH.nodes, MESH.triangles.tolist(), sigma, pieces, 4)).astype(float)


def sheet_pieces(conductances) -> list[Piece]:
    """What lies under each electrode, with its contact conductance."""
    out = []
    for k, (start, stop) in EDGES.items():
        along = SHEET.boundary_coordinate(MESH.nodes[MESH.boundary_edges].mean(1))
        under = MESH.boundary_edges[(start < along) & (along < stop)]
        out += [(edge.tolist(), k, conductances[k]) for edge in under]
    x, y = MESH.centroids.T
    for k, (x0, y0, x1, y1) in PATCHES.items():
        under = MESH.triangles[(x0 < x) & (x < x1) & (y0 < y) & (y < y1)]
        out += [(triangle.tolist(), k, conductances[k]) for triangle in under]
    return out


def paired(z: np.ndarray) -> np.ndarray:
    """Readings (pairs that drive, pairs that sense) from the transfer matrix."""
    return np.array([[z[c, a] - z[d, a] - z[c, b] + z[d, b] for c, d in PAIRS] for a, b in PAIRS])


def worst(readings: np.ndarray, right: np.ndarray) -> float:
    """The largest error of a reading, relative to that reading."""
    return float(np.abs(readings / right - 1).max())


# The textbook's ways.


def textbook_matrix(sigma, contacts, dtype=float) -> np.ndarray:
    """The whole system in the potentials of nodes and electrodes themselves, singular on constants."""
    count = len(MESH.nodes)
    matrix = np.zeros((count + 4, count + 4), dtype)
    corners = MESH.nodes[MESH.triangles]
    for triangle, (p, q, r), s in zip(MESH.triangles, corners, np.asarray(sigma, dtype), strict=True):
        slopes = np.array([r - q, p - r, q - p], dtype)  # turned by a right angle
        matrix[np.ix_(triangle, triangle)] += s * slopes @ slopes.T / 2  # of area 1/2, all of them
    for where, electrode, conductance in sheet_pieces([1 / dtype(z) for z in contacts]):
        k, dofs = len(where), [*where, count + electrode]
        size = 1 if k == 2 else 0.5
        mass = conductance * dtype(size / (k * (k + 1))) * (np.ones((k, k), dtype) + np.eye(k, dtype=dtype))
        drop = np.concatenate([np.eye(k), -np.ones((k, 1))], 1).astype(dtype)
        matrix[np.ix_(dofs, dofs)] += drop.T @ mass @ drop
    return matrix


def by_schur_and_pinv(sigma, contacts, dtype=float) -> np.ndarray:
    """Y = D - B^T K^-1 B by subtraction, Z = pinv(Y)."""
    matrix = textbook_matrix(sigma, contacts, dtype)
    admittance = matrix[-4:, -4:] - matrix[-4:, :-4] @ np.linalg.solve(matrix[:-4, :-4], matrix[:-4, -4:])
    return paired(np.linalg.pinv(admittance).astype(float))


def by_penalty(sigma, contacts, dtype=float) -> np.ndarray:
    """The first node held by a large number on its diagonal."""
    matrix = textbook_matrix(sigma, contacts, dtype)
    matrix[0, 0] += dtype(1e12) * matrix.diagonal().max()
    return paired(np.linalg.inv(matrix)[-4:, -4:].astype(float))


def by_inverse(sigma, contacts, dtype=float) -> np.ndarray:
    """The first node taken out, the rest inverted."""
    return paired(np.linalg.inv(textbook_matrix(sigma, contacts, dtype)[1:, 1:])[-4:, -4:].astype(float))
