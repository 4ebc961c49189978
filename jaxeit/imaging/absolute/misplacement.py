"""Whether the electrodes sit where the model has them, told from one untouched frame by a comparison of two beliefs.

Either the coat of the sheet alone makes the frame differ from the model, or the electrodes sit elsewhere too. Linear
about the sheet that explains the frame best, the readings are Gaussian under both beliefs, with the covariance

    K = c^2 J P J' + s^2 S S' + e^2 R + g^2 f f',

where J and S are the derivatives by the logarithm of the conductivity and by the shifts of the electrodes, P is the
correlation of the coat over the sheet, R has the errors of a good model, and f are the readings, whose common gain is
not known: g is large. The standard deviations c of the coat, s of the shifts and e of the errors are the most probable
ones (MacKay 1992, Neural Comput. 4: the evidence), so that an uneven coat or a rough model is not taken for misplaced
electrodes. Under the first belief s is zero. `fit_electrodes` tells the shifts better, through the full forward map,
and takes longer.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from scipy.linalg import eigh

from ..._compile import require_known, verb
from ...model.bases import Pixels
from ...model.discretisation import Model
from ...model.forward_model import Fields, terminal_matrix, voltages
from ...model.motion import Motion, electrode_motion, field_shift_jacobian
from ...model.sensitivity import field_jacobian, solved_fields
from ...model.sheet_conductivity import Coefficients
from ..inputs import InverseError, real_numbers
from .background import (
    COATING_COLUMNS,
    COATING_ERROR,
    COATING_LENGTH,
    COATING_STD,
    coat_precision,
    even_coat,
)
from .frames import frame_error
from .images import LogConductivity, Quadratic, gauss_newton

COAT_SPREAD = 0.7  # of the logarithm of the deviation of the coat
MODEL_ERROR = 1e-3  # relative, of which e is a multiple
LEAST_ERROR = 0.1  # e: derivatives hold no better
MOST_COAT, MOST_SHIFT = 1.0, 5e-3  # c, and s in m; beyond them, derivatives say nothing of a size
# Candidates of c / e, and of s / e in m; a step of 1.4 moves the logarithm of the evidence by less than two.
COATS, SHIFTS = np.geomspace(1e-4, 60, 40), np.append(0, np.geomspace(1e-6, 0.1, 90))


class Misplacement(eqx.Module):
    """How far electrodes seem to sit from where the model has them, by an untouched frame.

    | meaning                                                                             | shape           | unit |
    |-------------------------------------------------------------------------------------|-----------------|------|
    | size: standard deviation of the shifts in each direction; 5 mm: that or more        | ()              | m    |
    | evidence: twice the gain in log probability by shifts; above about 20: they are real | ()             | 1    |
    | shift: the most probable one of each electrode, of shifts of that size              | (electrodes, 2) | m    |
    | standard_error of each shift                                                        | (electrodes, 2) | m    |
    | error: relative error of a reading that neither coat nor shifts explain             | ()              | 1    |
    | unshifted: the same, if no electrode is shifted                                     | ()              | 1    |
    """

    size: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    evidence: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    shift: Float[Array, "electrodes 2"] = eqx.field(converter=jnp.asarray)
    standard_error: Float[Array, "electrodes 2"] = eqx.field(converter=jnp.asarray)
    error: Float[Array, ""] = eqx.field(converter=jnp.asarray)
    unshifted: Float[Array, ""] = eqx.field(converter=jnp.asarray)


def find_misplacement(
    model: Model, v0: Float[ArrayLike, " readings"], noise: Float[ArrayLike, " readings"] | None = None
) -> Misplacement:
    """Tell from an untouched frame whether electrodes sit elsewhere than in the model, and about how far.

    Args:
        v0: untouched frame, V, best a mean over many; readings that are not finite are left out.
        noise: standard deviation of each reading of v0, V; default: none.

    Raises:
        InverseError: if a shape or a value is wrong.
        MotionError: if the electrodes cannot be moved on this mesh.

    Example:
        skin = je.load_skin("testbed")
        places = skin.electrode_positions
        drilled = places + np.random.default_rng(0).normal(0, 1e-3, places.shape)  # m
        real = je.discretise(je.Scene(je.skin.with_positions(skin, drilled)), je.Fidelity.draft())
        doubt = je.imaging.find_misplacement(model, je.forward(real))
        print(f"bolts sit {1e3 * doubt.size:.1f} mm aside; log evidence {0.5 * doubt.evidence:.0f}")
    """
    require_known("find_misplacement", InverseError, model.nodes, v0, noise)
    frame, physics = even_coat("v0", model, v0, Pixels(COATING_COLUMNS).on(model))
    penalty = Quadratic(coat_precision(physics.image, COATING_LENGTH), jnp.asarray(1 / COATING_STD**2))
    coat = gauss_newton(physics, penalty, frame, frame_error(frame, COATING_ERROR))
    linear = _linear(physics, electrode_motion(model), coat, *solved_fields(model, _conductivity(physics, coat)))
    error = np.asarray(frame_error(frame, MODEL_ERROR), float)
    spread = np.zeros_like(error) if noise is None else real_numbers("noise", noise, "V")
    if spread.shape != error.shape or not (spread >= 0).all():
        raise InverseError("noise is not one number of zero or more for each reading of v0; give volts")
    known = np.isfinite(np.asarray(frame))
    by_coat, by_shift, *levels = (np.asarray(part, float)[known] for part in linear)
    at_start, found = levels
    rows = np.hypot(error, spread)[known]
    missed = (np.asarray(frame, float)[known] - at_start) / rows
    return _compared(missed, by_coat / rows[:, None], by_shift / rows[:, None], found / rows)


@verb
def _linear(
    physics: LogConductivity, motion: Motion, coat: Float[Array, " basis"], theta: Coefficients, x: Fields
) -> tuple[
    Float[Array, "readings basis"],
    Float[Array, "readings both"],
    Float[Array, " readings"],
    Float[Array, " readings"],
]:
    """About a coat, from the fields x at its coefficients theta: derivatives of the readings by independent parts of
    the coat, and by all shifts, V and V/m; the readings of an even sheet by these derivatives; and the readings, V."""
    model = physics.model
    by_coat = field_jacobian(model, theta, x, physics.image, theta.sigma)
    by_shift = field_shift_jacobian(model, motion, theta, x)
    found = voltages(model, terminal_matrix(model, theta, x))
    parts = coat_precision(physics.image, COATING_LENGTH).seen(by_coat)
    return parts, by_shift.reshape(len(by_shift), -1), found - by_coat @ coat, found


def _compared(
    y: Float[np.ndarray, " n"],
    by_coat: Float[np.ndarray, "n basis"],
    by_shift: Float[np.ndarray, "n both"],
    by_gain: Float[np.ndarray, " n"],
) -> Misplacement:
    """The more probable beliefs about readings y (n,) and their derivatives, all in errors of a good model.

    In the directions along which the coat moves the readings, its part of K is diagonal for every ratio c / e.
    """
    strengths, along = eigh(by_coat @ by_coat.T)
    of_coat = np.maximum(strengths, 0)
    seen = along.T @ np.column_stack([y, by_shift, by_gain])
    beliefs = [belief for ratio in COATS for belief in _beliefs(ratio, of_coat, seen)]
    unshifted, shifted = (min(beliefs[k::2], key=lambda belief: belief.surprise) for k in (0, 1))
    parts = (
        shifted.size,
        2 * (unshifted.surprise - shifted.surprise),
        shifted.shift.reshape(-1, 2),
        np.sqrt(shifted.variance).reshape(-1, 2),
        MODEL_ERROR * shifted.error,
        MODEL_ERROR * unshifted.error,
    )
    return Misplacement(*(jnp.asarray(part) for part in parts))


@verb
def _conductivity(physics: LogConductivity, coat: Float[Array, " basis"]) -> Float[Array, " elements"]:
    return physics.sigma(coat)


class _ShiftPosterior(NamedTuple):
    """Minus the log probability of readings, deviations of shifts, m, and errors, and shifts with their variances."""

    surprise: float
    size: float
    error: float
    shift: np.ndarray
    variance: np.ndarray


def _whitened(
    ratio: float, of_coat: Float[np.ndarray, " n"], seen: Float[np.ndarray, "n both_and_2"]
) -> tuple[np.ndarray, float]:
    """Readings and slopes of shifts with the covariance one, and half of the log determinant that makes them so."""
    variance = 1 + ratio**2 * of_coat
    white = seen / np.sqrt(variance)[:, None]
    others, gain = white[:, :-1], white[:, -1]
    square = gain @ gain
    lost = (1 - 1 / np.sqrt(1 + square)) / square  # (I + g g')^(-1/2) = I - lost g g'
    return others - np.outer(gain, lost * (gain @ others)), 0.5 * float(np.log(variance).sum() + np.log1p(square))


def _beliefs(
    ratio: float, of_coat: Float[np.ndarray, " n"], seen: Float[np.ndarray, "n both_and_2"]
) -> tuple[_ShiftPosterior, _ShiftPosterior]:
    """The belief without shifts, and that with the most probable size of shifts, for one ratio of coat to errors.

    The principal axes of the whitened slopes serve all sizes; the size of the errors is known in closed form.

    Args:
        of_coat: variance of the readings by a coat of deviation one, in errors.
        seen: readings, their derivatives by shifts, and what the common gain moves, a column each.
    """
    white, root = _whitened(ratio, of_coat, seen)
    y, slopes = white[:, 0], white[:, 1:]
    squares, axes = eigh(slopes.T @ slopes)
    squares, towards = np.maximum(squares, 0), axes.T @ (slopes.T @ y)
    told = SHIFTS[:, None] ** 2 * squares
    square = y @ y - (SHIFTS[:, None] ** 2 / (1 + told)) @ towards**2
    error = np.sqrt(np.maximum(square / len(y), LEAST_ERROR**2))
    surprise = len(y) * np.log(error) + 0.5 * (square / error**2 + np.log1p(told).sum(1)) + root
    surprise += 0.5 * (np.log(ratio * error / COATING_STD) / COAT_SPREAD) ** 2
    size = SHIFTS * error
    surprise = np.where((ratio * error > MOST_COAT) | (size > MOST_SHIFT), np.inf, surprise)

    def belief(k: int) -> _ShiftPosterior:
        left = 1 / (1 + told[k])
        shift = axes @ (SHIFTS[k] ** 2 * left * towards)
        return _ShiftPosterior(surprise[k], size[k], error[k], shift, size[k] ** 2 * (axes**2 @ left))

    return belief(0), belief(int(np.argmin(surprise)))
