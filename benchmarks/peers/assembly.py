"""What a direct solver is given by hand: P1 assembly as one sparse product, readings by indexing."""

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_array, csc_matrix, csr_array

Factor = Callable[[csc_matrix], Callable[[np.ndarray], np.ndarray]]


class DirectForward:
    """Forward model around a sparse direct solver.

    Pattern, unit stiffness and right-hand sides are made once; a call scatters sigma, factors, solves
    for 25 unit currents, and takes differences.
    """

    def __init__(self, problem, factor: Factor) -> None:
        self.problem, self.factor = problem, factor
        ground = int(np.setdiff1d(np.arange(len(problem.mesh.nodes)), problem.electrode_nodes)[0])
        self.free = np.delete(np.arange(len(problem.mesh.nodes)), ground)
        index = np.full(len(problem.mesh.nodes), -1)
        index[self.free] = np.arange(len(self.free))
        self.rows = index[problem.electrode_nodes]
        self.spread, self.matrix = _scatter(index[problem.mesh.triangles], unit_stiffness(problem.mesh))
        self.rhs = np.zeros((len(self.free), len(self.rows)))
        self.rhs[self.rows, np.arange(len(self.rows))] = 1

    def fields(self, sigma: np.ndarray) -> np.ndarray:
        """Potentials per ampere into each electrode, (nodes, electrodes)."""
        x = np.zeros((len(self.problem.mesh.nodes), self.rhs.shape[1]))
        x[self.free] = self._solve(sigma)
        return x

    def __call__(self, sigma: np.ndarray) -> np.ndarray:
        return self.readings(self._solve(sigma)[self.rows])

    def readings(self, z: np.ndarray) -> np.ndarray:
        """Voltages of the protocol, from potentials of electrodes per ampere into each, (electrodes, electrodes)."""
        source, sink, plus, minus = self.problem.pattern.T
        return z[plus, source] - z[minus, source] - z[plus, sink] + z[minus, sink]

    def _solve(self, sigma: np.ndarray) -> np.ndarray:
        self.matrix.data[:] = self.spread @ sigma
        return self.factor(self.matrix)(self.rhs)


def gradients(mesh) -> np.ndarray:
    """Slopes of the shape functions times the root of the area: (2, elements, 3)."""
    corners = mesh.nodes[mesh.triangles]
    opposite = np.roll(corners, -2, 1) - np.roll(corners, -1, 1)
    slopes = np.stack([-opposite[..., 1], opposite[..., 0]])
    return slopes / (2 * np.sqrt(mesh.areas)[:, None])


def unit_stiffness(mesh) -> np.ndarray:
    g = gradients(mesh)
    return np.einsum("cei,cej->eij", g, g)


def _scatter(dofs: np.ndarray, stiffness: np.ndarray) -> tuple[csr_array, csc_matrix]:
    """Matrix values = sparse matrix times sigma, and a matrix of that pattern."""
    n = dofs.max() + 1
    rows, cols = np.repeat(dofs, 3, 1).ravel(), np.tile(dofs, (1, 3)).ravel()
    element = np.repeat(np.arange(len(dofs)), 9)
    kept = (rows >= 0) & (cols >= 0)
    places, slot = np.unique(cols[kept] * n + rows[kept], return_inverse=True)
    spread = coo_array((stiffness.ravel()[kept], (slot, element[kept])), shape=(len(places), len(dofs)))
    starts = np.searchsorted(places, n * np.arange(n + 1))
    matrix = csc_matrix((np.ones(len(places)), places % n, starts), shape=(n, n))
    return spread.tocsr(), matrix
