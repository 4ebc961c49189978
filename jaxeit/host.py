"""Images in NumPy: for one frame at a time a call of JAX alone takes longer than the image."""

from collections.abc import Callable
from math import isfinite

import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array

from .whitening import SIGNS, Whitening, require_frames

FEW = 16  # readings missing from a frame, up to which they are mended one by one


class HostImages:
    """``factor P^T W dv`` of frames (..., readings) V: images (..., basis) S, NumPy in and out, of one ``dtype``.

    The few readings that a frame lacks are mended through themselves.  A frame that lacks more, or that lacks any of
    readings whose noise is correlated, is left to ``otherwise``: (readings,) to (basis,).  Mending loses digits
    (`AbstractReconstructor.__call__`), so it keeps the precision of ``predict``.
    """

    def __init__(
        self,
        factor: Float[Array, "basis k"],
        predict: Float[Array, "k k"],
        whitening: Whitening,
        otherwise: Callable[[Float[np.ndarray, " readings"]], Float[np.ndarray, " basis"]],
        dtype: str,
    ):
        self._factor, self._predict, self._otherwise = np.asarray(factor, dtype), np.asarray(predict), otherwise
        self._used, self._weight = np.asarray(whitening.channels), np.asarray(whitening.weight)
        self._pairs = np.asarray(whitening.pairs, np.intp)
        self._signs = (float(whitening.current) * SIGNS).astype(self._predict.dtype)
        self._correlated = self._weight.ndim == 2
        weight = np.ones_like(self._weight, shape=len(self._pairs)) if self._correlated else self._weight
        sums = _pair_sums(self._pairs, np.outer(weight, self._signs), self._used, len(self._predict))
        self._exact = sums @ self._weight if self._correlated else sums
        self._weigh = self._exact.astype(dtype, copy=False)

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
        """Through the missing readings: ``y = P T (t + P^T W y)`` on their rows of P."""
        there = np.isfinite(dv)
        missing = np.flatnonzero(self._used & ~there)
        if len(missing) > FEW or self._correlated:
            return np.asarray(self._otherwise(dv), self._factor.dtype)
        t = self._exact.dot(np.where(there, dv, 0).astype(self._predict.dtype, copy=False))
        place, weight = self._pairs[missing], self._weight[missing]
        through = self._signs @ self._predict[place]
        among = through[:, place] @ self._signs * weight
        y = np.linalg.solve(np.eye(len(missing)) - among, through @ t)
        np.add.at(t, place.ravel(), np.outer(weight * y, self._signs).ravel())
        return self._factor.dot(t.astype(self._factor.dtype))


def _pair_sums(pairs: np.ndarray, shares: np.ndarray, used: np.ndarray, count: int) -> csr_array:
    """From readings to (count,) pair sums, with the shares (readings, 4) of the four that each reading occurs in."""
    place = pairs[used].ravel(), np.repeat(np.flatnonzero(used), 4)
    return csr_array((shares[used].ravel(), place), (count, len(pairs)))
