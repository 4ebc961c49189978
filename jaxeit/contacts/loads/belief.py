"""The prior of loads and of the sheet before a frame."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .pressure import FORMS, free_parameters
from .result import LoadKind
from .sheet import PressedSheet


class LoadBelief(eqx.Module):
    """Prior of fits of loads.

    | meaning                                                             | shape            | unit |
    |---------------------------------------------------------------------|------------------|------|
    | sheet: from loads to whitened readings                              |                  |      |
    | low, high: corners of the sheet                                     | (2,)             | m    |
    | prior_mean, prior_std: of log width, log force                      | (2,)             |      |
    | difference_std: of the differences of these between loads           | (2,)             |      |
    | min_separation: distance of two loads, length of an edge, below which they count as one | (2,) | m |
    | length_std: of half an edge, in each direction                      | ()               | m    |
    | kind_probabilities: in the order of `LoadKind`                      | (5,)             |      |
    | model_error, shapes: see `LoadSettings`                             | (), (factors,)   |      |
    | force_logs, force_covariance, force_variance: see `ForceLaw`        | (3,), (3, 3), () |      |
    """

    sheet: PressedSheet
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    prior_mean: Float[Array, "2"]
    prior_std: Float[Array, "2"]
    difference_std: Float[Array, "2"]
    min_separation: Float[Array, "2"]
    length_std: Float[Array, ""]
    kind_probabilities: Float[Array, "5"]
    model_error: Float[Array, ""]
    shapes: Float[Array, " factors"]
    force_logs: Float[Array, "3"]
    force_covariance: Float[Array, "3 3"]
    force_variance: Float[Array, ""]

    def to_jax(self, *arrays: np.ndarray) -> tuple[Array, ...]:
        """Convert arrays to JAX, numbers in the precision of the model."""
        return tuple(jnp.asarray(array, self.low.dtype if array.dtype.kind == "f" else None) for array in arrays)

    @property
    def prior_moments(self) -> np.ndarray:
        """Rows (2, 6): prior mean and standard deviation of the parameters of a load; infinite for a position."""
        mean, std, length = np.asarray(self.prior_mean), np.asarray(self.prior_std), float(self.length_std)
        return np.array([[0, 0, *mean, 0, 0], [np.inf, np.inf, *std, length, length]])

    def bounds(self, start: np.ndarray, forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the parameters: on the sheet, and within four standard deviations of the prior mean.

        Parameters that a row does not have stay at their start.
        """
        mean, deviation = self.prior_moments
        deviation = np.where(np.isfinite(deviation), deviation, 0)
        low, high = mean - 4 * deviation, mean + 4 * deviation
        low[:2], high[:2] = self.low, self.high
        free = free_parameters(forms)
        return np.where(free, low, start), np.where(free, high, start)

    def log_prior(self, kind: LoadKind, loads: np.ndarray) -> float:
        """Logarithm of the prior density of parameters, without the squares of the prior residual."""
        further, deviation = len(FORMS[kind]) - 1, self.prior_moments[1]
        area = float(np.prod(np.asarray(self.high - self.low)))
        found = -np.log(area) - np.sum(np.log(deviation[2:4])) - np.log(2 * np.pi)
        if kind is LoadKind.EDGE:  # either end of an edge may be the first
            return float(found + np.log(2.0) - 2 * np.log(deviation[4]) - np.log(2 * np.pi))
        half = 0.5 * (loads[1 : further + 1, :2] - loads[0, :2]) / deviation[4]
        pair_density = np.exp(-0.5 * np.sum(half**2, 1)) / (2 * np.pi * (2 * deviation[4]) ** 2)
        found += np.sum(np.log(0.5 * pair_density + 0.5 / area))
        found -= further * (np.sum(np.log(np.asarray(self.difference_std))) + np.log(2 * np.pi))
        return float(found + np.sum(np.log(np.arange(1, further + 2))))  # loads in any order
