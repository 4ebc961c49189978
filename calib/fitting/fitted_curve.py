"""A fitted curve: its numbers, their covariance, and what it predicts."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Real

import jaxeit as je

from .curves import AbstractCurve
from .results import FitResult


class Prediction(NamedTuple):
    """Force (N), standard error of the curve (N; not of a new sample), and whether to believe it."""

    force: Array
    standard_error: Array
    valid: Array


class FittedCurve(eqx.Module):
    """A curve with its numbers and their honesty. From `fit_curves` every array has a leading pad axis.

    | field          | meaning                                                   | shape  | unit             |
    |----------------|-----------------------------------------------------------|--------|------------------|
    | curve          | the curve, its reference pressure set                     |        |                  |
    | parameters     | as named by `curve.names`                                 | (k,)   | `curve.units`    |
    | covariance     | of the parameters                                         | (k, k) | products thereof |
    | pressure_range | smallest and largest pressure fitted                      | (2,)   | Pa               |
    | scale          | robust standard deviation of the residuals                | ()     | N (1 with sigma) |
    | residual_rms   | root mean square residual, n - k degrees of freedom       | ()     | N                |
    | n, n_missing   | samples used, samples dropped as not finite               | ()     |                  |
    | n_groups       | presses used (0: samples taken as independent)            | ()     |                  |
    | rank           | parameters (directions) that the samples determine        | ()     |                  |
    | result         | a `FitResult`; anything but 0 means: do not use           | ()     |                  |
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
        """Of the parameters, in their units."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    def pad(self, index: int) -> "FittedCurve":
        """One pad of a batch."""
        found: FittedCurve = jax.tree.map(lambda leaf: leaf[index], self)
        return found

    def message(self) -> str:
        """What became of the fit, for a person (one pad)."""
        return FitResult(int(self.result)).message

    def predict(self, pressure: Real[ArrayLike, "..."], tolerance: float = 0.05) -> Prediction:
        """Force at `pressure` (any shape, Pa), by the delta method: se^2 = g' C g, g = dh/dparameters (one pad).

        `valid` is false for NaN, for a failed fit, and more than `tolerance` of the fitted range outside that range.
        """
        p = jnp.asarray(pressure, self.parameters.dtype)
        slope = jax.jacfwd(self.curve)(self.parameters, p.ravel())
        variance = jnp.einsum("ni,ij,nj->n", slope, self.covariance, slope).reshape(p.shape)
        low, high = self.pressure_range
        margin = tolerance * (high - low)
        inside = (p >= low - margin) & (p <= high + margin)
        ok = inside & (self.result == FitResult.SUCCESS)
        return Prediction(self.curve(self.parameters, p), jnp.sqrt(variance), ok)


@je.verb
def predict_pads(fitted: FittedCurve, pressures: Float[Array, "pads n"], tolerance: float = 0.05) -> Prediction:
    """`FittedCurve.predict` for every pad of a batch: pressures (pads, n) -> arrays (pads, n)."""
    found: Prediction = eqx.filter_vmap(lambda f, p: f.predict(p, tolerance))(fitted, pressures)
    return found
