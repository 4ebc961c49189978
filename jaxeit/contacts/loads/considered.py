"""Mean square errors of fitted loads, where shapes may differ from a Gaussian by more than the fits marginalise.

A fit takes the moments of a shape for 0.1, since larger ones would explain two loads as one of another shape. A ring
has moments of up to -2/3 and a flat tip that tilts has moments of higher order; at a high signal-to-noise ratio the fit
explains both by place and force. With S the slopes of the readings in all moments, n their standard deviation over that
which the fit takes, and R the covariance of all other errors at the loads found, what the fit leaves of the frame is

    J d + e,    e ~ N(0, R + n^2 S S'),    d: the true loads less the found ones, with what is known of loads before.

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


def mean_square_error(known: Known, free: np.ndarray, shapes: Float[np.ndarray, " k"]) -> Float[np.ndarray, "m m"]:
    """Mean square error (m, m) of the parameters that are free, of all; shapes: factors n, equally probable before."""
    end, left = known.end, known.y - np.asarray(known.end.value)
    every = np.concatenate([np.asarray(end.loads)[:, free], left[:, None], end.shapes, end.tilts], 1)
    white = solve_triangular(known.root, every, lower=True)
    products = white.T @ white
    # The root holds the moments that the fit marginalises once already.
    counts = end.shapes.shape[1], end.tilts.shape[1]
    more = [np.repeat([np.sqrt(n**2 - 1), n], counts) for n in shapes]
    found = [_about(products, one, known.surprise, known.slopes) for one in more]
    weight = np.exp([evidence for evidence, _ in found] - np.max([evidence for evidence, _ in found]))
    mean: np.ndarray = np.average([square for _, square in found], axis=0, weights=weight)
    return mean


def _about(
    products: Float[np.ndarray, "p p"],
    more: Float[np.ndarray, " q"],
    surprise: Float[np.ndarray, " s"],
    slopes: Float[np.ndarray, "s m"],
) -> tuple[float, Float[np.ndarray, "m m"]]:
    """Log evidence of moments of standard deviations `more`, up to a constant, and the mean square error with them.

    Products are those of the whitened slopes in m parameters, what is left, and the slopes in q moments. The inverse of
    the covariance with these moments is by Woodbury's identity, so that all matrices are small.
    """
    count = len(products) - len(more)
    across = more[:, None] * products[count:, :count]
    inner = np.eye(len(more)) + more[:, None] * products[count:, count:] * more
    rest = products[:count, :count] - across.T @ np.linalg.solve(inner, across)
    towards = rest[:-1, -1] - slopes.T @ surprise
    covariance, volume = inverse_of(rest[:-1, :-1] + slopes.T @ slopes)
    away = covariance @ towards
    evidence = -0.5 * (rest[-1, -1] - towards @ away + np.linalg.slogdet(inner)[1] + volume)
    return float(evidence), covariance + np.outer(away, away)


def inverse_of(normal: Float[np.ndarray, "m m"]) -> tuple[Float[np.ndarray, "m m"], float]:
    """Inverse of a normal matrix, whose parameters differ in unit, and the logarithm of its determinant.

    A direction that nothing tells has no part in the inverse.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    value, vector = np.linalg.eigh(scale[:, None] * normal * scale)
    told = value > len(value) * np.finfo(float).eps * value.max()
    vector = scale[:, None] * vector[:, told]
    return vector / value[told] @ vector.T, float(np.sum(np.log(value[told])) - 2 * np.sum(np.log(scale)))
