"""Fits of kinds of loads to one frame compared by their evidence, and handed out as loads."""

import numpy as np
from scipy.stats import norm

from .belief import LoadBelief
from .considered import Known, mean_errors, slopes_in_law
from .fits import Fit, FrameFits
from .pressure import FORCE, FORMS, LOAD_PARAMETERS, MAX_LOADS
from .result import LoadKind, Loads, LoadShape

PAIRS = ((0, 1), (0, 2), (1, 2))  # of three loads
# Part of the mean error by which the place of a single load moves, and the mean error, in widths, beyond which nothing
# moves. The whole step makes tilted tips better and rings worse, whose moments are too large for slopes; half of it
# makes neither worse.
MOVED, FAR = 0.5, 0.5
MOST_TOLD = 0.7  # change of the log of a force by `ForceLaw`, at most: its law is to first order


def evidences(frame: FrameFits, fits: dict[LoadKind, Fit]) -> dict[LoadKind, float]:
    """Evidence of each kind that is fitted, and of none.

    Loads near one another, and a short edge, describe a flat, ringlike or tilted tip better than the slopes in the
    shape of a Gaussian do. The part of their evidence where they are so near or short is evidence of fewer loads.
    """
    found = {kind: log_evidence(frame.belief, fit) for kind, fit in fits.items()}
    nearest, shortest = np.asarray(frame.belief.least)
    for kind, least in ((LoadKind.TWO, nearest), (LoadKind.EDGE, shortest), (LoadKind.MORE, nearest)):
        if kind not in fits:
            continue
        beyond = sorted(_beyond(fits[kind], step, float(least)) for step in _steps(fits[kind]))
        fewer = LoadKind.TWO if kind is LoadKind.MORE and beyond[1] > 0 else LoadKind.ONE
        if fewer in found:
            found[fewer] = np.logaddexp(found[fewer], found[kind] + norm.logcdf(-beyond[0]))
            found[kind] += norm.logcdf(beyond[0])
    return found | {LoadKind.NONE: -0.5 * float(frame.y @ frame.y)}


def log_evidence(belief: LoadBelief, fit: Fit) -> float:
    """Logarithm of the evidence of a kind of loads, up to a constant that all kinds share."""
    # A place that the frame does not tell is somewhere on the sheet: the variance of an even density bounds it.
    sides = np.asarray(belief.high - belief.low, float)
    on_sheet = np.tile(np.concatenate([12 / sides**2, np.zeros(LOAD_PARAMETERS - 2)]), MAX_LOADS)
    free = fit.free
    sign, volume = np.linalg.slogdet((fit.normal + np.diag(on_sheet))[np.ix_(free, free)])
    noise = np.sum(np.log(np.diag(fit.root)))
    found = belief.log_prior(fit.kind, fit.loads) - 0.5 * fit.square - noise
    found += 0.5 * (np.count_nonzero(free) * np.log(2 * np.pi) - volume)
    return float(found) if sign > 0 and np.isfinite(found) else -np.inf


def _steps(fit: Fit) -> list[np.ndarray]:
    """From the parameters of a fit to the way from one load to another, or along an edge; (2, m) each."""
    place = [np.eye(2, int(np.count_nonzero(fit.free)), k=4 * k) for k in range(MAX_LOADS)]
    if fit.kind is LoadKind.EDGE:
        return [2 * place[1]]  # after place, width and force come the half lengths
    return [place[j] - place[i] for i, j in PAIRS if j < len(FORMS[fit.kind])]


def _beyond(fit: Fit, step: np.ndarray, least: float) -> float:
    """By how many standard deviations two loads are farther apart, or an edge is longer, than the least."""
    away = step @ fit.loads.ravel()[fit.free]
    distance = max(float(np.linalg.norm(away)), np.finfo(float).tiny)
    along = away @ step / distance
    return (distance - least) / float(np.sqrt(max(along @ fit.covariance @ along, np.finfo(float).tiny)))


def summary(frame: FrameFits, evidence: dict[LoadKind, float], fits: dict[LoadKind, Fit]) -> Loads:
    """Probabilities from evidence, and the loads of each kind."""
    with np.errstate(divide="ignore"):
        logs = np.array([evidence.get(kind, -np.inf) for kind in LoadKind]) + np.log(np.asarray(frame.belief.prior))
    probability = np.exp(logs - logs.max())
    shapes = {kind.name.lower(): load_shape(frame, fit) for kind, fit in fits.items()}
    return Loads(probability=frame.belief.put(probability / probability.sum())[0], **shapes)


def load_shape(frame: FrameFits, fit: Fit) -> LoadShape:
    """Loads of a fit as they are handed out."""
    belief, rows, known = frame.belief, fit.rows, frame.known(fit)
    misfit = np.array((fit.square - known.surprise @ known.surprise) / len(frame.y))
    mean, square = mean_errors(known, fit.free, np.asarray(belief.shapes, float))
    step = _step(belief, rows, mean) if fit.kind is LoadKind.ONE else np.zeros(len(mean))
    covariance = square - np.outer(mean, step) - np.outer(step, mean) + np.outer(step, step)
    told, covariance = _forces(belief, known, fit.free, covariance)
    parts = rows[:, :2] + step[:2], np.exp(rows[:, 2]), np.exp(rows[:, 3] + told), rows[:, 4:], covariance
    return LoadShape(*belief.put(*parts, misfit))


def _forces(law: LoadBelief, known: Known, free: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Change of the logs of the forces by `ForceLaw`, (n,), and the covariance of all parameters after it."""
    at = np.flatnonzero(np.flatnonzero(free) % LOAD_PARAMETERS == FORCE)
    logs, unsure = (np.asarray(part, float) for part in (law.force_logs, law.force_covariance))
    slopes, scale = slopes_in_law(known, free)[at], np.ones(len(covariance))
    scale[at] = np.sqrt(float(law.force_variance))
    covariance = covariance.copy()
    covariance[np.ix_(at, at)] += slopes @ unsure @ slopes.T
    return np.clip(-(slopes @ logs), -MOST_TOLD, MOST_TOLD), covariance * np.outer(scale, scale)


def _step(belief: LoadBelief, rows: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """By how much a single load is handed out elsewhere than the fit has it, where its mean error is known.

    Half of the mean error of its place (see `MOVED`), on the sheet; nothing where slopes at the fit say no more.
    """
    step = np.zeros(len(mean))
    if np.linalg.norm(mean[:2]) < FAR * np.exp(rows[0, 2]):
        low, high = (np.asarray(corner, float) for corner in (belief.low, belief.high))
        step[:2] = np.clip(rows[0, :2] + MOVED * mean[:2], low, high) - rows[0, :2]
    return step
