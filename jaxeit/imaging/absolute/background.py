"""The conductivity of an untouched sheet, from a frame of it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..._compile import is_traced, verb
from ...kinds import stated
from ...model.bases import BasisMap, Pixels
from ...model.discretisation import Model
from ...model.forward_model import CoatedSheet, forward
from ..noise import InverseError, require_real
from ..priors import AbstractPrecision, GaussianSmooth
from .images import ImagePosterior, LogConductivity, Quadratic, most_probable, reading_weights

# What is believed of a real coating: standard deviation of the logarithm of its conductivity, distance over which it
# varies, m, and pixels of it along x, of less than half that distance on a skin of 0.2 m.
COATING_STD, COATING_LENGTH, COATING_COLUMNS = 0.15, 0.03, 20
# Relative error of a reading, from mesh, electrodes and current as they are modelled, and tolerance of the fit.
COATING_ERROR, TOLERANCE = 1e-2, 2e-3
# Smallest error of a reading, as a fraction of the root mean square of all: no reading is modelled better.
ERROR_FLOOR = 1e-3
# Steps of the fit, and share of the variance of its error that is kept.
STEPS, ERROR_VARIANCE = 12, 0.95
# Largest fraction of the readings that may stay unexplained. A larger one means another skin, another order of the
# readings or a wrong polarity.
MAX_UNEXPLAINED = 0.1


def fit_background(
    model: Model,
    v0: Float[ArrayLike, " readings"],
    *,
    std: Float[ArrayLike, ""] = COATING_STD,
    length: Float[ArrayLike, ""] = COATING_LENGTH,
    model_error: Float[ArrayLike, ""] = COATING_ERROR,
    columns: int = COATING_COLUMNS,
    basis: BasisMap | None = None,
    tolerance: float = TOLERANCE,
) -> Float[Array, " elements"]:
    """Estimate the conductivity, (elements,) S, of the untouched sheet from one frame; for ``sigma=`` of `prepare` and
    `prepare_contacts`.

    Real coatings are uneven, and assuming an even one is the largest source of localisation error. The estimate is the
    most probable conductivity for ``log sigma ~ N(level, std^2 exp(-r^2 / (2 length^2)))`` and independent errors
    ``model_error |v0|`` of the readings, at least a thousandth of their root mean square (`gauss_newton`). The level is
    that of the even sheet nearest to v0, so that a gain common to all readings does no harm.

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
    require_real(v0=v0)
    frame = jnp.asarray(v0, model.dtype)
    require_positive(std=std, length=length, model_error=model_error, columns=columns)
    physics = even_coat(model, frame, Pixels(columns).on(model) if basis is None else basis)
    return _fitted(physics, frame, std, length, model_error, tolerance)[0]


def _fitted(
    physics: LogConductivity,
    frame: Float[Array, " readings"],
    std: Float[ArrayLike, ""],
    length: Float[ArrayLike, ""],
    model_error: Float[ArrayLike, ""],
    tolerance: float,
) -> tuple[Float[Array, " elements"], Float[Array, "basis basis"]]:
    """The most probable conductivity of `fit_background`, S, and the precision of the logarithm of its pixels."""
    penalty = Quadratic(coat_precision(physics.image, length), 1 / jnp.asarray(std) ** 2)
    weight, readings = reading_weights(frame, frame_error(frame, model_error))
    posterior, start = ImagePosterior(physics, penalty, readings, weight), jnp.zeros(physics.image.size, frame.dtype)
    x, state = most_probable(posterior, start, STEPS, tolerance)
    require_explained("coating", physics.voltages(x), readings, jnp.isfinite(frame))
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
        InverseError: as for `fit_background`.
    """
    physics = even_coat(model, v0, Pixels(COATING_COLUMNS).on(model))
    sigma, precision = _fitted(physics, v0, COATING_STD, COATING_LENGTH, COATING_ERROR, TOLERANCE)
    values, vectors = np.linalg.eigh(np.asarray(precision, float))  # ascending: the largest variances first
    share = np.cumsum(1 / values) / np.sum(1 / values)
    count = 1 + int(np.searchsorted(share, ERROR_VARIANCE))
    pixels = jnp.asarray((vectors / np.sqrt(values))[:, :count].T, sigma.dtype)
    return UntouchedSheet(sigma, np.asarray(jax.vmap(physics.image.expand)(pixels), float).T)


def even_coat(model: Model, v0: Float[Array, "..."], image: BasisMap) -> LogConductivity:
    """The physics of a coat about the even sheet nearest to a frame.

    Raises:
        InverseError: if the frame has another shape, no reading or the opposite sign.
    """
    even = forward(model, model.background)
    require_frame(v0, even)
    level = sheet_level(v0, even)
    return LogConductivity(model, image, level * jnp.average(model.background, weights=model.areas))


def coat_precision(image: BasisMap, length: Float[ArrayLike, ""]) -> AbstractPrecision:
    """Precision of the logarithm of the conductivity of a coat that varies over a length, m, for a variance of one."""
    # The setting of a prior is a number; a length that JAX traces takes its place.
    smooth = eqx.tree_at(lambda prior: prior.length, GaussianSmooth(), jnp.asarray(length, image.picture.centres.dtype))
    found: AbstractPrecision = smooth.precision(jnp.zeros((1, image.size), smooth.length.dtype), image.picture)
    return found


def sheet_of(
    model: Model,
    untouched: Float[ArrayLike, " readings"] | None,
    sigma: Float[Array, " elements"] | None,
    channels: Bool[ArrayLike, " readings"] | None,
) -> Float[Array, " elements"] | None:
    """The conductivity of the untouched sheet, (elements,) S, from what is known of it; None: it is even.

    Raises:
        InverseError: if both a frame and a conductivity are given, or no coating explains the frame.
    """
    if sigma is not None and not hasattr(sigma, "shape") and not isinstance(sigma, CoatedSheet):
        raise InverseError(f"sigma is {stated(sigma)}; give the conductivity of each element, S, as an array")
    frame = untouched_frame(model, untouched, sigma, channels)
    return sigma if frame is None else fit_background(model, frame)


def untouched_frame(
    model: Model,
    untouched: Float[ArrayLike, " readings"] | None,
    sigma: Float[Array, " elements"] | None,
    channels: Bool[ArrayLike, " readings"] | None,
) -> Float[Array, "..."] | None:
    """The frame to which the sheet is fitted, with NaN for readings that are not used; None without a frame.

    Raises:
        InverseError: if both a frame and a conductivity are given.
    """
    if untouched is None:
        return None
    if sigma is not None:
        raise InverseError("untouched and sigma both tell the sheet; give one of them")
    frame = jnp.asarray(untouched, model.dtype)
    if channels is not None and frame.shape == np.shape(channels):
        frame = jnp.where(jnp.asarray(channels, bool), frame, jnp.nan)
    return frame


def sheet_level(v0: Float[Array, " readings"], even: Float[Array, " readings"]) -> Float[Array, ""]:
    """Conductivity of the even sheet nearest to a frame, over that of the model; ``even``: the model's readings."""
    level: Float[Array, ""] = _level(v0, even)
    if not is_traced(level) and not level > 0:
        raise InverseError("v0 has the opposite sign of the model's readings; reverse its polarity")
    return level


@verb
def _level(v0: Float[Array, " readings"], even: Float[Array, " readings"]) -> Float[Array, ""]:
    there = jnp.isfinite(v0)
    return jnp.sum(jnp.where(there, even**2, 0)) / (even @ jnp.where(there, v0, 0))


@verb
def frame_error(v0: Float[Array, " readings"], model_error: Float[ArrayLike, ""]) -> Float[Array, " readings"]:
    """Standard error of each reading of an untouched frame: a part of itself, and a thousandth of their rms."""
    there = jnp.isfinite(v0)
    known = jnp.where(there, v0, 0)
    floor = ERROR_FLOOR * jnp.sqrt(known @ known / jnp.sum(there, dtype=known.dtype))
    return jnp.hypot(model_error * known, floor)


def require_frame(v0: Float[Array, "..."], even: Float[Array, " readings"]) -> None:
    """Raise InverseError unless v0 is a frame with readings; ``even``: readings of the model."""
    if v0.shape != even.shape:
        raise InverseError(f"v0 has shape {v0.shape}; give the {len(even)} readings of one frame")
    if not is_traced(v0) and not np.any(np.nan_to_num(v0, posinf=0, neginf=0)):
        raise InverseError("v0 has no reading that is finite and not zero")


def require_positive(**values: Any) -> None:
    """Raise InverseError, with the name of the value, unless every value that is known is above zero."""
    for name, value in values.items():
        if not is_traced(value) and not 0 < value < np.inf:
            raise InverseError(f"{name} is {value}; give a number above zero")


@verb
def _unexplained(
    found: Float[Array, " readings"], known: Float[Array, " readings"], there: Bool[Array, " readings"]
) -> Float[Array, ""]:
    left: Array = jnp.linalg.norm(jnp.where(there, found - known, 0)) / jnp.linalg.norm(known)
    return left


def require_explained(
    what: str,
    found: Float[Array, " readings"],
    known: Float[Array, " readings"],
    there: Bool[Array, " readings"],
    hint: Callable[[], str] = str,
) -> None:
    """Raise InverseError if too much of a frame is left by the readings that were found for it.

    Args:
        hint: what ends the message, asked for where there is one.
    """
    left: Array = _unexplained(found, known, there)
    if not is_traced(left) and not left < MAX_UNEXPLAINED:
        raise InverseError(
            f"no {what} explains v0: {left:.0%} of it is left; give a frame of this skin, readings in the order of "
            f"the skin's protocol{hint()}"
        )
