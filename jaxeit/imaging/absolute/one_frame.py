"""The conductivity that one frame shows, by one call; and images whose errors grow until they explain what is left."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..._compile import require_known
from ...model.bases import AbstractBasis, BasisMap, Picture, Pixels
from ...model.discretisation import Model, require_model
from ...model.forward_model import forward
from ..inputs import InverseError
from .frames import checked_frame, frame_error, require_positive, sheet_level
from .images import AbstractPenalty, IsotropicVariation, LogConductivity, gauss_newton_fit

WEIGHT = 0.0064
"""Of the penalty, for each reading: errors are mostly the model's, and common to readings, not noise that averages."""
COLUMNS = 30
"""Pixels along x where no basis is given."""
MORE_FITS, BELIEVED_MISFIT = 3, 1.05
"""Fits with larger errors, of an image that leaves more of a frame than these; root mean square over the errors."""
ERROR = 0.01
"""Of a reading, relative: that of a tank whose contacts and places of electrodes are known well."""


class AbsoluteImage(eqx.Module):
    """The conductivity that a frame shows.

    | meaning                                                              | shape       | unit |
    |----------------------------------------------------------------------|-------------|------|
    | sigma: conductivity of each element of the model                     | (elements,) | S    |
    | image: conductivity of each coefficient of the basis                 | (basis,)    | S    |
    | picture that the image belongs to                                    |             |      |
    | errors: standard error of each reading that was believed             | (readings,) | V    |
    | misfit: root mean square of what the image leaves, over these errors | ()          | 1    |
    | converged: whether the fit ended before its twelve steps did; if not, the image may be far from the best | () | |
    """

    sigma: Float[Array, " elements"]
    image: Float[Array, " basis"]
    picture: Picture
    errors: Float[Array, " readings"]
    misfit: Float[Array, ""]
    converged: Bool[Array, ""]


def absolute_image(
    model: Model,
    frame: Float[ArrayLike, " readings"],
    basis: AbstractBasis | BasisMap | None = None,
    *,
    penalty: AbstractPenalty | None = None,
    error: float = ERROR,
) -> AbsoluteImage:
    """The conductivity that a frame shows, without another frame: `gauss_newton` from the even content nearest to it.

    Errors of readings are a part of each, and a thousandth of the root mean square of all; they grow where the image
    leaves more. Current, contacts and places of electrodes must be those of the model: what is wrong with them looks
    like objects at the rim. On the host, seconds a frame.

    Args:
        frame: V; readings that are not finite are left out.
        basis: default `Pixels`, 30 along x.
        penalty: of the logarithm of the conductivity; default `IsotropicVariation` with a weight of 0.0064 for each
            reading that is used.
        error: of a reading, relative to itself.

    Raises:
        SceneError: if ``model`` is no model, such as a tank.
        InverseError: if a shape or a value is wrong.

    Example:
        shown = je.imaging.absolute_image(model, v0 + dv, je.Pixels(16))
        print(f"{shown.sigma.min():.2g} to {shown.sigma.max():.2g} S; {shown.misfit:.1f} of the errors is left")
    """
    require_model(model)
    require_known("absolute_image", InverseError, model.background)
    require_positive(error=error)
    even = forward(model)
    readings = checked_frame("frame", frame, even)
    image = picture_basis(model, basis)
    level = sheet_level("frame", readings, even) * model.mean_background
    physics, own = LogConductivity(model, image, level), frame_error(readings, error)
    used = jnp.sum(jnp.isfinite(readings), dtype=model.dtype)
    penalty = variation_of(used) if penalty is None else penalty
    found = posterior_image(physics, penalty, readings, lambda growth: growth * own)
    seen = physics.sigma(found.image), level * jnp.exp(found.image)
    return AbsoluteImage(*seen, image.picture, found.errors, found.misfit, found.converged)


def variation_of(readings: Float[Array, ""]) -> IsotropicVariation:
    """The penalty for this many readings."""
    return IsotropicVariation(weight=WEIGHT * readings)


def picture_basis(model: Model, basis: AbstractBasis | BasisMap | None) -> BasisMap:
    """The basis laid over the model; a picture."""
    basis = Pixels(COLUMNS) if basis is None else basis
    image = basis if isinstance(basis, BasisMap) else basis.on(model)
    if len(image.picture.shape) != 2:
        raise InverseError("the basis is no picture; give pixels, such as basis=Pixels(40)")
    return image


class PosteriorImage(NamedTuple):
    """An image; errors of the readings that were believed, V; the root mean square of what the image leaves, over
    them; whether the fit converged."""

    image: Float[Array, " basis"]
    errors: Float[Array, " readings"]
    misfit: Float[Array, ""]
    converged: Bool[Array, ""]


def posterior_image(
    physics: LogConductivity,
    penalty: AbstractPenalty,
    target: Float[Array, " readings"],
    errors: Callable[[float], Float[Array, " readings"]],
) -> PosteriorImage:
    """The image, fitted anew with larger errors where it leaves more of the readings than they tell."""
    growth = 1.0
    for _ in range(1 + MORE_FITS):
        std = errors(growth)
        found, converged = gauss_newton_fit(physics, penalty, target, std)
        misfit = jnp.sqrt(jnp.nanmean(((target - physics.voltages(found)) / std) ** 2))
        if not misfit > BELIEVED_MISFIT:
            break
        growth *= float(misfit)
    return PosteriorImage(found, std, misfit, converged)
