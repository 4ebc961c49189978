"""CHOLMOD through scikit-sparse (LGPL and GPL): a peer to measure against, never a dependency."""

from typing import Any

import numpy as np

from .assembly import DirectForward

try:
    from sksparse import cholmod
except ImportError:
    cholmod = None

NAME = "CHOLMOD by hand"


def missing() -> str | None:
    return None if cholmod else "scikit-sparse is not installed"


class _Factor:
    """Symbolic analysis once: the best of CHOLMOD's orderings, simplicial or supernodal as it chooses."""

    def __init__(self) -> None:
        self.symbolic: Any = None

    def __call__(self, matrix):
        if self.symbolic is None:
            self.symbolic = cholmod.analyze(matrix, mode="auto", ordering_method="best")
        self.symbolic.cholesky_inplace(matrix)
        return self.symbolic


def prepare(problem) -> DirectForward:
    return DirectForward(problem, _Factor())


class _Substituted(DirectForward):
    """Forward substitution only: with ``P A P^T = L D L^T``, potentials of electrodes are ``W^T D^-1 W``,
    ``W = L^-1 P E``; half of the substitutions, and no potentials elsewhere."""

    def __call__(self, sigma: np.ndarray) -> np.ndarray:
        self.matrix.data[:] = self.spread @ sigma
        factor = self.factor(self.matrix)
        w = factor.solve_L(factor.apply_P(self.rhs), use_LDLt_decomposition=True)
        return self.readings(w.T @ (w / factor.D()[:, None]))


def prepare_substituted(problem) -> DirectForward:
    return _Substituted(problem, _Factor())
