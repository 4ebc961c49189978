"""Curves h: pad pressure (Pa, baseline removed) -> normal force on the pad (N).

A curve is a choice, not a result: it holds no fitted numbers. Every curve is increasing by construction, because
its slope and exponent are fitted as logarithms, and is handed to the solver in *free* coordinates of order one
(see `Scale`), so that float32 works and one step size suits all parameters.

A new curve is one class here and one row in `CURVES`.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Scalar = Float[Array, ""]
Params = Float[Array, " parameters"]
Samples = Float[Array, " samples"]
Mask = Bool[Array, " samples"]


class Scale(eqx.Module):
    """Sizes of one pad's samples, for scaling only: no result depends on them beyond rounding.

    | field    | meaning                                          | shape | unit |
    |----------|--------------------------------------------------|-------|------|
    | pressure | upper quartile of the absolute pressure          | ()    | Pa   |
    | centre   | median pressure                                  | ()    | Pa   |
    | spread   | half the distance between 5 % and 95 % quantiles | ()    | Pa   |
    | force    | upper quartile of the absolute force             | ()    | N    |
    """

    pressure: Scalar
    centre: Scalar
    spread: Scalar
    force: Scalar


def _positive(value: Scalar, otherwise) -> Scalar:
    return jnp.where(value > 0, value, otherwise)


def scale_of(pressure: Samples, force: Samples, valid: Mask) -> Scale:
    """`Scale` of the valid samples; quantiles, so that a spike does not set the scale."""
    p = jnp.where(valid, pressure, jnp.nan)
    f = jnp.where(valid, force, jnp.nan)
    size = _positive(jnp.nanquantile(jnp.abs(p), 0.75), 1.0)
    low, centre, high = jnp.nanquantile(p, jnp.array([0.05, 0.5, 0.95], p.dtype))
    return Scale(
        pressure=size,
        centre=jnp.nan_to_num(centre),
        spread=_positive((high - low) / 2, size),
        force=_positive(jnp.nanquantile(jnp.abs(f), 0.75), 1.0),
    )


def resistant_line(x: Samples, y: Samples, valid: Mask) -> tuple[Scalar, Scalar]:
    """Slope and intercept through the medians of the outer thirds of x (Tukey's resistant line).

    A start for the fit that neither outliers nor spikes can carry away. NaN where x has fewer than two values.
    """
    xm = jnp.where(valid, x, jnp.nan)
    low, high = jnp.nanquantile(xm, jnp.array([1 / 3, 2 / 3], x.dtype))
    left = [jnp.nanmedian(jnp.where(xm <= low, v, jnp.nan)) for v in (x, y)]
    right = [jnp.nanmedian(jnp.where(xm >= high, v, jnp.nan)) for v in (x, y)]
    run = right[0] - left[0]
    slope = jnp.where(run > 0, (right[1] - left[1]) / jnp.where(run > 0, run, 1.0), jnp.nan)
    return slope, (left[1] + right[1] - slope * (left[0] + right[0])) / 2


class AbstractCurve(eqx.Module):
    """h(parameters, pressure) -> force, its inverse, and the map between its parameters and free ones.

    Subclasses state `names` and `units` of their parameters, in order.
    """

    names: ClassVar[tuple[str, ...]]
    units: ClassVar[tuple[str, ...]]

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.names)

    def at(self, scale: Scale) -> "AbstractCurve":
        """The curve with whatever it left open (a reference pressure) taken from the samples."""
        del scale
        return self

    @abc.abstractmethod
    def __call__(self, params: Params, pressure: Float[Array, "..."]) -> Float[Array, "..."]:
        """Force in N at `pressure` in Pa; NaN pressure gives NaN force."""

    @abc.abstractmethod
    def inverse(self, params: Params, force: Float[Array, "..."]) -> Float[Array, "..."]:
        """Pressure in Pa at which the curve gives `force` in N."""

    @abc.abstractmethod
    def free(self, params: Params, scale: Scale) -> Params:
        """Parameters in free coordinates: dimensionless, unbounded, of order one."""

    @abc.abstractmethod
    def bound(self, free: Params, scale: Scale) -> Params:
        """Inverse of `free`: parameters with units, inside their bounds whatever `free` is."""

    @abc.abstractmethod
    def initial(self, pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Params:
        """A robust start for the fit, always finite and inside the bounds."""


def _start_slope(pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Scalar:
    """Median of force / pressure over loaded samples, kept positive."""
    loaded = valid & (pressure > 0.2 * scale.pressure)
    ratio = jnp.where(loaded, force / jnp.where(loaded, pressure, 1.0), jnp.nan)
    unit = scale.force / scale.pressure
    return jnp.maximum(jnp.nan_to_num(jnp.nanmedian(ratio), nan=unit), 1e-3 * unit)


class Linear(AbstractCurve):
    """F = a P: a pad that carries all the load at a constant effective area (the seed paper's assumption).

    | parameter | meaning           | shape | unit | bound |
    |-----------|-------------------|-------|------|-------|
    | slope a   | force per pascal  | ()    | N/Pa | a > 0 |
    """

    names: ClassVar[tuple[str, ...]] = ("slope",)
    units: ClassVar[tuple[str, ...]] = ("N/Pa",)

    def __call__(self, params, pressure):
        return params[0] * pressure

    def inverse(self, params, force):
        return force / params[0]

    def free(self, params, scale):
        return jnp.log(params * (scale.pressure / scale.force))

    def bound(self, free, scale):
        return jnp.exp(free) * (scale.force / scale.pressure)

    def initial(self, pressure, force, valid, scale):
        return _start_slope(pressure, force, valid, scale)[None]


class Affine(AbstractCurve):
    """F = a P + b: a preloaded pad, or a log whose zero is elsewhere. Not zero at zero: do not sum it over idle pads.

    | parameter | meaning                 | shape | unit | bound |
    |-----------|-------------------------|-------|------|-------|
    | slope a   | force per pascal        | ()    | N/Pa | a > 0 |
    | offset b  | force at zero pressure  | ()    | N    | none  |

    Free coordinates are the slope's logarithm and the force at the median pressure: the offset of samples far from
    zero (a plenum held at one bar) is then not entangled with their slope.
    """

    names: ClassVar[tuple[str, ...]] = ("slope", "offset")
    units: ClassVar[tuple[str, ...]] = ("N/Pa", "N")

    def __call__(self, params, pressure):
        return params[0] * pressure + params[1]

    def inverse(self, params, force):
        return (force - params[1]) / params[0]

    def free(self, params, scale):
        middle = params[0] * scale.centre + params[1]
        rise = params[0] * scale.spread
        return jnp.stack([jnp.log(rise / scale.force), middle / scale.force])

    def bound(self, free, scale):
        slope = jnp.exp(free[0]) * scale.force / scale.spread
        return jnp.stack([slope, free[1] * scale.force - slope * scale.centre])

    def initial(self, pressure, force, valid, scale):
        slope, _ = resistant_line(pressure, force, valid)
        unit = scale.force / scale.spread
        slope = jnp.maximum(jnp.nan_to_num(slope, nan=unit), 1e-3 * unit)
        level = jnp.nanmedian(jnp.where(valid, force - slope * pressure, jnp.nan))
        return jnp.stack([slope, jnp.nan_to_num(level)])


def _reference(value) -> Scalar | None:
    return None if value is None else jnp.asarray(value)


# Below this fraction of the reference the force is called zero: it keeps z**(b - 1) finite in float32.
_NOTHING = 1e-30


class PowerLaw(AbstractCurve):
    """F = a P0 (P / P0)**b for P > 0, and 0 otherwise: a pad whose contact area changes with load.

    | parameter  | meaning                                   | shape | unit | bound |
    |------------|-------------------------------------------|-------|------|-------|
    | secant a   | force per pascal at P0                    | ()    | N/Pa | a > 0 |
    | exponent b | curvature: below 1 softening, above 1 stiffening | () | 1   | b > 0 |

    `reference` P0 (Pa) is a choice, not a parameter; left out, the fit takes the upper quartile of the absolute
    pressure, where secant and exponent are least correlated. Value and gradient are finite at and below zero.
    """

    reference: Scalar | None = eqx.field(converter=_reference, default=None)

    names: ClassVar[tuple[str, ...]] = ("secant", "exponent")
    units: ClassVar[tuple[str, ...]] = ("N/Pa", "1")

    def at(self, scale):
        reference = scale.pressure if self.reference is None else self.reference
        return PowerLaw(jnp.asarray(reference, scale.pressure.dtype))

    def _p0(self, dtype) -> Scalar:
        if self.reference is None:
            raise ValueError(
                "PowerLaw has no reference pressure yet; give one (PowerLaw(1000.0), in Pa) or fit it first."
            )
        return self.reference.astype(dtype)

    def __call__(self, params, pressure):
        p0 = self._p0(params.dtype)
        loaded = pressure > _NOTHING * p0
        z = jnp.where(loaded, pressure, p0) / p0
        force = jnp.where(loaded, params[0] * p0 * z ** params[1], 0.0)
        return jnp.where(jnp.isnan(pressure), pressure, force)

    def inverse(self, params, force):
        p0 = self._p0(params.dtype)
        loaded = force > _NOTHING
        z = jnp.where(loaded, force, 1.0) / (params[0] * p0)
        pressure = jnp.where(loaded, p0 * z ** (1 / params[1]), 0.0)
        return jnp.where(jnp.isnan(force), force, pressure)

    def free(self, params, scale):
        size = params[0] * self._p0(params.dtype) / scale.force
        return jnp.log(jnp.stack([size, params[1]]))

    def bound(self, free, scale):
        size, exponent = jnp.exp(free)
        return jnp.stack([size * scale.force / self._p0(free.dtype), exponent])

    def initial(self, pressure, force, valid, scale):
        p0 = self._p0(pressure.dtype)
        loaded = valid & (pressure > 0.1 * scale.pressure) & (force > 0.02 * scale.force)
        x = jnp.log(jnp.where(loaded, pressure, p0) / p0)
        y = jnp.log(jnp.where(loaded, force, scale.force) / scale.force)
        slope, intercept = resistant_line(x, y, loaded)
        exponent = jnp.clip(jnp.nan_to_num(slope, nan=1.0), 0.2, 5.0)
        straight = _start_slope(pressure, force, valid, scale)
        secant = jnp.where(jnp.isfinite(slope) & (slope > 0), jnp.exp(intercept) * scale.force / p0, straight)
        return jnp.stack([secant, exponent])


CURVES: dict[str, type[AbstractCurve]] = {"linear": Linear, "affine": Affine, "power": PowerLaw}
"""Names used on the command line and in calibration files."""


def curve_name(curve: AbstractCurve) -> str:
    """The name of a curve's class in `CURVES`."""
    return next(name for name, kind in CURVES.items() if type(curve) is kind)
