"""Preparation of a tracker from a model of the skin."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import require_known
from ..fusion import pad_masks
from ..imaging.noise import InverseError, whitened_readings
from ..model.bases import Pixels
from ..model.discretisation import Model
from ..model.forward_model import conductivity
from ..skin.description import Skin
from ..contacts.bump_responses import points_of
from ..contacts.preparation import prepare_contacts
from ..contacts.settings import ContactSettings
from .filter import SIZE, ContactFilter
from .reanalysis import prepare_reanalysis
from .settings import TrackerSettings

# Pixels along x from which the force on a pad is summed.
PAD_PIXELS = 40


def prepare_filter(
    model: Model,
    skin: Skin,
    settings: TrackerSettings,
    noise: Float[ArrayLike, "..."],
    sigma: Float[Array, " elements"] | None,
    channels: Bool[ArrayLike, " readings"] | None,
) -> ContactFilter:
    """The filter of a skin; see `prepare_tracker`."""
    loads = settings.loads
    found = whitened_readings(model, noise, channels)
    finder = prepare_contacts(model, ContactSettings(most=1), noise=noise, sigma=sigma, channels=channels)
    # E C^T = 1, so that the directions which the finder kept are its rows times C^T.
    kept = np.asarray(finder.compress, float) @ found.factor.T
    sheet = conductivity(model) if sigma is None else sigma
    points, weights = points_of(model, loads.width)
    chart = np.asarray(model.chart, float)
    places, modes = _gain_modes(np.asarray(model.centroids, float), chart.min(0), chart.max(0), loads.gain_length)
    pixels = Pixels(PAD_PIXELS).on(model)
    masks = pad_masks(skin, pixels)
    put = partial(jnp.asarray, dtype=model.dtype)
    return ContactFilter(
        finder=finder,
        sheet=prepare_reanalysis(model, sheet, found.electrodes, kept @ found.factor, model.dtype),
        sigma=put(sheet),
        centroids=put(model.centroids),
        points=put(points),
        weights=put(weights),
        modes=put(np.concatenate([np.full((len(modes), 1), settings.level), loads.gain * modes], 1)),
        places=put(np.concatenate([np.full((1, 2), np.inf), places])),
        pixels=pixels.centres,
        pad_area=masks.weights * masks.areas,
        law=loads.law,
        model_error=put(loads.model_error),
        persistence=put(settings.persistence),
        rates=put(_rates(settings)),
        unknowns=settings.unknowns,
        active_modes=settings.modes,
        near_elements=4 * settings.unknowns,
    )


def _rates(settings: TrackerSettings) -> list[float]:
    """Random walk of each number of a contact, per root of a second; a place moves by its velocity alone."""
    rates = [1e-4, 1e-4, settings.width_rate, settings.force_rate, 1e-4, 1e-4, *2 * [settings.acceleration]]
    assert len(rates) == SIZE
    return rates


def _gain_modes(
    points: Float[np.ndarray, "n 2"], low: np.ndarray, high: np.ndarray, length: float
) -> tuple[Float[np.ndarray, "g 2"], Float[np.ndarray, "n g"]]:
    """Where the modes of a Gaussian field of variance one lie, and their values at points: bumps whose sum of products
    is exp(-d^2 / 2 length^2)."""
    axes = [np.arange(a - length, b + 1.5 * length, length) for a, b in zip(low, high, strict=True)]
    nodes = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    modes = np.exp(-((points[:, None] - nodes) ** 2).sum(-1) / length**2)
    return nodes, np.asarray(modes / np.sqrt(np.mean((modes**2).sum(-1))))
