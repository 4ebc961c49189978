"""Choice of the most informative readings of a scan, for frames with fewer readings.

A frame costs time for each of its readings and for each change of the driven pair. `choose_readings` takes readings
one by one, each time the one that adds most information to those taken; the information already known is removed from
the signal covariance (`jaxeit.scan.covariance`). As log det is submodular, the chosen readings have at least 1 - 1/e of
the information of the best set of equal size (Nemhauser, Wolsey and Fisher 1978).
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, Integer

from .._compile import is_traced, require_known, verb
from ..linalg.array_libraries import real_array
from ..messages.kinds import is_number, require_kind, shown
from ..skin.protocol import Protocol, ProtocolError

# A gain below this part of the largest one is rounding error: the readings taken before span the range of K.
ROUNDING_FRACTION = 1e-11


class AbstractSelection(eqx.Module):
    """A rule that ranks the readings not yet taken."""

    @abstractmethod
    def gain(self, left: Float[Array, " readings"]) -> Float[Array, " readings"]:
        """Gain of each reading, (readings,), zero or more, from its variance given the readings taken."""

    @abstractmethod
    def pivot(self, left: Float[Array, ""]) -> Float[Array, ""]:
        """Divisor of the outer product that is subtracted from K when a reading is taken."""


class DOptimal(AbstractSelection):
    """Greedy on ``log det(1 + K_SS)``: the readings that determine the image best, given the noise and the prior."""

    def gain(self, left: Float[Array, " readings"]) -> Float[Array, " readings"]:
        return jnp.log1p(jnp.maximum(left, 0))

    def pivot(self, left: Float[Array, ""]) -> Float[Array, ""]:
        return 1 + left


class Volume(AbstractSelection):
    """Greedy on ``det K_SS``, the volume that the rows of sensitivity span (arXiv 2111.01397), at any noise.

    It can choose no more readings than the rank of K.
    """

    def gain(self, left: Float[Array, " readings"]) -> Float[Array, " readings"]:
        return jnp.maximum(left, 0)

    def pivot(self, left: Float[Array, ""]) -> Float[Array, ""]:
        return left


class Sensitive(AbstractSelection):
    """The largest of ``sum_e J_me^2`` (times the prior's variance), each reading alone.

    It ignores the information of the other readings, so that many of its choices are redundant.
    """

    def gain(self, left: Float[Array, " readings"]) -> Float[Array, " readings"]:
        return jnp.maximum(left, 0)

    def pivot(self, left: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.full_like(left, jnp.inf)


class Chosen(eqx.Module):
    """Readings in the order in which they were taken.

    | meaning                                                     | shape    |
    |-------------------------------------------------------------|----------|
    | rows of the scan's pattern                                  | (count,) |
    | gain of each, in the measure of the selection; `DOptimal`: nats | (count,) |
    """

    rows: Int[Array, " count"]
    gain: Float[Array, " count"]


def choose_readings(
    signal: Float[Array, "readings readings"],
    count: int,
    selection: AbstractSelection | None = None,
    *,
    pattern: Integer[ArrayLike, "readings 4"] | None = None,
    switch: float = 0.0,
) -> Chosen:
    """Choose the ``count`` most informative readings, one by one.

    Under jit and grad the rows are those of the greedy choice and the gains have derivatives; the rank is not checked.

    Args:
        signal: K, from `signal_covariance`.
        count: number of readings to choose.
        selection: default `DOptimal`.
        pattern: rows of the scan; needed with ``switch``.
        switch: cost of a change of the driven pair, in readings (settling time over reading time).  The next reading
            is then the one with the largest gain over its cost; a pair that is already driven has no extra cost.

    Raises:
        ProtocolError: if the scan has fewer readings, or (for `Volume`) K has a lower rank.
    """
    signal, selection = real_array("signal", signal, ProtocolError), selection or DOptimal()
    readings = _reading_count(signal)
    give = "an object, such as selection=jaxeit.scan.DOptimal()"
    require_kind(selection, AbstractSelection, ProtocolError, "a selection", give, "choose_readings")
    if not is_number(count) or not 0 < count <= readings:
        raise ProtocolError(f"count is {shown(count)}, and this scan has {readings} readings; give 1 to {readings}")
    if pattern is None and (is_traced(switch) or switch):
        raise ProtocolError("switch is given without the pattern that names the driven pairs; give pattern=")
    drive = np.zeros(readings, int) if pattern is None else drives(pattern)
    chosen = _greedy_selection(selection, signal, jnp.asarray(drive), jnp.asarray(switch, signal.dtype), count)
    if isinstance(selection, Volume) and _is_rank_deficient(chosen):
        raise ProtocolError(
            f"the readings span fewer than {count} dimensions; ask for fewer readings, or choose by DOptimal"
        )
    return chosen


def _reading_count(signal: Float[Array, "readings readings"]) -> int:
    """The number of readings of K, which is refused unless it is square and, where it can be seen, finite."""
    if signal.ndim != 2 or signal.shape[0] != signal.shape[1]:
        raise ProtocolError(f"signal has shape {signal.shape}; give (readings, readings), from signal_covariance")
    if not is_traced(signal) and not np.isfinite(np.asarray(signal)).all():
        raise ProtocolError("signal has entries that are not finite; give that of signal_covariance for a sound model")
    return signal.shape[0]


def _is_rank_deficient(chosen: Chosen) -> bool:
    """Whether the gain of the last reading is only rounding error; False for traced gains."""
    known = not is_traced(chosen.gain)
    return known and float(chosen.gain[-1]) <= ROUNDING_FRACTION * float(jnp.max(chosen.gain))


def drives(pattern: Integer[ArrayLike, "readings 4"]) -> Int[np.ndarray, " readings"]:
    """Number of the driven pair of each row, (readings,)."""
    require_known("drives", ProtocolError, pattern)
    return np.asarray(np.unique(np.asarray(pattern)[:, :2], axis=0, return_inverse=True)[1]).ravel()


@verb
def _greedy_selection(
    selection: AbstractSelection,
    signal: Float[Array, "readings readings"],
    drive: Int[Array, " readings"],
    switch: Float[Array, ""],
    count: int,
) -> Chosen:
    """Cholesky factorisation of K with pivots: ``K - F^T F`` is unexplained, with a row of F per reading taken."""
    m, zero = len(signal), jnp.zeros((), signal.dtype)
    start = (
        jnp.diagonal(signal),
        jnp.zeros((count, m), signal.dtype),
        jnp.zeros(m, bool),
        jnp.zeros(count, int),
        jnp.zeros(count, signal.dtype),
    )

    def take(k: Int[Array, ""], state: tuple[Array, ...]) -> tuple[Array, ...]:
        left, factor, taken, rows, gains = state
        gain = selection.gain(left)
        driven = jnp.zeros(m, bool).at[drive].max(taken)[drive]
        row = jnp.argmax(jnp.where(taken, -1, gain / (1 + jnp.where(driven, zero, switch))))
        pivot = selection.pivot(left[row])
        factor_row = (signal[row] - factor[:, row] @ factor) * jnp.where(pivot > 0, pivot, jnp.inf) ** -0.5
        factor = factor.at[k].set(factor_row)
        return left - factor_row**2, factor, taken.at[row].set(True), rows.at[k].set(row), gains.at[k].set(gain[row])

    *_, rows, gains = jax.lax.fori_loop(0, count, take, start)
    return Chosen(rows, gains)


def shortened(protocol: Protocol, rows: Integer[ArrayLike, " count"] | Bool[ArrayLike, " readings"]) -> Protocol:
    """The scan reduced to some of its rows, in the scan's order, so that each pair is driven once.

    Args:
        protocol: the whole scan.
        rows: numbers of the rows to keep, or a flag for each row.

    Raises:
        ProtocolError: if no row is left.
    """
    rows = np.asarray(rows)
    rows = np.flatnonzero(rows) if rows.dtype == bool else np.unique(rows)
    return protocol.only(rows)


def scan_time(protocol: Protocol, switch: float = 0.0) -> float:
    """Seconds per frame when scans follow each other.

    Readings that several sense channels take at once count as one.

    Args:
        protocol: the scan.
        switch: cost of a change of the driven pair, in readings.

    Raises:
        ProtocolError: for a protocol of matrices, whose drives are no pairs.
    """
    drive = drives(protocol.rows("scan_time"))
    changes = int(np.sum(drive != np.roll(drive, 1)))
    return (protocol.frame_slots + switch * changes) * protocol.reading_time


def in_frame(
    values: Float[ArrayLike, "... count"], rows: Integer[ArrayLike, " count"], readings: int
) -> Float[Array, "... readings"]:
    """Put the readings of a shortened scan into a frame of the whole scan, with NaN for all other readings.

    Reconstructors and contact finders omit NaN exactly, so that one reconstructor or finder serves all shortened scans.

    Args:
        values: (..., count) V, in the order of the shortened scan.
        rows: numbers of the rows in the whole scan, ascending.
        readings: number of readings of the whole scan.
    """
    values = jnp.asarray(values)
    frame = jnp.full((*values.shape[:-1], readings), jnp.nan, values.dtype)
    return frame.at[..., jnp.asarray(rows)].set(values)
