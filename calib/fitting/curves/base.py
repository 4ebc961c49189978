"""The interface of a curve h: pad pressure (Pa, baseline removed) -> normal force on the pad (N).

A curve is a choice, not a result: it holds no fitted numbers. Every curve rises by construction, because its slopes
and exponents are fitted as logarithms. The solver works on *free* coordinates of order one (see `Scale`), so that
float32 suffices and one step size suits all parameters.
"""

import abc
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Real

from jaxeit.registry import AbstractChoice

from .order_statistics import median, quantiles

Scalar = Float[Array, ""]
Params = Float[Array, " parameters"]
Series = Float[Array, " samples"]
Mask = Bool[Array, " samples"]
Values = Float[Array, "..."]


class Scale(eqx.Module):
    """Sizes of one pad's samples. They only scale the fit: no result depends on them beyond rounding.

    | field    | meaning                                          | shape | unit |
    |----------|--------------------------------------------------|-------|------|
    | pressure | upper quartile of the absolute pressure          | ()    | Pa   |
    | centre   | median pressure                                  | ()    | Pa   |
    | spread   | half the distance between 5 % and 95 % quantiles | ()    | Pa   |
    | force    | upper quartile of the absolute force             | ()    | N    |
    | top      | 98 % quantile of the pressure                    | ()    | Pa   |
    """

    pressure: Scalar
    centre: Scalar
    spread: Scalar
    force: Scalar
    top: Scalar


def _positive(value: Scalar, otherwise: Scalar | float) -> Scalar:
    return jnp.where(value > 0, value, otherwise)


def scale_of(pressure: Series, force: Series, valid: Mask) -> Scale:
    """`Scale` of the valid samples; it consists of quantiles, so that a spike does not set the scale."""
    size = _positive(quantiles(jnp.abs(pressure), valid, (0.75,))[0], 1.0)
    low, centre, high, top = quantiles(pressure, valid, (0.05, 0.5, 0.95, 0.98))
    return Scale(
        pressure=size,
        centre=jnp.nan_to_num(centre),
        spread=_positive((high - low) / 2, size),
        force=_positive(quantiles(jnp.abs(force), valid, (0.75,))[0], 1.0),
        top=_positive(top, size),
    )


def resistant_line(x: Series, y: Series, valid: Mask) -> tuple[Scalar, Scalar]:
    """Slope and intercept through the medians of the outer thirds of x (Tukey's resistant line).

    As a start for the fit it resists outliers and spikes. NaN where x has fewer than two values.
    """
    low, high = quantiles(x, valid, (1 / 3, 2 / 3))
    left = [median(v, valid & (x <= low)) for v in (x, y)]
    right = [median(v, valid & (x >= high)) for v in (x, y)]
    run = right[0] - left[0]
    slope = jnp.where(run > 0, (right[1] - left[1]) / jnp.where(run > 0, run, 1.0), jnp.nan)
    return slope, (left[1] + right[1] - slope * (left[0] + right[0])) / 2


def start_slope(pressure: Series, force: Series, valid: Mask, scale: Scale) -> Scalar:
    """Median of force / pressure over the loaded samples, N/Pa; always positive."""
    loaded = valid & (pressure > 0.2 * scale.pressure)
    ratio = force / jnp.where(loaded, pressure, 1.0)
    unit = scale.force / scale.pressure
    return jnp.maximum(jnp.nan_to_num(median(ratio, loaded), nan=unit), 1e-3 * unit)


def optional_array(value: ArrayLike | Sequence[float] | None) -> Real[Array, "..."] | None:
    """Converter of a setting that may be left open."""
    return None if value is None else jnp.asarray(value)


class AbstractCurve(AbstractChoice):
    """h(parameters, pressure) -> force, its inverse, and the map between its parameters and free coordinates.

    Subclasses state `names` and `units` of their parameters, in order. A curve with `path` = True has memory: it gives
    the force at each pressure of a time series, which depends on the pressures before. Other curves are functions of
    the present pressure alone. The fit refuses a curve of a user's own that falls, is not finite, or does not return
    one number for each.
    """

    names: ClassVar[tuple[str, ...]]
    units: ClassVar[tuple[str, ...]]
    path: ClassVar[bool] = False

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.names)

    @property
    def positive(self) -> np.ndarray:
        """Flags, (parameters,): True for slopes and exponents, whose free coordinate is a logarithm; False: offset."""
        return np.array([name != "offset" for name in self.names])

    @property
    def bends(self) -> Float[np.ndarray, "m parameters"]:
        """Roughness penalty: m combinations of the parameters, each divided by its start, of expected size one.

        See `calib.fitting.curves.fit`. A curve without a penalty has m = 0.
        """
        return np.zeros((0, self.size))

    def at(self, scale: Scale) -> "AbstractCurve":
        """The curve with its open settings, such as a reference pressure, taken from the sizes of the samples."""
        del scale
        return self

    @abc.abstractmethod
    def __call__(self, params: Params, pressure: Values) -> Values:
        """Force (...) N at `pressure` (...) Pa, for parameters (parameters,); NaN pressure gives NaN force."""

    def seen(self, pressure: Series) -> Float[Array, "samples ..."]:
        """The part of the curve that does not depend on the parameters, computed once per fit; input of `given`."""
        return pressure

    def given(self, params: Params, seen: Float[Array, "samples ..."]) -> Series:
        """Force in N from the result of `seen`: ``given(params, seen(pressure))`` equals ``self(params, pressure)``."""
        return self(params, seen)

    @abc.abstractmethod
    def inverse(self, params: Params, force: Values) -> Values:
        """Pressure (...) Pa at which the curve with parameters (parameters,) gives `force` (...) N."""

    @abc.abstractmethod
    def free(self, params: Params, scale: Scale) -> Params:
        """Parameters (parameters,) in free coordinates: dimensionless, unbounded, of order one."""

    @abc.abstractmethod
    def bound(self, free: Params, scale: Scale) -> Params:
        """Inverse of `free`: parameters with units; any `free` gives parameters inside their bounds."""

    @abc.abstractmethod
    def initial(self, pressure: Series, force: Series, valid: Mask, scale: Scale) -> Params:
        """A robust start (parameters,) for the fit, always finite and inside the bounds.

        Args:
            pressure, force, valid: samples (samples,) in Pa and N, and which of them count.
        """


class PositiveSlopes(AbstractCurve):
    """Base of curves whose parameters are all positive slopes in N/Pa; the fit starts with equal slopes."""

    def free(self, params: Params, scale: Scale) -> Params:
        return jnp.log(params * (scale.pressure / scale.force))

    def bound(self, free: Params, scale: Scale) -> Params:
        return jnp.exp(free) * (scale.force / scale.pressure)

    def initial(self, pressure: Series, force: Series, valid: Mask, scale: Scale) -> Params:
        return jnp.broadcast_to(start_slope(pressure, force, valid, scale), (len(self.names),))
