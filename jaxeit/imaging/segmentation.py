"""Classes of an image: what conducts less than the reference, what conducts more, and the rest.

The image is the logarithm of the conductivity over that of the reference, found through the full forward map with a
penalty on edges (`gauss_newton`, `IsotropicVariation`); each region that stands out is cut at half of its own height. A
blurred edge lies at half the height, however high. Beside a piece of large contrast the image swings to the other side,
a little; such regions are left out.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, DTypeLike, Float, Int, Shaped
from scipy.ndimage import distance_transform_edt, label, map_coordinates

from .._compile import require_known
from ..messages.kinds import require_kind
from ..model.bases import AbstractBasis, AbstractPictured, BasisMap, Picture
from ..model.discretisation import Model, require_model
from ..model.forward_model import forward
from ..model.matrix.metal_sheet import containing_triangles
from ..registry import limited, require_limits
from .absolute.frames import checked_frame
from .absolute.images import (
    AbstractPenalty,
    ImagePosterior,
    LogConductivity,
    reading_weights,
)
from .absolute.one_frame import picture_basis, posterior_image, variation_of
from .inputs import InverseError
from .level_set import LevelSet, fitted_level, signed_distances

UNCHANGED, RESISTIVE, CONDUCTIVE = 0, 1, 2
"""The classes."""


class ChangeErrors(eqx.Module):
    """Errors of the changes that `segment` explains.

    | meaning                                                                                              | default |
    |------------------------------------------------------------------------------------------------------|---------|
    | relative: of a change, over itself                                                                   | 0.03    |
    | absolute: of a reading that does not change, over its size plus the root mean square of all          | 0.003   |

    The absolute error grows where the image leaves more of the frame than that. Frames that repeat better than 0.3 %
    allow a smaller one.

    Raises:
        InverseError: for a value out of range.

    Example:
        print(je.imaging.ChangeErrors(absolute=0.001))  # of frames that repeat well
    """

    relative: float = limited(0.03, above=0, static=True)
    absolute: float = limited(0.003, above=0, static=True)

    def __check_init__(self) -> None:
        require_limits(self, InverseError)


class RegionSettings(eqx.Module):
    """Regions of an image that `segment` takes for pieces.

    | meaning                                                                            | default |
    |------------------------------------------------------------------------------------|---------|
    | floor: least height of a region, absolute logarithm of conductivity                | 0.5     |
    | least: smallest region, over the area of the picture                               | 2.28e-3 |
    | weakest: sum of the image over the weakest region, over that of the strongest      | 0.18    |
    | pixels of the classes along each axis                                              | 256     |

    Raises:
        InverseError: for a value out of range.

    Example:
        print(je.imaging.RegionSettings(floor=0.2, pixels=128))  # also faint regions
    """

    floor: float = limited(0.5, above=0, static=True)
    least: float = limited(2.28e-3, above=0, static=True)
    weakest: float = limited(0.18, above=0, static=True)
    pixels: int = limited(256, least=1, static=True)

    def __check_init__(self) -> None:
        require_limits(self, InverseError)


class Segmentation(eqx.Module):
    """Classes of a frame.

    | meaning                                                                              | shape           |
    |--------------------------------------------------------------------------------------|-----------------|
    | image: logarithm of the conductivity over that of the reference                      | (basis,)        |
    | picture that the image belongs to                                                    |                 |
    | classes: 0 as the reference, 1 resistive, 2 conductive; row 0 at low y               | (rows, columns) |
    | pieces: image of one height for each class, of fitted borders; NaN: none were fitted | (basis,)        |
    | errors: standard error of each change that was believed, V                           | (readings,)     |
    | misfit: root mean square of what the pieces leave of the changes, over the errors    | ()              |
    | objective: what the fit of borders minimises; the least of several starts is best    | ()              |
    | converged: whether the fit of the image ended before its twelve steps did            | ()              |
    | borders_converged: the same of the fit of the borders; False: none were fitted       | ()              |
    """

    image: Float[Array, " basis"]
    picture: Picture
    classes: Int[np.ndarray, "rows columns"]
    pieces: Float[Array, " basis"]
    errors: Float[Array, " readings"]
    misfit: Float[Array, ""]
    objective: Float[Array, ""]
    converged: Bool[Array, ""]
    borders_converged: Bool[Array, ""]


ERRORS, REGIONS, BORDERS = ChangeErrors(), RegionSettings(), LevelSet()


def segment(
    model: Model,
    reference: Float[ArrayLike, " readings"],
    frame: Float[ArrayLike, " readings"],
    basis: AbstractBasis | BasisMap | None = None,
    *,
    penalty: AbstractPenalty | None = None,
    errors: ChangeErrors = ERRORS,
    regions: RegionSettings = REGIONS,
    borders: LevelSet | None = BORDERS,
    start: Int[ArrayLike, "rows columns"] | None = None,
    missed: Float[ArrayLike, " readings"] | None = None,
) -> Segmentation:
    """Find what changed from a reference of even content, in three classes; on the host, seconds a frame.

    The model is asked for the change only, ``forward(model) + frame - reference``, since what it misses of the
    reference it mostly misses of the frame too. The error of a reading has three parts: of its own change; of the
    reference, since frames do not repeat exactly; and of what the model misses of the reference, the part that the
    change is of the readings.

    Args:
        model: with the reference's conductivity and contacts, as `fit_reference` gives it.
        reference, frame: V; readings that are not finite in either are left out.
        basis: default `Pixels`, 30 along x.
        penalty: default `IsotropicVariation` with a weight of 0.0064 for each reading that is used.
        errors: of the changes.
        regions: which regions of the image are pieces, and the pixels of the classes.
        borders: how borders are fitted to the readings, from those of the regions; None: left as the image shows them.
        start: classes, (pixels, pixels), from whose borders that fit starts; default: those of the image's regions.
        missed: of the reference by the model, V; default: the difference.

    Raises:
        SceneError: if ``model`` is no model, such as a tank.
        InverseError: if a shape or a value is wrong.

    Example:
        from jaxeit.imaging import LevelSet, RegionSettings, segment

        dark = model.background * jnp.where(near, 0.2, 1.0)  # S: an object that hardly conducts
        quick = {"borders": LevelSet(widths=(0.5,)), "regions": RegionSettings(pixels=64)}
        found = segment(model, v0, je.forward(model, dark), je.Pixels(16), **quick)
        print(f"{(found.classes == 1).mean():.1%} of the picture is resistive")  # 2: conductive
    """
    require_model(model)
    require_known("segment", InverseError, model.background)
    seen = _seen(model, reference, frame, missed)
    require_kind(errors, ChangeErrors, InverseError, "an error of changes", "errors=ChangeErrors(...)")
    require_kind(regions, RegionSettings, InverseError, "a setting of regions", "regions=RegionSettings(...)")
    if borders is not None:
        require_kind(borders, LevelSet, InverseError, "a setting of borders", "borders=LevelSet(...), or None")
    image = picture_basis(model, basis)
    penalty = variation_of(seen.used(model.dtype)) if penalty is None else penalty
    physics = LogConductivity(model, image, model.mean_background)
    found = posterior_image(physics, penalty, seen.target, lambda growth: seen.std(errors, growth))
    grid = on_grid(found.image, image.picture, (regions.pixels, regions.pixels))
    classes = half_height_classes(grid, regions.floor, regions.least, regions.weakest)
    classes = classes if start is None else _checked_start(start, classes.shape)
    unfitted = jnp.asarray(jnp.nan, model.dtype)
    pieces, shaped = found.image * unfitted, jnp.asarray(False)
    fitted = pieces, found.errors, unfitted, unfitted, found.converged, shaped
    before = Segmentation(found.image, image.picture, classes, *fitted)
    return before if borders is None or not classes.any() else _shaped(physics, penalty, seen, before, borders)


def _checked_start(start: Int[ArrayLike, "rows columns"], shape: tuple[int, ...]) -> Int[np.ndarray, "rows columns"]:
    """Classes of a start; raises InverseError if they are none."""
    classes = np.asarray(start)
    if classes.shape != shape or not np.isin(classes, (UNCHANGED, RESISTIVE, CONDUCTIVE)).all():
        raise InverseError(f"start is no array {shape} of classes 0, 1 and 2; give one, or another number of pixels")
    return classes


class _Observation(NamedTuple):
    """Readings, each (readings,) in V: of the model, of the reference, their change, what the model misses of them."""

    even: Float[Array, " readings"]
    before: Float[Array, " readings"]
    change: Float[Array, " readings"]
    left: Float[Array, " readings"]

    @property
    def target(self) -> Float[Array, " readings"]:
        """Readings that the model is asked for."""
        return self.even + self.change

    def used(self, dtype: DTypeLike) -> Float[Array, ""]:
        """Number of readings."""
        return jnp.sum(jnp.isfinite(self.change), dtype=dtype)

    def std(self, errors: ChangeErrors, growth: float) -> Float[Array, " readings"]:
        """Standard errors of the changes, V, as `segment` describes them; ``growth`` is that of the absolute ones."""
        share = jnp.sqrt(jnp.nansum(self.change**2) / jnp.nansum(self.before**2))
        size = jnp.abs(self.before) + jnp.sqrt(jnp.nanmean(self.before**2))
        return errors.relative * jnp.abs(self.change) + growth * errors.absolute * size + share * jnp.abs(self.left)


def _seen(
    model: Model,
    reference: Float[ArrayLike, " readings"],
    frame: Float[ArrayLike, " readings"],
    missed: Float[ArrayLike, " readings"] | None,
) -> _Observation:
    """The readings of both frames; raises InverseError for what is no frame of the model."""
    even = forward(model)
    before, after = (checked_frame(*one, even) for one in (("reference", reference), ("frame", frame)))
    return _Observation(
        even, before, after - before, before - even if missed is None else jnp.asarray(missed, model.dtype)
    )


def _shaped(
    physics: LogConductivity,
    penalty: AbstractPenalty,
    seen: _Observation,
    before: Segmentation,
    borders: LevelSet,
) -> Segmentation:
    """Classes whose borders explain the readings, from the classes before."""
    start = signed_distances(before.classes, before.picture)
    weight, readings = reading_weights(seen.target, before.errors)
    posterior = ImagePosterior(physics, penalty, readings, weight)
    fit = fitted_level(posterior, start, seen.used(physics.model.dtype), borders)
    inside = on_grid(fit.level, before.picture, before.classes.shape) > 0
    classes = np.where(inside, start.owner + 1, UNCHANGED)
    told = replace(before, misfit=fit.misfit, objective=fit.objective, borders_converged=fit.converged)
    return replace(told, classes=classes, pieces=fit.pieces)


def on_grid(
    image: Shaped[ArrayLike, " n"],
    where: AbstractPictured | Picture | Model,
    shape: tuple[int, int],
    extent: tuple[float, float, float, float] | None = None,
) -> Float[np.ndarray, "rows columns"]:
    """An image on any grid: pixels by bilinear interpolation, elements of a model by the one at each point.

    Points beside the sheet have the value of the nearest pixel or element.

    Args:
        image: one number for each pixel of a picture, (basis,), or for each element of a model, (elements,).
        where: the picture, the reconstructor or the model that the image belongs to.
        shape: rows and columns of the grid; row 0 at low y.
        extent: of the grid, x0, x1, y0, y1 in m; default: that of the picture or the model.

    Raises:
        InverseError: if the image does not fit, or the picture has no grid.

    Example:
        sheet = je.imaging.on_grid(model.background, model, (32, 32))  # S
        corner = je.imaging.on_grid(image, recon.picture, (20, 20), extent=(0, 0.1, 0, 0.1))
    """
    values = np.asarray(image, float)
    if values.shape != (len(where.areas),):
        raise InverseError(f"the image has shape {values.shape}; {type(where).__name__} has {len(where.areas)} values")
    bounds = _extent(where)
    x0, x1, y0, y1 = bounds if extent is None else extent
    x, y = (a + (np.arange(n) + 0.5) / n * (b - a) for a, b, n in ((x0, x1, shape[1]), (y0, y1, shape[0])))
    if isinstance(where, Model):
        element, _ = containing_triangles(where.mesh, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
        by_element: np.ndarray = values[element].reshape(shape)
        return by_element
    inside = (np.asarray(where.areas) > 0).reshape(where.shape)
    nearest = distance_transform_edt(~inside, return_distances=False, return_indices=True)
    (rows, columns), (left, right, low, high) = where.shape, bounds
    places = (y - low) / (high - low) * rows - 0.5, (x - left) / (right - left) * columns - 0.5
    grid = np.meshgrid(*places, indexing="ij")
    found: np.ndarray = map_coordinates(values.reshape(where.shape)[tuple(nearest)], grid, order=1, mode="nearest")
    return found


def _extent(where: AbstractPictured | Picture | Model) -> tuple[float, ...]:
    """x0, x1, y0, y1 of a picture or a model, m; raises InverseError for a picture without a grid."""
    if isinstance(where, Model):
        low, high = (np.asarray(end(where.chart, 0)) for end in (jnp.min, jnp.max))
        return float(low[0]), float(high[0]), float(low[1]), float(high[1])
    if len(where.shape) != 2:
        raise InverseError("the basis is no picture; give the model in place of it, for a value per element")
    return tuple(float(end) for end in where.extent)


def half_height_classes(
    image: Float[np.ndarray, "rows columns"], floor: float, least: float, weakest: float = 0.0
) -> Int[np.ndarray, "rows columns"]:
    """Classes of an image that is zero where nothing changed: regions beyond ``floor``, each cut at half its own peak.

    Args:
        image: change, in any unit; row 0 at low y.
        floor: least absolute value of a pixel of a region, in the unit of the image.
        least: smallest region, over the area of the picture.
        weakest: sum of the image over the weakest region, over that of the strongest.

    Returns:
        0 unchanged, 1 below zero, 2 above zero, (rows, columns).

    Example:
        picture = je.imaging.on_grid(image, recon.picture, (64, 64))  # S, on a grid of its own
        # 0, 1 or 2
        classes = je.imaging.half_height_classes(picture, floor=0.2 * picture.max(), least=0.002)
    """
    classes, regions = np.full(image.shape, UNCHANGED), []
    for sign, kind in ((-1, RESISTIVE), (1, CONDUCTIVE)):
        labels, count = label(sign * image > floor)
        several = (labels == number for number in range(1, count + 1))
        regions += [(sign * image, kind, region) for region in several if region.mean() >= least]
    sums = [float(np.sum(height[region])) for height, _, region in regions]
    for (height, kind, region), total in zip(regions, sums, strict=True):
        if total >= weakest * max(sums):
            classes[region & (height > max(floor, 0.5 * float(np.max(height[region]))))] = kind
    return classes
