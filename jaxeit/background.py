"""The conductivity of an untouched sheet, from a frame of it."""

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .basis import Pixels
from .discretise import Model
from .forward import forward
from .nonlinear import LogConductivity, Quadratic, gauss_newton
from .priors import GaussianSmooth
from .whitening import InverseError

_FLOOR = 1e-3  # of the root mean square of all readings: no reading is modelled better
_WORST = 0.1  # of the readings, unexplained: another skin, order of readings or polarity


def fit_background(
    model: Model,
    v0: Float[ArrayLike, " readings"],
    *,
    std: float = 0.15,
    length: float = 0.03,
    model_error: float = 0.01,
    columns: int = 20,
) -> Float[Array, " elements"]:
    """The conductivity, (elements,) S, that explains the readings of the untouched skin; for ``sigma=`` of `prepare`
    and `prepare_contacts`.

    A sprayed coat is uneven, and a touch is seen through it: on a sheet taken for even, most of what a reconstruction
    gets wrong is the coat's.  The untouched frame, which every difference needs anyhow, tells of it.  This is the most
    probable conductivity for ``log sigma ~ N(level, std^2 exp(-r^2 / (2 length^2)))`` and readings of independent
    errors ``model_error |v0|``, at least a thousandth of their root mean square (`gauss_newton`).  The level is that of
    the even sheet nearest to v0, so that a gain common to all readings does no harm.

    Args:
        v0: untouched frame, V, best a mean over many; readings that are not finite are left out.
        std: of the logarithm of the conductivity.
        length: over which the coat is alike, m.
        model_error: of a reading, relative: mesh, electrodes and current as they are modelled.
        columns: pixels of the coat along x.

    Raises:
        InverseError: if the shape or a value is wrong, or no coat explains the readings: then the order or the polarity
            of the readings is not that of the skin's protocol.
    """
    v0, even = np.asarray(v0, float), np.asarray(forward(model, model.background), float)
    _check(v0, even, std=std, length=length, model_error=model_error, columns=columns)
    there = np.isfinite(v0)
    level = (even[there] @ even[there]) / (even[there] @ v0[there])
    if not level > 0:
        raise InverseError("v0 has the opposite sign of what the skin's protocol gives: turn its polarity")
    image = Pixels(columns).on(model)
    physics = LogConductivity(model, image, jnp.asarray(level * _mean(model), model.dtype))
    prior = GaussianSmooth(length).precision(jnp.zeros((1, image.size), model.dtype), image.picture)
    error = np.hypot(model_error * v0, _FLOOR * np.sqrt(np.mean(v0[there] ** 2)))
    x = gauss_newton(physics, Quadratic(prior, std**-2), *(jnp.asarray(a, model.dtype) for a in (v0, error)))
    left = np.linalg.norm((np.asarray(physics.voltages(x)) - v0)[there]) / np.linalg.norm(v0[there])
    if not left < _WORST:
        raise InverseError(f"no coat explains v0: {left:.0%} of it is left; is this its skin, and the order its own?")
    return physics.sigma(x)


def _mean(model: Model) -> float:
    return float(np.average(np.asarray(model.background, float), weights=np.asarray(model.areas, float)))


def _check(v0, even, **positive):
    if v0.shape != even.shape:
        raise InverseError(f"v0 has shape {v0.shape}; give the {len(even)} readings of one frame")
    if not np.isfinite(v0).any() or not np.any(v0[np.isfinite(v0)]):
        raise InverseError("v0 has no reading that is finite and not zero")
    for name, value in positive.items():
        if not 0 < value < np.inf:
            raise InverseError(f"{name} is {value}; give a number above zero")
