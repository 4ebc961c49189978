"""Errors of fitted loads, where shapes may differ from a Gaussian by more than the fits marginalise, or by less.

A fit takes the moments of a shape for 0.1, since larger ones would explain two loads as one of another shape. A ring
has moments of up to -2/3 and a flat tip that tilts has moments of higher order; at a high signal-to-noise ratio the fit
explains both by place and force. A Gaussian has none. Even moments, which a flat tip or a ring has, move no load; odd
ones do, which a tilted tip has: each of the two has a scale of its own. With S the slopes of the readings in all
moments, n their standard deviations over those which the fit takes, and R the covariance of all other errors at the
loads found, what the fit leaves of the frame is

    J d + e,    e ~ N(0, R + S n^2 S'),    d: the true loads less the found ones, with what is known of loads before.

For each n, d has a mean m and a covariance C, and the frame has an evidence. The mean over all n of C + m m', weighed
by evidence, is the mean square of what the found loads err by: the covariance of the posterior about the found loads
instead of its own mean. It is like a "consider" covariance (Schmidt 1966, Advances in Control Systems 3), except that
the frame tells how large the errors are that the fit leaves out. As slopes and errors are those of the loads found, and
those of the fit were those of its last start, m also holds by how much the fit is not at rest.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from .pressure import even_moments
from .sheet import Unknowns


class Known(NamedTuple):
    """What is known at the loads that a fit found.

    | meaning                                                                             | shape  |
    |-------------------------------------------------------------------------------------|--------|
    | y: whitened readings                                                                | (r,)   |
    | end: readings and slopes of the loads found                                         |        |
    | root: Cholesky factor of the covariance of the errors that the fit marginalises     | (r, r) |
    | surprise: what is unusual of the loads, in standard deviations; its slopes          | (s,), (s, m) |
    """

    y: Float[np.ndarray, " r"]
    end: Unknowns
    root: Float[np.ndarray, "r r"]
    surprise: Float[np.ndarray, " s"]
    slopes: Float[np.ndarray, "s m"]


def mean_errors(
    known: Known, free: np.ndarray, shapes: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """Mean (m,) and mean square (m, m) of the true parameters less the found ones, of those that are free.

    Args:
        known: what is known at the loads found.
        free: which of all parameters are fitted.
        shapes: factors n; each pair of one for even and one for odd moments is equally probable before the frame.
    """
    end, left = known.end, known.y - np.asarray(known.end.value)
    every = np.concatenate([np.asarray(end.loads)[:, free], left[:, None], end.shapes, end.tilts], 1)
    white = solve_triangular(known.root, every.astype(float), lower=True)
    products, count = white.T @ white, np.count_nonzero(free) + 1
    variances = _variances(shapes, end.shapes.shape[1], end.tilts.shape[1])
    # Loads that are absent have no moments.
    there = np.diag(products)[count:] > 0
    kept = np.append(np.ones(count, bool), there)
    found = _about(products[np.ix_(kept, kept)], variances[:, there], known.surprise, known.slopes)
    evidence, covariance, away = found
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    square = covariance + away[:, :, None] * away[:, None]
    return weight @ away, np.einsum("g,gij->ij", weight, square)


def slopes_in_law(known: Known, free: np.ndarray) -> Float[np.ndarray, "m 3"]:
    """By how much the parameters that are free are found otherwise, where the law is another one than that of the fit.

    Slopes in the logs of the law's amplitude, half pressure and exponent. With the readings' slopes J in the parameters
    and L in these logs, and what is known of loads before, they are those of the solution of least squares, the
    readings being those of the true law.
    """
    both = np.concatenate([np.asarray(known.end.loads)[:, free], np.asarray(known.end.law)], 1)
    white = solve_triangular(known.root, both.astype(float), lower=True)
    loads, law = white[:, :-3], white[:, -3:]
    found: np.ndarray = inverse_of(loads.T @ loads + known.slopes.T @ known.slopes)[0] @ (loads.T @ law)
    return found


def _variances(shapes: Float[np.ndarray, " k"], count: int, more: int) -> Float[np.ndarray, "g q"]:
    """Variances of moments, of all pairs of factors, over those that the root of the errors holds already."""
    even, odd = (factor.reshape(-1, 1) ** 2 for factor in np.meshgrid(shapes, shapes))
    return np.concatenate([np.where(even_moments(count), even, odd) - 1, np.repeat(odd, more, 1)], 1)


def _about(
    products: Float[np.ndarray, "p p"],
    variances: Float[np.ndarray, "g q"],
    surprise: Float[np.ndarray, " s"],
    slopes: Float[np.ndarray, "s m"],
) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, "g m m"], Float[np.ndarray, "g m"]]:
    """Log evidence of moments of further variances, up to a constant; covariance and mean of the errors with them.

    Products are those of the whitened slopes in m parameters, what is left, and the slopes in q moments. The inverse of
    the covariance with these moments is by Woodbury's identity, so that all matrices are small. A variance is negative
    where moments are smaller than those of the fit, but not below -1, so that the covariance is that of errors.
    """
    count = len(products) - variances.shape[1]
    across, own = products[:count, count:], products[count:, count:]
    inner = np.eye(len(own)) + own * variances[:, None]
    explained = np.linalg.solve(inner, np.broadcast_to(across.T, (len(variances), *across.T.shape)))
    rest = products[:count, :count] - (across * variances[:, None]) @ explained
    towards = rest[:, :-1, -1] - slopes.T @ surprise
    covariance, volume = inverse_of(rest[:, :-1, :-1] + slopes.T @ slopes)
    away = (covariance @ towards[:, :, None])[..., 0]
    square = rest[:, -1, -1] - np.sum(towards * away, 1)
    return -0.5 * (square + np.linalg.slogdet(inner)[1] + volume), covariance, away


def inverse_of(normal: Float[np.ndarray, "*n m m"]) -> tuple[Float[np.ndarray, "*n m m"], Float[np.ndarray, "*n"]]:
    """Inverses of normal matrices, whose parameters differ in unit, and the logarithms of their determinants.

    A direction that nothing tells has no part in the inverse.
    """
    diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
    scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
    value, vector = np.linalg.eigh(scale[..., None] * normal * scale[..., None, :])
    told = value > value.shape[-1] * np.finfo(float).eps * value.max(-1, keepdims=True)
    value, vector = np.where(told, value, 1), scale[..., None] * np.where(told[..., None, :], vector, 0)
    volume = np.sum(np.log(value), -1) - 2 * np.sum(np.log(scale), -1)
    return vector / value[..., None, :] @ np.swapaxes(vector, -1, -2), np.asarray(volume)
