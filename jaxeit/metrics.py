"""Figures of merit: where a contact is said to be, and how even the sensitivity is."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .inverse import Reconstructor


class AbstractEstimator(eqx.Module):
    """Where an image says that the contact is."""

    @abstractmethod
    def __call__(self, image: Float[Array, "... pixels"], recon: Reconstructor) -> Float[Array, "... 2"]:
        """Position, (..., 2) m; NaN where the image is nowhere positive."""


class Peak(AbstractEstimator):
    """The pixel with the largest value."""

    def __call__(self, image, recon):
        found = recon.centres[jnp.argmax(image, -1)]
        return jnp.where(jnp.max(image, -1, keepdims=True) > 0, found, jnp.nan)


class LevelCentroid(AbstractEstimator):
    """The unweighted centroid of the pixels at or above ``level`` of the largest value.

    Level 0.25 is the set q of the GREIT figures of merit (Adler et al. 2009); 0.5 is the half
    maximum.
    """

    level: float = 0.25

    def __call__(self, image, recon):
        top = jnp.max(image, -1, keepdims=True)
        inside = jnp.where((image >= self.level * top) & (top > 0), recon.areas, 0)
        return _centroid(inside, recon)


class PositiveCentroid(AbstractEstimator):
    """The centroid of the positive part, weighted by its value."""

    def __call__(self, image, recon):
        return _centroid(jnp.maximum(image, 0) * recon.areas, recon)


def _centroid(weight, recon):
    total = weight.sum(-1, keepdims=True)
    return jnp.where(total > 0, weight @ recon.centres / jnp.where(total > 0, total, 1), jnp.nan)


ESTIMATORS: dict[str, AbstractEstimator] = {
    "peak": Peak(),
    "half": LevelCentroid(0.5),
    "quarter": LevelCentroid(0.25),
    "positive": PositiveCentroid(),
}


def localisation_error(estimated: Float[ArrayLike, "... 2"], true: Float[ArrayLike, "... 2"]) -> Float[Array, "..."]:
    """Distance between estimated and true positions, m."""
    return jnp.linalg.norm(jnp.asarray(estimated) - jnp.asarray(true), axis=-1)


def inward_bias(
    estimated: Float[ArrayLike, "... 2"], true: Float[ArrayLike, "... 2"], centre: Float[ArrayLike, "2"]
) -> Float[Array, "..."]:
    """How much nearer to the sheet's centre the estimate lies than the truth, m, signed.

    The position error PE of the GREIT figures of merit, with the origin at ``centre``.
    """
    return localisation_error(true, centre) - localisation_error(estimated, centre)


def image_sum(image: Float[ArrayLike, "... pixels"], areas: Float[ArrayLike, " pixels"]) -> Float[Array, "..."]:
    """Integral of the image over the sheet, S m^2."""
    return jnp.asarray(image) @ jnp.asarray(areas)


def coefficient_of_variation(values: Float[ArrayLike, "... n"], *, ddof: int) -> Float[Array, "..."]:
    """Standard deviation over mean along the last axis; ``ddof`` is 0 or 1, and must be said."""
    values = jnp.asarray(values)
    return jnp.std(values, -1, ddof=ddof) / jnp.mean(values, -1)
