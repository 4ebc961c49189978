"""Images of the frames of presses, and the places of the presses estimated from these frames."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxeit as je

from ...check.placement import PLACEMENT_FIDELITY, placement_note
from ...fitting.fields import Places
from ...presses.pooled import PooledPresses
from ..recipes.recipe import Recipe
from .locators import AbstractLocator, locate

REPORTED_ESTIMATORS: Mapping[str, je.metrics.AbstractEstimator] = {
    name: je.metrics.ESTIMATORS.make(name) for name in ("peak", "half", "quarter", "positive")
}
"""Estimators of the place whose errors an evaluation states, by their names there."""


class PressImages(NamedTuple):
    """Images of presses, with estimated places.

    | meaning                                                       | shape                | unit  |
    |---------------------------------------------------------------|----------------------|-------|
    | image                                                         | (presses, pixels)    | S     |
    | integral of the image over the sheet                          | (presses,)           | S m^2 |
    | estimated: positions by each named estimator of the image     | (presses, 2) each    | m     |
    | places estimated by the locator; None: without a locator      |                      |       |
    """

    image: np.ndarray
    integral: np.ndarray
    estimated: dict[str, np.ndarray]
    places: Places | None


@dataclass(frozen=True, eq=False)
class Imager:
    """Computes images and places from frames, prepared for one skin.

    | meaning                                                              |
    |----------------------------------------------------------------------|
    | recon: frames to images                                              |
    | masks: which pad carries which pixel                                 |
    | locator: estimator of places; None: no place is needed               |
    | notes: remarks for the reader of the results                         |
    """

    recon: je.Reconstructor | je.imaging.IterativeReconstructor
    masks: je.fusion.PadMasks
    locator: AbstractLocator | None = None
    notes: tuple[str, ...] = ()

    def presses(self, dv: np.ndarray) -> PressImages:
        """Images of presses (presses, readings) V, each of which holds one contact."""
        recon, one = self.recon, None if self.locator is None else self.locator.single()
        image = recon(jnp.asarray(dv, recon.dtype))
        estimated = {n: np.asarray(e(image, recon), float) for n, e in REPORTED_ESTIMATORS.items()}
        places = None
        if one is not None:
            places = locate(one, dv, recon, self.masks, image)
            estimated["fitted"] = np.asarray(places.position, float)[:, 0]
        integral = np.asarray(je.metrics.image_sum(image, self.masks.areas), float)
        return PressImages(np.asarray(image), integral, estimated, places)


def prepare_imager(skin: je.Skin, presses: PooledPresses, recipe: Recipe) -> Imager:
    """The imager of a recipe, prepared with channels, noise and untouched frames of the presses.

    Raises:
        InverseError, HyperparameterError: if no image can be made with these choices.
    """
    imaging, model = recipe.imaging, je.discretise(je.Scene(skin), recipe.fidelity)
    same = model if recipe.fidelity == PLACEMENT_FIDELITY else None
    doubt = placement_note(skin, presses.untouched, presses.channels, same)
    sigma, notes = (None, ()) if recipe.even_sheet else fit_untouched_sheet(model, presses.untouched, presses.channels)
    recon = imaging.prepare(
        model,
        quiet=presses.quiet_frames(recipe.processing) if imaging.noise.needs_frames else None,
        frames=presses.dv,
        channels=presses.channels,
        sigma=sigma,
    )
    masks = je.pad_masks(skin, recon)
    locator = recipe.locator.prepare(model, presses.noise, presses.channels, sigma) if recipe.locates else None
    return Imager(recon, masks, locator, (*filter(None, [doubt]), *notes))


def fit_untouched_sheet(
    model: je.Model, untouched: np.ndarray, channels: np.ndarray
) -> tuple[Array | None, tuple[str, ...]]:
    """Conductivity of the untouched sheet (elements,) S; or None, with a note that the sheet is taken for even."""
    try:
        return je.fit_background(model, np.where(channels, untouched, np.nan)), ()
    except je.imaging.InverseError as error:
        return None, (taken_for_even(error),)


def taken_for_even(error: je.imaging.InverseError) -> str:
    """What is said where no conductivity of the sheet fits the untouched frame."""
    return f"the sheet is taken for even, as the untouched frame shows none that fits: {error}"
