"""Estimators of the place of a contact in an image."""

from abc import abstractmethod

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._compile import verb
from ..registry import AbstractChoice, Registry, limited
from .inputs import Pictured, on_pixels


class AbstractEstimator(AbstractChoice):
    """An estimator of the contact's position from an image.

    A class of your own is named by its import path, as in ``--locator image-centroid:estimator=my_module:MyEstimator``.
    """

    @abstractmethod
    def __call__(self, image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... 2"]:
        """Position, (..., 2) m; NaN where the image is nowhere positive."""


class Peak(AbstractEstimator):
    """The pixel with the largest value."""

    def __call__(self, image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... 2"]:
        return _peak(on_pixels(image, recon), recon.centres)


class LevelCentroid(AbstractEstimator):
    """The unweighted centroid of the pixels at or above ``level`` of the largest value.

    Level 0.25 is the set q of the GREIT figures of merit (Adler et al. 2009); 0.5 is the half
    maximum.
    """

    level: float = limited(0.25, above=0, most=1)

    def __call__(self, image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... 2"]:
        image = on_pixels(image, recon)
        return _level_centroid(image, recon.centres, recon.areas, jnp.asarray(self.level, image.dtype))


class PositiveCentroid(AbstractEstimator):
    """The centroid of the positive part, weighted by its value.

    Example:
        print(je.metrics.PositiveCentroid()(images, recon))  # m
    """

    def __call__(self, image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... 2"]:
        return _positive_centroid(on_pixels(image, recon), recon.centres, recon.areas)


@verb
def _peak(image: Float[Array, "... pixels"], centres: Float[Array, "pixels 2"]) -> Float[Array, "... 2"]:
    return jnp.where(jnp.max(image, -1, keepdims=True) > 0, centres[jnp.argmax(image, -1)], jnp.nan)


@verb
def _level_centroid(
    image: Float[Array, "... pixels"],
    centres: Float[Array, "pixels 2"],
    areas: Float[Array, " pixels"],
    level: Float[Array, ""],
) -> Float[Array, "... 2"]:
    top = jnp.max(image, -1, keepdims=True)
    return _centroid(jnp.where((image >= level * top) & (top > 0), areas, 0), centres)


@verb
def _positive_centroid(
    image: Float[Array, "... pixels"], centres: Float[Array, "pixels 2"], areas: Float[Array, " pixels"]
) -> Float[Array, "... 2"]:
    return _centroid(jnp.maximum(image, 0) * areas, centres)


def _centroid(weight: Float[Array, "... pixels"], centres: Float[Array, "pixels 2"]) -> Float[Array, "... 2"]:
    total = weight.sum(-1, keepdims=True)
    return jnp.where(total > 0, weight @ centres / jnp.where(total > 0, total, 1), jnp.nan)


ESTIMATORS = Registry(
    AbstractEstimator,
    "estimator",
    "jaxeit.estimators",
    words={"half": "level-centroid:level=0.5", "quarter": "level-centroid:level=0.25", "positive": "positive-centroid"},
)
"""Estimators by the names that recipes and the command line use; "half" and "quarter" are levels of `LevelCentroid`."""
