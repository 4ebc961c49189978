"""Priors: what an image is expected to look like before the data are seen."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractPrior(eqx.Module):
    """A quadratic penalty ``x^T R x`` with a diagonal R."""

    @abstractmethod
    def diagonal(
        self, jacobian: Float[Array, "readings basis"], areas: Float[Array, " basis"]
    ) -> Float[Array, " basis"]:
        """The diagonal of R = Gamma^T Gamma, positive; its overall scale does not matter."""


class Noser(AbstractPrior):
    """``R = diag(J^T J)^p``: pixels that the readings hardly see are not blown up.

    Newton's One-Step Error Reconstructor (Cheney et al. 1990); the exponent as in Adler and Guardo.
    Pixels without any sensitivity (corners, under a bolt) are floored at ``floor`` of the largest.

    | meaning  | default | range    |
    |----------|---------|----------|
    | exponent | 0.5     | 0 to 1   |
    | floor    | 1e-3    | above 0  |
    """

    exponent: float = 0.5
    floor: float = 1e-3

    def diagonal(self, jacobian, areas):
        power = jnp.sum(jacobian**2, 0) ** self.exponent
        return jnp.maximum(power, self.floor * jnp.max(power))


class Tikhonov(AbstractPrior):
    """``R = diag(area)``: the same penalty per unit of area everywhere, whatever the mesh."""

    def diagonal(self, jacobian, areas):
        return jnp.maximum(areas, 1e-3 * jnp.max(areas))
