"""Outlines of the pads and the rim of the sheet, and where a place lies on them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

import jaxeit as je

OnPads = Float[Array, "... pads 2"]

# Straight sides that stand for a rim without corners. A circle then differs from its sides by 0.03 % of its radius.
RIM_SIDES = 128


class Geometry(eqx.Module):
    """Outlines of the pads and the rim of the sheet, as straight sides.

    | field      | meaning                              | shape              | unit |
    |------------|--------------------------------------|--------------------|------|
    | start, end | of each side of each pad; pads with  | (pads, sides, 2)   | m    |
    |            | few sides have some of length zero   |                    |      |
    | rim        | ends of the sides of the sheet's rim | (rim sides, 2, 2)  | m    |
    """

    start: Float[Array, "pads sides 2"]
    end: Float[Array, "pads sides 2"]
    rim: Float[Array, "rim 2 2"]

    @property
    def pads(self) -> int:
        """Number of pads."""
        return self.start.shape[0]


def geometry_of(skin: je.Skin, dtype: DTypeLike | None = None) -> Geometry:
    """The outlines of a skin's pads and its rim."""
    sides = max((len(pad.outline) for pad in skin.pads), default=1)
    outlines = [np.concatenate([p.outline, np.repeat(p.outline[:1], sides - len(p.outline), 0)]) for p in skin.pads]
    start = np.array(outlines, float).reshape(len(skin.pads), sides, 2)
    corners = np.asarray(skin.domain.corners, float)
    if not len(corners):
        corners = np.linspace(0, skin.domain.perimeter, RIM_SIDES, endpoint=False)
    rim = np.asarray(skin.domain.boundary_point(corners), float)
    parts = start, np.roll(start, -1, 1), np.stack([rim, np.roll(rim, -1, 0)], 1)
    return Geometry(*(jnp.asarray(part, dtype) for part in parts))


def nearest_points(
    point: Float[Array, "... 2"], start: Float[Array, "... 2"], end: Float[Array, "... 2"]
) -> Float[Array, "... 2"]:
    """The point of each side that is nearest to a point (..., 2): (..., sides, 2)."""
    vector = end - start
    square = jnp.sum(vector**2, -1)
    along = jnp.sum((point[..., None, :] - start) * vector, -1) / jnp.where(square > 0, square, 1)
    return start + jnp.clip(along, 0, 1)[..., None] * vector


def distance(a: Float[Array, "... 2"], b: Float[Array, "... 2"]) -> Float[Array, "..."]:
    """Euclidean distance, with a gradient of zero (not NaN) at zero."""
    square = jnp.sum((a - b) ** 2, -1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def _contains(
    point: Float[Array, "... 2"], start: Float[Array, "pads sides 2"], end: Float[Array, "pads sides 2"]
) -> Bool[Array, "... pads"]:
    """Whether points (..., 2) lie within pads, by the even-odd rule: (..., pads)."""
    x, y = point[..., None, None, 0], point[..., None, None, 1]
    spans = (start[..., 1] > y) != (end[..., 1] > y)
    rise = jnp.where(end[..., 1] == start[..., 1], 1, end[..., 1] - start[..., 1])
    crosses = x < start[..., 0] + (y - start[..., 1]) * (end[..., 0] - start[..., 0]) / rise
    return jnp.sum(spans & crosses, -1) % 2 == 1


def onto_pads(geometry: Geometry, point: Float[Array, "... 2"]) -> OnPads:
    """The point of each pad nearest to each point, (..., pads, 2): a contact beside a pad loads the pad at its edge."""
    near = nearest_points(point[..., None, :], geometry.start, geometry.end)
    best = jnp.argmin(distance(near, point[..., None, None, :]), -1)
    edge = jnp.take_along_axis(near, best[..., None, None], -2)[..., 0, :]
    inside = _contains(point, geometry.start, geometry.end)
    return jnp.where(inside[..., None], point[..., None, :], edge)


def relative_to_pads(geometry: Geometry, place: OnPads) -> OnPads:
    """Places on pads (..., pads, 2) m in coordinates of the pads' bounding boxes, -1 to 1."""
    low, high = geometry.start.min(1), geometry.start.max(1)
    return (2 * place - low - high) / (high - low)
