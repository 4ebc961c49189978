"""How like two images are: correlation, structural similarity, and the score of the KTC 2023."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Integer, Real

from .._compile import is_traced, verb
from ..linalg.array_libraries import real_array
from .inputs import MetricError, floating_type


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
    dtype = jnp.promote_types(floating_type(image), floating_type(truth))
    return image.astype(dtype), truth.astype(dtype)
