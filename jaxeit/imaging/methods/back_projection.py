"""Back-projection: each pixel as a weighted mean of the readings."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...registry import limited
from .base import AbstractLinearMethod, Problem


class BackProjection(AbstractLinearMethod):
    """Each pixel is the mean of the readings weighted by its sensitivity, ``x_j = J_j . y / (|J_j|^2 + f)``.

    f is ``floor`` of the largest ``|J_j|^2``.

    The oldest method, for comparison; it uses neither prior nor hyperparameter, and its images are blurred.
    """

    floor: float = limited(1e-3, above=0)

    def image(self, problem: Problem, y: Float[Array, "k ..."]) -> Float[Array, "basis ..."]:
        power = jnp.sum(problem.jacobian**2, 0)
        return (y.T @ problem.jacobian / (power + self.floor * jnp.max(power))).T
