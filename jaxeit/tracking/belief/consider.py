"""What contacts err by because of what stays the same in all frames: shapes of loads, coat, errors of the model.

The filter takes a load for Gaussian, or for even along an edge, and a sheet of which no untouched frame is at hand for
even. A tip of another shape and the coat are the same in all frames, so that no frame lessens what they make the
contact err by; and a filter that learned shapes would take a second contact for the shape of the first. Errors of mesh
and contact layer last as long as a press, and the filter forgets them after `TrackerSettings.persistence`, lest it take
them for further contacts. What all of these may cause is added where a contact is handed out: a "consider" covariance
(Schmidt 1966, Advances in Control Systems 3; Bierman 1977, ch. 8). With the slopes J of frames and pads in the numbers
of the belief, S in the moments of the shapes, in the modes of the coat and in the errors of the model, all in units of
their standard deviations, and the covariance P of the numbers before any frame, contacts that rest for n frames come to
err by

    (n J^T J + P^-1)^-1 n J^T S s,      s ~ N(0, 1).
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._compile import verb
from ...linalg import lapack
from .filter import ROUND_HALF, SEEN_SIZE, Belief, ContactFilter, Pads, active_numbers, telling_pads

# Frames n, each with an error of the model of its own, after which contacts are told by the frames and not by P.
FRAMES = 10
# Moments of the shape of each load.
MOMENTS = 6
# Changes of place, log width, log force and half an edge within which the covariance is taken for the same.
CHANGED = np.array([0.002, 0.002, 0.1, 0.2, 0.002, 0.002])


@verb
def consider_covariance(
    contact_filter: ContactFilter, belief: Belief, pads: Pads, unexplained: Float[Array, ""]
) -> Float[Array, "K 6 6"]:
    """Covariance of the first six numbers of each contact that unknown shapes, coat and errors of the model cause.

    Args:
        belief: of one contact or more.
        pads: whose errors say how closely they tell forces.
        unexplained: variance of the effect of a press on the gain that the belief leaves out
            (`LearnedLayer.unexplained`); forces err by it, and places hardly.
    """
    contacts, count = belief.contacts[:, :SEEN_SIZE], len(belief.contacts)
    active = active_numbers(contact_filter, belief.contacts)
    near = contact_filter.sheet.near(contacts)
    pads = telling_pads(contact_filter, belief.contacts, near, pads)
    modes = active[contacts.size :] - belief.contacts.size
    shown = contact_filter.sheet.shown(contacts, belief.gain, modes, near, shapes=True)
    square = (shown.readings @ shown.readings) / len(shown.readings)
    scale, error = jnp.sqrt((1 + contact_filter.error_share * square) / FRAMES), pads.error / math.sqrt(FRAMES)
    every = jnp.concatenate([shown.reading_slopes / scale, shown.pad_slopes / error], 1)
    of_loads, of_modes = jnp.split(every, [count * (SEEN_SIZE + MOMENTS)])
    of_numbers, bent = jnp.split(of_loads.reshape(count, SEEN_SIZE + MOMENTS, -1), [SEEN_SIZE], 1)
    slopes = jnp.concatenate([of_numbers.reshape(count * SEEN_SIZE, -1), of_modes])
    bent = contact_filter.shape * bent.reshape(count * MOMENTS, -1)
    if contact_filter.sheet.coat.shape[1]:
        by_coat = contact_filter.sheet.coat_slopes(contacts, belief.gain, near) / scale
        # The forces on pads do not depend on the coat.
        bent = jnp.concatenate([bent, jnp.pad(by_coat, ((0, 0), (0, len(error))))])
    usual = jnp.broadcast_to(contact_filter.spread, (count, len(contact_filter.spread)))
    halves = jnp.maximum(jnp.abs(contacts[:, 4:]), ROUND_HALF)
    of_gain = jnp.ones(len(modes), halves.dtype)
    before = jnp.concatenate([jnp.concatenate([usual, halves], 1).ravel(), of_gain])
    whitened = before[:, None] * slopes
    root = lapack.cholesky(whitened @ whitened.T + jnp.eye(len(before), dtype=before.dtype), lower=True)
    # The model errs in each reading by itself.
    by_model = contact_filter.model_error * jnp.sqrt(square) / scale * whitened[:, : len(shown.readings)]
    towards = jnp.concatenate([whitened @ bent.T, by_model, whitened @ of_modes.T], 1)
    moved = before[:, None] * lapack.cho_solve((root, True), towards)
    own, by_press = jnp.split(moved[: contacts.size].reshape(count, SEEN_SIZE, -1), [towards.shape[1] - len(modes)], 2)
    found = jnp.einsum("kim,kjm->kij", own, own)
    return found.at[:, 3, 3].add(unexplained * jnp.sum(by_press[:, 3] ** 2, 1))


class ConsiderErrors(NamedTuple):
    """What unknown shapes, an unknown coat and errors of the model make contacts err by.

    | meaning                                                                | shape     | unit  |
    |------------------------------------------------------------------------|-----------|-------|
    | numbers: of the contacts                                               |           |       |
    | contacts: the first six numbers of each, for which this was found      | (K, 6)    | mixed |
    | covariance that is added to that of the belief                         | (K, 6, 6) | mixed |
    """

    numbers: tuple[int, ...] = ()
    contacts: np.ndarray = np.zeros((0, SEEN_SIZE))
    covariance: np.ndarray = np.zeros((0, SEEN_SIZE, SEEN_SIZE))

    def holds(self, numbers: tuple[int, ...], contacts: Float[np.ndarray, "K 8"]) -> bool:
        """Whether the covariance is that of these contacts still."""
        return numbers == self.numbers and bool((np.abs(contacts[:, :SEEN_SIZE] - self.contacts) < CHANGED).all())

    def added(self, number: int, covariance: Float[np.ndarray, "8 8"]) -> Float[np.ndarray, "8 8"]:
        """The covariance of a contact with what these errors add to it; nothing to that of another contact."""
        if number not in self.numbers:
            return covariance
        whole = np.array(covariance)
        whole[:SEEN_SIZE, :SEEN_SIZE] += self.covariance[self.numbers.index(number)]
        return whole
