"""Scans whose readings are sums of rows of the pattern, such as the trigonometric one."""

from collections.abc import Sized
from typing import Protocol, runtime_checkable

import numpy as np
import scipy.sparse as sp

TERMS = ("term_reading", "term_row", "term_share")  # datasets of a session file: what `terms_of_mixing` gives


@runtime_checkable
class Scan(Protocol):
    """What a session, a table of its channels and the protocol of a skin have in common."""

    @property
    def pattern(self) -> np.ndarray | None:
        """Zero-based electrodes drive+, drive-, sense+, sense- of each row, (rows, 4)."""

    @property
    def mixing(self) -> sp.csr_array | None:
        """Readings as sums of rows, (readings, rows); None: each row is one."""


def count_readings(pattern: Sized, mixing: sp.csr_array | None) -> int:
    """Number of readings of a frame."""
    return len(pattern) if mixing is None else int(mixing.shape[0])


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


def terms_of_mixing(mixing: sp.csr_array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reading, row of the pattern and share of each term (terms,): the reverse of `mixing_of_terms`."""
    found = mixing.tocoo()
    return (*found.coords, found.data)


def same_scan(one: Scan, other: Scan) -> bool:
    """Whether two scans have the same readings in the same order."""
    if one.pattern is None or other.pattern is None or not np.array_equal(one.pattern, other.pattern):
        return False
    mine, others = one.mixing, other.mixing
    if mine is None or others is None:
        return mine is others
    return mine.shape == others.shape and bool(abs(mine - others).max() <= 1e-9 * abs(mine).max())
