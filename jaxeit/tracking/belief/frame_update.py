"""How one frame changes the belief of contacts and of the contact layer's gain.

An extended Kalman filter (Jazwinski 1970, ch. 8), whose update is iterated until it is linear enough. A contact is a
load (place, width, force, half length of an edge) with a velocity; loads add as pressure, and the law of the contact
layer turns pressure times gain into conductivity, of which `Reanalysis` knows the readings. The update minimises the
squares of an `UpdateProblem`; the covariance is that of Laplace's approximation there.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from ..._compile import verb
from ...least_squares import ImplicitStep, LeastSquaresState, LevenbergMarquardt
from ...linalg import lapack
from .contact_filter import ContactFilter, noise_scales, predict, whitened_frame
from .state import CONTACT_SIZE, LOAD_SIZE, Attempt, Belief, Pads, Update
from .update_problem import UpdateProblem, prepare_problem, quadratic, residual

# Predicted fall of half of chi-square, below which a step is the last one: of an ordinary frame, whose next step would
# lower it by 0.001 then, and of an update that starts far from its minimum.
FALL_ATOL, CAREFUL_FALL_ATOL = 10.0, 1.0
# Most evaluations of an ordinary update, and of one that starts far from its minimum; evaluations of a piece of the
# latter.
MAX_STEPS, MAX_CAREFUL_STEPS, PIECE_STEPS = 6, 12, 2
# Growth of a log force above which an update starts from grown forces; largest factor of growth; and smallest share by
# which the signals of two contacts must differ for their growths to be told apart.
GROWTH_THRESHOLD, MAX_GROWTH, MIN_DISTINCT_SHARE = 0.7, 1e3, 1e-6


def _solver(fall: float) -> LevenbergMarquardt:
    return LevenbergMarquardt(rtol=0.0, atol=0.0, fall_rtol=1e-6, fall_atol=fall)


ORDINARY_SOLVER, CAREFUL_SOLVER = _solver(FALL_ATOL), _solver(CAREFUL_FALL_ATOL)


def _minimise(
    problem: UpdateProblem,
    solver: LevenbergMarquardt,
    steps: int,
    start: Float[Array, " a"],
    state: LeastSquaresState | None = None,
) -> optx.Solution[Array, Any]:
    """The change z under which the frame is most probable, after so many evaluations more."""
    options: dict[str, Any] = {"quadratic": quadratic} | ({} if state is None else {"state": state})
    found: optx.Solution[Array, Any] = optx.least_squares(
        residual, solver, start, problem, options, max_steps=steps, adjoint=ImplicitStep(), throw=False
    )
    return found


def _initial_change(problem: UpdateProblem) -> Float[Array, " a"]:
    """The change z from which a careful update starts: zero, or that of forces that have grown.

    Steps in the logarithm of a force do not reach one that has grown severalfold, and would move the contact instead.
    Signals are nearly linear in forces, so that their growth is a linear regression of the frame on them. The other
    parameters change with the forces by their covariance.
    """
    count = len(problem.belief.contacts)
    forces = problem.factor[3 : LOAD_SIZE * count : LOAD_SIZE]
    signals = problem.signals()
    normal = signals @ signals.T
    root = lapack.cholesky(normal + MIN_DISTINCT_SHARE * jnp.trace(normal) * jnp.eye(count), lower=True)
    ratio = lapack.cho_solve((root, True), signals @ problem.frame.y)
    growth = jnp.log(jnp.clip(ratio, 1.0, MAX_GROWTH))
    covariance = lapack.cholesky(forces @ forces.T, lower=True)
    # The least z, which is the most probable one, among those with this growth.
    grown, none = forces.T @ lapack.cho_solve((covariance, True), growth), jnp.zeros_like(problem.factor[0])

    def square(z: Float[Array, " a"]) -> Float[Array, ""]:
        return jnp.sum(residual(z, problem) ** 2)

    better = jax.lax.cond(
        jnp.max(growth) > GROWTH_THRESHOLD, lambda: square(grown) < square(none), lambda: jnp.asarray(False)
    )
    return jnp.where(better, grown, none)


@verb
def predict_and_update(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> tuple[Belief, Update]:
    """Predict the belief so many seconds after the last frame, and update it by a frame."""
    predicted = predict(contact_filter, belief, seconds)
    return predicted, update(contact_filter, predicted, dv, pads, seconds)


@verb
def update(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> Update:
    """Update a belief by a difference frame (readings,) V and the forces on the pads, seconds after the last frame."""
    if not len(belief.contacts):
        return _update_without_contacts(contact_filter, belief, dv, pads, seconds)
    problem = prepare_problem(contact_filter, belief, dv, pads, seconds)
    found = _minimise(problem, ORDINARY_SOLVER, MAX_STEPS, jnp.zeros(len(problem.active), problem.factor.dtype))
    return _laplace_update(problem, found.value, found.state)


@verb
def advance(
    contact_filter: ContactFilter,
    belief: Belief,
    dv: Float[Array, " readings"],
    pads: Pads,
    attempt: Attempt | None = None,
) -> Attempt:
    """Advance an update that may start far from its minimum by one piece.

    Its evidence is that of a single frame: no frame before it has measured the same errors of the model.
    """
    if not len(belief.contacts):
        update = _update_without_contacts(contact_filter, belief, dv, pads, contact_filter.persistence)
        return Attempt(
            jnp.zeros(0, update.evidence.dtype), None, update.evidence, update.signal_to_noise, jnp.asarray(True)
        )
    problem = prepare_problem(contact_filter, belief, dv, pads, contact_filter.persistence)
    start = _initial_change(problem) if attempt is None else attempt.z
    found = _minimise(problem, CAREFUL_SOLVER, PIECE_STEPS, start, None if attempt is None else attempt.state)
    update = _laplace_update(problem, found.value, found.state)
    ended = found.state.converged | (found.state.steps >= MAX_CAREFUL_STEPS)
    return Attempt(found.value, found.state, update.evidence, update.signal_to_noise, ended)


@verb
def conclude(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, attempt: Attempt
) -> Update:
    """Conclude an attempt: the update at its last iterate."""
    if attempt.state is None:
        return _update_without_contacts(contact_filter, belief, dv, pads, contact_filter.persistence)
    return _laplace_update(
        prepare_problem(contact_filter, belief, dv, pads, contact_filter.persistence), attempt.z, attempt.state
    )


@verb
def innovation(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads
) -> Float[Array, " r"]:
    """Innovation of a single frame: its readings less those predicted, (r,), in standard deviations."""
    if not len(belief.contacts):
        frame, _, model_variance = whitened_frame(contact_filter, dv)
        return frame.y / jnp.sqrt(1 + model_variance)
    problem = prepare_problem(contact_filter, belief, dv, pads, contact_filter.persistence)
    predicted = problem.predict_measurement(jnp.zeros(len(problem.active))).readings
    scaled, root = (problem.frame.y - predicted) / problem.single_frame_scale, problem.frame.root
    found: Array = jax.lax.cond(problem.complete, lambda scaled: scaled, lambda scaled: root @ scaled, scaled)
    return found


def _update_without_contacts(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> Update:
    """Update a belief without contacts, which stays as it is."""
    frame, _, model_variance = whitened_frame(contact_filter, dv)
    scale, single_frame_scale = noise_scales(contact_filter, model_variance, seconds)
    on_pads = jnp.sum((pads.force / pads.error) ** 2)
    zero = jnp.zeros((), frame.y.dtype)
    return Update(
        belief=belief,
        evidence=-0.5 * (jnp.sum((frame.y / scale) ** 2) + on_pads),
        misfit=jnp.sum((frame.y / single_frame_scale) ** 2) + on_pads,
        correction_square=zero,
        signal_to_noise=jnp.zeros(0, frame.y.dtype),
        evaluations=jnp.asarray(0),
        converged=jnp.asarray(True),
    )


def _laplace_update(problem: UpdateProblem, z: Float[Array, " a"], state: LeastSquaresState) -> Update:
    """The update at a change z of the active parameters, by Laplace's approximation."""
    normal, square = state.quadratic.hessian.matrix, state.square
    root, ratio = lapack.cholesky(normal, lower=True), problem.scale / problem.single_frame_scale
    return Update(
        belief=_posterior(problem, z, root),
        # The integral over z takes half the log of the determinant of N off: the prior of z is standard normal.
        evidence=-0.5 * square - jnp.sum(jnp.log(jnp.diag(root))),
        misfit=(square - z @ z) * ratio**2,
        correction_square=z @ z,
        signal_to_noise=_signal_to_noise(normal, problem.factor, len(problem.belief.contacts)) * ratio,
        evaluations=state.steps,
        converged=state.converged,
    )


def _posterior(problem: UpdateProblem, z: Float[Array, " a"], root: Float[Array, "a a"]) -> Belief:
    """The belief whose active parameters have changed by C z and have the covariance C N^-1 C^T, with N = R R^T."""
    belief = problem.belief
    across = lapack.solve_triangular(problem.factor, belief.covariance[problem.active], lower=True)
    # The others follow by regression on the active ones: their covariance with these is `across`^T C^T.
    unit = jnp.eye(len(z), dtype=z.dtype)
    learned = unit - lapack.cho_solve((root, True), unit)
    covariance = belief.covariance - across.T @ (learned @ across)
    flat = jnp.concatenate([belief.contacts.ravel(), belief.gain]) + across.T @ z
    size = belief.contacts.size
    found = 0.5 * (covariance + covariance.T)
    return belief._replace(contacts=flat[:size].reshape(-1, CONTACT_SIZE), gain=flat[size:], covariance=found)


def _signal_to_noise(normal: Float[Array, "a a"], factor: Float[Array, "a a"], count: int) -> Float[Array, " K"]:
    """Signal-to-noise ratio of each contact: length of the readings' slope in its log force, in standard deviations."""
    unit = jnp.eye(len(factor), dtype=factor.dtype)[:, 3 : LOAD_SIZE * count : LOAD_SIZE]
    along = lapack.solve_triangular(factor, unit, lower=True)
    # N less the identity, which is the prior's part of it.
    return jnp.sqrt(jnp.maximum(jnp.sum(along * (normal @ along - along), 0), 0))
