"""Figures of merit: the position of a contact in an image, the fidelity of the image, the evenness of sensitivity.

Example:
    import jax
    import jax.numpy as jnp

    import jaxeit as je

    jax.config.update("jax_enable_x64", True)

    model = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft())
    recon = je.prepare(model, basis=je.Pixels(20))
    places = jnp.array([[0.06, 0.13], [0.1, 0.1], [0.15, 0.05]])  # m
    bumps = jnp.exp(-jnp.sum((model.centroids - places[:, None]) ** 2, -1) / (2 * 0.008**2))
    touched = jax.vmap(lambda bump: je.forward(model, model.background * (1 + 0.5 * bump)))(bumps)
    images = recon(touched - je.forward(model))  # S, one for each place
    image = images[0]

    for name in ("peak", "half", "quarter", "positive", "level-centroid:level=0.4"):
        estimator = je.metrics.ESTIMATORS.make(name)  # "half" is LevelCentroid(0.5)
        errors = je.localisation_error(estimator(images, recon), places)
        print(f"{name}: {1e3 * errors.mean():.1f} mm")
    figures = je.metrics.greit_figures(images, recon, places, [0.1, 0.1])
    print(figures.resolution, figures.ringing)  # 1
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol, TypeAlias, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Integer, Real, Shaped

from ._compile import full_precision, is_traced, verb
from .linalg.array_libraries import real_array
from .messages.kinds import shown, stated
from .registry import AbstractChoice, Registry, limited

__all__ = [
    "ESTIMATORS",
    "AbstractEstimator",
    "GreitFigures",
    "LevelCentroid",
    "MetricError",
    "Peak",
    "Pictured",
    "PositiveCentroid",
    "coefficient_of_variation",
    "greit_figures",
    "image_correlation",
    "image_sum",
    "inward_bias",
    "ktc_score",
    "localisation_error",
    "otsu_thresholds",
    "structural_similarity",
]


Places: TypeAlias = Float[ArrayLike, "... 2"] | Sequence[float]
"""Positions on the flat sheet, m; a single position may be a list or tuple."""


class MetricError(ValueError):
    """Images that cannot be compared, or a setting out of range."""


@runtime_checkable
class Pictured(Protocol):
    """An object that states the places of the pixels of an image: a reconstructor, a basis map or a picture.

    | meaning                                              | shape       | unit |
    |------------------------------------------------------|-------------|------|
    | centres in the sheet's flat coordinates              | (pixels, 2) | m    |
    | areas on the sheet; zero for a pixel that misses it  | (pixels,)   | m^2  |
    | shape: (rows, columns) of a picture                  |             |      |
    """

    @property
    def centres(self) -> Float[Array, "pixels 2"]:
        """Centres of the pixels in the sheet's flat coordinates, (pixels, 2) m."""

    @property
    def areas(self) -> Float[Array, " pixels"]:
        """Areas of the pixels on the sheet, (pixels,) m^2; zero for a pixel that misses it."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the picture."""


class AbstractEstimator(AbstractChoice):
    """An estimator of the contact's position from an image.

    A class of your own is named by its import path, as in ``--locator image-centroid:estimator=my_module:MyEstimator``.
    """

    @abstractmethod
    def __call__(self, image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... 2"]:
        """Position, (..., 2) m; NaN where the image is nowhere positive."""


class Peak(AbstractEstimator):
    """The pixel with the largest value."""

    def __call__(self, image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... 2"]:
        return _peak(_on_pixels(image, recon), recon.centres)


class LevelCentroid(AbstractEstimator):
    """The unweighted centroid of the pixels at or above ``level`` of the largest value.

    Level 0.25 is the set q of the GREIT figures of merit (Adler et al. 2009); 0.5 is the half
    maximum.
    """

    level: float = limited(0.25, above=0, most=1)

    def __call__(self, image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... 2"]:
        image = _on_pixels(image, recon)
        return _level_centroid(image, recon.centres, recon.areas, jnp.asarray(self.level, image.dtype))


class PositiveCentroid(AbstractEstimator):
    """The centroid of the positive part, weighted by its value.

    Example:
        print(je.metrics.PositiveCentroid()(images, recon))  # m
    """

    def __call__(self, image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... 2"]:
        return _positive_centroid(_on_pixels(image, recon), recon.centres, recon.areas)


def _on_pixels(image: Float[ArrayLike, "... pixels"], recon: Pictured) -> Float[Array, "... pixels"]:
    """The image, (..., pixels); MetricError unless it is one of the pixels of ``recon``."""
    if not hasattr(recon, "centres"):
        raise MetricError(f"{stated(recon)} has no pixels; give a reconstructor, or Pixels(20).on(model)")
    image, pixels = real_array("image", image, MetricError), len(recon.centres)
    if image.shape[-1:] != (pixels,):
        raise MetricError(f"image of shape {image.shape}; give (..., {pixels}), one number for each pixel of recon")
    return image


@verb
def _peak(image: Float[Array, "... pixels"], centres: Float[Array, "pixels 2"]) -> Float[Array, "... 2"]:
    return jnp.where(jnp.max(image, -1, keepdims=True) > 0, centres[jnp.argmax(image, -1)], jnp.nan)


@verb
def _level_centroid(
    image: Float[Array, "... pixels"],
    centres: Float[Array, "pixels 2"],
    areas: Float[Array, " pixels"],
    level: Float[Array, ""],
) -> Float[Array, "... 2"]:
    top = jnp.max(image, -1, keepdims=True)
    return _centroid(jnp.where((image >= level * top) & (top > 0), areas, 0), centres)


@verb
def _positive_centroid(
    image: Float[Array, "... pixels"], centres: Float[Array, "pixels 2"], areas: Float[Array, " pixels"]
) -> Float[Array, "... 2"]:
    return _centroid(jnp.maximum(image, 0) * areas, centres)


def _centroid(weight: Float[Array, "... pixels"], centres: Float[Array, "pixels 2"]) -> Float[Array, "... 2"]:
    total = weight.sum(-1, keepdims=True)
    return jnp.where(total > 0, weight @ centres / jnp.where(total > 0, total, 1), jnp.nan)


ESTIMATORS = Registry(
    AbstractEstimator,
    "estimator",
    "jaxeit.estimators",
    words={"half": "level-centroid:level=0.5", "quarter": "level-centroid:level=0.25", "positive": "positive-centroid"},
)
"""Estimators by the names that recipes and the command line use; "half" and "quarter" are levels of `LevelCentroid`."""


def localisation_error(estimated: Places, true: Places) -> Float[Array, "..."]:
    """Distance between estimated and true positions, (..., 2) m each; (...) m, with a gradient of zero at zero.

    Raises:
        MetricError: if the positions are not pairs, or as many of them as fit each other.
    """
    found, wanted = (real_array("positions", each, MetricError) for each in (estimated, true))
    try:
        np.broadcast_shapes(found.shape, wanted.shape)
        pairs = found.shape[-1:] == wanted.shape[-1:] == (2,)
    except ValueError:
        pairs = False
    if not pairs:
        raise MetricError(
            f"positions of shapes {found.shape} and {wanted.shape}; give (..., 2) m, as many true as estimated ones"
        )
    return _length(found - wanted)


@verb
def _length(vector: Float[Array, "... n"]) -> Float[Array, "..."]:
    """Euclidean length, with a gradient of zero (not NaN) at zero."""
    square = jnp.sum(vector**2, -1)
    return jnp.where(square == 0, 0, jnp.sqrt(jnp.where(square == 0, 1, square)))


def inward_bias(
    estimated: Places, true: Places, centre: Float[ArrayLike, "2"] | Sequence[float]
) -> Float[Array, "..."]:
    """Shift of the estimate towards the sheet's centre, m; negative if outward.

    The position error PE of the GREIT figures of merit, with the origin at ``centre``.

    Example:
        found = je.metrics.Peak()(images, recon)
        print(je.metrics.inward_bias(found, places, [0.1, 0.1]))  # m, above 0: inward
    """
    return localisation_error(true, centre) - localisation_error(estimated, centre)


@full_precision
def image_sum(image: Float[ArrayLike, "... pixels"], areas: Float[ArrayLike, " pixels"]) -> Float[Array, "..."]:
    """Integral of the image (..., pixels) S over the sheet, (...) S m^2, by the areas of the pixels (pixels,) m^2."""
    return jnp.asarray(image) @ jnp.asarray(areas)


def coefficient_of_variation(values: Float[ArrayLike, "... n"], *, ddof: int) -> Float[Array, "..."]:
    """Standard deviation over mean along the last axis.

    NaN where the mean is zero, and for a single value with ``ddof=1``, for which the standard deviation is undefined.

    Args:
        values: (..., n).
        ddof: degrees of freedom subtracted for the mean, 0 or 1; required, since results differ.

    Example:
        sums = je.metrics.image_sum(images, recon.areas)  # S m^2
        print(je.metrics.coefficient_of_variation(sums, ddof=1))  # of equal touches at several places
    """
    numbers = real_array("values", values, MetricError)
    if ddof not in (0, 1) or not numbers.shape[-1:] > (0,):
        raise MetricError(
            f"values of shape {numbers.shape} with ddof={shown(ddof)}; give (..., n) values, and 0 or 1 for ddof"
        )
    found: Array = _variation(numbers, ddof)
    return found


@verb
def _variation(values: Float[Array, "... n"], ddof: int) -> Float[Array, "..."]:
    mean = jnp.mean(values, -1)
    spread = _length(values - mean[..., None]) / jnp.sqrt(values.shape[-1] - ddof)
    return jnp.where(mean == 0, jnp.nan, spread / jnp.where(mean == 0, 1, mean))


# --- GREIT figures of merit ------------------------------------------------------------------------------------------


class GreitFigures(eqx.Module):
    """Figures of merit of the image of a single small contact; see `greit_figures`.

    | meaning                                                        | shape | unit  | best  |
    |----------------------------------------------------------------|-------|-------|-------|
    | amplitude AR: integral of the image                            | (...) | S m^2 | even  |
    | position_error PE: inward shift, negative if outward           | (...) | m     | 0     |
    | resolution RES: square root of A_q / A_sheet                   | (...) |       | small |
    | shape_deformation SD: share of q outside its circle            | (...) |       | 0     |
    | ringing RNG: negative part of the image over the sum over q    | (...) |       | 0     |
    """

    amplitude: Float[Array, "..."]
    position_error: Float[Array, "..."]
    resolution: Float[Array, "..."]
    shape_deformation: Float[Array, "..."]
    ringing: Float[Array, "..."]


def greit_figures(
    image: Float[ArrayLike, "... pixels"],
    recon: Pictured,
    target: Places,
    centre: Float[ArrayLike, "2"] | Sequence[float],
) -> GreitFigures:
    """The GREIT figures of merit; every sum over pixels is weighted by their areas A on the sheet.

    With q = {pixels of at least a quarter of the largest value x}, r_q the centroid of q (each
    pixel weighted by its area alone), and C the circle about r_q that has the area of q:

        AR  = sum(A x)                                  RES = sqrt(A_q / A_sheet)
        PE  = |target - centre| - |r_q - centre|        SD  = A_(q outside C) / A_q
        RNG = -sum(A x over negative x) / sum(A x over q)

    A pixel is in C if its centre is. These are the definitions of EIDORS
    (``eval_GREIT_fig_merit``), with the origin at ``centre``; there AR is divided by its mean over
    targets near the centre when there are more than ten images; here the caller does this.
    The text of the paper sums the ringing outside and inside C in place of q.

    PE is radial: it does not contain an error along the circle about ``centre``. `localisation_error`
    contains both. For contacts that lower the conductivity, change the sign of the image.

    Args:
        image: (..., pixels) S; pixels that miss the sheet are ignored.
        recon: the reconstructor, basis map or picture that the image belongs to.
        target: true position, (..., 2) m.
        centre: of the sheet, (2,) m.

    Returns:
        The figures; all but the amplitude are NaN where the image is nowhere positive, and only there.

    Source: Adler et al. 2009, Physiol. Meas. 30 S35, section 2.2.
    """
    image, dtype = _on_pixels(image, recon), recon.areas.dtype
    where = jnp.asarray(target, dtype), jnp.asarray(centre, dtype)
    return _greit_figures(image, recon.centres, recon.areas, *where)


@verb
def _greit_figures(
    image: Float[Array, "... pixels"],
    centres: Float[Array, "pixels 2"],
    areas: Float[Array, " pixels"],
    target: Float[Array, "... 2"],
    centre: Float[Array, "2"],
) -> GreitFigures:
    image = jnp.where(areas > 0, image, 0)
    top = jnp.max(image, -1, keepdims=True)
    seen = top[..., 0] > 0
    lit = jnp.where(image >= top / 4, areas, 0)
    area = lit.sum(-1)
    middle = lit @ centres / area[..., None]
    outside = jnp.sum((centres - middle[..., None, :]) ** 2, -1) >= area[..., None] / jnp.pi
    negative = jnp.minimum(image, 0) @ areas
    positive = jnp.where(seen, jnp.sum(lit * image, -1), 1)
    return GreitFigures(
        amplitude=image @ areas,
        position_error=jnp.where(seen, inward_bias(middle, target, centre), jnp.nan),
        resolution=jnp.where(seen, jnp.sqrt(area / areas.sum()), jnp.nan),
        shape_deformation=jnp.where(seen, jnp.sum(jnp.where(outside, lit, 0), -1) / area, jnp.nan),
        ringing=jnp.where(seen, -negative / positive, jnp.nan),
    )


# --- similarity of two images ----------------------------------------------------------------------------------------


def image_correlation(
    image: Float[ArrayLike, "... pixels"], truth: Float[ArrayLike, "... pixels"], areas: Float[ArrayLike, " pixels"]
) -> Float[Array, "..."]:
    """Pearson's correlation (...) of two images (..., pixels), each pixel weighted by its area; -1 to 1.

    0 where either image is constant, so that a mean over many frames stays finite. Pixels without area are ignored.
    """
    given = {"image": image, "truth": truth, "areas": areas}
    pictures = [real_array(name, values, MetricError) for name, values in given.items()]
    if len({picture.shape[-1:] for picture in pictures}) > 1 or not pictures[2].ndim:
        shapes = ", ".join(f"{name} {picture.shape}" for name, picture in zip(given, pictures, strict=True))
        raise MetricError(f"shapes that do not fit: {shapes}; give one number for each pixel")
    return _image_correlation(*pictures)


@verb
def _image_correlation(
    image: Float[Array, "... pixels"], truth: Float[Array, "... pixels"], areas: Float[Array, " pixels"]
) -> Float[Array, "..."]:
    weight = areas / areas.sum()
    a, b = _contrast(image, weight), _contrast(truth, weight)
    square = jnp.sum(weight * a**2, -1) * jnp.sum(weight * b**2, -1)
    known = square > 0
    return jnp.where(known, jnp.sum(weight * a * b, -1) / jnp.sqrt(jnp.where(known, square, 1)), 0)


def _contrast(image: Float[Array, "... pixels"], weight: Float[Array, " pixels"]) -> Float[Array, "... pixels"]:
    """The image less its mean, in units of its span; exactly zero for a constant image."""
    there = jnp.argmax(weight)
    rise = jnp.where(weight > 0, image - image[..., there, None], 0)
    span = jnp.max(jnp.abs(rise), -1, keepdims=True)
    rise = rise / jnp.where(span > 0, span, 1)
    return rise - jnp.sum(weight * rise, -1, keepdims=True)


def structural_similarity(
    image: Real[ArrayLike, "... rows columns"],
    truth: Real[ArrayLike, "... rows columns"],
    *,
    width: float = 80.0,
    c1: float = 1e-4,
    c2: float = 9e-4,
) -> Float[Array, "..."]:
    """Mean structural similarity (SSIM) of two pictures, as the Kuopio Tomography Challenge 2023 computes it.

        SSIM = (2 m_a m_b + c1) (2 s_ab + c2) / ((m_a^2 + m_b^2 + c1) (s_aa + s_bb + c2)),

    with m and s the local means and (co)variances, s_ab = mean(a b) - m_a m_b, under a Gaussian
    window, and the mean taken over all pixels. The window is cut to the square of ceil(2 ``width``)
    pixels to each side; at the rim, the part of the window on the picture is
    normalised to a sum of one (neither zeros nor reflections are assumed beyond the rim). 1 for equal pictures.

    Args:
        image, truth: (..., rows, columns), with values in a range of about one, such as 0 to 1.
        width: standard deviation of the window, pixels.
        c1, c2: constants that bound the quotient where both pictures are zero, or constant.

    Raises:
        MetricError: if the shapes differ, there is no picture, or a setting is not above zero.

    Example:
        truth = jnp.linalg.norm(recon.centres - places[0], axis=1) < 0.015
        found = jnp.clip(image / image.max(), 0, 1).reshape(recon.shape)
        truth = truth.reshape(recon.shape).astype(float)
        print(je.metrics.structural_similarity(found, truth, width=3.0))  # 1: equal
    """
    a, b = _pictures(image, truth)
    if not is_traced(width, c1, c2) and not (width > 0 and c1 > 0 and c2 > 0):
        raise MetricError(f"width, c1 and c2 are {width}, {c1} and {c2}; give numbers above zero")
    return _structural_similarity(a, b, *(jnp.asarray(number, a.dtype) for number in (width, c1, c2)))


@verb
def _structural_similarity(
    a: Float[Array, "... rows columns"],
    b: Float[Array, "... rows columns"],
    width: Float[Array, ""],
    c1: Float[Array, ""],
    c2: Float[Array, ""],
) -> Float[Array, "..."]:
    rows, columns = (_window(size, width) for size in a.shape[-2:])

    def mean(picture: Float[Array, "... rows columns"]) -> Float[Array, "... rows columns"]:
        return rows @ picture @ columns.T  # the window is a product of one along each side, rim included

    m_a, m_b = mean(a), mean(b)
    s_aa, s_bb, s_ab = mean(a * a) - m_a**2, mean(b * b) - m_b**2, mean(a * b) - m_a * m_b
    like = (2 * m_a * m_b + c1) * (2 * s_ab + c2) / ((m_a**2 + m_b**2 + c1) * (s_aa + s_bb + c2))
    return jnp.mean(like, (-2, -1))


def _window(size: int, width: Float[Array, ""]) -> Float[Array, "size size"]:
    """Weights of the local mean along one side, (size, size); every row sums to one."""
    places = jnp.arange(size, dtype=width.dtype)
    apart = places[:, None] - places
    weight = jnp.where(jnp.abs(apart) <= jnp.ceil(2 * width), jnp.exp(-0.5 * (apart / width) ** 2), 0)
    return weight / weight.sum(1, keepdims=True)


def ktc_score(
    labels: Integer[ArrayLike, "... rows columns"], truth: Integer[ArrayLike, "... rows columns"]
) -> Float[Array, "..."]:
    """Score of a segmented picture in the Kuopio Tomography Challenge 2023 (Räsänen et al.); 1 is best.

    The mean `structural_similarity` of two masks: pixels labelled 1 (resistive) and pixels labelled 2
    (conductive); other labels are water. A class that is in neither picture scores 1. The pictures of
    the challenge are 256 x 256, and the window of 80 pixels suits that size.

    Raises:
        MetricError: if the shapes differ or there is no picture.
    """
    a, b = _pictures(labels, truth)
    masks = ([(picture == label).astype(a.dtype) for picture in (a, b)] for label in (1, 2))
    resistive, conductive = (structural_similarity(*pair) for pair in masks)
    return (resistive + conductive) / 2


def _pictures(
    image: Real[ArrayLike, "..."], truth: Real[ArrayLike, "..."]
) -> tuple[Float[Array, "... rows columns"], Float[Array, "... rows columns"]]:
    image, truth = real_array("image", image, MetricError), real_array("truth", truth, MetricError)
    if image.shape != truth.shape or image.ndim < 2 or not image.size:
        raise MetricError(
            f"pictures of shapes {image.shape} and {truth.shape}; give two of one shape (..., rows, columns)"
        )
    dtype = jnp.promote_types(_floating(image), _floating(truth))
    return image.astype(dtype), truth.astype(dtype)


def _floating(array: Real[Array, "..."]) -> np.dtype[Any]:
    """Type of the array if that is a floating one; else JAX's default."""
    return array.dtype if jnp.issubdtype(array.dtype, jnp.floating) else jnp.result_type(float)


# --- segmentation ----------------------------------------------------------------------------------------------------


def otsu_thresholds(
    values: Real[ArrayLike, "..."],
    classes: int = 3,
    *,
    bins: int = 256,
    weights: Float[ArrayLike, "..."] | None = None,
) -> Float[Array, " {classes}-1"]:
    """Thresholds that divide the values into classes with the largest variance between classes (Otsu 1979).

    Exact for the histogram of ``bins`` equal bins from the smallest value to the largest: dynamic
    programming covers every choice of bin edges. Where several edges divide the values alike, the
    threshold is their mean. Class numbers are ``jnp.searchsorted(thresholds, values, side="right")``.
    If the values fill fewer bins than there are classes, some class is empty; if all values are
    equal, every threshold is that value.

    Args:
        values: of any shape; values that are not finite are ignored.
        classes: number of classes, 2 or more.
        bins: of the histogram, at least as many as classes.
        weights: of each value, such as the area of its pixel; default: equal weights.

    Returns:
        Ascending, in the unit of the values; NaN if no value is finite and has weight.

    Raises:
        MetricError: if there are fewer than two classes, fewer bins than classes, no values, or
            weights of another shape.

    Example:
        thresholds = je.metrics.otsu_thresholds(image, classes=2)
        pressed = jnp.searchsorted(thresholds, image, side="right")  # 0 or 1 for each pixel
        truth = jnp.linalg.norm(recon.centres - places[0], axis=1) < 0.015
        shape = recon.shape
        print(je.metrics.ktc_score(pressed.reshape(shape), truth.astype(int).reshape(shape)))  # 1 is best
    """
    values = real_array("values", values, MetricError)
    weights = jnp.ones(values.shape) if weights is None else real_array("weights", weights, MetricError)
    if not 2 <= classes <= bins:
        raise MetricError(f"{classes} classes from {bins} bins; give at least 2 classes, and no more classes than bins")
    if weights.shape != values.shape or not values.size:
        raise MetricError(
            f"values of shape {values.shape} with weights of shape {weights.shape}; give one for each value"
        )
    dtype = _floating(values)
    return _otsu_thresholds(values.ravel().astype(dtype), weights.ravel().astype(dtype), classes, bins)


@verb
def _otsu_thresholds(
    values: Float[Array, " n"], weights: Float[Array, " n"], classes: int, bins: int
) -> Float[Array, " {classes}-1"]:
    edges, count = _histogram(values, jnp.where(jnp.isfinite(values), weights, 0), bins)
    mass, moment = _sums(count), _sums(count * jnp.linspace(-1, 1, bins, dtype=count.dtype))
    inside, first = mass - mass[:, None], moment - moment[:, None]  # sums over the class from edge i to edge j
    gain = jnp.where(inside > 0, first**2 / jnp.where(inside > 0, inside, 1), 0)
    cuts = _best_cuts(jnp.where(jnp.tri(bins + 1, k=-1, dtype=bool), -jnp.inf, gain), classes)
    filled = _sums(count > 0)  # number of bins below each edge that are not empty
    alike = filled == filled[cuts][:, None]
    return jnp.sum(jnp.where(alike, edges, 0), 1) / jnp.sum(alike, 1, dtype=edges.dtype)


def _histogram(
    values: Float[Array, " n"], weights: Float[Array, " n"], bins: int
) -> tuple[Float[Array, " {bins}+1"], Float[Array, " {bins}"]]:
    low = jnp.min(jnp.where(weights > 0, values, jnp.inf))
    high = jnp.max(jnp.where(weights > 0, values, -jnp.inf))
    part = jnp.where(weights > 0, values - low, 0) / jnp.where(high > low, high - low, 1)
    place = jnp.clip((part * bins).astype(int), 0, bins - 1)
    edges = low + (high - low) * jnp.linspace(0, 1, bins + 1, dtype=values.dtype)
    return edges, jnp.zeros(bins, weights.dtype).at[place].add(weights)


def _sums(values: Shaped[Array, " bins"]) -> Real[Array, " bins+1"]:
    """Sum of all values before each edge."""
    return jnp.concatenate([jnp.zeros_like(jnp.cumsum(values[:1])), jnp.cumsum(values)])


def _best_cuts(gain: Float[Array, "edges edges"], classes: int) -> Int[Array, " {classes}-1"]:
    """The path over edges from first to last, in ``classes`` steps, with the largest sum of gains."""
    best, before = gain[0], list[Array]()
    for _ in range(classes - 2):
        total = best[:, None] + gain
        best, before = total.max(0), [*before, total.argmax(0)]
    cuts = [jnp.argmax(best + gain[:, -1])]
    for step in reversed(before):
        cuts.insert(0, step[cuts[0]])
    return jnp.stack(cuts)
