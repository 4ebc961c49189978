"""Gains of pads that have drifted since the calibration, applied to their pressures.

A pad reads exp(log_gain) times the pressure that it read when it was calibrated. Dividing by this gain gives what the
calibration would have read, so that curve, field, memory and calibrated range apply as they are. The uncertainty of the
gains adds (dF/dg) C (dF/dg)' to the variance of a force, with the slopes by forward derivatives of the whole response.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .pad_predictions import PadPrediction


class PadGains(eqx.Module):
    """Pressure of each pad over what it was at the calibration.

    | field      | meaning                       | shape        | unit |
    |------------|-------------------------------|--------------|------|
    | log_gain   | natural logarithm of the gain | (pads,)      | 1    |
    | covariance | of the logarithms             | (pads, pads) | 1    |
    """

    log_gain: Float[Array, " pads"] = eqx.field(converter=jnp.asarray)
    covariance: Float[Array, "pads pads"] = eqx.field(converter=jnp.asarray)

    def to_calibrated(self, pressures: Float[Array, "n pads"]) -> Float[Array, "n pads"]:
        """Pressures that the pads would have read at the calibration."""
        return pressures * jnp.exp(-self.log_gain).astype(pressures.dtype)

    def forces(self, response: Callable[[Array], PadPrediction], pressures: Float[Array, "n pads"]) -> PadPrediction:
        """Prediction of `response`, a function of calibrated pressures (n, pads) Pa, from pressures as read now."""
        calibrated = self.to_calibrated(pressures)
        found, slopes = response(calibrated), gain_slopes(lambda p: response(p).force, calibrated)
        variance, total = self._variance(slopes), self._variance(jnp.sum(slopes, -1, keepdims=True))[:, 0]
        return found._replace(
            standard_error=jnp.sqrt(found.standard_error**2 + variance),
            total_variance=found.total_variance + total,
        )

    def _variance(self, slopes: Float[Array, "pads n k"]) -> Float[Array, "n k"]:
        """Variance (N^2) of forces with these slopes by the gains, whose errors may be correlated."""
        found = jnp.einsum("qnr,qs,snr->nr", slopes, self.covariance.astype(slopes.dtype), slopes)
        return jnp.maximum(found, 0)


def gain_slopes(
    force: Callable[[Array], Array], pressures: Float[Array, "n pads"]
) -> Float[Array, "pads n pads_of_force"]:
    """Derivative of each pad's force (N) with respect to minus the log gain of every pad q, the first axis."""
    own = jnp.eye(pressures.shape[1], dtype=bool)[:, None]
    tangents = jnp.where(own, pressures, 0)  # `where`, because a product with a missing pressure would be NaN

    def slope(tangent: Array) -> Array:
        derivative: Array = jax.jvp(force, (pressures,), (tangent,))[1]
        return derivative

    slopes: Array = jax.vmap(slope)(tangents)
    return slopes
