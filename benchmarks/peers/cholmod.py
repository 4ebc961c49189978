"""CHOLMOD through scikit-sparse (LGPL and GPL): a peer to measure against, never a dependency."""

from typing import Any

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
