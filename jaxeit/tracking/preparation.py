"""Preparation of a tracker from a model of the skin."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float
from scipy.spatial import cKDTree

from ..contacts.bump_responses import points_of
from ..contacts.preparation import prepare_contacts
from ..contacts.settings import ContactSettings
from ..fusion import pad_masks
from ..imaging.noise import whitened_readings
from ..model.bases import Pixels
from ..model.discretisation import Model, discretise
from ..model.forward_model import conductivity
from ..model.scene import Scene
from ..model.sensitivity import pair_jacobian
from ..skin.description import Skin
from .filter import SIZE, ContactFilter
from .reanalysis import prepare_reanalysis
from .settings import TrackerSettings


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
    mixing = kept @ found.factor
    coarse = discretise(Scene(skin), settings.fidelity)
    whole = conductivity(model) if sigma is None else sigma
    fine = Pixels(settings.columns).on(model)
    response = pair_jacobian(model, whole, fine, jnp.asarray(found.electrodes), jnp.asarray(mixing)).T
    background = np.asarray(fine.restrict(whole)) / np.asarray(fine.restrict(jnp.ones_like(whole)))
    masks = pad_masks(skin, fine)
    points, weights = points_of(coarse, loads.width)
    places, of_elements, of_pixels = _gain_modes(coarse, np.asarray(fine.centres, float), loads.gain_length)
    heavy = np.dtype(settings.dtype)
    put, light = partial(jnp.asarray, dtype=model.dtype), partial(jnp.asarray, dtype=heavy)
    mean = _carried(model, whole, coarse)

    def with_level(modes: np.ndarray) -> Array:
        return put(np.concatenate([np.full((len(modes), 1), settings.level), loads.gain * modes], 1))

    return ContactFilter(
        finder=finder,
        sheet=prepare_reanalysis(coarse, put(mean), found.electrodes, mixing, heavy),
        sigma=light(mean),
        points=light(points),
        weights=light(weights),
        modes=with_level(of_elements),
        places=put(np.concatenate([np.full((1, 2), np.inf), places])),
        pixels=light(fine.centres),
        pixel_response=light(response * background[:, None]),
        pixel_modes=with_level(of_pixels),
        pad_area=put(masks.weights * masks.areas),
        law=loads.law,
        model_error=put(loads.model_error),
        persistence=put(settings.persistence),
        rates=put(_rates(settings)),
        unknowns=settings.unknowns,
        active_modes=settings.modes,
        near_pixels=settings.pixels,
    )


def _carried(model: Model, sigma: Float[Array, " elements"], other: Model) -> np.ndarray:
    """A conductivity on the elements of another mesh of the same sheet: of the nearest element."""
    near = cKDTree(np.asarray(model.centroids, float)).query(np.asarray(other.centroids, float))[1]
    found: np.ndarray = np.asarray(sigma, float)[near]
    return found


def _rates(settings: TrackerSettings) -> list[float]:
    """Random walk of each number of a contact, per root of a second; a place moves by its velocity alone."""
    rates = [1e-4, 1e-4, settings.width_rate, settings.force_rate, 1e-4, 1e-4, *2 * [settings.acceleration]]
    assert len(rates) == SIZE
    return rates


def _gain_modes(
    model: Model, pixels: Float[np.ndarray, "p 2"], length: float
) -> tuple[Float[np.ndarray, "g 2"], Float[np.ndarray, "elements g"], Float[np.ndarray, "p g"]]:
    """Where the modes of a Gaussian field of variance one lie, and their values on elements and pixels: bumps whose sum
    of products is exp(-d^2 / 2 length^2)."""
    chart = np.asarray(model.chart, float)
    corners = zip(chart.min(0), chart.max(0), strict=True)
    axes = [np.arange(low - length, high + 1.5 * length, length) for low, high in corners]
    nodes = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    values = [
        np.exp(-((at[:, None] - nodes) ** 2).sum(-1) / length**2) for at in (np.asarray(model.centroids, float), pixels)
    ]
    norm = np.sqrt(np.mean((values[0] ** 2).sum(-1)))
    return nodes, values[0] / norm, values[1] / norm
