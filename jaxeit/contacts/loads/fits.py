"""Loads of given kinds fitted to one frame, with the errors there."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from .belief import LoadBelief
from .considered import Known, inverse_of
from .pressure import FORMS, free_parameters, padded, padded_forms
from .programs import Problem, before, fit_loads, unknowns_of
from .result import LoadKind
from .sheet import Unknowns

# Half of the fall of chi-square at which a fit ends: one whose errors are those at its start, and the last one.
TRIAL_FALL, LAST_FALL = 1.0, 0.02
ASTRAY = 4.0  # chi-square over the number of readings, above which a fit starts elsewhere


class Fit(NamedTuple):
    """Loads of a kind that explain a frame best.

    | meaning                                                                   | shape      |
    |---------------------------------------------------------------------------|------------|
    | kind of the loads                                                         |            |
    | loads: parameters of all `MAX_LOADS` rows                                 | (3, 6)     |
    | square: sum of squares with that of the prior                             | ()         |
    | normal: half the second derivatives of the square, of all parameters      | (18, 18)   |
    | root: Cholesky factor of the covariance of the errors                     | (r, r)     |
    """

    kind: LoadKind
    loads: np.ndarray
    square: float
    normal: np.ndarray
    root: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """Parameters of the loads that there are, (n, 6)."""
        return self.loads[: len(FORMS[self.kind])]

    @property
    def forms(self) -> np.ndarray:
        """Forms of all rows, (3,)."""
        return padded_forms(self.kind)

    @property
    def free(self) -> np.ndarray:
        """Which of all parameters the kind has, (18,)."""
        return free_parameters(self.forms).ravel()

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the parameters that are fitted, with the shapes that the fit marginalises."""
        return inverse_of(self.normal[np.ix_(self.free, self.free)])[0]

    @property
    def improbability(self) -> float:
        """Twice the surprise of the fit, up to a constant that all fits of a kind share."""
        return float(self.square + 2 * np.sum(np.log(np.diag(self.root))))


@dataclass(frozen=True, eq=False)
class FrameFits:
    """Fits to one frame, whose whitened readings are y, under a belief."""

    belief: LoadBelief
    y: np.ndarray

    def best(self, kind: LoadKind, starts: list[np.ndarray]) -> Fit:
        """The best fit from some starts, with the errors at its end.

        Errors are those where a fit begins. A fit of another force or place than they are meant for can be worse by its
        own errors, and end far away: then the next start is taken.
        """
        tried = sorted((self.fit(kind, start, TRIAL_FALL) for start in starts), key=lambda fit: fit.improbability)
        found: list[Fit] = []
        for first in tried:
            found.append(self.fit(kind, first.rows, LAST_FALL))
            if not self.astray(found[-1]):
                return found[-1]
        return min(found, key=lambda fit: fit.improbability)

    def astray(self, fit: Fit) -> bool:
        """Whether a fit explains so little that another one should start elsewhere."""
        return not fit.square < ASTRAY * len(self.y)

    def fit(self, kind: LoadKind, rows: np.ndarray, fall: float) -> Fit:
        """The best loads near a start, with the errors there."""
        begin, forms = padded(rows), padded_forms(kind)
        bounds = self.belief.bounds(begin, forms)
        start, form = self.belief.put(np.clip(begin, *bounds), forms)
        root = self.errors(unknowns_of(self.belief.sheet, start, form))
        y, given, low, high, end = self.belief.put(self.y, root, *bounds, np.array(fall))
        loads, square, normal = fit_loads(Problem(self.belief, y, form, given), start, (low, high), end)
        return Fit(kind, np.asarray(loads), float(square), np.asarray(normal), root)

    def errors(self, unknowns: Unknowns) -> np.ndarray:
        """Cholesky factor of the covariance of the errors: noise, unknowns, and the rest."""
        slopes = np.asarray(unknowns.nuisances)
        even = 1 + float(self.belief.model_error) ** 2 * (self.y @ self.y) / len(self.y)
        return np.linalg.cholesky(even * np.eye(len(self.y)) + slopes @ slopes.T)

    def unknowns(self, fit: Fit) -> Unknowns:
        """Readings of the loads of a fit, and their slopes."""
        found: Unknowns = unknowns_of(self.belief.sheet, *self.belief.put(fit.loads, fit.forms))
        return found

    def left(self, fit: Fit) -> tuple[np.ndarray, Unknowns]:
        """What a fit leaves of the frame, in units of its errors, and the slopes there."""
        known = self.unknowns(fit)
        return solve_triangular(fit.root, self.y - np.asarray(known.value), lower=True), known

    def reach(self, one: Fit) -> np.ndarray:
        """Second moments that the frame asks for beside a single load, (2,): see `elongations`."""
        left, known = self.left(one)
        slopes = np.concatenate([np.asarray(known.loads)[:, one.free], np.asarray(known.elongation)], 1)
        slopes = solve_triangular(one.root, slopes, lower=True)
        found: np.ndarray = np.linalg.lstsq(slopes, left, rcond=None)[0][-2:]
        return found

    def surprise(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """What is unusual of the loads of a fit (s,), and its slopes in those that are fitted (s, m)."""
        y, form, root, loads = self.belief.put(self.y, fit.forms, fit.root, fit.loads)
        unusual, slopes = map(np.asarray, before(Problem(self.belief, y, form, root), loads))
        return unusual, slopes[:, fit.free]

    def known(self, fit: Fit) -> Known:
        """What is known at the loads of a fit."""
        end = self.unknowns(fit)
        return Known(self.y, end, self.errors(end), *self.surprise(fit))
