"""SuperLU through SciPy, with its options for symmetric matrices."""

import time

import numpy as np
from scipy.sparse.linalg import splu

from .assembly import DirectForward

NAME = "SuperLU by hand"
PANELS = (1, 4, 20)


def missing() -> None:
    """It comes with SciPy."""


class _Factor:
    """Ordering and panel size are chosen once.

    SciPy cannot keep an ordering, so the matrix is permuted beforehand.  Panels are narrower than
    SuperLU's own choice, which was made for larger problems: the quickest of a few is kept.
    """

    def __init__(self) -> None:
        self.order: np.ndarray | None = None

    def __call__(self, matrix):
        if self.order is None:
            self._analyse(matrix)
        self.permuted.data[:] = matrix.data[self.gather]
        return self._solve(_splu(self.permuted, "NATURAL", self.panel))

    def _analyse(self, matrix) -> None:
        self.order = np.argsort(_splu(matrix, "MMD_AT_PLUS_A").perm_c)
        numbered = matrix.copy()
        numbered.data = np.arange(len(matrix.data), dtype=float)
        self.permuted = numbered[self.order][:, self.order].tocsc()
        self.permuted.sort_indices()
        self.gather = self.permuted.data.astype(int)
        self.permuted.data[:] = matrix.data[self.gather]
        self.panel = min(PANELS, key=lambda panel: _once(self.permuted, panel))

    def _solve(self, lu):
        def solve(rhs):
            x = np.empty_like(rhs)
            x[self.order] = lu.solve(rhs[self.order])
            return x

        return solve


def _once(matrix, panel: int, tries: int = 3) -> float:
    """Least time of a factorisation with its solves, in s."""
    rhs, times = np.ones((matrix.shape[0], 25)), []
    for _ in range(tries):
        start = time.perf_counter()
        _splu(matrix, "NATURAL", panel).solve(rhs)
        times.append(time.perf_counter() - start)
    return min(times)


def _splu(matrix, ordering: str, panel: int | None = None):
    options = {"SymmetricMode": True}
    return splu(matrix, ordering, diag_pivot_thresh=0.0, relax=panel, panel_size=panel, options=options)


def prepare(problem) -> DirectForward:
    return DirectForward(problem, _Factor())
