"""How the readings of a step are computed from the conductivity of the sheet: solved, or from slopes."""

from abc import abstractmethod
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

import jaxeit as je

from .contacts import SimulatorError


class AbstractFrames(eqx.Module):
    """From the conductivity of the sheet to the readings of a frame."""

    @abstractmethod
    def prepared(self, model: je.Model) -> "AbstractFrames":
        """With all that the untouched sheet determines computed in advance.

        Raises:
            SimulatorError: for a scene that this cannot compute.
        """

    @abstractmethod
    def __call__(
        self, model: je.Model, sigma: Float[Array, " elements"] | je.model.CoatedSheet
    ) -> Float[Array, " readings"]:
        """Readings, (readings,) V, of a conductivity (elements,) S or a coated sheet."""


class Solved(AbstractFrames):
    """Every frame is a solution of the sheet; exact up to the fidelity.

    Example:
        # the default
        exact = simulators.prepare_skin(scene, 50.0, je.Fidelity.draft(), simulators.Solved())
    """

    def prepared(self, model: je.Model) -> "Solved":
        return self

    def __call__(
        self, model: je.Model, sigma: Float[Array, " elements"] | je.model.CoatedSheet
    ) -> Float[Array, " readings"]:
        return je.forward(model, sigma)


class Polarised(AbstractFrames):
    """Frames from the slopes of the untouched sheet: a product with a matrix in place of a solution.

    ``v = v0 + J (2 sigma0 (k - 1) / (k + 1))`` with k = sigma / sigma0 and the Jacobian J at sigma0. A disc whose
    conductivity is k times that around it disturbs an even field like the dipole 2 (k - 1) / (k + 1) times its area
    (Maxwell 1873, in two dimensions), and like k - 1 only to first order. With one to three contacts on the testbed,
    the change of the readings is off by 1 % at 3 N each, 2 % at 8 N and 3 % at 15 N, where the first order is off by 6,
    12 and 19 %. Contacts that are no round spots, or near each other, are less exact.

    | meaning                                                | shape                | unit |
    |--------------------------------------------------------|----------------------|------|
    | resting: readings of the untouched sheet               | (readings,)          | V    |
    | background: conductivity of the untouched sheet        | (elements,)          | S    |
    | slopes of the readings in the conductivity             | (readings, elements) | V/S  |
    """

    resting: Float[Array, " readings"] | None = None
    background: Float[Array, " elements"] | None = None
    slopes: Float[Array, "readings elements"] | None = None

    def prepared(self, model: je.Model) -> "Polarised":
        if model.coat is not None:
            raise SimulatorError("Polarised computes one sheet, and the scene has a coat of metal; choose Solved")
        background = je.conductivity(model)
        resting, slopes = je.forward(model, background), je.jacobian(model, background)
        return replace(self, resting=resting, background=background, slopes=slopes)

    def __call__(
        self, model: je.Model, sigma: Float[Array, " elements"] | je.model.CoatedSheet
    ) -> Float[Array, " readings"]:
        if not isinstance(sigma, jax.Array) or self.resting is None or self.background is None or self.slopes is None:
            raise SimulatorError("Polarised is not prepared; prepare_skin does so")
        ratio = sigma / self.background
        dipole = 2 * self.background * (ratio - 1) / (ratio + 1)
        found: Float[Array, " readings"] = self.resting + jnp.dot(self.slopes, dipole)
        return found
