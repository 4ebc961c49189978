"""Optimality criteria of a scan: functions of the covariance of the place of a contact."""

from abc import abstractmethod
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..registry import AbstractChoice, Registry, limited


class AbstractCriterion(AbstractChoice):
    """A convex function h of the covariance of place, (2, 2) in squared widths, whose mean over sites is minimised."""

    name: ClassVar[str]

    @abstractmethod
    def after(self, place: Float[Array, "2 2"], change: Float[Array, " k"]) -> Float[Array, " k"]:
        """h when the covariance changes by ``k k^T`` with ``change = k^T metric k``, or by its negative."""

    @abstractmethod
    def metric(self, place: Float[Array, "2 2"]) -> tuple[Float[Array, ""], Float[Array, "2 2"]]:
        """Factor f and matrix G, with which the derivative of h along ``k k^T`` is ``f k^T G k``."""

    @abstractmethod
    def length(self, mean: float) -> float:
        """The mean of h as an error of place, in widths."""

    def mean(self, covariance: Float[Array, "n 4 4"]) -> Float[Array, ""]:
        """The mean of h over covariances of the unknowns of contacts."""
        zero = jnp.zeros(1, covariance.dtype)
        return jnp.mean(jax.vmap(lambda c: self.after(c[:2, :2], zero))(covariance))


class PlaceError(AbstractCriterion):
    """h is a power of the error of place, the root of the sum of both variances.

    A power of 1 is the mean error over sites, 2 the mean variance (A-optimal); a larger one looks at the worst sites. h
    is convex for every power, since the inverse of the sum of variances is concave in the information.

    Example:
        print(list(je.scan.CRITERIA))  # names for the command line
        worst = je.scan.PlaceError(power=8.0)
        few = je.skin.all_pairs(25)[::40]  # candidates
        sensitivity = je.scan.place_sensitivity(model, je.scan.DesignSettings(columns=4))
        design = je.scan.design_scan(sensitivity, 60, worst, candidates=few)
        print(f"{1e3 * design.error:.2f} mm; no 60 of these readings are below {1e3 * design.bound:.2f} mm")
    """

    name: ClassVar[str] = "place-error"
    power: float = limited(1.0, above=0, most=40, static=True)

    def after(self, place: Float[Array, "2 2"], change: Float[Array, " k"]) -> Float[Array, " k"]:
        return jnp.maximum(jnp.trace(place) + change, 0) ** (0.5 * self.power)

    def metric(self, place: Float[Array, "2 2"]) -> tuple[Float[Array, ""], Float[Array, "2 2"]]:
        half = 0.5 * self.power
        return half * jnp.trace(place) ** (half - 1), jnp.eye(2, dtype=place.dtype)

    def length(self, mean: float) -> float:
        return float(max(mean, 0.0) ** (1 / self.power))


class PlaceVolume(AbstractCriterion):
    """D-optimal: h is the log determinant of the covariance, the area of the ellipse of place.

    Example:
        smallest_ellipses = je.scan.design_scan(sensitivity, 60, je.scan.PlaceVolume(), candidates=few)
    """

    name: ClassVar[str] = "d-optimal"

    def after(self, place: Float[Array, "2 2"], change: Float[Array, " k"]) -> Float[Array, " k"]:
        return jnp.log(_determinant(place)) + jnp.log1p(jnp.maximum(change, -1))

    def metric(self, place: Float[Array, "2 2"]) -> tuple[Float[Array, ""], Float[Array, "2 2"]]:
        (a, b), (_, d) = place
        return jnp.ones((), place.dtype), jnp.array([[d, -b], [-b, a]]) / _determinant(place)

    def length(self, mean: float) -> float:
        return float(np.sqrt(2) * np.exp(0.25 * mean))


def _determinant(place: Float[Array, "2 2"]) -> Float[Array, ""]:
    return place[0, 0] * place[1, 1] - place[0, 1] ** 2


CRITERIA: Registry[AbstractCriterion] = Registry(AbstractCriterion, "criterion", "jaxeit.criteria")
"""Criteria by the names that the command line uses."""
