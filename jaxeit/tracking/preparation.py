"""Preparation of a tracker from a model of the skin."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float
from scipy.spatial import cKDTree

from .._compile import full_precision, verb
from ..contacts.bump_responses import quadrature_points
from ..contacts.loads.spreading import Spreading
from ..contacts.preparation import prepare_contacts
from ..contacts.settings import ContactSettings
from ..fusion import pad_masks
from ..imaging.absolute.background import UntouchedSheet
from ..imaging.readings.whitening import whitened_readings
from ..linalg.base import on_device
from ..model.bases import Pixels
from ..model.discretisation import Model, discretise
from ..model.gaussian_field import field_modes
from ..model.scene import Scene
from ..model.sensitivity import pair_jacobian
from ..model.sheet_conductivity import conductivity
from ..skin.description import Skin
from .belief.apparent_gain import apparent_gain
from .belief.contact_filter import ContactFilter
from .belief.layer import GainField
from .belief.reanalysis import prepare_reanalysis
from .belief.response import LoadedSheet, NeighbourTable, edge_half_lengths
from .belief.state import CONTACT_SIZE, POSITION_STD
from .settings import TrackerSettings

# Cells of the grid of neighbours, along the longer side.
GRID_CELLS = 20
# Number of modes, unknowns and pixels in the fit of a single press, over that in a frame of the filter. Such a fit may
# end a centimetre from its start, and is not repeated there: what it left out it would take for gain.
PRESS_REACH_RATIO = 2.5
# Apparent log gain by the error of a mesh at a place, over the model error: a contact's signal errs by about as much,
# and its place and width explain a part of that and add to the rest.
MESH_ERROR_RATIO = 2.0
# Share of the variance of an unknown coat that its modes hold.
COAT_VARIANCE_SHARE = 0.99
# Number of usual loads along each side of the sheet, at which the error by an unknown coat is computed.
COAT_GRID = 5
# Square of a half length, m^2, below which a load is round.
MIN_SQUARED_LENGTH = 1e-12
# Pixels of the first order per usual width of a load; limits of their number along x.
PIXELS_PER_WIDTH, COLUMN_LIMITS = 3, (12, 150)


@full_precision
def prepare_filter(
    model: Model,
    skin: Skin,
    settings: TrackerSettings,
    noise: Float[ArrayLike, "..."],
    untouched: UntouchedSheet | None,
    channels: Bool[ArrayLike, " readings"] | None,
) -> tuple[ContactFilter, ContactFilter, GainField]:
    """The filter of a skin, that of single presses, and the gain before any contact; see `prepare_tracker`."""
    loads, sigma = settings.loads, None if untouched is None else untouched.sigma
    found = whitened_readings(model, noise, channels)
    finder = prepare_contacts(model, ContactSettings(most=1), noise=noise, sigma=sigma, channels=channels)
    # E C^T = 1, so that the directions which the finder kept are its rows times C^T.
    kept = np.asarray(finder.compress, float) @ found.factor.T
    put = partial(on_device, dtype=model.dtype)
    whole = conductivity(model) if sigma is None else sigma
    coat = loads.coat_spread(sigma is not None)
    field, sheet, around = _loaded_sheet(model, skin, settings, whole, coat, found.electrodes, kept @ found.factor)
    unit = put(np.eye(len(finder.whitening.channels)))
    far = _press_settings(settings)
    tracker = ContactFilter(
        finder=finder,
        compress=finder.whitening.sums(unit).dot(finder.compress.T).T,
        sheet=sheet,
        places=put(field.places),
        model_error=put(loads.model_error),
        coat_error=put(_coat_error(sheet, settings) if coat else 0),
        persistence=put(settings.persistence),
        rates=put(_rates(settings)),
        gain_rate=put(settings.gain_rate / settings.level),
        tail=put(settings.tail),
        shape=put(loads.shape),
        spread=put([POSITION_STD, POSITION_STD, loads.width_spread, loads.force_spread]),
        active_modes=settings.modes,
    )
    with_errors = sheet if untouched is None else with_sheet_errors(sheet, model, untouched.errors)
    by_sheet = apparent_gain(tracker, with_errors, np.log([loads.width, loads.force]), loads.gain_length)
    field = replace(field, sheet_error=by_sheet, mesh_error=MESH_ERROR_RATIO * loads.model_error)
    return tracker, replace(tracker, sheet=replace(sheet, neighbours=around), active_modes=far.modes), field


def _loaded_sheet(
    model: Model,
    skin: Skin,
    settings: TrackerSettings,
    sigma: Float[Array, " elements"],
    coat: float,
    pairs: np.ndarray,
    mixing: np.ndarray,
) -> tuple[GainField, LoadedSheet, NeighbourTable]:
    """The gain before any contact, the measurement model, and the neighbours of single presses."""
    loads, light = settings.loads, partial(on_device, dtype=np.dtype(settings.dtype))
    coarse, fine = discretise(Scene(skin), settings.fidelity), Pixels(_column_count(model, settings)).on(model)
    response = pair_jacobian(model, sigma, fine, jnp.asarray(pairs), jnp.asarray(mixing)).T
    total, covered = (np.asarray(fine.restrict(values)) for values in (sigma, jnp.ones_like(sigma)))
    background = np.divide(total, covered, out=np.zeros_like(total), where=covered > 0)  # 0 beside the sheet
    mean, masks, (points, weights) = (
        _nearest_values(model, sigma, np.asarray(coarse.centroids, float)),
        pad_masks(skin, fine),
        quadrature_points(coarse, loads.width),
    )
    centres = np.asarray(fine.centres, float)
    chart, middles = np.asarray(coarse.chart, float), np.asarray(coarse.centroids, float)
    field = GainField.on_sheet(np.stack([chart.min(0), chart.max(0)]), middles, loads, settings.level)
    reanalysis = prepare_reanalysis(coarse, jnp.asarray(mean, coarse.dtype), pairs, mixing, light(0).dtype)
    of_coat = light(_coat_modes(coarse, coat, loads.coat_length))
    sheet = LoadedSheet(
        sheet=reanalysis,
        neighbours=_neighbour_table(coarse, centres, settings, edge_half_lengths()),
        sigma=light(mean),
        points=light(points),
        weights=light(weights),
        modes=light(field.modes_at(middles)),
        pixels=light(centres),
        pixel_response=light(response * background[:, None]),
        pixel_modes=light(field.modes_at(centres)),
        pad_area=light((masks.weights * masks.areas).T),
        coat=of_coat,
        untouched_slopes=reanalysis.slopes_along(light(mean) * of_coat.T, reanalysis.potential),
        law=loads.law,
        spreading=Spreading.at_depth(loads.depth or 0.0, settings.dtype),
    )
    return (
        field,
        sheet,
        _neighbour_table(coarse, centres, _press_settings(settings), edge_half_lengths()[:1]),
    )  # a press is round


def _press_settings(settings: TrackerSettings) -> TrackerSettings:
    """Settings of the fit of a single press."""
    modes, unknowns, pixels = (
        int(PRESS_REACH_RATIO * count) for count in (settings.modes, settings.unknowns, settings.pixels)
    )
    return replace(settings, modes=modes, unknowns=unknowns, pixels=pixels)


def _column_count(model: Model, settings: TrackerSettings) -> int:
    """Pixels along x of the first order. They follow the width of a load, not the sheet: the pixels around a contact
    reach as far on a small skin as on a large one."""
    if settings.columns is not None:
        return settings.columns
    length = float(np.ptp(np.asarray(model.chart, float)[:, 0]))
    return int(np.clip(np.ceil(length * PIXELS_PER_WIDTH / settings.loads.width), *COLUMN_LIMITS))


def _coat_error(sheet: LoadedSheet, settings: TrackerSettings) -> float:
    """Part of a contact's signal by which an unknown coat makes it err, root mean square of usual loads all over the
    sheet.

    The filter takes it for an error of the model, like noise: it then holds to what is known of widths and of the gain
    where it would otherwise explain the coat by them. What contacts err by even so is a consider covariance.
    """
    pixels = np.asarray(sheet.pixels)
    low, high = pixels.min(0), pixels.max(0)
    along = (np.arange(COAT_GRID) + 0.5) / COAT_GRID
    places = np.stack(np.meshgrid(*(low + (high - low) * along[:, None]).T), -1).reshape(-1, 2)
    usual = np.log([settings.loads.width, settings.loads.force])
    shares = _squared_coat_errors(sheet, *(on_device(values, pixels.dtype) for values in (places, usual)))
    return float(np.sqrt(np.mean(shares)))


@verb
def _squared_coat_errors(
    sheet: LoadedSheet, places: Float[Array, "n 2"], usual: Float[Array, "2"]
) -> Float[Array, " n"]:
    """Square of that part, of a load of a usual log width and force at each place."""
    gain = jnp.zeros(sheet.modes.shape[1], places.dtype)

    def share(place: Float[Array, "2"]) -> Float[Array, ""]:
        contact = jnp.concatenate([place, usual, jnp.zeros_like(place)])[None]
        near = sheet.neighbourhood(contact)
        seen = sheet.predict_measurement(contact, gain, jnp.zeros(0, jnp.int32), near).readings
        return jnp.sum(sheet.coat_slopes(contact, gain, near) ** 2) / (seen @ seen)

    found: Array = jax.lax.map(share, places)
    return found


def _coat_modes(model: Model, spread: float, length: float) -> Float[np.ndarray, "elements c"]:
    """Modes of the log conductivity that is not known, of standard deviation ``spread``, on elements; none for zero.

    They are the principal components of the field (Karhunen and Loeve), as many as hold `COAT_VARIANCE_SHARE` of it.
    """
    areas = np.sqrt(np.asarray(model.areas, float))
    if not spread:
        return np.zeros((len(areas), 0))
    modes = field_modes(np.asarray(model.centroids, float), length)
    left, values, _ = np.linalg.svd(areas[:, None] * modes, full_matrices=False)
    share = np.cumsum(values**2) / np.sum(values**2)
    count = 1 + int(np.searchsorted(share, COAT_VARIANCE_SHARE))
    found: np.ndarray = spread * (left * values)[:, :count] / areas[:, None]
    return found


def _neighbour_table(
    model: Model, pixels: Float[np.ndarray, "p 2"], settings: TrackerSettings, halves: Float[np.ndarray, "edges 2"]
) -> NeighbourTable:
    """The table of elements, unknowns and pixels nearest to loads of these half lengths."""
    chart = np.asarray(model.chart, float)
    low, high = chart.min(0), chart.max(0)
    pitch = float((high - low).max() / GRID_CELLS)
    shape = tuple(int(n) for n in np.ceil((high - low)[::-1] / pitch).astype(int))
    y, x = np.meshgrid(*(pitch * (np.arange(n) + 0.5) for n in shape), indexing="ij")
    cells = low + np.stack([x.ravel(), y.ravel()], 1)
    middles, unknowns = chart[np.asarray(model.triangles)].mean(1), _unknown_positions(model)

    def nearest(places: np.ndarray, count: int) -> Array:
        squares = squared_line_distances(cells, places, halves)
        count = min(count, len(places))
        return on_device(np.argpartition(squares, count - 1, -1)[..., :count], np.int32)

    return NeighbourTable(
        low=on_device(low, settings.dtype),
        pitch=on_device(pitch, settings.dtype),
        elements=nearest(middles, 2 * settings.unknowns),
        unknowns=nearest(unknowns, settings.unknowns),
        pixels=nearest(pixels, settings.pixels),
        shape=(shape[0], shape[1]),
    )


def squared_line_distances(
    middles: Float[np.ndarray, "n 2"], places: Float[np.ndarray, "p 2"], halves: Float[np.ndarray, "edges 2"]
) -> Float[np.ndarray, "edges n p"]:
    """Squared distances, m^2, of places from straight lines of each half length around each middle."""
    x, y = (places - middles[:, None]).astype(np.float32).transpose(2, 0, 1)
    squares = np.empty((len(halves), *x.shape), np.float32)
    for (a, b), square in zip(halves.astype(np.float32), squares, strict=True):
        along = np.clip((a * x + b * y) / max(a * a + b * b, np.float32(MIN_SQUARED_LENGTH)), -1, 1)
        square[:] = (x - a * along) ** 2 + (y - b * along) ** 2
    return squares


def _unknown_positions(model: Model) -> Float[np.ndarray, "n 2"]:
    """Approximate position of each unknown: the mean middle of its elements."""
    dofs = np.asarray(model.system.dofs)
    middles = np.asarray(model.chart, float)[np.asarray(model.triangles)].mean(1)
    count = np.maximum(np.bincount(dofs.ravel(), minlength=model.system.unknowns), 1)
    sums = [np.bincount(dofs.ravel(), np.repeat(axis, dofs.shape[1]), len(count)) for axis in middles.T]
    return np.stack(sums, 1) / count[:, None]


def with_sheet_errors(sheet: LoadedSheet, model: Model, errors: Float[np.ndarray, "elements c"]) -> LoadedSheet:
    """The sheet with modes of its error, which are those on the elements of the model, in place of a coat's."""
    coat = on_device(_nearest_values(model, errors, np.asarray(sheet.points, float).mean(1)), sheet.sigma.dtype)
    untouched_slopes = sheet.sheet.slopes_along(sheet.sigma * coat.T, sheet.sheet.potential)
    return replace(sheet, coat=coat, untouched_slopes=untouched_slopes)


def _nearest_values(
    model: Model, values: Float[ArrayLike, "elements ..."], places: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n ..."]:
    """Values at places, each that of the nearest element."""
    near = cKDTree(np.asarray(model.centroids, float)).query(places)[1]
    found: np.ndarray = np.asarray(values, float)[near]
    return found


def _rates(settings: TrackerSettings) -> list[float]:
    """Random walk of each number of a contact, per root of a second; a place moves by its velocity alone."""
    rates = [1e-4, 1e-4, settings.width_rate, settings.force_rate, 1e-4, 1e-4, *2 * [settings.acceleration]]
    assert len(rates) == CONTACT_SIZE
    return rates
