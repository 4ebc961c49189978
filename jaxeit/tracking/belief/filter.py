"""The belief of contacts and of the contact layer's gain, and how one frame changes it.

An extended Kalman filter (Jazwinski 1970, ch. 8), whose update is iterated until it is linear enough. A contact is a
load (place, width, force, half length of an edge) with a velocity; loads add as pressure, and the law of the contact
layer turns pressure times gain into conductivity, of which `Reanalysis` knows the readings. The gain ``exp(level +
field)`` is the same in all frames, so its modes are part of the belief: the uncertainty of a place that the gain causes
does not shrink while a contact rests, and the gain is learned where contacts move. The level alone may wander during a
press, since a layer that follows another law looks like another gain under another force.

Only the parameters that a frame informs are active in an update: positions, widths, forces, half lengths, the level and
the modes around contacts. With their covariance ``P = C C^T`` the update minimises ``|y - h|^2 / s^2 + |z|^2`` over z,
where ``C z`` is the change of the active parameters; all others follow by their covariance with these.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..._compile import usually, verb
from ...contacts.search import ContactFinder, WhitenedFrame
from ...least_squares import ImplicitStep, LeastSquaresState, LevenbergMarquardt, normal_equations
from ...linalg import lapack
from .response import LoadedSheet, Neighbourhood, PredictedMeasurement

# State of a contact: x, y, log width, log force, half an edge along x and y, velocity along x and y. The first six are
# those of its load, on which readings and pad forces depend.
CONTACT_SIZE, LOAD_SIZE = 8, 6
# Prior standard deviation of the position of a new contact, m.
POSITION_STD = 0.012
# Prior standard deviation of the half length of a round contact, m: above zero, so that the covariance stays definite.
ROUND_HALF_LENGTH = 1e-4
# Smallest share of a load on pads of known force with which the pads inform on the force of the contact.
MIN_PAD_SHARE = 0.25
# Width of the load whose tails pads may feel, over that of the contact.
TAIL_WIDTH_RATIO = 2.0
# Load on a pad that counts as zero, N.
NEGLIGIBLE_LOAD = 1e-6
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


class Pads(NamedTuple):
    """Forces on the pads in a frame, and their standard errors, (pads,) N; infinite where a force is not known."""

    force: Float[Array | np.ndarray, " pads"]
    error: Float[Array | np.ndarray, " pads"]


class Belief(NamedTuple):
    """Normal distribution of contacts and gain.

    | meaning                                                                  | shape    | unit  |
    |--------------------------------------------------------------------------|----------|-------|
    | contacts: x, y, log width, log force, half an edge (2), velocity (2)     | (K, 8)   | mixed |
    | gain: level, then modes of the field, in units of their prior deviations | (g,)     | 1     |
    | covariance of contacts and gain                                          | (n, n)   | mixed |
    | level: mean and variance of the level before the contacts of now         | (2,)     | 1     |
    """

    contacts: Float[Array, "K 8"]
    gain: Float[Array, " g"]
    covariance: Float[Array, "n n"]
    level: Float[Array, "2"]


class Update(NamedTuple):
    """A belief after a frame.

    | meaning                                                                   | shape |
    |---------------------------------------------------------------------------|-------|
    | belief                                                                    |       |
    | evidence: log of the frame's probability before it came, up to a constant | ()    |
    | misfit: chi-square of the frame and the pads                              | ()    |
    | correction_square: squared Mahalanobis length of the belief's correction  | ()    |
    | signal_to_noise: signal of each contact over its standard deviation       | (K,)  |
    | evaluations: number of evaluations of the measurement model               | ()    |
    | converged: further evaluations would not change it                        | ()    |
    """

    belief: Belief
    evidence: Float[Array, ""]
    misfit: Float[Array, ""]
    correction_square: Float[Array, ""]
    signal_to_noise: Float[Array, " K"]
    evaluations: Int[Array, ""]
    converged: Bool[Array, ""]


class Attempt(NamedTuple):
    """The iterate of an update that starts far from its minimum; `advance` continues it.

    | meaning                                                                   | shape |
    |---------------------------------------------------------------------------|-------|
    | z: change of the active parameters; state: of the solver                  | (a,)  |
    | evidence, signal_to_noise: as of an `Update`                              |       |
    | ended: converged, or at the largest number of evaluations                 | ()    |
    """

    z: Float[Array, " a"]
    state: LeastSquaresState | None
    evidence: Float[Array, ""]
    signal_to_noise: Float[Array, " K"]
    ended: Bool[Array, ""]


class ContactFilter(eqx.Module):
    """Measurement model, motion model and noise of an extended Kalman filter of contacts; made by `prepare_tracker`.

    | meaning                                                                  | shape            | unit |
    |--------------------------------------------------------------------------|------------------|------|
    | finder: whitens frames; its atoms are where contacts may begin           |                  |      |
    | compress: whitened readings of a frame that lacks none                   | (r, readings)    | 1/V  |
    | sheet: measurement model                                                 |                  |      |
    | places: where the modes of the gain lie; the first is the level          | (g, 2)           | m    |
    | model_error: part of the signal by which mesh and contact layer err      | ()               | 1    |
    | coat_error: part of the signal by which an unknown coat makes it err     | ()               | 1    |
    | persistence of these errors                                              | ()               | s    |
    | tail: part of what wider loads would change pads, by which pads may err  | ()               | 1    |
    | shape: standard deviation of each moment of a load's shape               | ()               | 1    |
    | spread: prior deviation of position (2), log width, log force            | (4,)             | m, 1 |
    | rates: random walk of each state variable of a contact                   | (8,)             | per sqrt(s) |
    | gain_rate: random walk of the level, in its prior standard deviations    | ()               | per sqrt(s) |
    """

    finder: ContactFinder
    compress: Float[Array, "r readings"]
    sheet: LoadedSheet
    places: Float[Array, "g 2"]
    model_error: Float[Array, ""]
    coat_error: Float[Array, ""]
    persistence: Float[Array, ""]
    rates: Float[Array, "8"]
    gain_rate: Float[Array, ""]
    tail: Float[Array, ""]
    shape: Float[Array, ""]
    spread: Float[Array, "4"]
    active_modes: int = eqx.field(static=True)

    @property
    def error_share(self) -> Float[Array, ""]:
        """Share of the square of a signal that is an error of the model or caused by an unknown coat."""
        return self.model_error**2 + self.coat_error**2


@verb
def contact_slice(k: int) -> slice:
    """Rows of contact k in the covariance of a belief."""
    return slice(CONTACT_SIZE * k, CONTACT_SIZE * (k + 1))


def predict(contact_filter: ContactFilter, belief: Belief, seconds: Float[Array, ""]) -> Belief:
    """Predict the belief so many seconds later: contacts move at their velocities, and walk at random.

    The level follows an Ornstein-Uhlenbeck process about what was known of it before the present contacts.
    """
    count, size = len(belief.contacts), belief.contacts.size
    if not count:
        return belief
    transition = jnp.eye(CONTACT_SIZE).at[:2, 6:].set(seconds * jnp.eye(2))
    # A velocity that walks at random: the integrated Wiener process, exactly.
    walk = jnp.diag(contact_filter.rates**2 * seconds)
    drift = contact_filter.rates[6:] ** 2
    walk = walk.at[:2, :2].add(jnp.diag(drift * seconds**3 / 3))
    walk = walk.at[:2, 6:].add(jnp.diag(drift * seconds**2 / 2)).at[6:, :2].add(jnp.diag(drift * seconds**2 / 2))
    transitions = jnp.kron(jnp.eye(count), transition)
    rows = belief.covariance.at[:size].set(transitions @ belief.covariance[:size])
    both = rows.at[:, :size].set(rows[:, :size] @ transitions.T)
    covariance = both.at[:size, :size].add(jnp.kron(jnp.eye(count), walk))
    mean, variance = belief.level
    decay = jnp.exp(-0.5 * contact_filter.gain_rate**2 * seconds / variance)
    decayed = (
        covariance.at[size].multiply(decay).at[:, size].multiply(decay).at[size, size].add((1 - decay**2) * variance)
    )
    gain = belief.gain.at[0].set(mean + decay * (belief.gain[0] - mean))
    return belief._replace(contacts=belief.contacts @ transition.T, gain=gain, covariance=decayed)


class _UpdateProblem(NamedTuple):
    """The least-squares problem of one update.

    | meaning                                                                  |
    |--------------------------------------------------------------------------|
    | filter, frame, pads; complete: whether the frame has all readings        |
    | belief before the frame                                                  |
    | active: indices of the parameters that the frame informs                 |
    | factor C of their covariance                                             |
    | scale: standard deviation of a whitened reading                          |
    | single_frame_scale: the same in a frame that no other one precedes       |
    | neighbourhood: of the contacts before the frame                          |
    """

    contact_filter: ContactFilter
    frame: WhitenedFrame
    complete: Bool[Array, ""]
    pads: Pads
    belief: Belief
    active: Int[Array, " a"]
    factor: Float[Array, "a a"]
    scale: Float[Array, ""]
    single_frame_scale: Float[Array, ""]
    neighbourhood: Neighbourhood

    def predict_measurement(self, z: Float[Array, " a"]) -> PredictedMeasurement:
        """Predict readings and pad forces if the active parameters change by C z, with slopes in z."""
        change, before = self.factor @ z, self.belief.contacts[:, :LOAD_SIZE]
        modes = self.active[before.size :] - self.belief.contacts.size
        gain = self.belief.gain.at[modes].add(change[before.size :])
        contacts = before + change[: before.size].reshape(-1, LOAD_SIZE)
        full = self.contact_filter.sheet.predict_measurement(contacts, gain, modes, self.neighbourhood)
        readings, slopes = self._as_observed(full.readings, full.reading_slopes)
        return PredictedMeasurement(readings, full.pads, self.factor.T @ slopes, self.factor.T @ full.pad_slopes)

    def signals(self) -> Float[Array, "K r"]:
        """Readings of each contact before the frame, to first order."""
        sheet, belief = self.contact_filter.sheet, self.belief
        full = sheet.signals(belief.contacts[:, :LOAD_SIZE], belief.gain, self.neighbourhood)
        return self._as_observed(full)[0]

    def _as_observed(self, *readings: Array) -> tuple[Array, ...]:
        """Whiten readings as those of the frame, which may lack some."""

        def whiten(*a: Array) -> tuple[Array, ...]:
            return tuple(one @ self.frame.root.T for one in a)

        found: tuple[Array, ...] = jax.lax.cond(self.complete, lambda *a: a, whiten, *readings)
        return found

    def residual(self, z: Float[Array, " a"], predicted: PredictedMeasurement) -> Float[Array, " n"]:
        """Residuals of the frame, of the pads and of the prior, in standard deviations."""
        frame = (predicted.readings - self.frame.y) / self.scale
        return jnp.concatenate([frame, (predicted.pads - self.pads.force) / self.pads.error, z])


def _quadratic(z: Float[Array, " a"], problem: _UpdateProblem) -> Any:
    predicted = problem.predict_measurement(z)
    slopes = [predicted.reading_slopes / problem.scale, predicted.pad_slopes / problem.pads.error, jnp.eye(len(z))]
    return normal_equations(problem.residual(z, predicted), jnp.concatenate(slopes, 1).T)


def _residual(z: Float[Array, " a"], problem: _UpdateProblem) -> Float[Array, " n"]:
    return problem.residual(z, problem.predict_measurement(z))


def active_indices(contact_filter: ContactFilter, contacts: Float[Array, "K 8"]) -> Int[Array, " a"]:
    """Indices of the parameters that a frame informs: loads of contacts, the level, and the modes around contacts."""
    count = len(contacts)
    own = (CONTACT_SIZE * np.arange(count)[:, None] + np.arange(LOAD_SIZE)).ravel()
    known = jnp.asarray([*own, CONTACT_SIZE * count], jnp.int32)
    square = jnp.min(jnp.sum((contact_filter.places[1:, None] - contacts[None, :, :2]) ** 2, -1), 1)
    around = 1 + jax.lax.top_k(-square, min(contact_filter.active_modes * count, square.size))[1]
    return jnp.concatenate([known, CONTACT_SIZE * count + around.astype(jnp.int32)])


def _whitened_frame(
    contact_filter: ContactFilter, dv: Float[Array, " readings"]
) -> tuple[WhitenedFrame, Bool[Array, ""], Float[Array, ""]]:
    """A whitened frame, whether it has all readings, and the variance of a whitened reading by errors of the model."""
    dv = jnp.asarray(dv, contact_filter.compress.dtype)
    y = contact_filter.compress @ dv  # of channels that are not used the matrix is zero, but not its product with NaN
    complete = jnp.all(jnp.isfinite(y))
    frame = usually(
        complete, _complete_frame, lambda finder, _, dv: finder.compressed(dv)[0], contact_filter.finder, y, dv
    )
    complete = complete | jnp.all(jnp.isfinite(dv) | ~contact_filter.finder.whitening.channels)
    return frame, complete, contact_filter.error_share * (frame.y @ frame.y) / len(frame.y)


def _complete_frame(finder: ContactFinder, y: Float[Array, " r"], dv: Float[Array, " readings"]) -> WhitenedFrame:
    zero = jnp.zeros((), y.dtype)
    return WhitenedFrame(y, zero, zero, finder.root)


def _problem(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> _UpdateProblem:
    frame, complete, model_variance = _whitened_frame(contact_filter, dv)
    scales = _noise_scales(contact_filter, model_variance, seconds)
    active = active_indices(contact_filter, belief.contacts)
    factor = lapack.cholesky(belief.covariance[jnp.ix_(active, active)], lower=True)
    near = contact_filter.sheet.neighbourhood(belief.contacts[:, :LOAD_SIZE])
    pads = informative_pads(contact_filter, belief.contacts, near, pads)
    return _UpdateProblem(contact_filter, frame, complete, pads, belief, active, factor, *scales, near)


def informative_pads(
    contact_filter: ContactFilter, contacts: Float[Array, "K 8"], near: Neighbourhood, pads: Pads
) -> Pads:
    """Pads with the errors of their forces as measurements of contacts; infinite for pads that hardly inform on any.

    How much of a load lies on the pads beside it depends on its shape, which is not known: foam spreads a load farther
    than it makes the layer conduct. So pads may err by a part of what a load `TAIL_WIDTH_RATIO` times as wide would
    change them.

    A pad that mostly bears contacts with less than `MIN_PAD_SHARE` of their load on pads of known force bears their
    tails, as where the pad under a contact is dead, and those beside it work. The whole force would err tenfold. While
    there is such a contact, pads without any load count as bearing it.
    """
    own = contacts[:, :LOAD_SIZE]
    loads = contact_filter.sheet.pad_loads(own, near)
    spread = contact_filter.sheet.pad_loads(own.at[:, 2].add(math.log(TAIL_WIDTH_RATIO)), near) - loads
    error = jnp.sqrt(pads.error**2 + contact_filter.tail**2 * jnp.sum(spread**2, 0))
    supported = jnp.sum(jnp.where(jnp.isfinite(pads.error), loads, 0), 1) >= MIN_PAD_SHARE * jnp.exp(contacts[:, 3])
    supported_load = jnp.sum(jnp.where(supported[:, None], loads, 0), 0)
    other_load = jnp.sum(jnp.where(supported[:, None], 0, loads + NEGLIGIBLE_LOAD), 0)
    return pads._replace(error=jnp.where(supported_load >= other_load, error, jnp.inf))


def _noise_scales(
    contact_filter: ContactFilter, model_variance: Float[Array, ""], seconds: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Standard deviations of a whitened reading in a frame so long after the last one, and in a single frame.

    Errors of the model that stay for n frames are measured n times, and count once.
    """
    repeats = jnp.maximum(contact_filter.persistence / seconds, 1)
    return jnp.sqrt(1 + repeats * model_variance), jnp.sqrt(1 + model_variance)


def _minimise(
    problem: _UpdateProblem,
    solver: LevenbergMarquardt,
    steps: int,
    start: Float[Array, " a"],
    state: LeastSquaresState | None = None,
) -> optx.Solution[Array, Any]:
    """The change z under which the frame is most probable, after so many evaluations more."""
    options: dict[str, Any] = {"quadratic": _quadratic} | ({} if state is None else {"state": state})
    found: optx.Solution[Array, Any] = optx.least_squares(
        _residual, solver, start, problem, options, max_steps=steps, adjoint=ImplicitStep(), throw=False
    )
    return found


def _initial_change(problem: _UpdateProblem) -> Float[Array, " a"]:
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
    grown, none = forces.T @ lapack.cho_solve((covariance, True), growth), jnp.zeros_like(problem.factor[0])

    def square(z: Float[Array, " a"]) -> Float[Array, ""]:
        return jnp.sum(_residual(z, problem) ** 2)

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
    problem = _problem(contact_filter, belief, dv, pads, seconds)
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
    problem = _problem(contact_filter, belief, dv, pads, contact_filter.persistence)
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
        _problem(contact_filter, belief, dv, pads, contact_filter.persistence), attempt.z, attempt.state
    )


@verb
def innovation(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads
) -> Float[Array, " r"]:
    """Innovation of a single frame: its readings less those predicted, (r,), in standard deviations."""
    if not len(belief.contacts):
        frame, _, model_variance = _whitened_frame(contact_filter, dv)
        return frame.y / jnp.sqrt(1 + model_variance)
    problem = _problem(contact_filter, belief, dv, pads, contact_filter.persistence)
    predicted = problem.predict_measurement(jnp.zeros(len(problem.active))).readings
    scaled, root = (problem.frame.y - predicted) / problem.single_frame_scale, problem.frame.root
    found: Array = jax.lax.cond(problem.complete, lambda scaled: scaled, lambda scaled: root @ scaled, scaled)
    return found


def _update_without_contacts(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> Update:
    """Update a belief without contacts, which stays as it is."""
    frame, _, model_variance = _whitened_frame(contact_filter, dv)
    scale, single_frame_scale = _noise_scales(contact_filter, model_variance, seconds)
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


def _laplace_update(problem: _UpdateProblem, z: Float[Array, " a"], state: LeastSquaresState) -> Update:
    """The update at a change z of the active parameters, by Laplace's approximation."""
    normal, square = state.quadratic.hessian.matrix, state.square
    root, ratio = lapack.cholesky(normal, lower=True), problem.scale / problem.single_frame_scale
    return Update(
        belief=_posterior(problem, z, root),
        evidence=-0.5 * square - jnp.sum(jnp.log(jnp.diag(root))),
        misfit=(square - z @ z) * ratio**2,
        correction_square=z @ z,
        signal_to_noise=_signal_to_noise(normal, problem.factor, len(problem.belief.contacts)) * ratio,
        evaluations=state.steps,
        converged=state.converged,
    )


def _posterior(problem: _UpdateProblem, z: Float[Array, " a"], root: Float[Array, "a a"]) -> Belief:
    """The belief whose active parameters have changed by C z and have the covariance C N^-1 C^T, with N = R R^T."""
    belief = problem.belief
    across = lapack.solve_triangular(problem.factor, belief.covariance[problem.active], lower=True)
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
    return jnp.sqrt(jnp.maximum(jnp.sum(along * (normal @ along - along), 0), 0))
