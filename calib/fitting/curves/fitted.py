"""A fitted curve: its parameters, their covariance, and the forces that it predicts."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Real

import jaxeit as je

from ..results import FitResult
from .base import AbstractCurve
from .own_curves import is_own

# Part of the fitted range of pressures by which a pressure beyond it still counts as calibrated.
RANGE_TOLERANCE = 0.05


class Prediction(NamedTuple):
    """Force (N), standard error of the curve (N; without the noise of a new sample), and whether both are valid."""

    force: Array
    standard_error: Array
    valid: Array


class FittedCurve(eqx.Module):
    """A curve with its parameters and their uncertainty. From `fit_curves` every array has a leading pad axis.

    | field          | meaning                                                   | shape  | unit             |
    |----------------|-----------------------------------------------------------|--------|------------------|
    | curve          | the curve with all its settings                           |        |                  |
    | parameters     | values of the parameters `curve.names`                    | (k,)   | `curve.units`    |
    | covariance     | of the parameters                                         | (k, k) | products thereof |
    | pressure_range | smallest and largest pressure fitted                      | (2,)   | Pa               |
    | scale          | robust standard deviation of the residuals                | ()     | N (1 with sigma) |
    | residual_rms   | root mean square residual, n - k degrees of freedom       | ()     | N                |
    | n, n_missing   | samples used, samples dropped as not finite               | ()     |                  |
    | n_groups       | presses used (0: samples taken as independent)            | ()     |                  |
    | rank           | parameters (directions) that the samples determine        | ()     |                  |
    | result         | a `FitResult`; do not use a fit whose code is not 0       | ()     |                  |
    """

    curve: AbstractCurve
    parameters: Float[Array, "*pads k"]
    covariance: Float[Array, "*pads k k"]
    pressure_range: Float[Array, "*pads 2"]
    scale: Float[Array, "*pads"]
    residual_rms: Float[Array, "*pads"]
    n: Int[Array, "*pads"]
    n_missing: Int[Array, "*pads"]
    n_groups: Int[Array, "*pads"]
    rank: Int[Array, "*pads"]
    result: Int[Array, "*pads"]

    @property
    def standard_errors(self) -> Float[Array, "*pads k"]:
        """Standard errors of the parameters, (pads, k) or (k,) of one pad, in their units."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    def pad(self, index: int) -> "FittedCurve":
        """The fit of one pad of a batch."""
        found: FittedCurve = jax.tree.map(lambda leaf: leaf[index], self)
        return found

    def message(self) -> str:
        """The outcome of the fit in one sentence, and what to do about it (one pad)."""
        said = FitResult(int(self.result)).message
        if is_own(self.curve) and int(self.result) in (FitResult.NOT_FINITE, FitResult.NO_RESPONSE):
            return f"{said}; or {type(self.curve).__name__}.__call__ falls or is not finite"
        return said

    def predict(self, pressure: Real[ArrayLike, "..."], tolerance: float = RANGE_TOLERANCE) -> Prediction:
        """Force of one pad at `pressure` (any shape, Pa); by the delta method, se^2 = g' C g with g = dh/dparameters.

        `valid` is false for NaN, for a failed fit, and more than `tolerance` of the fitted range outside that range.
        """
        found: Prediction = _predict(self, jnp.asarray(pressure, self.parameters.dtype), tolerance)
        return found


@je.verb
def _predict(fitted: FittedCurve, p: Float[Array, "..."], tolerance: float) -> Prediction:
    slope = jax.jacfwd(fitted.curve)(fitted.parameters, p.ravel())
    variance = jnp.einsum("ni,ij,nj->n", slope, fitted.covariance, slope).reshape(p.shape)
    low, high = fitted.pressure_range
    margin = tolerance * (high - low)
    inside = (p >= low - margin) & (p <= high + margin)
    ok = inside & (fitted.result == FitResult.SUCCESS)
    return Prediction(fitted.curve(fitted.parameters, p), jnp.sqrt(variance), ok)


@je.verb
def predict_pads(
    fitted: FittedCurve, pressures: Float[Array, "pads n"], tolerance: float = RANGE_TOLERANCE
) -> Prediction:
    """`FittedCurve.predict` for every pad of a batch, from pressures (pads, n) Pa; arrays are (pads, n)."""
    found: Prediction = eqx.filter_vmap(lambda f, p: f.predict(p, tolerance))(fitted, pressures)
    return found
