"""Curves of one elementary function: a line through zero, a line with an offset, a power law."""

from typing import ClassVar

import jax.numpy as jnp
from jax.typing import DTypeLike

from jaxeit.registry import limited

from .base import (
    AbstractCurve,
    Mask,
    Params,
    PositiveSlopes,
    Scalar,
    Scale,
    Series,
    Values,
    optional_array,
    resistant_line,
    start_slope,
)
from .order_statistics import median

# A load no larger than this counts as zero (pressure as a multiple of P0, force in N). The derivative z**(b - 1) of a
# power is infinite at zero for b < 1; at 1e-30 it is still finite in float32.
ZERO_LOAD = 1e-30


class Linear(PositiveSlopes):
    """F = a P: a pad that carries all the load at a constant effective area (the seed paper's assumption).

    | parameter | meaning           | shape | unit | bound |
    |-----------|-------------------|-------|------|-------|
    | slope a   | force per pascal  | ()    | N/Pa | a > 0 |
    """

    name: ClassVar[str] = "linear"

    names: ClassVar[tuple[str, ...]] = ("slope",)
    units: ClassVar[tuple[str, ...]] = ("N/Pa",)

    def __call__(self, params: Params, pressure: Values) -> Values:
        return params[0] * pressure

    def inverse(self, params: Params, force: Values) -> Values:
        return force / params[0]


class Affine(AbstractCurve):
    """F = a P + b: a preloaded pad, or a log whose zero is elsewhere.

    The force at zero pressure is b, not zero: a sum over pads counts the offset of every idle pad.

    | parameter | meaning                 | shape | unit | bound |
    |-----------|-------------------------|-------|------|-------|
    | slope a   | force per pascal        | ()    | N/Pa | a > 0 |
    | offset b  | force at zero pressure  | ()    | N    | none  |

    Free coordinates are the logarithm of the slope and the force at the median pressure. These two are uncorrelated
    also for samples far from zero pressure (a plenum held at one bar), where slope and offset are not.
    """

    name: ClassVar[str] = "affine"

    names: ClassVar[tuple[str, ...]] = ("slope", "offset")
    units: ClassVar[tuple[str, ...]] = ("N/Pa", "N")

    def __call__(self, params: Params, pressure: Values) -> Values:
        return params[0] * pressure + params[1]

    def inverse(self, params: Params, force: Values) -> Values:
        return (force - params[1]) / params[0]

    def free(self, params: Params, scale: Scale) -> Params:
        middle = params[0] * scale.centre + params[1]
        rise = params[0] * scale.spread
        return jnp.stack([jnp.log(rise / scale.force), middle / scale.force])

    def bound(self, free: Params, scale: Scale) -> Params:
        slope = jnp.exp(free[0]) * scale.force / scale.spread
        return jnp.stack([slope, free[1] * scale.force - slope * scale.centre])

    def initial(self, pressure: Series, force: Series, valid: Mask, scale: Scale) -> Params:
        slope, _ = resistant_line(pressure, force, valid)
        unit = scale.force / scale.spread
        slope = jnp.maximum(jnp.nan_to_num(slope, nan=unit), 1e-3 * unit)
        level = median(force - slope * pressure, valid)
        return jnp.stack([slope, jnp.nan_to_num(level)])


class PowerLaw(AbstractCurve):
    """F = a P0 (P / P0)**b for P > 0, and 0 otherwise: a pad whose contact area changes with load.

    | parameter  | meaning                                   | shape | unit | bound |
    |------------|-------------------------------------------|-------|------|-------|
    | secant a   | force per pascal at P0                    | ()    | N/Pa | a > 0 |
    | exponent b | curvature: below 1 softening, above 1 stiffening | () | 1   | b > 0 |

    `reference` P0 (Pa) is a setting, not a parameter. By default the fit takes the upper quartile of the absolute
    pressure, where secant and exponent are least correlated. Value and gradient are finite at and below zero.
    """

    name: ClassVar[str] = "power"

    reference: Scalar | None = limited(None, above=0, converter=optional_array)

    names: ClassVar[tuple[str, ...]] = ("secant", "exponent")
    units: ClassVar[tuple[str, ...]] = ("N/Pa", "1")

    def at(self, scale: Scale) -> "PowerLaw":
        reference = scale.pressure if self.reference is None else self.reference
        return PowerLaw(jnp.asarray(reference, scale.pressure.dtype))

    def _p0(self, dtype: DTypeLike) -> Scalar:
        if self.reference is None:
            raise ValueError(
                "PowerLaw has no reference pressure yet; give one (PowerLaw(1000.0), in Pa) or fit it first."
            )
        return self.reference.astype(dtype)

    def __call__(self, params: Params, pressure: Values) -> Values:
        return jnp.where(jnp.isnan(pressure), pressure, self.given(params, self.seen(pressure)))

    def seen(self, pressure: Values) -> Values:
        """Logarithm of P / P0, which takes most of the curve's time, and whether the pad is loaded, (..., 2)."""
        p0 = self._p0(pressure.dtype)
        loaded = pressure > ZERO_LOAD * p0
        return jnp.stack([jnp.log(jnp.where(loaded, pressure, p0) / p0), loaded.astype(pressure.dtype)], -1)

    def given(self, params: Params, seen: Values) -> Values:
        force = params[0] * self._p0(params.dtype) * jnp.exp(params[1] * seen[..., 0])
        return jnp.where(seen[..., 1] > 0, force, 0.0)

    def inverse(self, params: Params, force: Values) -> Values:
        p0 = self._p0(params.dtype)
        loaded = force > ZERO_LOAD
        z = jnp.where(loaded, force, 1.0) / (params[0] * p0)
        pressure = jnp.where(loaded, p0 * z ** (1 / params[1]), 0.0)
        return jnp.where(jnp.isnan(force), force, pressure)

    def free(self, params: Params, scale: Scale) -> Params:
        size = params[0] * self._p0(params.dtype) / scale.force
        return jnp.log(jnp.stack([size, params[1]]))

    def bound(self, free: Params, scale: Scale) -> Params:
        size, exponent = jnp.exp(free)
        return jnp.stack([size * scale.force / self._p0(free.dtype), exponent])

    def initial(self, pressure: Series, force: Series, valid: Mask, scale: Scale) -> Params:
        p0 = self._p0(pressure.dtype)
        loaded = valid & (pressure > 0.1 * scale.pressure) & (force > 0.02 * scale.force)
        x = jnp.log(jnp.where(loaded, pressure, p0) / p0)
        y = jnp.log(jnp.where(loaded, force, scale.force) / scale.force)
        slope, intercept = resistant_line(x, y, loaded)
        exponent = jnp.clip(jnp.nan_to_num(slope, nan=1.0), 0.2, 5.0)
        straight = start_slope(pressure, force, valid, scale)
        secant = jnp.where(jnp.isfinite(slope) & (slope > 0), jnp.exp(intercept) * scale.force / p0, straight)
        return jnp.stack([secant, exponent])
