"""Readings for several sense channels, which take that many readings of one drive at once.

The time of a frame is divided into slots: each belongs to one driven pair and holds a reading of each channel. Since a
further reading never tells less, all slots are filled. Slots are first given to the pairs with the heaviest readings,
then improved by exchanges: a reading against another of the same driven pair, or a slot of one pair against a slot of
another. Estimates, which sum the changes by single readings, only choose which exchanges are tried; an exchange is kept
if it lowers the mean itself.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer

from .._compile import verb
from .criteria import AbstractCriterion
from .driven_pairs import codes_of_pairs
from .exchange import MIN_GAIN, Cases, changes, covariance_of, information_of, inverse_of, mean_and_forms

TRIES = 12  # exchanges that are tried before there is none


class Drives(NamedTuple):
    """Pairs that may drive, and the candidates that each of them can take, as drive or by reciprocity as sense.

    | meaning                                                 | shape       |
    |---------------------------------------------------------|-------------|
    | pairs of electrodes                                     | (pairs, 2)  |
    | takes: numbers of candidates, padded with the number of candidates | (pairs, n)  |
    """

    pairs: Int[np.ndarray, "pairs 2"]
    takes: Int[np.ndarray, "pairs n"]

    @staticmethod
    def of(pattern: Integer[np.ndarray, "candidates 4"], pairs: Integer[np.ndarray, "pairs 2"] | None) -> "Drives":
        """Those among ``pairs``; None: all pairs that a candidate names."""
        ends, size = codes_of_pairs(pattern)
        codes = np.unique(ends) if pairs is None else np.sort(pairs, 1) @ [size, 1]
        found = [np.flatnonzero((ends == code).any(1)) for code in codes]
        longest = max(map(len, found))
        takes = np.array([np.pad(own, (0, longest - len(own)), constant_values=len(pattern)) for own in found])
        return Drives(np.stack(np.divmod(codes, size), 1), takes)

    def numbers(self, pairs: Integer[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
        """The number of each of these pairs among all."""
        known = {tuple(pair): number for number, pair in enumerate(self.pairs.tolist())}
        return np.array([known[tuple(sorted(pair))] for pair in pairs.tolist()])

    def smallest(self, values: Float[np.ndarray, " candidates"], count: int) -> Float[np.ndarray, " pairs"]:
        """Of each pair, the sum of the ``count`` smallest values of its candidates; without infinite ones."""
        listed = np.append(values, np.inf)[self.takes]
        count = min(count, listed.shape[1])
        least = np.partition(listed, count - 1, 1)[:, :count]
        return np.where(np.isfinite(least).any(1), np.where(np.isfinite(least), least, 0).sum(1), np.inf)


class Slots(NamedTuple):
    """The driven pair of each candidate, -1 where it is not taken, and the number of slots of each pair."""

    owner: Int[np.ndarray, " candidates"]
    held: Int[np.ndarray, " pairs"]

    @property
    def taken(self) -> Int[np.ndarray, " readings"]:
        """Numbers of the candidates that are taken."""
        return np.flatnonzero(self.owner >= 0)


class Frame(NamedTuple):
    """What a frame has room for.

    | meaning                                                        | unit           |
    |----------------------------------------------------------------|----------------|
    | time                                                           | slots          |
    | switch: cost of a change of the driven pair                    | slots          |
    | channels: readings in a slot                                   |                |
    """

    time: float
    switch: float
    channels: int

    def left(self, count: Int[np.ndarray, "*b pairs"]) -> Float[np.ndarray, "*b"]:
        """Time that slots of these numbers leave."""
        found: np.ndarray = self.time + 1e-9 - count.sum(-1) - self.switch * (count > 0).sum(-1)
        return found


def filled(drives: Drives, weights: Float[np.ndarray, " candidates"], frame: Frame, slots: Slots | None) -> Slots:
    """Further slots while there is time, each to the pair whose heaviest free readings weigh most over their cost.

    Args:
        slots: to begin with; None: no slot.
    """
    none = np.full(len(weights), -1), np.zeros(len(drives.pairs), int)
    owner, count = none if slots is None else (part.copy() for part in slots)
    while True:
        free = np.where(owner < 0, -weights, np.inf)
        value = drives.smallest(free, frame.channels) / (1 + frame.switch * (count == 0))
        value[frame.left(count + np.eye(len(count), dtype=int)) < 0] = np.inf
        best = int(np.argmin(value))
        if not np.isfinite(value[best]):
            return Slots(owner, count)
        own = drives.takes[best]
        heaviest = own[np.argsort(np.append(free, np.inf)[own], kind="stable")[: frame.channels]]
        owner[[one for one in heaviest if one < len(owner) and owner[one] < 0]] = best
        count[best] += 1


def improved(
    criterion: AbstractCriterion,
    cases: Cases,
    drives: Drives,
    frame: Frame,
    slots: Slots,
    progress: Callable[[Iterable[Any]], Iterable[Any]],
) -> tuple[Slots, float]:
    """The slots after exchanges, and the mean of h."""
    search = _Search(criterion, cases, drives, frame)
    for _ in progress(range(2 * len(slots.taken) + 1)):
        mean, worth, loss = (np.asarray(part) for part in _worths(criterion, cases, _flags(cases, slots)))
        found = search.reading(slots, float(mean), worth, loss) or search.slot(slots, float(mean), worth, loss)
        if found is None:
            return slots, float(mean)
        slots = filled(drives, -worth, frame, found)  # where a drive was given up, there may be time for a slot
    return slots, float(_worths(criterion, cases, _flags(cases, slots))[0])


class _Search(NamedTuple):
    """One exchange of a design with slots; each method has the slots after it, or None if none lowers the mean."""

    criterion: AbstractCriterion
    cases: Cases
    drives: Drives
    frame: Frame

    def reading(
        self, slots: Slots, mean: float, worth: Float[np.ndarray, " candidates"], loss: Float[np.ndarray, " candidates"]
    ) -> Slots | None:
        """A reading against another of the same driven pair."""
        gain = np.full(len(self.drives.pairs), np.inf)
        for pair in np.flatnonzero(slots.held):
            gain[pair] = loss[slots.owner == pair].min()
        gain += self.drives.smallest(worth, 1)
        for pair in _best(gain):
            own = self.drives.takes[pair]
            new = own[np.argmin(np.append(worth, np.inf)[own])]
            owner = slots.owner.copy()
            owner[new] = pair
            after = np.asarray(_worths(self.criterion, self.cases, _flags(self.cases, slots._replace(owner=owner)))[2])
            out = int(np.argmin(np.where(owner == pair, after, np.inf)))
            if worth[new] + after[out] < -MIN_GAIN * abs(mean):
                owner[out] = -1
                return slots._replace(owner=owner)
        return None

    def slot(
        self, slots: Slots, mean: float, worth: Float[np.ndarray, " candidates"], loss: Float[np.ndarray, " candidates"]
    ) -> Slots | None:
        """A slot of one driven pair against a slot of another."""
        driven, unit = np.flatnonzero(slots.held), np.eye(len(slots.held), dtype=int)
        least = [self._least(slots, pair, loss) for pair in driven.tolist()]
        change = np.array([loss[out].sum() for out in least])[:, None]
        change = change + self.drives.smallest(worth, self.frame.channels)
        counts = slots.held - unit[driven][:, None] + unit
        change[(self.frame.left(counts) < 0) | (driven[:, None] == np.arange(len(unit)))] = np.inf
        for best in _best(change.ravel()):
            first, to = divmod(int(best), len(unit))
            owner = slots.owner.copy()
            owner[least[first]] = -1
            listed = jnp.asarray(self.drives.takes[to])
            freed = _flags(self.cases, slots._replace(owner=owner))
            kept, after = _with_slot(self.criterion, self.cases, freed, listed, self.frame.channels)
            if float(after) < mean - MIN_GAIN * abs(mean):
                owner[(np.asarray(kept) > 0) & (owner < 0)] = to
                return Slots(owner, counts[first, to])
        return None

    def _least(self, slots: Slots, pair: int, loss: Float[np.ndarray, " candidates"]) -> Int[np.ndarray, " n"]:
        """The readings of a pair that are worth least, as many as its last slot holds."""
        own = np.flatnonzero(slots.owner == pair)
        kept = (slots.held[pair] - 1) * self.frame.channels
        return own[np.argsort(loss[own], kind="stable")[: max(len(own) - kept, 0)]]


def _best(change: Float[np.ndarray, " n"]) -> Int[np.ndarray, " tries"]:
    """Numbers of the smallest finite changes, of which so many are tried."""
    order = np.argsort(change, kind="stable")[:TRIES]
    found: np.ndarray = order[np.isfinite(change[order])]
    return found


def _flags(cases: Cases, slots: Slots) -> Float[Array, " candidates"]:
    """One for each candidate that is taken, zero for others."""
    return jnp.asarray(slots.owner >= 0, cases.alive.dtype)


@verb
def _worths(
    criterion: AbstractCriterion, cases: Cases, taken: Float[Array, " candidates"]
) -> tuple[Float[Array, ""], Float[Array, " candidates"], Float[Array, " candidates"]]:
    """The mean of h, and its change if each candidate is added, or taken away; infinite where it cannot be."""
    covariance = covariance_of(cases, taken)
    worth, loss = (changes(criterion, cases, covariance, sign) for sign in (1.0, -1.0))
    there = taken > 0
    mean = mean_and_forms(criterion, covariance)[0]
    return mean, jnp.where(there, jnp.inf, worth), jnp.where(there, loss, jnp.inf)


@verb
def _with_slot(
    criterion: AbstractCriterion,
    cases: Cases,
    taken: Float[Array, " candidates"],
    listed: Int[Array, " n"],
    channels: int,
) -> tuple[Float[Array, " candidates"], Float[Array, ""]]:
    """The readings after a slot is filled from a list, one by one with the one that lowers h most; the mean of h."""
    part = cases.only(jnp.minimum(listed, len(taken) - 1))

    def add(_: Int[Array, ""], state: tuple[Array, Array]) -> tuple[Array, Array]:
        taken, information = state
        covariance = inverse_of(information)
        worth = changes(criterion, part, covariance, 1.0)
        free = (listed < len(taken)) & (taken.at[listed].get(mode="clip") == 0)
        best = jnp.argmin(jnp.where(free, worth, jnp.inf))
        new = jnp.where(free[best], 1, 0).astype(taken.dtype)
        row = part.rows[:, :, best]
        more = jnp.einsum("sa,sb,c->scab", row, row, new * part.alive[:, best])
        return taken.at[listed[best]].max(new, mode="drop"), information + more

    after, information = jax.lax.fori_loop(0, channels, add, (taken, information_of(cases, taken)))
    covariance = inverse_of(information)
    return after, mean_and_forms(criterion, covariance)[0]
