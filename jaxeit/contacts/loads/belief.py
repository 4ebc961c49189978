"""What is believed of loads and of the sheet before a frame."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .pressure import FORMS, free_parameters
from .result import LoadKind
from .sheet import PressedSheet


class LoadBelief(eqx.Module):
    """What fits of loads believe before a frame.

    | meaning                                                             | shape            | unit |
    |---------------------------------------------------------------------|------------------|------|
    | sheet: from loads to whitened readings                              |                  |      |
    | low, high: corners of the sheet                                     | (2,)             | m    |
    | usual, spread: mean and standard deviation of log width, log force  | (2,)             |      |
    | difference: standard deviation of their differences between loads   | (2,)             |      |
    | least: distance of two loads, length of an edge, that is not one load | (2,)           | m    |
    | length, prior, model_error, shapes: see `LoadSettings`              | (), (5,), (), (factors,) | |
    | force_logs, force_covariance, force_variance: see `ForceLaw`        | (3,), (3, 3), () |      |
    """

    sheet: PressedSheet
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    usual: Float[Array, "2"]
    spread: Float[Array, "2"]
    difference: Float[Array, "2"]
    least: Float[Array, "2"]
    length: Float[Array, ""]
    prior: Float[Array, "5"]
    model_error: Float[Array, ""]
    shapes: Float[Array, " factors"]
    force_logs: Float[Array, "3"]
    force_covariance: Float[Array, "3 3"]
    force_variance: Float[Array, ""]

    def put(self, *arrays: np.ndarray) -> tuple[Array, ...]:
        """Arrays as JAX holds them; numbers in the precision of the model."""
        return tuple(jnp.asarray(array, self.low.dtype if array.dtype.kind == "f" else None) for array in arrays)

    @property
    def scale(self) -> np.ndarray:
        """Rows (2, 6) of mean and standard deviation of what is known of a load before a frame; infinite: nothing."""
        usual, spread, length = np.asarray(self.usual), np.asarray(self.spread), float(self.length)
        return np.array([[0, 0, *usual, 0, 0], [np.inf, np.inf, *spread, length, length]])

    def bounds(self, start: np.ndarray, forms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest parameters: on the sheet, and within four deviations of what is usual.

        What a row does not have stays where it starts.
        """
        mean, deviation = self.scale
        deviation = np.where(np.isfinite(deviation), deviation, 0)
        low, high = mean - 4 * deviation, mean + 4 * deviation
        low[:2], high[:2] = self.low, self.high
        free = free_parameters(forms)
        return np.where(free, low, start), np.where(free, high, start)

    def log_prior(self, kind: LoadKind, loads: np.ndarray) -> float:
        """Logarithm of the density of parameters before the frame, less that of the squares of surprise."""
        more, deviation = len(FORMS[kind]) - 1, self.scale[1]
        area = float(np.prod(np.asarray(self.high - self.low)))
        found = -np.log(area) - np.sum(np.log(deviation[2:4])) - np.log(2 * np.pi)
        if kind is LoadKind.EDGE:  # either end of an edge may be the first
            return float(found + np.log(2.0) - 2 * np.log(deviation[4]) - np.log(2 * np.pi))
        half = 0.5 * (loads[1 : more + 1, :2] - loads[0, :2]) / deviation[4]
        near = np.exp(-0.5 * np.sum(half**2, 1)) / (2 * np.pi * (2 * deviation[4]) ** 2)
        found += np.sum(np.log(0.5 * near + 0.5 / area))
        found -= more * (np.sum(np.log(np.asarray(self.difference))) + np.log(2 * np.pi))
        return float(found + np.sum(np.log(np.arange(1, more + 2))))  # loads in any order
