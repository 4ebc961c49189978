"""The covariance of a scan's readings under the prior, in units of their noise: the input of every choice of readings.

With readings in units of their noise, the information of a subset S about an image with prior covariance G is

    log det(1 + K_SS) = log det(G^-1 + J_S^T J_S) - log det(G^-1),        K = J G J^T,

so that a choice needs only K, (readings, readings).
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from .._compile import verb
from ..imaging.inputs import InverseError, known_flags, require_some
from ..imaging.methods import Problem
from ..imaging.priors import AbstractPrior, Noser
from ..imaging.readings.noise import noise_weight
from ..model.bases import AbstractBasis, BasisMap, Picture, Pixels
from ..model.discretisation import Model
from ..model.sensitivity import jacobian


def signal_covariance(
    model: Model,
    prior: AbstractPrior | None = None,
    basis: AbstractBasis | BasisMap | None = None,
    noise: Float[ArrayLike, " readings"] | None = None,
    hyperparameter: Float[ArrayLike, ""] = 0.1,
    *,
    sigma: Float[Array, " elements"] | None = None,
    region: Float[ArrayLike, "... basis"] | None = None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> Float[Array, "... readings readings"]:
    """Covariance K of the readings under the prior, in units of their noise.

    It works under jit, vmap and grad with respect to ``noise``, ``hyperparameter``, ``sigma`` and ``region``; traced
    noise is not checked.

    Args:
        model: the scan's model.
        prior, hyperparameter: as for `prepare`; default `Noser` and 0.1.
        basis: default `Pixels`, 40 along x.  Under jit pass a `BasisMap`.
        noise: standard deviation of each reading, (readings,) V; default: equal for all readings.
        sigma: conductivity to linearise at, (elements,) S; default: the untouched sheet.
        region: weights of the places where changes are expected, (basis,) 0 to 1 (`around`, or the weights of
            `pad_masks`), which multiply the prior's variances.  The strength of the prior remains that of the whole
            sheet.  Leading axes hold several regions.
        channels: readings that the device can take; the others have a covariance of zero; default: all.

    Raises:
        InverseError: if the noise is not one positive number per reading that is used, or no reading is used.
    """
    image = basis if isinstance(basis, BasisMap) else (basis or Pixels()).on(model)
    weights = jnp.ones(image.size, model.dtype) if region is None else jnp.asarray(region, model.dtype)
    return region_covariance(model, prior or Noser(), image, noise, hyperparameter, sigma, channels)(weights)


def region_covariance(
    model: Model,
    prior: AbstractPrior,
    image: BasisMap,
    noise: Float[ArrayLike, " readings"] | None,
    hyperparameter: Float[ArrayLike, ""],
    sigma: Float[Array, " elements"] | None,
    channels: Bool[ArrayLike, " readings"] | None = None,
) -> Callable[[Float[Array, "... basis"]], Float[Array, "... readings readings"]]:
    """`signal_covariance` as a function of the region, so that many regions share one Jacobian."""
    if noise is not None and np.ndim(noise) != 1:
        raise InverseError(
            f"noise has shape {np.shape(noise)}; give one standard deviation per reading, ({model.readings},) V"
        )
    used = np.ones(model.readings, bool) if channels is None else known_flags(channels, model.readings)
    weight = jnp.asarray(noise_weight(noise, model.readings, require_some(used)))
    strength = jnp.asarray(hyperparameter, model.dtype)
    return partial(
        _signal_covariance, jacobian(model, sigma, image), weight.astype(model.dtype), prior, strength, image
    )


@verb
def _signal_covariance(
    j: Float[Array, "readings basis"],
    weight: Float[Array, " readings"],
    prior: AbstractPrior,
    hyperparameter: Float[Array, ""],
    image: BasisMap,
    region: Float[Array, "... basis"],
) -> Float[Array, "... readings readings"]:
    j = j * jnp.sqrt(weight)[:, None]
    problem = Problem(j, jnp.sum(weight > 0, dtype=j.dtype), hyperparameter, prior, image.picture)
    precision = problem.precision()
    strength = problem.strength(precision.solve(j.T))

    def of_region(region: Float[Array, " basis"]) -> Float[Array, "readings readings"]:
        weighted = j * jnp.sqrt(region)
        return weighted @ precision.solve(weighted.T) / strength

    covariances: Array = jax.lax.map(of_region, region.reshape(-1, image.size))
    return covariances.reshape(*region.shape[:-1], *covariances.shape[1:])


def around(
    picture: Picture | BasisMap, place: Float[ArrayLike, "2"] | Sequence[float], radius: float
) -> Float[Array, " basis"]:
    """A region for `signal_covariance`: ``exp(-d^2 / (2 radius^2))`` with the distance d from a place, m.

    Example:
        place = je.scan.around(pixels, [0.06, 0.13], radius=0.03)  # 1 at the place, less around it
        local = je.scan.signal_covariance(model, basis=pixels, region=place)
        best_there = je.scan.choose_readings(local, 40).rows
    """
    square = jnp.sum((picture.centres - jnp.asarray(place, picture.centres.dtype)) ** 2, -1)
    return jnp.exp(-0.5 * square / radius**2)
