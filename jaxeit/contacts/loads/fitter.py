"""Loads of one frame, fitted through the pressure law and the full forward map: none, one, two, an edge, or three.

Contacts in load space are pressures (place, force, width, length), not bumps of conductivity. They add before the law
that turns pressure into conductivity, which saturates; bumps that add leave misfits of 7 to 9 on two contacts where the
noise is 1. With p the pressure of all loads and f the law, the readings are those of the conductivity sigma f(p g).

What is not known besides the loads is what errs: the gain g = exp(std field) of the contact layer, which moves a load,
bends it and splits it; the coat of the sheet; and the shape of a load. All of it is marginalised to first order. With N
the slopes of the r whitened readings y in these unknowns, each of standard deviation one, and e the part of the signal
by which all else errs, errors have the covariance (1 + e^2 |y|^2 / r) I + N N'. Kinds are compared by their evidence in
Laplace's approximation (MacKay 1992, Neural Comput. 4), so that probabilities and covariances hold the model's error as
well as the noise.

The host decides what is fitted next; JAX runs two compiled programs, which serve all kinds (`pressure`).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy.linalg import solve_triangular
from scipy.stats import norm

from ..._compile import require_known, verb
from ...imaging.noise import InverseError, Whitening
from ...least_squares import ImplicitStep, normal_equations
from ...least_squares.searches import Quadratic
from ...linalg import lapack
from ..fit import SOLVER
from ..result import Contacts
from .pressure import MOST, SIZE, Form, Forms, Parameters
from .proposal import Proposed
from .result import LoadKind, Loads, LoadShape
from .sheet import PressedSheet, Unknowns
from .starts import Starts

FORMS = {
    LoadKind.ONE: (Form.ROUND,),
    LoadKind.TWO: (Form.ROUND, Form.ROUND),
    LoadKind.EDGE: (Form.LONG,),
    LoadKind.MORE: (Form.ROUND, Form.ROUND, Form.ROUND),
}
STEPS = 16  # of a fit at most
# Half of the fall of chi-square at which a fit ends: one whose errors are those at its start, and the last one.
TRIAL_FALL, LAST_FALL = 1.0, 0.02
MIN_FALL = 12.0  # of chi-square by a third load, below which none is fitted
ASTRAY = 4.0  # chi-square over the number of readings, above which a fit of one load starts elsewhere
MIN_PROBABILITY = 2e-3  # of a kind that is proposed, below which it is not fitted
# Probability that the evidence of fits tells kinds, beside a proposal; otherwise it says nothing. Fits know the forward
# map and one load's shape; the network has seen shapes, layers and faults that fits do not have. Of 0.3, 0.5, 0.7 and
# 0.9, this number had the least surprise on frames of skins that neither had seen (docs/proposal.md).
TRUST = 0.3
MIN_SHARE = 0.15  # of the force, that the weaker of two ends of an edge bears


class Fit(NamedTuple):
    """Loads of a kind that explain a frame best.

    | meaning                                                                   | shape      |
    |---------------------------------------------------------------------------|------------|
    | loads: parameters of all rows                                             | (MOST, 6)  |
    | square: sum of squares with that of the prior                             | ()         |
    | normal: half the second derivatives of the square, of all parameters      | (18, 18)   |
    | root: Cholesky factor of the covariance of the errors                     | (r, r)     |
    """

    loads: np.ndarray
    square: float
    normal: np.ndarray
    root: np.ndarray


class LoadFitter(eqx.Module):
    """Fits loads to frames; made by `prepare_loads`, called with a frame and the contacts that a finder saw in it.

    | meaning                                                             | shape            | unit |
    |---------------------------------------------------------------------|------------------|------|
    | sheet: from loads to whitened readings                              |                  |      |
    | whitening, compress: from readings to whitened ones                 | , (r, k)         |      |
    | starts: where fits begin                                            |                  |      |
    | low, high: corners of the sheet                                     | (2,)             | m    |
    | usual, spread: mean and standard deviation of log width, log force  | (2,)             |      |
    | difference: standard deviation of their differences between loads   | (2,)             |      |
    | least: distance of two loads, length of an edge, that is not one load | (2,)           | m    |
    | length, prior, model_error: see `LoadSettings`                      | (), (5,), ()     |      |
    """

    sheet: PressedSheet
    whitening: Whitening
    compress: Float[Array, "r k"]
    starts: Starts
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    usual: Float[Array, "2"]
    spread: Float[Array, "2"]
    difference: Float[Array, "2"]
    least: Float[Array, "2"]
    length: Float[Array, ""]
    prior: Float[Array, "5"]
    model_error: Float[Array, ""]

    def __call__(self, dv: Float[ArrayLike, " readings"], contacts: Contacts) -> Loads:
        """Loads of one difference frame (readings,) V, from the contacts that a `ContactFinder` saw in it.

        Raises:
            InverseError: if the frame has another shape, or a reading that is used is not finite.
        """
        require_known("LoadFitter", InverseError, dv, contacts)
        return _Search(self, self._whitened(dv, contacts.present.ndim - 1), contacts).loads()

    def refine(self, dv: Float[ArrayLike, " readings"], proposed: Proposed) -> Loads:
        """Loads of one difference frame (readings,) V, from those that a `Proposal` proposes; no finder is needed.

        Kinds of a probability below `MIN_PROBABILITY` are not fitted, and the others once each. Probabilities are those
        of the proposal times what the fits say (`TRUST`). A frame that no proposed kind explains is searched, and one
        that lies outside of what the proposal was trained on is told as without it.

        Raises:
            InverseError: as when called.
        """
        require_known("LoadFitter", InverseError, dv, proposed)
        search = _Search(self, self._whitened(dv, np.ndim(proposed.distance)), None)
        return search.refined(proposed) if not proposed.outside else search.loads()

    def _whitened(self, dv: Float[ArrayLike, " readings"], batch: int) -> np.ndarray:
        """The whitened readings of one frame."""
        dv, used = np.asarray(dv, float), np.asarray(self.whitening.channels)
        if dv.shape != used.shape or batch:
            raise InverseError(f"dv has shape {dv.shape}; fit one frame of {len(used)} readings at a time")
        if not np.isfinite(dv[used]).all():
            first = int(np.argmax(used & ~np.isfinite(dv)))
            raise InverseError(f"reading {first} is not finite; leave its channel out")
        return np.asarray(_white(self, jnp.asarray(dv, self.low.dtype)))

    @property
    def scale(self) -> np.ndarray:
        """Rows (2, 6) of mean and standard deviation of what is known of a load before a frame; infinite: nothing."""
        usual, spread, length = np.asarray(self.usual), np.asarray(self.spread), float(self.length)
        return np.array([[0, 0, *usual, 0, 0], [np.inf, np.inf, *spread, length, length]])

    def bounds(self, start: np.ndarray, forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest parameters: on the sheet, and within four deviations of what is usual.

        What a row does not have stays where it starts.
        """
        mean, deviation = self.scale
        deviation = np.where(np.isfinite(deviation), deviation, 0)
        low, high = mean - 4 * deviation, mean + 4 * deviation
        low[:2], high[:2] = self.low, self.high
        free = free_parameters(forms)
        return np.where(free, low, start), np.where(free, high, start)

    def log_prior(self, kind: LoadKind, loads: np.ndarray) -> float:
        """Logarithm of the density of parameters before the frame, less that of the squares of surprise."""
        more, deviation = len(FORMS[kind]) - 1, self.scale[1]
        area = float(np.prod(np.asarray(self.high - self.low)))
        found = -np.log(area) - np.sum(np.log(deviation[2:4])) - np.log(2 * np.pi)
        if kind is LoadKind.EDGE:  # either end of an edge may be the first
            return float(found + np.log(2.0) - 2 * np.log(deviation[4]) - np.log(2 * np.pi))
        half = 0.5 * (loads[1 : more + 1, :2] - loads[0, :2]) / deviation[4]
        near = np.exp(-0.5 * np.sum(half**2, 1)) / (2 * np.pi * (2 * deviation[4]) ** 2)
        found += np.sum(np.log(0.5 * near + 0.5 / area))
        found -= more * (np.sum(np.log(np.asarray(self.difference))) + np.log(2 * np.pi))
        return float(found + np.sum(np.log(np.arange(1, more + 2))))  # loads in any order


def free_parameters(forms: np.ndarray) -> np.ndarray:
    """Which parameters of all rows are fitted, (MOST, 6)."""
    free: np.ndarray = np.arange(SIZE) < np.array([0, 4, 6])[forms][:, None]
    return free


def padded(rows: np.ndarray, kind: LoadKind) -> tuple[np.ndarray, np.ndarray]:
    """All rows of parameters, and their forms."""
    forms = np.zeros(MOST, np.int32)
    forms[: len(FORMS[kind])] = FORMS[kind]
    rows = np.pad(rows, ((0, 0), (0, SIZE - rows.shape[1])))
    return np.concatenate([rows, np.repeat(rows[-1:], MOST - len(rows), 0)]), forms


class _Search:
    """The search of one frame, whose whitened readings are y."""

    def __init__(self, fitter: LoadFitter, y: np.ndarray, contacts: Contacts | None):
        self.fitter, self.y, self.contacts = fitter, y, contacts

    def put(self, *arrays: np.ndarray) -> tuple[Array, ...]:
        """Arrays as JAX holds them; numbers in the precision of the model."""
        dtype = self.fitter.low.dtype
        return tuple(jnp.asarray(array, dtype if array.dtype.kind == "f" else None) for array in arrays)

    def loads(self) -> Loads:
        """Loads of all kinds with their probabilities."""
        fits = {LoadKind.ONE: self.one()}
        one = fits[LoadKind.ONE]
        halves, long = self.fitter.starts.split(one.loads[0], self.reach(one))
        fits[LoadKind.TWO] = self.best(LoadKind.TWO, [halves, *self.seen(2)])
        two = fits[LoadKind.TWO]
        share, between = self.fitter.starts.between(two.loads[:2])
        fits[LoadKind.EDGE] = self.best(LoadKind.EDGE, [between if share > MIN_SHARE else long])
        evidence = {LoadKind.NONE: -0.5 * float(self.y @ self.y)}
        left = self.left(LoadKind.TWO, two)[0]
        fall, three = self.fitter.starts.another(two, left)
        if fall > MIN_FALL:
            fits[LoadKind.MORE] = self.best(LoadKind.MORE, [three, *self.seen(3)])
        # What the finder cannot tell from noise is nothing.
        there = self.contacts is None or bool(np.any(self.contacts.present))
        evidence |= self.evidences(fits) if there else dict.fromkeys(fits, -np.inf)
        fits.setdefault(LoadKind.MORE, two)
        return self.summary(evidence, fits)

    def refined(self, proposed: Proposed) -> Loads:
        """Loads of the kinds that are proposed, from where they are proposed."""
        likely = [kind for kind in FORMS if proposed.probability[kind] > MIN_PROBABILITY]
        fits = {kind: self.best(kind, [proposed.of(kind)]) for kind in {LoadKind.ONE: None} | dict.fromkeys(likely)}
        if min(fit.square for fit in fits.values()) > ASTRAY * len(self.y):
            found, fitted = self.loads(), list(LoadKind)
        else:
            evidence = {LoadKind.NONE: -0.5 * float(self.y @ self.y)} | self.evidences(fits)
            found, fitted = self.summary(evidence, fits), list(evidence)
        pooled = TRUST * np.asarray(found.probability) + (1 - TRUST) / len(LoadKind)
        pooled *= proposed.probability * np.isin(np.arange(len(LoadKind)), fitted)
        return replace(found, probability=self.put(pooled / pooled.sum())[0])

    def seen(self, count: int) -> list[np.ndarray]:
        """Loads of the contacts that a finder saw, if there are so many."""
        return [] if self.contacts is None else self.fitter.starts.seen(self.contacts, count)

    def one(self) -> Fit:
        """The best single load; where the contacts lead astray, from the atom that explains most."""
        starts = self.fitter.starts
        if self.contacts is None:
            return self.best(LoadKind.ONE, [starts.atom(self.y, np.eye(len(self.y)))[1]])
        found = self.best(LoadKind.ONE, [starts.single(self.y, self.contacts)])
        if found.square < ASTRAY * len(self.y):
            return found
        anew = self.best(LoadKind.ONE, [starts.atom(self.y, np.eye(len(self.y)))[1]])
        return min(found, anew, key=lambda fit: fit.square)

    def best(self, kind: LoadKind, starts: list[np.ndarray]) -> Fit:
        """The best fit from some starts, with the errors at its end."""
        tried = [self.fit(kind, start, TRIAL_FALL) for start in starts]
        first = min(tried, key=lambda fit: fit.square + 2 * np.sum(np.log(np.diag(fit.root))))
        return self.fit(kind, first.loads[: len(FORMS[kind])], LAST_FALL)

    def fit(self, kind: LoadKind, rows: np.ndarray, fall: float) -> Fit:
        """The best loads near a start, with the errors there."""
        begin, forms = padded(rows, kind)
        bounds = self.fitter.bounds(begin, forms)
        start, form = self.put(np.clip(begin, *bounds), forms)
        root = self.errors(_unknowns(self.fitter, start, form))
        y, given, low, high, end = self.put(self.y, root, *bounds, np.array(fall))
        loads, square, normal = _fit(self.fitter, y, start, form, given, (low, high), end)
        return Fit(np.asarray(loads), float(square), np.asarray(normal), root)

    def left(self, kind: LoadKind, fit: Fit) -> tuple[np.ndarray, Unknowns]:
        """What a fit leaves of the frame, in units of its errors, and the slopes there."""
        forms = padded(fit.loads[: len(FORMS[kind])], kind)[1]
        known = _unknowns(self.fitter, *self.put(fit.loads, forms))
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
        """Evidence of each kind that is fitted.

        Two loads near one another, and a short edge, describe a flat, ringlike or tilted tip better than the slopes in
        the shape of a Gaussian do. The part of their evidence where they are so near or short is evidence of one load.
        """
        found = {kind: self.evidence(kind, fit) for kind, fit in fits.items()}
        for kind, least in zip((LoadKind.TWO, LoadKind.EDGE), np.asarray(self.fitter.least), strict=True):
            if kind not in fits:
                continue
            beyond = self.beyond(kind, fits[kind], float(least))
            found[LoadKind.ONE] = np.logaddexp(found[LoadKind.ONE], found[kind] + norm.logcdf(-beyond))
            found[kind] += norm.logcdf(beyond)
        return found

    def beyond(self, kind: LoadKind, fit: Fit, least: float) -> float:
        """By how many standard deviations two loads are farther apart, or an edge is longer, than the least."""
        covariance, free = self.covariance(kind, fit), self.free(kind, fit)
        second = np.eye(2, len(covariance), k=4)  # the half length of an edge, or the second place
        step = 2 * second if kind is LoadKind.EDGE else second - np.eye(2, len(covariance))
        away = step @ fit.loads.ravel()[free]
        distance = max(float(np.linalg.norm(away)), np.finfo(float).tiny)
        along = away @ step / distance
        return (distance - least) / float(np.sqrt(along @ covariance @ along))

    @staticmethod
    def free(kind: LoadKind, fit: Fit) -> np.ndarray:
        """Which of all parameters a kind has, (18,)."""
        return free_parameters(padded(fit.loads[: len(FORMS[kind])], kind)[1]).ravel()

    def covariance(self, kind: LoadKind, fit: Fit) -> np.ndarray:
        """Covariance of the parameters that are fitted."""
        free = self.free(kind, fit)
        normal = fit.normal[np.ix_(free, free)]
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
        inverse = np.linalg.pinv(scale[:, None] * normal * scale, hermitian=True)
        found: np.ndarray = scale[:, None] * inverse * scale
        return found

    def evidence(self, kind: LoadKind, fit: Fit) -> float:
        """Logarithm of the evidence of a kind of loads, up to a constant that all kinds share."""
        free = self.free(kind, fit)
        # A place that the frame does not tell is somewhere on the sheet: the variance of an even density bounds it.
        sides = np.asarray(self.fitter.high - self.fitter.low, float)
        on_sheet = np.tile(np.concatenate([12 / sides**2, np.zeros(SIZE - 2)]), MOST)
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
        rows = fit.loads[: len(FORMS[kind])]
        parts = rows[:, :2], np.exp(rows[:, 2]), np.exp(rows[:, 3]), rows[:, 4:], self.covariance(kind, fit)
        y, forms, root, flat = self.put(self.y, padded(rows, kind)[1], fit.root, fit.loads.ravel())
        surprise = np.asarray(_surprise(flat, _Problem(self.fitter, y, forms, root)))
        misfit = np.array((fit.square - surprise @ surprise) / len(self.y))
        return LoadShape(*self.put(*parts, misfit))


class _Problem(NamedTuple):
    """A frame (r,) that loads of some forms are to explain, up to errors of covariance `root` `root`'."""

    fitter: LoadFitter
    y: Float[Array, " r"]
    forms: Forms
    root: Float[Array, "r r"]


@verb
def _white(fitter: LoadFitter, dv: Float[Array, " readings"]) -> Float[Array, " r"]:
    return fitter.compress @ fitter.whitening.sums(dv)


@verb
def _unknowns(fitter: LoadFitter, loads: Parameters, forms: Forms) -> Unknowns:
    return fitter.sheet.unknowns(loads, forms)


@verb
def _fit(
    fitter: LoadFitter,
    y: Float[Array, " r"],
    start: Parameters,
    forms: Forms,
    root: Float[Array, "r r"],
    bounds: tuple[Parameters, Parameters],
    fall: Float[Array, ""],
) -> tuple[Parameters, Float[Array, ""], Float[Array, "m m"]]:
    """Loads, square and normal matrix; see `Fit`."""
    problem = _Problem(fitter, y, forms, root)
    found: optx.Solution[Array, Any] = optx.least_squares(
        _residual,
        replace(SOLVER, fall_rtol=0.0, fall_atol=fall),
        start.ravel(),
        problem,
        {"lower": bounds[0].ravel(), "upper": bounds[1].ravel(), "quadratic": _quadratic},
        max_steps=STEPS,
        adjoint=ImplicitStep(),
        throw=False,
    )
    return found.value.reshape(start.shape), found.state.square, found.state.quadratic.hessian.matrix


def _residual(flat: Float[Array, " m"], problem: _Problem) -> Float[Array, " n"]:
    left = problem.y - problem.fitter.sheet.response(flat.reshape(MOST, SIZE), problem.forms)
    return jnp.append(lapack.solve_triangular(problem.root, left, lower=True), _surprise(flat, problem))


def _quadratic(flat: Float[Array, " m"], problem: _Problem) -> Quadratic:
    """The sum of squares near some loads; the sheet knows its slopes."""
    sheet, loads = problem.fitter.sheet, flat.reshape(MOST, SIZE)
    at = sheet.linearised(loads, problem.forms)
    both = jnp.concatenate([(problem.y - at.value)[:, None], -sheet.slopes(at, loads, problem.forms)], 1)
    both = lapack.solve_triangular(problem.root, both, lower=True)
    surprise, by_loads = _surprise(flat, problem), jax.jacfwd(_surprise)(flat, problem)
    return normal_equations(jnp.append(both[:, 0], surprise), jnp.concatenate([both[:, 1:], by_loads]))


def _surprise(flat: Float[Array, " m"], problem: _Problem) -> Float[Array, " s"]:
    """What is unusual of loads, in standard deviations.

    Log width and log force, of the first load and of the others less those of the first; half lengths of an edge.
    """
    fitter, loads, there = problem.fitter, flat.reshape(MOST, SIZE), problem.forms[:, None] > Form.ABSENT
    first = (loads[0, 2:4] - fitter.usual) / fitter.spread
    others = jnp.where(there, (loads[:, 2:4] - loads[0, 2:4]) / fitter.difference, 0)[1:]
    length = jnp.where(problem.forms[:, None] == Form.LONG, loads[:, 4:] / fitter.length, 0)
    return jnp.concatenate([first, others.ravel(), length.ravel()])
