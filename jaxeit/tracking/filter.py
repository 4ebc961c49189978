"""The belief of contacts and of the contact layer's gain, and how one frame changes it.

An extended Kalman filter (Jazwinski 1970, ch. 8), whose update is iterated until it is linear enough. A contact is a
load (place, width, force, half length of an edge) with a velocity; loads add as pressure, and the law of the contact
layer turns pressure times gain into conductivity, of which `Reanalysis` knows the readings. The gain ``exp(level +
field)`` is the same in all frames, so its modes are part of the belief: the uncertainty of a place that the gain causes
does not shrink while a contact rests, and the gain is learned where contacts move.

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
from jax.scipy.special import erf
from jaxtyping import Array, Bool, Float, Int

from .._compile import verb
from ..contacts.search import ContactFinder, Frame
from ..effects.material import ContactPiezoresistance
from ..least_squares import ImplicitStep, LevenbergMarquardt
from ..linalg import lapack
from .reanalysis import Reanalysis

# Numbers of a contact: x, y, log width, log force, half an edge along x and y, velocity along x and y.
SIZE, SEEN = 8, 6
# An update is linear enough where a further step would lower half of chi-square by less than this.
FALL = 1.0
# Evaluations of an update, and of one that begins far from its end.
STEPS, MANY_STEPS = 6, 20
# Least half length, m: an edge of length zero has no direction.
SHORTEST = 1e-3

SOLVER = LevenbergMarquardt(rtol=0.0, atol=0.0, fall_rtol=1e-6, fall_atol=FALL)


class Pads(NamedTuple):
    """Forces on the pads in a frame, and their standard errors, (pads,) N; infinite for a pad that tells none."""

    force: Float[Array, " pads"]
    error: Float[Array, " pads"]


class Belief(NamedTuple):
    """Normal distribution of contacts and gain.

    | meaning                                                                  | shape    | unit  |
    |--------------------------------------------------------------------------|----------|-------|
    | contacts: x, y, log width, log force, half an edge (2), velocity (2)     | (K, 8)   | mixed |
    | gain: level, then modes of the field, in units of their prior deviations | (g,)     | 1     |
    | covariance of contacts and gain                                          | (n, n)   | mixed |
    """

    contacts: Float[Array, "K 8"]
    gain: Float[Array, " g"]
    covariance: Float[Array, "n n"]


class Update(NamedTuple):
    """A belief after a frame.

    | meaning                                                                   | shape |
    |---------------------------------------------------------------------------|-------|
    | belief                                                                    |       |
    | evidence: log of the frame's probability before it came, up to a constant | ()    |
    | left: what no contact explains, in standard deviations of a single frame  | (r,)  |
    | surprise: square of the change of the belief, in its standard deviations  | ()    |
    | loudness: of each contact's signal, in standard deviations                | (K,)  |
    """

    belief: Belief
    evidence: Float[Array, ""]
    left: Float[Array, " r"]
    surprise: Float[Array, ""]
    loudness: Float[Array, " K"]


class LogGain(NamedTuple):
    """Log gain of elements (e,) and pixels (n,)."""

    elements: Float[Array, " e"]
    pixels: Float[Array, " n"]


class ContactFilter(eqx.Module):
    """What frames tell of contacts; made by `prepare_tracker`.

    | meaning                                                                  | shape            | unit |
    |--------------------------------------------------------------------------|------------------|------|
    | finder: whitens frames; its atoms are where contacts may begin           |                  |      |
    | sheet: readings of a changed sheet                                       |                  |      |
    | sigma: of the untouched sheet                                            | (elements,)      | S    |
    | points, weights: of the elements                                         | (elements, q, 2), (q,) | m |
    | modes: of the log gain of each element; the first is the level           | (elements, g)    | 1    |
    | places: where the modes lie                                              | (g, 2)           | m    |
    | pixels: their middles                                                    | (p, 2)           | m    |
    | pixel_response: readings per relative change of each, to first order     | (p, r)           | 1    |
    | pixel_modes: of the log gain of each                                     | (p, g)           | 1    |
    | pad_area: area of each pad in each pixel                                 | (pads, p)        | m^2  |
    | law: factor of conductivity by pressure                                  |                  |      |
    | model_error: part of the signal by which mesh, sheet and load shape err  | ()               | 1    |
    | persistence of that error                                                | ()               | s    |
    | rates: random walk of each number of a contact                           | (8,)             | per sqrt(s) |
    """

    finder: ContactFinder
    sheet: Reanalysis
    sigma: Float[Array, " elements"]
    points: Float[Array, "elements q 2"]
    weights: Float[Array, " q"]
    modes: Float[Array, "elements g"]
    places: Float[Array, "g 2"]
    pixels: Float[Array, "p 2"]
    pixel_response: Float[Array, "p r"]
    pixel_modes: Float[Array, "p g"]
    pad_area: Float[Array, "pads p"]
    law: ContactPiezoresistance
    model_error: Float[Array, ""]
    persistence: Float[Array, ""]
    rates: Float[Array, "8"]
    unknowns: int = eqx.field(static=True)
    active_modes: int = eqx.field(static=True)
    near_pixels: int = eqx.field(static=True)

    def pressure(self, contacts: Float[Array, "K 6"], points: Float[Array, "... 2"]) -> Float[Array, "..."]:
        """Pressure of all contacts at points, Pa."""
        pressures = [_edge(one, points) for one in contacts]
        return jnp.sum(jnp.stack(pressures), 0) if pressures else jnp.zeros(points.shape[:-1], points.dtype)

    def near(self, contacts: Float[Array, "K 6"]) -> tuple[Int[Array, " e"], Int[Array, " n"]]:
        """Elements under contacts, and pixels under and around them; pressure elsewhere is next to nothing."""
        quick, count = contacts.astype(self.points.dtype), len(contacts)
        middles = self.points.mean(1)
        elements = jax.lax.top_k(self.pressure(quick, middles), min(2 * self.unknowns * count, len(middles)))[1]
        pixels = jax.lax.top_k(self.pressure(quick, self.pixels), min(self.near_pixels * count, len(self.pixels)))[1]
        return elements, pixels

    def response(
        self, contacts: Float[Array, "K 6"], near: tuple[Int[Array, " e"], Int[Array, " n"]], gain: "LogGain"
    ) -> Float[Array, " r"]:
        """Whitened readings of contacts, from what is near them and the gain there."""
        elements, pixels = near
        quick = self.points.dtype
        law = jax.tree.map(lambda leaf: leaf.astype(quick), self.law)
        loads = contacts.astype(quick)
        of_pixels = self.pressure(loads, self.pixels[pixels]) * jnp.exp(gain.pixels.astype(quick))
        first = (law.factor(of_pixels) - 1) @ self.pixel_response[pixels]
        of_points = self.pressure(loads, self.points[elements]) * jnp.exp(gain.elements.astype(quick))[:, None]
        change = self.sigma[elements] * (law.factor(of_points) @ self.weights - 1)
        size = min(self.unknowns * len(contacts), len(self.sheet.green))
        found: Array = (first + self.sheet.beyond(elements, change, size)).astype(contacts.dtype)
        return found

    def pad_forces(self, contacts: Float[Array, "K 6"]) -> Float[Array, " pads"]:
        """Force of the contacts on each pad, N."""
        return self.pad_area @ self.pressure(contacts, self.pixels.astype(contacts.dtype))


def _edge(one: Float[Array, "6"], points: Float[Array, "... 2"]) -> Float[Array, "..."]:
    """Pressure of one load: even along a line, blurred by a Gaussian; of a length near zero, a Gaussian."""
    width, half = jnp.exp(one[2]), jnp.sqrt(one[4:] @ one[4:] + SHORTEST**2)
    away = points - one[:2]
    along = away @ one[4:] / half
    across = jnp.sum(away**2, -1) - along**2
    root = np.sqrt(2.0) * width
    spread = (erf((along + half) / root) - erf((along - half) / root)) / (4 * half)
    found: Array = jnp.exp(one[3] - 0.5 * across / width**2) * spread / (np.sqrt(2 * np.pi) * width)
    return found


@verb
def predicted(tracker: ContactFilter, belief: Belief, seconds: Float[Array, ""]) -> Belief:
    """The belief so many seconds later: contacts move on, and may change."""
    count, size = len(belief.contacts), belief.contacts.size
    step = jnp.eye(SIZE).at[:2, 6:].set(seconds * jnp.eye(2))
    # A velocity that walks at random: the integrated Wiener process, exactly.
    walk = jnp.diag(tracker.rates**2 * seconds)
    drift = tracker.rates[6:] ** 2
    walk = walk.at[:2, :2].add(jnp.diag(drift * seconds**3 / 3))
    walk = walk.at[:2, 6:].add(jnp.diag(drift * seconds**2 / 2)).at[6:, :2].add(jnp.diag(drift * seconds**2 / 2))
    whole = jnp.kron(jnp.eye(count), step)
    rows = belief.covariance.at[:size].set(whole @ belief.covariance[:size])
    both = rows.at[:, :size].set(rows[:, :size] @ whole.T)
    covariance = both.at[:size, :size].add(jnp.kron(jnp.eye(count), walk))
    return Belief(belief.contacts @ step.T, belief.gain, covariance)


class _Problem(NamedTuple):
    """One update: the filter, the frame, whether it is whole, pads, the belief before, active numbers, their factor."""

    tracker: ContactFilter
    frame: Frame
    whole: Bool[Array, ""]
    pads: Pads
    belief: Belief
    active: Int[Array, " a"]
    factor: Float[Array, "a a"]
    scale: Float[Array, ""]
    near: tuple[Int[Array, " e"], Int[Array, " n"]]

    def contacts(self, change: Float[Array, " a"]) -> Float[Array, "K 6"]:
        """Contacts after a change of the active numbers."""
        before = self.belief.contacts[:, :SEEN]
        return before + change[: before.size].reshape(-1, SEEN)

    def log_gain(self, change: Float[Array, " a"]) -> LogGain:
        """Log gain near the contacts after a change of the active numbers."""
        size, seen = self.belief.contacts.size, SEEN * len(self.belief.contacts)
        tables = self.tracker.modes[self.near[0]], self.tracker.pixel_modes[self.near[1]]
        moved = [modes @ self.belief.gain + modes[:, self.active[seen:] - size] @ change[seen:] for modes in tables]
        return LogGain(*moved)


def _residual(z: Float[Array, " a"], problem: _Problem) -> tuple[Float[Array, " n"], Float[Array, " r"]]:
    """What the belief after z leaves of the frame, of the pads and of the belief before, in standard deviations; and
    the first of these."""
    change, tracker = problem.factor @ z, problem.tracker
    contacts = problem.contacts(change)
    found = tracker.response(contacts, problem.near, problem.log_gain(change))
    mixed = jax.lax.cond(problem.whole, lambda r: r, lambda r: problem.frame.root @ r, found)
    left = (problem.frame.y - mixed) / problem.scale
    on_pads = (tracker.pad_forces(contacts) - problem.pads.force) / problem.pads.error
    return jnp.concatenate([left, on_pads, z]), left


def _active(tracker: ContactFilter, contacts: Float[Array, "K 8"]) -> Int[Array, " a"]:
    """Numbers of the belief that a frame tells of: of the contacts, the level, and the modes around contacts."""
    count = len(contacts)
    own = (SIZE * np.arange(count)[:, None] + np.arange(SEEN)).ravel()
    square = jnp.min(jnp.sum((tracker.places[1:, None] - contacts[None, :, :2]) ** 2, -1), 1)
    around = 1 + jax.lax.top_k(-square, min(tracker.active_modes * count, square.size))[1]
    return jnp.concatenate([jnp.asarray(own), jnp.asarray([SIZE * count]), SIZE * count + around])


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
    frame, whole = tracker.finder.compressed(jnp.asarray(dv, tracker.finder.compress.dtype))
    share = tracker.model_error**2 * (frame.y @ frame.y) / len(frame.y)
    alone = jnp.sqrt(1 + share)
    scale = jnp.sqrt(1 + jnp.maximum(tracker.persistence / seconds, 1) * share)
    if not len(belief.contacts):
        return _nothing(belief, frame.y, pads, alone, scale)
    active = _active(tracker, belief.contacts)
    factor = lapack.cholesky(belief.covariance[jnp.ix_(active, active)], lower=True)
    near = tracker.near(belief.contacts[:, :SEEN])
    problem = _Problem(tracker, frame, whole, pads, belief, active, factor, scale, near)
    residual: Any = _residual  # the types of optimistix know no auxiliary output
    found: optx.Solution[Array, Any] = optx.least_squares(
        residual,
        SOLVER,
        jnp.zeros(len(active), factor.dtype),
        problem,
        has_aux=True,
        max_steps=MANY_STEPS if many else STEPS,
        adjoint=ImplicitStep(),
        throw=False,
    )
    z, normal = found.value, found.state.quadratic.hessian.matrix
    # The step that has not been evaluated changes what is left by less than the square root of FALL.
    return Update(
        belief=_followed(belief, active, factor, z, normal),
        evidence=-0.5 * found.state.square - jnp.sum(jnp.log(jnp.diag(lapack.cholesky(normal, lower=True)))),
        left=found.aux * scale / alone,
        surprise=z @ z,
        loudness=_loudness(normal, factor, len(belief.contacts)) * scale / alone,
    )


def _nothing(
    belief: Belief, y: Float[Array, " r"], pads: Pads, alone: Float[Array, ""], scale: Float[Array, ""]
) -> Update:
    """The update of a belief without contacts: nothing is learned."""
    square = jnp.sum((y / scale) ** 2) + jnp.sum((pads.force / pads.error) ** 2)
    return Update(belief, -0.5 * square, y / alone, jnp.zeros((), y.dtype), jnp.zeros(0, y.dtype))


def _followed(
    belief: Belief,
    active: Int[Array, " a"],
    factor: Float[Array, "a a"],
    z: Float[Array, " a"],
    normal: Float[Array, "a a"],
) -> Belief:
    """The belief whose active numbers have changed by C z and have the covariance C N^-1 C^T."""
    across = lapack.solve_triangular(factor, belief.covariance[active], lower=True)
    learned = jnp.eye(len(z), dtype=z.dtype) - lapack.cho_solve(lapack.cho_factor(normal, lower=True), jnp.eye(len(z)))
    covariance = belief.covariance - across.T @ (learned @ across)
    flat = jnp.concatenate([belief.contacts.ravel(), belief.gain]) + across.T @ z
    size = belief.contacts.size
    return Belief(flat[:size].reshape(-1, SIZE), flat[size:], 0.5 * (covariance + covariance.T))


def _loudness(normal: Float[Array, "a a"], factor: Float[Array, "a a"], count: int) -> Float[Array, " K"]:
    """Length of the readings' slope in each contact's log force: for a weak contact, its signal."""
    unit = jnp.eye(len(factor), dtype=factor.dtype)[:, 3 : SEEN * count : SEEN]
    along = lapack.solve_triangular(factor, unit, lower=True)
    return jnp.sqrt(jnp.maximum(jnp.sum(along * (normal @ along - along), 0), 0))
