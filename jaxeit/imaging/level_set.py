"""Shapes of pieces in a tank: a level set, fitted to the readings from the regions of an image.

The image is ``height * sigmoid(level / width)``: each piece has one height, so that readings which an image explains by
a blurred disc of many heights tell the border of the piece (Santosa 1996; Dorn and Lesselier 2006, Inverse Problems
22). The penalty on edges of the image is that on the length of borders; a Gaussian prior keeps the level smooth.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from .._compile import verb
from ..least_squares import quadratic
from ..least_squares.searches import HalfSquares
from ..messages.kinds import require_kind
from ..model.bases import Picture
from ..registry import limited, require_limits
from .absolute.images import IMAGE_STEPS, IMAGE_TOLERANCE, AbstractPosterior, ImagePosterior, Quadratic, most_probable
from .inputs import InverseError
from .priors import AbstractPrior, Laplace

FAR = 4.0
"""Largest distance from a border that the first level tells, pixels of the image."""


class LevelSet(eqx.Module):
    """How borders of pieces are fitted. The prior is one that needs no readings, such as `Laplace` or `GaussianSmooth`.

    | meaning                                                                        | default        | unit   |
    |--------------------------------------------------------------------------------|----------------|--------|
    | prior of the level, which is about a distance from the border                  | Laplace(3e-3)  |        |
    | weight of the prior, for each reading that is used                             | 1e-4           |        |
    | outside: the level where readings tell nothing                                 | -2             | pixels |
    | widths of the border, of one fit after the other                               | 0.5, 0.25      | pixels |
    | height of a piece: absolute logarithm of conductivity over the reference's     | 2              |        |
    | height_std: of the height, before the frame is seen                            | 0.1            |        |

    Raises:
        InverseError: for a value out of range.
    """

    prior: AbstractPrior = Laplace(3e-3)
    weight: float = limited(1e-4, above=0, static=True)
    outside: float = limited(-2.0, static=True)
    widths: tuple[float, ...] = limited((0.5, 0.25), above=0, static=True)
    height: float = limited(2.0, above=0, static=True)
    height_std: float = limited(0.1, above=0, static=True)

    def __check_init__(self) -> None:
        an_object = "an object, such as je.Laplace(3e-3)"
        require_kind(self.prior, AbstractPrior, InverseError, "a prior", an_object, "LevelSet")
        require_limits(self, InverseError)


class Distances(NamedTuple):
    """Signed distance from the nearest border, above zero inside; the class of the nearest region, less one."""

    level: Float[np.ndarray, "rows columns"]
    owner: Int[np.ndarray, "rows columns"]


def signed_distances(classes: Int[np.ndarray, "rows columns"], picture: Picture) -> Distances:
    """Distances from the borders of classes 1 and 2 on a grid over the extent of a picture, in its pixels."""
    sampling = [old / new for old, new in zip(picture.shape, classes.shape, strict=True)]
    found = np.full((2, *classes.shape), -np.inf)
    for number in range(2):
        inside = classes == number + 1
        if inside.any():
            within, beyond = (distance_transform_edt(part, sampling=sampling) for part in (inside, ~inside))
            found[number] = within - beyond
    return Distances(found.max(0), found.argmax(0))


class FittedLevel(NamedTuple):
    """The most probable level of each pixel and the image of pieces that it makes, (basis,); misfit and objective as
    `Segmentation` has them; whether the fit at the last width converged."""

    level: Float[Array, " basis"]
    pieces: Float[Array, " basis"]
    misfit: Float[Array, ""]
    objective: Float[Array, ""]
    converged: Bool[Array, ""]


def fitted_level(
    posterior: ImagePosterior, start: Distances, readings: Float[Array, ""], settings: LevelSet
) -> FittedLevel:
    """The most probable level of each pixel of an image, from distances on any grid over it.

    Args:
        readings: number of them that are used.
    """
    picture = posterior.physics.image.picture
    shapes = zip(picture.shape, start.level.shape, strict=True)
    places = np.ix_(*(((np.arange(n) + 0.5) / n * fine).astype(int) for n, fine in shapes))
    level, owner = (part[places].ravel() for part in start)
    heights, dtype = settings.height * np.array([-1.0, 1.0]), posterior.readings.dtype
    smooth = settings.prior.precision(jnp.zeros((0, picture.size), dtype), picture)
    expected = jnp.asarray(np.append(np.full(picture.size, settings.outside), heights), dtype)
    z = jnp.asarray(np.append(np.clip(level, -FAR, FAR), heights), dtype)
    prior, std = Quadratic(smooth, settings.weight * readings), jnp.asarray(settings.height_std, dtype)
    for width in settings.widths:
        shaped = _LevelPosterior(posterior, prior, expected, std, jnp.asarray(owner), jnp.asarray(width, dtype))
        z, state = most_probable(shaped, z, IMAGE_STEPS, IMAGE_TOLERANCE, damped=True)
    left = _residual(shaped, z)
    data = jnp.sum(left[: len(posterior.readings)] ** 2)
    # the penalty and the prior are numbers of which half the square has 1/2 too much
    misfit, objective = jnp.sqrt(data / readings), 0.5 * jnp.sum(left**2) - 1
    return FittedLevel(z[: picture.size], shaped.pieces(z), misfit, objective, state.converged)


@verb
def _residual(posterior: AbstractPosterior, x: Float[Array, " n"]) -> Float[Array, " m"]:
    return posterior.residual(x)


class _LevelPosterior(AbstractPosterior):
    """Minus the logarithm of the posterior probability of the levels of an image and of two heights.

    | meaning                                                    | shape      |
    |------------------------------------------------------------|------------|
    | image: that of the image which they make                   |            |
    | prior of the levels                                        |            |
    | expected: levels and heights before the frame is seen      | (basis+2,) |
    | height_std: of the heights before the frame is seen        | ()         |
    | owner: which of the heights a pixel has                    | (basis,)   |
    | width of the border                                        | ()         |
    """

    image: ImagePosterior
    prior: Quadratic
    expected: Float[Array, " n"]
    height_std: Float[Array, ""]
    owner: Int[Array, " basis"]
    width: Float[Array, ""]

    def pieces(self, x: Float[Array, " n"]) -> Float[Array, " basis"]:
        """The image."""
        return x[-2:][self.owner] * jax.nn.sigmoid(x[:-2] / self.width)

    def residual(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        # The prior as one number whose half square is the prior plus 1/2: its root alone has no slope at zero.
        return jnp.append(self.image.residual(self.pieces(x)), jnp.sqrt(1 + 2 * self._prior(x)[0]))

    def quadratic(self, x: Float[Array, " n"]) -> HalfSquares:
        """That of the image by the chain rule, without the curvature of the sigmoid, plus that of the priors."""
        share, height = jax.nn.sigmoid(x[:-2] / self.width), x[-2:][self.owner]
        of_image = self.image.quadratic(height * share)
        slope = height * share * (1 - share) / self.width
        of_heights = jax.nn.one_hot(self.owner, 2, dtype=x.dtype) * share[:, None]
        whole = of_image.hessian.matrix
        mixed = whole @ of_heights
        beside = slope[:, None] * mixed
        hessian = jnp.block([[slope[:, None] * whole * slope, beside], [beside.T, of_heights.T @ mixed]])
        gradient = jnp.append(slope * of_image.grad, of_heights.T @ of_image.grad)
        value, prior_gradient, matrix = self._prior(x)
        return quadratic(of_image.f + value, gradient + prior_gradient, hessian + matrix)

    def _prior(self, x: Float[Array, " n"]) -> tuple[Float[Array, ""], Float[Array, " n"], Float[Array, "n n"]]:
        """Value, gradient and matrix of the priors of levels and heights."""
        picture, d = self.image.physics.image.picture, x - self.expected
        matrix = jnp.diag(jnp.append(jnp.zeros_like(x[:-2]), jnp.full(2, self.height_std**-2, x.dtype)))
        matrix = matrix.at[:-2, :-2].set(self.prior.matrix(picture, d[:-2]))
        return 0.5 * d @ matrix @ d, matrix @ d, matrix
