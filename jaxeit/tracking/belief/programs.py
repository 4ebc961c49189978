"""The compiled programs of a filter of contacts, for calls from a loop in Python."""

from collections.abc import Callable, Iterator

import jax
import numpy as np
from jaxtyping import Array, Float

from ..._compile import bind
from .consider import consider_covariance
from .contact_filter import ContactFilter, predict
from .frame_update import advance, conclude, innovation, predict_and_update
from .state import Attempt, Belief, Pads, Update

# Most positions from which the fit of a new contact starts, and their least distance, m.
MAX_STARTS, MIN_START_DISTANCE = 4, 0.01
# Most evaluations of the fit of a single press.
MAX_PRESS_STEPS = 24


class Programs:
    """What a `ContactFilter` computes, with its arrays packed; each number of contacts is compiled once.

    `size`: number of whitened readings of a frame.
    """

    def __init__(self, contact_filter: ContactFilter):
        self.size = len(contact_filter.compress)
        self._predict_and_update: Callable[..., tuple[Belief, Update]] = bind(predict_and_update, contact_filter)
        self._predict: Callable[..., Belief] = bind(predict, contact_filter)
        self._advance: Callable[..., Attempt] = bind(advance, contact_filter)
        self._conclude: Callable[..., Update] = bind(conclude, contact_filter)
        self._consider_covariance: Callable[..., Array] = bind(consider_covariance, contact_filter)
        self._innovation: Callable[..., Array] = bind(innovation, contact_filter)
        self._atoms, self._starts = (
            np.asarray(contact_filter.finder.atoms),
            np.asarray(contact_filter.finder.starts)[:, :2],
        )
        self._dtype = contact_filter.places.dtype

    def predict_and_update(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, seconds: float
    ) -> tuple[Belief, Update]:
        """See `frame_update.predict_and_update`."""
        return self._predict_and_update(_as_arrays(belief), dv, pads, np.asarray(seconds, self._dtype))

    def predict(self, belief: Belief, seconds: float) -> Belief:
        """See `contact_filter.predict`."""
        return self._predict(_as_arrays(belief), np.asarray(seconds, self._dtype))

    def advance(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, attempt: Attempt | None
    ) -> Attempt:
        """See `frame_update.advance`."""
        return self._advance(_as_arrays(belief), dv, pads, attempt)

    def single_frame_update(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads) -> Update:
        """The update of a single frame that may start far from its minimum, as that of a press."""
        return self.conclude(belief, dv, pads, self.converge(belief, dv, pads, MAX_PRESS_STEPS))

    def converge(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, most: int) -> Attempt:
        """Advance an update until it has converged or taken ``most`` steps."""
        attempt = self.advance(belief, dv, pads, None)
        while attempt.state is not None and not attempt.state.converged and attempt.state.steps < most:
            attempt = self.advance(belief, dv, pads, attempt)
        return attempt

    def conclude(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, attempt: Attempt) -> Update:
        """See `frame_update.conclude`."""
        return self._conclude(_as_arrays(belief), dv, pads, attempt)

    def consider_covariance(self, belief: Belief, pads: Pads, unexplained: float) -> Float[np.ndarray, "K 6 6"]:
        """See `consider.consider_covariance`."""
        return np.asarray(self._consider_covariance(_as_arrays(belief), pads, np.asarray(unexplained, self._dtype)))

    def birth_position(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads) -> Float[np.ndarray, "2"]:
        """Most probable position of a new contact, by the innovation of a frame, m."""
        return self.matched_position(self.innovation(belief, dv, pads))

    def excess_position(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads
    ) -> Float[np.ndarray, "2"] | None:
        """Position at which a frame shows more than was predicted, m; None where what it shows most is less."""
        score = self._atoms @ self.innovation(belief, dv, pads)
        place = int(np.argmax(np.abs(score)))
        return self._starts[place] if score[place] > 0 else None

    def matched_position(self, innovation: Float[np.ndarray, " r"]) -> Float[np.ndarray, "2"]:
        """Position of the atom that explains most of an innovation, by a matched filter, m."""
        place: np.ndarray = self._starts[int(np.argmax(self._atoms @ innovation))]
        return place

    def matched_positions(self, innovation: Float[np.ndarray, " r"]) -> Iterator[Float[np.ndarray, "2"]]:
        """Positions of atoms that explain an innovation, m, best first and `MIN_START_DISTANCE` or more apart."""
        score = self._atoms @ innovation
        for _ in range(MAX_STARTS):
            place = self._starts[int(np.argmax(score))]
            yield place
            score = np.where(np.linalg.norm(self._starts - place, axis=1) < MIN_START_DISTANCE, -np.inf, score)

    def innovation(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads) -> Float[np.ndarray, " r"]:
        """See `frame_update.innovation`."""
        return np.asarray(self._innovation(_as_arrays(belief), dv, pads))


def _as_arrays(belief: Belief) -> Belief:
    """The belief as arrays that are bound to no device.

    JAX binds the results of kept programs (`jaxeit.cache_programs`) to their device, those of `jnp.asarray` not, and
    compiles a program once for each mixture of both: a frame would wait for it.
    """
    found: Belief = jax.tree.map(np.asarray, belief)
    return found
