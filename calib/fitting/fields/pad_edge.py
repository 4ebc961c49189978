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

KNOTS_PER_OCTAVE = 2  # of the functions of `PadEdgeSpline`
NO_WALL = 1e9  # m, beyond all bumps


class PadEdge(AbstractField):
    """Distance to the walls: a pad is stiff at its sides, and the part of a load beyond the rim of the sheet is lost.

    The field is a sum of functions of distance: to each side of the pad, and to the nearest side of the rim; and, with
    `corners`, a sum of products of bumps of the distances to the two nearest sides of the rim, all but the farthest,
    because a load at a corner of the sheet is lost beyond two sides, which counts neither once nor twice.
    Functions are sums of cubic B-splines over octaves of distance, the n-th centred where the distance is (2^n - 1)
    `width` (m). Walls are alike, so that all pads share the coefficients, and a few dozen presses suffice. A
    coefficient without presses at its distance keeps its prior.
    """

    name: ClassVar[str] = "edge"
    early: ClassVar[Mapping[str, Any]] = {"corners": False}
    former: ClassVar[Mapping[str, Any]] = {"steps": 1, "order": 0}

    width: Float[Array, ""] = limited(8e-3, above=0, converter=jnp.asarray)
    bumps: int = limited(4, least=1, most=20, static=True)
    shared: bool = eqx.field(static=True, default=True)
    corners: bool = eqx.field(static=True, default=True)

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        sides, rim = map(self._bumps, wall_distances(geometry, place))
        nearest, second = jnp.moveaxis(rim, -2, 0)
        return jnp.concatenate([jnp.sum(sides, -2), nearest, (nearest * second)[..., : self.pairs]], -1)

    def supported(self, low: Float[Array, "... 2"], high: Float[Array, "... 2"]) -> tuple[Array, Array]:
        """The box of the farthest press on every side, because all walls are alike."""
        farthest = jnp.max(jnp.maximum(-low, high), -1, keepdims=True)
        return jnp.broadcast_to(-farthest, low.shape), jnp.broadcast_to(farthest, high.shape)

    @property
    def pairs(self) -> int:
        """Number of products of bumps: of all but the farthest."""
        return self.bumps - 1 if self.corners else 0

    def _bumps(self, metres: Float[Array, "..."]) -> Float[Array, "... bumps"]:
        octaves = jnp.log2(1 + metres / self.width.astype(metres.dtype))
        return cubic_bspline(octaves[..., None] - jnp.arange(self.bumps, dtype=octaves.dtype))

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, 2 * self.bumps + self.pairs))


class PadEdgeSpline(PadEdge):
    """`PadEdge` with smooth functions of any shape, also of two distances together.

    Functions are sums of cubic B-splines with two knots an octave. By the prior, a function is a Gaussian process over
    octaves u of distance, which falls off with the distance: the covariance of coefficients at u and v is
    2^-(u + v) (1 + r + r^2 / 3) exp(-r), r = sqrt(5) |u - v| / `length` (Matern's, of smoothness 5/2). Between the
    distances of the presses the error that it states grows. With `corners`, functions of the distances to the two
    nearest sides are added, of the rim and of the pad: products of the `modes` largest principal functions of that
    process.

    Example:
        recipe = calib.Recipe(location=calib.PadEdgeSpline())
    """

    name: ClassVar[str] = "edge-spline"
    early: ClassVar[Mapping[str, Any]] = {}
    former: ClassVar[Mapping[str, Any]] = {}
    steady: ClassVar[bool] = True

    bumps: int = limited(12, least=1, most=20, static=True)
    length: float = limited(2.0, above=0, static=True, converter=float)
    modes: int = limited(5, least=1, most=20, static=True)

    def basis(self, geometry: Geometry, place: OnPads) -> Features:
        sides, rim = map(self._bumps, wall_distances(geometry, place))
        single, paired = (
            jnp.asarray(part, rim.dtype) for part in (self.principal(), self.principal()[:, : self.pairs])
        )
        corners = [_products(part[..., :2, :] @ paired) for part in (rim, sides)]
        return jnp.concatenate([jnp.sum(sides, -2) @ single, rim[..., 0, :] @ single, *corners], -1)

    @property
    def pairs(self) -> int:
        """Number of functions of each distance whose products are used at corners."""
        return min(self.modes, self.bumps) if self.corners else 0

    def octaves(self) -> Float[np.ndarray, " bumps"]:
        """Octaves of distance at the centres of the B-splines."""
        return (np.arange(self.bumps) - 1) / KNOTS_PER_OCTAVE

    def principal(self) -> Float[np.ndarray, "bumps bumps"]:
        """Coefficients of the B-splines in each principal function of the process, the largest first.

        The prior variance of the functions is one, and that of the coefficients is one on the average. The largest
        coefficient of each is above zero: LAPACK leaves the signs open, and what one machine saves another one opens.
        """
        u = self.octaves()
        r = np.sqrt(5) * np.abs(u[:, None] - u) / self.length
        covariance = 2.0 ** -(u[:, None] + u) * (1 + r + r**2 / 3) * np.exp(-r)
        values, vectors = np.linalg.eigh(covariance / np.mean(np.diag(covariance)))
        largest = vectors[np.abs(vectors).argmax(0), np.arange(self.bumps)]
        found: np.ndarray = (vectors * np.sign(largest) * np.sqrt(np.maximum(values, 0)))[:, ::-1]
        return found

    def _bumps(self, metres: Float[Array, "..."]) -> Float[Array, "... bumps"]:
        octaves = jnp.log2(1 + metres / self.width.astype(metres.dtype))
        return cubic_bspline(KNOTS_PER_OCTAVE * (octaves[..., None] - jnp.asarray(self.octaves(), octaves.dtype)))

    def shapes(self) -> Float[np.ndarray, "shapes k"]:
        return np.ones((1, 2 * self.bumps + 2 * self.pairs**2))


def _products(functions: Float[Array, "... 2 k"]) -> Float[Array, "... products"]:
    """Products of each function of the nearest wall and each of the second."""
    both = functions[..., 0, :, None] * functions[..., 1, None, :]
    return both.reshape(*both.shape[:-2], -1)


def wall_distances(
    geometry: Geometry, place: OnPads
) -> tuple[Float[Array, "... pads sides"], Float[Array, "... pads 2"]]:
    """Distances (m) from places on pads to all sides of the pad, and to the two nearest sides of the rim, in order.

    The distance to a side of length zero, which a pad of few sides has, is `NO_WALL`.
    """
    real = jnp.any(geometry.start != geometry.end, -1)
    to_sides = distance(nearest_points(place, geometry.start, geometry.end), place[..., None, :])
    to_rim = distance(nearest_points(place, geometry.rim[:, 0], geometry.rim[:, 1]), place[..., None, :])
    return jnp.sort(jnp.where(real, to_sides, NO_WALL), -1), jnp.sort(to_rim, -1)[..., :2]


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
