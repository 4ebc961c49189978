"""What a curve's fit minimises: residuals of the samples, and of the bends that are expected of a spline."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .curves import AbstractCurve, Scale
from .losses import AbstractLoss
from .order_statistics import MAD_TO_SIGMA, median
from .samples import Samples

# Parts of the samples in order of time; residuals of different parts are taken as independent.
TIME_BLOCKS = 20
# Smallest slope or exponent, as a multiple of its start: it stands for zero, whose logarithm no solver arrives at.
SMALLEST_MULTIPLE = 6e-6

Parameters = Float[Array, " k"]
Spread = Float[Array, ""] | float


def residuals(
    free: Parameters, curve: AbstractCurve, samples: Samples, scale: Scale, spread: Spread
) -> Float[Array, " n"]:
    """Standardised residuals; zero at samples that are not valid. Pressures are as `AbstractCurve.seen` has them."""
    force = curve.given(curve.bound(free, scale), samples.pressure)
    r = (samples.force - force) / (samples.sigma * spread)
    return jnp.where(samples.valid, r, 0.0)


def residual_scale(free: Parameters, curve: AbstractCurve, samples: Samples, scale: Scale) -> Float[Array, ""]:
    """Robust standard deviation of the residuals; never below rounding, so that perfect samples can be fitted too."""
    mad = MAD_TO_SIGMA * median(jnp.abs(residuals(free, curve, samples, scale, 1.0)), samples.valid)
    floor = 10 * jnp.sqrt(jnp.finfo(mad.dtype).eps) * scale.force
    return jnp.where(mad > floor, mad, floor)


def design_effect(influence: Float[Array, " n"], samples: Samples, n_groups: int) -> Float[Array, ""]:
    """Variance of sums of residuals over groups, over that of sums of independent ones; one at least.

    So many times fewer independent samples would tell as much (Kish 1965, Survey Sampling, 8.2). Without groups the
    sums are over `TIME_BLOCKS` parts of the samples in their order.
    """
    count = jnp.cumsum(samples.valid)
    block = (count - 1) * TIME_BLOCKS // count[-1]
    sums = jax.ops.segment_sum(influence, samples.group if n_groups else block, n_groups or TIME_BLOCKS)
    total = jnp.sum(influence**2)
    return jnp.maximum(jnp.sum(sums**2) / jnp.where(total > 0, total, 1), 1)


class CurveProblem(eqx.Module):
    """A curve and its samples, for parameters as multiples of their start (an offset: in units of the force's size).

    | field    | meaning                                                                  | shape |
    |----------|--------------------------------------------------------------------------|-------|
    | curve    | with its reference pressure                                              |       |
    | samples  | with the pressures as `AbstractCurve.seen` has them                      |       |
    | scale    | sizes of the samples                                                     |       |
    | loss     |                                                                          |       |
    | start    | free parameters                                                          | (k,)  |
    | n_groups | number of groups; 0: samples are independent                             |       |
    """

    curve: AbstractCurve
    samples: Samples
    scale: Scale
    loss: AbstractLoss
    start: Parameters
    n_groups: int = eqx.field(static=True)

    @property
    def first(self) -> Parameters:
        """The start as multiples of itself."""
        return jnp.where(self.curve.positive, 1.0, self.start)

    @property
    def lower(self) -> Parameters:
        """Lower bounds of the multiples."""
        return jnp.where(self.curve.positive, SMALLEST_MULTIPLE, -jnp.inf).astype(self.start.dtype)

    @property
    def bends(self) -> Float[Array, "m k"]:
        """See `AbstractCurve.bends`."""
        return jnp.asarray(self.curve.bends, self.start.dtype)

    def vanished(self, multiple: Parameters) -> Bool[Array, " k"]:
        """Which slopes and exponents are next to nothing."""
        return jnp.asarray(self.curve.positive) & (multiple < 2 * SMALLEST_MULTIPLE)

    def free(self, multiple: Parameters) -> Parameters:
        """Free parameters, from multiples of the start."""
        above = jnp.maximum(multiple, SMALLEST_MULTIPLE)
        return jnp.where(self.curve.positive, self.start + jnp.log(above), multiple)

    def weights(self, multiple: Parameters, bent: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Scale of the residuals there, and the weight of the bends, ``bent`` times the root of the design effect."""
        spread = residual_scale(self.free(multiple), self.curve, self.samples, self.scale)
        if not len(self.bends):
            return spread, bent
        influence = self.loss.psi(residuals(self.free(multiple), self.curve, self.samples, self.scale, spread))
        return spread, bent * jnp.sqrt(design_effect(influence, self.samples, self.n_groups))

    def objective(
        self, multiple: Parameters, spread: Float[Array, ""], weight: Float[Array, ""]
    ) -> Float[Array, " residuals"]:
        """Residuals whose squares are the loss, and the bends, clipped like the slopes: as steep at a bound."""
        left = residuals(self.free(multiple), self.curve, self.samples, self.scale, spread)
        bends = weight * (self.bends @ jnp.maximum(multiple, SMALLEST_MULTIPLE))
        return jnp.concatenate([self.loss.transform(left), bends])

    def curvature(self, transformed: Float[Array, " residuals"]) -> Float[Array, " residuals"]:
        """See `AbstractLoss.curvature`; the bends have no loss."""
        n = len(self.samples.force)
        return jnp.concatenate([self.loss.curvature(transformed[:n]), jnp.ones_like(transformed[n:])])
