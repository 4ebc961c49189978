"""The adjoint formula by hand in NumPy: dV/dsigma_e = - area grad u_drive . grad u_sense."""

import numpy as np
from scipy.sparse import csr_array

from . import cholmod, superlu
from .assembly import gradients

NAME = "adjoint by hand"


def prepare_gradient(problem):
    """Of half the sum of squares of the voltages, from the fields of all electrodes.

    ``- area sum_ab C_ab grad u_a . grad u_b``, where C adds each voltage to the pairs of electrodes it comes from.
    """
    forward = (superlu if cholmod.missing() else cholmod).prepare(problem)
    slopes, triangles, rows = gradients(problem.mesh), problem.mesh.triangles, problem.electrode_nodes
    pairs = [(problem.pattern[:, sense], problem.pattern[:, drive]) for sense in (2, 3) for drive in (0, 1)]
    signs = (1, -1, -1, 1)

    def gradient(sigma):
        x = forward.fields(sigma)
        voltages = forward.readings(x[rows])
        weight = np.zeros((len(rows), len(rows)))
        for (sense, drive), sign in zip(pairs, signs, strict=True):
            np.add.at(weight, (sense, drive), sign * voltages)
        weight = 0.5 * (weight + weight.T)
        out = np.zeros(len(sigma))
        for g in slopes:
            along = np.einsum("ei,eia->ea", g, x[triangles])
            out -= np.einsum("ea,ea->e", along @ weight, along)
        return out

    return gradient


def prepare(problem, pixels: csr_array | None = None):
    """Onto elements, or through ``pixels`` (elements, basis), drive by drive in bounded memory."""
    forward = (superlu if cholmod.missing() else cholmod).prepare(problem)
    slopes, triangles, pairs = gradients(problem.mesh), problem.mesh.triangles, problem.pairs
    project = None if pixels is None else pixels.T.tocsr()
    senses = [np.flatnonzero(row) for row in problem.kept]
    starts = np.cumsum([0, *map(len, senses)])

    def jacobian(sigma):
        x = forward.fields(sigma)
        drop = np.ascontiguousarray((x[:, pairs[:, 0]] - x[:, pairs[:, 1]]).T)
        gx, gy = (np.einsum("pei,ei->pe", drop[:, triangles], -g) for g in slopes)
        out = np.empty((starts[-1], len(sigma) if project is None else project.shape[0]))
        for drive, sense in enumerate(senses):
            block = -gx[drive] * gx[sense] - gy[drive] * gy[sense]
            out[starts[drive] : starts[drive + 1]] = block if project is None else (project @ block.T).T
        return out

    return jacobian
