"""The compiled programs of a tracker, for calls from a loop in Python."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .filter import Attempt, Belief, ContactFilter, Pads, Update, attempted, concluded, followed, unexplained


class Programs:
    """What a `ContactFilter` computes; each number of contacts is compiled once."""

    def __init__(self, tracker: ContactFilter):
        self._tracker = tracker
        self._atoms, self._starts = np.asarray(tracker.finder.atoms), np.asarray(tracker.finder.starts)[:, :2]

    def followed(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, seconds: float
    ) -> tuple[Belief, Update]:
        """See `filter.followed`."""
        found: tuple[Belief, Update] = followed(self._tracker, belief, jnp.asarray(dv), pads, jnp.asarray(seconds))
        return found

    def attempted(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, attempt: Attempt | None
    ) -> Attempt:
        """See `filter.attempted`."""
        found: Attempt = attempted(self._tracker, belief, jnp.asarray(dv), pads, attempt)
        return found

    def concluded(self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads, attempt: Attempt) -> Update:
        """See `filter.concluded`."""
        found: Update = concluded(self._tracker, belief, jnp.asarray(dv), pads, attempt)
        return found

    def unexplained_place(
        self, belief: Belief, dv: Float[np.ndarray, " readings"], pads: Pads
    ) -> Float[np.ndarray, "2"]:
        """Where a contact would explain most of what the contacts leave of a frame, m."""
        left = np.asarray(unexplained(self._tracker, belief, jnp.asarray(dv), pads))
        place: np.ndarray = self._starts[int(np.argmax(self._atoms @ left))]
        return place
