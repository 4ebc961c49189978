"""The belief of contacts and of the contact layer's gain, and how one frame changes it.

An extended Kalman filter (Jazwinski 1970, ch. 8), whose update is iterated until it is linear enough. A contact is a
load (place, width, force, half length of an edge) with a velocity; loads add as pressure, and the law of the contact
layer turns pressure times gain into conductivity, of which `Reanalysis` knows the readings. The gain ``exp(level +
field)`` is the same in all frames, so its modes are part of the belief: the uncertainty of a place that the gain causes
does not shrink while a contact rests, and the gain is learned where contacts move. The level alone may wander during a
press, since a layer that follows another law looks like another gain under another force.

Only the parameters that a frame tells of are active in an update: places, widths, forces, half lengths, the level and
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
from ...contacts.search import ContactFinder, Frame
from ...least_squares import ImplicitStep, LeastSquaresState, LevenbergMarquardt, normal_equations
from ...linalg import lapack
from .response import LoadedSheet, Near, Shown

# Numbers of a contact: x, y, log width, log force, half an edge along x and y, velocity along x and y.
CONTACT_SIZE, SEEN_SIZE = 8, 6
# Prior deviation of the place of a contact that begins, m.
PLACE_STD = 0.012
# Half an edge that is none: what keeps its covariance definite, m.
ROUND_HALF = 1e-4
# Share of a load on pads that tell forces, from which the pads tell the force of a contact.
MIN_TOLD_SHARE = 0.25
# How many times as wide a load is whose tails pads may feel.
WIDER = 2.0
# Load on a pad that counts as none, N.
NO_LOAD = 1e-6
# Where a step is expected to lower half of chi-square by no more than this, it is taken, and the next one is left out:
# of an ordinary frame, whose next step would lower it by 0.001 then, and of one that begins far from its end.
FALL, CAREFUL_FALL = 10.0, 1.0
# Evaluations of an update; of one that begins far from its end, and of a piece of such a one.
STEPS, MANY_STEPS, PIECE = 6, 12, 2
# Forces begin as grown where the log of one has by more than this, and by no more than so many times; of two contacts
# whose signals differ by less than this share the growth is not told apart.
GROWN, MOST_GROWTH, ALIKE = 0.7, 1e3, 1e-6


def _solver(fall: float) -> LevenbergMarquardt:
    return LevenbergMarquardt(rtol=0.0, atol=0.0, fall_rtol=1e-6, fall_atol=fall)


ORDINARY, CAREFUL = _solver(FALL), _solver(CAREFUL_FALL)


class Pads(NamedTuple):
    """Forces on the pads in a frame, and their standard errors, (pads,) N; infinite for a pad that tells none."""

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
    | surprise: square of the change of the belief, in its standard deviations  | ()    |
    | loudness: of each contact's signal, in standard deviations                | (K,)  |
    | solves: evaluations of what the contacts show                             | ()    |
    | converged: further evaluations would not change it                        | ()    |
    """

    belief: Belief
    evidence: Float[Array, ""]
    misfit: Float[Array, ""]
    surprise: Float[Array, ""]
    loudness: Float[Array, " K"]
    solves: Int[Array, ""]
    converged: Bool[Array, ""]


class Attempt(NamedTuple):
    """An update that begins far from its end, as far as it has come; `attempted` goes on with it.

    | meaning                                                                   | shape |
    |---------------------------------------------------------------------------|-------|
    | z: change of the active numbers; state: of the solver                     | (a,)  |
    | evidence, loudness: as of an `Update`                                     |       |
    | ended: further evaluations would not change it, or there were enough      | ()    |
    """

    z: Float[Array, " a"]
    state: LeastSquaresState | None
    evidence: Float[Array, ""]
    loudness: Float[Array, " K"]
    ended: Bool[Array, ""]


class ContactFilter(eqx.Module):
    """What frames tell of contacts; made by `prepare_tracker`.

    | meaning                                                                  | shape            | unit |
    |--------------------------------------------------------------------------|------------------|------|
    | finder: whitens frames; its atoms are where contacts may begin           |                  |      |
    | compress: whitened readings of a frame that lacks none                   | (r, readings)    | 1/V  |
    | sheet: what contacts show                                                |                  |      |
    | places: where the modes of the gain lie; the first is the level          | (g, 2)           | m    |
    | model_error: part of the signal by which mesh and contact layer err      | ()               | 1    |
    | coat_error: part of the signal by which an unknown coat makes it err     | ()               | 1    |
    | persistence of these errors                                              | ()               | s    |
    | tail: part of what wider loads would change pads, by which pads may err  | ()               | 1    |
    | shape: standard deviation of each moment of a load's shape               | ()               | 1    |
    | spread: of place (2), log width and log force before a contact is seen   | (4,)             | m, 1 |
    | rates: random walk of each number of a contact                           | (8,)             | per sqrt(s) |
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
def numbers_of(k: int) -> slice:
    """Where the numbers of contact k stand in the covariance of a belief."""
    return slice(CONTACT_SIZE * k, CONTACT_SIZE * (k + 1))


def predicted(contact_filter: ContactFilter, belief: Belief, seconds: Float[Array, ""]) -> Belief:
    """The belief so many seconds later: contacts move on, and may change.

    What the contacts of now have told of the level is forgotten as they change: the level follows an
    Ornstein-Uhlenbeck process about what was known of it before them.
    """
    count, size = len(belief.contacts), belief.contacts.size
    if not count:
        return belief
    step = jnp.eye(CONTACT_SIZE).at[:2, 6:].set(seconds * jnp.eye(2))
    # A velocity that walks at random: the integrated Wiener process, exactly.
    walk = jnp.diag(contact_filter.rates**2 * seconds)
    drift = contact_filter.rates[6:] ** 2
    walk = walk.at[:2, :2].add(jnp.diag(drift * seconds**3 / 3))
    walk = walk.at[:2, 6:].add(jnp.diag(drift * seconds**2 / 2)).at[6:, :2].add(jnp.diag(drift * seconds**2 / 2))
    whole = jnp.kron(jnp.eye(count), step)
    rows = belief.covariance.at[:size].set(whole @ belief.covariance[:size])
    both = rows.at[:, :size].set(rows[:, :size] @ whole.T)
    covariance = both.at[:size, :size].add(jnp.kron(jnp.eye(count), walk))
    mean, variance = belief.level
    kept = jnp.exp(-0.5 * contact_filter.gain_rate**2 * seconds / variance)
    forgotten = (
        covariance.at[size].multiply(kept).at[:, size].multiply(kept).at[size, size].add((1 - kept**2) * variance)
    )
    gain = belief.gain.at[0].set(mean + kept * (belief.gain[0] - mean))
    return belief._replace(contacts=belief.contacts @ step.T, gain=gain, covariance=forgotten)


class _Problem(NamedTuple):
    """One update.

    | meaning                                                          |
    |------------------------------------------------------------------|
    | filter, frame, pads; whole: whether the frame lacks no reading   |
    | belief before the frame                                          |
    | active: numbers of the belief that the frame tells of            |
    | factor C of their covariance                                     |
    | scale: standard deviation of a whitened reading; alone: in a frame by itself |
    | near: what is near the contacts before the frame                 |
    """

    contact_filter: ContactFilter
    frame: Frame
    whole: Bool[Array, ""]
    pads: Pads
    belief: Belief
    active: Int[Array, " a"]
    factor: Float[Array, "a a"]
    scale: Float[Array, ""]
    alone: Float[Array, ""]
    near: Near

    def shown(self, z: Float[Array, " a"]) -> Shown:
        """What the frame and the pads show if the active numbers change by C z; with slopes in z."""
        change, before = self.factor @ z, self.belief.contacts[:, :SEEN_SIZE]
        modes = self.active[before.size :] - self.belief.contacts.size
        gain = self.belief.gain.at[modes].add(change[before.size :])
        contacts = before + change[: before.size].reshape(-1, SEEN_SIZE)
        found = self.contact_filter.sheet.shown(contacts, gain, modes, self.near)

        seen = self._told(found.readings, found.reading_slopes)
        return Shown(seen[0], found.pads, self.factor.T @ seen[1], self.factor.T @ found.pad_slopes)

    def signals(self) -> Float[Array, "K r"]:
        """What each contact shows before the frame, to first order."""
        belief = self.belief
        (found,) = self._told(self.contact_filter.sheet.signals(belief.contacts[:, :SEEN_SIZE], belief.gain, self.near))
        return found

    def _told(self, *readings: Array) -> tuple[Array, ...]:
        """Whitened readings as the frame has them, which may lack some."""

        def mixed(*a: Array) -> tuple[Array, ...]:
            return tuple(one @ self.frame.root.T for one in a)

        found: tuple[Array, ...] = jax.lax.cond(self.whole, lambda *a: a, mixed, *readings)
        return found

    def residual(self, z: Float[Array, " a"], shown: Shown) -> Float[Array, " n"]:
        """What is left of the frame, of the pads and of the belief before, in standard deviations."""
        left = (shown.readings - self.frame.y) / self.scale
        return jnp.concatenate([left, (shown.pads - self.pads.force) / self.pads.error, z])


def _quadratic(z: Float[Array, " a"], problem: _Problem) -> Any:
    shown = problem.shown(z)
    slopes = [shown.reading_slopes / problem.scale, shown.pad_slopes / problem.pads.error, jnp.eye(len(z))]
    return normal_equations(problem.residual(z, shown), jnp.concatenate(slopes, 1).T)


def _residual(z: Float[Array, " a"], problem: _Problem) -> Float[Array, " n"]:
    return problem.residual(z, problem.shown(z))


def active_numbers(contact_filter: ContactFilter, contacts: Float[Array, "K 8"]) -> Int[Array, " a"]:
    """Numbers of the belief that a frame tells of: of the contacts, the level, and the modes around contacts."""
    count = len(contacts)
    own = (CONTACT_SIZE * np.arange(count)[:, None] + np.arange(SEEN_SIZE)).ravel()
    known = jnp.asarray([*own, CONTACT_SIZE * count], jnp.int32)
    square = jnp.min(jnp.sum((contact_filter.places[1:, None] - contacts[None, :, :2]) ** 2, -1), 1)
    around = 1 + jax.lax.top_k(-square, min(contact_filter.active_modes * count, square.size))[1]
    return jnp.concatenate([known, CONTACT_SIZE * count + around.astype(jnp.int32)])


def _seen(
    contact_filter: ContactFilter, dv: Float[Array, " readings"]
) -> tuple[Frame, Bool[Array, ""], Float[Array, ""]]:
    """A frame as it is fitted, whether it lacks no reading, and the share of the model in the variance of a number."""
    dv = jnp.asarray(dv, contact_filter.compress.dtype)
    y = contact_filter.compress @ dv  # of channels that are not used the matrix is zero, but not its product with NaN
    whole = jnp.all(jnp.isfinite(y))
    frame = usually(whole, _complete, lambda finder, _, dv: finder.compressed(dv)[0], contact_filter.finder, y, dv)
    whole = whole | jnp.all(jnp.isfinite(dv) | ~contact_filter.finder.whitening.channels)
    return frame, whole, contact_filter.error_share * (frame.y @ frame.y) / len(frame.y)


def _complete(finder: ContactFinder, y: Float[Array, " r"], dv: Float[Array, " readings"]) -> Frame:
    none = jnp.zeros((), y.dtype)
    return Frame(y, none, none, finder.root)


def _problem(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> _Problem:
    frame, whole, share = _seen(contact_filter, dv)
    scale, alone = _scales(contact_filter, share, seconds)
    active = active_numbers(contact_filter, belief.contacts)
    factor = lapack.cholesky(belief.covariance[jnp.ix_(active, active)], lower=True)
    near = contact_filter.sheet.near(belief.contacts[:, :SEEN_SIZE])
    pads = telling_pads(contact_filter, belief.contacts, near, pads)
    return _Problem(contact_filter, frame, whole, pads, belief, active, factor, scale, alone, near)


def telling_pads(contact_filter: ContactFilter, contacts: Float[Array, "K 8"], near: Near, pads: Pads) -> Pads:
    """Pads with the errors of what they tell of contacts; infinite for pads that hardly tell any.

    How much of a load lies on the pads beside it depends on its shape, which is not known: foam spreads a load farther
    than it makes the layer conduct. So pads may err by a part of what a load `WIDER` would change them.

    A pad that mostly bears contacts with less than `MIN_TOLD_SHARE` of their load on pads that tell forces bears their
    tails, as where the pad under a contact is dead, and those beside it tell forces. The whole force would err tenfold.
    While there is such a contact, pads without any load count as bearing it.
    """
    own = contacts[:, :SEEN_SIZE]
    loads = contact_filter.sheet.on_pads(own, near)
    spread = contact_filter.sheet.on_pads(own.at[:, 2].add(math.log(WIDER)), near) - loads
    error = jnp.sqrt(pads.error**2 + contact_filter.tail**2 * jnp.sum(spread**2, 0))
    told = jnp.sum(jnp.where(jnp.isfinite(pads.error), loads, 0), 1) >= MIN_TOLD_SHARE * jnp.exp(contacts[:, 3])
    of_told = jnp.sum(jnp.where(told[:, None], loads, 0), 0)
    of_others = jnp.sum(jnp.where(told[:, None], 0, loads + NO_LOAD), 0)
    return pads._replace(error=jnp.where(of_told >= of_others, error, jnp.inf))


def _scales(
    contact_filter: ContactFilter, share: Float[Array, ""], seconds: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Standard deviations of a whitened reading in a frame so long after the last one, and in a frame by itself.

    Errors of the model that stay for n frames are told n times, and count once.
    """
    repeats = jnp.maximum(contact_filter.persistence / seconds, 1)
    return jnp.sqrt(1 + repeats * share), jnp.sqrt(1 + share)


def _fitted(
    problem: _Problem,
    solver: LevenbergMarquardt,
    steps: int,
    begin: Float[Array, " a"],
    state: LeastSquaresState | None = None,
) -> optx.Solution[Array, Any]:
    """The change z under which the frame is most probable, after so many evaluations more."""
    options: dict[str, Any] = {"quadratic": _quadratic} | ({} if state is None else {"state": state})
    found: optx.Solution[Array, Any] = optx.least_squares(
        _residual, solver, begin, problem, options, max_steps=steps, adjoint=ImplicitStep(), throw=False
    )
    return found


def _begun(problem: _Problem) -> Float[Array, " a"]:
    """The change z at which an update begins that may begin far from its end: none, or that of forces that have grown.

    Steps in the logarithm of a force do not reach one that has grown severalfold, and would move the contact instead.
    The frame tells by how much signals have grown, as they are nearly linear in forces; what a force tells of the other
    numbers goes with it, by their covariance.
    """
    count = len(problem.belief.contacts)
    forces = problem.factor[3 : SEEN_SIZE * count : SEEN_SIZE]
    signals = problem.signals()
    normal = signals @ signals.T
    root = lapack.cholesky(normal + ALIKE * jnp.trace(normal) * jnp.eye(count), lower=True)
    times = lapack.cho_solve((root, True), signals @ problem.frame.y)
    growth = jnp.log(jnp.clip(times, 1.0, MOST_GROWTH))
    covariance = lapack.cholesky(forces @ forces.T, lower=True)
    grown, still = forces.T @ lapack.cho_solve((covariance, True), growth), jnp.zeros_like(problem.factor[0])

    def square(z: Float[Array, " a"]) -> Float[Array, ""]:
        return jnp.sum(_residual(z, problem) ** 2)

    better = jax.lax.cond(jnp.max(growth) > GROWN, lambda: square(grown) < square(still), lambda: jnp.asarray(False))
    return jnp.where(better, grown, still)


@verb
def followed(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> tuple[Belief, Update]:
    """The belief as it is predicted so many seconds after the last frame, and what a frame makes of it."""
    moved = predicted(contact_filter, belief, seconds)
    return moved, updated(contact_filter, moved, dv, pads, seconds)


@verb
def updated(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> Update:
    """The belief after a difference frame (readings,) V and the forces on the pads, seconds after the last frame."""
    if not len(belief.contacts):
        return _nothing(contact_filter, belief, dv, pads, seconds)
    problem = _problem(contact_filter, belief, dv, pads, seconds)
    found = _fitted(problem, ORDINARY, STEPS, jnp.zeros(len(problem.active), problem.factor.dtype))
    return _update(problem, found.value, found.state)


@verb
def attempted(
    contact_filter: ContactFilter,
    belief: Belief,
    dv: Float[Array, " readings"],
    pads: Pads,
    attempt: Attempt | None = None,
) -> Attempt:
    """An update that may begin far from its end, one piece further.

    Its evidence is that of one frame by itself: what the model errs by in this frame it has not told before.
    """
    if not len(belief.contacts):
        update = _nothing(contact_filter, belief, dv, pads, contact_filter.persistence)
        return Attempt(jnp.zeros(0, update.evidence.dtype), None, update.evidence, update.loudness, jnp.asarray(True))
    problem = _problem(contact_filter, belief, dv, pads, contact_filter.persistence)
    begin = _begun(problem) if attempt is None else attempt.z
    found = _fitted(problem, CAREFUL, PIECE, begin, None if attempt is None else attempt.state)
    update = _update(problem, found.value, found.state)
    ended = found.state.converged | (found.state.steps >= MANY_STEPS)
    return Attempt(found.value, found.state, update.evidence, update.loudness, ended)


@verb
def concluded(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, attempt: Attempt
) -> Update:
    """The update to which an attempt has come."""
    if attempt.state is None:
        return _nothing(contact_filter, belief, dv, pads, contact_filter.persistence)
    return _update(_problem(contact_filter, belief, dv, pads, contact_filter.persistence), attempt.z, attempt.state)


@verb
def unexplained(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads
) -> Float[Array, " r"]:
    """What the contacts leave of a frame, (r,), in standard deviations of one frame."""
    if not len(belief.contacts):
        frame, _, share = _seen(contact_filter, dv)
        return frame.y / jnp.sqrt(1 + share)
    problem = _problem(contact_filter, belief, dv, pads, contact_filter.persistence)
    left = (problem.frame.y - problem.shown(jnp.zeros(len(problem.active))).readings) / problem.alone
    root = problem.frame.root
    found: Array = jax.lax.cond(problem.whole, lambda left: left, lambda left: root @ left, left)
    return found


def _nothing(
    contact_filter: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads, seconds: Float[Array, ""]
) -> Update:
    """The update of a belief without contacts: nothing is learned."""
    frame, _, share = _seen(contact_filter, dv)
    scale, alone = _scales(contact_filter, share, seconds)
    on_pads = jnp.sum((pads.force / pads.error) ** 2)
    none = jnp.zeros((), frame.y.dtype)
    return Update(
        belief=belief,
        evidence=-0.5 * (jnp.sum((frame.y / scale) ** 2) + on_pads),
        misfit=jnp.sum((frame.y / alone) ** 2) + on_pads,
        surprise=none,
        loudness=jnp.zeros(0, frame.y.dtype),
        solves=jnp.asarray(0),
        converged=jnp.asarray(True),
    )


def _update(problem: _Problem, z: Float[Array, " a"], state: LeastSquaresState) -> Update:
    """What the change z of the active numbers makes of the belief."""
    normal, square = state.quadratic.hessian.matrix, state.square
    root, ratio = lapack.cholesky(normal, lower=True), problem.scale / problem.alone
    return Update(
        belief=_followed(problem, z, root),
        evidence=-0.5 * square - jnp.sum(jnp.log(jnp.diag(root))),
        misfit=(square - z @ z) * ratio**2,
        surprise=z @ z,
        loudness=_loudness(normal, problem.factor, len(problem.belief.contacts)) * ratio,
        solves=state.steps,
        converged=state.converged,
    )


def _followed(problem: _Problem, z: Float[Array, " a"], root: Float[Array, "a a"]) -> Belief:
    """The belief whose active numbers have changed by C z and have the covariance C N^-1 C^T, with N = R R^T."""
    belief = problem.belief
    across = lapack.solve_triangular(problem.factor, belief.covariance[problem.active], lower=True)
    unit = jnp.eye(len(z), dtype=z.dtype)
    learned = unit - lapack.cho_solve((root, True), unit)
    covariance = belief.covariance - across.T @ (learned @ across)
    flat = jnp.concatenate([belief.contacts.ravel(), belief.gain]) + across.T @ z
    size = belief.contacts.size
    found = 0.5 * (covariance + covariance.T)
    return belief._replace(contacts=flat[:size].reshape(-1, CONTACT_SIZE), gain=flat[size:], covariance=found)


def _loudness(normal: Float[Array, "a a"], factor: Float[Array, "a a"], count: int) -> Float[Array, " K"]:
    """Length of the readings' slope in each contact's log force: for a weak contact, its signal."""
    unit = jnp.eye(len(factor), dtype=factor.dtype)[:, 3 : SEEN_SIZE * count : SEEN_SIZE]
    along = lapack.solve_triangular(factor, unit, lower=True)
    return jnp.sqrt(jnp.maximum(jnp.sum(along * (normal @ along - along), 0), 0))
