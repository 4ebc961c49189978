"""Fusion: the shape of the contact from the image, its force from the pads."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .basis import BasisMap, overlap_areas
from .inverse import Reconstructor
from .skin import Skin


class FusionError(ValueError):
    """Masks or forces that do not fit the image."""


class PadMasks(eqx.Module):
    """Which pad carries which part of the image.

    | meaning                                                  | shape          | unit |
    |----------------------------------------------------------|----------------|------|
    | weights: share of each pad in each pixel, sum at most 1  | (pads, pixels) |      |
    | areas of the pixels                                      | (pixels,)      | m^2  |
    """

    weights: Float[Array, "pads pixels"]
    areas: Float[Array, " pixels"]


class ForceMap(eqx.Module):
    """Forces on the skin.

    | meaning                                                          | shape         | unit |
    |------------------------------------------------------------------|---------------|------|
    | force on each pixel; over a pad it sums to the pad's force       | (..., pixels) | N    |
    | valid: the shape comes from the image, not from the fallback     | (..., pads)   |      |
    | concentration: positive part of the image over its magnitude     | (..., pads)   |      |
    | discarded: negative part of the image that was cut away          | (..., pads)   | S m^2|
    | areas of the pixels                                              | (pixels,)     | m^2  |
    """

    force: Float[Array, "... pixels"]
    valid: Bool[Array, "... pads"]
    concentration: Float[Array, "... pads"]
    discarded: Float[Array, "... pads"]
    areas: Float[Array, " pixels"]

    @property
    def pressure(self) -> Float[Array, "... pixels"]:
        """Mean pressure on each pixel, Pa; zero where a pixel misses the sheet."""
        area = jnp.where(self.areas > 0, self.areas, 1.0)
        return jnp.where(self.areas > 0, self.force / area, 0.0)

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.force, dtype=dtype)


def pad_masks(skin: Skin, image: Reconstructor | BasisMap) -> PadMasks:
    """Masks of the skin's pads on a pixel image, by exact areas of overlap.

    Where pads overlap they share the pixel equally (a partition of unity).

    Raises:
        FusionError: if the image is not one of pixels, or a pad lies outside it.
    """
    if len(image.shape) != 2:
        raise FusionError("pad masks need an image of pixels; prepare with basis=Pixels(...)")
    x0, x1, y0, y1 = image.extent
    rows, columns = image.shape
    pixel = np.array([(x1 - x0) / columns, (y1 - y0) / rows])
    low = np.asarray(image.centres, float) - pixel / 2
    masks = [_coverage(pad.outline, low, low + pixel) for pad in skin.pads]
    weights = np.array(masks).reshape(len(skin.pads), len(low))
    areas = np.asarray(image.areas)
    for pad, mask in zip(skin.pads, weights, strict=True):
        if not (mask * areas).any():
            raise FusionError(f"pad {pad.name!r} covers no part of the image")
    weights = weights / np.maximum(weights.sum(0), 1.0)
    return PadMasks(jnp.asarray(weights, image.areas.dtype), image.areas)


def _coverage(outline: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    outlines = np.broadcast_to(outline, (len(low), *outline.shape))
    share = overlap_areas(outlines, low, high) / np.prod(high - low, -1)
    return np.where(share > 1e-9, np.minimum(share, 1.0), 0.0)


@eqx.filter_jit
def fuse(
    image: Float[Array, "... pixels"],
    masks: PadMasks,
    pad_forces: Float[Array, "... pads"],
    *,
    gate: float = 0.6,
) -> ForceMap:
    """Distribute each pad's force over its part of the image.

    The paper's equation 4 in a form that cannot blow up: a pixel weighs its area times the positive
    part of its image; where the image over a pad is mostly noise (its positive part less than
    ``gate`` of its magnitude; noise alone gives a half) or not finite, or the pad's force is not
    positive, the force is spread evenly over the pad and flagged as not valid.  Either way the
    map over a pad sums to the pad's force.  A pad whose force is not finite has NaN on its own pixels only.

    Args:
        image: conductivity change, (..., pixels) S.
        masks: from `pad_masks`.
        pad_forces: (..., pads) N.
        gate: least concentration of a valid image, 0.5 to 1.

    Raises:
        ValueError: if the shapes do not fit.
    """
    image, forces = jnp.asarray(image), jnp.asarray(pad_forces)
    pads, pixels = masks.weights.shape
    if image.shape[-1:] != (pixels,) or forces.shape[-1:] != (pads,):
        raise FusionError(
            f"image {image.shape} and pad_forces {forces.shape} must end in {pixels} pixels and {pads} pads"
        )
    finite = jnp.isfinite(image)
    mass = jnp.where(finite, image, 0) * masks.areas
    positive = jnp.maximum(mass, 0) @ masks.weights.T
    discarded = jnp.maximum(-mass, 0) @ masks.weights.T
    total = positive + discarded
    concentration = positive / jnp.where(total > 0, total, 1)
    missing = (~finite).astype(mass.dtype) @ masks.weights.T > 0
    known = jnp.isfinite(forces)
    valid = (concentration >= gate) & ~missing & known & (forces > 0)

    shape = jnp.where(valid[..., None], jnp.maximum(mass, 0)[..., None, :], masks.areas)
    part = masks.weights * shape
    whole = part.sum(-1, keepdims=True)
    part = part / jnp.where(whole > 0, whole, 1)
    force = (part * jnp.where(known, forces, 0)[..., None]).sum(-2)
    silent = (~known).astype(mass.dtype) @ masks.weights > 0  # NaN last: it spreads in no sum, and in no derivative
    force = jnp.where(silent, jnp.nan, force)
    return ForceMap(force, valid, concentration, discarded, masks.areas)
