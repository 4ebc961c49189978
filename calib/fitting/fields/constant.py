"""The field that is the same everywhere."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .base import AbstractField, Features
from .geometry import Geometry, OnPads


class Constant(AbstractField):
    """No correction: the gain of a pad is the same everywhere, and its scatter over places is estimated."""

    name: ClassVar[str] = "constant"

    shared: bool = eqx.field(static=True, default=True)

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        return jnp.zeros((*place.shape[:-1], 1), place.dtype)

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, 1))
