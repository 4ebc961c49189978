"""From readings to independent numbers of unit noise.

All readings are differences of the L(L-1)/2 *pair sums*, entries of the transfer matrix (see `jacobian`): ``v = P z``
with four entries in each row of P.  So a frame of 1,372 readings of 25 electrodes holds at most 300 numbers, and a
linear reconstruction need not know more of it than ``t = P^T W dv``, W the inverse covariance of the noise: from
``J = P J_z``,

    (J^T W J + l^2 R)^-1 J^T W dv  =  (J_z^T G J_z + l^2 R)^-1 J_z^T t,      G = P^T W P.

With a factor ``G = C^T C`` of full rank the numbers ``y = E t``, ``E = (C C^T)^-1 C``, have independent noise of unit
variance and the Jacobian ``C J_z``: what is minimised over them is what would be over all readings.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int
from scipy.linalg import cho_factor as cho_factor_host
from scipy.linalg import cho_solve as cho_solve_host
from scipy.linalg.lapack import dpstrf


class Lost(NamedTuple):
    """The part of G that missing readings carried, and ``P^T W dv`` of the others."""

    gram: Float[Array, "k k"]
    sums: Float[Array, " k"]


class Whitening(eqx.Module):
    """The pair sums that a protocol measures, and how well.

    | meaning                                                              | shape              | unit  |
    |----------------------------------------------------------------------|--------------------|-------|
    | pairs: the four pair sums z0 - z1 - z2 + z3 of each reading          | (readings, 4)      |       |
    | lines, sign: the readings that each pair sum occurs in; sign 0: none | (k, c)             |       |
    | current                                                              | ()                 | A     |
    | weight: inverse of the noise, as variances or as a covariance matrix | (readings,) or     | 1/V^2 |
    |   (0 where a channel is not used)                                    | (readings, readings) |     |
    | channels: readings that are used                                     | (readings,)        |       |
    """

    pairs: Int[Array, "readings 4"]
    lines: Int[Array, "k c"]
    sign: Float[Array, "k c"]
    current: Float[Array, ""]
    weight: Float[Array, "..."]
    channels: Bool[Array, " readings"]

    def sums(self, dv: Float[Array, "... readings"]) -> Float[Array, "... k"]:
        """``t = P^T W dv``; channels that are not used may hold anything."""
        dv = jnp.where(self.channels, dv, 0)
        weighted = dv * self.weight if self.weight.ndim == 1 else dv @ self.weight
        return self.current * jnp.sum(self.sign * weighted[..., self.lines], -1)

    def readings(self, z: Float[Array, "k ..."]) -> Float[Array, "readings ..."]:
        """``P z``."""
        first, second, third, fourth = (z[column] for column in self.pairs.T)
        return self.current * (first - second - third + fourth)

    def rows(self, number: Int[Array, " n"]) -> Float[Array, "n k"]:
        """Rows of P."""
        place = self.pairs[number]
        row = jnp.zeros((len(number), self.lines.shape[0]), self.sign.dtype)
        signs = self.current * jnp.asarray(_SIGNS, self.sign.dtype)
        return row.at[jnp.arange(len(number))[:, None], place].add(signs)

    def lost(self, dv: Float[Array, " readings"]) -> Lost:
        """What a frame lacks whose readings are not all finite: their rows and columns leave the covariance.

        The inverse of what remains is a Schur complement of W.
        """
        missing = self.channels & ~jnp.isfinite(dv)
        known = jnp.where(self.channels & ~missing, dv, 0)
        pairs = self.readings(jnp.eye(self.lines.shape[0], dtype=self.sign.dtype))
        rows = jnp.where(missing[:, None], self._weighted(pairs), 0)
        if self.weight.ndim == 1:
            gone = rows / jnp.where(self.weight > 0, self.weight, 1)[:, None]
        else:
            gone = self._solved_among(missing, rows)
        return Lost(rows.T @ gone, self.sums(known) - gone.T @ self._weighted(known))

    def without(self, used: Bool[Array, " readings"]) -> tuple["Whitening", Float[Array, "k k"]]:
        """The whitening of the channels that are still used, and the part of G that the others carried."""
        lost = self.lost(jnp.where(used, jnp.zeros_like(self.sign, shape=used.shape), jnp.nan))
        weight = jnp.where(used, self.weight, 0)
        if self.weight.ndim == 2:
            gone = self.channels & ~used
            rows = jnp.where(gone[:, None], self.weight, 0)
            weight = jnp.where(used[:, None] & used, self.weight - rows.T @ self._solved_among(gone, rows), 0)
        changed = (weight, used & self.channels)
        return eqx.tree_at(lambda w: (w.weight, w.channels), self, changed), lost.gram

    def _solved_among(self, missing: Bool[Array, " readings"], rows: Float[Array, "readings n"]) -> Array:
        """The block of a matrix W that belongs to the missing readings, solved for rows that vanish elsewhere."""
        inner = jnp.where(missing[:, None] & missing, self.weight, jnp.diag((~missing).astype(rows.dtype)))
        return cho_solve(cho_factor(inner), rows)

    def _weighted(self, values: Float[Array, "readings ..."]) -> Float[Array, "readings ..."]:
        """``W values``."""
        return (self.weight * values.T).T if self.weight.ndim == 1 else self.weight @ values


def whitened(
    pattern: np.ndarray, current: float, weight: np.ndarray, channels: np.ndarray, dtype: np.dtype
) -> "Whitened":
    """The pair sums of a protocol, from its pattern (readings, 4); on the host."""
    source, sink, plus, minus = pattern.T
    ends = np.sort([[plus, source], [minus, source], [plus, sink], [minus, sink]], 1).astype(np.int64)
    count = 1 + ends.max()
    keys, number = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    electrodes = np.stack(np.divmod(keys, count), 1)
    pairs = number.reshape(4, -1).T
    lines, sign = lines_of(pairs, len(electrodes))
    found = Whitening(
        pairs=jnp.asarray(pairs, jnp.int32),
        lines=jnp.asarray(lines, jnp.int32),
        sign=jnp.asarray(sign, dtype),
        current=jnp.asarray(current, dtype),
        weight=jnp.asarray(weight, dtype),
        channels=jnp.asarray(channels),
    )
    factor = _factor(pairs, current, weight)
    return Whitened(found, electrodes, factor, cho_solve_host(cho_factor_host(factor @ factor.T), factor))


class Whitened(NamedTuple):
    """What `whitened` finds, the matrices in float64 whatever the model's.

    | meaning                                           | shape  | unit |
    |---------------------------------------------------|--------|------|
    | whitening                                         |        |      |
    | electrodes: whose pair each sum is                | (k, 2) |      |
    | factor C: from pair sums to whitened readings     | (r, k) | 1/ohm |
    | compress E: from the sums ``t`` to whitened readings | (r, k) | ohm |
    """

    whitening: Whitening
    electrodes: np.ndarray
    factor: np.ndarray
    compress: np.ndarray


_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])


def lines_of(pairs: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """For each pair sum the readings it occurs in, and its sign there; padded with sign 0."""
    order = np.argsort(pairs, axis=None, kind="stable")
    pair, reading, sign = pairs.ravel()[order], order // 4, _SIGNS[order % 4]
    counts = np.bincount(pair, minlength=count)
    rank = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
    lines, signs = np.zeros((count, counts.max()), int), np.zeros((count, counts.max()))
    lines[pair, rank], signs[pair, rank] = reading, sign
    return lines, signs


def _factor(pairs: np.ndarray, current: float, weight: np.ndarray) -> np.ndarray:
    """C of ``G = P^T W P = C^T C``, as many rows as its rank: a Cholesky factor with pivots."""
    rows = np.repeat(np.arange(len(pairs)), 4)
    p = current * sp.csr_array((np.tile(_SIGNS, len(pairs)), (rows, pairs.ravel())))
    gram = (p.T @ sp.diags_array(weight) @ p).toarray() if weight.ndim == 1 else p.T @ (p.T @ weight).T
    upper, pivots, rank, _ = dpstrf(gram, tol=1e-11 * gram.diagonal().max())
    factor = np.empty_like(upper)
    factor[:, pivots - 1] = np.triu(upper)
    return factor[:rank]
