"""SuperLU through SciPy, with its options for symmetric matrices."""

import numpy as np
from scipy.sparse.linalg import splu

from .assembly import DirectForward

NAME = "SuperLU by hand"


def missing() -> None:
    """It comes with SciPy."""


class _Factor:
    """The ordering is found once: SciPy cannot keep it, so the matrix is permuted beforehand."""

    def __init__(self) -> None:
        self.order: np.ndarray | None = None

    def __call__(self, matrix):
        if self.order is None:
            self._analyse(matrix)
        self.permuted.data[:] = matrix.data[self.gather]
        return self._solve(_splu(self.permuted, "NATURAL"))

    def _analyse(self, matrix) -> None:
        self.order = np.argsort(_splu(matrix, "MMD_AT_PLUS_A").perm_c)
        numbered = matrix.copy()
        numbered.data = np.arange(len(matrix.data), dtype=float)
        self.permuted = numbered[self.order][:, self.order].tocsc()
        self.permuted.sort_indices()
        self.gather = self.permuted.data.astype(int)

    def _solve(self, lu):
        def solve(rhs):
            x = np.empty_like(rhs)
            x[self.order] = lu.solve(rhs[self.order])
            return x

        return solve


def _splu(matrix, ordering: str):
    return splu(matrix, permc_spec=ordering, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def prepare(problem) -> DirectForward:
    return DirectForward(problem, _Factor())
