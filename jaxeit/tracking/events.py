"""Events that may change contacts between two frames, as hypotheses: beliefs before the next frame."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .belief.state import CONTACT_SIZE, POSITION_STD, ROUND_HALF_LENGTH, Belief, contact_slice
from .settings import TrackerSettings

# Half length of an edge in a hypothesis, m.
TRIAL_HALF_LENGTH = 0.012
# Standard deviation of a jump of contacts: x, y, log width, log force, half length, velocity.
JUMP_STD = np.array([0.01, 0.01, 0.3, 1.5, 0.0, 0.0, 0.1, 0.1])
# Half length of an edge over the distance of the two contacts that merge into it.
MERGED_LENGTH_RATIO = 0.8
# Directions of an edge in the hypotheses.
EDGE_ANGLES = np.pi * np.arange(4) / 4
# Prior standard deviation of the velocity of a new contact, m/s.
VELOCITY_STD = 0.05
# Standard deviation of the change of a contact that turns out to be an edge, and fall of its log width.
EDGE_STD, EDGE_NARROWING = np.array([0.01, 0.01, 0.4, 0.5, TRIAL_HALF_LENGTH, TRIAL_HALF_LENGTH, 0.0, 0.0]), 0.3


class Hypothesis(NamedTuple):
    """A belief before a frame, with the contacts that it holds, and the log of its prior probability."""

    belief: Belief
    numbers: tuple[int, ...]
    edges: tuple[bool, ...]
    prior: float = 0.0

    def without(self, k: int, prior: float) -> "Hypothesis":
        """The hypothesis that contact k was none, or has lifted."""
        numbers, edges = self.numbers[:k] + self.numbers[k + 1 :], self.edges[:k] + self.edges[k + 1 :]
        return Hypothesis(remove_contact(self.belief, k), numbers, edges, prior)

    def as_edge(self, k: int, prior: float) -> Iterator["Hypothesis"]:
        """The hypotheses that contact k is an edge, one for each direction; none if it is one already."""
        if not self.edges[k]:
            edges = (*self.edges[:k], True, *self.edges[k + 1 :])
            for angle in EDGE_ANGLES:
                belief = elongate_contact(self.belief, k, angle)
                yield Hypothesis(belief, self.numbers, edges, prior - float(np.log(len(EDGE_ANGLES))))

    def merge(self, j: int, k: int, prior: float) -> "Hypothesis":
        """The hypothesis that contacts j and k, the later one, are one edge."""
        left, edges = self.without(k, prior), (*self.edges[:j], True, *self.edges[j + 1 :])
        return left._replace(belief=merge_contacts(self.belief, j, k), edges=edges[:k] + edges[k + 1 :])


class EventHypotheses:
    """Generates the hypotheses that are compared where a frame is unexpected."""

    def __init__(self, settings: TrackerSettings, area: float):
        """`area`: of the skin, m^2."""
        self._settings, self._area = settings, area
        loads = settings.loads
        self._usual = np.log([loads.width, loads.force])
        self._spread = np.array([loads.width_spread, loads.force_spread])

    def event_log_prior(self, seconds: float) -> float:
        """Log of the prior probability of an event within some seconds."""
        return float(np.log(self._settings.birth_rate * seconds))

    def birth_log_prior(self, seconds: float) -> float:
        """Log of the prior probability of a birth within some seconds, in units of the fit's prior.

        The prior of a position is even over the skin, that of the fit is normal about its start.
        """
        return self.event_log_prior(seconds) + float(np.log(2 * np.pi * POSITION_STD**2 / self._area))

    def hypotheses(
        self,
        now: Hypothesis,
        begun: int,
        places: Sequence[Float[np.ndarray, "2"]],
        alternatives: Sequence[Float[np.ndarray, "2"]],
        seconds: float,
    ) -> Iterator[Hypothesis]:
        """Hypotheses of what may have happened to contacts within some seconds; the least probable come last.

        Args:
            begun: number of contacts so far.
            places: positions at which a contact may have begun, m, the most likely one first.
            alternatives: position of the atom that explains most of the innovation without contact k, m, for each
                contact.
        """
        event_prior, birth_prior, count = self.event_log_prior(seconds), self.birth_log_prior(seconds), len(now.numbers)
        if count < self._settings.most:
            for place in places:
                belief = self.with_contact(now.belief, place)
                yield Hypothesis(belief, (*now.numbers, begun + 1), (*now.edges, False), birth_prior)
        if count:
            yield now._replace(belief=allow_jumps(now.belief), prior=event_prior)
            distances = np.asarray(now.belief.contacts)[:, :2] - places[0]
            yield from now.as_edge(int(np.argmin(np.linalg.norm(distances, axis=1))), event_prior)
        for k in range(count):
            yield now.without(k, event_prior)
        for j, k in combinations(range(count), 2):
            yield now.merge(j, k, event_prior)
        for k, other in enumerate(alternatives):
            yield self.relocate(now, k, other, event_prior + birth_prior)

    def with_contact(self, belief: Belief, place: Float[np.ndarray, "2"]) -> Belief:
        """The belief with a new contact about a position, m."""
        return insert_contact(belief, *self._birth(place))

    def relocate(self, now: Hypothesis, k: int, place: Float[np.ndarray, "2"], prior: float = 0.0) -> Hypothesis:
        """The hypothesis that contact k is round and starts anew about a position, m."""
        edges = (*now.edges[:k], False, *now.edges[k + 1 :])
        return Hypothesis(replace_contact(now.belief, k, *self._birth(place)), now.numbers, edges, prior)

    def _birth(self, place: Float[np.ndarray, "2"]) -> tuple[np.ndarray, np.ndarray]:
        """State of a new contact about a position, m, and its standard deviations."""
        row = np.array([*place, *self._usual, 0.0, 0.0, 0.0, 0.0])
        half, velocity = 2 * [ROUND_HALF_LENGTH], 2 * [VELOCITY_STD]
        return row, np.array([POSITION_STD, POSITION_STD, *self._spread, *half, *velocity])


def remove_contact(belief: Belief, k: int) -> Belief:
    """Remove contact k from a belief."""
    kept = np.delete(np.arange(len(belief.covariance)), contact_slice(k))
    contacts = np.delete(np.asarray(belief.contacts), k, 0)
    covariance = np.asarray(belief.covariance)[np.ix_(kept, kept)]
    return belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance))


def insert_contact(belief: Belief, row: np.ndarray, spread: np.ndarray) -> Belief:
    """Insert a contact after the others, independent of all else."""
    place = belief.contacts.size
    old = np.asarray(belief.covariance)
    kept = np.concatenate([np.arange(place), np.arange(place + CONTACT_SIZE, len(old) + CONTACT_SIZE)])
    covariance = np.zeros((len(old) + CONTACT_SIZE,) * 2, old.dtype)
    covariance[np.ix_(kept, kept)] = old
    covariance[place : place + CONTACT_SIZE, place : place + CONTACT_SIZE] = np.diag(spread**2)
    contacts = np.concatenate([np.asarray(belief.contacts), row[None]]).astype(old.dtype)
    return belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance))


def replace_contact(belief: Belief, k: int, row: np.ndarray, spread: np.ndarray) -> Belief:
    """Replace contact k by another one, independent of all else."""
    contacts, covariance, own = np.array(belief.contacts), np.array(belief.covariance), contact_slice(k)
    contacts[k] = row
    covariance[own] = covariance[:, own] = 0
    covariance[own, own] = np.diag(spread**2)
    return belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance))


def allow_jumps(belief: Belief) -> Belief:
    """Inflate the covariance of contacts, so that they may be elsewhere, or press otherwise, than a frame ago."""
    spread = np.zeros(len(belief.covariance))
    spread[: belief.contacts.size] = np.tile(JUMP_STD, len(belief.contacts))
    return belief._replace(covariance=belief.covariance + jnp.diag(jnp.asarray(spread**2, belief.covariance.dtype)))


def elongate_contact(belief: Belief, k: int, angle: float) -> Belief:
    """Elongate contact k to an edge in about this direction."""
    contacts, covariance = np.array(belief.contacts), np.array(belief.covariance)
    own = np.arange(len(covariance))[contact_slice(k)]
    contacts[k, 4:6] = TRIAL_HALF_LENGTH * np.cos(angle), TRIAL_HALF_LENGTH * np.sin(angle)
    contacts[k, 2] -= EDGE_NARROWING
    covariance[own, own] += EDGE_STD**2
    return belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance))


def merge_contacts(belief: Belief, first: int, second: int) -> Belief:
    """Merge two contacts into one edge, from the one to the other; it takes the row of the first."""
    contacts, covariance = np.array(belief.contacts), np.array(belief.covariance)
    pair = contacts[[first, second]]
    force = np.exp(pair[:, 3])
    contacts[first, :3] = force @ pair[:, :3] / force.sum()
    contacts[first, 3], contacts[first, 4:6] = np.log(force.sum()), MERGED_LENGTH_RATIO * (pair[1, :2] - pair[0, :2])
    contacts[first, 6:] = pair[:, 6:].mean(0)
    own = np.arange(len(covariance))[contact_slice(first)]
    covariance[own, own] += EDGE_STD**2
    return remove_contact(belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance)), second)
