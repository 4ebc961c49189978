"""Errors of images of the reference's frames, relative to the touches that made the frames."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..fusion import PadMasks, fuse, pad_masks
from ..imaging.reconstruction import AbstractReconstructor, Reconstructor
from ..metrics import LevelCentroid, localisation_error
from ..model.bases import BasisMap
from ..model.discretisation import Model
from ..skin.description import Skin
from .recommendation import Reference
from .settings import Choice, LadderError, Touch
from .solutions import gaussian
from .timing import clocked, finished

HALF_MAXIMUM_CENTROID = LevelCentroid(0.5)


@dataclass(frozen=True, eq=False)
class JudgedImages:
    """Errors of one choice's images, and the calls to time.

    | meaning                                                                | shape      | unit |
    |------------------------------------------------------------------------|------------|------|
    | distances of the half-maximum centroid from each touch                  | (touches,) | m    |
    | misplaced: share of the force in the wrong place, mean over the touches | ()         | 1    |
    | prepare: seconds of `jaxeit.prepare`                                    |            | s    |
    | one, many: calls that image one frame, and many                         |            |      |
    """

    distances: Float[np.ndarray, " touches"]
    misplaced: float
    prepare: float
    one: Callable[[np.ndarray], Any]
    many: Callable[[np.ndarray], Any]


def judged_images(
    skin: Skin, model: Model, choice: Choice, touches: Sequence[Touch], truth: Reference
) -> JudgedImages | None:
    """Image the reference's frames with the imaging of ``choice`` and measure their errors; None if it has no imaging.

    Raises:
        LadderError: if the image of a touch is not positive anywhere.
    """
    how = choice.imaging
    if how is None:
        return None
    spent, recon = clocked(lambda: jax.block_until_ready(how.prepare(model, frames=truth.differences)))
    image = recon(truth.differences.astype(model.dtype))
    distances = np.asarray(localisation_error(HALF_MAXIMUM_CENTROID(image, recon), _places(touches, model.dtype)))
    if not np.isfinite(distances).all():
        lost = touches[int(np.argmin(np.isfinite(distances)))].name
        raise LadderError(f"{choice.label} shows nothing of the touch {lost!r}; give another touch, or another imaging")
    one = recon.on_host() if isinstance(recon, Reconstructor) else finished(recon)
    wrong = float(misplaced(skin, recon, image, touches).mean())
    return JudgedImages(distances, wrong, spent, one, finished(recon))


def _places(touches: Sequence[Touch], dtype: np.dtype) -> Float[np.ndarray, "touches 2"]:
    return np.array([touch.position for touch in touches], dtype)


def misplaced(
    skin: Skin,
    recon: AbstractReconstructor | BasisMap,
    image: Float[Array, "touches basis"],
    touches: Sequence[Touch],
) -> Float[np.ndarray, " touches"]:
    """Share of the force that the force map shows in the wrong place, for exact pad forces.

    Half of the sum of excess and missing force over the pixels, for a force of one.
    """
    bumps = np.stack([gaussian(np.asarray(recon.centres, np.float64), t) for t in touches]) * np.asarray(recon.areas)
    masks = _masks(skin, recon, bumps)
    weights = np.asarray(masks.weights, np.float64)
    wanted = bumps * weights.sum(0)
    whole = wanted.sum(1, keepdims=True)
    shown = fuse(image, masks, jnp.asarray(bumps @ weights.T / whole, image.dtype))
    return np.asarray(np.abs(np.asarray(shown) - wanted / whole).sum(1) / 2)


def _masks(skin: Skin, recon: Any, bumps: Float[np.ndarray, "touches basis"]) -> PadMasks:
    """The pads, if they carry more than half of every touch; else the sheet as one pad."""
    if skin.pads and len(recon.shape) == 2:
        masks = pad_masks(skin, recon)
        if np.all(bumps @ np.asarray(masks.weights).sum(0) > bumps.sum(1) / 2):
            return masks
    return PadMasks(jnp.ones_like(recon.areas)[None], recon.areas)
