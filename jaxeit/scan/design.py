"""Optimal design of a scan: the four-terminal readings of a skin that inform most on the place of a contact.

With weights w_i of the candidates, 0 <= w_i <= 1 and sum w_i = N, the mean over sites of a convex function h of the
covariance of place is minimised by the multiplicative algorithm w_i <- min(1, c w_i sqrt(d_i)), with d_i = -dh/dw_i and
c such that the sum is kept (Silvey, Titterington and Torsney 1978, here with an upper bound). As h is convex, no N
different candidates can have a smaller value than

    h(w) - (sum of the N largest d_i - sum_i w_i d_i),

the certificate of a design (Kiefer and Wolfowitz 1960). The N readings of largest weight are then improved by
exchanges (Fedorov 1972): the candidate that lowers h most comes in, and the reading that raises it least goes out.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Integer

from .._compile import require_known, verb
from ..budget import require
from ..skin.patterns import all_pairs
from ..skin.protocol import Protocol, ProtocolError
from .contact_information import UNKNOWNS, PlaceSensitivity
from .criteria import AbstractCriterion, PlaceError
from .driven_pairs import cover_by_pairs, order_readings
from .exchange import Cases, covariance_matrix, directional_derivatives, exchange_readings, mean_and_forms
from .slots import Drives, FrameBudget, Slots, exchange_slots, fill_slots

# Largest number of iterations of the weights, and the gap of error and bound, over the error, at which they end.
MAX_ITERATIONS, BOUND_RTOL = 300, 4e-3


class ScanDesign(NamedTuple):
    """The readings of a designed scan.

    Without ``switch`` the bound holds for all driven pairs, with it for those that the design drives.

    | meaning                                                                              | shape         | unit |
    |--------------------------------------------------------------------------------------|---------------|------|
    | pattern: the readings, each pair driven once, untouched readings above zero          | (readings, 4) |      |
    | error: of place in the measure of the criterion (`PlaceError()`: mean over sites)  | ()            | m    |
    | bound: no so many different candidates of these driven pairs have a smaller error    | ()            | m    |
    """

    pattern: np.ndarray
    error: float
    bound: float

    @property
    def drives(self) -> int:
        """Number of driven pairs."""
        return len(np.unique(self.pattern[:, :2], axis=0))


def design_scan(
    sensitivity: PlaceSensitivity,
    readings: int,
    criterion: AbstractCriterion | None = None,
    *,
    candidates: Integer[ArrayLike, "candidates 4"] | None = None,
    switch: float = 0.0,
    sense_channels: int = 1,
    any_dead: bool = False,
    progress: Callable[[Iterable[Any]], Iterable[Any]] = iter,
) -> ScanDesign:
    """Design the readings that inform most on the place of a contact anywhere on the sheet, in the time of a frame.

    Args:
        sensitivity: of the skin, from `place_sensitivity`.
        readings: time of a frame over the time of a reading; without ``switch``, and with one sense channel, the number
            of readings.
        criterion: default `PlaceError`.
        candidates: readings that the hardware can take; default `jaxeit.skin.all_pairs`. Drive and sense of a candidate
            may be exchanged, which by reciprocity leaves the reading as it is.
        switch: cost of a change of the driven pair, in readings. Several numbers of driven pairs are tried.
        sense_channels: readings of one drive that the hardware takes at once, in the time of one.
        any_dead: whether h is averaged also over the cases in which any one electrode is dead.
        progress: wraps the iterations, as a progress bar does.

    Raises:
        ProtocolError: for too few readings or candidates.
    """
    require_known("design_scan", ProtocolError, sensitivity, candidates)
    given = all_pairs(sensitivity.electrodes) if candidates is None else np.asarray(candidates)
    pattern = Protocol(given, sense_channels=sense_channels).check(sensitivity.electrodes).pattern
    _check_time(readings, switch, len(pattern))
    search = _DrivenPairSearch(
        criterion or PlaceError(), pattern, _design_cases(sensitivity, pattern, any_dead), progress
    )
    if sense_channels == 1:
        found = search.design_readings(readings, switch)
    else:
        found = search.design_slots(FrameBudget(readings, switch, sense_channels))
    width, length = float(sensitivity.width), search.criterion.length
    chosen = pattern[found.chosen]
    ordered = order_readings(chosen, np.asarray(sensitivity.voltages(chosen)), found.drives)
    return ScanDesign(ordered, width * length(found.mean), width * length(found.bound))


def _check_time(readings: int, switch: float, candidates: int) -> None:
    if not 0 <= switch < np.inf:
        raise ProtocolError(f"switch is {switch}; give the settling time over the time of a reading, 0 or more")
    if not 1 <= readings <= candidates:
        raise ProtocolError(f"readings is {readings}, and there are {candidates:,} candidates; give 1 to so many")
    if readings < 1 + switch:
        raise ProtocolError(f"a frame of {readings} readings is over before one drive has settled; give more readings")


def _design_cases(sensitivity: PlaceSensitivity, pattern: np.ndarray, any_dead: bool) -> Cases:
    """All electrodes alive and, if asked, each of them dead."""
    cases = 1 + any_dead * sensitivity.electrodes
    size = 8 * len(pattern) * (len(sensitivity.sites) * UNKNOWNS + 2 * cases)
    require("array_bytes", size, "design_scan: candidates times sites (give fewer columns or candidates)")
    alive = np.ones((cases, len(pattern)), bool)
    if any_dead:
        alive[1:] = (pattern != np.arange(sensitivity.electrodes)[:, None, None]).all(2)
    rows = sensitivity.rows(pattern)
    return Cases(rows, jnp.asarray(alive, rows.dtype), jnp.diag(sensitivity.prior))


class _ReadingsDesign(NamedTuple):
    """The mean of h and its bound, indices of the chosen candidates, and the driven pairs where they are prescribed."""

    mean: float
    bound: float
    chosen: np.ndarray
    drives: tuple[np.ndarray, np.ndarray] | None = None


class _DrivenPairSearch(NamedTuple):
    """Designs of several numbers of driven pairs; the best one is returned."""

    criterion: AbstractCriterion
    pattern: np.ndarray
    cases: Cases
    progress: Callable[[Iterable[Any]], Iterable[Any]]

    def design_readings(self, readings: int, switch: float) -> _ReadingsDesign:
        """A design of single readings."""
        weights, bound = _optimal_weights(self.criterion, self.cases, readings, self.progress)
        designs = []
        for count in _drive_counts(self.pattern, weights, readings, switch):
            kept, size = np.arange(len(self.pattern)), int(readings - switch * count)
            if switch:
                kept = np.flatnonzero(cover_by_pairs(self.pattern, weights, count)[0] >= 0)
                size = min(size, len(kept))
            part, start = self.cases.subset(kept), weights[kept]
            if switch:
                start, bound = _optimal_weights(self.criterion, part, size, self.progress, start)
            first = np.argsort(-start, kind="stable")[:size]
            chosen, mean = exchange_readings(self.criterion, part, first, self.progress)
            designs.append(_ReadingsDesign(mean, bound, kept[chosen]))
        return min(designs, key=lambda design: design.mean)

    def design_slots(self, frame: FrameBudget) -> _ReadingsDesign:
        """A design of slots; without a cost of switching, any pairs may drive in the end."""
        most = int(frame.time)
        weights, bound = _optimal_weights(
            self.criterion, self.cases, min(most * frame.channels, len(self.pattern)), self.progress
        )
        counts = _drive_counts(self.pattern, weights, most, frame.switch) if frame.switch else [most]
        found = min((self._design_pairs(weights, count, frame) for count in counts), key=lambda design: design.mean)
        if frame.switch or found.drives is None:
            return found
        number, pairs = found.drives
        drives, drive = Drives.of(self.pattern, None), np.full(len(self.pattern), -1)
        drive[found.chosen] = drives.indices(pairs)[number]
        count = -(-np.bincount(drive[found.chosen], minlength=len(drives.pairs)) // frame.channels)
        start = fill_slots(drives, weights, frame, Slots(drive, count))
        slots, mean = exchange_slots(self.criterion, self.cases, drives, frame, start, self.progress)
        return _ReadingsDesign(mean, bound, slots.chosen, (slots.drive[slots.chosen], drives.pairs))

    def _design_pairs(self, weights: np.ndarray, count: int, frame: FrameBudget) -> _ReadingsDesign:
        """A design of so many driven pairs at most, those whose readings weigh most."""
        group, pairs = cover_by_pairs(self.pattern, weights, count)
        kept = np.flatnonzero(group >= 0)
        part, drives = self.cases.subset(kept), Drives.of(self.pattern[kept], pairs)
        slots = int(frame.time - frame.switch * len(pairs))
        readings = min(slots * frame.channels, len(kept))
        start, bound = _optimal_weights(self.criterion, part, readings, self.progress, weights[kept])
        first = fill_slots(drives, start, frame, None)
        best, mean = exchange_slots(self.criterion, part, drives, frame, first, self.progress)
        if len(best.chosen) > readings:  # where fewer pairs drive, there is time for more
            bound = _optimal_weights(self.criterion, part, len(best.chosen), self.progress, start)[1]
        return _ReadingsDesign(mean, bound, kept[best.chosen], (best.drive[best.chosen], drives.pairs))


def _drive_counts(pattern: np.ndarray, weights: np.ndarray, readings: int, switch: float) -> list[int]:
    """Numbers of driven pairs to try: those that leave a fifth to nine tenths of a frame's time for readings."""
    if not switch:
        return [0]
    most = min(len(cover_by_pairs(pattern, weights > 0.5)[1]), int((readings - 1) / switch))
    counts = np.floor(readings * np.array([0.1, 0.2, 0.35, 0.5, 0.65, 0.8]) / switch)
    return sorted({int(count) for count in np.clip(counts, 1, max(most, 1))})


def _optimal_weights(
    criterion: AbstractCriterion,
    cases: Cases,
    count: int,
    progress: Callable[[Iterable[Any]], Iterable[Any]],
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Optimal weights by the multiplicative algorithm, and the lower bound of the mean of h."""
    candidates = cases.rows.shape[2]
    weights = jnp.full(candidates, count / candidates, cases.rows.dtype)
    if start is not None:  # a weight of zero would stay zero
        weights = 0.5 * weights + 0.5 * jnp.asarray(start * count / start.sum(), weights.dtype)
    bound = -np.inf
    for _ in progress(range(MAX_ITERATIONS)):
        after, mean, gap = _multiplicative_step(criterion, cases, weights, count)
        bound = max(bound, float(mean - gap))
        if criterion.length(bound) >= (1 - BOUND_RTOL) * criterion.length(float(mean)):
            break
        weights = after
    return np.asarray(weights), bound


@verb
def _multiplicative_step(
    criterion: AbstractCriterion, cases: Cases, weights: Float[Array, " candidates"], count: int
) -> tuple[Float[Array, " candidates"], Float[Array, ""], Float[Array, ""]]:
    """The next weights; the mean of h at these, and how far it is from its bound at most."""
    covariance = covariance_matrix(cases, weights)
    mean, forms = mean_and_forms(criterion, covariance)
    derivatives = directional_derivatives(cases, forms)
    gap = jnp.sum(jax.lax.top_k(derivatives, count)[0]) - weights @ derivatives
    unbounded = weights * jnp.sqrt(jnp.maximum(derivatives, 0))
    unbounded = unbounded * (count / jnp.sum(unbounded))

    def halve(_: Int[Array, ""], span: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = span
        middle = jnp.sqrt(low * high)
        below = jnp.sum(jnp.minimum(1, middle * unbounded)) < count
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    one = jnp.ones((), weights.dtype)  # the scale c is 1 where no weight is at its bound, and larger otherwise
    scale = jax.lax.fori_loop(0, 60, halve, (one, 1e6 * one))[1]
    return jnp.minimum(1, scale * unbounded), mean, gap
