"""Images in NumPy: for one frame at a time a call of JAX alone takes longer than the image."""

from functools import cached_property
from math import isfinite, prod
from typing import Any

import numpy as np
from jaxtyping import Array, Float
from scipy.sparse import csr_array

from ..linalg.array_libraries import NUMPY
from .inputs import require_frames
from .readings.missing import Missing, PairRows, completed_sums, correlated, removed
from .readings.whitening import Whitening


class NumpyImages:
    """``factor P^T W dv`` of frames (..., readings) V: images (..., basis) S, NumPy in and out, of one ``dtype``.

    Missing readings are mended as by `AbstractReconstructor.__call__`, by the formulas of `missing`. Mending loses
    digits, so it keeps the precision of ``predict``; and it compiles nothing, so that the first frame which lacks a
    reading takes no longer than the next.
    """

    def __init__(self, factor: Float[Array, "basis k"], predict: Float[Array, "k k"], whitening: Whitening, dtype: str):
        self._exact_factor, self._predict = np.asarray(factor), np.asarray(predict)
        self._factor = self._exact_factor.astype(dtype, copy=False)
        self._used, self._weight = np.asarray(whitening.channels), np.asarray(whitening.weight)
        self._pairs = np.asarray(whitening.pairs, np.intp)
        signs = np.asarray(whitening.signs, self._predict.dtype)
        self._signs = np.broadcast_to(signs, self._pairs.shape)
        self._correlated = self._weight.ndim == 2
        ones = np.ones_like(self._weight, shape=len(self._pairs))
        sums = self._adjoint(ones if self._correlated else self._weight)
        self._exact_sums = sums @ self._weight if self._correlated else sums
        self._sums = self._exact_sums.astype(dtype, copy=False)

    def _adjoint(self, weight: np.ndarray) -> csr_array:
        """``P^T`` times these weights, (k, readings); zero for channels that are not used."""
        place = self._pairs[self._used].ravel(), np.repeat(np.flatnonzero(self._used), self._pairs.shape[1])
        shares = (weight[:, None] * self._signs)[self._used].ravel()
        return csr_array((shares, place), (len(self._predict), len(self._pairs)))

    def __call__(self, dv: Float[np.ndarray, "... readings"]) -> Float[np.ndarray, "... basis"]:
        """The images of these frames."""
        require_frames(dv, len(self._used))
        dv = np.asarray(dv)
        if dv.ndim > 1:
            batch = dv.shape[:-1]
            return self._batch(dv.reshape(prod(batch), dv.shape[-1])).reshape(*batch, len(self._factor))
        t = self._weighted_sums(dv)
        return self._factor.dot(t) if isfinite(t.dot(t)) else self._mended(dv)

    def _weighted_sums(self, dv: np.ndarray) -> np.ndarray:
        dv = dv.astype(self._factor.dtype, copy=False)
        sums: np.ndarray
        if not self._correlated:
            sums = self._sums.dot(dv.T)
            return sums
        with np.errstate(invalid="ignore"):  # infinite readings, which show in the sums
            sums = self._sums.dot(np.where(self._used, dv, 0).T)
        return sums

    def _batch(self, dv: np.ndarray) -> np.ndarray:
        t = self._weighted_sums(dv)
        whole = np.isfinite(t).all(0)
        images: np.ndarray = self._factor.dot(t if whole.all() else np.where(whole, t, 0)).T
        for frame in np.flatnonzero(~whole):
            images[frame] = self._mended(dv[frame])
        return images

    def _mended(self, dv: np.ndarray) -> np.ndarray:
        """The image of the finite readings of a frame."""
        there = np.isfinite(dv)
        missing, left = np.flatnonzero(self._used & ~there), np.flatnonzero(self._used & there)
        known = np.where(there, dv, 0).astype(self._predict.dtype, copy=False)
        if self._correlated or len(missing) <= len(left):
            sums = completed_sums(NUMPY, self._missing(known, missing), self._predict, self._exact_sums.dot(known))
            image: np.ndarray = self._factor.dot(sums.astype(self._factor.dtype, copy=False))
            return image
        image = self._image_of(left, known[left])
        return image.astype(self._factor.dtype, copy=False)

    def _missing(self, known: np.ndarray, missing: np.ndarray) -> Missing[Any]:
        if not self._correlated:
            weight = self._weight[missing]
            return Missing(PairRows(self._pairs[missing], self._signs[missing]), weight, np.zeros_like(weight))
        rows, weights = self._exact_sums[:, missing].T, self._weight[missing]
        return correlated(NUMPY, rows, weights[:, missing], weights @ known)

    def _image_of(self, left: np.ndarray, values: np.ndarray) -> np.ndarray:
        """The image of the few readings that are left: they are added to a reconstructor without readings."""
        predict, factor = self._without_readings
        added = Missing(PairRows(self._pairs[left], self._signs[left]), self._weight[left], values)
        sums = completed_sums(NUMPY, added, predict, np.zeros_like(predict, shape=len(predict)))
        image: np.ndarray = factor.dot(sums)
        return image

    @cached_property
    def _without_readings(self) -> tuple[np.ndarray, np.ndarray]:
        """``-predict`` and ``factor`` of the reconstructor that has no reading; see `missing` for the sign."""
        gram = (self._exact_sums @ self._adjoint(np.ones_like(self._weight)).T).toarray()
        predict, factor = removed(NUMPY, gram, self._predict, self._exact_factor)
        return -predict, np.ascontiguousarray(factor)
