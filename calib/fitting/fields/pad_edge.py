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

    The field is a sum of functions of distance: to each side of the pad, and to the nearest side of the rim; and, with
    `corners`, a sum of products of bumps of the distances to the two nearest sides of the rim, all but the farthest,
    because a load at a corner of the sheet is lost beyond two sides, which counts neither once nor twice.
    Functions are sums of cubic B-splines over octaves of distance, the n-th centred where the distance is
    (2^(n / `steps`) - 1) `width` (m). Walls are alike, so that all pads share the coefficients, and a few dozen presses
    suffice. A coefficient without presses at its distance keeps its prior. With ``order=0`` coefficients are
    independent; for larger ones see `PadEdgeSpline`.
    """

    name: ClassVar[str] = "edge"
    early: ClassVar[Mapping[str, Any]] = {"corners": False, "steps": 1, "order": 0}

    width: Float[Array, ""] = limited(8e-3, above=0, converter=jnp.asarray)
    bumps: int = limited(4, least=1, most=20, static=True)
    shared: bool = eqx.field(static=True, default=True)
    corners: bool = eqx.field(static=True, default=True)
    steps: int = limited(1, least=1, most=8, static=True)
    order: int = limited(0, least=0, most=3, static=True)

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        real = jnp.any(geometry.start != geometry.end, -1)
        to_sides = distance(nearest_points(place, geometry.start, geometry.end), place[..., None, :])
        to_rim = distance(nearest_points(place, geometry.rim[:, 0], geometry.rim[:, 1]), place[..., None, :])
        nearest, second = jnp.moveaxis(self._bumps(jnp.sort(to_rim, -1)[..., :2]), -2, 0)
        sides = jnp.sum(jnp.where(real[..., None], self._bumps(to_sides), 0), -2)
        corner = (nearest * second)[..., : self.pairs]
        parts = [part @ jnp.asarray(self.smooth(part.shape[-1]), part.dtype) for part in (sides, nearest, corner)]
        return jnp.concatenate(parts, -1)

    def supported(self, low: Float[Array, "... 2"], high: Float[Array, "... 2"]) -> tuple[Array, Array]:
        """The box of the farthest press on every side, because all walls are alike."""
        farthest = jnp.max(jnp.maximum(-low, high), -1, keepdims=True)
        return jnp.broadcast_to(-farthest, low.shape), jnp.broadcast_to(farthest, high.shape)

    @property
    def first(self) -> int:
        """Number n of the first bump."""
        return -1 if self.order else 0

    @property
    def pairs(self) -> int:
        """Number of products of bumps: of all but the farthest."""
        return self.bumps - 1 if self.corners else 0

    def smooth(self, bumps: int) -> Float[np.ndarray, "bumps bumps"]:
        """Coefficients of so many bumps for each independent one, with prior variances of one on average."""
        summed = np.linalg.matrix_power(np.triu(np.ones((bumps, bumps))), self.order)
        found: np.ndarray = summed / np.sqrt(np.sum(summed**2) / max(bumps, 1))
        return found

    def _bumps(self, metres: Float[Array, "..."]) -> Float[Array, "... bumps"]:
        octaves = jnp.log2(1 + metres / self.width.astype(metres.dtype))
        place = self.steps * octaves - self.first
        return cubic_bspline(place[..., None] - jnp.arange(self.bumps, dtype=octaves.dtype))

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, 2 * self.bumps + self.pairs))


class PadEdgeSpline(PadEdge):
    """`PadEdge` with functions that may bend twice in an octave: smoothing splines (Wahba 1990), for many presses.

    From n = -1 on, the coefficient of each B-spline is that of the next one plus an independent step (`order` 1; 2: the
    steps are such sums themselves). So a function vanishes far from the walls, and between and beyond the distances of
    the presses it stays near the values there. Press at scattered places: a regular grid has few distances to walls.

    Example:
        recipe = calib.Recipe(location=fitting.PadEdgeSpline())
    """

    name: ClassVar[str] = "edge-spline"

    bumps: int = limited(9, least=1, most=20, static=True)
    steps: int = limited(2, least=1, most=8, static=True)
    order: int = limited(1, least=0, most=3, static=True)


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
