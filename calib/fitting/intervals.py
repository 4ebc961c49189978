"""Noise of a reading about a fitted response, which grows with force, and intervals that cover a stated fraction.

The standard deviation of a new reading about the prediction F of a pad is s(F) = scale sqrt(floor^2 + (fraction F)^2):
the floor is the noise of the sensors, the fraction holds what is proportional to force, such as an error of gain or
place that the model does not know. Both have the largest normal likelihood of held-out residuals, from which the
variance of the model is subtracted. Half the width of an interval is a multiple of the standard deviation, taken from
the same residuals (split conformal prediction; Lei et al. 2018, JASA 113), so that it holds without normal noise.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import nnls
from scipy.special import stdtrit

import jaxeit as je

COVERAGE = 0.9  # of the intervals
NORMAL_MULTIPLE = 1.6449  # half the width of a normal distribution's 90 % interval, in standard deviations
MIN_GROUPS = 10  # of held-out readings; fewer determine no multiple, and the normal one is used
# Weight of the common deviation against that of a pad, in groups of readings.
PRIOR_GROUPS = 5.0
# Least size of a component of the noise, over that with which it alone would be all of the noise. Without a bound,
# readings that a model fits exactly, such as a force of zero without load, would lead to noise of zero.
MIN_SIZE_RATIO = 0.01
MAX_STEPS, VARIANCE_RTOL = 200, 1e-5  # of the Fisher scoring


class NoiseLaw(eqx.Module):
    """Deviation of new readings about a fitted response.

    | field    | meaning                                                       | shape   | unit |
    |----------|---------------------------------------------------------------|---------|------|
    | floor    | standard deviation without force                              | ()      | N    |
    | fraction | standard deviation per force, for large forces                | ()      | 1    |
    | scale    | of each pad, relative to all                                  | (pads,) | 1    |
    | multiple | half the 90 % interval, in standard deviations                | ()      | 1    |
    """

    floor: Float[Array, ""]
    fraction: Float[Array, ""]
    scale: Float[Array, " pads"]
    multiple: Float[Array, ""]

    def variance(self, force: Float[Array, "*n pads"]) -> Float[Array, "*n pads"]:
        """Variance (N^2) of a new reading about each pad's predicted force (N)."""
        variances: Float[Array, "*n pads"] = _variances(self, force)
        return variances

    def half_widths(self, force: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Half the 90 % interval of the total of predicted forces (n, pads) N, (n,) N; `variance` of that total by
        the model, (n,) N^2."""
        noise = np.asarray(self.variance(jnp.asarray(force))).sum(1)
        return np.asarray(float(self.multiple) * np.sqrt(noise + variance))


@je.verb
def _variances(law: NoiseLaw, force: Float[Array, "*n pads"]) -> Float[Array, "*n pads"]:
    return law.scale**2 * (law.floor**2 + (law.fraction * force) ** 2)


def fit_noise(
    residual: Float[np.ndarray, " n"],
    force: Float[np.ndarray, "n pads"],
    variance: Float[np.ndarray, " n"],
    group: np.ndarray,
) -> NoiseLaw:
    """Fit the noise law to held-out residuals of the total force.

    Args:
        residual: measured minus predicted total force, N; rows that are not finite are left out.
        force: predicted force of each pad, N.
        variance: of the predicted total force, by the model, N^2.
        group: place or press (n,) of each row. Rows of a group count as one, because they err together.
    """
    finite = np.isfinite(residual) & np.isfinite(force).all(1) & np.isfinite(variance)
    residual, force, variance, group = residual[finite], force[finite], variance[finite], group[finite]
    _, group, count = np.unique(group, return_inverse=True, return_counts=True)
    weight = 1 / count[group]
    scale = np.ones(force.shape[1])
    floor, fraction = _fit_floor_and_fraction(residual, force, variance, weight, scale)
    if len(count) >= MIN_GROUPS and len(scale) > 1:
        scale = _pad_scales(residual, force, variance + _variance(floor, fraction, scale, force), weight)
        floor, fraction = _fit_floor_and_fraction(residual, force, variance, weight, scale)
    pull = residual / np.sqrt(np.maximum(variance + _variance(floor, fraction, scale, force), np.finfo(float).tiny))
    multiple = _conformal_multiple(np.abs(pull), weight, len(count))
    return NoiseLaw(*map(jnp.asarray, (floor, fraction, scale, multiple)))


def _variance(floor: float, fraction: float, scale: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Variance (n,) N^2 of the total force about its prediction."""
    return np.asarray((floor**2 + (fraction * force) ** 2) @ scale**2)


def _fit_floor_and_fraction(
    residual: np.ndarray, force: np.ndarray, variance: np.ndarray, weight: np.ndarray, scale: np.ndarray
) -> tuple[float, float]:
    """Floor (N) and fraction of largest normal likelihood."""
    terms = np.stack([np.full(len(force), (scale**2).sum()), force**2 @ scale**2], 1)
    floor, fraction = fit_variance_components(residual, variance, weight, terms)
    return float(floor), float(fraction)


def fit_variance_components(
    residual: Float[np.ndarray, " n"],
    variance: Float[np.ndarray, " n"],
    weight: Float[np.ndarray, " n"],
    terms: Float[np.ndarray, "n terms"],
) -> Float[np.ndarray, " terms"]:
    """Sizes s of the components of a variance, `variance + terms @ s^2`, by maximum normal likelihood.

    Args:
        residual: of readings, in any unit.
        variance: known part of their variances.
        weight: of each reading in the likelihood.
        terms: squares, not negative; a term that is zero throughout has size 0.
    """
    sizes = np.zeros(terms.shape[1])
    rms = float(np.sqrt(np.average(residual**2, weights=weight))) if len(residual) else 0.0
    used = (terms > 0).any(0) if len(terms) else np.zeros(len(sizes), bool)
    if rms == 0 or not used.any():
        return sizes
    terms = terms[:, used]
    # Squares of the sizes with which each term is all of the variance.
    full = rms**2 / np.average(terms, axis=0, weights=weight)
    least = MIN_SIZE_RATIO**2 * full
    known = variance + terms @ least
    starts = np.exp(-6 * (1 - np.eye(len(full)))) * full  # one term is nearly all of the variance
    minima = [_fisher_scoring(residual**2, known, weight, terms, start) for start in starts]
    sizes[used] = np.sqrt(least + min(minima, key=lambda minimum: minimum[1])[0])
    return sizes


def _fisher_scoring(
    square: np.ndarray, known: np.ndarray, weight: np.ndarray, terms: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, float]:
    """Components of the variance, not negative, of least deviance, -2 log likelihood; and the deviance.

    Fisher scoring: each step is the least-squares fit of the squares of residuals, weighted by their expected
    variances; it is halved until the likelihood does not fall.
    """

    def deviance(parts: np.ndarray) -> float:
        total = known + terms @ parts
        return float(weight @ (np.log(total) + square / total))

    # The deviance is no sum of squares, so that a least-squares solver does not apply. A general minimiser within
    # bounds, L-BFGS-B, finds the same components and takes longer, since it does not know the expected curvature.
    parts, best = start, deviance(start)
    for _ in range(MAX_STEPS):
        row = np.sqrt(weight) / (known + terms @ parts)
        step = nnls(row[:, None] * terms, row * (square - known))[0] - parts
        while (after := deviance(parts + step)) > best and np.any(np.abs(step) > VARIANCE_RTOL * parts):
            step = step / 2
        if after > best:
            break
        parts, best = parts + step, after
        if np.all(np.abs(step) <= VARIANCE_RTOL * parts):
            break
    return parts, best


def student_factor(freedom: int) -> float:
    """Width of the 90 % interval of Student's distribution of so many degrees of freedom, over that of a known
    deviation."""
    return float(stdtrit(freedom, 0.5 + COVERAGE / 2)) / NORMAL_MULTIPLE


def _pad_scales(residual: np.ndarray, force: np.ndarray, total: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Scale (pads,): deviation of the presses on a pad over that of all, shrunk to one where they are few."""
    size = np.abs(force)
    share = weight[:, None] * size / np.maximum(size.sum(1), np.finfo(float).tiny)[:, None]
    square = share.T @ (residual**2 / total)
    scale = np.sqrt((square + PRIOR_GROUPS) / (share.sum(0) + PRIOR_GROUPS))
    return np.asarray(scale)


def _conformal_multiple(pull: np.ndarray, weight: np.ndarray, groups: int) -> float:
    """Quantile of the pull for a coverage of `COVERAGE` of the readings of a new group (split conformal prediction).

    Args:
        pull: errors over their standard deviations, not negative.
        weight: of each; those of a group sum to one.
        groups: number of groups; fewer than `MIN_GROUPS` give the multiple of normal errors.
    """
    if groups < MIN_GROUPS:
        return NORMAL_MULTIPLE
    order = np.argsort(pull)
    below = np.cumsum(weight[order]) / groups
    rank = int(np.searchsorted(below, min(COVERAGE * (1 + 1 / groups), 1.0)))
    return float(pull[order[min(rank, len(order) - 1)]])
