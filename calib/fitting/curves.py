"""Curves h: pad pressure (Pa, baseline removed) -> normal force on the pad (N).

A curve is a choice, not a result: it holds no fitted numbers. Every curve is increasing by construction, because
its slopes and exponents are fitted as logarithms, and is handed to the solver in *free* coordinates of order one
(see `Scale`), so that float32 works and one step size suits all parameters.

A new curve is one class with a `name`; `CURVES` finds it in the modules of this room.
"""

import abc
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float, Real

from jaxeit.registry import Registry

from .order_statistics import median, quantiles

Scalar = Float[Array, ""]
Params = Float[Array, " parameters"]
Samples = Float[Array, " samples"]
Mask = Bool[Array, " samples"]
Values = Float[Array, "..."]


class Scale(eqx.Module):
    """Sizes of one pad's samples, for scaling only: no result depends on them beyond rounding.

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


def scale_of(pressure: Samples, force: Samples, valid: Mask) -> Scale:
    """`Scale` of the valid samples; quantiles, so that a spike does not set the scale."""
    size = _positive(quantiles(jnp.abs(pressure), valid, (0.75,))[0], 1.0)
    low, centre, high, top = quantiles(pressure, valid, (0.05, 0.5, 0.95, 0.98))
    return Scale(
        pressure=size,
        centre=jnp.nan_to_num(centre),
        spread=_positive((high - low) / 2, size),
        force=_positive(quantiles(jnp.abs(force), valid, (0.75,))[0], 1.0),
        top=_positive(top, size),
    )


def resistant_line(x: Samples, y: Samples, valid: Mask) -> tuple[Scalar, Scalar]:
    """Slope and intercept through the medians of the outer thirds of x (Tukey's resistant line).

    A start for the fit that neither outliers nor spikes can carry away. NaN where x has fewer than two values.
    """
    low, high = quantiles(x, valid, (1 / 3, 2 / 3))
    left = [median(v, valid & (x <= low)) for v in (x, y)]
    right = [median(v, valid & (x >= high)) for v in (x, y)]
    run = right[0] - left[0]
    slope = jnp.where(run > 0, (right[1] - left[1]) / jnp.where(run > 0, run, 1.0), jnp.nan)
    return slope, (left[1] + right[1] - slope * (left[0] + right[0])) / 2


class AbstractCurve(eqx.Module):
    """h(parameters, pressure) -> force, its inverse, and the map between its parameters and free ones.

    Subclasses state `names` and `units` of their parameters, in order. A curve with a `path` gives the force at each
    pressure of a series in the order of time, from what came before it; all others look at each pressure alone.
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
        """Which parameters are above zero, slopes and exponents, by their logarithms; not an offset, (parameters,)."""
        return np.array([name != "offset" for name in self.names])

    @property
    def bends(self) -> Float[np.ndarray, "m parameters"]:
        """Combinations of the parameters, as multiples of their start, that are of order one at most; see `fit`."""
        return np.zeros((0, self.size))

    def at(self, scale: Scale) -> "AbstractCurve":
        """The curve with whatever it left open (a reference pressure) taken from the samples."""
        del scale
        return self

    @abc.abstractmethod
    def __call__(self, params: Params, pressure: Values) -> Values:
        """Force in N at `pressure` in Pa; NaN pressure gives NaN force."""

    def seen(self, pressure: Samples) -> Float[Array, "samples ..."]:
        """What of a series of pressures does not depend on the parameters: made once for a fit, then `given`."""
        return pressure

    def given(self, params: Params, seen: Float[Array, "samples ..."]) -> Samples:
        """Force in N, from what was `seen`."""
        return self(params, seen)

    @abc.abstractmethod
    def inverse(self, params: Params, force: Values) -> Values:
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
    ratio = force / jnp.where(loaded, pressure, 1.0)
    unit = scale.force / scale.pressure
    return jnp.maximum(jnp.nan_to_num(median(ratio, loaded), nan=unit), 1e-3 * unit)


class Linear(AbstractCurve):
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

    def free(self, params: Params, scale: Scale) -> Params:
        return jnp.log(params * (scale.pressure / scale.force))

    def bound(self, free: Params, scale: Scale) -> Params:
        return jnp.exp(free) * (scale.force / scale.pressure)

    def initial(self, pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Params:
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

    def initial(self, pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Params:
        slope, _ = resistant_line(pressure, force, valid)
        unit = scale.force / scale.spread
        slope = jnp.maximum(jnp.nan_to_num(slope, nan=unit), 1e-3 * unit)
        level = median(force - slope * pressure, valid)
        return jnp.stack([slope, jnp.nan_to_num(level)])


def _reference(value: ArrayLike | None) -> Real[Array, "..."] | None:
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

    name: ClassVar[str] = "power"

    reference: Scalar | None = eqx.field(converter=_reference, default=None)

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
        """Logarithm of P / P0, and whether the pad is loaded: the logarithm is the slowest part of the curve."""
        p0 = self._p0(pressure.dtype)
        loaded = pressure > _NOTHING * p0
        return jnp.stack([jnp.log(jnp.where(loaded, pressure, p0) / p0), loaded.astype(pressure.dtype)], -1)

    def given(self, params: Params, seen: Values) -> Values:
        force = params[0] * self._p0(params.dtype) * jnp.exp(params[1] * seen[..., 0])
        return jnp.where(seen[..., 1] > 0, force, 0.0)

    def inverse(self, params: Params, force: Values) -> Values:
        p0 = self._p0(params.dtype)
        loaded = force > _NOTHING
        z = jnp.where(loaded, force, 1.0) / (params[0] * p0)
        pressure = jnp.where(loaded, p0 * z ** (1 / params[1]), 0.0)
        return jnp.where(jnp.isnan(force), force, pressure)

    def free(self, params: Params, scale: Scale) -> Params:
        size = params[0] * self._p0(params.dtype) / scale.force
        return jnp.log(jnp.stack([size, params[1]]))

    def bound(self, free: Params, scale: Scale) -> Params:
        size, exponent = jnp.exp(free)
        return jnp.stack([size * scale.force / self._p0(free.dtype), exponent])

    def initial(self, pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Params:
        p0 = self._p0(pressure.dtype)
        loaded = valid & (pressure > 0.1 * scale.pressure) & (force > 0.02 * scale.force)
        x = jnp.log(jnp.where(loaded, pressure, p0) / p0)
        y = jnp.log(jnp.where(loaded, force, scale.force) / scale.force)
        slope, intercept = resistant_line(x, y, loaded)
        exponent = jnp.clip(jnp.nan_to_num(slope, nan=1.0), 0.2, 5.0)
        straight = _start_slope(pressure, force, valid, scale)
        secant = jnp.where(jnp.isfinite(slope) & (slope > 0), jnp.exp(intercept) * scale.force / p0, straight)
        return jnp.stack([secant, exponent])


class _PositiveSlopes(AbstractCurve):
    """Parameters that are slopes in N/Pa, each above zero; from the start all alike."""

    def free(self, params: Params, scale: Scale) -> Params:
        return jnp.log(params * (scale.pressure / scale.force))

    def bound(self, free: Params, scale: Scale) -> Params:
        return jnp.exp(free) * (scale.force / scale.pressure)

    def initial(self, pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Params:
        return jnp.broadcast_to(_start_slope(pressure, force, valid, scale), (len(self.names),))


def _knots(value: ArrayLike | Sequence[float] | None) -> Real[Array, "..."] | None:
    return None if value is None else jnp.asarray(value)


class _Stretch(AbstractCurve):
    """A rising curve on the stretch from 0 to `top` (Pa), straight on beyond both ends; zero at zero.

    `top` is a choice; left out, the fit takes the 98 % quantile of the pressure.
    """

    top: Scalar | None = eqx.field(converter=_knots, default=None)

    units: ClassVar[tuple[str, ...]] = ()

    def at(self, scale: Scale) -> "_Stretch":
        return type(self)(jnp.asarray(scale.top if self.top is None else self.top, scale.top.dtype))

    def _top(self, dtype: DTypeLike) -> Scalar:
        if self.top is None:
            raise ValueError(f"{type(self).__name__} has no top pressure yet; give one in Pa or fit it first.")
        return self.top.astype(dtype)

    @abc.abstractmethod
    def _unit(self, params: Params, z: Values) -> Values:
        """Force at z = pressure / top between 0 and 1."""

    @abc.abstractmethod
    def _ends(self, params: Params) -> tuple[Scalar, Scalar]:
        """Slopes at both ends, N per unit of z."""

    def __call__(self, params: Params, pressure: Values) -> Values:
        z = pressure / self._top(params.dtype)
        low, high = self._ends(params)
        inside = self._unit(params, jnp.clip(z, 0, 1))
        return inside + low * jnp.minimum(z, 0) + high * jnp.maximum(z - 1, 0)

    def inverse(self, params: Params, force: Values) -> Values:
        low, high = self._ends(params)
        last = self._unit(params, jnp.ones((), params.dtype))

        def halve(_: Array, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
            lower, upper = bounds
            middle = (lower + upper) / 2
            above = self._unit(params, middle) > force
            return jnp.where(above, lower, middle), jnp.where(above, middle, upper)

        shape = jnp.shape(force)
        start = jnp.zeros(shape, params.dtype), jnp.ones(shape, params.dtype)
        lower, upper = jax.lax.fori_loop(0, 60, halve, start)
        z = (lower + upper) / 2
        z = jnp.where(force < 0, force / low, jnp.where(force > last, 1 + (force - last) / high, z))
        return jnp.where(jnp.isnan(force), force, z * self._top(params.dtype))


class MonotonePolynomial(_Stretch):
    """F = sum of c_j B_j(P / top), Bernstein polynomials of degree 3 with c_0 = 0 and c_j rising: a rising cubic.

    | parameter    | meaning                                   | shape | unit | bound |
    |--------------|-------------------------------------------|-------|------|-------|
    | rise 1, 2, 3 | c_j - c_(j-1); equal: a straight line     | ()    | N    | > 0   |
    """

    name: ClassVar[str] = "polynomial"

    names: ClassVar[tuple[str, ...]] = ("rise 1", "rise 2", "rise 3")
    units: ClassVar[tuple[str, ...]] = ("N", "N", "N")

    def _unit(self, params: Params, z: Values) -> Values:
        c1, c2, c3 = jnp.cumsum(params)
        found: Values = 3 * c1 * z * (1 - z) ** 2 + 3 * c2 * z**2 * (1 - z) + c3 * z**3
        return found

    def _ends(self, params: Params) -> tuple[Scalar, Scalar]:
        return 3 * params[0], 3 * params[2]

    def free(self, params: Params, scale: Scale) -> Params:
        return jnp.log(params / scale.force)

    def bound(self, free: Params, scale: Scale) -> Params:
        return jnp.exp(free) * scale.force

    def initial(self, pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Params:
        slope = _start_slope(pressure, force, valid, scale)
        return jnp.broadcast_to(slope * self._top(slope.dtype) / 3, (3,))


_BEND = 0.5  # of the typical slope: how far a slope is expected from the middle between its neighbours, twice over


class MonotoneSpline(_PositiveSlopes, _Stretch):
    """A curve whose slope is straight between five knots from 0 to `top`, and positive at each: a quadratic I-spline.

    | parameter     | meaning                       | shape | unit | bound |
    |---------------|-------------------------------|-------|------|-------|
    | slope 0 .. 4  | at the knots, evenly spaced   | ()    | N/Pa | > 0   |

    Where samples say little about a bend, it is fitted gently bent (P-spline; Eilers and Marx 1996, Statist. Sci. 11):
    second differences of the slopes, over the slope at the start, are expected to be of size 0.5.
    """

    name: ClassVar[str] = "spline"

    names: ClassVar[tuple[str, ...]] = tuple(f"slope {j}" for j in range(5))
    units: ClassVar[tuple[str, ...]] = ("N/Pa",) * 5

    @property
    def bends(self) -> Float[np.ndarray, "m parameters"]:
        """Second differences of the slopes."""
        return np.diff(np.eye(self.size), 2, axis=0) / _BEND

    def _unit(self, params: Params, z: Values) -> Values:
        pieces = len(params) - 1
        slopes = params * self._top(params.dtype) / pieces
        along = jnp.clip(z[..., None] * pieces - jnp.arange(pieces), 0, 1)  # part of each piece that lies below
        return jnp.sum(slopes[:-1] * along + 0.5 * jnp.diff(slopes) * along**2, -1)

    def _ends(self, params: Params) -> tuple[Scalar, Scalar]:
        top = self._top(params.dtype)
        return params[0] * top, params[-1] * top


def play(signal: Float[Array, " n"], width: Float[Array, " m"]) -> Float[Array, "n m"]:
    """Play operators: each follows the signal at a distance of at most its width, from rest at zero.

    y_k = max(u_k - r, min(u_k + r, y_(k-1))). Steps are clamps, and clamps after clamps are clamps: so the series is
    done in log(n) parallel steps. NaN holds still.
    """
    u = signal[:, None]
    hold = jnp.isnan(u)
    low = jnp.where(hold, -jnp.inf, u - width)
    high = jnp.where(hold, jnp.inf, u + width)

    def then(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
        return jnp.clip(first[0], *second), jnp.clip(first[1], *second)

    low, high = jax.lax.associative_scan(then, (low, high))
    return jnp.clip(jnp.zeros((), u.dtype), low, high)


def _cumulative_weights(slopes: Float[Array, " m"]) -> Float[Array, " m"]:
    """Weights of a Prandtl-Ishlinskii operator whose curve of first loading has these slopes."""
    return jnp.concatenate([slopes[:1], jnp.diff(slopes)])


def _undone(weights: Float[Array, " m"], widths: Float[Array, " m-1"], out: Samples) -> Samples:
    """The series that a Prandtl-Ishlinskii operator makes `out` of: an operator of the same kind."""
    sums, all_widths = jnp.cumsum(weights), jnp.concatenate([jnp.zeros(1, weights.dtype), widths])
    turned = [jnp.sum(weights[: i + 1] * (r - all_widths[: i + 1])) for i, r in enumerate(all_widths)]
    back = -weights[1:] / (sums[1:] * sums[:-1])
    return out / weights[0] + play(out, jnp.stack(turned[1:])) @ back


_WIDTHS = (0.2, 0.4, 0.8)  # of half the distance between the 5 % and 95 % quantiles of the pressure


class _PrandtlIshlinskii(AbstractCurve):
    """F = b + w_0 P + sum of w_i play(P; r_i), in time: hysteresis that does not depend on rate.

    The slopes w_0 + ... + w_i of its curve of first loading are positive, so that it has an inverse, which is of the
    same kind (Krejci and Kuhnen 2001): a law for force from pressure, fitted directly, *is* the inverse of one for the
    pressure that a pad shows. `widths` r_i (Pa) are a choice; left out, 10, 20 and 40 % of the range fitted.
    """

    widths: Float[Array, " m"] | None = eqx.field(converter=_knots, default=None)

    path: ClassVar[bool] = True

    def at(self, scale: Scale) -> "_PrandtlIshlinskii":
        own = jnp.asarray(_WIDTHS, scale.spread.dtype) * scale.spread
        return type(self)(own if self.widths is None else jnp.asarray(self.widths, own.dtype))

    def _widths(self, dtype: DTypeLike) -> Float[Array, " m"]:
        if self.widths is None:
            raise ValueError(f"{type(self).__name__} has no widths yet; give them in Pa or fit it first.")
        return self.widths.astype(dtype)

    def _split(self, params: Params) -> tuple[Float[Array, " m"], Scalar]:
        """Weights and offset."""
        return _cumulative_weights(params), jnp.zeros((), params.dtype)

    def __call__(self, params: Params, pressure: Values) -> Values:
        return self.given(params, self.seen(jnp.ravel(pressure))).reshape(jnp.shape(pressure))

    def seen(self, pressure: Samples) -> Float[Array, "samples ..."]:
        return jnp.column_stack([pressure, play(pressure, self._widths(pressure.dtype))])

    def given(self, params: Params, seen: Float[Array, "samples ..."]) -> Samples:
        weights, offset = self._split(params)
        return seen @ weights + offset

    def inverse(self, params: Params, force: Values) -> Values:
        weights, offset = self._split(params)
        return _undone(weights, self._widths(params.dtype), jnp.ravel(force) - offset).reshape(jnp.shape(force))


_SLOPES = tuple(f"slope {j}" for j in range(len(_WIDTHS) + 1))


class Play(_PositiveSlopes, _PrandtlIshlinskii):
    """Hysteresis of a pad: force from the series of its pressures; zero as long as nothing has been pressed.

    | parameter    | meaning                                                    | shape | unit | bound |
    |--------------|------------------------------------------------------------|-------|------|-------|
    | slope 0 .. 3 | of first loading: at once, and beyond each of the widths   | ()    | N/Pa | > 0   |

    After a turn the slopes follow each other in the same order, at twice the widths.
    """

    name: ClassVar[str] = "play"

    names: ClassVar[tuple[str, ...]] = _SLOPES
    units: ClassVar[tuple[str, ...]] = ("N/Pa",) * len(_SLOPES)


class AffinePlay(_PrandtlIshlinskii):
    """`Play` with an offset: loading and unloading branches of a log whose zero is elsewhere.

    | parameter    | meaning                                                    | shape | unit | bound |
    |--------------|------------------------------------------------------------|-------|------|-------|
    | slope 0 .. 3 | as of `Play`                                               | ()    | N/Pa | > 0   |
    | offset       | added throughout                                           | ()    | N    | none  |
    """

    name: ClassVar[str] = "hysteresis"

    names: ClassVar[tuple[str, ...]] = (*_SLOPES, "offset")
    units: ClassVar[tuple[str, ...]] = (*("N/Pa",) * len(_SLOPES), "N")

    def _split(self, params: Params) -> tuple[Float[Array, " m"], Scalar]:
        return _cumulative_weights(params[:-1]), params[-1]

    def free(self, params: Params, scale: Scale) -> Params:
        middle = params[-2] * scale.centre + params[-1]
        slopes = jnp.log(params[:-1] * (scale.spread / scale.force))
        return jnp.append(slopes, middle / scale.force)

    def bound(self, free: Params, scale: Scale) -> Params:
        slopes = jnp.exp(free[:-1]) * (scale.force / scale.spread)
        return jnp.append(slopes, free[-1] * scale.force - slopes[-1] * scale.centre)

    def initial(self, pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Params:
        slope, offset = Affine().initial(pressure, force, valid, scale)
        return jnp.append(jnp.broadcast_to(slope, (len(_SLOPES),)), offset)


_RATIOS = tuple(f"ratio {j}" for j in range(len(_WIDTHS)))


class PlaySpline(AbstractCurve):
    """F = b + S(y), S a `MonotoneSpline` of y, the pressure seen through play operators: bent, and with hysteresis.

    y = w_0 P + sum of w_i play(P; r_i); its slope of first loading is ratio i beyond the i-th width and 1 beyond all:
    y is in pascal, and S carries the size. A generalised Prandtl-Ishlinskii operator (Al Janaideh et al. 2011, IEEE
    Trans. Mechatronics 16): the inverse is that of S, then that of the operator.

    | parameter     | meaning                                                    | shape | unit | bound |
    |---------------|------------------------------------------------------------|-------|------|-------|
    | slope 0 .. 4  | of S at its knots, evenly spaced from 0 to `top`           | ()    | N/Pa | > 0   |
    | ratio 0 .. 2  | of first loading: at once, and beyond all widths but one   | ()    | 1    | > 0   |
    | offset        | added throughout                                           | ()    | N    | none  |
    """

    name: ClassVar[str] = "hysteresis-spline"

    widths: Float[Array, " m"] | None = eqx.field(converter=_knots, default=None)
    top: Scalar | None = eqx.field(converter=_knots, default=None)

    path: ClassVar[bool] = True
    names: ClassVar[tuple[str, ...]] = (*MonotoneSpline.names, *_RATIOS, "offset")
    units: ClassVar[tuple[str, ...]] = (*MonotoneSpline.units, *("1",) * len(_RATIOS), "N")

    @property
    def bends(self) -> Float[np.ndarray, "m parameters"]:
        """Those of S."""
        own = MonotoneSpline(self.top).bends
        return np.pad(own, ((0, 0), (0, self.size - own.shape[1])))

    def at(self, scale: Scale) -> "PlaySpline":
        return PlaySpline(Play(self.widths).at(scale).widths, MonotoneSpline(self.top).at(scale).top)

    def _parts(self, params: Params) -> tuple[Float[Array, " knots"], Float[Array, " m"], Scalar]:
        """Parameters of the spline, weights of the operator, and the offset."""
        knots = len(MonotoneSpline.names)
        ratios = jnp.append(params[knots:-1], jnp.ones((), params.dtype))
        return params[:knots], _cumulative_weights(ratios), params[-1]

    def __call__(self, params: Params, pressure: Values) -> Values:
        return self.given(params, self.seen(jnp.ravel(pressure))).reshape(jnp.shape(pressure))

    def seen(self, pressure: Samples) -> Float[Array, "samples ..."]:
        return Play(self.widths).seen(pressure)

    def given(self, params: Params, seen: Float[Array, "samples ..."]) -> Samples:
        slopes, weights, offset = self._parts(params)
        return MonotoneSpline(self.top)(slopes, seen @ weights) + offset

    def inverse(self, params: Params, force: Values) -> Values:
        slopes, weights, offset = self._parts(params)
        seen = MonotoneSpline(self.top).inverse(slopes, jnp.ravel(force) - offset)
        return _undone(weights, Play(self.widths)._widths(params.dtype), seen).reshape(jnp.shape(force))

    def free(self, params: Params, scale: Scale) -> Params:
        knots = len(MonotoneSpline.names)
        slopes = MonotoneSpline(self.top).free(params[:knots], scale)
        return jnp.concatenate([slopes, jnp.log(params[knots:-1]), params[-1:] / scale.force])

    def bound(self, free: Params, scale: Scale) -> Params:
        knots = len(MonotoneSpline.names)
        slopes = MonotoneSpline(self.top).bound(free[:knots], scale)
        return jnp.concatenate([slopes, jnp.exp(free[knots:-1]), free[-1:] * scale.force])

    def initial(self, pressure: Samples, force: Samples, valid: Mask, scale: Scale) -> Params:
        slope, offset = Affine().initial(pressure, force, valid, scale)
        slopes = jnp.broadcast_to(slope, (len(MonotoneSpline.names),))
        return jnp.concatenate([slopes, jnp.ones(len(_RATIOS), slopes.dtype), offset[None]])


CURVES = Registry(AbstractCurve, "curve", "calib.curves")
"""Curves by the names used on the command line and in calibration files."""
