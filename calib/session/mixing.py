"""Scans whose readings are sums of rows of the pattern, such as the trigonometric one."""

import numpy as np
import scipy.sparse as sp


def checked_mixing(mixing: sp.csr_array, rows: int) -> sp.csr_array:
    """Readings as sums of rows of the pattern, (readings, rows); each of some rows, with finite shares.

    Raises:
        ValueError: saying what is wrong.
    """
    mixing = sp.csr_array(mixing, dtype=float)
    if mixing.shape[1] != rows or not mixing.shape[0]:
        raise ValueError(f"has shape {mixing.shape}, the pattern has {rows} rows")
    mixing.sum_duplicates()
    empty = np.diff(mixing.indptr) == 0
    if empty.any():
        raise ValueError(f"reading {int(np.argmax(empty))} is a sum of no rows")
    if not np.isfinite(mixing.data).all():
        raise ValueError("holds a share that is not finite")
    return mixing


def mixing_of_terms(reading: np.ndarray, row: np.ndarray, share: np.ndarray, rows: int) -> sp.csr_array:
    """The readings of which each term (terms,) is a part: a row of the pattern with its share.

    Raises:
        ValueError: saying what is wrong.
    """
    if not len(reading) or reading.min() < 0 or row.min() < 0 or row.max() >= rows:
        raise ValueError(f"names no reading from 0 on, or no row of the {rows} of the pattern")
    if reading.max() >= len(reading):
        raise ValueError(f"names reading {reading.max()} in {len(reading)} terms")
    return checked_mixing(sp.csr_array((share.astype(float), (reading, row)), (int(reading.max()) + 1, rows)), rows)


def same_scan(
    pattern: np.ndarray, mixing: sp.csr_array | None, other: np.ndarray, other_mixing: sp.csr_array | None
) -> bool:
    """Whether two scans have the same readings in the same order."""
    if pattern.shape != other.shape or (pattern != other).any() or (mixing is None) != (other_mixing is None):
        return False
    if mixing is None or other_mixing is None:
        return True
    return mixing.shape == other_mixing.shape and bool(abs(mixing - other_mixing).max() <= 1e-9 * abs(mixing).max())
