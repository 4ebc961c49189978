"""The compiled programs of a filter of contacts, for calls from a loop in Python."""

from collections.abc import Callable, Iterator

import jax
import numpy as np
from jaxtyping import Array, Float

from ..._compile import bind
from .consider import consider_covariance
from .filter import (
    Attempt,
    Belief,
    ContactFilter,
    Pads,
    Update,
    attempted,
    concluded,
    followed,
    predicted,
    unexplained,
)

# Places where the fit of a contact begins, and their least distance, m.
STARTS, APART = 4, 0.01
# Evaluations of the fit of a single press.
PRESS_STEPS = 24


class Programs:
    """What a `ContactFilter` computes, with its arrays packed; each number of contacts is compiled once.

    `size`: number of whitened readings of a frame.
    """

    def __init__(self, contact_filter: ContactFilter):
        self.size = len(contact_filter.compress)
        self._followed: Callable[..., tuple[Belief, Update]] = bind(followed, contact_filter)
        self._predicted: Callable[..., Belief] = bind(predicted, contact_filter)
        self._attempted: Callable[..., Attempt] = bind(attempted, contact_filter)
        self._concluded: Callable[..., Update] = bind(concluded, contact_filter)
        self._consider_covariance: Callable[..., Array] = bind(consider_covariance, contact_filter)
        self._unexplained: Callable[..., Array] = bind(unexplained, contact_filter)
        self._atoms, self._starts = (
            np.asarray(contact_filter.finder.atoms),
            np.asarray(contact_filter.finder.starts)[:, :2],
        )
        self._dtype = contact_filter.places.dtype

    def followed(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, seconds: float
    ) -> tuple[Belief, Update]:
        """See `filter.followed`."""
        return self._followed(_free(belief), dv, pads, np.asarray(seconds, self._dtype))

    def predicted(self, belief: Belief, seconds: float) -> Belief:
        """See `filter.predicted`."""
        return self._predicted(_free(belief), np.asarray(seconds, self._dtype))

    def attempted(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, attempt: Attempt | None
    ) -> Attempt:
        """See `filter.attempted`."""
        return self._attempted(_free(belief), dv, pads, attempt)

    def careful(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads) -> Update:
        """The update of a frame by itself that may begin far from its end, as that of a single press."""
        return self.concluded(belief, dv, pads, self.completed(belief, dv, pads, PRESS_STEPS))

    def completed(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, most: int) -> Attempt:
        """What is `attempted`, until it has converged or taken ``most`` steps."""
        attempt = self.attempted(belief, dv, pads, None)
        while attempt.state is not None and not attempt.state.converged and attempt.state.steps < most:
            attempt = self.attempted(belief, dv, pads, attempt)
        return attempt

    def concluded(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, attempt: Attempt) -> Update:
        """See `filter.concluded`."""
        return self._concluded(_free(belief), dv, pads, attempt)

    def consider_covariance(self, belief: Belief, pads: Pads, unexplained: float) -> Float[np.ndarray, "K 6 6"]:
        """See `consider.consider_covariance`."""
        return np.asarray(self._consider_covariance(_free(belief), pads, np.asarray(unexplained, self._dtype)))

    def unexplained_place(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads
    ) -> Float[np.ndarray, "2"]:
        """Where a contact would explain most of what the contacts leave of a frame, m."""
        return self.explaining_place(self.unexplained(belief, dv, pads))

    def explaining_place(self, left: Float[np.ndarray, " r"]) -> Float[np.ndarray, "2"]:
        """Where a contact would explain most of what is `unexplained`, m."""
        place: np.ndarray = self._starts[int(np.argmax(self._atoms @ left))]
        return place

    def explaining_places(self, left: Float[np.ndarray, " r"]) -> Iterator[Float[np.ndarray, "2"]]:
        """Where a contact would explain what is `unexplained`, m: the best place, then others that are `APART`."""
        score = self._atoms @ left
        for _ in range(STARTS):
            place = self._starts[int(np.argmax(score))]
            yield place
            score = np.where(np.linalg.norm(self._starts - place, axis=1) < APART, -np.inf, score)

    def unexplained(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads) -> Float[np.ndarray, " r"]:
        """See `filter.unexplained`."""
        return np.asarray(self._unexplained(_free(belief), dv, pads))


def _free(belief: Belief) -> Belief:
    """The belief as arrays that are bound to no device.

    JAX binds the results of kept programs (`jaxeit.cache_programs`) to their device, those of `jnp.asarray` not, and
    compiles a program once for each mixture of both: a frame would wait for it.
    """
    found: Belief = jax.tree.map(np.asarray, belief)
    return found
