"""Mechanics: from the indenter to the pressure on the sheet."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._base import AbstractLoadEffect, Touch, parameter


class LoadSpreading(AbstractLoadEffect):
    """The pad spreads the load: the tip's pressure arrives as a Gaussian.

    ``p / load = exp(-r^2 / (2 s^2)) / (2 pi s^2)``, whose integral over the plane is one; the part
    that falls outside the sheet is carried by the frame and lost, not renormalised.

    | meaning                                  | default | range   | unit | source          |
    |------------------------------------------|---------|---------|------|-----------------|
    | width s, tip included                    | 12      | 6 to 20 | mm   | assumption; the |
    | half-space under a 20 mm tip: 7 to 10 mm |         |         |      | pad is hollow   |
    """

    width: Float[Array, ""] = parameter(12e-3)

    def __call__(self, spread, touch: Touch, centroids):
        square = jnp.sum((centroids - touch.centre) ** 2, -1)
        return jnp.exp(-0.5 * square / self.width**2) / (2 * jnp.pi * self.width**2)
