"""One cell of a square lattice of inclusions in a sheet, resolved: bilinear elements on a quarter of it.

The mean field is along x and the cell even and odd about its middle lines, so that the potential is 0 on
the middle line x = 0 and in the metal above the cell, 1 at the cell's side, and nothing flows through
y = 0 and the top.  The sheet exchanges current with the metal through ``exchange``, S/m^2.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

_STIFFNESS = np.array([[4, -1, -2, -1], [-1, 4, -1, -2], [-2, -1, 4, -1], [-1, -2, -1, 4]]) / 6
_MASS = np.array([[4, 2, 1, 2], [2, 4, 2, 1], [1, 2, 4, 2], [2, 1, 2, 4]]) / 36


def effective_conductivity(width, sigma, exchange):
    """Of the lattice, S; ``sigma`` and ``exchange`` are (n, n) of the squares of the quarter ``width`` wide."""
    n = len(sigma)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()  # row y, column x
    nodes = corner[:, None] + np.array([0, 1, n + 2, n + 1])
    blocks = sigma.ravel()[:, None, None] * _STIFFNESS + (exchange.ravel() * (width / n) ** 2)[:, None, None] * _MASS
    rows, columns = np.repeat(nodes, 4, 1).ravel(), np.tile(nodes, (1, 4)).ravel()
    matrix = coo_matrix((blocks.ravel(), (rows, columns)), shape=((n + 1) ** 2,) * 2).tocsr()
    x = np.arange((n + 1) ** 2) % (n + 1)
    u, free = np.where(x == n, 1.0, 0.0), (x > 0) & (x < n)
    u[free] = spsolve(matrix[free][:, free], -(matrix @ u)[free])
    return u @ matrix @ u


def covered(width, n, inside, samples=8):
    """Share of each square of the quarter that lies inside, (n, n), by samples."""
    x = (np.arange(n * samples) + 0.5) * width / (n * samples)
    return inside(*np.meshgrid(x, x)).reshape(n, samples, n, samples).mean((1, 3))
