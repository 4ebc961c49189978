"""Images in NumPy: for one frame at a time a call of JAX alone takes longer than the image."""

from functools import cached_property
from math import isfinite

import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array

from .whitening import SIGNS, Whitening, require_frames


class HostImages:
    """``factor P^T W dv`` of frames (..., readings) V: images (..., basis) S, NumPy in and out, of one ``dtype``.

    What frames lack is mended as by `AbstractReconstructor.__call__`.  That loses digits, so it keeps the precision of
    ``predict``; and it compiles nothing, so that the first frame which lacks a reading takes no longer than the next.
    """

    def __init__(self, factor: Float[Array, "basis k"], predict: Float[Array, "k k"], whitening: Whitening, dtype: str):
        self._own, self._predict = np.asarray(factor), np.asarray(predict)
        self._factor = self._own.astype(dtype, copy=False)
        self._used, self._weight = np.asarray(whitening.channels), np.asarray(whitening.weight)
        self._pairs = np.asarray(whitening.pairs, np.intp)
        self._signs = (float(whitening.current) * SIGNS).astype(self._predict.dtype)
        self._correlated = self._weight.ndim == 2
        sums = self._pair_sums(np.ones_like(self._weight, shape=len(self._pairs)) if self._correlated else self._weight)
        self._exact = sums @ self._weight if self._correlated else sums
        self._weigh = self._exact.astype(dtype, copy=False)

    def _pair_sums(self, weight: np.ndarray) -> csr_array:
        """(k, readings): to pair sums, from readings with these weights; none of what is not used."""
        place = self._pairs[self._used].ravel(), np.repeat(np.flatnonzero(self._used), 4)
        shares = np.outer(weight, self._signs)[self._used].ravel()
        return csr_array((shares, place), (len(self._predict), len(self._pairs)))

    def __call__(self, dv: Float[np.ndarray, "... readings"]) -> Float[np.ndarray, "... basis"]:
        dv = np.asarray(dv)
        require_frames(dv, len(self._used))
        if dv.ndim > 1:
            return self._batch(dv.reshape(-1, dv.shape[-1])).reshape(*dv.shape[:-1], -1)
        t = self._sums(dv)
        return self._factor.dot(t) if isfinite(t.dot(t)) else self._mended(dv)

    def _sums(self, dv: np.ndarray) -> np.ndarray:
        dv = dv.astype(self._factor.dtype, copy=False)
        if not self._correlated:
            return self._weigh.dot(dv.T)
        with np.errstate(invalid="ignore"):  # infinite readings, which show in the sums
            return self._weigh.dot(np.where(self._used, dv, 0).T)

    def _batch(self, dv: np.ndarray) -> np.ndarray:
        t = self._sums(dv)
        whole = np.isfinite(t).all(0)
        images = self._factor.dot(t if whole.all() else np.where(whole, t, 0)).T
        for frame in np.flatnonzero(~whole):
            images[frame] = self._mended(dv[frame])
        return images

    def _mended(self, dv: np.ndarray) -> np.ndarray:
        there = np.isfinite(dv)
        missing, left = np.flatnonzero(self._used & ~there), np.flatnonzero(self._used & there)
        known = np.where(there, dv, 0).astype(self._predict.dtype, copy=False)
        if self._correlated:
            image = self._factor.dot(self._together(known, missing).astype(self._factor.dtype, copy=False))
        elif len(missing) <= len(left):
            image = self._factor.dot(self._less(known, missing).astype(self._factor.dtype, copy=False))
        else:
            image = self._from(known, left).astype(self._factor.dtype, copy=False)
        return image

    def _less(self, known: np.ndarray, missing: np.ndarray) -> np.ndarray:
        """Sums, through the missing readings: ``t + P^T W y``, ``y = P T (t + P^T W y)`` on their rows of P."""
        t, weight = self._exact.dot(known), self._weight[missing]
        through, among = self._between(missing, self._predict)
        y = np.linalg.solve(np.eye(len(missing), dtype=t.dtype) - among * weight, through @ t)
        return self._spread(missing, weight * y, t)

    def _together(self, known: np.ndarray, missing: np.ndarray) -> np.ndarray:
        """The same where W is no diagonal: first what remains of it when the rows of the missing leave its inverse."""
        rows, inner = self._exact[:, missing].T, self._weight[np.ix_(missing, missing)]
        t = self._exact @ known - rows.T @ np.linalg.solve(inner, self._weight[missing] @ known)
        through = rows @ self._predict
        return t + rows.T @ np.linalg.solve(inner - through @ rows.T, through @ t)

    def _from(self, known: np.ndarray, left: np.ndarray) -> np.ndarray:
        """The image, through the few readings that are left: ``F P^T W y``, ``y = dv - P C P^T W y`` on their rows."""
        covariance, factor = self._untold
        _, among = self._between(left, covariance)
        weight = self._weight[left]
        y = np.linalg.solve(np.eye(len(left), dtype=known.dtype) + among * weight, known[left])
        return factor.dot(self._spread(left, weight * y, np.zeros_like(covariance, shape=len(covariance))))

    @cached_property
    def _untold(self) -> tuple[np.ndarray, np.ndarray]:
        """C and F, what ``predict`` T and ``factor`` would be without a reading: ``C = T (1 - G T)^-1``, F alike."""
        k = len(self._predict)
        gram = self._exact @ self._pair_sums(np.ones_like(self._weight)).T
        mend = np.eye(k, dtype=self._predict.dtype) - gram @ self._predict
        found = np.linalg.solve(mend.T, np.concatenate([self._predict, self._own]).T).T
        return found[:k], np.ascontiguousarray(found[k:])

    def _between(self, readings: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``P M`` and ``P M P^T`` on the rows of these readings."""
        place = self._pairs[readings]
        through = self._signs @ matrix[place]
        return through, through[:, place] @ self._signs

    def _spread(self, readings: np.ndarray, values: np.ndarray, sums: np.ndarray) -> np.ndarray:
        """Add ``P^T values`` to sums."""
        np.add.at(sums, self._pairs[readings].ravel(), np.outer(values, self._signs).ravel())
        return sums
