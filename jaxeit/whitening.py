"""From readings to independent numbers of unit noise.

All readings are differences of the L(L-1)/2 *pair sums*, entries of the transfer matrix (see `jacobian`): ``v = P z``
with four entries in each row of P.  So a frame of 1,372 readings of 25 electrodes holds at most 300 numbers, and a
linear reconstruction need not know more of it than ``t = P^T W dv``, W the inverse covariance of the noise: from
``J = P J_z``,

    (J^T W J + l^2 R)^-1 J^T W dv  =  (J_z^T G J_z + l^2 R)^-1 J_z^T t,      G = P^T W P.

With a factor ``G = C^T C`` of full rank and the least E for which ``E C^T = I``, the numbers ``y = E t`` have
independent noise of unit variance and the Jacobian ``C J_z``: what is minimised over them is what would be over all
readings.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int
from scipy.linalg import solve_triangular as solve_lower
from scipy.linalg.lapack import dpstrf, dtrtri

from .discretise import Model
from .effects import AbstractTerminalEffect, chosen
from .lapack import cho_factor, cho_solve


class InverseError(ValueError):
    """Settings from which no reconstruction can be made."""


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
        return self.current * self._over_lines(weighted)

    def _over_lines(self, values: Float[Array, "... readings"]) -> Float[Array, "... k"]:
        if values.ndim == 1:
            return jnp.sum(self.sign * values[self.lines], -1)
        by_reading = values.reshape(-1, values.shape[-1]).T  # the frames of a batch lie side by side
        sums = jnp.zeros((len(self.lines), by_reading.shape[1]), values.dtype)
        columns = self.sign.T[..., None], self.lines.T
        sums, _ = jax.lax.scan(lambda sums, column: (sums + column[0] * by_reading[column[1]], None), sums, columns)
        return sums.T.reshape(*values.shape[:-1], -1)

    def readings(self, z: Float[Array, "k ..."]) -> Float[Array, "readings ..."]:
        """``P z``."""
        first, second, third, fourth = (z[column] for column in self.pairs.T)
        return self.current * (first - second - third + fourth)

    def rows(self, number: Int[Array, " n"]) -> Float[Array, "n k"]:
        """Rows of P."""
        place = self.pairs[number]
        row = jnp.zeros((len(number), self.lines.shape[0]), self.sign.dtype)
        signs = self.current * jnp.asarray(SIGNS, self.sign.dtype)
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


def pair_sums(pattern: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pairs of electrodes whose sums a pattern, (readings, 4), measures: (k, 2); the four of each reading."""
    source, sink, plus, minus = pattern.T
    ends = np.sort([[plus, source], [minus, source], [plus, sink], [minus, sink]], 1).astype(np.int64)
    count = 1 + ends.max()
    keys, number = np.unique(ends[:, 0] * count + ends[:, 1], return_inverse=True)
    return np.stack(np.divmod(keys, count), 1), number.reshape(4, -1).T


def whitened(
    pattern: np.ndarray, current: float, weight: np.ndarray, channels: np.ndarray, dtype: np.dtype
) -> "Whitened":
    """The pair sums of a protocol, from its pattern (readings, 4); on the host."""
    electrodes, pairs = pair_sums(pattern)
    lines, sign = lines_of(pairs, len(electrodes))
    arrays = {
        "pairs": pairs.astype(np.int32),
        "lines": lines.astype(np.int32),
        "sign": sign.astype(dtype),
        "current": np.asarray(current, dtype),
        "weight": weight.astype(dtype),
        "channels": channels.copy(),  # JAX may keep what it is given: the caller's stays his own
    }
    factors = _factors(current**2 * _gram(pairs, len(electrodes), weight))
    return Whitened(Whitening(**jax.device_put(arrays)), electrodes, *factors)


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


SIGNS = np.array([1.0, -1.0, -1.0, 1.0])


def lines_of(pairs: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """For each pair sum the readings it occurs in, and its sign there; padded with sign 0."""
    order = np.argsort(pairs, axis=None, kind="stable")
    pair, reading, sign = pairs.ravel()[order], order // 4, SIGNS[order % 4]
    counts = np.bincount(pair, minlength=count)
    rank = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
    lines, signs = np.zeros((count, counts.max()), int), np.zeros((count, counts.max()))
    lines[pair, rank], signs[pair, rank] = reading, sign
    return lines, signs


def _gram(pairs: np.ndarray, count: int, weight: np.ndarray) -> np.ndarray:
    """``G = P^T W P`` for a unit current."""
    if weight.ndim == 1:
        place = count * pairs[:, :, None] + pairs[:, None]
        shares = weight[:, None, None] * np.outer(SIGNS, SIGNS)
        return np.bincount(place.ravel(), shares.ravel(), count**2).reshape(count, count)
    rows = np.repeat(np.arange(len(pairs)), 4)
    p = sp.csr_array((np.tile(SIGNS, len(pairs)), (rows, pairs.ravel())))
    return p.T @ (p.T @ weight).T


def _factors(gram: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C of ``G = C^T C``, as many rows as its rank, by Cholesky with pivots; and the least E.

    ``E C^T = I`` holds for the inverse of the pivots' part; what E does on the null space of C is taken off it.
    """
    upper, pivots, rank, _ = dpstrf(gram, tol=1e-11 * gram.diagonal().max())
    root, (taken, left) = np.triu(upper[:rank]), np.split(pivots - 1, [rank])
    factor, compress, null = np.empty_like(root), np.zeros_like(root), np.zeros((len(gram), len(left)))
    factor[:, pivots - 1] = root
    inverse, _ = dtrtri(root[:, :rank])
    compress[:, taken] = inverse.T
    null[taken], null[left] = -inverse @ root[:, rank:], np.eye(len(left))
    return factor, compress - compress @ null @ np.linalg.solve(null.T @ null, null.T)


def whitened_readings(model: Model, noise, channels) -> Whitened:
    """What of a frame is used, and how much it weighs; noise and channels as for `prepare`."""
    between = chosen(model.effects, AbstractTerminalEffect)
    if between:
        raise InverseError(
            f"{type(between[0]).__name__} acts between sheet and readings, which are then not the differences of "
            "potentials that reconstruction takes them for; reconstruct with a scene without it"
        )
    readings = model.pattern.shape[0]
    used = require_some(np.ones(readings, bool) if channels is None else as_flags(channels, readings))
    weight = noise_weight(noise, readings, used)
    if not np.abs(weight).max() < np.finfo(model.dtype).max:
        raise InverseError(f"one over the noise squared is beyond {model.dtype}; is the noise in V?")
    return whitened(np.asarray(model.pattern), float(model.current), weight, used, model.dtype)


def as_flags(channels, readings: int) -> np.ndarray:
    flags = np.asarray(channels, bool)
    if flags.shape != (readings,):
        raise InverseError(f"channels has shape {flags.shape}; this model has {readings} readings")
    return flags


def require_frames(dv: Float[ArrayLike, "..."], readings: int) -> None:
    """Refuse what is no frame, or frames, of so many readings."""
    if np.shape(dv)[-1:] != (readings,):
        raise InverseError(f"dv has shape {np.shape(dv)}; its last axis must hold {readings} readings")


def require_some(used: np.ndarray) -> np.ndarray:
    if not used.any():
        raise InverseError("every channel is left out: there is nothing to reconstruct from")
    return used


def noise_weight(noise, readings: int, channels: np.ndarray) -> np.ndarray:
    """Inverse of the noise on the channels that are used, zero elsewhere: variances or a covariance."""
    if noise is None:
        return channels.astype(float)
    noise = np.asarray(noise, float)
    if noise.shape not in ((readings,), (readings, readings)):
        raise InverseError(f"noise has shape {noise.shape}; this model has {readings} readings")
    if noise.ndim == 2:
        return _inverse_covariance(noise, channels)
    bad = channels & ~(np.isfinite(noise) & (noise > 0))
    if bad.any():
        raise InverseError(
            f"the noise of reading {int(np.argmax(bad))} is {noise[bad][0]} V; give a positive "
            "number, or leave the channel out with channels=..."
        )
    return np.where(channels, np.where(channels, noise, 1.0) ** -2.0, 0.0)


def _inverse_covariance(noise: np.ndarray, channels: np.ndarray) -> np.ndarray:
    used = np.flatnonzero(channels)
    part = noise[np.ix_(used, used)]
    try:
        lower = np.linalg.cholesky(part)
    except np.linalg.LinAlgError:
        lower = np.full_like(part, np.nan)
    weight = np.zeros_like(noise)
    half = solve_lower(lower, np.eye(len(used)), lower=True, check_finite=False)
    weight[np.ix_(used, used)] = half.T @ half
    if not np.isfinite(weight).all() or not np.allclose(part, part.T, rtol=1e-6, atol=0):
        raise InverseError(
            "the covariance of the noise is not symmetric positive definite; a recording of fewer frames than readings "
            "gives such a one: give standard deviations instead, or shrink it towards its diagonal "
            "(jaxeit.noise_covariance does)"
        )
    return weight


def noise_covariance(blank: Float[ArrayLike, "frames readings"]) -> np.ndarray:
    """Covariance of the readings of a blank recording, shrunk towards its diagonal so that it can be inverted.

    The weight of the diagonal is that of Schaefer and Strimmer (2005): the variance of the off-diagonal entries, as
    the frames tell it, over their squares; 1 where the frames tell of no correlation.

    Args:
        blank: readings without contact, (frames, readings) V; at least four frames, finite.

    Returns:
        (readings, readings) V^2.

    Raises:
        InverseError: for fewer frames, or readings that are not finite or do not change at all.
    """
    blank = np.asarray(blank, float)
    if blank.ndim != 2 or len(blank) < 4 or not np.isfinite(blank).all():
        raise InverseError(f"the blank recording has shape {blank.shape}; give four or more frames of finite readings")
    n, centred = len(blank), blank - blank.mean(0)
    std = centred.std(0, ddof=1)
    if (std == 0).any():
        raise InverseError(f"reading {int(np.argmax(std == 0))} does not change at all; leave it out as a dead channel")
    z = centred / std
    mean = z.T @ z / n
    spread = (z**2).T @ z**2 / n - mean**2
    off = ~np.eye(len(std), dtype=bool)
    correlation = mean * n / (n - 1)
    shrink = np.clip(spread[off].sum() * n / (n - 1) ** 3 * n / max((correlation[off] ** 2).sum(), 1e-300), 0, 1)
    return np.where(off, (1 - shrink) * correlation, 1.0) * np.outer(std, std)
