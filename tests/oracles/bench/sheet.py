"""The sheet by linear finite elements with the complete electrode model, and exact updates for touching patches.

Unknowns are the potentials u at the points and U of the bolts; the last bolt is grounded.  The energy is

    sum_t sigma_t |grad u|^2 + sum_l (1 / rho) integral over bolt l of (u - U_l)^2.

The sheet is factorised once.  A patch p of a protrusion exchanges current with the sheet through the mean
potential ``P_p^T u`` beneath it.  With ``G = P^T K^-1 P`` between patches and ``E = P^T K^-1 F`` to the bolts,
patches joined by the conductance matrix L change the bolts' transfer matrix by Woodbury's identity:

    Z = Z0 - E^T L (1 + G L)^-1 E.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree

from .mesh import Mesh, doubled_areas

MASS = (np.ones((3, 3)) + np.eye(3)) / 12


@dataclass(frozen=True, eq=False)
class Sheet:
    """A factorised sheet: its mesh, factors, number of bolts, and the bolts' transfer matrix untouched, ohm."""

    mesh: Mesh
    factors: SuperLU
    bolts: int
    untouched: np.ndarray


def make_sheet(mesh: Mesh, sigma: np.ndarray, contact: float) -> Sheet:
    """Assemble and factorise; ``sigma`` (t,) in siemens, ``contact`` in ohm m^2."""
    count, bolts = len(mesh.points), mesh.bolt.max() + 1
    matrix = assemble(mesh, sigma, contact)[:-1, :-1]
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    currents = np.zeros((count + bolts - 1, bolts))
    currents[count + np.arange(bolts - 1), np.arange(bolts - 1)] = 1.0
    untouched = np.zeros((bolts, bolts))
    untouched[:-1] = factors.solve(currents)[count:]
    return Sheet(mesh, factors, bolts, untouched)


def assemble(mesh: Mesh, sigma: np.ndarray, contact: float) -> csc_matrix:
    """Second derivatives of half the energy in (u, U), singular until one potential is given."""
    count = len(mesh.points)
    area = doubled_areas(mesh.points[mesh.triangles]) / 2
    under = mesh.bolt >= 0
    held = np.concatenate([mesh.triangles[under], count + mesh.bolt[under, None]], 1)
    drop = np.concatenate([np.eye(3), -np.ones((3, 1))], 1)  # u - U at the corners
    robin = area[under, None, None] / contact * (drop.T @ MASS @ drop)
    size = count + mesh.bolt.max() + 1
    return _sparse(mesh.triangles, _stiffness(mesh, sigma, area), size) + _sparse(held, robin, size)


def _stiffness(mesh: Mesh, sigma: np.ndarray, area: np.ndarray) -> np.ndarray:
    corners = mesh.points[mesh.triangles]
    edges = np.roll(corners, -1, 1) - np.roll(corners, 1, 1)  # opposite to each corner; as long as its gradient
    return (sigma / (4 * area))[:, None, None] * (edges @ edges.transpose(0, 2, 1))


def _sparse(dofs: np.ndarray, blocks: np.ndarray, size: int) -> csc_matrix:
    k = dofs.shape[1]
    rows, columns = np.repeat(dofs, k, 1).ravel(), np.tile(dofs, (1, k)).ravel()
    return coo_matrix((blocks.ravel(), (rows, columns)), shape=(size, size)).tocsc()


def mean_potentials(mesh: Mesh, samples: np.ndarray) -> csc_matrix:
    """Matrix (n, patches) that takes the mean of u over each patch, from ``samples`` (patches, k, 2) in it."""
    patches, k, _ = samples.shape
    triangle, weights = _locate(mesh, samples.reshape(-1, 2))
    rows, columns = mesh.triangles[triangle].ravel(), np.repeat(np.arange(patches), 3 * k)
    return coo_matrix((weights.ravel() / k, (rows, columns)), shape=(len(mesh.points), patches)).tocsc()


def _locate(mesh: Mesh, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangle at each place and the barycentric weights there: the best of those with near centres."""
    corners = mesh.points[mesh.triangles]
    _, near = cKDTree(corners.mean(1)).query(places, k=24)
    a, b, c = np.moveaxis(corners[near], 2, 0)
    p = places[:, None]
    cross = lambda u, v: u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]  # noqa: E731
    weights = np.stack([cross(b - p, c - p), cross(c - p, a - p), cross(a - p, b - p)], -1)
    weights /= cross(b - a, c - a)[..., None]
    best = weights.min(-1).argmax(1)
    each = np.arange(len(places))
    return near[each, best], weights[each, best]


def green(sheet: Sheet, patches: csc_matrix, block: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """G (patches, patches) and E (patches, bolts), ohm: potentials at patches from patches, and from bolts."""
    count, total = patches.shape
    between, bolts = np.empty((total, total)), np.zeros((total, sheet.bolts))
    sources = np.zeros((count + sheet.bolts - 1, block))
    for start in range(0, total, block):
        part = patches[:, start : start + block]
        sources[:count, : part.shape[1]] = part.toarray()
        found = sheet.factors.solve(sources[:, : part.shape[1]])
        between[:, start : start + block] = patches.T @ found[:count]
        bolts[start : start + block, :-1] = found[count:].T
    return between, bolts


def touched(sheet: Sheet, between: np.ndarray, bolts: np.ndarray, conductances: np.ndarray) -> np.ndarray:
    """Transfer matrix of the bolts with patches joined by ``conductances`` L (patches, patches), S."""
    within = np.eye(len(conductances)) + between @ conductances
    return sheet.untouched - bolts.T @ conductances @ np.linalg.solve(within, bolts)


def readings(transfer: np.ndarray, pattern: np.ndarray, current: float) -> np.ndarray:
    """Volts of each row (drive+, drive-, sense+, sense-) of the pattern."""
    source, sink, plus, minus = pattern.T
    return current * (transfer[plus, source] - transfer[minus, source] - transfer[plus, sink] + transfer[minus, sink])
