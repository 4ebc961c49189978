"""Pneumatics: from the pressure on a pad to the pressure in it."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._base import AbstractPadEffect, parameter


class PadEdgeDip(AbstractPadEffect):
    """A pad is stiff where its walls are: the response falls by ``d exp(-distance / w)``.

    | meaning                     | default | range    | unit | source                         |
    |-----------------------------|---------|----------|------|--------------------------------|
    | depth d at the outline      | 0.4     | 0 to 0.9 | 1    | chosen: gives the paper's 0.14 |
    | width w of the stiff border | 10      | 2 to 30  | mm   | chosen: gives the paper's 0.14 |
    """

    depth: Float[Array, ""] = parameter(0.4)
    width: Float[Array, ""] = parameter(10e-3)

    def __call__(self, response, distance):
        return response * (1 - self.depth * jnp.exp(-distance / self.width))
