"""Absolute images through the full forward map: the logarithm of the conductivity, found in several steps.

For absolute readings, or changes too large for one linear step: `gauss_newton` with any penalty, `least_squares_image`
with a quadratic one and any least-squares solver of optimistix.  A difference of frames is imaged by adding it to the
voltages that the model gives for the reference: ``readings = physics.voltages(0) + dv``.
"""

from abc import abstractmethod
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..._compile import full_precision, verb
from ...least_squares import ImplicitStep, LeastSquaresState, LevenbergMarquardt, normal_equations, quadratic
from ...least_squares.levenberg_marquardt import gauss_newton_solver
from ...least_squares.searches import HalfSquares
from ...model.bases import BasisMap, Picture
from ...model.discretisation import Model
from ...model.forward_model import forward, terminal_matrix, voltages
from ...model.sensitivity import field_jacobian, scaled_jacobian, solved_fields
from ...registry import AbstractChoice, limited
from ..inputs import InverseError, require_real
from ..priors import AbstractPrecision
from .frames import checked_errors, require_steps

IMAGE_STEPS, IMAGE_TOLERANCE = 12, 2e-3
"""Largest number of steps of a fit through the full forward map, and the fall of its objective that is next to nothing,
over the objective."""


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
        """Conductivity of the elements, (elements,) S, of an image x, (basis,)."""
        return self.background * jnp.exp(self.image.expand(x))

    def voltages(self, x: Float[Array, " basis"]) -> Float[Array, " readings"]:
        """Readings, (readings,) V, of an image x, (basis,)."""
        return forward(self.model, self.sigma(x))

    def slopes(self, x: Float[Array, " basis"]) -> Float[Array, "readings basis"]:
        """Derivative of the readings with respect to the image, V: each element's share times its conductivity."""
        sigma = self.sigma(x)
        return scaled_jacobian(self.model, sigma, self.image, sigma)

    def linearised(self, x: Float[Array, " basis"]) -> tuple[Float[Array, " readings"], Float[Array, "readings basis"]]:
        """`voltages` and `slopes` of an image x, (basis,), from one factorisation."""
        sigma = self.sigma(x)
        theta, found = solved_fields(self.model, sigma)
        readings = voltages(self.model, terminal_matrix(self.model, theta, found))
        return readings, field_jacobian(self.model, theta, found, self.image, sigma)


class AbstractPenalty(AbstractChoice):
    """The penalty that a prior puts on an image, a number without unit."""

    @abstractmethod
    def value(self, picture: Picture, x: Float[Array, " basis"]) -> Float[Array, ""]:
        """The penalty of an image x, (basis,)."""

    @abstractmethod
    def matrix(self, picture: Picture, x: Float[Array, " basis"]) -> Float[Array, "basis basis"]:
        """R, (basis, basis), where ``R x`` is the gradient of the penalty at x."""


class Quadratic(AbstractPenalty):
    """``strength / 2 * x^T R x`` for the R of any prior, from `AbstractPrior.precision`."""

    precision: AbstractPrecision
    strength: Float[Array, ""] = limited(1.0, above=0, converter=jnp.asarray)

    def value(self, picture: Picture, x: Float[Array, " basis"]) -> Float[Array, ""]:
        return 0.5 * self.strength.astype(x.dtype) * x @ self.precision.times(x)

    def matrix(self, picture: Picture, x: Float[Array, " basis"]) -> Float[Array, "basis basis"]:
        return self.strength.astype(x.dtype) * self.precision.matrix()


class IsotropicVariation(AbstractPenalty):
    """``weight / L * integral of sqrt(|grad x|^2 + (beta / h)^2)`` over pixels of side h, with L the root of the area
    of the image: piecewise constant images whose edges may lie in any direction (Rudin, Osher and Fatemi 1992), plus
    ``ridge / 2 * |x|^2`` that keeps it definite.

    All have no unit, so that they mean the same in tanks of any size. The default suits errors of 1 to 5 % of a reading
    of some thousands; it is 350 per metre in the tank of the Kuopio challenge, whose L is 0.204 m. Where fewer readings
    tell less, more weight leaves less of their noise.

    | meaning                                                           |
    |-------------------------------------------------------------------|
    | weight: penalty of an edge of height 1 through the whole image    |
    | beta: jumps below it are smoothed over                            |
    | ridge                                                             |
    """

    weight: Float[Array, ""] = limited(71.0, least=0, converter=jnp.asarray)
    beta: Float[Array, ""] = limited(0.05, above=0, converter=jnp.asarray)
    ridge: Float[Array, ""] = limited(1e-3, least=0, converter=jnp.asarray)

    @full_precision
    def value(self, picture: Picture, x: Float[Array, " basis"]) -> Float[Array, ""]:
        weight, size, _ = self._jumps(picture, x)
        return weight * jnp.sum(size) + 0.5 * self.ridge.astype(x.dtype) * x @ x

    def matrix(self, picture: Picture, x: Float[Array, " basis"]) -> Float[Array, "basis basis"]:
        """The quadratic that touches the penalty at x from above (Vogel and Oman 1996)."""
        weight, size, (first, second) = self._jumps(picture, x)
        w = weight / size[first]
        r = self.ridge.astype(x.dtype) * jnp.eye(len(x), dtype=x.dtype)
        r = r.at[first, first].add(w).at[second, second].add(w)
        return r.at[first, second].add(-w).at[second, first].add(-w)

    def _jumps(
        self, picture: Picture, x: Float[Array, " basis"]
    ) -> tuple[Float[Array, ""], Float[Array, " basis"], tuple[Int[Array, " edges"], Int[Array, " edges"]]]:
        """Weight of a jump between pixels; size of each pixel's jump to its neighbours on one side, smoothed by beta;
        the pairs."""
        first, second = jnp.sort(picture.edges, 1).T
        square = jnp.zeros_like(x).at[first].add((x[second] - x[first]) ** 2)
        side = jnp.sqrt(jnp.max(picture.areas) / jnp.sum(picture.areas))
        size = jnp.sqrt(square + self.beta.astype(x.dtype) ** 2)
        return self.weight.astype(x.dtype) * side, size, (first, second)


def gauss_newton(
    physics: LogConductivity,
    penalty: AbstractPenalty,
    readings: Float[Array, " readings"],
    std: Float[Array, " readings"],
    *,
    steps: int = IMAGE_STEPS,
    tolerance: float = IMAGE_TOLERANCE,
) -> Float[Array, " basis"]:
    """argmin over x of ``|(readings - voltages(x)) / std|^2 / 2 + penalty(x)``, from x = 0.

    Each step computes the Jacobian and the penalty's matrix at the present image, and is halved until the sum falls.
    The last step is the one that promises a fall of less than ``tolerance`` of the sum. If no step within ``steps`` is
    small enough, the image after the last of them is returned: its sum is the least so far, and may be far from the
    minimum. `gauss_newton_fit` says whether that is so.

    Readings that are not finite, and readings whose error is not, are left out.

    Works under `jax.jit`, `jax.vmap` and `jax.grad`. Derivatives are those of the exact minimum (`ImplicitStep`):
    precise derivatives need a small tolerance. Errors of zero or less that JAX hides leave their readings out.

    Args:
        readings, std: the readings and their standard errors, V.
        steps: largest number of steps; each halving is one.

    Raises:
        InverseError: if a shape or a value is wrong, such as a ``std`` of zero.

    Example:
        physics = je.imaging.LogConductivity(model, coarse, model.background.mean())
        # log of a ratio
        x = je.gauss_newton(physics, je.imaging.IsotropicVariation(), v0 + dv, noise, steps=3)
        sigma = physics.sigma(x)  # S, of each element
    """
    return gauss_newton_fit(physics, penalty, readings, std, steps=steps, tolerance=tolerance).image


class ImageFit(NamedTuple):
    """What `gauss_newton_fit` finds.

    | meaning                                                                                      | shape    |
    |----------------------------------------------------------------------------------------------|----------|
    | image: logarithm of the conductivity over the background's                                   | (basis,) |
    | converged: whether the last step was next to nothing; if not, the number of steps ended the fit | ()    |
    """

    image: Float[Array, " basis"]
    converged: Bool[Array, ""]


def gauss_newton_fit(
    physics: LogConductivity,
    penalty: AbstractPenalty,
    readings: Float[Array, " readings"],
    std: Float[Array, " readings"],
    *,
    steps: int = IMAGE_STEPS,
    tolerance: float = IMAGE_TOLERANCE,
) -> ImageFit:
    """`gauss_newton`, and whether it converged. Arguments and errors are the same.

    Example:
        fit = je.imaging.gauss_newton_fit(physics, je.imaging.IsotropicVariation(), v0 + dv, noise)
        print(fit.image.max(), "at the minimum" if fit.converged else "after the last step allowed")
    """
    require_steps(steps, tolerance)
    posterior = _image_posterior(physics, penalty, readings, std)
    start = jnp.zeros(physics.image.size, posterior.readings.dtype)
    x, state = most_probable(posterior, start, steps, tolerance)
    return ImageFit(x, state.converged)


class AbstractPosterior(eqx.Module):
    """Minus the logarithm of a posterior probability, as half a sum of squares: what `most_probable` minimises."""

    @abstractmethod
    def residual(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """Of which half the sum of squares is minimised."""

    @abstractmethod
    def quadratic(self, x: Float[Array, " n"]) -> HalfSquares:
        """Gauss and Newton's quadratic near x."""


class ImagePosterior(AbstractPosterior):
    """Minus the logarithm of the posterior probability of an image x, as half a sum of squares."""

    physics: LogConductivity
    penalty: AbstractPenalty
    readings: Float[Array, " readings"]
    weight: Float[Array, " readings"]

    def residual(self, x: Float[Array, " basis"]) -> Float[Array, " readings_and_one"]:
        """The weighted misfits, and a number of which half the square is the penalty plus 1/2, whose root is smooth."""
        missed = self.weight * (self.readings - self.physics.voltages(x))
        return jnp.append(missed, jnp.sqrt(1 + 2 * self.penalty.value(self.physics.image.picture, x)))

    def quadratic(self, x: Float[Array, " basis"]) -> HalfSquares:
        """Gauss and Newton's quadratic of the misfits, plus that of the penalty's matrix."""
        picture = self.physics.image.picture
        found, slopes = self.physics.linearised(x)
        data = normal_equations(self.weight * (self.readings - found), -self.weight[:, None] * slopes)
        matrix = self.penalty.matrix(picture, x)
        value = data.f + self.penalty.value(picture, x)
        return quadratic(value, data.grad + matrix @ x, data.hessian.matrix + matrix)


def _image_posterior(
    physics: LogConductivity,
    penalty: AbstractPenalty,
    readings: Float[Array, " readings"],
    std: Float[Array, " readings"],
) -> ImagePosterior:
    """The posterior of an image, from readings and their errors, V; raises InverseError for what are none."""
    require_real(readings=readings)
    values = jnp.asarray(readings)
    if values.shape != (physics.model.readings,):
        raise InverseError(
            f"readings has shape {values.shape}; give the {physics.model.readings} readings of one frame"
        )
    weight, values = reading_weights(values, checked_errors("std", std, values))
    return ImagePosterior(physics, penalty, values, weight)


@verb
def most_probable(
    posterior: AbstractPosterior, start: Float[Array, " n"], steps: int, tolerance: float, *, damped: bool = False
) -> tuple[Float[Array, " n"], LeastSquaresState]:
    """The x of largest posterior probability, by Gauss and Newton's method as `gauss_newton` describes it; and where
    the fit stands then, whose quadratic is that before the last step, and whose ``converged`` says whether this step
    was next to nothing. If not, x is the best that was found in so many steps.

    With ``damped`` by Levenberg and Marquardt's, where the quadratic holds for small steps only.
    """
    solver = LevenbergMarquardt(0.0, 0.0, fall_rtol=tolerance) if damped else gauss_newton_solver(tolerance)
    found: optx.Solution[Array, Any] = optx.least_squares(
        lambda x, posterior: posterior.residual(x),
        solver,
        start,
        posterior,
        {"quadratic": lambda x, posterior: posterior.quadratic(x)},
        max_steps=steps + 1,  # the first evaluates the start
        adjoint=ImplicitStep(),
        throw=False,
    )
    return found.value, found.state


@verb
def reading_weights(
    readings: Float[Array, "*frames readings"], std: Float[Array, "*frames readings"]
) -> tuple[Float[Array, "*frames readings"], Float[Array, "*frames readings"]]:
    """One over the noise, and the readings; both 0 where a reading or its noise is not finite, or the noise is zero."""
    used = jnp.isfinite(readings) & jnp.isfinite(std) & (std > 0)
    return jnp.where(used, 1 / jnp.where(used, std, 1), 0), jnp.where(used, readings, 0)


def least_squares_image(
    physics: LogConductivity,
    penalty: Quadratic,
    readings: Float[Array, " readings"],
    std: Float[Array, " readings"],
    *,
    solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any] | None = None,
    steps: int = 64,
) -> Float[Array, " basis"]:
    """argmin over x of ``|(readings - voltages(x)) / std|^2 / 2 + penalty(x)``, from x = 0, by `optimistix`.

    For ``z = strength^1/2 Gamma x`` with ``R = Gamma^T Gamma`` this is a sum of squares. Readings that are not finite
    are left out.

    Args:
        readings, std: the readings and their standard errors, V.
        solver: of optimistix; default: `LevenbergMarquardt`, to a millionth (float32: a thousandth).
        steps: largest number of steps.

    Returns:
        (basis,); NaN throughout if the solver did not converge.

    Raises:
        InverseError: if a shape or a value is wrong, such as a ``std`` of zero.

    Example:
        prior = je.Tikhonov().precision(physics.slopes(jnp.zeros(coarse.size)), coarse.picture)
        x = je.imaging.least_squares_image(
            physics, je.imaging.Quadratic(prior, strength=1.0), v0 + dv, noise
        )
    """
    require_steps(steps)
    posterior = _image_posterior(physics, penalty, readings, std)
    tolerance = 1e-6 if posterior.readings.dtype == jnp.float64 else 1e-3
    solver = LevenbergMarquardt(tolerance, tolerance) if solver is None else solver
    return _solved(posterior, solver, steps)


@verb
def _solved(
    posterior: ImagePosterior, solver: optx.AbstractLeastSquaresSolver[Any, Any, Any, Any], steps: int
) -> Float[Array, " basis"]:
    def image(z: Float[Array, " rows"], penalty: Quadratic) -> Float[Array, " basis"]:
        return penalty.precision.image(z) / jnp.sqrt(penalty.strength.astype(z.dtype))

    def residual(z: Float[Array, " rows"], posterior: ImagePosterior) -> Float[Array, " residuals"]:
        x = image(z, cast(Quadratic, posterior.penalty))
        missed = posterior.weight * (posterior.readings - _voltages(x, posterior.physics))
        return jnp.concatenate([missed, z])

    found: optx.Solution[Array, Any] = optx.least_squares(
        residual,
        solver,
        jnp.zeros(posterior.physics.image.size, posterior.readings.dtype),
        posterior,
        max_steps=steps,
        adjoint=ImplicitStep(),
        throw=False,
    )
    converged = found.result == optx.RESULTS.successful
    return jnp.where(converged, image(found.value, cast(Quadratic, posterior.penalty)), jnp.nan)


@eqx.filter_custom_jvp
def _voltages(x: Float[Array, " basis"], physics: LogConductivity) -> Float[Array, " readings"]:
    return physics.voltages(x)


@full_precision
def _voltages_jvp(
    primals: tuple[Float[Array, " basis"], LogConductivity], tangents: tuple[Float[Array, " basis"] | None, Any]
) -> tuple[Float[Array, " readings"], Float[Array, " readings"]]:
    """By the Jacobian: a solver that needs all its columns would otherwise compute them one by one."""
    x, physics = primals
    value, of_physics = eqx.filter_jvp(lambda physics: physics.voltages(x), (physics,), (tangents[1],))
    of_image = None if tangents[0] is None else physics.slopes(x) @ tangents[0]
    changes = [change for change in (of_image, of_physics) if change is not None]
    return value, sum(changes, start=jnp.zeros_like(value))


_voltages.def_jvp(_voltages_jvp)
