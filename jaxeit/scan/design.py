"""Optimal design of a scan: which of all four-terminal readings of a skin tell most of the place of a contact.

With weights w_i of the candidates, 0 <= w_i <= 1 and sum w_i = N, the mean over sites of a convex function h of the
covariance of place is minimised by the multiplicative algorithm w_i <- min(1, c w_i sqrt(d_i)), with d_i = -dh/dw_i and
c such that the sum is kept (Silvey, Titterington and Torsney 1978, here with an upper bound). As h is convex, no N
different candidates can have a smaller value than

    h(w) - (sum of the N largest d_i - sum_i w_i d_i),

the certificate of a design (Kiefer and Wolfowitz 1960). The N heaviest readings are then improved by exchanges (Fedorov
1972): the candidate that lowers h most comes in, and the reading that raises it least goes out.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, Integer

from .._compile import require_known, verb
from ..budget import require
from ..registry import Registry
from ..skin.patterns import all_pairs
from ..skin.protocol import Protocol, ProtocolError
from .contact_information import UNKNOWNS, PlaceSensitivity, inverse_information

# Of the weights: at most so many iterations, or until the bound is so near, as part of the error.
ITERATIONS, TOLERANCE = 300, 4e-3
MIN_GAIN = 1e-4  # part of h by which an exchange must lower it
UPPER = np.triu_indices(UNKNOWNS)


class AbstractCriterion(eqx.Module):
    """A convex function h of the covariance of place, (2, 2) in squared widths, whose mean over sites is minimised."""

    name: ClassVar[str]

    @abstractmethod
    def after(self, place: Float[Array, "2 2"], change: Float[Array, " k"]) -> Float[Array, " k"]:
        """h when the covariance changes by ``k k^T`` with ``change = k^T metric k``, or by its negative."""

    @abstractmethod
    def metric(self, place: Float[Array, "2 2"]) -> tuple[Float[Array, ""], Float[Array, "2 2"]]:
        """Factor f and matrix G, with which the derivative of h along ``k k^T`` is ``f k^T G k``."""

    @abstractmethod
    def length(self, mean: float) -> float:
        """The mean of h as an error of place, in widths."""

    def mean(self, covariance: Float[Array, "n 4 4"]) -> Float[Array, ""]:
        """The mean of h over covariances of the unknowns of contacts."""
        nothing = jnp.zeros(1, covariance.dtype)
        return jnp.mean(jax.vmap(lambda c: self.after(c[:2, :2], nothing))(covariance))


class PlaceError(AbstractCriterion):
    """h is a power of the error of place, the root of the sum of both variances.

    A power of 1 is the mean error over sites, 2 the mean variance (A-optimal); a larger one looks at the worst sites. h
    is convex for every power, since the inverse of the sum of variances is concave in the information.
    """

    name: ClassVar[str] = "place-error"
    power: float = eqx.field(default=1.0, static=True)

    def __check_init__(self) -> None:
        if not 0 < self.power <= 40:
            raise ProtocolError(f"power is {self.power}; give a number above 0, up to 40 (the worst site)")

    def after(self, place: Float[Array, "2 2"], change: Float[Array, " k"]) -> Float[Array, " k"]:
        return jnp.maximum(jnp.trace(place) + change, 0) ** (0.5 * self.power)

    def metric(self, place: Float[Array, "2 2"]) -> tuple[Float[Array, ""], Float[Array, "2 2"]]:
        half = 0.5 * self.power
        return half * jnp.trace(place) ** (half - 1), jnp.eye(2, dtype=place.dtype)

    def length(self, mean: float) -> float:
        return float(max(mean, 0.0) ** (1 / self.power))


class PlaceVolume(AbstractCriterion):
    """D-optimal: h is the log determinant of the covariance, the area of the ellipse of place."""

    name: ClassVar[str] = "d-optimal"

    def after(self, place: Float[Array, "2 2"], change: Float[Array, " k"]) -> Float[Array, " k"]:
        return jnp.log(_determinant(place)) + jnp.log1p(jnp.maximum(change, -1))

    def metric(self, place: Float[Array, "2 2"]) -> tuple[Float[Array, ""], Float[Array, "2 2"]]:
        (a, b), (_, d) = place
        return jnp.ones((), place.dtype), jnp.array([[d, -b], [-b, a]]) / _determinant(place)

    def length(self, mean: float) -> float:
        return float(np.sqrt(2) * np.exp(0.25 * mean))


def _determinant(place: Float[Array, "2 2"]) -> Float[Array, ""]:
    return place[0, 0] * place[1, 1] - place[0, 1] ** 2


CRITERIA: Registry[AbstractCriterion] = Registry(AbstractCriterion, "criterion", "jaxeit.criteria")


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


class _Cases(NamedTuple):
    """Candidates, and the cases over which h is averaged: all electrodes alive, and, if asked, each of them dead."""

    rows: Float[Array, "sites 4 candidates"]
    alive: Float[Array, "cases candidates"]
    prior: Float[Array, "4 4"]

    def only(self, kept: Any) -> "_Cases":
        return self._replace(rows=self.rows[:, :, kept], alive=self.alive[:, kept])


def design_scan(
    sensitivity: PlaceSensitivity,
    readings: int,
    criterion: AbstractCriterion | None = None,
    *,
    candidates: Integer[ArrayLike, "candidates 4"] | None = None,
    switch: float = 0.0,
    any_dead: bool = False,
    progress: Callable[[Iterable[Any]], Iterable[Any]] = iter,
) -> ScanDesign:
    """The readings that tell most of the place of a contact anywhere on the sheet, in a given time of a frame.

    Args:
        sensitivity: of the skin, from `place_sensitivity`.
        readings: time of a frame over the time of a reading; without ``switch`` the number of readings.
        criterion: default `PlaceError`.
        candidates: readings that the hardware can take; default `jaxeit.skin.all_pairs`. Drive and sense of a candidate
            may be exchanged, which by reciprocity leaves the reading as it is.
        switch: cost of a change of the driven pair, in readings. Several numbers of driven pairs are tried.
        any_dead: whether h is averaged also over the cases in which any one electrode is dead.
        progress: wraps the iterations, as a progress bar does.

    Raises:
        ProtocolError: for too few readings or candidates.
    """
    require_known("design_scan", ProtocolError, sensitivity, candidates)
    given = all_pairs(sensitivity.electrodes) if candidates is None else np.asarray(candidates)
    pattern = Protocol(given).check(sensitivity.electrodes).pattern
    criterion = criterion or PlaceError()
    if not 0 <= switch < np.inf:
        raise ProtocolError(f"switch is {switch}; give the settling time over the time of a reading, 0 or more")
    if not 1 <= readings <= len(pattern):
        raise ProtocolError(f"readings is {readings}, and there are {len(pattern):,} candidates; give 1 to so many")
    if readings < 1 + switch:
        raise ProtocolError(f"a frame of {readings} readings is over before one drive has settled; give more readings")
    cases = 1 + any_dead * sensitivity.electrodes
    size = 8 * len(pattern) * (len(sensitivity.sites) * UNKNOWNS + 2 * cases)
    require("array_bytes", size, "design_scan: candidates times sites (give fewer columns or candidates)")
    alive = np.ones((cases, len(pattern)), bool)
    if any_dead:
        alive[1:] = (pattern != np.arange(sensitivity.electrodes)[:, None, None]).all(2)
    rows = sensitivity.rows(pattern)
    whole = _Cases(rows, jnp.asarray(alive, rows.dtype), jnp.diag(sensitivity.prior))
    weights, bound = _relaxed(criterion, whole, readings, progress)
    found = []
    for count in _drive_counts(pattern, weights, readings, switch):
        kept, left = np.arange(len(pattern)), int(readings - switch * count)
        if switch:
            kept = np.flatnonzero(cover(pattern, weights, count)[0] >= 0)
            left = min(left, len(kept))
        part, start = whole.only(kept), weights[kept]
        if switch:
            start, bound = _relaxed(criterion, part, left, progress, start)
        taken, mean = _exchanged(criterion, part, np.argsort(-start, kind="stable")[:left], progress)
        found.append((mean, kept[taken], bound))
    mean, taken, bound = min(found, key=lambda one: one[0])
    width = float(sensitivity.width)
    ordered = in_order(pattern[taken], np.asarray(sensitivity.voltages(pattern[taken])))
    return ScanDesign(ordered, width * criterion.length(mean), width * criterion.length(bound))


def _drive_counts(pattern: np.ndarray, weights: np.ndarray, readings: int, switch: float) -> list[int]:
    """Numbers of driven pairs to try: those that leave a fifth to nine tenths of a frame's time for readings."""
    if not switch:
        return [0]
    most = min(len(cover(pattern, weights > 0.5)[1]), int((readings - 1) / switch))
    counts = np.floor(readings * np.array([0.1, 0.2, 0.35, 0.5, 0.65, 0.8]) / switch)
    return sorted({int(count) for count in np.clip(counts, 1, max(most, 1))})


def _relaxed(
    criterion: AbstractCriterion,
    cases: _Cases,
    count: int,
    progress: Callable[[Iterable[Any]], Iterable[Any]],
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Optimal weights, and the lower bound of the mean of h."""
    candidates = cases.rows.shape[2]
    weights = jnp.full(candidates, count / candidates, cases.rows.dtype)
    if start is not None:  # no candidate may begin with nothing, since it would stay so
        weights = 0.5 * weights + 0.5 * jnp.asarray(start * count / start.sum(), weights.dtype)
    bound = -np.inf
    for _ in progress(range(ITERATIONS)):
        after, mean, gap = _step(criterion, cases, weights, count)
        bound = max(bound, float(mean - gap))
        if criterion.length(bound) >= (1 - TOLERANCE) * criterion.length(float(mean)):
            break
        weights = after
    return np.asarray(weights), bound


@verb
def _step(
    criterion: AbstractCriterion, cases: _Cases, weights: Float[Array, " candidates"], count: int
) -> tuple[Float[Array, " candidates"], Float[Array, ""], Float[Array, ""]]:
    """The next weights; the mean of h at these, and how far it is from its bound at most."""
    covariance = _covariance(cases, weights)
    mean, forms = _forms(criterion, covariance)
    steepness = _summed_forms(cases, forms)
    gap = jnp.sum(jax.lax.top_k(steepness, count)[0]) - weights @ steepness
    wanted = weights * jnp.sqrt(jnp.maximum(steepness, 0))
    wanted = wanted * (count / jnp.sum(wanted))

    def halve(_: Int[Array, ""], span: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = span
        middle = jnp.sqrt(low * high)
        few = jnp.sum(jnp.minimum(1, middle * wanted)) < count
        return jnp.where(few, middle, low), jnp.where(few, high, middle)

    one = jnp.ones((), weights.dtype)  # the scale c lies above 1, where nothing is cut
    scale = jax.lax.fori_loop(0, 60, halve, (one, 1e6 * one))[1]
    return jnp.minimum(1, scale * wanted), mean, gap


def _covariance(cases: _Cases, weights: Float[Array, " candidates"]) -> Float[Array, "sites cases 4 4"]:
    """Covariance of the unknowns at each site in each case."""
    weighted = (cases.alive * weights).T

    def site(rows: Float[Array, "4 candidates"]) -> Float[Array, "cases 4 4"]:
        upper = (rows[UPPER[0]] * rows[UPPER[1]] @ weighted).T
        whole = jnp.zeros((len(upper), UNKNOWNS, UNKNOWNS), rows.dtype).at[:, *UPPER].set(upper)
        return whole + jnp.triu(whole, 1).swapaxes(1, 2) + cases.prior

    information: Array = jax.lax.map(site, cases.rows)
    return inverse_information(information.reshape(-1, UNKNOWNS, UNKNOWNS)).reshape(information.shape)


def _forms(
    criterion: AbstractCriterion, covariance: Float[Array, "sites cases 4 4"]
) -> tuple[Float[Array, ""], Float[Array, "sites cases 4 4"]]:
    """The mean of h, and the matrices Q with which ``-dh/dw_i = sum over sites and cases of j_i^T Q j_i``."""
    flat = covariance.reshape(-1, UNKNOWNS, UNKNOWNS)
    mean = criterion.mean(flat)

    def form(c: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
        factor, metric = criterion.metric(c[:2, :2])
        return factor / len(flat) * c[:, :2] @ metric @ c[:2]

    return mean, jax.vmap(form)(flat).reshape(covariance.shape)


def _quadratic(form: Float[Array, "cases 4 4"], rows: Float[Array, "4 candidates"]) -> Float[Array, "cases candidates"]:
    """``j^T Q j`` of each candidate, in each case."""
    twice = np.where(UPPER[0] == UPPER[1], 1.0, 2.0).astype(rows.dtype)
    return (form[:, *UPPER] * twice) @ (rows[UPPER[0]] * rows[UPPER[1]])


def _summed_forms(cases: _Cases, forms: Float[Array, "sites cases 4 4"]) -> Float[Array, " candidates"]:
    def add(total: Array, site: tuple[Array, Array]) -> tuple[Array, None]:
        return total + _quadratic(site[1], site[0]), None

    total, _ = jax.lax.scan(add, jnp.zeros_like(cases.alive), (cases.rows, forms))
    return jnp.sum(total * cases.alive, 0)


def _changes(
    criterion: AbstractCriterion, cases: _Cases, covariance: Float[Array, "sites cases 4 4"], sign: float
) -> Float[Array, " candidates"]:
    """The change of the mean of h when each candidate is added (sign 1) or taken away (-1), exactly.

    By Sherman and Morrison ``(M + s j j^T)^-1 = M^-1 - s k k^T / (1 + s j^T k)`` with ``k = M^-1 j``.
    """

    def add(total: Array, site: tuple[Array, Array]) -> tuple[Array, None]:
        rows, inverse = site
        metric = jax.vmap(lambda c: c[:, :2] @ criterion.metric(c[:2, :2])[1] @ c[:2])(inverse)
        left = jnp.maximum(1 + sign * _quadratic(inverse, rows), 1e-12)
        place, nothing = inverse[:, :2, :2], jnp.zeros(1, rows.dtype)
        change = -sign * _quadratic(metric, rows) / left
        after = jax.vmap(criterion.after)(place, change) - jax.vmap(lambda p: criterion.after(p, nothing))(place)
        return total + jnp.sum(after * cases.alive, 0), None

    total, _ = jax.lax.scan(add, jnp.zeros(cases.alive.shape[1], cases.rows.dtype), (cases.rows, covariance))
    return total / (covariance.shape[0] * covariance.shape[1])


def _exchanged(
    criterion: AbstractCriterion,
    cases: _Cases,
    taken: np.ndarray,
    progress: Callable[[Iterable[Any]], Iterable[Any]],
) -> tuple[np.ndarray, float]:
    """The readings after exchanges, and the mean of h."""
    now, best = jnp.asarray(taken), np.inf
    for _ in progress(range(2 * len(taken))):
        mean, after = _exchange(criterion, cases, now)
        if best - float(mean) <= MIN_GAIN * abs(float(mean)):
            break
        taken, best, now = np.asarray(now), float(mean), after
    return taken, best


@verb
def _exchange(
    criterion: AbstractCriterion, cases: _Cases, taken: Int[Array, " count"]
) -> tuple[Float[Array, ""], Int[Array, " count"]]:
    """The mean of h for the readings taken, and the readings after the best one has come in and the least has gone."""

    def of(rows: Int[Array, " k"]) -> tuple[_Cases, Float[Array, "sites cases 4 4"]]:
        part = cases.only(rows)
        return part, _covariance(part, jnp.ones(len(rows), cases.rows.dtype))

    _, covariance = of(taken)
    worth = _changes(criterion, cases, covariance, 1.0).at[taken].set(jnp.inf)
    more = jnp.append(taken, jnp.argmin(worth).astype(taken.dtype))
    out = jnp.argmin(_changes(criterion, *of(more), -1.0))
    return _forms(criterion, covariance)[0], more.at[out].set(more[-1])[:-1]


def cover(
    pattern: np.ndarray, weights: Float[np.ndarray, " k"] | Bool[np.ndarray, " k"], most: int | None = None
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, "drives 2"]]:
    """For each reading the number of the driven pair that takes it, as drive or by reciprocity as sense; and the pairs.

    Pairs are taken one by one, each time the one of the largest weight of readings not yet covered, until all readings
    with a weight are covered or ``most`` pairs are taken. A reading that is not covered has the number -1.
    """
    size = int(pattern.max()) + 1
    ends = np.sort(pattern.reshape(-1, 2, 2), 2) @ [size, 1]
    found, left = np.full(len(pattern), -1), np.asarray(weights, float).copy()
    taken: list[tuple[int, int]] = []
    while left.any() and len(taken) < (len(pattern) if most is None else most):
        best = int(np.argmax(sum(np.bincount(ends[:, end], left, minlength=size**2) for end in (0, 1))))
        new = (ends == best).any(1) & (found < 0)
        found[new], left[new] = len(taken), 0
        taken.append(divmod(best, size))
    return found, np.array(taken, int).reshape(-1, 2)


def in_order(
    pattern: Integer[np.ndarray, "readings 4"], voltages: Float[np.ndarray, " readings"]
) -> Int[np.ndarray, "readings 4"]:
    """Readings sorted by driven pair, of which as few are used as possible, with untouched voltages above zero."""
    group, pairs = cover(pattern, np.ones(len(pattern)))
    drive, out = pairs[group], pattern.copy()
    swap = (np.sort(out[:, :2], 1) != drive).any(1)
    out[swap] = out[swap][:, [2, 3, 0, 1]]
    turned = (out[:, :2] != drive).any(1)
    out[turned] = out[turned][:, [1, 0, 3, 2]]
    negative = voltages < 0
    out[negative] = out[negative][:, [0, 1, 3, 2]]
    order = np.lexsort((*out.T[::-1], group))
    return out[order].astype(np.int32)
