"""Predicted forces of all pads, and the variance of their total.

Errors of different pads are independent where each comes from the pad's own curve, its own sensor or its own noise, so
that their squares add up. A field that all pads share errs alike at places that are alike, such as the two sides of a
wall: a press across it sums up the errors themselves. Independent errors would state 20 % too little there.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .curves.fitted import Prediction
from .fields.fitted import LogGain


class PadPrediction(NamedTuple):
    """Forces of all pads.

    | meaning                                                   | shape     | unit |
    |-----------------------------------------------------------|-----------|------|
    | force on each pad                                         | (n, pads) | N    |
    | standard_error of each force                              | (n, pads) | N    |
    | valid: pressure in the calibrated range                   | (n, pads) |      |
    | total_variance: of the sum of the forces, by these errors | (n,)      | N^2  |
    """

    force: Array
    standard_error: Array
    valid: Array
    total_variance: Array

    def with_noise(self, variance: Float[Array, "n pads"]) -> "PadPrediction":
        """The forces with independent noise of each pad of this variance (N^2) beside their errors."""
        return self._replace(
            standard_error=jnp.sqrt(self.standard_error**2 + variance),
            total_variance=self.total_variance + variance.sum(1),
        )


def independent(curves: Prediction) -> PadPrediction:
    """The forces (n, pads) of curves, each of which was fitted to its own pad."""
    return PadPrediction(*curves, jnp.sum(curves.standard_error**2, 1))


def with_gain(curves: Prediction, gain: LogGain, shared: bool) -> PadPrediction:
    """The forces (n, pads) of curves times the gain of a field.

    Args:
        shared: whether all pads have one field, whose errors then add up. This is exact for pads at places that are
            alike, and states too much otherwise.
    """
    factor = jnp.exp(gain.mean)
    force, of_curve = curves.force * factor, (curves.standard_error * factor) ** 2
    of_gain = force**2 * gain.variance
    common = jnp.sum(jnp.sqrt(of_gain), 1) ** 2 if shared else jnp.sum(of_gain, 1)
    return PadPrediction(force, jnp.sqrt(of_curve + of_gain), curves.valid, jnp.sum(of_curve, 1) + common)
