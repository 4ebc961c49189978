"""Errors of contacts that are the same in all frames: by the shapes of loads, the coat and errors of the model.

The filter takes a load for Gaussian, or for even along an edge, and a sheet of which no untouched frame is at hand for
even. A tip of another shape and the coat are the same in all frames, so that no frame lessens what they make the
contact err by; and a filter that learned shapes would take a second contact for the shape of the first. Errors of mesh
and contact layer last as long as a press, and the filter forgets them after `TrackerSettings.persistence`, lest it take
them for further contacts. What all of these may cause is added where a contact is handed out: a "consider" covariance
(Schmidt 1966, Advances in Control Systems 3; Bierman 1977, ch. 8). With the slopes J of frames and pads in the state
of the belief, S in the moments of the shapes, in the modes of the coat and in the errors of the model, all in units of
their standard deviations, and the prior covariance P of the state, contacts that rest for n frames come to err by

    (n J^T J + P^-1)^-1 n J^T S s,      s ~ N(0, 1).
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._compile import verb
from ...linalg import lapack
from .contact_filter import ContactFilter, active_indices, informative_pads
from .state import LOAD_SIZE, ROUND_HALF_LENGTH, Belief, Pads

# Number n of frames, each with an error of the model of its own, after which the frames outweigh P.
REST_FRAMES = 10
# Moments of the shape of each load.
SHAPE_MOMENTS = 6
# Changes of position, log width, log force and half an edge within which a covariance stays valid.
VALIDITY_RANGE = np.array([0.002, 0.002, 0.1, 0.2, 0.002, 0.002])


@verb
def consider_covariance(
    contact_filter: ContactFilter, belief: Belief, pads: Pads, unexplained: Float[Array, ""]
) -> Float[Array, "K 6 6"]:
    """Covariance of the load of each contact by unknown shapes, an unknown coat and errors of the model.

    Args:
        belief: of one contact or more.
        pads: forces on the pads, of which only the errors count.
        unexplained: variance of the effect of a press on the gain that the belief leaves out
            (`LearnedLayer.unexplained`); forces err by it, and positions hardly.
    """
    contacts, count = belief.contacts[:, :LOAD_SIZE], len(belief.contacts)
    active = active_indices(contact_filter, belief.contacts)
    near = contact_filter.sheet.neighbourhood(contacts)
    pads = informative_pads(contact_filter, belief.contacts, near, pads)
    modes = active[contacts.size :] - belief.contacts.size
    predicted = contact_filter.sheet.predict_measurement(contacts, belief.gain, modes, near, shapes=True)
    square = (predicted.readings @ predicted.readings) / len(predicted.readings)
    scale = jnp.sqrt((1 + contact_filter.error_share * square) / REST_FRAMES)
    pad_error = pads.error / math.sqrt(REST_FRAMES)
    slopes = jnp.concatenate([predicted.reading_slopes / scale, predicted.pad_slopes / pad_error], 1)
    load_slopes, gain_slopes = jnp.split(slopes, [count * (LOAD_SIZE + SHAPE_MOMENTS)])
    load_slopes = load_slopes.reshape(count, LOAD_SIZE + SHAPE_MOMENTS, -1)
    contact_slopes, nuisance_slopes = jnp.split(load_slopes, [LOAD_SIZE], 1)
    parameter_slopes = jnp.concatenate([contact_slopes.reshape(count * LOAD_SIZE, -1), gain_slopes])
    nuisance_slopes = contact_filter.shape * nuisance_slopes.reshape(count * SHAPE_MOMENTS, -1)
    if contact_filter.sheet.coat.shape[1]:
        coat_slopes = contact_filter.sheet.coat_slopes(contacts, belief.gain, near) / scale
        # The forces on pads do not depend on the coat.
        nuisance_slopes = jnp.concatenate([nuisance_slopes, jnp.pad(coat_slopes, ((0, 0), (0, len(pad_error))))])
    load_std = jnp.broadcast_to(contact_filter.spread, (count, len(contact_filter.spread)))
    half_std = jnp.maximum(jnp.abs(contacts[:, 4:]), ROUND_HALF_LENGTH)
    gain_std = jnp.ones(len(modes), half_std.dtype)
    prior_std = jnp.concatenate([jnp.concatenate([load_std, half_std], 1).ravel(), gain_std])
    whitened = prior_std[:, None] * parameter_slopes
    root = lapack.cholesky(whitened @ whitened.T + jnp.eye(len(prior_std), dtype=prior_std.dtype), lower=True)
    # The model errs in each reading by itself.
    model_error = contact_filter.model_error * jnp.sqrt(square) / scale * whitened[:, : len(predicted.readings)]
    cross = jnp.concatenate([whitened @ nuisance_slopes.T, model_error, whitened @ gain_slopes.T], 1)
    shift = prior_std[:, None] * lapack.cho_solve((root, True), cross)
    shift = shift[: contacts.size].reshape(count, LOAD_SIZE, -1)
    error, press_error = jnp.split(shift, [cross.shape[1] - len(modes)], 2)
    found = jnp.einsum("kim,kjm->kij", error, error)
    return found.at[:, 3, 3].add(unexplained * jnp.sum(press_error[:, 3] ** 2, 1))


class ConsiderErrors(NamedTuple):
    """Errors of contacts by unknown shapes, an unknown coat and errors of the model.

    | meaning                                                                | shape     | unit  |
    |------------------------------------------------------------------------|-----------|-------|
    | numbers: of the contacts                                               |           |       |
    | contacts: the loads for which the covariance was computed              | (K, 6)    | mixed |
    | covariance that is added to that of the belief                         | (K, 6, 6) | mixed |
    """

    numbers: tuple[int, ...] = ()
    contacts: np.ndarray = np.zeros((0, LOAD_SIZE))
    covariance: np.ndarray = np.zeros((0, LOAD_SIZE, LOAD_SIZE))

    def is_valid_for(self, numbers: tuple[int, ...], contacts: Float[np.ndarray, "K 8"]) -> bool:
        """Whether the covariance is still that of these contacts."""
        if numbers != self.numbers:
            return False
        return bool((np.abs(contacts[:, :LOAD_SIZE] - self.contacts) < VALIDITY_RANGE).all())

    def add_to(self, number: int, covariance: Float[np.ndarray, "8 8"]) -> Float[np.ndarray, "8 8"]:
        """The covariance of a contact plus that of these errors, if they are known of this contact."""
        if number not in self.numbers:
            return covariance
        total = np.array(covariance)
        total[:LOAD_SIZE, :LOAD_SIZE] += self.covariance[self.numbers.index(number)]
        return total
