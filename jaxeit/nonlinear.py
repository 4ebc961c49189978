"""Images by the full forward map: the logarithm of the conductivity, in several steps.

For absolute readings, or changes too large for one linear step: `gauss_newton` with any penalty, `least_squares_image`
with a quadratic one and any least-squares solver of optimistix.  A difference of frames is imaged by adding it to the
voltages that the model gives for the reference: ``readings = physics.voltages(0) + dv``.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from .basis import BasisMap, Picture
from .discretise import Model
from .forward import forward
from .jacobian import scaled_jacobian
from .lapack import cho_factor, cho_solve
from .optimise import LevenbergMarquardt
from .priors import AbstractPrecision


class LogConductivity(eqx.Module):
    """Sheet conductivity as ``background * exp(image)``: positive, whatever the image.

    | meaning                                        | unit |
    |------------------------------------------------|------|
    | model; image: a basis laid over it             |      |
    | background: conductivity where the image is 0  | S    |
    """

    model: Model
    image: BasisMap
    background: Float[Array, ""]

    def sigma(self, x: Float[Array, " basis"]) -> Float[Array, " elements"]:
        """Conductivity of the elements, S."""
        return self.background * jnp.exp(self.image.expand(x))

    def voltages(self, x: Float[Array, " basis"]) -> Float[Array, " readings"]:
        """Readings, V."""
        return forward(self.model, self.sigma(x))

    def slopes(self, x: Float[Array, " basis"]) -> Float[Array, "readings basis"]:
        """Derivative of the readings with respect to the image, V: each element's share times its conductivity."""
        sigma = self.sigma(x)
        return scaled_jacobian(self.model, sigma, self.image, sigma)


class AbstractPenalty(eqx.Module):
    """What an image costs before the readings are seen."""

    @abstractmethod
    def value(self, picture: Picture, x: Float[Array, " basis"]) -> Float[Array, ""]:
        """The penalty."""

    @abstractmethod
    def matrix(self, picture: Picture, x: Float[Array, " basis"]) -> Float[Array, "basis basis"]:
        """R with ``R x`` the gradient of the penalty at x."""


class Quadratic(AbstractPenalty):
    """``strength / 2 * x^T R x`` for the R of any prior, from `AbstractPrior.precision`."""

    precision: AbstractPrecision
    strength: float = 1.0

    def value(self, picture, x):
        return 0.5 * self.strength * x @ self.precision.times(x)

    def matrix(self, picture, x):
        return self.strength * self.precision.matrix()


class IsotropicVariation(AbstractPenalty):
    """``weight * integral of sqrt(|grad x|^2 + (beta / h)^2)`` over pixels of side h: piecewise constant images whose
    edges may lie in any direction (Rudin, Osher and Fatemi 1992), plus ``ridge / 2 * |x|^2`` that keeps it definite.

    | meaning                                     | unit |
    |---------------------------------------------|------|
    | weight                                      | 1/m  |
    | beta: jumps below it are smoothed over      |      |
    | ridge                                       |      |
    """

    weight: float = 350.0
    beta: float = 0.05
    ridge: float = 1e-3

    def value(self, picture, x):
        weight, size, _ = self._jumps(picture, x)
        return weight * jnp.sum(size) + 0.5 * self.ridge * x @ x

    def matrix(self, picture, x):
        """The quadratic that touches the penalty at x from above (Vogel and Oman 1996)."""
        weight, size, (first, second) = self._jumps(picture, x)
        w = weight / size[first]
        r = self.ridge * jnp.eye(len(x), dtype=x.dtype)
        r = r.at[first, first].add(w).at[second, second].add(w)
        return r.at[first, second].add(-w).at[second, first].add(-w)

    def _jumps(self, picture, x):
        """Each pixel's jump to its neighbours on one side along each axis, its size smoothed by beta."""
        first, second = jnp.sort(picture.edges, 1).T
        square = jnp.zeros_like(x).at[first].add((x[second] - x[first]) ** 2)
        side = jnp.sqrt(jnp.max(picture.areas))
        return self.weight * side, jnp.sqrt(square + self.beta**2), (first, second)


def gauss_newton(
    physics: LogConductivity,
    penalty: AbstractPenalty,
    readings: Float[Array, " readings"],
    std: Float[Array, " readings"],
    *,
    steps: int = 12,
    tolerance: float = 2e-3,
) -> Float[Array, " basis"]:
    """argmin over x of ``|(readings - voltages(x)) / std|^2 / 2 + penalty(x)``, from x = 0.

    Each step takes the Jacobian and the penalty's matrix anew, and is halved until the sum falls; it ends where the sum
    falls by less than ``tolerance`` of itself. Readings that are not finite are left out.
    """
    weight, readings = _weighed(readings, std)
    x = jnp.zeros(physics.image.size, readings.dtype)
    value = _objective(physics, penalty, readings, weight, x)
    for _ in range(steps):
        step, before = _direction(physics, penalty, readings, weight, x), value
        tries = ((x + 0.5**n * step) for n in range(5))
        found = ((new, _objective(physics, penalty, readings, weight, new)) for new in tries)
        x, value = next((pair for pair in found if pair[1] < before), (x, before))
        if not before - value > tolerance * before:
            break
    return x


def _weighed(readings, std):
    """One over the noise, 0 where a reading or its noise is not finite, and readings that are."""
    used = jnp.isfinite(readings) & jnp.isfinite(std)
    return jnp.where(used, 1 / std, 0), jnp.where(used, readings, 0)


@eqx.filter_jit
def _objective(physics, penalty, readings, weight, x):
    missed = weight * (readings - physics.voltages(x))
    return 0.5 * missed @ missed + penalty.value(physics.image.picture, x)


@eqx.filter_jit
def _direction(physics, penalty, readings, weight, x):
    j = weight[:, None] * physics.slopes(x)
    missed = weight * (readings - physics.voltages(x))
    r = penalty.matrix(physics.image.picture, x)
    return cho_solve(cho_factor(j.T @ j + r), j.T @ missed - r @ x)


def least_squares_image(
    physics: LogConductivity,
    penalty: Quadratic,
    readings: Float[Array, " readings"],
    std: Float[Array, " readings"],
    *,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    steps: int = 64,
) -> Float[Array, " basis"]:
    """argmin over x of ``|(readings - voltages(x)) / std|^2 / 2 + penalty(x)``, from x = 0, by `optimistix`.

    For ``z = strength^1/2 Gamma x`` with ``R = Gamma^T Gamma`` this is a sum of squares. Readings that are not finite
    are left out.

    Args:
        solver: of optimistix; default: `LevenbergMarquardt`, to a millionth (float32: a thousandth).
        steps: at most.

    Returns:
        (basis,); NaN throughout if the solver did not converge.
    """
    weight, readings = _weighed(jnp.asarray(readings), jnp.asarray(std))
    tolerance = 1e-6 if readings.dtype == jnp.float64 else 1e-3
    return _solved(physics, penalty, readings, weight, solver or LevenbergMarquardt(tolerance, tolerance), steps)


@eqx.filter_jit
def _solved(physics, penalty, readings, weight, solver, steps):
    def image(z):
        return penalty.precision.image(z) / jnp.sqrt(jnp.asarray(penalty.strength, z.dtype))

    def residual(z, _):
        return weight * (readings - _voltages(image(z), physics)), z

    start = jnp.zeros(physics.image.size, readings.dtype)
    found: optx.Solution = optx.least_squares(residual, solver, start, max_steps=steps, throw=False)
    return jnp.where(found.result == optx.RESULTS.successful, image(found.value), jnp.nan)


@eqx.filter_custom_jvp
def _voltages(x, physics):
    return physics.voltages(x)


@_voltages.def_jvp
def _voltages_jvp(primals, tangents):
    """By the Jacobian: a solver that asks for all columns would else make them one by one."""
    x, physics = primals
    return physics.voltages(x), physics.slopes(x) @ tangents[0]
