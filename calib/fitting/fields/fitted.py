"""A fitted field: its coefficients, their uncertainty, and the gains that it predicts."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

import jaxeit as je

from ..results import FitResult
from .base import REFERENCE_WIDTH, AbstractField
from .geometry import Geometry, onto_pads
from .places import Places


class LogGain(NamedTuple):
    """Log of the gain of each pad and its variance, (n, pads); at an unknown place 0, and the presses' variance."""

    mean: Array
    variance: Array


class FittedField(eqx.Module):
    """A field with its coefficients and their uncertainty.

    | field        | meaning                                                            | shape        | unit |
    |--------------|--------------------------------------------------------------------|--------------|------|
    | field        | the field, with its settings                                       |              |      |
    | geometry     | outlines of the skin's pads and rim                                |              |      |
    | coefficients | of the centred features                                            | (m,)         | 1    |
    | covariance   | of the coefficients, posterior                                     | (m, m)       | 1    |
    | reach        | corners of the box in which presses determine each pad's field     | (pads, 2, 2) | m    |
    | centre       | mean features of each pad's presses: there log-gain is zero        | (pads, m)    | 1    |
    | noise        | scatter of single presses about the field, in log force            | ()           | 1    |
    | spread       | the same without a field                                           | ()           | 1    |
    | evidence     | log of the largest marginal likelihood, relative to no field       | ()           | 1    |
    | effective    | number of coefficients that the presses determine                  | ()           |      |
    | n            | presses used; all presses at one place count as one                | ()           |      |
    | result       | a `FitResult`; if not 0, there is no correction                    | ()           |      |
    | error_scale  | factor of standard errors, by held-out neighbourhoods of presses   | ()           | 1    |
    """

    field: AbstractField
    geometry: Geometry
    coefficients: Float[Array, " m"]
    covariance: Float[Array, "m m"]
    reach: Float[Array, "pads 2 2"]
    centre: Float[Array, "pads m"]
    noise: Float[Array, ""]
    spread: Float[Array, ""]
    evidence: Float[Array, ""]
    effective: Float[Array, ""]
    n: Float[Array, ""]
    result: Int[Array, ""]
    error_scale: Float[Array, ""]

    def log_gain(self, places: Places) -> LogGain:
        """The field at places; that of a pad is the mean over the contacts that load the pad.

        Outside the box of the presses (`reach`) the field keeps its value at the border. The variance there is that of
        the extrapolated field, plus the square of the difference between the two. `error_scale` widens the errors up to
        those at an unknown place.
        """
        anywhere = jnp.zeros_like(self.reach) + jnp.asarray([[-jnp.inf], [jnp.inf]], self.reach.dtype)
        inside, extrapolated = jax.vmap(partial(self.centred, places))(jnp.stack([self.reach, anywhere]))
        between = (extrapolated - inside) @ self.coefficients
        variance = jnp.einsum("npi,ij,npj->np", extrapolated, self.covariance, extrapolated) + between**2
        unknown = jnp.maximum(self.spread**2 - self.noise**2, 0)
        variance = jnp.maximum(variance, jnp.minimum(self.error_scale**2 * variance, unknown))
        return LogGain(inside @ self.coefficients, jnp.where(places.known, variance, unknown))

    def centred(self, places: Places, reach: Float[Array, "pads 2 2"]) -> Float[Array, "n pads m"]:
        """Features less those of the presses, with contacts inside the box `reach`; 0 where the place is not known."""
        features = pad_features(self.field, self.geometry, places, reach)
        return jnp.where(places.known[..., None] & jnp.isfinite(features), features - self.centre, 0)

    def message(self) -> str:
        """The outcome of the fit in one sentence, and what to do about it."""
        return FitResult(int(self.result)).message


@je.verb
def log_gain(fitted: FittedField, places: Places) -> LogGain:
    """`FittedField.log_gain`, compiled."""
    return fitted.log_gain(places)


@je.verb
def centred_features(fitted: FittedField, places: Places) -> Float[Array, "n pads m"]:
    """Features of the field at places inside its reach, less those of the presses, compiled."""
    return fitted.centred(places, fitted.reach)


def pad_features(
    field: AbstractField, geometry: Geometry, places: Places, reach: Float[Array, "*pads 2 2"] | None = None
) -> Float[Array, "n pads m"]:
    """Features of each pad, the weighted mean over its contacts: 0 for a pad without contact, NaN where not known.

    Contacts outside the box `reach` (lowest and highest corner, m) of a pad are moved to its border.
    """
    present = jnp.all(jnp.isfinite(places.position), -1)
    width = jnp.where(present, places.width, REFERENCE_WIDTH)
    place = onto_pads(geometry, jnp.where(present[..., None], places.position, 0))
    inside = place if reach is None else jnp.clip(place, reach[..., 0, :], reach[..., 1, :])
    features = field.features(geometry, inside, width)
    weight = jnp.where(present[..., None], places.weight, 0)
    total = jnp.sum(weight, 1, keepdims=True)
    return jnp.sum((weight / jnp.where(total > 0, total, 1))[..., None] * features, 1)
