"""Errors of fitted loads whose shapes differ from a Gaussian by more than the fits marginalise, or by less.

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

from ..pressure import even_moments
from ..sheet import Sensitivities


class Linearisation(NamedTuple):
    """Linearisation of readings and prior at the loads that a fit found.

    | meaning                                                                             | shape  |
    |-------------------------------------------------------------------------------------|--------|
    | y: whitened readings                                                                | (r,)   |
    | sensitivities: readings and slopes of the loads found                               |        |
    | root: Cholesky factor of the covariance of the errors that the fit marginalises     | (r, r) |
    | prior_residual: of the loads, in standard deviations; prior_slopes: its slopes      | (s,), (s, m) |
    """

    y: Float[np.ndarray, " r"]
    sensitivities: Sensitivities
    root: Float[np.ndarray, "r r"]
    prior_residual: Float[np.ndarray, " s"]
    prior_slopes: Float[np.ndarray, "s m"]


def mean_errors(
    linear: Linearisation, free: np.ndarray, shapes: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"]]:
    """Mean (m,) and mean square (m, m) of the true parameters less the found ones, of those that are free.

    Args:
        linear: at the loads found.
        free: which of all parameters are fitted.
        shapes: factors n; each pair of one for even and one for odd moments is equally probable before the frame.
    """
    found, residual = linear.sensitivities, linear.y - np.asarray(linear.sensitivities.value)
    columns = np.concatenate([np.asarray(found.loads)[:, free], residual[:, None], found.shapes, found.tilts], 1)
    whitened = solve_triangular(linear.root, columns.astype(float), lower=True)
    products, count = whitened.T @ whitened, np.count_nonzero(free) + 1
    variances = _moment_variances(shapes, found.shapes.shape[1], found.tilts.shape[1])
    # Loads that are absent have no moments.
    present = np.diag(products)[count:] > 0
    kept = np.append(np.ones(count, bool), present)
    products, prior = products[np.ix_(kept, kept)], (linear.prior_residual, linear.prior_slopes)
    evidence, covariance, mean = _error_moments(products, variances[:, present], *prior)
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    square = covariance + mean[:, :, None] * mean[:, None]
    return weights @ mean, np.einsum("g,gij->ij", weights, square)


def law_sensitivities(linear: Linearisation, free: np.ndarray) -> Float[np.ndarray, "m 3"]:
    """Sensitivities of the free parameters to the law of pressure, where it is another one than that of the fit.

    They are slopes in the logs of the law's amplitude, half pressure and exponent. With the readings' slopes J in the
    parameters and L in these logs, and what is known of loads before, they are those of the solution of least squares,
    the readings being those of the true law.
    """
    columns = np.concatenate([np.asarray(linear.sensitivities.loads)[:, free], np.asarray(linear.sensitivities.law)], 1)
    whitened = solve_triangular(linear.root, columns.astype(float), lower=True)
    loads, law = whitened[:, :-3], whitened[:, -3:]
    covariance = inverse_of(loads.T @ loads + linear.prior_slopes.T @ linear.prior_slopes)[0]
    found: np.ndarray = covariance @ (loads.T @ law)
    return found


def _moment_variances(shapes: Float[np.ndarray, " k"], count: int, tilt_count: int) -> Float[np.ndarray, "g q"]:
    """Variances of the moments for all pairs of factors, less those that the root of the errors holds already."""
    even, odd = (factor.reshape(-1, 1) ** 2 for factor in np.meshgrid(shapes, shapes))
    return np.concatenate([np.where(even_moments(count), even, odd) - 1, np.repeat(odd, tilt_count, 1)], 1)


def _error_moments(
    products: Float[np.ndarray, "p p"],
    variances: Float[np.ndarray, "g q"],
    prior_residual: Float[np.ndarray, " s"],
    slopes: Float[np.ndarray, "s m"],
) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, "g m m"], Float[np.ndarray, "g m"]]:
    """Log evidence of moments of further variances, up to a constant; covariance and mean of the errors with them.

    Products are those of the whitened slopes in m parameters, what is left, and the slopes in q moments. The inverse of
    the covariance with these moments is by Woodbury's identity, so that all matrices are small. A variance is negative
    where moments are smaller than those of the fit, but not below -1, so that the covariance is that of errors.
    """
    count = len(products) - variances.shape[1]
    cross, own = products[:count, count:], products[count:, count:]
    inner = np.eye(len(own)) + own * variances[:, None]
    solved = np.linalg.solve(inner, np.broadcast_to(cross.T, (len(variances), *cross.T.shape)))
    rest = products[:count, :count] - (cross * variances[:, None]) @ solved
    gradient = rest[:, :-1, -1] - slopes.T @ prior_residual
    covariance, log_determinant = inverse_of(rest[:, :-1, :-1] + slopes.T @ slopes)
    mean = (covariance @ gradient[:, :, None])[..., 0]
    square = rest[:, -1, -1] - np.sum(gradient * mean, 1)
    return -0.5 * (square + np.linalg.slogdet(inner)[1] + log_determinant), covariance, mean


def inverse_of(normal: Float[np.ndarray, "*n m m"]) -> tuple[Float[np.ndarray, "*n m m"], Float[np.ndarray, "*n"]]:
    """Inverses of normal matrices, whose parameters differ in unit, and the logarithms of their determinants.

    A direction on which nothing informs has no part in the inverse.
    """
    diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
    scale = 1 / np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
    value, vector = np.linalg.eigh(scale[..., None] * normal * scale[..., None, :])
    informed = value > value.shape[-1] * np.finfo(float).eps * value.max(-1, keepdims=True)
    value, vector = np.where(informed, value, 1), scale[..., None] * np.where(informed[..., None, :], vector, 0)
    log_determinant = np.sum(np.log(value), -1) - 2 * np.sum(np.log(scale), -1)
    return vector / value[..., None, :] @ np.swapaxes(vector, -1, -2), np.asarray(log_determinant)
