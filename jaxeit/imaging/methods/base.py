"""Interfaces of the linear and the iterative methods of reconstruction, and the whitened problem that both solve."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...model.bases import Picture
from ...registry import AbstractChoice
from ..inputs import InverseError
from ..priors import AbstractPrecision, AbstractPrior


class Problem(eqx.Module):
    """A linearised problem in whitened readings.

    | meaning                                            | shape      | unit |
    |----------------------------------------------------|------------|------|
    | jacobian                                           | (k, basis) | 1/S  |
    | readings: number of readings that the k numbers represent | ()  |      |
    | hyperparameter                                     | ()         |      |
    | prior, and the picture it is for                   |            |      |
    """

    jacobian: Float[Array, "k basis"]
    readings: Float[Array, ""]
    hyperparameter: Float[Array, ""]
    prior: AbstractPrior
    picture: Picture

    def precision(self, at: Float[Array, " basis"] | None = None) -> AbstractPrecision:
        """R; see `AbstractPrior.precision`."""
        found = self.prior.precision(self.jacobian, self.picture, at)
        returns = f"{type(self.prior).__name__}.precision returns"
        if not isinstance(found, AbstractPrecision):
            given = "an array" if hasattr(found, "shape") else type(found).__name__
            raise InverseError(f"{returns} {given}; return jaxeit.imaging.Diagonal(values), or Precision(matrix)")
        size = len(getattr(found, "values", self.picture.areas))
        if size != len(self.picture.areas):
            raise InverseError(
                f"{returns} {type(found).__name__} of {size} values; the image has {len(self.picture.areas)}"
            )
        return found

    def strength(self, gained: Float[Array, "basis k"]) -> Float[Array, ""]:
        """``l^2``, given ``R^-1 J^T``."""
        return self.hyperparameter**2 * jnp.sum(self.jacobian.T * gained) / self.readings

    def level(self, seen: Float[Array, "k n"]) -> Float[Array, ""]:
        """``l``, given ``J Gamma^-1``; no square of the hyperparameter is formed."""
        return self.hyperparameter * jnp.sqrt(jnp.sum(seen**2) / self.readings)


class AbstractMethod(AbstractChoice):
    """A choice of method: an `AbstractLinearMethod` or an `AbstractIterativeMethod`.

    ``follows_prior``: whether the method evaluates the prior again at each image, as `TotalVariation` needs.
    ``needs_diagonal_prior``: whether the R of the prior must be diagonal, as `Noser` and `Tikhonov` have it.
    """

    follows_prior: ClassVar[bool] = False
    needs_diagonal_prior: ClassVar[bool] = False


class AbstractLinearMethod(AbstractMethod):
    """A method whose image is a matrix Q times the readings."""

    @abstractmethod
    def image(self, problem: Problem, y: Float[Array, "k ..."]) -> Float[Array, "basis ..."]:
        """``Q y``, (basis, m) S: the images of m whitened frames, (k, m), one in each column."""

    def variance(self, problem: Problem) -> Float[Array, " basis"]:
        """Posterior variance of each coefficient, (basis,) S^2, for noise of unit variance; infinite if unknown."""
        return jnp.full_like(problem.picture.areas, jnp.inf)


class AbstractIterativeMethod(AbstractMethod):
    """A method that solves a problem for each frame, in a limited number of steps."""

    @abstractmethod
    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        """The image, (basis,) S, of one whitened frame, (k,)."""
