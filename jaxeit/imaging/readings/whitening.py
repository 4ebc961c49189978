"""From readings to independent numbers of unit noise.

All readings are differences of the L(L-1)/2 *pair sums*, entries of the transfer matrix (see `jacobian`): ``v = P z``
with four entries in each row of P.  So a frame of 1,372 readings of 25 electrodes holds at most 300 numbers, and a
linear reconstruction need not know more of it than the *weighted sums* ``t = P^T W dv``, W the inverse covariance of
the noise: from ``J = P J_z``,

    (J^T W J + l^2 R)^-1 J^T W dv  =  (J_z^T G J_z + l^2 R)^-1 J_z^T t,      G = P^T W P.

With a factor ``G = C^T C`` of full rank and the least E for which ``E C^T = I``, the numbers ``y = E t`` have
independent noise of unit variance and the Jacobian ``C J_z``: what is minimised over them is what would be over all
readings.
"""

from math import prod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Bool, Float, Int
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpstrf

from ..._compile import is_traced
from ...budget import require
from ...effects import AbstractTerminalEffect, CommonMode, chosen
from ...linalg.array_libraries import JAX, NUMPY
from ...model.discretisation import Model
from ...model.mixing import Mixing, matrix_of_rows, padded_rows
from ..inputs import InverseError, known_flags, require_some
from .noise import noise_weight


class Whitening(eqx.Module):
    """The pair sums that a protocol measures, and how well.

    Here ``pairs`` are numbers of pair sums. Where they are electrodes, (k, 2), other classes say so.

    | meaning                                                              | shape              | unit  |
    |----------------------------------------------------------------------|--------------------|-------|
    | pairs: the four pair sums z0 - z1 - z2 + z3 of each reading          | (readings, 4)      |       |
    | lines, sign: the readings that each pair sum occurs in, and its sign or share there; 0: none | (k, c) |  |
    | shares of ``pairs`` in each reading, and (readings, n) pairs, where the protocol has a mixing |     | |
    | current                                                              | ()                 | A     |
    | weight: inverse of the noise, as variances or as a covariance matrix | (readings,) or     | 1/V^2 |
    |   (0 where a channel is not used)                                    | (readings, readings) |     |
    | channels: readings that are used                                     | (readings,)        |       |
    """

    pairs: Int[Array, "readings n"]
    lines: Int[Array, "k c"]
    sign: Float[Array, "k c"]
    current: Float[Array, ""]
    weight: Float[Array, "..."]
    channels: Bool[Array, " readings"]
    shares: Float[Array, "readings n"] | None = None

    @property
    def signs(self) -> Float[Array, "4"] | Float[Array, "readings n"]:
        """Current times the sign of each of the four pair sums of a reading, or times their shares, A."""
        return self.current * (jnp.asarray(SIGNS, self.sign.dtype) if self.shares is None else self.shares)

    def sums(self, dv: Float[Array, "... readings"]) -> Float[Array, "... k"]:
        """The weighted sums ``t = P^T W dv``, A/V; channels that are not used may hold anything."""
        dv = jnp.where(self.channels, dv, 0)
        return self.adjoint(dv * self.weight if self.weight.ndim == 1 else dv @ self.weight)

    def adjoint(self, values: Float[Array, "... readings"]) -> Float[Array, "... k"]:
        """``P^T v``, the adjoint of `readings`: for each pair sum, the values of its readings with their signs, times
        the current."""
        if values.ndim == 1:
            return self.current * jnp.sum(self.sign * values[self.lines], -1)
        batch = values.shape[:-1]
        by_reading = values.reshape(prod(batch), values.shape[-1]).T  # the frames of a batch lie side by side
        sums = jnp.zeros((len(self.lines), by_reading.shape[1]), values.dtype)
        columns = self.sign.T[..., None], self.lines.T
        sums, _ = jax.lax.scan(lambda sums, column: (sums + column[0] * by_reading[column[1]], None), sums, columns)
        return self.current * sums.T.reshape(*batch, len(self.lines))

    def readings(self, z: Float[Array, "k ..."]) -> Float[Array, "readings ..."]:
        """``P z``: readings, V, of pair sums, ohm."""
        if self.shares is not None:
            return self.current * Mixing(self.pairs, self.shares)(z)
        first, second, third, fourth = (z[column] for column in self.pairs.T)
        return self.current * (first - second - third + fourth)


def pairs_of(pattern: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs of electrodes whose sums a pattern, (readings, 4), measures: (k, 2); the four of each reading."""
    source, sink, plus, minus = pattern.T
    ends = np.sort([[plus, source], [minus, source], [plus, sink], [minus, sink]], 1).astype(np.int64)
    count = 1 + ends.max()
    keys, number = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    return np.stack(np.divmod(keys, count), 1), number.reshape(4, -1).T


def whitened(
    pattern: np.ndarray,
    current: Any,
    weight: Any,
    channels: np.ndarray,
    dtype: np.dtype,
    mixing: sp.csr_array | None = None,
    common: float = 0.0,
) -> "Whitened":
    """The pair sums of a protocol, from its pattern (rows, 4); in NumPy unless JAX traces current or weight.

    Args:
        common: gain of the amplifiers for the common-mode voltage (`CommonMode`).
    """
    electrodes, pairs = pairs_of(pattern)
    if common:
        electrodes, p = with_common_mode(pattern, common)
    else:
        p = matrix_of(pairs, len(electrodes))
    require("array_bytes", 8 * len(electrodes) ** 2, "prepare: covariance of the pairs of electrodes")
    shares = None
    if mixing is None and not common:
        lines, sign = lines_of(pairs, len(electrodes))
    else:
        p = p if mixing is None else mixing @ p
        (pairs, shares), (lines, sign) = padded_rows(p), padded_rows(p.T.tocsr())
    arrays = {
        "pairs": pairs.astype(np.int32),
        "lines": lines.astype(np.int32),
        "sign": sign.astype(dtype),
        "current": jnp.asarray(current, dtype) if is_traced(current) else np.asarray(current, dtype),
        "weight": weight.astype(dtype),
        "channels": channels.copy(),  # JAX may keep the array that it is given, and the caller's is not ours to keep
    }
    if shares is not None:
        arrays["shares"] = shares.astype(dtype)
    factors = _factors(p, current, weight, channels)
    return Whitened(Whitening(**_on_device(arrays)), electrodes, *factors)


def _on_device(arrays: dict[str, Any]) -> dict[str, Array]:
    """The arrays in JAX; those with known numbers stay known, inside a compiled function too."""
    known = {name: array for name, array in arrays.items() if not is_traced(array)}
    with jax.ensure_compile_time_eval():
        moved: dict[str, Array] = arrays | jax.device_put(known)
    return moved


class Whitened(NamedTuple):
    """What `whitened` finds; the matrices are in float64 whatever the model's precision.

    The matrices are those of NumPy, or of JAX where it traces the noise or the current.

    | meaning                                           | shape  | unit |
    |---------------------------------------------------|--------|------|
    | whitening                                         |        |      |
    | electrodes: whose pair each sum is                | (k, 2) |      |
    | factor C: from pair sums to whitened readings     | (r, k) | 1/ohm |
    | compress E: from the weighted sums to whitened readings | (r, k) | ohm |
    """

    whitening: Whitening
    electrodes: np.ndarray
    factor: Any
    compress: Any


SIGNS = np.array([1.0, -1.0, -1.0, 1.0])


def with_common_mode(pattern: np.ndarray, gain: float) -> tuple[np.ndarray, sp.csr_array]:
    """The pairs of electrodes, (k, 2), and P for a unit current, (readings, k), of readings
    ``V + gain (V+ + V-) / 2``, with potentials above drive-."""
    source, sink, plus, minus = pattern.T
    ends = np.stack([(plus, source), (minus, source), (plus, sink), (minus, sink), (sink, source), (sink, sink)])
    electrodes, number = np.unique(np.sort(ends, 1).swapaxes(1, 2).reshape(-1, 2), axis=0, return_inverse=True)
    shares = np.append(SIGNS, [0, 0]) + gain / 2 * np.array([1, 1, -1, -1, -2, 2])
    rows = np.tile(np.arange(len(pattern)), len(ends))
    p = sp.csr_array((np.repeat(shares, len(pattern)), (rows, number.ravel())), (len(pattern), len(electrodes)))
    return electrodes.astype(np.int64), p


def lines_of(pairs: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """For each pair sum the readings it occurs in, and its sign there; padded with sign 0."""
    order = np.argsort(pairs, axis=None, kind="stable")
    pair, reading, sign = pairs.ravel()[order], order // 4, SIGNS[order % 4]
    counts = np.bincount(pair, minlength=count)
    rank = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
    lines, signs = np.zeros((count, counts.max()), int), np.zeros((count, counts.max()))
    lines[pair, rank], signs[pair, rank] = reading, sign
    return lines, signs


def lines_of_shares(pairs: np.ndarray, shares: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """For each pair sum the readings it occurs in, and its share there; padded with share 0."""
    place = np.repeat(np.arange(len(pairs)), pairs.shape[1]), pairs.ravel()
    found = sp.csr_array((shares.ravel(), place), (len(pairs), count)).T.tocsr()
    found.eliminate_zeros()
    return padded_rows(found)


def matrix_of(pairs: np.ndarray, count: int) -> sp.csr_array:
    """P for a unit current, (readings, k)."""
    rows = np.repeat(np.arange(len(pairs)), 4)
    return sp.csr_array((np.tile(SIGNS, len(pairs)), (rows, pairs.ravel())), (len(pairs), count))


def gram_of(p: Any, weight: Any) -> Any:
    """``P^T W P``, of a matrix P that is sparse or, for JAX, dense."""
    weighted = p.T * weight if weight.ndim == 1 else p.T @ weight
    gram = weighted @ p
    return gram.toarray() if sp.issparse(gram) else gram


class PairStructure(NamedTuple):
    """Which pair sums are independent in the readings that are used: ``P = P_i M``.

    | meaning                                                        | shape  |
    |----------------------------------------------------------------|--------|
    | taken i: independent pair sums                                 | (r,)   |
    | mixing M                                                       | (r, k) |
    | inverse K of M: ``K M^T = I``, and K is zero where M is        | (r, k) |
    """

    taken: np.ndarray
    mixing: np.ndarray
    inverse: np.ndarray


def structure_of(gram: np.ndarray) -> PairStructure:
    """The structure of G, from its Cholesky factor with pivots: as many pair sums as its rank.

    The tolerance is that of the heaviest readings: beside them, what readings of a millionth of their weight add is
    lost to rounding, and noise whose units differ by 1e60 must not make the rest singular.
    """
    # Of a G of this rank the factor is [A B; 0 0], so that the columns of P left over are those taken times A^-1 B.
    upper, pivots, rank, _ = dpstrf(gram, tol=1e-11 * gram.diagonal().max())
    taken, left = np.split(pivots - 1, [rank])
    mixing, null = np.empty((rank, len(gram))), np.zeros((len(gram), len(left)))
    mixing[:, taken], mixing[:, left] = np.eye(rank), solve_triangular(upper[:rank, :rank], upper[:rank, rank:])
    null[taken], null[left] = -mixing[:, left], np.eye(len(left))
    # The columns of null span the null space of M. The unit matrix on what is taken is an inverse of M; the least one
    # has no part in that space.
    unit = np.zeros_like(mixing)
    unit[:, taken] = np.eye(rank)
    return PairStructure(taken, mixing, unit - unit @ null @ np.linalg.solve(null.T @ null, null.T))


def _factors(p: sp.csr_array, current: Any, weight: Any, channels: np.ndarray) -> tuple[Any, Any]:
    """C of ``G = C^T C``, as many rows as its rank, and the least E with ``E C^T = I``.

    With ``G_ii = L L^T`` on the independent pair sums i, ``C = L^T M`` and ``E = L^-1 K`` (`PairStructure`). Where JAX
    traces the weights, the structure is that of equal weights.
    """
    if is_traced(current, weight):
        current, weight = jnp.asarray(current, float), jnp.asarray(weight, float)  # as on the host, whatever the model
        library, gram = JAX, current**2 * gram_of(p.toarray(), weight)
        structure = structure_of(gram_of(p, channels.astype(float)))
    else:
        library, gram = NUMPY, current**2 * gram_of(p, weight)
        structure = structure_of(gram)
    lower = library.cholesky(gram[np.ix_(structure.taken, structure.taken)])
    return lower.T @ structure.mixing, library.solve_lower(lower, structure.inverse)


def whitened_readings(model: Model, noise: Any, channels: Any) -> Whitened:
    """What of a frame is used, and how much it weighs; noise and channels as for `prepare`."""
    common = _common_gain(chosen(model.effects, AbstractTerminalEffect))
    if is_traced(model.pattern, model.mixing):
        raise InverseError(
            "jit, grad or vmap hides the protocol of the model, which decides the shapes of a reconstruction; use the "
            "model from outside the transformed function, and pass only what changes as an argument"
        )
    readings = model.readings
    used = require_some(np.ones(readings, bool) if channels is None else known_flags(channels, readings))
    weight = noise_weight(noise, readings, used)
    if not is_traced(weight) and not np.abs(weight).max() < np.finfo(model.dtype).max:
        raise InverseError(f"one over the noise squared is beyond {model.dtype}; is the noise in V?")
    current = model.current if is_traced(model.current) else float(model.current)
    rows = len(model.pattern)
    mixing = None if model.mixing is None else matrix_of_rows(model.mixing, rows)
    return whitened(np.asarray(model.pattern), current, weight, used, model.dtype, mixing, common)


def _common_gain(effects: tuple[AbstractTerminalEffect, ...]) -> float:
    """The gain for the common mode, if that is all that acts between sheet and readings."""
    gain = 0.0
    for effect in effects:
        if not isinstance(effect, CommonMode):
            raise InverseError(
                f"{type(effect).__name__} acts between sheet and readings, which are then not the sums of potentials "
                "that reconstruction takes them for; reconstruct with a scene without it"
            )
        if is_traced(effect.gain):
            raise InverseError(
                "jit, grad or vmap hides the gain of CommonMode, which decides what readings are made of"
            )
        gain += float(effect.gain)
    return gain
