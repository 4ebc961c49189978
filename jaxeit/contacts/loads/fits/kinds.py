"""Loads of given kinds fitted to one frame, with the errors there."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from ..belief import LoadBelief
from ..pressure import FORMS, free_parameters, pad_rows, padded_forms
from ..result import LoadKind
from ..sheet import Sensitivities
from .programs import LoadProblem, fit_loads, linearise_prior, sensitivities_of
from .shape_errors import Linearisation, inverse_of

# Predicted fall of half of chi-square at which a fit ends: a trial, whose errors are those at its start, and the final
# fit.
TRIAL_FALL_ATOL, FINAL_FALL_ATOL = 1.0, 0.02
MAX_REDUCED_MISFIT = 4.0  # chi-square over the number of readings, above which a fit is poor and starts elsewhere


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
    def deviance(self) -> float:
        """Minus twice the log density of the fit, up to a constant that all fits of a kind share."""
        return float(self.square + 2 * np.sum(np.log(np.diag(self.root))))


@dataclass(frozen=True, eq=False)
class FrameFits:
    """Fits to one frame, whose whitened readings are y, under a belief."""

    belief: LoadBelief
    y: np.ndarray

    def best_fit(self, kind: LoadKind, starts: list[np.ndarray]) -> Fit:
        """The best fit from some starts, with the errors at its end.

        Errors are those where a fit begins. A fit of another force or place than they are meant for can be worse by its
        own errors, and end far away: then the next start is taken.
        """
        tried = sorted((self.fit(kind, start, TRIAL_FALL_ATOL) for start in starts), key=lambda fit: fit.deviance)
        found: list[Fit] = []
        for first in tried:
            found.append(self.fit(kind, first.rows, FINAL_FALL_ATOL))
            if not self.is_poor(found[-1]):
                return found[-1]
        return min(found, key=lambda fit: fit.deviance)

    def is_poor(self, fit: Fit) -> bool:
        """Whether a fit explains so little that another one should start elsewhere (`MAX_REDUCED_MISFIT`)."""
        return not fit.square < MAX_REDUCED_MISFIT * len(self.y)

    def fit(self, kind: LoadKind, rows: np.ndarray, fall_atol: float) -> Fit:
        """The best loads near a start, with the errors there."""
        start_rows, forms = pad_rows(rows), padded_forms(kind)
        bounds = self.belief.bounds(start_rows, forms)
        start, form = self.belief.to_jax(np.clip(start_rows, *bounds), forms)
        root = self.error_factor(sensitivities_of(self.belief.sheet, start, form))
        y, factor, low, high, atol = self.belief.to_jax(self.y, root, *bounds, np.array(fall_atol))
        loads, square, normal = fit_loads(LoadProblem(self.belief, y, form, factor), start, (low, high), atol)
        return Fit(kind, np.asarray(loads), float(square), np.asarray(normal), root)

    def error_factor(self, sensitivities: Sensitivities) -> np.ndarray:
        """Cholesky factor of the covariance of the errors: noise, unknowns, and the rest."""
        slopes = np.asarray(sensitivities.nuisances)
        noise_variance = 1 + float(self.belief.model_error) ** 2 * (self.y @ self.y) / len(self.y)
        return np.linalg.cholesky(noise_variance * np.eye(len(self.y)) + slopes @ slopes.T)

    def sensitivities(self, fit: Fit) -> Sensitivities:
        """Readings of the loads of a fit, and their slopes."""
        found: Sensitivities = sensitivities_of(self.belief.sheet, *self.belief.to_jax(fit.loads, fit.forms))
        return found

    def residual(self, fit: Fit) -> tuple[np.ndarray, Sensitivities]:
        """Residual of a fit in units of its errors, and the sensitivities there."""
        sensitivities = self.sensitivities(fit)
        return solve_triangular(fit.root, self.y - np.asarray(sensitivities.value), lower=True), sensitivities

    def second_moments(self, one: Fit) -> np.ndarray:
        """Second moments by which the frame differs from a single load, (2,): see `elongations`."""
        residual, sensitivities = self.residual(one)
        slopes = np.concatenate([np.asarray(sensitivities.loads)[:, one.free], np.asarray(sensitivities.elongation)], 1)
        slopes = solve_triangular(one.root, slopes, lower=True)
        found: np.ndarray = np.linalg.lstsq(slopes, residual, rcond=None)[0][-2:]
        return found

    def prior_residual(self, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Prior residual of the loads of a fit (s,), and its slopes in the free parameters (s, m)."""
        y, form, root, loads = self.belief.to_jax(self.y, fit.forms, fit.root, fit.loads)
        residual, slopes = map(np.asarray, linearise_prior(LoadProblem(self.belief, y, form, root), loads))
        return residual, slopes[:, fit.free]

    def linearise(self, fit: Fit) -> Linearisation:
        """Linearise readings and prior at the loads of a fit."""
        sensitivities = self.sensitivities(fit)
        return Linearisation(self.y, sensitivities, self.error_factor(sensitivities), *self.prior_residual(fit))
