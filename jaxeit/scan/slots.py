"""Readings for several sense channels, which take that many readings of one drive at once.

The time of a frame is divided into slots: each belongs to one driven pair and holds a reading of each channel. A
further reading never lowers the information, so that all slots are filled: first for the pairs with the largest
weights. Then exchanges improve them: a reading for another of the same driven pair, or a slot of one pair for a slot of
another. Estimates, which sum the changes by single readings, select the exchanges that are tried; an exchange is kept
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
from .driven_pairs import pair_codes
from .exchange import (
    MIN_RELATIVE_FALL,
    Cases,
    covariance_matrix,
    criterion_changes,
    information_matrix,
    invert_information,
    mean_and_forms,
)

MAX_TRIALS = 12  # exchanges that are tried before the search ends


class Drives(NamedTuple):
    """Pairs that may drive, and the candidates of each, as given or by reciprocity.

    | meaning                                                 | shape       |
    |---------------------------------------------------------|-------------|
    | pairs of electrodes                                     | (pairs, 2)  |
    | candidates: their indices, padded with their number     | (pairs, n)  |
    """

    pairs: Int[np.ndarray, "pairs 2"]
    candidates: Int[np.ndarray, "pairs n"]

    @staticmethod
    def of(pattern: Integer[np.ndarray, "candidates 4"], pairs: Integer[np.ndarray, "pairs 2"] | None) -> "Drives":
        """The driven pairs among ``pairs``; None: all pairs of electrodes in the candidates."""
        ends, size = pair_codes(pattern)
        codes = np.unique(ends) if pairs is None else np.sort(pairs, 1) @ [size, 1]
        lists = [np.flatnonzero((ends == code).any(1)) for code in codes]
        longest = max(map(len, lists))
        candidates = np.array([np.pad(own, (0, longest - len(own)), constant_values=len(pattern)) for own in lists])
        return Drives(np.stack(np.divmod(codes, size), 1), candidates)

    def indices(self, pairs: Integer[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
        """Indices of these pairs among all."""
        index = {tuple(pair): i for i, pair in enumerate(self.pairs.tolist())}
        return np.array([index[tuple(sorted(pair))] for pair in pairs.tolist()])

    def smallest_sums(self, values: Float[np.ndarray, " candidates"], count: int) -> Float[np.ndarray, " pairs"]:
        """Sum of the ``count`` smallest finite values of the candidates of each pair; infinite without any."""
        padded = np.append(values, np.inf)[self.candidates]
        count = min(count, padded.shape[1])
        lowest = np.partition(padded, count - 1, 1)[:, :count]
        return np.where(np.isfinite(lowest).any(1), np.where(np.isfinite(lowest), lowest, 0).sum(1), np.inf)


class Slots(NamedTuple):
    """The driven pair of each candidate, -1 where it is not chosen, and the number of slots of each pair."""

    drive: Int[np.ndarray, " candidates"]
    counts: Int[np.ndarray, " pairs"]

    @property
    def chosen(self) -> Int[np.ndarray, " readings"]:
        """Indices of the chosen candidates."""
        return np.flatnonzero(self.drive >= 0)


class FrameBudget(NamedTuple):
    """Time and channels of a frame.

    | meaning                                                        | unit           |
    |----------------------------------------------------------------|----------------|
    | time                                                           | slots          |
    | switch: cost of a change of the driven pair                    | slots          |
    | channels: readings in a slot                                   |                |
    """

    time: float
    switch: float
    channels: int

    def remaining(self, count: Int[np.ndarray, "*b pairs"]) -> Float[np.ndarray, "*b"]:
        """Time that remains beside these counts of slots."""
        time: np.ndarray = self.time + 1e-9 - count.sum(-1) - self.switch * (count > 0).sum(-1)
        return time


def fill_slots(
    drives: Drives, weights: Float[np.ndarray, " candidates"], frame: FrameBudget, slots: Slots | None
) -> Slots:
    """Add slots while there is time, each to the pair whose free readings have the largest weights over their cost.

    Args:
        slots: to start from; None: no slot.
    """
    empty = np.full(len(weights), -1), np.zeros(len(drives.pairs), int)
    drive, count = empty if slots is None else (array.copy() for array in slots)
    while True:
        free = np.where(drive < 0, -weights, np.inf)
        value = drives.smallest_sums(free, frame.channels) / (1 + frame.switch * (count == 0))
        value[frame.remaining(count + np.eye(len(count), dtype=int)) < 0] = np.inf
        best = int(np.argmin(value))
        if not np.isfinite(value[best]):
            return Slots(drive, count)
        own = drives.candidates[best]
        heaviest = own[np.argsort(np.append(free, np.inf)[own], kind="stable")[: frame.channels]]
        drive[[one for one in heaviest if one < len(drive) and drive[one] < 0]] = best
        count[best] += 1


def exchange_slots(
    criterion: AbstractCriterion,
    cases: Cases,
    drives: Drives,
    frame: FrameBudget,
    slots: Slots,
    progress: Callable[[Iterable[Any]], Iterable[Any]],
) -> tuple[Slots, float]:
    """Improve slots by exchanges; the slots, and the mean of h."""
    search = _SlotExchange(criterion, cases, drives, frame)
    for _ in progress(range(2 * len(slots.chosen) + 1)):
        mean, addition, removal = map(np.asarray, _candidate_changes(criterion, cases, _indicator(cases, slots)))
        change = float(mean), addition, removal
        improved_slots = search.exchange_reading(slots, *change) or search.exchange_slot(slots, *change)
        if improved_slots is None:
            return slots, float(mean)
        # Where a pair no longer drives, there may be time for a further slot.
        slots = fill_slots(drives, -addition, frame, improved_slots)
    return slots, float(_candidate_changes(criterion, cases, _indicator(cases, slots))[0])


class _SlotExchange(NamedTuple):
    """One exchange of a design with slots; each method returns the slots after it, or None if none lowers the mean."""

    criterion: AbstractCriterion
    cases: Cases
    drives: Drives
    frame: FrameBudget

    def exchange_reading(
        self,
        slots: Slots,
        mean: float,
        addition: Float[np.ndarray, " candidates"],
        removal: Float[np.ndarray, " candidates"],
    ) -> Slots | None:
        """Exchange a reading for another of the same driven pair."""
        change = np.full(len(self.drives.pairs), np.inf)
        for pair in np.flatnonzero(slots.counts):
            change[pair] = removal[slots.drive == pair].min()
        change += self.drives.smallest_sums(addition, 1)
        for pair in _best_trials(change):
            own = self.drives.candidates[pair]
            new = own[np.argmin(np.append(addition, np.inf)[own])]
            drive = slots.drive.copy()
            drive[new] = pair
            weights = _indicator(self.cases, slots._replace(drive=drive))
            after = np.asarray(_candidate_changes(self.criterion, self.cases, weights)[2])
            old = int(np.argmin(np.where(drive == pair, after, np.inf)))
            if addition[new] + after[old] < -MIN_RELATIVE_FALL * abs(mean):
                drive[old] = -1
                return slots._replace(drive=drive)
        return None

    def exchange_slot(
        self,
        slots: Slots,
        mean: float,
        addition: Float[np.ndarray, " candidates"],
        removal: Float[np.ndarray, " candidates"],
    ) -> Slots | None:
        """Exchange a slot of one driven pair for a slot of another."""
        driven, unit = np.flatnonzero(slots.counts), np.eye(len(slots.counts), dtype=int)
        outgoing = [self._least_informative(slots, pair, removal) for pair in driven.tolist()]
        change = np.array([removal[readings].sum() for readings in outgoing])[:, None]
        change = change + self.drives.smallest_sums(addition, self.frame.channels)
        new_counts = slots.counts - unit[driven][:, None] + unit
        change[(self.frame.remaining(new_counts) < 0) | (driven[:, None] == np.arange(len(unit)))] = np.inf
        for best in _best_trials(change.ravel()):
            source, target = divmod(int(best), len(unit))
            drive = slots.drive.copy()
            drive[outgoing[source]] = -1
            incoming = jnp.asarray(self.drives.candidates[target])
            rest = _indicator(self.cases, slots._replace(drive=drive))
            weights, after = _fill_slot(self.criterion, self.cases, rest, incoming, self.frame.channels)
            if float(after) < mean - MIN_RELATIVE_FALL * abs(mean):
                drive[(np.asarray(weights) > 0) & (drive < 0)] = target
                return Slots(drive, new_counts[source, target])
        return None

    def _least_informative(
        self, slots: Slots, pair: int, removal: Float[np.ndarray, " candidates"]
    ) -> Int[np.ndarray, " n"]:
        """The readings of a pair whose removal costs least, as many as its last slot has."""
        own = np.flatnonzero(slots.drive == pair)
        kept = (slots.counts[pair] - 1) * self.frame.channels
        return own[np.argsort(removal[own], kind="stable")[: max(len(own) - kept, 0)]]


def _best_trials(change: Float[np.ndarray, " n"]) -> Int[np.ndarray, " tries"]:
    """Indices of the smallest finite changes, `MAX_TRIALS` at most."""
    order = np.argsort(change, kind="stable")[:MAX_TRIALS]
    finite: np.ndarray = order[np.isfinite(change[order])]
    return finite


def _indicator(cases: Cases, slots: Slots) -> Float[Array, " candidates"]:
    """Weights of the candidates: one if chosen, zero otherwise."""
    return jnp.asarray(slots.drive >= 0, cases.alive.dtype)


@verb
def _candidate_changes(
    criterion: AbstractCriterion, cases: Cases, chosen: Float[Array, " candidates"]
) -> tuple[Float[Array, ""], Float[Array, " candidates"], Float[Array, " candidates"]]:
    """The mean of h, and its changes by addition and removal of each candidate; infinite where it cannot be."""
    covariance = covariance_matrix(cases, chosen)
    addition, removal = (criterion_changes(criterion, cases, covariance, sign) for sign in (1.0, -1.0))
    is_chosen = chosen > 0
    mean = mean_and_forms(criterion, covariance)[0]
    return mean, jnp.where(is_chosen, jnp.inf, addition), jnp.where(is_chosen, removal, jnp.inf)


@verb
def _fill_slot(
    criterion: AbstractCriterion,
    cases: Cases,
    chosen: Float[Array, " candidates"],
    incoming: Int[Array, " n"],
    channels: int,
) -> tuple[Float[Array, " candidates"], Float[Array, ""]]:
    """Fill a slot from a list, one by one with the reading that lowers h most; weights after it, and the mean of h."""
    part = cases.subset(jnp.minimum(incoming, len(chosen) - 1))

    def add(_: Int[Array, ""], state: tuple[Array, Array]) -> tuple[Array, Array]:
        chosen, information = state
        covariance = invert_information(information)
        addition = criterion_changes(criterion, part, covariance, 1.0)
        free = (incoming < len(chosen)) & (chosen.at[incoming].get(mode="clip") == 0)
        best = jnp.argmin(jnp.where(free, addition, jnp.inf))
        new = jnp.where(free[best], 1, 0).astype(chosen.dtype)
        row = part.rows[:, :, best]
        added = jnp.einsum("sa,sb,c->scab", row, row, new * part.alive[:, best])
        return chosen.at[incoming[best]].max(new, mode="drop"), information + added

    after, information = jax.lax.fori_loop(0, channels, add, (chosen, information_matrix(cases, chosen)))
    covariance = invert_information(information)
    return after, mean_and_forms(criterion, covariance)[0]
