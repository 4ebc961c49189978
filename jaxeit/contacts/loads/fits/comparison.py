"""Fits of kinds of loads to one frame compared by their evidence, and handed out as loads."""

import numpy as np
from scipy.special import log_ndtr

from ..belief import LoadBelief
from ..pressure import FORCE_INDEX, FORMS, LOAD_PARAMETERS, MAX_LOADS
from ..result import LoadKind, Loads, LoadShape
from .kinds import Fit, FrameFits
from .shape_errors import Linearisation, law_sensitivities, mean_errors

PAIRS = ((0, 1), (0, 2), (1, 2))  # of three loads
# Share of the mean error by which the position of a single load moves, and the mean error, in widths, beyond which it
# does not move. The whole step makes tilted tips better and rings worse, whose moments are too large for slopes; half
# of it makes neither worse.
STEP_SHARE, MAX_STEP = 0.5, 0.5
MAX_FORCE_CHANGE = 0.7  # of the log of a force by `ForceLaw`, which holds to first order


def evidences(frame: FrameFits, fits: dict[LoadKind, Fit]) -> dict[LoadKind, float]:
    """Evidence of each kind that is fitted, and of none.

    Loads near one another, and a short edge, describe a flat, ringlike or tilted tip better than the slopes in the
    shape of a Gaussian do. The part of their evidence where they are so near or short is evidence of fewer loads.
    """
    found = {kind: log_evidence(frame.belief, fit) for kind, fit in fits.items()}
    nearest, shortest = np.asarray(frame.belief.min_separation)
    for kind, threshold in ((LoadKind.TWO, nearest), (LoadKind.EDGE, shortest), (LoadKind.MORE, nearest)):
        if kind not in fits:
            continue
        scores = sorted(_separation_score(fits[kind], step, float(threshold)) for step in _separations(fits[kind]))
        fewer = LoadKind.TWO if kind is LoadKind.MORE and scores[1] > 0 else LoadKind.ONE
        if fewer in found:
            found[fewer] = np.logaddexp(found[fewer], found[kind] + log_ndtr(-scores[0]))
            found[kind] += log_ndtr(scores[0])
    return found | {LoadKind.NONE: -0.5 * float(frame.y @ frame.y)}


def log_evidence(belief: LoadBelief, fit: Fit) -> float:
    """Logarithm of the evidence of a kind of loads, up to a constant that all kinds share."""
    # A place that the frame does not tell is somewhere on the sheet: the variance of an even density bounds it.
    sides = np.asarray(belief.high - belief.low, float)
    on_sheet = np.tile(np.concatenate([12 / sides**2, np.zeros(LOAD_PARAMETERS - 2)]), MAX_LOADS)
    free = fit.free
    sign, log_determinant = np.linalg.slogdet((fit.normal + np.diag(on_sheet))[np.ix_(free, free)])
    noise = np.sum(np.log(np.diag(fit.root)))
    found = belief.log_prior(fit.kind, fit.loads) - 0.5 * fit.square - noise
    found += 0.5 * (np.count_nonzero(free) * np.log(2 * np.pi) - log_determinant)
    return float(found) if sign > 0 and np.isfinite(found) else -np.inf


def _separations(fit: Fit) -> list[np.ndarray]:
    """Matrices (2, m) from the parameters of a fit to the vector from one load to another, or along an edge."""
    place = [np.eye(2, int(np.count_nonzero(fit.free)), k=4 * k) for k in range(MAX_LOADS)]
    if fit.kind is LoadKind.EDGE:
        return [2 * place[1]]  # after place, width and force come the half lengths
    return [place[j] - place[i] for i, j in PAIRS if j < len(FORMS[fit.kind])]


def _separation_score(fit: Fit, step: np.ndarray, threshold: float) -> float:
    """Standard deviations by which two loads are farther apart, or an edge is longer, than a threshold."""
    separation = step @ fit.loads.ravel()[fit.free]
    distance = max(float(np.linalg.norm(separation)), np.finfo(float).tiny)
    along = separation @ step / distance
    return (distance - threshold) / float(np.sqrt(max(along @ fit.covariance @ along, np.finfo(float).tiny)))


def summarise(frame: FrameFits, evidence: dict[LoadKind, float], fits: dict[LoadKind, Fit]) -> Loads:
    """Probabilities from evidence, and the loads of each kind."""
    with np.errstate(divide="ignore"):
        logs = np.array([evidence.get(kind, -np.inf) for kind in LoadKind]) + np.log(
            np.asarray(frame.belief.kind_probabilities)
        )
    probability = np.exp(logs - logs.max())
    shapes = {kind.name.lower(): load_shape(frame, fit) for kind, fit in fits.items()}
    return Loads(probability=frame.belief.to_jax(probability / probability.sum())[0], **shapes)


def load_shape(frame: FrameFits, fit: Fit) -> LoadShape:
    """Loads of a fit as they are handed out."""
    belief, rows, linear = frame.belief, fit.rows, frame.linearise(fit)
    misfit = np.array((fit.square - linear.prior_residual @ linear.prior_residual) / len(frame.y))
    mean, square = mean_errors(linear, fit.free, np.asarray(belief.shapes, float))
    step = _position_step(belief, rows, mean) if fit.kind is LoadKind.ONE else np.zeros(len(mean))
    covariance = square - np.outer(mean, step) - np.outer(step, mean) + np.outer(step, step)
    force_change, covariance = _correct_forces(belief, linear, fit.free, covariance)
    parts = rows[:, :2] + step[:2], np.exp(rows[:, 2]), np.exp(rows[:, 3] + force_change), rows[:, 4:], covariance
    return LoadShape(*belief.to_jax(*parts, misfit))


def _correct_forces(
    law: LoadBelief, linear: Linearisation, free: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Correct forces by `ForceLaw`: change of their logs, (n,), and the covariance of all parameters after it."""
    force_rows = np.flatnonzero(np.flatnonzero(free) % LOAD_PARAMETERS == FORCE_INDEX)
    logs, law_covariance = (np.asarray(part, float) for part in (law.force_logs, law.force_covariance))
    slopes, scale = law_sensitivities(linear, free)[force_rows], np.ones(len(covariance))
    scale[force_rows] = np.sqrt(float(law.force_variance))
    covariance = covariance.copy()
    covariance[np.ix_(force_rows, force_rows)] += slopes @ law_covariance @ slopes.T
    return np.clip(-(slopes @ logs), -MAX_FORCE_CHANGE, MAX_FORCE_CHANGE), covariance * np.outer(scale, scale)


def _position_step(belief: LoadBelief, rows: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Correction of the position of a single load by its mean error.

    It is `STEP_SHARE` of the mean error, on the sheet, and zero beyond `MAX_STEP`, where slopes at the fit do not hold.
    """
    step = np.zeros(len(mean))
    if np.linalg.norm(mean[:2]) < MAX_STEP * np.exp(rows[0, 2]):
        low, high = (np.asarray(corner, float) for corner in (belief.low, belief.high))
        step[:2] = np.clip(rows[0, :2] + STEP_SHARE * mean[:2], low, high) - rows[0, :2]
    return step
