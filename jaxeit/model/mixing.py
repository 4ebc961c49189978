"""Readings that are sums of four-electrode readings: any currents, any voltages (`Protocol.from_matrices`)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int


class Mixing(eqx.Module):
    """A sparse matrix from four-electrode readings to readings, as its rows; shorter rows are padded with zero share.

    | meaning                                 | shape         |
    |-----------------------------------------|---------------|
    | row: rows of the pattern in a reading   | (readings, c) |
    | share of each                           | (readings, c) |
    """

    row: Int[Array, "readings c"]
    share: Float[Array, "readings c"]

    @property
    def readings(self) -> int:
        """Number of readings."""
        return self.row.shape[0]

    def __call__(self, values: Float[Array, "rows ..."]) -> Float[Array, "readings ..."]:
        """The readings from values of the rows of the pattern; the other axes are independent."""

        def add(total: Array, column: tuple[Array, Array]) -> tuple[Array, None]:
            row, share = column
            return total + (share * values[row].T).T, None

        start = jnp.zeros((self.readings, *values.shape[1:]), values.dtype)
        total: Array = jax.lax.scan(add, start, (self.row.T, self.share.T))[0]
        return total


def padded_rows(matrix: sp.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Column and value of every entry of each row, (rows, c), padded with column 0 and value 0."""
    counts = np.diff(matrix.indptr)
    line = np.repeat(np.arange(len(counts)), counts)
    rank = np.arange(len(line)) - np.repeat(matrix.indptr[:-1], counts)
    column, value = np.zeros((len(counts), counts.max()), int), np.zeros((len(counts), counts.max()))
    column[line, rank], value[line, rank] = matrix.indices, matrix.data
    return column, value


def matrix_of_rows(mixing: Mixing, rows: int) -> sp.csr_array:
    """The reverse of `padded_rows`, of known numbers: (readings, rows)."""
    column, value = np.asarray(mixing.row), np.asarray(mixing.share, float)
    line = np.repeat(np.arange(len(column)), column.shape[1])
    matrix = sp.csr_array((value.ravel(), (line, column.ravel())), (len(column), rows))
    matrix.eliminate_zeros()
    return matrix
