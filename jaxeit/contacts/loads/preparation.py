"""Preparing the fit of loads: everything that does not depend on the frame."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float
from scipy.spatial import cKDTree

from ..._compile import full_precision, verb
from ...imaging.inputs import InverseError
from ...messages.kinds import require_kind
from ...model.discretisation import Model
from ...model.forward_model import transfer
from ...model.gaussian_field import field_modes
from ...model.sheet_conductivity import coefficients, conductivity
from ..bump_responses import mean_conductivity, quadrature_points
from ..preparation import MIN_SIGNAL, require_signal, sheet_and_readings
from .belief import LoadBelief
from .fitter import LoadFitter
from .pressure import LOAD_PARAMETERS, MAX_LOADS, LoadForm
from .settings import LoadSettings
from .sheet import AbstractGain, KnownGain, PressedSheet
from .spreading import Spreading
from .starts import Starts

# Number of elements whose changes count, over that of those within so many widths of the middle of a usual load. Half
# of them miss most changes by strong and wide loads, on whose slopes a fit then ends far from the minimum.
ELEMENT_FACTOR, REACH_WIDTHS = 4, 2.5


@full_precision
def prepare_loads(
    model: Model,
    settings: LoadSettings | None = None,
    *,
    noise: Float[ArrayLike, "..."],
    untouched: Float[ArrayLike, " readings"] | None = None,
    sigma: Float[Array, " elements"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
    gain: AbstractGain | None = None,
) -> LoadFitter:
    """Prepare the fit of loads to frames of a skin, for use offline.

    Args:
        model: of edges not above 0.05 of the sheet; a draft moves a load by 0.15 mm, which is in no covariance.
        settings: default `LoadSettings()`.
        noise, untouched, sigma, channels: as for `prepare_contacts`.
        gain: of the contact layer, as it was learned (`tracking.LearnedLayer`), in place of that of the settings;
            default: not known.

    Raises:
        InverseError: as for `prepare_contacts`.
    """
    settings = LoadSettings() if settings is None else settings
    require_kind(settings, LoadSettings, InverseError, "settings of loads", "LoadSettings(...)", "prepare_loads")
    sigma, found = sheet_and_readings("prepare_loads", model, noise, untouched, sigma, channels)
    put = partial(jnp.asarray, dtype=model.dtype)
    known = sigma is not None
    sigma = conductivity(model) if sigma is None else put(sigma)
    chart = np.asarray(model.chart, float)
    low, high = chart.min(0), chart.max(0)
    sheet = _sheet(model, settings, sigma, settings.coat_spread(known), put(found.factor), found.electrodes, gain)
    starts = _starts(sheet, settings, low, high, mean_conductivity(model, np.asarray(sigma, float)))
    require_signal(bool((np.linalg.norm(starts.atoms, axis=1) > MIN_SIGNAL).any()))
    return LoadFitter(
        belief=_belief(sheet, settings, low, high),
        whitening=found.whitening,
        compress=put(found.compress),
        starts=starts,
    )


def _belief(sheet: PressedSheet, settings: LoadSettings, low: np.ndarray, high: np.ndarray) -> LoadBelief:
    """The prior of loads by their settings, on a sheet between two corners."""
    put = partial(jnp.asarray, dtype=sheet.sigma.dtype)
    return LoadBelief(
        sheet=sheet,
        low=put(low),
        high=put(high),
        prior_mean=put(np.log([settings.width, settings.force])),
        prior_std=put([settings.width_spread, settings.force_spread]),
        difference_std=put([settings.width_difference, settings.force_difference]),
        min_separation=put([settings.nearest, settings.shortest]),
        length_std=put(settings.length),
        kind_probabilities=put(settings.prior),
        model_error=put(settings.model_error),
        shapes=put(settings.shapes),
        force_logs=put(settings.forces.logs),
        force_covariance=put(settings.forces.covariance),
        force_variance=put(settings.forces.variance),
    )


def _sheet(
    model: Model,
    settings: LoadSettings,
    sigma: Float[Array, " elements"],
    coat: float,
    factor: Float[Array, "r k"],
    electrodes: np.ndarray,
    known: AbstractGain | None,
) -> PressedSheet:
    """The sheet under loads, with the modes of all that is not known of it."""
    put = partial(jnp.asarray, dtype=model.dtype)
    points, weights = quadrature_points(model, settings.width)
    centroids = np.einsum("q,eqd->ed", weights, points)
    gain, known_gain = settings.gain * field_modes(centroids, settings.gain_length), None
    if known is not None:
        mean, gain, covariance = known.distribution(centroids)
        known_gain = KnownGain(put(np.exp(mean)), put(covariance))
    modes = _scaled_modes(centroids, coat, settings.coat_length)
    sheet = PressedSheet(
        model=model,
        sigma=sigma,
        factor=factor,
        pairs=jnp.asarray(electrodes),
        untouched=jnp.zeros(len(factor), model.dtype),
        points=put(points),
        weights=put(weights),
        gain=put(gain),
        texture=texture_modes(points, weights, settings, model.dtype),
        coat=put(modes),
        untouched_coat_slopes=put(np.zeros((len(factor), modes.shape[1]))),
        shape=put(settings.shape),
        law=settings.law,
        spreading=Spreading.at_depth(settings.depth or 0.0, model.dtype),
        element_count=min(len(centroids), ELEMENT_FACTOR * _max_count_within(centroids, REACH_WIDTHS * settings.width)),
        known_gain=known_gain,
    )
    return _with_untouched(sheet)


def texture_modes(
    points: Float[ArrayLike, "elements q 2"], weights: Float[ArrayLike, " q"], settings: LoadSettings, dtype: DTypeLike
) -> Float[Array, "elements t"]:
    """Modes of the texture of the gain on elements of these points and weights; none where there is no texture."""
    centroids = np.einsum("q,eqd->ed", np.asarray(weights, float), np.asarray(points, float))
    return jnp.asarray(_scaled_modes(centroids, settings.texture, settings.texture_length), dtype)


def _scaled_modes(points: Float[np.ndarray, "n 2"], spread: float, length: float) -> Float[np.ndarray, "n g"]:
    """Modes of a Gaussian field of a standard deviation at points; none for zero."""
    return spread * field_modes(points, length) if spread else np.zeros((len(points), 0))


@verb
def _with_untouched(sheet: PressedSheet) -> PressedSheet:
    """The sheet with its readings without loads, and their slopes."""
    z = transfer(sheet.model, coefficients(sheet.model, sheet.sigma))
    known = sheet.whiten(z), sheet.coat_slopes(sheet.sigma)
    ready: PressedSheet = eqx.tree_at(lambda s: (s.untouched, s.untouched_coat_slopes), sheet, known)
    return ready


def _starts(
    sheet: PressedSheet, settings: LoadSettings, low: np.ndarray, high: np.ndarray, background: float
) -> Starts:
    """Readings of usual loads a usual width and a half apart."""
    counts = np.maximum(np.round((high - low) / (1.5 * settings.width)).astype(int), 1)
    axes = [a + (b - a) * (np.arange(n) + 0.5) / n for a, b, n in zip(low, high, counts, strict=True)]
    places = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    usual = np.broadcast_to(np.log([settings.width, settings.force]), places.shape)
    rows = jnp.asarray(np.concatenate([places, usual], 1), sheet.sigma.dtype)
    return Starts(_atoms(sheet, rows), rows, jnp.asarray(background, sheet.sigma.dtype), settings.law)


@verb
def _atoms(sheet: PressedSheet, rows: Float[Array, "b 4"]) -> Float[Array, "b r"]:
    forms = jnp.array([LoadForm.ROUND] + [LoadForm.ABSENT] * (MAX_LOADS - 1))
    respond = lambda one: sheet.response(jnp.tile(jnp.pad(one, (0, LOAD_PARAMETERS - 4)), (MAX_LOADS, 1)), forms)  # noqa: E731
    found: Array = jax.lax.map(respond, rows)
    return found


def _max_count_within(centroids: Float[np.ndarray, "elements 2"], radius: float) -> int:
    """Largest number of elements within a circle around one of them."""
    return int(cKDTree(centroids).query_ball_point(centroids, radius, return_length=True).max())
