"""Priors: what is known of an image before it is measured.

A prior is a quadratic penalty ``x^T R x``; its *precision* R comes in three forms, each of which computes what the
methods need in the cheapest way.  The overall scale of R does not matter: the hyperparameter has no unit (`methods`).
"""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._compile import verb
from ..linalg.lapack import cho_factor, cho_solve, cholesky, solve_triangular
from ..model.bases import Picture
from ..registry import AbstractChoice, Registry, limited
from ..registry.limits import LONGEST


class AbstractPrecision(eqx.Module):
    """R, symmetric positive definite."""

    @abstractmethod
    def matrix(self) -> Float[Array, "basis basis"]:
        """R itself, (basis, basis)."""

    @abstractmethod
    def times(self, x: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        """``R x`` of one x, or of several side by side, (basis, ...)."""

    @abstractmethod
    def solve(self, x: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        """``R^-1 x`` of one x, or of several side by side, (basis, ...)."""

    @abstractmethod
    def variance(self) -> Float[Array, " basis"]:
        """The diagonal of ``R^-1``, (basis,)."""

    @abstractmethod
    def seen(self, j: Float[Array, "k basis"]) -> Float[Array, "k basis"]:
        """``J Gamma^-1`` of a J of k rows, (k, basis); Gamma as in `residual`."""

    @abstractmethod
    def image(self, z: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        """``x = Gamma^-1 z``, (basis, ...), for which ``x^T R x = |z|^2``."""

    @abstractmethod
    def residual(self, x: Float[Array, " basis"]) -> Float[Array, " rows"]:
        """``Gamma x``, whose sum of squares is ``x^T R x``: a block for any least-squares method."""


class Diagonal(AbstractPrecision):
    """R = diag(values), (basis,) above zero."""

    values: Float[Array, " basis"]

    def matrix(self) -> Float[Array, "basis basis"]:
        return jnp.diag(self.values)

    def times(self, x: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return (self.values * x.T).T

    def solve(self, x: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return (x.T / self.values).T

    def variance(self) -> Float[Array, " basis"]:
        return 1 / self.values

    def seen(self, j: Float[Array, "k basis"]) -> Float[Array, "k basis"]:
        return j / jnp.sqrt(self.values)

    def image(self, z: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return (z.T / jnp.sqrt(self.values)).T

    def residual(self, x: Float[Array, " basis"]) -> Float[Array, " rows"]:
        return jnp.sqrt(self.values) * x


class Precision(AbstractPrecision):
    """R as the matrix ``values``, (basis, basis)."""

    values: Float[Array, "basis basis"]

    def matrix(self) -> Float[Array, "basis basis"]:
        return self.values

    def times(self, x: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return self.values @ x

    def solve(self, x: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return cho_solve(cho_factor(self.values), x)

    def variance(self) -> Float[Array, " basis"]:
        diagonal: Array = jnp.diagonal(self.solve(jnp.eye(len(self.values), dtype=self.values.dtype)))
        return diagonal

    def seen(self, j: Float[Array, "k basis"]) -> Float[Array, "k basis"]:
        return solve_triangular(cholesky(self.values), j.T, trans=1).T

    def image(self, z: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return solve_triangular(cholesky(self.values), z)

    def residual(self, x: Float[Array, " basis"]) -> Float[Array, " rows"]:
        return cholesky(self.values) @ x


class Covariance(AbstractPrecision):
    """R as its inverse ``values``, the covariance of the image, (basis, basis)."""

    values: Float[Array, "basis basis"]

    def matrix(self) -> Float[Array, "basis basis"]:
        return self.times(jnp.eye(len(self.values), dtype=self.values.dtype))

    def times(self, x: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return cho_solve(cho_factor(self.values), x)

    def solve(self, x: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return self.values @ x

    def variance(self) -> Float[Array, " basis"]:
        diagonal: Array = jnp.diagonal(self.values)
        return diagonal

    # With L L^T the covariance, Gamma is L^-1, so that its inverse needs no solve.

    def seen(self, j: Float[Array, "k basis"]) -> Float[Array, "k basis"]:
        return j @ cholesky(self.values, lower=True)

    def image(self, z: Float[Array, "basis ..."]) -> Float[Array, "basis ..."]:
        return cholesky(self.values, lower=True) @ z

    def residual(self, x: Float[Array, " basis"]) -> Float[Array, " rows"]:
        return solve_triangular(cholesky(self.values, lower=True), x, lower=True)


class AbstractPrior(AbstractChoice):
    """A choice of R.  A new prior is one class in a module of this room; `PRIORS` finds it there.

    ``follows_image``: whether R depends on the image; such a prior needs a method that asks for R at each image.
    ``diagonal``: whether R is diagonal, as `SparseBayes` needs; None: what `precision` returns tells.
    """

    follows_image: ClassVar[bool] = False
    diagonal: ClassVar[bool | None] = None

    @abstractmethod
    def precision(
        self, jacobian: Float[Array, "k basis"], picture: Picture, at: Float[Array, " basis"] | None = None
    ) -> AbstractPrecision:
        """R for images that lie like this.

        Args:
            jacobian: of whitened readings; of it only sums over the readings may be used, ``J^T J``.
            at: the present image, for a prior that is not quadratic (`TotalVariation`); default: no image yet.
        """


class Noser(AbstractPrior):
    """``R = diag(J^T J)^p``: pixels to which the readings are hardly sensitive are not amplified.

    Newton's One-Step Error Reconstructor (Cheney et al. 1990); the exponent as in Adler and Guardo.
    Pixels without any sensitivity (corners, under a bolt) are floored at ``floor`` of the largest.

    | meaning  | default | range    |
    |----------|---------|----------|
    | exponent | 0.5     | 0 to 1   |
    | floor    | 1e-3    | to 1     |
    """

    diagonal: ClassVar[bool | None] = True
    exponent: float = limited(0.5, least=0, most=1)
    floor: float = limited(1e-3, above=0, most=1)

    def precision(
        self, jacobian: Float[Array, "k basis"], picture: Picture, at: Float[Array, " basis"] | None = None
    ) -> Diagonal:
        square = jnp.sum(jacobian**2, 0)
        seen = square > 0  # elsewhere the power has no derivative, and its floor counts
        unseen = jnp.zeros((), square.dtype) ** jax.lax.stop_gradient(self.exponent)
        power = jnp.where(seen, jnp.where(seen, square, 1) ** self.exponent, unseen)
        return Diagonal(jnp.maximum(power, self.floor * jnp.max(power)))


class Tikhonov(AbstractPrior):
    """``R = diag(area)``: the same penalty per unit of area everywhere, whatever the mesh."""

    diagonal: ClassVar[bool | None] = True

    def precision(
        self, jacobian: Float[Array, "k basis"], picture: Picture, at: Float[Array, " basis"] | None = None
    ) -> Diagonal:
        return Diagonal(_areas(picture))


class Laplace(AbstractPrior):
    """``R = D^T D`` with the differences D between neighbours: smooth images, of any level.

    A constant costs nothing in D; ``floor`` of the mean diagonal is added so that R stays definite (the prior of
    EIDORS' `prior_laplace`, whose R is the graph Laplacian as here).
    """

    diagonal: ClassVar[bool | None] = False
    floor: float = limited(1e-3, above=0)

    def precision(
        self, jacobian: Float[Array, "k basis"], picture: Picture, at: Float[Array, " basis"] | None = None
    ) -> Precision:
        return Precision(_laplacian(picture, jnp.ones(len(picture.edges), picture.areas.dtype), self.floor))


@verb
def _smooth_field(centres: Float[Array, "pixels 2"], length: Float[Array, ""], nugget: Float[Array, ""]) -> Array:
    """Covariance of a Gaussian random field of variance one, with the pixels' own variance."""
    square = jnp.sum((centres[:, None] - centres) ** 2, -1)
    return jnp.exp(-0.5 * square / length**2) + nugget * jnp.eye(len(square), dtype=square.dtype)


class GaussianSmooth(AbstractPrior):
    """The image is a Gaussian random field: ``(R^-1)_ij = s_i s_j exp(-|r_i - r_j|^2 / (2 length^2))``.

    The covariance form of EIDORS' Gaussian high-pass prior.  With ``noser`` the standard deviations are those of
    `Noser` (exponent 0.5), so that the rim and the electrodes are treated alike; else s = 1.

    | meaning                                                     | default | unit |
    |-------------------------------------------------------------|---------|------|
    | length over which the image is alike                        | 0.01    | m    |
    | nugget: variance of each pixel's own, of that of the field  | 1e-3    |      |
    | noser                                                       | False   |      |
    """

    diagonal: ClassVar[bool | None] = False
    length: float = limited(0.01, above=0, most=LONGEST)
    nugget: float = limited(1e-3, above=0)
    noser: bool = eqx.field(static=True, default=False)

    def precision(
        self, jacobian: Float[Array, "k basis"], picture: Picture, at: Float[Array, " basis"] | None = None
    ) -> Covariance:
        dtype = picture.centres.dtype
        field = _smooth_field(picture.centres, jnp.asarray(self.length, dtype), jnp.asarray(self.nugget, dtype))
        if not self.noser:
            return Covariance(field)
        std = 1 / jnp.sqrt(Noser().precision(jacobian, picture).values)
        return Covariance(std[:, None] * field * std)


class TotalVariation(AbstractPrior):
    """``sum over edges of length * sqrt((x_i - x_j)^2 + beta^2)``: few jumps, and flat parts between them.

    Minimised by iteratively reweighted least squares, with ``R = D^T diag(length / sqrt((D x)^2 + beta^2)) D`` at an
    image x (Vogel and Oman 1996).  ``beta``, as a fraction of the largest value of the image, keeps the penalty smooth
    where x is flat.  ``floor`` of the mean diagonal is added so that R stays definite.
    """

    follows_image: ClassVar[bool] = True
    diagonal: ClassVar[bool | None] = False
    beta: float = limited(1e-2, above=0)
    floor: float = limited(1e-3, above=0)

    def precision(
        self, jacobian: Float[Array, "k basis"], picture: Picture, at: Float[Array, " basis"] | None = None
    ) -> Precision:
        if at is None:
            return Precision(_laplacian(picture, picture.edge_length, self.floor))
        first, second = picture.edges.T
        step, top = at[first] - at[second], jnp.max(jnp.abs(at))
        top = jnp.where(top > 0, top, 1)
        weight = picture.edge_length / jnp.sqrt((step / top) ** 2 + self.beta**2)
        return Precision(_laplacian(picture, weight, self.floor))


def _areas(picture: Picture) -> Float[Array, " basis"]:
    return jnp.maximum(picture.areas, 1e-3 * jnp.max(picture.areas))


def _laplacian(
    picture: Picture, weight: Float[Array, " edges"], floor: Float[Array, ""] | float
) -> Float[Array, "basis basis"]:
    """``D^T diag(weight) D``, with ``floor`` of its mean diagonal added."""
    first, second = picture.edges.T
    r = jnp.zeros((picture.size, picture.size), weight.dtype)
    r = r.at[first, first].add(weight).at[second, second].add(weight)
    r = r.at[first, second].add(-weight).at[second, first].add(-weight)
    mean = jnp.trace(r) / picture.size
    return r + floor * jnp.where(mean > 0, mean, 1) * jnp.eye(picture.size, dtype=weight.dtype)


PRIORS = Registry(AbstractPrior, "prior", "jaxeit.priors")
"""Priors by the names that the command line and recipes use."""
