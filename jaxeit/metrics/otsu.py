"""Thresholds that divide the values of an image into classes."""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Real, Shaped

from .._compile import verb
from ..linalg.array_libraries import real_array
from .inputs import MetricError, floating_type


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
    dtype = floating_type(values)
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
