"""The conductivity of an untouched sheet, from a frame of it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ...model.bases import BasisMap, Pixels
from ...model.discretisation import Model
from ...model.forward_model import forward
from ..priors import AbstractPrecision, GaussianSmooth
from .frames import checked_frame, frame_error, require_explained, require_positive, require_steps, sheet_level
from .images import (
    IMAGE_STEPS,
    IMAGE_TOLERANCE,
    ImagePosterior,
    LogConductivity,
    Quadratic,
    most_probable,
    reading_weights,
)

# What is believed of a real coating: standard deviation of the logarithm of its conductivity, distance over which it
# varies, m, and pixels of it along x, of less than half that distance on a skin of 0.2 m.
COATING_STD, COATING_LENGTH, COATING_COLUMNS = 0.15, 0.03, 20
# Relative error of a reading, from mesh, electrodes and current as they are modelled.
COATING_ERROR = 1e-2
# Share of the variance of the error of the fit that is kept.
ERROR_VARIANCE = 0.95


def fit_background(
    model: Model,
    v0: Float[ArrayLike, " readings"],
    *,
    std: Float[ArrayLike, ""] = COATING_STD,
    length: Float[ArrayLike, ""] = COATING_LENGTH,
    model_error: Float[ArrayLike, ""] = COATING_ERROR,
    columns: int = COATING_COLUMNS,
    basis: BasisMap | None = None,
    tolerance: float = IMAGE_TOLERANCE,
) -> Float[Array, " elements"]:
    """Estimate the conductivity, (elements,) S, of the untouched sheet from one frame; for ``sigma=`` of `prepare` and
    `prepare_contacts`.

    Real coatings are uneven, and assuming an even one is the largest source of localisation error. The estimate is the
    most probable conductivity for ``log sigma ~ N(level, std^2 exp(-r^2 / (2 length^2)))`` and independent errors
    ``model_error |v0|`` of the readings, at least a thousandth of their root mean square (`gauss_newton`). The level is
    that of the even sheet nearest to v0, so that a gain common to all readings does no harm.

    A fit that has not converged after twelve steps ends with the best conductivity found so far. It is refused, as any
    other, if it leaves a tenth of the readings unexplained.

    Works under `jax.jit` and `jax.grad`; values that are traced are not checked. Under jit give ``basis``.

    Args:
        v0: untouched frame, V, best a mean over many; readings that are not finite are left out.
        std: standard deviation of the logarithm of the conductivity.
        length: distance over which the coating varies, m.
        model_error: relative error of a reading, from mesh, electrodes and current as they are modelled.
        columns: number of pixels of the coating along x.
        basis: pixels of the coating laid over the model, ``Pixels(columns).on(model)``; default: made from ``columns``.
        tolerance: as for `gauss_newton`.

    Raises:
        InverseError: if the shape or a value is wrong, or no coating explains the readings: then the order or the
            polarity of the readings is not that of the skin's protocol.

    Example:
        uneven = je.Scene(je.load_skin("testbed"), (je.effects.CoatingNonUniformity(0.15, seed=7),))
        real = je.discretise(uneven, je.Fidelity.draft())
        frame = je.forward(real, je.conductivity(real))  # V, of the untouched skin
        sigma = je.fit_background(model, frame, columns=12)  # S, for je.prepare and je.prepare_contacts
        truth = je.conductivity(real)
        print(jnp.std(jnp.log(sigma / truth)), "of", jnp.std(jnp.log(truth)), "left")
    """
    require_positive(std=std, length=length, model_error=model_error, columns=columns)
    require_steps(IMAGE_STEPS, tolerance)
    image = Pixels(columns).on(model) if basis is None else basis
    frame, physics = even_coat("v0", model, v0, image)
    return _fitted("v0", physics, frame, std, length, model_error, tolerance)[0]


def _fitted(
    name: str,
    physics: LogConductivity,
    frame: Float[Array, " readings"],
    std: Float[ArrayLike, ""],
    length: Float[ArrayLike, ""],
    model_error: Float[ArrayLike, ""],
    tolerance: float,
) -> tuple[Float[Array, " elements"], Float[Array, "basis basis"]]:
    """The most probable conductivity of `fit_background`, S, and the precision of the logarithm of its pixels.

    Args:
        name: of the argument that is the frame, for messages.
    """
    penalty = Quadratic(coat_precision(physics.image, length), 1 / jnp.asarray(std) ** 2)
    weight, readings = reading_weights(frame, frame_error(frame, model_error))
    posterior, start = ImagePosterior(physics, penalty, readings, weight), jnp.zeros(physics.image.size, frame.dtype)
    x, state = most_probable(posterior, start, IMAGE_STEPS, tolerance)
    require_explained(name, "coating", physics.voltages(x), readings, jnp.isfinite(frame))
    return physics.sigma(x), state.quadratic.hessian.matrix


class UntouchedSheet(NamedTuple):
    """The conductivity of the untouched sheet, (elements,) S, and modes of the error of its logarithm, (elements, c).

    The error is the sum of the modes, each times a standard normal number.
    """

    sigma: Float[Array, " elements"]
    errors: Float[np.ndarray, "elements c"]


def fitted_sheet(model: Model, v0: Float[Array, " readings"]) -> UntouchedSheet:
    """The sheet of `fit_background` and its error: the principal components of its posterior covariance, as many as
    hold `ERROR_VARIANCE` of it.

    Raises:
        InverseError: as for `fit_background`, of an argument ``untouched``.
    """
    sigma, precision, image = untouched_sheet(model, v0)
    values, vectors = np.linalg.eigh(np.asarray(precision, float))  # ascending: the largest variances first
    share = np.cumsum(1 / values) / np.sum(1 / values)
    count = 1 + int(np.searchsorted(share, ERROR_VARIANCE))
    pixels = jnp.asarray((vectors / np.sqrt(values))[:, :count].T, sigma.dtype)
    return UntouchedSheet(sigma, np.asarray(jax.vmap(image.expand)(pixels), float).T)


def untouched_sheet(
    model: Model, untouched: Float[Array, "..."]
) -> tuple[Float[Array, " elements"], Float[Array, "basis basis"], BasisMap]:
    """Conductivity of an untouched sheet, S, the precision of the logarithm of its pixels, and these pixels."""
    frame, physics = even_coat("untouched", model, untouched, Pixels(COATING_COLUMNS).on(model))
    fit = _fitted("untouched", physics, frame, COATING_STD, COATING_LENGTH, COATING_ERROR, IMAGE_TOLERANCE)
    return *fit, physics.image


def even_coat(
    name: str, model: Model, v0: Float[ArrayLike, "..."], image: BasisMap
) -> tuple[Float[Array, " readings"], LogConductivity]:
    """A frame, V, in the model's precision; and the physics of a coat about the even sheet nearest to it.

    Args:
        name: of the argument that is the frame, for messages.

    Raises:
        InverseError: if the frame has another shape, no reading or the opposite sign.
    """
    even = forward(model, model.background)
    frame = checked_frame(name, v0, even)
    return frame, LogConductivity(model, image, sheet_level(name, frame, even) * model.mean_background)


def coat_precision(image: BasisMap, length: Float[ArrayLike, ""]) -> AbstractPrecision:
    """Precision of the logarithm of the conductivity of a coat that varies over a length, m, for a variance of one."""
    # The setting of a prior is a number; a length that JAX traces takes its place.
    smooth = eqx.tree_at(lambda prior: prior.length, GaussianSmooth(), jnp.asarray(length, image.picture.centres.dtype))
    found: AbstractPrecision = smooth.precision(jnp.zeros((1, image.size), smooth.length.dtype), image.picture)
    return found
