"""Where the electrodes sit, found from what the skin reads: misplaced bolts cost a skin more than an uneven coat.

An untouched frame tells the shifts of the electrodes apart from the coat of the sheet only in part, since both are
smooth. Presses at known places tell the rest: each is a bump of conductivity whose place is known, and whose strength
and width are not. Unknown are, all Gaussian before the readings are seen,

- the shift of each electrode;
- the logarithm of the conductivity of the untouched sheet, a smooth field;
- the logarithm of the gain of the contact layer, a smooth field, which the presses have in common;
- the logarithms of strength and width of each press.

The most probable ones are found by Gauss and Newton's method through the full forward map (`most_probable`), and the
covariance of the shifts is that of the curvature there, with all else marginalised.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from ..._compile import require_known, verb
from ...least_squares import LeastSquaresState, normal_equations, quadratic
from ...least_squares.searches import HalfSquares, normal_inverse
from ...model.bases import BasisMap, Pixels
from ...model.discretisation import Model
from ...model.forward_model import fields, forward, terminal_matrix, voltages
from ...model.motion import Motion, electrode_motion, field_shift_jacobian, moved
from ...model.sensitivity import field_jacobian, field_slope, scaled_jacobian
from ...model.sheet_conductivity import coefficients
from ...registry import AbstractChoice, limited
from ...registry.limits import LONGEST
from ..inputs import InverseError
from ..priors import GaussianSmooth
from .background import COATING_LENGTH, COATING_STD
from .frames import checked_frame, frame_error, sheet_level
from .images import IMAGE_STEPS, IMAGE_TOLERANCE, AbstractPosterior, most_probable, reading_weights

STRENGTH_STD = 1.0  # of the logarithm of a press's strength, whose first value comes from its readings
WIDTH_STD = 0.3  # of the logarithm of a press's width
FLATNESS_STD = 0.5  # of the logarithm of the exponent over that of a Gaussian


class ElectrodeFitSettings(AbstractChoice):
    """Assumptions before the readings are seen.

    | meaning                                                              | default | unit |
    |----------------------------------------------------------------------|---------|------|
    | shift: standard deviation of an electrode's shift, in each direction | 1e-3    | m    |
    | coat_std, coat_length: of the logarithm of the conductivity          | 0.15, 0.03 | 1, m |
    | gain_std, gain_length: of the logarithm of the contact layer's gain  | 0.12, 0.015 | 1, m |
    | width: standard deviation of the bump of a press                     | 0.012   | m    |
    | model_error: of each reading of the untouched frame, relative        | 3e-3    | 1    |
    | press_error: of each change by a press, relative to its size         | 3e-2    | 1    |
    | columns: pixels of both fields along x                               | 20      |      |
    """

    shift: float = limited(1e-3, above=0, most=LONGEST)
    coat_std: float = limited(COATING_STD, above=0)
    coat_length: float = limited(COATING_LENGTH, above=0, most=LONGEST)
    gain_std: float = limited(0.12, above=0)
    gain_length: float = limited(0.015, above=0, most=LONGEST)
    width: float = limited(0.012, above=0, most=LONGEST)
    model_error: float = limited(3e-3, above=0)
    press_error: float = limited(3e-2, above=0)
    columns: int = limited(20, least=2, static=True)


class KnownPresses(eqx.Module):
    """Presses of one finger or tip at places that a stage tells.

    | meaning                                                            | shape               | unit |
    |--------------------------------------------------------------------|---------------------|------|
    | change of the readings by each press; NaN: missing                 | (presses, readings) | V    |
    | place of each, in the sheet's flat coordinates                     | (presses, 2)        | m    |
    | noise: standard deviation of a change                              | (readings,)         | V    |

    Example:
        change, place = dv[None], jnp.array([[0.06, 0.13]])  # V, m; give ten to forty presses
        presses = je.imaging.KnownPresses(change, place, noise)
    """

    change: Float[Array, "presses readings"] = eqx.field(converter=jnp.asarray)
    place: Float[Array, "presses 2"] = eqx.field(converter=jnp.asarray)
    noise: Float[Array, " readings"] = eqx.field(converter=jnp.asarray)


class ElectrodeFit(eqx.Module):
    """Where the electrodes sit.

    | meaning                                                                    | shape            | unit |
    |----------------------------------------------------------------------------|------------------|------|
    | shift of each electrode from its place in the skin                         | (electrodes, 2)  | m    |
    | covariance of all shifts, those of an electrode side by side               | (2 electrodes, 2 electrodes) | m^2 |
    | sigma: conductivity of the untouched sheet, on the mesh that is moved along | (elements,)      | S    |
    | misfit: root mean square of what is left of the readings, in their errors  | ()               | 1    |
    | converged: whether the fit ended before its twelve steps did; if not, shifts may err by more than stated | () | |
    """

    shift: Float[Array, "electrodes 2"]
    covariance: Float[Array, "both both"]
    sigma: Float[Array, " elements"]
    misfit: Float[Array, ""]
    converged: Bool[Array, ""]

    @property
    def standard_error(self) -> Float[Array, "electrodes 2"]:
        """Standard error of each shift, (electrodes, 2) m; the deviation before the fit where readings tell nothing."""
        return jnp.sqrt(jnp.diagonal(self.covariance)).reshape(self.shift.shape)


def fit_electrodes(
    model: Model,
    v0: Float[ArrayLike, " readings"],
    presses: KnownPresses | None = None,
    settings: ElectrodeFitSettings | None = None,
) -> ElectrodeFit:
    """Find how far the electrodes sit from where the skin's file says.

    `je.skin.with_positions(skin, skin.electrode_positions + fit.shift)` is the skin as it is.

    Args:
        model: of the skin as its file describes it, with elements of second order: the errors of a mesh of first order
            are larger than those that ``model_error`` states.
        v0: untouched frame, V, best a mean over many; readings that are not finite are left out.
        presses: at known places; some ten to forty, spread over the sheet.

    Raises:
        InverseError: if a shape or a value is wrong.
        MotionError: if the electrodes cannot be moved on this mesh.

    Example:
        second = je.discretise(je.Scene(je.load_skin("testbed")), je.Fidelity.draft(order=2))
        settings = je.imaging.ElectrodeFitSettings(shift=1e-3)  # m
        # better with `presses`, `KnownPresses`
        fit = je.imaging.fit_electrodes(second, frame, settings=settings)
        print(1e3 * fit.shift[0], 1e3 * fit.standard_error[0])  # mm
    """
    require_known("fit_electrodes", InverseError, model.nodes, v0)
    settings = ElectrodeFitSettings() if settings is None else settings
    motion, image = electrode_motion(model), Pixels(settings.columns).on(model)
    even = forward(model)
    frame = checked_frame("v0", v0, even)
    level = sheet_level("v0", frame, even) * model.mean_background
    seen = _no_presses(model) if presses is None else _checked(model, presses)
    weight, known = reading_weights(
        jnp.concatenate([frame[None], seen.change]),
        jnp.concatenate([frame_error(frame, settings.model_error)[None], _press_errors(seen, settings)]),
    )
    strength = _first_strengths(model, image, seen, level, settings)
    prior = _prior(image, model.electrodes, len(strength), settings)
    posterior = _ElectrodePosterior(model, motion, image, level, settings, known, weight, seen.place, strength, prior)
    start = jnp.zeros(posterior.size, model.dtype)
    return _described(posterior, *most_probable(posterior, start, IMAGE_STEPS, IMAGE_TOLERANCE))


def _no_presses(model: Model) -> KnownPresses:
    none = jnp.zeros((0, model.readings), model.dtype)
    return KnownPresses(none, jnp.zeros((0, 2), model.dtype), jnp.ones(model.readings, model.dtype))


def _checked(model: Model, presses: KnownPresses) -> KnownPresses:
    """The presses in the model's precision; raises InverseError if shapes or values are wrong."""
    count, readings = len(presses.place), model.readings
    wanted = {"change": (count, readings), "place": (count, 2), "noise": (readings,)}
    for name, shape in wanted.items():
        if getattr(presses, name).shape != shape:
            raise InverseError(f"presses: {name} has shape {getattr(presses, name).shape}; give {shape}")
    for name in ("place", "noise"):
        if not np.isfinite(getattr(presses, name)).all():
            raise InverseError(f"presses: {name} has a value that is not finite; leave such presses out")
    if not (np.asarray(presses.noise) > 0).all():
        raise InverseError("presses: noise has a value that is not above zero")
    cast: KnownPresses = jax.tree.map(lambda values: values.astype(model.dtype), presses)
    return cast


@verb
def _first_strengths(
    model: Model, image: BasisMap, presses: KnownPresses, level: Float[Array, ""], settings: ElectrodeFitSettings
) -> Float[Array, " presses"]:
    """Logarithm of the relative change of conductivity in the middle of each press, by linear least squares."""
    jacobian = scaled_jacobian(model, None, image, model.background)
    away = jnp.sum((image.picture.centres - presses.place[:, None]) ** 2, -1)
    expected = jnp.exp(-0.5 * away / settings.width**2) @ jacobian.T * (jnp.mean(model.background) / level)
    change = jnp.where(jnp.isfinite(presses.change), presses.change, 0)
    found = jnp.sum(expected * change, 1) / jnp.sum(expected**2, 1)
    return jnp.log(jnp.clip(found, 0.01, 3))


def _press_errors(presses: KnownPresses, settings: ElectrodeFitSettings) -> Float[Array, "presses readings"]:
    """Standard error of each change by a press, V: its noise, and a part of its size."""
    there = jnp.isfinite(presses.change)
    known = jnp.where(there, presses.change, 0)
    count = jnp.maximum(jnp.sum(there, 1, dtype=known.dtype), 1)
    typical = jnp.sqrt(jnp.sum(known**2, 1) / count)
    return jnp.hypot(presses.noise, settings.press_error * jnp.hypot(known, typical[:, None]))


class _Parts(NamedTuple):
    """The unknowns, apart."""

    coat: Float[Array, " basis"]
    shift: Float[Array, "electrodes 2"]  # in standard deviations
    gain: Float[Array, " basis"]
    strength: Float[Array, " presses"]
    width: Float[Array, " presses"]
    flatness: Float[Array, "1"]


@verb
def _prior(image: BasisMap, electrodes: int, presses: int, settings: ElectrodeFitSettings) -> Float[Array, "n n"]:
    """Precision of the unknowns, in the order of `_Parts`, before the readings are seen."""
    kind, n = image.picture.centres.dtype, image.size
    still = jnp.zeros((1, n), kind)
    coat = GaussianSmooth(settings.coat_length).precision(still, image.picture).matrix() / settings.coat_std**2
    gain = GaussianSmooth(settings.gain_length).precision(still, image.picture).matrix() / settings.gain_std**2
    counts = (n, 2 * electrodes, n, presses, presses, 1)
    ones = (0.0, 1.0, 0.0, STRENGTH_STD**-2, WIDTH_STD**-2, FLATNESS_STD**-2)
    whole = jnp.diag(jnp.repeat(jnp.array(ones, kind), np.array(counts), total_repeat_length=sum(counts)))
    after = n + 2 * electrodes
    return whole.at[:n, :n].set(coat).at[after : after + n, after : after + n].set(gain)


class _Press(NamedTuple):
    """A press as the fit has it; the untouched frame is one without strength."""

    place: Float[Array, "2"]
    expected: Float[Array, ""]  # logarithm of its strength at the first value
    strength: Float[Array, ""]
    width: Float[Array, ""]


class _ElectrodePosterior(AbstractPosterior):
    """Minus the logarithm of the posterior probability of all unknowns, as half a sum of squares.

    Frames are the untouched one, and the change by each press.
    """

    model: Model
    motion: Motion
    image: BasisMap
    level: Float[Array, ""]
    settings: ElectrodeFitSettings
    readings: Float[Array, "frames readings"]  # V, zero where missing
    weight: Float[Array, "frames readings"]  # one over the error
    place: Float[Array, "presses 2"]
    strength: Float[Array, " presses"]  # expected
    prior: Float[Array, "n n"]  # precision of all unknowns before the readings are seen

    @property
    def size(self) -> int:
        return len(self.prior)

    def parts(self, x: Float[Array, " n"]) -> _Parts:
        n, e, k = self.image.size, self.model.electrodes, len(self.strength)
        coat, shift, gain, strength, width, flatness = jnp.split(x, np.cumsum([n, 2 * e, n, k, k]))
        return _Parts(coat, shift.reshape(e, 2), gain, strength, width, flatness)

    def sheet(self, parts: _Parts) -> tuple[Model, Float[Array, " elements"]]:
        """The model with its electrodes where they sit, and the conductivity of the untouched sheet."""
        there = moved(self.model, self.motion, self.settings.shift * parts.shift)
        return there, self.level * jnp.exp(self.image.expand(parts.coat))

    def presses(self, parts: _Parts) -> _Press:
        """The presses of all frames."""
        none = _Press(jnp.zeros(2, self.level.dtype), *jnp.array([-jnp.inf, 0, 0], self.level.dtype))
        each = _Press(self.place, self.strength, parts.strength, parts.width)
        whole: _Press = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), none, each)
        return whole

    def bump(
        self, parts: _Parts, press: _Press
    ) -> tuple[Float[Array, " elements"], Float[Array, " elements"], Float[Array, " elements"]]:
        """Relative change of conductivity by a press, and its derivatives by the logarithms of width and exponent."""
        spread = jnp.square(self.settings.width * jnp.exp(press.width))
        away = jnp.maximum(jnp.sum((self.model.centroids - press.place) ** 2, 1) / spread, 1e-6)
        exponent = jnp.exp(parts.flatness)
        fall = 0.5 * away**exponent
        change = jnp.exp(press.expected + press.strength + self.image.expand(parts.gain) - fall)
        return change, 2 * exponent * change * fall, -change * fall * jnp.log(away) * exponent

    def residual(self, x: Float[Array, " n"]) -> Float[Array, " frames_readings_and_one"]:
        """Weighted misfits, and a number of which half the square is the penalty plus 1/2, whose root is smooth."""
        parts = self.parts(x)
        there, sigma = self.sheet(parts)
        found = jax.lax.map(lambda one: forward(there, sigma * (1 + self.bump(parts, one)[0])), self.presses(parts))
        missed = self.weight * (self.readings - found.at[1:].add(-found[0]))
        return jnp.append(missed.ravel(), jnp.sqrt(1 + x @ self.prior @ x))

    def frame(
        self, parts: _Parts, sheet: tuple[Model, Float[Array, " elements"]], number: Int[Array, ""], press: _Press
    ) -> tuple[Float[Array, " readings"], Float[Array, "readings n"]]:
        """Readings under a press, and their slopes in all unknowns; one factorisation serves them all."""
        there, sigma = sheet
        bump, by_width, by_flatness = self.bump(parts, press)
        theta = coefficients(there, sigma * (1 + bump))
        x = fields(there, theta)
        by_shift = self.settings.shift * field_shift_jacobian(there, self.motion, theta, x)
        scales = jnp.stack([theta.sigma, sigma * bump])
        by_coat, by_gain = jax.vmap(partial(field_jacobian, there, theta, x, self.image))(scales)
        by_shape = jax.vmap(partial(field_slope, there, theta, x))(sigma * jnp.stack([by_width, by_flatness]))
        own = (jnp.arange(len(self.strength)) == number - 1).astype(sigma.dtype)
        columns = [
            by_coat,
            by_shift.reshape(len(by_shift), -1),
            by_gain,
            jnp.outer(by_gain.sum(1), own),  # the pixels of an image sum to one everywhere
            jnp.outer(by_shape[0], own),
            by_shape[1][:, None],
        ]
        return voltages(there, terminal_matrix(there, theta, x)), jnp.concatenate(columns, 1)

    def quadratic(self, x: Float[Array, " n"]) -> HalfSquares:
        """Gauss and Newton's quadratic of the misfits, plus that of the prior."""
        parts, prior = self.parts(x), self.prior
        sheet = self.sheet(parts)

        def add(sums: tuple[Any, Any], one: tuple[Any, ...]) -> tuple[tuple[Any, Any], None]:
            (total, still), (number, readings, weight, press) = sums, one
            now = self.frame(parts, sheet, number, press)
            found, slopes = jax.tree.map(jnp.subtract, now, still)
            part = normal_equations(weight * (readings - found), -weight[:, None] * slopes)
            total = jax.tree.map(jnp.add, total, (part.f, part.grad, part.hessian.matrix))
            # The first frame is the untouched one, from which all others are changes.
            still = jax.tree.map(lambda new, old: jnp.where(number == 0, new, old), now, still)
            return (total, still), None

        count, m = self.readings.shape
        zeros = partial(jnp.zeros, dtype=x.dtype)
        none = ((zeros(()), zeros(len(x)), zeros(prior.shape)), (zeros(m), zeros((m, len(x)))))
        frames = (jnp.arange(count), self.readings, self.weight, self.presses(parts))
        ((value, gradient, curvature), _), _ = jax.lax.scan(add, none, frames)
        return quadratic(value + 0.5 * x @ prior @ x, gradient + prior @ x, curvature + prior)


@verb
def _described(posterior: _ElectrodePosterior, x: Float[Array, " n"], state: LeastSquaresState) -> ElectrodeFit:
    parts, shift = posterior.parts(x), posterior.settings.shift
    n, both = posterior.image.size, 2 * posterior.model.electrodes
    solve = normal_inverse(state.quadratic.hessian.matrix, jnp.ones(len(x), bool))
    covariance = solve(jnp.eye(len(x), dtype=x.dtype)[:, n : n + both])[n : n + both]
    used = jnp.sum(posterior.weight > 0, dtype=x.dtype)
    square = jnp.maximum(state.square - x @ posterior.prior @ x, 0)
    return ElectrodeFit(
        shift * parts.shift,
        shift**2 * 0.5 * (covariance + covariance.T),
        posterior.sheet(parts)[1],
        jnp.sqrt(square / jnp.maximum(used, 1)),
        state.converged,
    )
