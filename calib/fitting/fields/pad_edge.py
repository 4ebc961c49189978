"""Fields of the distance to walls: the sides of a pad and the rim of the sheet."""

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jaxeit.registry import limited

from .base import REFERENCE_WIDTH, AbstractField, Features, cubic_bspline
from .geometry import Geometry, OnPads, distance, nearest_points


class PadEdge(AbstractField):
    """Distance to the walls: a pad is stiff at its sides, and the part of a load beyond the rim of the sheet is lost.

    Features are bumps (cubic B-splines) over octaves of distance, the n-th centred where the distance is
    (2^n - 1) `width` (m), summed over the sides of the pad; the same bumps of the distance to the rim; and, with
    `corners`, their products with those of the distance to the second nearest side of the rim, all but the farthest,
    because a load at a corner of the sheet is lost beyond two sides, which counts neither once nor twice. A coefficient
    without presses at its distance keeps its prior. Walls are alike, so that all pads share the coefficients, and a few
    dozen presses suffice.
    """

    name: ClassVar[str] = "edge"
    early: ClassVar[Mapping[str, Any]] = {"corners": False}

    width: Float[Array, ""] = limited(8e-3, above=0, converter=jnp.asarray)
    bumps: int = limited(4, least=1, most=20, static=True)
    shared: bool = eqx.field(static=True, default=True)
    corners: bool = eqx.field(static=True, default=True)

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        real = jnp.any(geometry.start != geometry.end, -1)
        to_sides = distance(nearest_points(place, geometry.start, geometry.end), place[..., None, :])
        to_rim = distance(nearest_points(place, geometry.rim[:, 0], geometry.rim[:, 1]), place[..., None, :])
        nearest, second = jnp.moveaxis(self._bumps(jnp.sort(to_rim, -1)[..., :2]), -2, 0)
        sides = jnp.sum(jnp.where(real[..., None], self._bumps(to_sides), 0), -2)
        corner = (nearest * second)[..., : self.bumps - 1 if self.corners else 0]
        return jnp.concatenate([sides, nearest, corner], -1)

    def supported(self, low: Float[Array, "... 2"], high: Float[Array, "... 2"]) -> tuple[Array, Array]:
        """The box of the farthest press on every side, because all walls are alike."""
        farthest = jnp.max(jnp.maximum(-low, high), -1, keepdims=True)
        return jnp.broadcast_to(-farthest, low.shape), jnp.broadcast_to(farthest, high.shape)

    def _bumps(self, metres: Float[Array, "..."]) -> Float[Array, "... bumps"]:
        octaves = jnp.log2(1 + metres / self.width.astype(metres.dtype))
        return cubic_bspline(octaves[..., None] - jnp.arange(self.bumps, dtype=octaves.dtype))

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, 3 * self.bumps - 1 if self.corners else 2 * self.bumps))


class PadEdgeSize(PadEdge):
    """`PadEdge`, times a power of the contact's estimated width, for pads that respond differently to broad contacts.

    Press with tips of several diameters to determine the power.

    Example:
        recipe = calib.Recipe(location=fitting.PadEdgeSize())
    """

    name: ClassVar[str] = "edge-size"

    def features(
        self, geometry: Geometry, place: OnPads, width: Float[ArrayLike, "..."] = REFERENCE_WIDTH
    ) -> Float[Array, "... pads m"]:
        edge = super().features(geometry, place)
        size = jnp.log(jnp.asarray(width, edge.dtype) / REFERENCE_WIDTH)
        return jnp.concatenate([edge, jnp.broadcast_to(size[..., None, None], (*edge.shape[:-1], 1))], -1)

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.concatenate([super().shapes(), np.ones((1, 1))], 1)
