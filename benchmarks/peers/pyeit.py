"""pyEIT as its users call it: `EITForward.solve_eit`, `compute_jac` and `JAC` on the same mesh and pairs."""

import numpy as np

try:
    from pyeit.eit.fem import EITForward
    from pyeit.eit.jac import JAC
    from pyeit.eit.protocol import PyEITProtocol
    from pyeit.mesh import PyEITMesh
except ImportError:
    EITForward = None

NAME = "pyEIT"


def missing() -> str | None:
    return None if EITForward else "pyeit is not installed (pip install pyeit)"


def _work(problem):
    """Mesh and protocol.  pyEIT wants as many readings for each drive: all 40, of which those kept are taken."""
    nodes, wanted = problem.mesh.nodes, problem.electrode_nodes
    ground = int(np.setdiff1d(np.arange(len(nodes)), wanted)[0])
    mesh = PyEITMesh(nodes, problem.mesh.triangles, 1.0, el_pos=wanted, ref_node=ground)
    every = np.broadcast_to(problem.pairs, (40, 40, 2)).copy()
    return mesh, PyEITProtocol(problem.pairs, every, problem.kept.ravel())


def _solver(problem):
    return EITForward(*_work(problem))


def prepare(problem):
    solver, kept = _solver(problem), problem.kept.ravel()
    return lambda sigma: solver.solve_eit(sigma)[kept]


def prepare_jacobian(problem):
    """pyEIT leaves out the sign of dV/dsigma."""
    solver, kept = _solver(problem), problem.kept.ravel()
    return lambda sigma: -solver.compute_jac(sigma)[0][kept]


def prepare_inverse(problem, strength: float):
    """`JAC` with method "kotre" and p = 0.5, (elements, readings): what its `setup` does, for the readings kept."""
    solver, kept = JAC(*_work(problem)), problem.kept.ravel()

    def matrix(sigma):
        jacobian = solver.fwd.compute_jac(sigma)[0][kept]
        return -solver._compute_h(jacobian, 0.5, strength, "kotre")

    return matrix


def prepare_pipeline(problem, strength: float, frames: np.ndarray):
    """From the mesh to images of frames, (readings, frames); see `prepare_inverse`."""

    def images(sigma):
        return prepare_inverse(problem, strength)(sigma) @ frames

    return images
