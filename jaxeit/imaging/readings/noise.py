"""The weight of each reading: the inverse of its variance, or of a covariance."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from ..._compile import is_traced, require_known
from ...linalg.array_libraries import JAX, NUMPY, ArrayLibrary
from ..inputs import InverseError, real_numbers


def noise_weight(noise: Any, readings: int, channels: np.ndarray) -> Any:
    """Inverse of the noise on the channels that are used, zero elsewhere: variances or a covariance.

    Traced noise gives an array of JAX and is not checked: where it is not positive, the result is not finite.
    """
    if noise is None:
        return channels.astype(float)
    if isinstance(noise, type | eqx.Module):
        raise InverseError(
            f"noise is {noise!r:.60}; give the standard deviation of each reading, V, or give a choice such as "
            "MeasuredNoise() to je.Imaging(noise=...), whose prepare(model, quiet=frames) measures it"
        )
    library, known = (JAX, False) if is_traced(noise) else (NUMPY, True)
    noise = jnp.asarray(noise) if not known else real_numbers("noise", noise, "V")
    if noise.shape not in ((readings,), (readings, readings)):
        raise InverseError(
            f"noise has shape {noise.shape}; this model has {readings} readings: give the standard deviation of each, "
            f"V, such as np.full({readings}, 1e-6), or their covariance, V^2"
        )
    if noise.ndim == 2:
        return _known_inverse(noise, channels) if known else _inverse_covariance(library, noise, channels)
    bad = channels & ~(np.isfinite(noise) & (noise > 0)) if known else np.zeros(readings, bool)
    if bad.any():
        raise InverseError(
            f"the noise of reading {int(np.argmax(bad))} is {noise[bad][0]} V; give a positive "
            "number, or leave the channel out with channels=..."
        )
    where = library.namespace.where
    return where(channels, where(channels, noise, 1.0) ** -2.0, 0.0)


def _known_inverse(noise: np.ndarray, channels: np.ndarray) -> np.ndarray:
    """The inverse of a covariance whose numbers are known, checked."""
    used = np.ix_(*2 * [np.flatnonzero(channels)])
    try:
        weight: np.ndarray = _inverse_covariance(NUMPY, noise, channels)
    except np.linalg.LinAlgError:
        weight = np.full_like(noise, np.nan)
    if not np.isfinite(weight).all() or not np.allclose(noise[used], noise[used].T, rtol=1e-6, atol=0):
        raise InverseError(
            "the covariance of the noise is not symmetric positive definite; a recording of fewer frames than readings "
            "gives such a one: give standard deviations instead, or shrink it towards its diagonal "
            "(je.imaging.noise_covariance does)"
        )
    return weight


def _inverse_covariance(library: ArrayLibrary, noise: Any, channels: np.ndarray) -> Any:
    """The inverse of the covariance of the channels that are used, zero elsewhere."""
    used = np.flatnonzero(channels)
    lower = library.cholesky(noise[np.ix_(used, used)])
    half = library.solve_lower(lower, np.eye(len(used), dtype=lower.dtype))
    place = np.full(len(channels), len(used))  # of each reading in the inverse; beyond its end, zeros
    place[used] = np.arange(len(used))
    return library.namespace.pad(half.T @ half, (0, 1))[np.ix_(place, place)]


def noise_covariance(blank: Float[ArrayLike, "frames readings"]) -> np.ndarray:
    """Covariance of the readings of a blank recording, shrunk towards its diagonal so that it can be inverted.

    The weight of the diagonal is that of Schaefer and Strimmer (2005): the variance of the off-diagonal entries, as
    the frames tell it, over their squares; 1 where the frames tell of no correlation.

    Args:
        blank: readings without contact, (frames, readings) V; at least four frames, finite.

    Returns:
        (readings, readings) V^2.

    Raises:
        InverseError: for fewer frames, or readings that are not finite or do not change at all.

    Example:
        crosstalk = je.prepare(model, basis=je.Pixels(10), noise=je.imaging.noise_covariance(quiet))
    """
    require_known("noise_covariance", InverseError, blank)
    blank = real_numbers("the blank recording", blank, "V")
    if blank.ndim != 2 or len(blank) < 4 or not np.isfinite(blank).all():
        raise InverseError(f"the blank recording has shape {blank.shape}; give four or more frames of finite readings")
    n, centred = len(blank), blank - blank.mean(0)
    std = centred.std(0, ddof=1)
    if (std == 0).any():
        raise InverseError(f"reading {int(np.argmax(std == 0))} does not change at all; leave it out as a dead channel")
    z = centred / std
    mean = z.T @ z / n
    spread = (z**2).T @ z**2 / n - mean**2
    off = ~np.eye(len(std), dtype=bool)
    correlation = mean * n / (n - 1)
    shrink = np.clip(spread[off].sum() * n / (n - 1) ** 3 * n / max((correlation[off] ** 2).sum(), 1e-300), 0, 1)
    return np.where(off, (1 - shrink) * correlation, 1.0) * np.outer(std, std)
