"""Readings that are missing from a frame: one algebra for JAX, NumPy, reconstructors and the contact finder.

`whitening` has the symbols: readings v = P z plus noise of inverse covariance W, their weighted sums t = P^T W v, and
G = P^T W P. T is the matrix that predicts pair sums, ``z = T t``, from the one-step image. The missing readings m hold
zero in v.
`Missing` describes them as b = B z plus independent noise of weight w, with what the other readings say about them
through the noise, e:

    independent noise:   B = P_m,             w = W_mm,   e = 0;
    correlated noise:    B = L^-1 (W P)_m,    w = 1,      e = -L^-1 (W v)_m,     L L^T = W_mm.

Everything else follows from B, w and e:

    G_m = B^T w B                          the part of G that the missing readings carry        (`lost_by`)
    t + B^T w e                            the sums of the other readings                       (`lost_by`)
    y = (1 - B T B^T w)^-1 (B T t + e)     values that the image of the others predicts
    t + B^T w y                            sums that give the image of the others               (`completed_sums`)
    M (1 - G_m T)^-1                       for M = T or the factor: readings removed for good   (`removed`)

Sums that give the image of a few readings, where no reading was known before, follow from the same two lines: adding
readings is removing them with the sign of T turned (`completed_sums` with -T, t = 0 and e = the readings).
"""

from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...linalg.array_libraries import JAX, ArrayLibrary
from ...linalg.lapack import eigh
from .whitening import Whitening

# Missing readings up to which JAX gathers their rows of P, for a system of this size; with more it solves one in all
# pair sums. A compiled program needs a fixed number.
GATHERED_READINGS = 16


class Rows(Protocol):
    """The rows B of `Missing`: `PairRows` or `DenseRows`."""

    def times(self, matrix: Any) -> Any:
        """``B M``, (n, m) of a matrix (k, m)."""

    def between(self, rows: Any) -> Any:
        """``A B^T``, (i, n) of rows (i, k)."""

    def add_to(self, library: ArrayLibrary, sums: Any, values: Any) -> Any:
        """``t + B^T y``, (k,) of sums (k,) and values (n,)."""


RowsType = TypeVar("RowsType", bound=Rows)


class PairRows(NamedTuple):
    """Rows of P as four pair sums each; see `Whitening`.

    | meaning                                   | shape          | unit |
    |-------------------------------------------|----------------|------|
    | pairs: the four pair sums of each reading | (n, 4)         |      |
    | signs: current times the sign of each     | (4,) or (n, 4) | A    |

    Readings of a protocol with a mixing have more than four.
    """

    pairs: Any
    signs: Any

    def times(self, matrix: Any) -> Any:
        """See `Rows`."""
        if self.signs.ndim > 1:
            return (self.signs[:, None] @ matrix[self.pairs])[:, 0]
        return self.signs @ matrix[self.pairs]

    def between(self, rows: Any) -> Any:
        """See `Rows`."""
        return (rows[:, self.pairs] * self.signs).sum(-1) if self.signs.ndim > 1 else rows[:, self.pairs] @ self.signs

    def add_to(self, library: ArrayLibrary, sums: Any, values: Any) -> Any:
        """See `Rows`."""
        return library.add_at(sums, self.pairs.ravel(), (values[:, None] * self.signs).ravel())


class DenseRows(NamedTuple):
    """Rows as a matrix, (n, k)."""

    matrix: Any

    def times(self, matrix: Any) -> Any:
        """See `Rows`."""
        return self.matrix @ matrix

    def between(self, rows: Any) -> Any:
        """See `Rows`."""
        return rows @ self.matrix.T

    def add_to(self, library: ArrayLibrary, sums: Any, values: Any) -> Any:
        """See `Rows`."""
        return sums + self.matrix.T @ values


class Missing(NamedTuple, Generic[RowsType]):
    """Missing readings as combinations whose noise is independent; the head of this file has the formulas.

    | meaning                                                             | shape      |
    |---------------------------------------------------------------------|------------|
    | rows B                                                              | (n, k)     |
    | weight w of each; zero where a row only fills up a fixed shape      | (n,) or () |
    | expected e: what the other readings say of each through the noise   | (n,)       |
    """

    rows: RowsType
    weight: Any
    expected: Any


class MissingInformation(NamedTuple):
    """What missing readings take away.

    | meaning                                                            | shape  |
    |--------------------------------------------------------------------|--------|
    | gram: the part of G that the missing readings carry, G_m           | (k, k) |
    | sums of the other readings, weighed by the noise that is theirs    | (k,)   |
    """

    gram: Float[Array, "k k"]
    sums: Float[Array, " k"]


def correlated(library: ArrayLibrary, rows: Any, block: Any, residuals: Any) -> Missing[DenseRows]:
    """The missing readings of a frame whose noise is correlated.

    Args:
        rows: those of ``W P`` that belong to the missing readings, (n, k).
        block: of W, (n, n).
        residuals: entries of ``W v``, (n,).
    """
    lower = library.cholesky(block)
    return Missing(DenseRows(library.solve_lower(lower, rows)), 1.0, -library.solve_lower(lower, residuals))


def completed_sums(library: ArrayLibrary, missing: Missing[Any], predict: Any, sums: Any) -> Any:
    """``t + B^T w y``: the sums of a frame completed by what the image of its other readings predicts, (k,)."""
    through = missing.rows.times(predict)
    among = missing.rows.between(through) * missing.weight
    system = library.namespace.eye(len(among), dtype=among.dtype) - among
    values = library.solve(system, through @ sums + missing.expected)
    return missing.rows.add_to(library, sums, missing.weight * values)


def removed(library: ArrayLibrary, gram: Any, predict: Any, factor: Any) -> tuple[Any, Any]:
    """``predict`` and ``factor`` of a reconstructor that never had the readings which carry this part of G."""
    rest = library.namespace.eye(len(gram), dtype=gram.dtype) - gram @ predict
    both = library.namespace.concatenate([predict, factor])
    found = library.solve(rest.T, both.T).T
    return found[: len(gram)], found[len(gram) :]


# --- in JAX, of a `Whitening` ------------------------------------------------------------------------------------


def completed_sums_of_frame(
    whitening: Whitening, predict: Float[Array, "k k"], dv: Float[Array, " readings"]
) -> Float[Array, " k"]:
    """Sums of a frame that give the image of its finite readings."""
    missing, known = _split(whitening, dv)

    def of_a_few(known: Float[Array, " readings"], missing: Bool[Array, " readings"]) -> Float[Array, " k"]:
        found: Array = completed_sums(JAX, _gathered(whitening, known, missing), predict, whitening.sums(known))
        return found

    def of_many(known: Float[Array, " readings"], missing: Bool[Array, " readings"]) -> Float[Array, " k"]:
        lost = lost_by(_masked(whitening, known, missing), whitening.sums(known))
        found: Array = JAX.solve(jnp.eye(len(lost.sums), dtype=known.dtype) - lost.gram @ predict, lost.sums)
        return found

    sums: Array = jax.lax.cond(jnp.sum(missing) <= GATHERED_READINGS, of_a_few, of_many, known, missing)
    return sums


def missing_information(whitening: Whitening, dv: Float[Array, " readings"]) -> MissingInformation:
    """What a frame loses by its readings that are not finite."""
    missing, known = _split(whitening, dv)
    return lost_by(_masked(whitening, known, missing), whitening.sums(known))


def _split(
    whitening: Whitening, dv: Float[Array, " readings"]
) -> tuple[Bool[Array, " readings"], Float[Array, " readings"]]:
    """Which readings are missing, and the others with zeros in place of these and of channels that are not used."""
    finite = jnp.isfinite(dv)
    return whitening.channels & ~finite, jnp.where(whitening.channels & finite, dv, 0)


def lost_by(missing: Missing[DenseRows], sums: Float[Array, " k"]) -> MissingInformation:
    """The part of G that missing readings carry, of `DenseRows`, and the sums of the others."""
    rows, weighted = missing.rows.matrix, (missing.weight * missing.rows.matrix.T).T
    return MissingInformation(weighted.T @ rows, sums + weighted.T @ missing.expected)


def without_readings(whitening: Whitening, used: Bool[Array, " readings"]) -> tuple[Whitening, Float[Array, "k k"]]:
    """The whitening of the channels that are still used, and the part of G that the others carried."""
    gone, nothing = whitening.channels & ~used, jnp.zeros_like(whitening.sign, shape=used.shape)
    lost = lost_by(_masked(whitening, nothing, gone), whitening.sums(nothing))
    weight = jnp.where(used, whitening.weight, 0)
    if weight.ndim == 2:
        between = correlated(JAX, *_masked_block(whitening.weight, gone, whitening.weight), nothing)
        left = whitening.weight - lost_by(between, nothing).gram
        weight = jnp.where(used[:, None] & used, left, 0)
    changed = (weight, used & whitening.channels)
    return eqx.tree_at(lambda w: (w.weight, w.channels), whitening, changed), lost.gram


def _gathered(
    whitening: Whitening, known: Float[Array, " readings"], missing: Bool[Array, " readings"]
) -> Missing[Any]:
    """Up to `GATHERED_READINGS` missing readings, filled up by ones of no weight."""
    place = jnp.flatnonzero(missing, size=GATHERED_READINGS, fill_value=0)
    there = jnp.arange(GATHERED_READINGS) < jnp.sum(missing)
    if whitening.weight.ndim == 1:
        weight = jnp.where(there, whitening.weight[place], 0)
        signs = whitening.signs if whitening.shares is None else whitening.signs[place]
        return Missing(PairRows(whitening.pairs[place], signs), weight, jnp.zeros_like(weight))
    weights = jnp.where(there[:, None], whitening.weight[place], 0)
    block = jnp.where(there[:, None] & there, weights[:, place], jnp.diag((~there).astype(known.dtype)))
    return correlated(JAX, whitening.adjoint(weights), block, weights @ known)


def _masked(
    whitening: Whitening, known: Float[Array, " readings"], missing: Bool[Array, " readings"]
) -> Missing[DenseRows]:
    """Any number of missing readings, as rows of all readings of which the others have no weight."""
    rows = whitening.readings(jnp.eye(whitening.lines.shape[0], dtype=whitening.sign.dtype))
    if whitening.weight.ndim == 1:
        return Missing(DenseRows(rows), jnp.where(missing, whitening.weight, 0), jnp.zeros_like(known))
    weighted, block = _masked_block(whitening.weight, missing, whitening.weight @ rows)
    return correlated(JAX, weighted, block, jnp.where(missing, whitening.weight @ known, 0))


def _masked_block(
    weight: Float[Array, "readings readings"], missing: Bool[Array, " readings"], rows: Float[Array, "readings m"]
) -> tuple[Float[Array, "readings m"], Float[Array, "readings readings"]]:
    """The rows of the missing readings, and their block of W; zero and one for the others."""
    block = jnp.where(missing[:, None] & missing, weight, jnp.diag((~missing).astype(weight.dtype)))
    return jnp.where(missing[:, None], rows, 0), block


class Gap(NamedTuple):
    """What missing readings do to the whitened numbers y of a frame.

    With all readings the numbers have the metric I. Without some of them, what is minimised over a response f is, up to
    a constant,

        f^T (I - M) f - 2 f^T t,      M = E G_m E^T,      t = E times the sums of the others:

    the squares of ``(I - M)^1/2 f - (I - M)^-1/2 t``. Nothing is filled in.

    | meaning                                                        | shape  |
    |----------------------------------------------------------------|--------|
    | root ``(I - M)^1/2``, by which responses are seen              | (r, r) |
    | y: the numbers to be explained                                 | (r,)   |
    | rank: how many numbers the readings at hand still amount to    | ()     |
    """

    root: Float[Array, "r r"]
    y: Float[Array, " r"]
    rank: Float[Array, ""]


def gap_of(compress: Float[Array, "r k"], lost: MissingInformation) -> Gap:
    """The gap, in numbers ``compress @ sums``; directions that only missing readings knew are left out."""
    metric = jnp.eye(len(compress), dtype=lost.sums.dtype) - compress @ lost.gram @ compress.T
    left, vectors = eigh(jax.lax.stop_gradient(metric))  # it does not depend on what was read
    known = left > 1e4 * jnp.finfo(left.dtype).eps
    root = jnp.sqrt(jnp.where(known, left, 0))
    y = vectors @ (jnp.where(known, 1 / jnp.where(known, root, 1), 0) * (vectors.T @ (compress @ lost.sums)))
    return Gap((vectors * root) @ vectors.T, y, jnp.sum(known).astype(left.dtype))
