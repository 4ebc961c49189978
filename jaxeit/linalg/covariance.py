"""Whether a matrix that was read from a file can be a covariance."""

import numpy as np

ROUNDING = 16.0
"""Largest negative eigenvalue of correlations that counts as rounding, over the square root of the precision."""


def is_covariance(matrices: np.ndarray) -> bool:
    """Whether matrices (..., n, n) are symmetric and positive semidefinite up to rounding.

    The test is the Cholesky factorisation of the correlations with a small multiple of the identity added, which takes
    a fraction of the time for eigenvalues. A matrix with values that are not finite is no covariance.

    Example:
        for correlation in (0.5, 2.0):
            print(correlation, linalg.is_covariance(np.array([[1.0, correlation], [correlation, 1.0]])))
    """
    matrices = np.asarray(matrices)
    variance = np.diagonal(matrices, axis1=-2, axis2=-1).astype(np.float64)
    if not np.isfinite(matrices).all() or (variance < 0).any():
        return False
    size = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = matrices / size[..., :, None] / size[..., None, :]
    tolerance = ROUNDING * float(np.sqrt(np.finfo(matrices.dtype).eps))
    symmetric = np.abs(correlation - np.swapaxes(correlation, -1, -2)).max(initial=0.0) <= tolerance
    try:
        np.linalg.cholesky(correlation + tolerance * np.eye(matrices.shape[-1]))
    except np.linalg.LinAlgError:
        return False
    return bool(symmetric)
