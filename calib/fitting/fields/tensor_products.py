"""Fields whose features are products of one function along each axis of the pad's bounding box."""

import abc
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxeit.registry import limited

from .base import AbstractField, Features, cubic_bspline
from .geometry import Geometry, OnPads, relative_to_pads

# Half width of the box of a Gaussian process's modes, over that of the pad. All modes vanish at the walls of the box,
# which must therefore lie outside the pad.
BOX_HALF_WIDTH = 1.4


class _TensorProduct(AbstractField):
    """Products of one function of each coordinate, both from the same list of functions."""

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        along = self._functions(relative_to_pads(geometry, place)[..., None])
        products: Features = along[..., 0, :, None] * along[..., 1, None, :]
        return products.reshape(*products.shape[:-2], -1)

    @abc.abstractmethod
    def _functions(self, u: Float[Array, "... 1"]) -> Float[Array, "... functions"]:
        """All functions at a coordinate u, -1 to 1 from side to side of the pad."""


class _Grid(_TensorProduct):
    """The same bump about each node of a grid over the pad."""

    nodes: eqx.AbstractVar[int]

    def _functions(self, u: Float[Array, "... 1"]) -> Float[Array, "... functions"]:
        centres, pitch = self._centres()
        return self._bump((u - jnp.asarray(centres, u.dtype)) / pitch)

    def _centres(self) -> tuple[Float[np.ndarray, " nodes"], float]:
        """Nodes along one axis, and their pitch."""
        pitch = 2 / (self.nodes - 1)
        return np.linspace(-1, 1, self.nodes), pitch

    @abc.abstractmethod
    def _bump(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        """The bump at a distance of z pitches from its node."""

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, len(self._centres()[0]) ** 2))


class Bilinear(_Grid):
    """Bilinear interpolation between the nodes of a grid over the pad."""

    name: ClassVar[str] = "bilinear"

    nodes: int = limited(3, least=2, most=50, static=True)
    shared: bool = eqx.field(static=True, default=False)

    def _bump(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.maximum(1 - jnp.abs(z), 0)


class RadialBasis(_Grid):
    """Gaussian bumps on a grid over the pad; their standard deviation is one pitch.

    Example:
        recipe = calib.Recipe(location=fitting.RadialBasis(nodes=5, shared=True))
    """

    name: ClassVar[str] = "rbf"

    nodes: int = limited(5, least=2, most=50, static=True)
    shared: bool = eqx.field(static=True, default=False)

    def _bump(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.exp(-0.5 * z**2)


class TensorSpline(_Grid):
    """Products of uniform cubic B-splines over `nodes` knots along each axis.

    Example:
        recipe = calib.Recipe(location=fitting.TensorSpline(nodes=4))
    """

    name: ClassVar[str] = "spline"

    nodes: int = limited(4, least=2, most=50, static=True)
    shared: bool = eqx.field(static=True, default=False)

    def _centres(self) -> tuple[Float[np.ndarray, " nodes"], float]:
        pitch = 2 / (self.nodes - 1)
        return np.linspace(-1 - pitch, 1 + pitch, self.nodes + 2), pitch

    def _bump(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        return cubic_bspline(z)


def _floats(values: Sequence[float] | Float[ArrayLike, " n"]) -> tuple[float, ...]:
    return tuple(np.asarray(values, float).tolist())


class GaussianProcess(_TensorProduct):
    """A smooth field of unknown length scale: a Gaussian process with squared exponential covariance.

    The features are the modes of the Laplacian on a box around the pad, and their prior variances are the spectral
    density of the process (Solin and Särkkä 2020, Statistics and Computing 30). The fit is linear, and exact as far as
    `modes` modes per axis resolve the length. `lengths` to average over are multiples of half the size of the pad.

    Example:
        # cross-validation chooses
        recipe = calib.Recipe(location=(calib.PadEdge(), fitting.GaussianProcess()))
    """

    name: ClassVar[str] = "gp"

    lengths: tuple[float, ...] = limited((0.3, 0.45, 0.7, 1.0, 1.5), above=0, static=True, converter=_floats)
    modes: int = limited(8, least=1, most=50, static=True)
    shared: bool = eqx.field(static=True, default=False)

    def _frequencies(self) -> Float[np.ndarray, " modes"]:
        """Angular frequencies of the modes along one axis."""
        return np.pi * np.arange(1, self.modes + 1) / (2 * BOX_HALF_WIDTH)

    def _functions(self, u: Float[Array, "... 1"]) -> Float[Array, "... functions"]:
        phase = (u + BOX_HALF_WIDTH) * jnp.asarray(self._frequencies(), u.dtype)
        found: Array = jnp.sin(phase) / np.sqrt(BOX_HALF_WIDTH)
        return found

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        square = self._frequencies() ** 2
        both = (square[:, None] + square).ravel()
        return np.array([2 * np.pi * length**2 * np.exp(-0.5 * length**2 * both) for length in self.lengths])
