"""What the fit of a curve minimises: the residuals of the samples, and the roughness penalty of a spline."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...presses.streams import MAD_TO_SIGMA
from ..losses import AbstractLoss
from .base import AbstractCurve, Scale
from .order_statistics import median
from .samples import Samples

# Parts into which samples without groups are cut in order of time; residuals of different parts count as independent.
# Longer parts would be closer to independent, more parts would give a more certain variance of their sums.
TIME_BLOCKS = 20
# Lower bound of a slope or exponent, as a multiple of its start, about exp(-12). It stands for zero, whose logarithm is
# not finite.
MIN_MULTIPLE = 6e-6

Parameters = Float[Array, " k"]
Spread = Float[Array, ""] | float


def residuals(
    free: Parameters, curve: AbstractCurve, samples: Samples, scale: Scale, spread: Spread
) -> Float[Array, " n"]:
    """Standardised residuals; zero where a sample is not valid. `samples.pressure` comes from `AbstractCurve.seen`."""
    force = curve.given(curve.bound(free, scale), samples.pressure)
    r = (samples.force - force) / (samples.sigma * spread)
    return jnp.where(samples.valid, r, 0.0)


def residual_scale(free: Parameters, curve: AbstractCurve, samples: Samples, scale: Scale) -> Float[Array, ""]:
    """Robust standard deviation of the residuals; not below rounding, so that samples without noise can be fitted."""
    mad = MAD_TO_SIGMA * median(jnp.abs(residuals(free, curve, samples, scale, 1.0)), samples.valid)
    floor = 10 * jnp.sqrt(jnp.finfo(mad.dtype).eps) * scale.force
    return jnp.where(mad > floor, mad, floor)


def design_effect(influence: Float[Array, " n"], samples: Samples, n_groups: int) -> Float[Array, ""]:
    """Variance of the residuals' sums over groups, divided by that of independent residuals; at least one.

    n samples carry the information of n / effect independent ones (Kish 1965, Survey Sampling, 8.2). Without groups
    the sums are over `TIME_BLOCKS` parts of the samples in their order.
    """
    count = jnp.cumsum(samples.valid)
    block = (count - 1) * TIME_BLOCKS // count[-1]
    sums = jax.ops.segment_sum(influence, samples.group if n_groups else block, n_groups or TIME_BLOCKS)
    total = jnp.sum(influence**2)
    return jnp.maximum(jnp.sum(sums**2) / jnp.where(total > 0, total, 1), 1)


class CurveProblem(eqx.Module):
    """A curve and its samples. Unknowns are parameters as multiples of their start (an offset: in units of the force).

    | field    | meaning                                                                  | shape |
    |----------|--------------------------------------------------------------------------|-------|
    | curve    | the curve with all its settings                                          |       |
    | samples  | the samples, with the result of `AbstractCurve.seen` as pressure         |       |
    | scale    | sizes of the samples                                                     |       |
    | loss     | robust loss of the residuals                                             |       |
    | start    | free parameters of the start                                             | (k,)  |
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
        return jnp.where(self.curve.positive, MIN_MULTIPLE, -jnp.inf).astype(self.start.dtype)

    @property
    def bends(self) -> Float[Array, "m k"]:
        """Roughness penalty, see `AbstractCurve.bends`."""
        return jnp.asarray(self.curve.bends, self.start.dtype)

    def at_bound(self, multiple: Parameters) -> Bool[Array, " k"]:
        """Flags of the slopes and exponents that ended on their lower bound."""
        return jnp.asarray(self.curve.positive) & (multiple < 2 * MIN_MULTIPLE)

    def free(self, multiple: Parameters) -> Parameters:
        """Free parameters, from multiples of the start."""
        positive = jnp.maximum(multiple, MIN_MULTIPLE)
        return jnp.where(self.curve.positive, self.start + jnp.log(positive), multiple)

    def weights(self, multiple: Parameters, penalty: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Scale of the residuals at `multiple`; weight of the penalty: `penalty` by the root of the design effect."""
        spread = residual_scale(self.free(multiple), self.curve, self.samples, self.scale)
        if not len(self.bends):
            return spread, penalty
        influence = self.loss.psi(residuals(self.free(multiple), self.curve, self.samples, self.scale, spread))
        return spread, penalty * jnp.sqrt(design_effect(influence, self.samples, self.n_groups))

    def objective(
        self, multiple: Parameters, spread: Float[Array, ""], weight: Float[Array, ""]
    ) -> Float[Array, " residuals"]:
        """Residuals whose squares are the loss, then those of the penalty, its slopes clipped at their bound too."""
        r = residuals(self.free(multiple), self.curve, self.samples, self.scale, spread)
        bends = weight * (self.bends @ jnp.maximum(multiple, MIN_MULTIPLE))
        return jnp.concatenate([self.loss.transform(r), bends])

    def curvature(self, transformed: Float[Array, " residuals"]) -> Float[Array, " residuals"]:
        """`AbstractLoss.curvature` of the samples' residuals; one for those of the penalty, which are squared."""
        n = len(self.samples.force)
        return jnp.concatenate([self.loss.curvature(transformed[:n]), jnp.ones_like(transformed[n:])])
