"""What a frame of even content tells about a tank: conductivity, contacts, channels, and where the electrodes sit.

A tank that is filled with saline, or a skin that nobody touches, has one unknown conductivity. The frame also depends
on the contact of each electrode, on the gain and the offset of each channel, and on the places of the electrodes: where
currents pass the electrodes that sense, a wrong contact makes the conductivity wrong by tens of percent.

All unknowns are Gaussian before the frame is seen, conductivity and contacts by their logarithms. The most probable
ones are found through the full forward map by `LevenbergMarquardt`; their covariance is that of the curvature there.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, Integer

from ..._compile import full_precision, is_traced, verb
from ...effects import CommonMode, chosen
from ...least_squares import ImplicitStep
from ...least_squares.levenberg_marquardt import gauss_newton_solver
from ...linalg.lapack import eigh
from ...model.discretisation import Model, require_model
from ...model.forward_model import forward
from ...model.motion import electrode_motion
from ..inputs import ConvergenceError, InverseError, require_real
from .frames import MAX_UNEXPLAINED, checked_errors, checked_frame, frame_error, require_explained, sheet_level
from .images import reading_weights
from .reference_unknowns import (
    MODEL_ERROR,
    ReferenceParameters,
    ReferenceProblem,
    ReferenceSettings,
    prior_root,
    split_unknowns,
)

MESH_LENGTH = {3: 0.12, 6: 0.025}
"""Contact resistance of an electrode on the rim that its mesh is off by, times the conductivity and over the length of
an edge of the mesh, by the unknowns of an element: linear, quadratic. Against the exact solution of the disc it is 0.09
to 0.13 and 0.003 to 0.035."""
FITS = 3  # each with errors as large as the misfit of the fit before, the first with what even content leaves
TOLERANCE, MAX_STEPS = 1e-6, 256  # tolerance of the sum of squares: 1 is one standard error


class ReferenceFit(eqx.Module):
    """Parameters fitted to a frame of even content; under jit, NaN throughout if the fit did not converge.

    The covariance holds what the mesh misses near electrodes on the rim, which no frame tells.

    | meaning                                                                            | shape  |
    |------------------------------------------------------------------------------------|--------|
    | value: mean conductivity, S; contacts, ohm m^2, or ohm m of edges; gain relative to 1; offset, V; shift, m | |
    | standard_error: the same, but of the logarithms of conductivity and contacts       |        |
    | covariance of the unknowns, ordered as `ReferenceParameters`; level, contacts by logarithms | (n, n) |
    | information: what the frame adds along each direction, over what was believed      | (k,)   |
    | directions: independent before and after; each is one standard deviation before    | (k, n) |
    | misfit: root mean square of what is left of the readings, in their errors          | ()     |
    | model with the conductivity, contacts and electrodes that were found               |        |
    | channel: number of the channel of each reading; None without gains and offsets     | (readings,) |
    """

    value: ReferenceParameters
    standard_error: ReferenceParameters
    covariance: Float[Array, "n n"]
    information: Float[Array, " k"]
    directions: Float[Array, "k n"]
    misfit: Float[Array, ""]
    model: Model
    channel: Int[Array, " readings"] | None = None

    def corrected(self, frames: Float[ArrayLike, "... readings"]) -> Float[Array, "... readings"]:
        """Frames, V, as the model reads them: without the gains, the offsets and the scale that were fitted."""
        require_real(frames=frames)
        readings = jnp.asarray(frames, self.model.dtype)
        if self.channel is not None:
            readings = (readings - self.value.offset[self.channel]) / (1 + self.value.gain[self.channel])
        return readings / (1 + self.value.scale)

    @property
    def untold(self) -> list[ReferenceParameters]:
        """Directions of which the frame tells less than was believed before: their information is below 1.

        A direction has the units of `standard_error`.
        """
        electrodes, channels = self.model.electrodes, len(self.value.gain)
        found = np.asarray(self.directions)[np.asarray(self.information) < 1]
        return [split_unknowns(jnp.asarray(direction), electrodes, channels) for direction in found]


@full_precision
def fit_reference(
    model: Model,
    frame: Float[ArrayLike, " readings"],
    settings: ReferenceSettings | None = None,
    *,
    std: Float[ArrayLike, " readings"] | None = None,
    channel: Integer[ArrayLike, " readings"] | None = None,
) -> ReferenceFit:
    """Fit conductivity, contacts, channels and places of electrodes to one frame of even content.

    A reading is ``(1 + scale) (1 + gain) v + offset``, gain and offset of its channel, with v that of the model. What
    all readings have in common has the same effect as another conductivity with contacts in proportion: only the
    deviations believed before tell them apart. `ReferenceFit.untold` names such directions. So `scale` enters the
    standard error of the conductivity, whose noise averages out over the readings while the error of a mesh does not.

    Works under `jax.jit` and `jax.grad`; values that are traced are not checked.

    Args:
        model: of the tank. Its contact resistances times its conductivity are the most probable ones before the frame
            is seen, and electrodes with a perfect contact keep it. Whether the mesh resolves a bolt depends on the
            contact that the model has. Linear elements miss a part of the resistance near electrodes, and fits add it
            to contacts; fit contacts with a `Fidelity` of order 2.
        frame: V, best a mean over many; readings that are not finite are left out.
        settings: what is unknown, and how far.
        std: standard error of each reading, V; default: 0.3 % of itself, and a thousandth of their rms, enlarged until
            the misfit is 1.
        channel: number of the channel of each reading, from 0; default: one for each pair of sense electrodes.

    Raises:
        InverseError: if a shape or a value is wrong, or no even content explains the frame.
        ConvergenceError: if the fit does not converge.
        SceneError: if ``model`` is no model, such as a tank.
        MotionError: if the electrodes cannot be moved on this mesh.
    """
    require_model(model)
    settings = ReferenceSettings() if settings is None else settings
    even = forward(model)
    readings = checked_frame("frame", frame, even)
    level = sheet_level("frame", readings, even) if settings.level else jnp.ones((), model.dtype)
    error = frame_error(readings, MODEL_ERROR) if std is None else checked_errors("std", std, even)
    weight, known = reading_weights(readings, error)
    each = _channels(model, channel) if settings.gain or settings.offset else None
    channels = 0 if each is None else int(each.max()) + 1
    motion = electrode_motion(model) if settings.shift else None
    spread = jnp.asarray(prior_root(model, settings, channels), model.dtype)
    numbers = None if each is None else jnp.asarray(each, jnp.int32)
    touches, amplifies = bool(settings.contact or settings.contact_each), bool(settings.common_mode)
    meshed = touches and bool(settings.scale)
    problem = ReferenceProblem(model, motion, numbers, channels, touches, meshed, amplifies, level, spread)
    x, used, converged = _repeated(problem, known, weight, _rms(weight * (known - even / level)), std is None)
    fit, found = _described(problem, known, used, jnp.where(converged, x, jnp.nan))
    used = jnp.where(converged, used, 0)
    hint: Callable[[], str] = str if settings.offset else partial(_with_offset, known, even, used)
    require_explained("frame", "even content", found, known, used > 0, hint)
    return fit


def _with_offset(known: Float[Array, " readings"], even: Float[Array, " readings"], weight: Array) -> str:
    """What an offset that all readings share would leave, for the error that even content alone leaves too much."""
    used = np.asarray(weight) > 0
    seen, like = np.asarray(known)[used], np.stack([np.asarray(even)[used], np.ones(used.sum())], 1)
    sizes = np.linalg.lstsq(like, seen)[0]
    left = np.linalg.norm(seen - like @ sizes) / np.linalg.norm(seen)
    if not left < MAX_UNEXPLAINED:
        return ""
    remedy = f"fit it by ReferenceSettings(offset={abs(sizes[1]):.2g}) or --fit-offset {abs(sizes[1]):.2g}"
    return f"; with an offset of {sizes[1]:.2g} V in all readings it leaves {left:.0%}: {remedy}"


def _channels(model: Model, channel: Integer[ArrayLike, " readings"] | None) -> np.ndarray:
    """The channel of each reading, from 0; raises InverseError if they are not known."""
    if channel is None:
        if model.mixing is not None:
            raise InverseError(
                "the readings are those of matrices; give channel=, the number of each reading's channel, or fit "
                "neither gains nor offsets (no --fit-offset)"
            )
        _, number = np.unique(np.asarray(model.pattern)[:, 2:], axis=0, return_inverse=True)
        return np.asarray(number).ravel()
    channels = np.asarray(channel)
    if channels.shape != (model.readings,) or channels.min() < 0:
        raise InverseError(
            f"channel has shape {channels.shape}; give a number from 0 to each of {model.readings} readings"
        )
    return channels


def _repeated(
    problem: ReferenceProblem,
    known: Float[Array, " readings"],
    weight: Float[Array, " readings"],
    growth: Float[Array, ""],
    enlarged: bool,
) -> tuple[Float[Array, " k"], Float[Array, " readings"], Bool[Array, ""]]:
    """The most probable unknowns, the weights of the readings in the last fit, and whether it converged.

    Errors far below what is left bend the valley of contacts, where steps become short: fits begin with large ones.

    Args:
        growth: of the errors in the first fit.
        enlarged: whether errors grow until the misfit is 1; if not, those of the later fits are as they are given.

    Raises:
        ConvergenceError: if the last fit does not converge, unless JAX hides that.
    """
    x, used, converged = jnp.zeros(problem.spread.shape[1], known.dtype), weight, jnp.asarray(False)
    for _ in range(FITS):
        used = weight / growth
        x, misfit, converged = _most_probable(problem, known, used, x)
        growth = jnp.maximum(growth * misfit, 1) if enlarged else jnp.ones_like(growth)
    if not is_traced(converged) and not converged:
        raise ConvergenceError(
            f"the fit to the frame does not converge in {MAX_STEPS} steps, as where contacts are better than the mesh "
            "resolves, or in float32; use float64 (jax_enable_x64), fit fewer unknowns, or keep the contacts of the "
            "model: contact=0 and contact_each=0"
        )
    return x, used, converged


@verb
def _most_probable(
    problem: ReferenceProblem,
    known: Float[Array, " readings"],
    weight: Float[Array, " readings"],
    start: Float[Array, " k"],
) -> tuple[Float[Array, " k"], Float[Array, ""], Bool[Array, ""]]:
    """The most probable unknowns, root mean square of what they leave of the frame, and whether the fit converged."""

    def residual(x: Float[Array, " k"], given: tuple[Any, ...]) -> Float[Array, " residuals"]:
        problem, known, weight = given
        return jnp.append(weight * (known - problem.read(x)), x)

    # Damped steps swing from one side of the valley of contacts to the other; halved ones of Gauss and Newton do not.
    found: optx.Solution[Array, Any] = optx.least_squares(
        residual,
        gauss_newton_solver(TOLERANCE, TOLERANCE),
        start,
        (problem, known, weight),
        max_steps=MAX_STEPS,
        adjoint=ImplicitStep(),
        throw=False,
    )
    misfit = _rms(weight * (known - problem.read(found.value)))
    return found.value, misfit, jnp.asarray(found.result == optx.RESULTS.successful)


@verb
def _described(
    problem: ReferenceProblem,
    known: Float[Array, " readings"],
    weight: Float[Array, " readings"],
    x: Float[Array, " k"],
) -> tuple[ReferenceFit, Float[Array, " readings"]]:
    """The fit at the most probable unknowns, and the frame as it explains it."""
    readings, slopes = problem.read(x), weight[:, None] * jax.jacfwd(problem.read)(x)
    missed = weight * (known - readings)
    information, axes = eigh(slopes.T @ slopes)
    information = jnp.maximum(information, 0)  # rounding
    directions = (problem.spread @ axes).T
    # Along each direction the prior has the variance one, and the frame adds its information to that of the prior.
    covariance = directions.T @ (directions / (1 + information)[:, None])
    parts = problem.parts(x)
    model = problem.there(parts)
    if problem.meshed:
        mesh = _missed_by_mesh(problem, model)
        covariance = covariance + jnp.outer(mesh, mesh)
    touching = model.contact > 0
    value = parts._replace(
        level=jnp.average(model.background, weights=problem.model.areas),
        contact=jnp.where(touching, 1 / jnp.where(touching, model.contact, 1), 0),
        common_mode=sum((effect.gain for effect in chosen(model.effects, CommonMode)), jnp.zeros_like(parts.level)),
    )
    error = split_unknowns(jnp.sqrt(jnp.diagonal(covariance)), model.electrodes, problem.channels)
    fit = ReferenceFit(value, error, covariance, information, directions, _rms(missed), model, problem.channel)
    return fit, readings


def _missed_by_mesh(problem: ReferenceProblem, model: Model) -> Float[Array, " n"]:
    """Error of the unknowns by the mesh: of the logarithm of contacts on the rim, at most what was believed before."""
    system, believed = model.system, jnp.sqrt(jnp.sum(problem.spread**2, 1))
    on_rim = ~jnp.any(system.contact_mass[:, -1], 1)  # of a piece on the rim: padding, without mass
    length = jnp.where(on_rim, jnp.sum(system.contact_mass, (1, 2)), 0)
    none = jnp.zeros(model.electrodes, length.dtype)
    whole, count = (none.at[system.contact_electrode].add(part) for part in (length, on_rim.astype(length.dtype)))
    edge = whole / jnp.maximum(count, 1)
    sigma = jnp.average(model.background, weights=problem.model.areas)
    missed = MESH_LENGTH[system.dofs.shape[1]] * edge / sigma * model.contact
    found = jnp.zeros_like(believed).at[1 : 1 + model.electrodes].set(missed)
    return jnp.minimum(found, believed)


def _rms(missed: Float[Array, " readings"]) -> Float[Array, ""]:
    """Root mean square over the readings that are used, whose misfits are not zero."""
    return jnp.sqrt(missed @ missed / jnp.maximum(jnp.sum(missed != 0, dtype=missed.dtype), 1))
