"""What may happen to contacts between two frames, as beliefs before the next one."""

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .belief.filter import CONTACT_SIZE, PLACE_STD, ROUND_HALF, Belief, numbers_of
from .settings import TrackerSettings

# Half length of an edge that is tried, m.
HALF = 0.012
# How far contacts may jump: x, y, log width, log force, half length, velocity.
JUMP = np.array([0.01, 0.01, 0.3, 1.5, 0.0, 0.0, 0.1, 0.1])
# Half length of an edge over the distance of the two contacts that were taken for it.
BETWEEN = 0.8
# Directions of an edge that are tried.
DIRECTIONS = np.pi * np.arange(4) / 4
# Prior deviation of the velocity of a contact that begins, m/s.
VELOCITY = 0.05
# How far a contact may change when it turns out to be an edge, and how much narrower its load then is.
EDGE, NARROWER = np.array([0.01, 0.01, 0.4, 0.5, HALF, HALF, 0.0, 0.0]), 0.3


class Hypothesis(NamedTuple):
    """A belief before a frame, with the contacts that it holds, and the log of its prior probability."""

    belief: Belief
    numbers: tuple[int, ...]
    edges: tuple[bool, ...]
    prior: float = 0.0

    def without(self, k: int, prior: float) -> "Hypothesis":
        """Contact k was none, or has lifted."""
        numbers, edges = self.numbers, self.edges
        return Hypothesis(without(self.belief, k), numbers[:k] + numbers[k + 1 :], edges[:k] + edges[k + 1 :], prior)

    def as_edge(self, k: int, prior: float) -> Iterator["Hypothesis"]:
        """Contact k as an edge in each of some directions, unless it is one."""
        if not self.edges[k]:
            edges = (*self.edges[:k], True, *self.edges[k + 1 :])
            for angle in DIRECTIONS:
                belief = lengthened(self.belief, k, angle)
                yield Hypothesis(belief, self.numbers, edges, prior - float(np.log(len(DIRECTIONS))))

    def joined(self, j: int, k: int, prior: float) -> "Hypothesis":
        """Contacts j and k, the later one, are one edge."""
        left, edges = self.without(k, prior), (*self.edges[:j], True, *self.edges[j + 1 :])
        return left._replace(belief=joined(self.belief, j, k), edges=edges[:k] + edges[k + 1 :])


class Events:
    """The events that are tried where a frame is not expected."""

    def __init__(self, settings: TrackerSettings, area: float):
        """`area`: of the skin, m^2."""
        self._settings, self._area = settings, area
        loads = settings.loads
        self._usual = np.log([loads.width, loads.force])
        self._spread = np.array([loads.width_spread, loads.force_spread])

    def rare(self, seconds: float) -> float:
        """Log of the prior probability of an event within some seconds."""
        return float(np.log(self._settings.birth_rate * seconds))

    def anywhere(self, seconds: float) -> float:
        """Log of the prior probability that a contact has begun within some seconds, in units of the fit's prior.

        The prior of a place is even over the skin, that of the fit is normal about where it begins.
        """
        return self.rare(seconds) + float(np.log(2 * np.pi * PLACE_STD**2 / self._area))

    def possible(
        self,
        now: Hypothesis,
        begun: int,
        place: Float[np.ndarray, "2"],
        instead: Sequence[Float[np.ndarray, "2"]],
        seconds: float,
    ) -> Iterator[Hypothesis]:
        """What may have happened to contacts within some seconds; what is least probable comes last.

        Args:
            begun: number of contacts so far.
            place: where a contact would explain most of what the contacts leave of the frame, m.
            instead: the same where the others leave it, for each contact.
        """
        rare, anywhere, count = self.rare(seconds), self.anywhere(seconds), len(now.numbers)
        if count < self._settings.most:
            belief = self.with_contact(now.belief, place)
            yield Hypothesis(belief, (*now.numbers, begun + 1), (*now.edges, False), anywhere)
        if count:
            yield now._replace(belief=jumped(now.belief), prior=rare)
            away = np.asarray(now.belief.contacts)[:, :2] - place
            yield from now.as_edge(int(np.argmin(np.linalg.norm(away, axis=1))), rare)
        for k in range(count):
            yield now.without(k, rare)
        for j, k in combinations(range(count), 2):
            yield now.joined(j, k, rare)
        for k, other in enumerate(instead):
            yield self.elsewhere(now, k, other, rare + anywhere)

    def with_contact(self, belief: Belief, place: Float[np.ndarray, "2"]) -> Belief:
        """The belief with a contact more, that begins about a place, m."""
        return inserted(belief, *self._beginning(place))

    def elsewhere(self, now: Hypothesis, k: int, place: Float[np.ndarray, "2"], prior: float = 0.0) -> Hypothesis:
        """Contact k is round and begins anew about a place, m."""
        edges = (*now.edges[:k], False, *now.edges[k + 1 :])
        return Hypothesis(replaced(now.belief, k, *self._beginning(place)), now.numbers, edges, prior)

    def _beginning(self, place: Float[np.ndarray, "2"]) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of a contact that begins about a place, m, and their standard deviations."""
        row = np.array([*place, *self._usual, 0.0, 0.0, 0.0, 0.0])
        return row, np.array([PLACE_STD, PLACE_STD, *self._spread, ROUND_HALF, ROUND_HALF, VELOCITY, VELOCITY])


def without(belief: Belief, k: int) -> Belief:
    """Without contact k."""
    kept = np.delete(np.arange(len(belief.covariance)), numbers_of(k))
    contacts = np.delete(np.asarray(belief.contacts), k, 0)
    covariance = np.asarray(belief.covariance)[np.ix_(kept, kept)]
    return belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance))


def inserted(belief: Belief, row: np.ndarray, spread: np.ndarray) -> Belief:
    """With a contact after the others that is independent of all else."""
    place = belief.contacts.size
    old = np.asarray(belief.covariance)
    kept = np.concatenate([np.arange(place), np.arange(place + CONTACT_SIZE, len(old) + CONTACT_SIZE)])
    covariance = np.zeros((len(old) + CONTACT_SIZE,) * 2, old.dtype)
    covariance[np.ix_(kept, kept)] = old
    covariance[place : place + CONTACT_SIZE, place : place + CONTACT_SIZE] = np.diag(spread**2)
    contacts = np.concatenate([np.asarray(belief.contacts), row[None]]).astype(old.dtype)
    return belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance))


def replaced(belief: Belief, k: int, row: np.ndarray, spread: np.ndarray) -> Belief:
    """With another contact in the place of contact k, that is independent of all else."""
    contacts, covariance, own = np.array(belief.contacts), np.array(belief.covariance), numbers_of(k)
    contacts[k] = row
    covariance[own] = covariance[:, own] = 0
    covariance[own, own] = np.diag(spread**2)
    return belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance))


def jumped(belief: Belief) -> Belief:
    """With contacts that may be elsewhere, or press otherwise, than they could a frame ago."""
    spread = np.zeros(len(belief.covariance))
    spread[: belief.contacts.size] = np.tile(JUMP, len(belief.contacts))
    return belief._replace(covariance=belief.covariance + jnp.diag(jnp.asarray(spread**2, belief.covariance.dtype)))


def lengthened(belief: Belief, k: int, angle: float) -> Belief:
    """With contact k as an edge in about this direction."""
    contacts, covariance = np.array(belief.contacts), np.array(belief.covariance)
    own = np.arange(len(covariance))[numbers_of(k)]
    contacts[k, 4:6] = HALF * np.cos(angle), HALF * np.sin(angle)
    contacts[k, 2] -= NARROWER
    covariance[own, own] += EDGE**2
    return belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance))


def joined(belief: Belief, first: int, second: int) -> Belief:
    """With one edge in the place of two contacts, from the one to the other; it takes the place of the first."""
    contacts, covariance = np.array(belief.contacts), np.array(belief.covariance)
    pair = contacts[[first, second]]
    force = np.exp(pair[:, 3])
    contacts[first, :3] = force @ pair[:, :3] / force.sum()
    contacts[first, 3], contacts[first, 4:6] = np.log(force.sum()), BETWEEN * (pair[1, :2] - pair[0, :2])
    contacts[first, 6:] = pair[:, 6:].mean(0)
    own = np.arange(len(covariance))[numbers_of(first)]
    covariance[own, own] += EDGE**2
    return without(belief._replace(contacts=jnp.asarray(contacts), covariance=jnp.asarray(covariance)), second)
