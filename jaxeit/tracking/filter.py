"""The belief of contacts and of the contact layer's gain, and how one frame changes it.

An extended Kalman filter (Jazwinski 1970, ch. 8), whose update is iterated until it is linear enough. A contact is a
load (place, width, force, half length of an edge, shape) with a velocity; loads add as pressure, and the law of the
contact layer turns pressure times gain into conductivity, of which `Reanalysis` knows the readings. The gain
``exp(level + field)`` is the same in all frames, so its modes are part of the belief: the uncertainty of a place that
the gain causes does not shrink while a contact rests, and the gain is learned where contacts move. Nor does that which
an unknown shape causes, which hardly changes while a contact lasts.

Only the parameters that a frame tells of are active in an update: places, widths, forces, half lengths, the level and
the modes around contacts. With their covariance ``P = C C^T`` the update minimises ``|y - h|^2 / s^2 + |z|^2`` over z,
where ``C z`` is the change of the active parameters; all others follow by their covariance with these.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from .._compile import verb
from ..contacts.search import ContactFinder, Frame
from ..least_squares import ImplicitStep, LevenbergMarquardt, normal_equations
from ..linalg import lapack
from .response import LoadedSheet, Near, Shown

# Numbers of a contact: x, y, log width, log force, half an edge along x and y, six of its shape (`pressure.shaped`),
# velocity along x and y; of these all but the velocity are seen in a frame.
SIZE, SEEN = 14, 12
EDGE, SHAPE, VELOCITY = slice(4, 6), slice(6, SEEN), slice(SEEN, SIZE)
# An update is linear enough where a further step would lower half of chi-square by less than this.
FALL = 1.0
# Evaluations of an update, and of one that begins far from its end.
STEPS, MANY_STEPS = 6, 12

SOLVER = LevenbergMarquardt(rtol=0.0, atol=0.0, fall_rtol=1e-6, fall_atol=FALL)


class Pads(NamedTuple):
    """Forces on the pads in a frame, and their standard errors, (pads,) N; infinite for a pad that tells none."""

    force: Float[Array, " pads"]
    error: Float[Array, " pads"]


class Belief(NamedTuple):
    """Normal distribution of contacts and gain.

    | meaning                                                                  | shape    | unit  |
    |--------------------------------------------------------------------------|----------|-------|
    | contacts: x, y, log width, log force, half an edge (2), shape (6), velocity (2) | (K, 14) | mixed |
    | gain: level, then modes of the field, in units of their prior deviations | (g,)     | 1     |
    | covariance of contacts and gain                                          | (n, n)   | mixed |
    """

    contacts: Float[Array, "K 14"]
    gain: Float[Array, " g"]
    covariance: Float[Array, "n n"]


class Update(NamedTuple):
    """A belief after a frame.

    | meaning                                                                   | shape |
    |---------------------------------------------------------------------------|-------|
    | belief                                                                    |       |
    | evidence: log of the frame's probability before it came, up to a constant | ()    |
    | misfit: chi-square of the frame and the pads                              | ()    |
    | surprise: square of the change of the belief, in its standard deviations  | ()    |
    | loudness: of each contact's signal, in standard deviations                | (K,)  |
    """

    belief: Belief
    evidence: Float[Array, ""]
    misfit: Float[Array, ""]
    surprise: Float[Array, ""]
    loudness: Float[Array, " K"]


class ContactFilter(eqx.Module):
    """What frames tell of contacts; made by `prepare_tracker`.

    | meaning                                                                  | shape            | unit |
    |--------------------------------------------------------------------------|------------------|------|
    | finder: whitens frames; its atoms are where contacts may begin           |                  |      |
    | compress: whitened readings of a frame that lacks none                   | (r, readings)    | 1/V  |
    | sheet: what contacts show                                                |                  |      |
    | places: where the modes of the gain lie; the first is the level          | (g, 2)           | m    |
    | model_error: part of the signal by which mesh, sheet and load shape err  | ()               | 1    |
    | persistence of that error                                                | ()               | s    |
    | rates: random walk of each number of a contact                           | (14,)            | per sqrt(s) |
    """

    finder: ContactFinder
    compress: Float[Array, "r readings"]
    sheet: LoadedSheet
    places: Float[Array, "g 2"]
    model_error: Float[Array, ""]
    persistence: Float[Array, ""]
    rates: Float[Array, "14"]
    active_modes: int = eqx.field(static=True)


@verb
def predicted(tracker: ContactFilter, belief: Belief, seconds: Float[Array, ""]) -> Belief:
    """The belief so many seconds later: contacts move on, and may change."""
    count, size = len(belief.contacts), belief.contacts.size
    step = jnp.eye(SIZE).at[:2, VELOCITY].set(seconds * jnp.eye(2))
    # A velocity that walks at random: the integrated Wiener process, exactly.
    walk = jnp.diag(tracker.rates**2 * seconds)
    drift = tracker.rates[VELOCITY] ** 2
    walk = walk.at[:2, :2].add(jnp.diag(drift * seconds**3 / 3))
    walk = (
        walk.at[:2, VELOCITY]
        .add(jnp.diag(drift * seconds**2 / 2))
        .at[VELOCITY, :2]
        .add(jnp.diag(drift * seconds**2 / 2))
    )
    whole = jnp.kron(jnp.eye(count), step)
    rows = belief.covariance.at[:size].set(whole @ belief.covariance[:size])
    both = rows.at[:, :size].set(rows[:, :size] @ whole.T)
    covariance = both.at[:size, :size].add(jnp.kron(jnp.eye(count), walk))
    return Belief(belief.contacts @ step.T, belief.gain, covariance)


class _Problem(NamedTuple):
    """One update.

    | meaning                                                          |
    |------------------------------------------------------------------|
    | tracker, frame, pads; whole: whether the frame lacks no reading  |
    | belief before the frame                                          |
    | active: numbers of the belief that the frame tells of            |
    | factor C of their covariance                                     |
    | scale: standard deviation of a whitened reading                  |
    | near: what is near the contacts before the frame                 |
    """

    tracker: ContactFilter
    frame: Frame
    whole: Bool[Array, ""]
    pads: Pads
    belief: Belief
    active: Int[Array, " a"]
    factor: Float[Array, "a a"]
    scale: Float[Array, ""]
    near: Near

    def shown(self, z: Float[Array, " a"]) -> Shown:
        """What the frame and the pads show if the active numbers change by C z; with slopes in z."""
        change, before = self.factor @ z, self.belief.contacts[:, :SEEN]
        modes = self.active[before.size :] - self.belief.contacts.size
        gain = self.belief.gain.at[modes].add(change[before.size :])
        contacts = before + change[: before.size].reshape(-1, SEEN)
        found = self.tracker.sheet.shown(contacts, gain, modes, self.near)

        def mixed(*a: Array) -> tuple[Array, ...]:
            return tuple(one @ self.frame.root.T for one in a)

        seen = jax.lax.cond(self.whole, lambda *a: a, mixed, found.readings, found.reading_slopes)
        return Shown(seen[0], found.pads, self.factor.T @ seen[1], self.factor.T @ found.pad_slopes)

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


def _active(tracker: ContactFilter, contacts: Float[Array, "K 14"]) -> Int[Array, " a"]:
    """Numbers of the belief that a frame tells of: of the contacts, the level, and the modes around contacts."""
    count = len(contacts)
    own = (SIZE * np.arange(count)[:, None] + np.arange(SEEN)).ravel()
    known = jnp.asarray([*own, SIZE * count], jnp.int32)
    square = jnp.min(jnp.sum((tracker.places[1:, None] - contacts[None, :, :2]) ** 2, -1), 1)
    around = 1 + jax.lax.top_k(-square, min(tracker.active_modes * count, square.size))[1]
    return jnp.concatenate([known, SIZE * count + around.astype(jnp.int32)])


def _seen(tracker: ContactFilter, dv: Float[Array, " readings"]) -> tuple[Frame, Bool[Array, ""], Float[Array, ""]]:
    """A frame as it is fitted, whether it lacks no reading, and the share of the model in the variance of a number."""
    dv = jnp.asarray(dv, tracker.compress.dtype)
    y = tracker.compress @ dv  # of channels that are not used the matrix is zero, but not its product with NaN
    whole = jnp.all(jnp.isfinite(y))
    none = jnp.zeros((), y.dtype)
    quick = Frame(y, none, none, tracker.finder.root)
    frame = jax.lax.cond(whole, lambda dv: quick, lambda dv: tracker.finder.compressed(dv)[0], dv)
    whole = whole | jnp.all(jnp.isfinite(dv) | ~tracker.finder.whitening.channels)
    return frame, whole, tracker.model_error**2 * (frame.y @ frame.y) / len(frame.y)


def _problem(
    tracker: ContactFilter, belief: Belief, frame: Frame, whole: Bool[Array, ""], pads: Pads, scale: Float[Array, ""]
) -> _Problem:
    active = _active(tracker, belief.contacts)
    factor = lapack.cholesky(belief.covariance[jnp.ix_(active, active)], lower=True)
    near = tracker.sheet.near(belief.contacts[:, :SEEN])
    return _Problem(tracker, frame, whole, pads, belief, active, factor, scale, near)


@verb
def updated(
    tracker: ContactFilter,
    belief: Belief,
    dv: Float[Array, " readings"],
    pads: Pads,
    seconds: Float[Array, ""],
    many: bool = False,
) -> Update:
    """The belief after a difference frame (readings,) V and the forces on the pads.

    Args:
        seconds: since the last frame. Errors of the model that stay for n frames are told n times, and count once.
        many: a step of full length may be too long, as for a contact that has just been put somewhere.
    """
    frame, whole, share = _seen(tracker, dv)
    repeats = jnp.maximum(tracker.persistence / seconds, 1)
    scale, alone = jnp.sqrt(1 + repeats * share), jnp.sqrt(1 + share)
    if not len(belief.contacts):
        return _nothing(belief, frame.y, pads, alone, scale)
    problem = _problem(tracker, belief, frame, whole, pads, scale)
    found: optx.Solution[Array, Any] = optx.least_squares(
        _residual,
        SOLVER,
        jnp.zeros(len(problem.active), problem.factor.dtype),
        problem,
        {"quadratic": _quadratic},
        max_steps=MANY_STEPS if many else STEPS,
        adjoint=ImplicitStep(),
        throw=False,
    )
    z, normal, square = found.value, found.state.quadratic.hessian.matrix, found.state.square
    root = lapack.cholesky(normal, lower=True)
    return Update(
        belief=_followed(belief, problem, z, root),
        evidence=-0.5 * square - jnp.sum(jnp.log(jnp.diag(root))),
        misfit=(square - z @ z) * (scale / alone) ** 2,
        surprise=z @ z,
        loudness=_loudness(normal, problem.factor, len(belief.contacts)) * scale / alone,
    )


@verb
def unexplained(
    tracker: ContactFilter, belief: Belief, dv: Float[Array, " readings"], pads: Pads
) -> Float[Array, " r"]:
    """What the contacts leave of a frame, (r,), in standard deviations of one frame."""
    frame, whole, share = _seen(tracker, dv)
    alone = jnp.sqrt(1 + share)
    if not len(belief.contacts):
        return frame.y / alone
    problem = _problem(tracker, belief, frame, whole, pads, alone)
    left = (frame.y - problem.shown(jnp.zeros(len(problem.active))).readings) / alone
    found: Array = jax.lax.cond(whole, lambda left: left, lambda left: frame.root @ left, left)
    return found


def _nothing(
    belief: Belief, y: Float[Array, " r"], pads: Pads, alone: Float[Array, ""], scale: Float[Array, ""]
) -> Update:
    """The update of a belief without contacts: nothing is learned."""
    on_pads = jnp.sum((pads.force / pads.error) ** 2)
    none = jnp.zeros((), y.dtype)
    evidence = -0.5 * (jnp.sum((y / scale) ** 2) + on_pads)
    return Update(belief, evidence, jnp.sum((y / alone) ** 2) + on_pads, none, jnp.zeros(0, y.dtype))


def _followed(belief: Belief, problem: _Problem, z: Float[Array, " a"], root: Float[Array, "a a"]) -> Belief:
    """The belief whose active numbers have changed by C z and have the covariance C N^-1 C^T, with N = R R^T."""
    across = lapack.solve_triangular(problem.factor, belief.covariance[problem.active], lower=True)
    unit = jnp.eye(len(z), dtype=z.dtype)
    learned = unit - lapack.cho_solve((root, True), unit)
    covariance = belief.covariance - across.T @ (learned @ across)
    flat = jnp.concatenate([belief.contacts.ravel(), belief.gain]) + across.T @ z
    size = belief.contacts.size
    return Belief(flat[:size].reshape(-1, SIZE), flat[size:], 0.5 * (covariance + covariance.T))


def _loudness(normal: Float[Array, "a a"], factor: Float[Array, "a a"], count: int) -> Float[Array, " K"]:
    """Length of the readings' slope in each contact's log force: for a weak contact, its signal."""
    unit = jnp.eye(len(factor), dtype=factor.dtype)[:, 3 : SEEN * count : SEEN]
    along = lapack.solve_triangular(factor, unit, lower=True)
    return jnp.sqrt(jnp.maximum(jnp.sum(along * (normal @ along - along), 0), 0))
