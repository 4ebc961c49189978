"""Kinds of loads of one frame compared: which fits are tried, from where, and how probable each kind is."""

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy.linalg import solve_triangular
from scipy.stats import norm

from ..result import Contacts
from .considered import Known, inverse_of, mean_errors, slopes_in_law
from .pressure import FORCE, LOAD_PARAMETERS, MAX_LOADS, Form
from .programs import Problem, before, fit_loads, unknowns_of
from .proposal import Proposed
from .result import LoadKind, Loads, LoadShape
from .sheet import Unknowns

if TYPE_CHECKING:
    from .fitter import LoadFitter

FORMS = {
    LoadKind.ONE: (Form.ROUND,),
    LoadKind.TWO: (Form.ROUND, Form.ROUND),
    LoadKind.EDGE: (Form.LONG,),
    LoadKind.MORE: (Form.ROUND, Form.ROUND, Form.ROUND),
}
PAIRS = ((0, 1), (0, 2), (1, 2))  # of three loads
# Half of the fall of chi-square at which a fit ends: one whose errors are those at its start, and the last one.
TRIAL_FALL, LAST_FALL = 1.0, 0.02
MIN_FALL = 12.0  # of chi-square by a third load, below which none is fitted
ASTRAY = 4.0  # chi-square over the number of readings, above which a fit starts elsewhere
MIN_PROBABILITY = 2e-3  # of a kind that is proposed, below which it is not fitted
# Chi-square over the number of readings, above which a fit from a proposal is searched too. Proposals of three loads
# often begin astray. Beyond 1.3 lies one in a thousand of fits whose errors are those believed.
SURPRISING = 2.0
# Probability that the evidence of fits tells kinds, beside a proposal; otherwise it says nothing. Fits know the forward
# map and one load's shape; the network has seen shapes, layers and faults that fits do not have. Of 0.3, 0.5, 0.7 and
# 0.9, this number had the least surprise on frames of skins that neither had seen (docs/proposal.md).
TRUST = 0.3
# Part of the mean error by which the place of a single load moves, and the mean error, in widths, beyond which nothing
# moves. The whole step makes tilted tips better and rings worse, whose moments are too large for slopes; half of it
# makes neither worse.
MOVED, FAR = 0.5, 0.5
MOST_TOLD = 0.7  # change of the log of a force by `ForceLaw`, at most: its law is to first order
MIN_SHARE = 0.15  # of the force, that the weaker of two ends of an edge bears


class Fit(NamedTuple):
    """Loads of a kind that explain a frame best.

    | meaning                                                                   | shape      |
    |---------------------------------------------------------------------------|------------|
    | loads: parameters of all `MAX_LOADS` rows                                 | (3, 6)     |
    | square: sum of squares with that of the prior                             | ()         |
    | normal: half the second derivatives of the square, of all parameters      | (18, 18)   |
    | root: Cholesky factor of the covariance of the errors                     | (r, r)     |
    """

    loads: np.ndarray
    square: float
    normal: np.ndarray
    root: np.ndarray


def improbability(fit: Fit) -> float:
    """Twice the surprise of a fit, up to a constant that all fits of a kind share."""
    return float(fit.square + 2 * np.sum(np.log(np.diag(fit.root))))


def free_parameters(forms: np.ndarray) -> np.ndarray:
    """Which parameters of all rows are fitted, (MAX_LOADS, 6)."""
    free: np.ndarray = np.arange(LOAD_PARAMETERS) < np.array([0, 4, 6])[forms][:, None]
    return free


def padded(rows: np.ndarray, kind: LoadKind) -> tuple[np.ndarray, np.ndarray]:
    """All rows of parameters, and their forms."""
    forms = np.zeros(MAX_LOADS, np.int32)
    forms[: len(FORMS[kind])] = FORMS[kind]
    rows = np.pad(rows, ((0, 0), (0, LOAD_PARAMETERS - rows.shape[1])))
    return np.concatenate([rows, np.repeat(rows[-1:], MAX_LOADS - len(rows), 0)]), forms


class Comparison:
    """Kinds of loads of one frame, whose whitened readings are y, fitted and compared."""

    def __init__(self, fitter: "LoadFitter", y: np.ndarray, contacts: Contacts | None):
        self.fitter, self.y, self.contacts = fitter, y, contacts

    def put(self, *arrays: np.ndarray) -> tuple[Array, ...]:
        """Arrays as JAX holds them; numbers in the precision of the model."""
        dtype = self.fitter.low.dtype
        return tuple(jnp.asarray(array, dtype if array.dtype.kind == "f" else None) for array in arrays)

    def loads(self) -> Loads:
        """Loads of all kinds with their probabilities."""
        fits = self.searched()
        # What the finder cannot tell from noise is nothing.
        there = self.contacts is None or bool(np.any(self.contacts.present))
        evidence = self.evidences(fits) if there else self.evidences({}) | dict.fromkeys(fits, -np.inf)
        return self.summary(evidence, {LoadKind.MORE: fits[LoadKind.TWO]} | fits)

    def searched(self) -> dict[LoadKind, Fit]:
        """Fits of all kinds from where frame and finder say; of three loads only where a third explains more."""
        fits = {LoadKind.ONE: self.one()}
        one = fits[LoadKind.ONE]
        halves, long = self.fitter.starts.split(one.loads[0], self.reach(one))
        fits[LoadKind.TWO] = self.best(LoadKind.TWO, [halves, *self.seen(2)])
        two = fits[LoadKind.TWO]
        share, between = self.fitter.starts.between(two.loads[:2])
        fits[LoadKind.EDGE] = self.best(LoadKind.EDGE, [between if share > MIN_SHARE else long])
        left, known = self.left(LoadKind.TWO, two)
        slopes = np.asarray(known.loads)[:, self.free(LoadKind.TWO, two)]
        fall, three = self.fitter.starts.another(two, left, slopes)
        if fall > MIN_FALL:
            fits[LoadKind.MORE] = self.best(LoadKind.MORE, [three, *self.seen(3)])
        return fits

    def refined(self, proposed: Proposed) -> Loads:
        """Loads of the kinds that are proposed, from where they are proposed; searched too where these surprise."""
        likely = [kind for kind in FORMS if proposed.probability[kind] > MIN_PROBABILITY]
        fits = {kind: self.best(kind, [proposed.of(kind)]) for kind in {LoadKind.ONE: None} | dict.fromkeys(likely)}
        found = self.pooled(proposed, fits)
        left = fits[found.kind].square if found.kind in fits else float(self.y @ self.y)
        if left <= SURPRISING * len(self.y):
            return found
        for kind, other in self.searched().items():
            fits[kind] = min(other, fits.get(kind, other), key=improbability)
        return self.pooled(proposed, fits)

    def pooled(self, proposed: Proposed, fits: dict[LoadKind, Fit]) -> Loads:
        """Loads of fits, whose kinds are as probable as the proposal and the fits say together."""
        evidence = self.evidences(fits)
        found = self.summary(evidence, fits)
        pooled = TRUST * np.asarray(found.probability) + (1 - TRUST) / len(LoadKind)
        pooled *= proposed.probability * np.isin(np.arange(len(LoadKind)), list(evidence))
        return replace(found, probability=self.put(pooled / pooled.sum())[0])

    def seen(self, count: int) -> list[np.ndarray]:
        """Loads of the contacts that a finder saw, if there are so many."""
        return [] if self.contacts is None else self.fitter.starts.seen(self.contacts, count)

    def one(self) -> Fit:
        """The best single load; where the contacts lead astray, a usual load in their place or the best atom."""
        starts = self.fitter.starts
        if self.contacts is None:
            return self.best(LoadKind.ONE, [starts.atom(self.y, np.eye(len(self.y)))[1]])
        begin = starts.single(self.y, self.contacts)
        found = self.best(LoadKind.ONE, [begin])
        if found.square < ASTRAY * len(self.y):
            return found
        usual = np.append(begin[0, :2], np.asarray(self.fitter.usual))[None]
        anew = self.best(LoadKind.ONE, [usual, starts.atom(self.y, np.eye(len(self.y)))[1]])
        return min(found, anew, key=lambda fit: fit.square)

    def best(self, kind: LoadKind, starts: list[np.ndarray]) -> Fit:
        """The best fit from some starts, with the errors at its end.

        Errors are those where a fit begins. A fit of another force or place than they are meant for can be worse by its
        own errors, and end far away: then the next start is taken.
        """
        tried = sorted((self.fit(kind, start, TRIAL_FALL) for start in starts), key=improbability)
        found: list[Fit] = []
        for first in tried:
            found.append(self.fit(kind, first.loads[: len(FORMS[kind])], LAST_FALL))
            if found[-1].square < ASTRAY * len(self.y):
                return found[-1]
        return min(found, key=improbability)

    def fit(self, kind: LoadKind, rows: np.ndarray, fall: float) -> Fit:
        """The best loads near a start, with the errors there."""
        begin, forms = padded(rows, kind)
        bounds = self.fitter.bounds(begin, forms)
        start, form = self.put(np.clip(begin, *bounds), forms)
        root = self.errors(unknowns_of(self.fitter, start, form))
        y, given, low, high, end = self.put(self.y, root, *bounds, np.array(fall))
        loads, square, normal = fit_loads(self.fitter, y, start, form, given, (low, high), end)
        return Fit(np.asarray(loads), float(square), np.asarray(normal), root)

    def left(self, kind: LoadKind, fit: Fit) -> tuple[np.ndarray, Unknowns]:
        """What a fit leaves of the frame, in units of its errors, and the slopes there."""
        forms = padded(fit.loads[: len(FORMS[kind])], kind)[1]
        known = unknowns_of(self.fitter, *self.put(fit.loads, forms))
        return solve_triangular(fit.root, self.y - np.asarray(known.value), lower=True), known

    def errors(self, unknowns: Unknowns) -> np.ndarray:
        """Cholesky factor of the covariance of the errors: noise, unknowns, and the rest."""
        slopes = np.asarray(unknowns.nuisances)
        even = 1 + float(self.fitter.model_error) ** 2 * (self.y @ self.y) / len(self.y)
        return np.linalg.cholesky(even * np.eye(len(self.y)) + slopes @ slopes.T)

    def reach(self, one: Fit) -> np.ndarray:
        """Second moments that the frame asks for beside a single load, (2,): see `elongations`."""
        left, known = self.left(LoadKind.ONE, one)
        slopes = np.concatenate([np.asarray(known.loads)[:, :4], np.asarray(known.elongation)], 1)
        slopes = solve_triangular(one.root, slopes, lower=True)
        found: np.ndarray = np.linalg.lstsq(slopes, left, rcond=None)[0][4:]
        return found

    def evidences(self, fits: dict[LoadKind, Fit]) -> dict[LoadKind, float]:
        """Evidence of each kind that is fitted, and of none.

        Loads near one another, and a short edge, describe a flat, ringlike or tilted tip better than the slopes in the
        shape of a Gaussian do. The part of their evidence where they are so near or short is evidence of fewer loads.
        """
        found = {kind: self.evidence(kind, fit) for kind, fit in fits.items()}
        nearest, shortest = np.asarray(self.fitter.least)
        for kind, least in ((LoadKind.TWO, nearest), (LoadKind.EDGE, shortest), (LoadKind.MORE, nearest)):
            if kind not in fits:
                continue
            beyond = sorted(self.beyond(kind, fits[kind], step, float(least)) for step in self.steps(kind, fits[kind]))
            fewer = LoadKind.TWO if kind is LoadKind.MORE and beyond[1] > 0 else LoadKind.ONE
            if fewer in found:
                found[fewer] = np.logaddexp(found[fewer], found[kind] + norm.logcdf(-beyond[0]))
                found[kind] += norm.logcdf(beyond[0])
        return found | {LoadKind.NONE: -0.5 * float(self.y @ self.y)}

    def steps(self, kind: LoadKind, fit: Fit) -> list[np.ndarray]:
        """From the parameters of a fit to the way from one load to another, or along an edge; (2, m) each."""
        place = [np.eye(2, int(np.count_nonzero(self.free(kind, fit))), k=4 * k) for k in range(MAX_LOADS)]
        if kind is LoadKind.EDGE:
            return [2 * place[1]]  # after place, width and force come the half lengths
        return [place[j] - place[i] for i, j in PAIRS if j < len(FORMS[kind])]

    def beyond(self, kind: LoadKind, fit: Fit, step: np.ndarray, least: float) -> float:
        """By how many standard deviations two loads are farther apart, or an edge is longer, than the least."""
        covariance = self.covariance(kind, fit)
        away = step @ fit.loads.ravel()[self.free(kind, fit)]
        distance = max(float(np.linalg.norm(away)), np.finfo(float).tiny)
        along = away @ step / distance
        return (distance - least) / float(np.sqrt(max(along @ covariance @ along, np.finfo(float).tiny)))

    @staticmethod
    def free(kind: LoadKind, fit: Fit) -> np.ndarray:
        """Which of all parameters a kind has, (18,)."""
        return free_parameters(padded(fit.loads[: len(FORMS[kind])], kind)[1]).ravel()

    def covariance(self, kind: LoadKind, fit: Fit) -> np.ndarray:
        """Covariance of the parameters that are fitted, with the shapes that the fit marginalises."""
        free = self.free(kind, fit)
        return inverse_of(fit.normal[np.ix_(free, free)])[0]

    def evidence(self, kind: LoadKind, fit: Fit) -> float:
        """Logarithm of the evidence of a kind of loads, up to a constant that all kinds share."""
        free = self.free(kind, fit)
        # A place that the frame does not tell is somewhere on the sheet: the variance of an even density bounds it.
        sides = np.asarray(self.fitter.high - self.fitter.low, float)
        on_sheet = np.tile(np.concatenate([12 / sides**2, np.zeros(LOAD_PARAMETERS - 2)]), MAX_LOADS)
        sign, volume = np.linalg.slogdet((fit.normal + np.diag(on_sheet))[np.ix_(free, free)])
        noise = np.sum(np.log(np.diag(fit.root)))
        found = self.fitter.log_prior(kind, fit.loads) - 0.5 * fit.square - noise
        found += 0.5 * (np.count_nonzero(free) * np.log(2 * np.pi) - volume)
        return float(found) if sign > 0 and np.isfinite(found) else -np.inf

    def summary(self, evidence: dict[LoadKind, float], fits: dict[LoadKind, Fit]) -> Loads:
        """Probabilities from evidence, and the loads of each kind."""
        with np.errstate(divide="ignore"):
            logs = np.array([evidence.get(kind, -np.inf) for kind in LoadKind]) + np.log(np.asarray(self.fitter.prior))
        probability = np.exp(logs - logs.max())
        shapes = {
            kind.name.lower(): self.shape(kind if kind in evidence else LoadKind.TWO, fit) for kind, fit in fits.items()
        }
        return Loads(probability=self.put(probability / probability.sum())[0], **shapes)

    def shape(self, kind: LoadKind, fit: Fit) -> LoadShape:
        """Loads as they are handed out."""
        rows, free, known = fit.loads[: len(FORMS[kind])], self.free(kind, fit), self.known(kind, fit)
        misfit = np.array((fit.square - known.surprise @ known.surprise) / len(self.y))
        mean, square = mean_errors(known, free, np.asarray(self.fitter.shapes, float))
        step = self.step(rows, mean) if kind is LoadKind.ONE else np.zeros(len(mean))
        covariance = square - np.outer(mean, step) - np.outer(step, mean) + np.outer(step, step)
        told, covariance = self.forces(known, free, covariance)
        parts = rows[:, :2] + step[:2], np.exp(rows[:, 2]), np.exp(rows[:, 3] + told), rows[:, 4:], covariance
        return LoadShape(*self.put(*parts, misfit))

    def known(self, kind: LoadKind, fit: Fit) -> Known:
        """What is known at the loads of a fit."""
        forms = padded(fit.loads[: len(FORMS[kind])], kind)[1]
        y, form, root, loads = self.put(self.y, forms, fit.root, fit.loads)
        surprise, slopes = map(np.asarray, before(Problem(self.fitter, y, form, root), loads))
        end = unknowns_of(self.fitter, loads, form)
        return Known(self.y, end, self.errors(end), surprise, slopes[:, self.free(kind, fit)])

    def forces(self, known: Known, free: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Change of the logs of the forces by `ForceLaw`, (n,), and the covariance of all parameters after it."""
        law, at = self.fitter, np.flatnonzero(np.flatnonzero(free) % LOAD_PARAMETERS == FORCE)
        logs, unsure = (np.asarray(part, float) for part in (law.force_logs, law.force_covariance))
        slopes, scale = slopes_in_law(known, free)[at], np.ones(len(covariance))
        scale[at] = np.sqrt(float(law.force_variance))
        covariance = covariance.copy()
        covariance[np.ix_(at, at)] += slopes @ unsure @ slopes.T
        return np.clip(-(slopes @ logs), -MOST_TOLD, MOST_TOLD), covariance * np.outer(scale, scale)

    def step(self, rows: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """By how much a single load is handed out elsewhere than the fit has it, where its mean error is known.

        Half of the mean error of its place (see `MOVED`), on the sheet; nothing where slopes at the fit say no more.
        """
        step = np.zeros(len(mean))
        if np.linalg.norm(mean[:2]) < FAR * np.exp(rows[0, 2]):
            low, high = (np.asarray(corner, float) for corner in (self.fitter.low, self.fitter.high))
            step[:2] = np.clip(rows[0, :2] + MOVED * mean[:2], low, high) - rows[0, :2]
        return step
