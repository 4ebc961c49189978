"""Curves with hysteresis: weighted sums of play operators over the series of pressures."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxeit.registry import limited

from .base import AbstractCurve, Mask, Params, PositiveSlopes, Scalar, Scale, Series, Values, optional_array
from .elementary import Affine
from .monotone import MonotoneSpline


def play(signal: Float[Array, " n"], width: Float[Array, " m"]) -> Float[Array, "n m"]:
    """Play operators: each follows the signal at a distance of at most its width; each starts at zero.

    y_k = max(u_k - r, min(u_k + r, y_(k-1))). The state is kept where the signal is NaN. The loop over the samples is
    compiled in 0.1 s whatever their number; an associative scan takes 10 to 40 s and is slower on a CPU.
    """

    def follow(state: Float[Array, " m"], sample: Scalar) -> tuple[Array, Array]:
        near = jnp.clip(state, sample - width, sample + width)
        state = jnp.where(jnp.isnan(sample), state, near)
        return state, state

    return jax.lax.scan(follow, jnp.zeros(width.shape, signal.dtype), signal)[1]


def _cumulative_weights(slopes: Float[Array, " m"]) -> Float[Array, " m"]:
    """Weights w_i of a Prandtl-Ishlinskii operator whose curve of first loading has these slopes."""
    return jnp.concatenate([slopes[:1], jnp.diff(slopes)])


def _operator_input(weights: Float[Array, " m"], widths: Float[Array, " m-1"], out: Series) -> Series:
    """Input series of a Prandtl-Ishlinskii operator with output `out`; the inverse is an operator of the same kind.

    Krejci and Kuhnen 2001, IEE Proc. Control Theory Appl. 148.
    """
    sums, all_widths = jnp.cumsum(weights), jnp.concatenate([jnp.zeros(1, weights.dtype), widths])
    turned = [jnp.sum(weights[: i + 1] * (r - all_widths[: i + 1])) for i, r in enumerate(all_widths)]
    back = -weights[1:] / (sums[1:] * sums[:-1])
    return out / weights[0] + play(out, jnp.stack(turned[1:])) @ back


# Default widths r_i as multiples of `Scale.spread`, which is half the range. After a turn, the width r has an effect
# once the pressure has gone back by 2 r: a cycle over the whole range reaches all three.
WIDTHS = (0.2, 0.4, 0.8)


class _PrandtlIshlinskii(AbstractCurve):
    """F = b + w_0 P + sum of w_i play(P; r_i) over a series in time: hysteresis that does not depend on rate.

    The slopes w_0 + ... + w_i of the curve of first loading are positive, so that the operator has an inverse of the
    same kind (Krejci and Kuhnen 2001). A fit of force from pressure is therefore also a model of pressure from force.
    `widths` r_i (Pa) are settings, not parameters; by default 10, 20 and 40 % of the range of the samples.
    """

    widths: Float[Array, " m"] | None = limited(None, above=0, converter=optional_array)

    path: ClassVar[bool] = True

    def at(self, scale: Scale) -> "_PrandtlIshlinskii":
        own = jnp.asarray(WIDTHS, scale.spread.dtype) * scale.spread
        return type(self)(own if self.widths is None else jnp.asarray(self.widths, own.dtype))

    def _widths(self, dtype: DTypeLike) -> Float[Array, " m"]:
        if self.widths is None:
            raise ValueError(f"{type(self).__name__} has no widths yet; give them in Pa or fit it first.")
        return self.widths.astype(dtype)

    def _split(self, params: Params) -> tuple[Float[Array, " m"], Scalar]:
        """Weights (m + 1,) in N/Pa, and the offset in N."""
        return _cumulative_weights(params), jnp.zeros((), params.dtype)

    def __call__(self, params: Params, pressure: Values) -> Values:
        return self.given(params, self.seen(jnp.ravel(pressure))).reshape(jnp.shape(pressure))

    def seen(self, pressure: Series) -> Float[Array, "samples ..."]:
        return jnp.column_stack([pressure, play(pressure, self._widths(pressure.dtype))])

    def given(self, params: Params, seen: Float[Array, "samples ..."]) -> Series:
        weights, offset = self._split(params)
        return seen @ weights + offset

    def inverse(self, params: Params, force: Values) -> Values:
        weights, offset = self._split(params)
        return _operator_input(weights, self._widths(params.dtype), jnp.ravel(force) - offset).reshape(jnp.shape(force))


SLOPE_NAMES = tuple(f"slope {j}" for j in range(len(WIDTHS) + 1))


class Play(PositiveSlopes, _PrandtlIshlinskii):
    """Hysteresis of a pad: force from the series of its pressures; zero until the pad is first pressed.

    | parameter    | meaning                                                    | shape | unit | bound |
    |--------------|------------------------------------------------------------|-------|------|-------|
    | slope 0 .. 3 | of first loading: from zero, and beyond each of the widths | ()    | N/Pa | > 0   |

    After the pressure turns, the same slopes follow in the same order, each after twice its width.
    """

    name: ClassVar[str] = "play"

    names: ClassVar[tuple[str, ...]] = SLOPE_NAMES
    units: ClassVar[tuple[str, ...]] = ("N/Pa",) * len(SLOPE_NAMES)


class AffinePlay(_PrandtlIshlinskii):
    """`Play` with an offset: loading and unloading branches of a log whose zero is elsewhere.

    | parameter    | meaning                                                    | shape | unit | bound |
    |--------------|------------------------------------------------------------|-------|------|-------|
    | slope 0 .. 3 | slopes of first loading, as in `Play`                      | ()    | N/Pa | > 0   |
    | offset       | force added to that of the play operators                  | ()    | N    | none  |
    """

    name: ClassVar[str] = "hysteresis"

    names: ClassVar[tuple[str, ...]] = (*SLOPE_NAMES, "offset")
    units: ClassVar[tuple[str, ...]] = (*("N/Pa",) * len(SLOPE_NAMES), "N")

    def _split(self, params: Params) -> tuple[Float[Array, " m"], Scalar]:
        return _cumulative_weights(params[:-1]), params[-1]

    def free(self, params: Params, scale: Scale) -> Params:
        middle = params[-2] * scale.centre + params[-1]
        slopes = jnp.log(params[:-1] * (scale.spread / scale.force))
        return jnp.append(slopes, middle / scale.force)

    def bound(self, free: Params, scale: Scale) -> Params:
        slopes = jnp.exp(free[:-1]) * (scale.force / scale.spread)
        return jnp.append(slopes, free[-1] * scale.force - slopes[-1] * scale.centre)

    def initial(self, pressure: Series, force: Series, valid: Mask, scale: Scale) -> Params:
        slope, offset = Affine().initial(pressure, force, valid, scale)
        return jnp.append(jnp.broadcast_to(slope, (len(SLOPE_NAMES),)), offset)


RATIO_NAMES = tuple(f"ratio {j}" for j in range(len(WIDTHS)))


class PlaySpline(AbstractCurve):
    """F = b + S(y): a `MonotoneSpline` S of the output y of play operators, for curves that bend and have hysteresis.

    y = w_0 P + sum of w_i play(P; r_i) is in pascal: its slope of first loading is ratio i beyond the i-th width, and 1
    beyond the last, so that S alone carries the unit of force. A generalised Prandtl-Ishlinskii operator (Al Janaideh
    et al. 2011, IEEE Trans. Mechatronics 16); its inverse is the inverse of S, then that of the play operators. The
    ``widths`` r_i and ``top`` are settings in Pa; by default the fit takes them from the samples.

    | parameter     | meaning                                                    | shape | unit | bound |
    |---------------|------------------------------------------------------------|-------|------|-------|
    | slope 0 .. 4  | slopes of S at its knots, evenly spaced from 0 to `top`    | ()    | N/Pa | > 0   |
    | ratio 0 .. 2  | slopes of y: from zero, and beyond each width but the last | ()    | 1    | > 0   |
    | offset        | force added to S                                           | ()    | N    | none  |
    """

    name: ClassVar[str] = "hysteresis-spline"

    widths: Float[Array, " m"] | None = limited(None, above=0, converter=optional_array)
    top: Scalar | None = limited(None, above=0, converter=optional_array)

    path: ClassVar[bool] = True
    names: ClassVar[tuple[str, ...]] = (*MonotoneSpline.names, *RATIO_NAMES, "offset")
    units: ClassVar[tuple[str, ...]] = (*MonotoneSpline.units, *("1",) * len(RATIO_NAMES), "N")

    @property
    def bends(self) -> Float[np.ndarray, "m parameters"]:
        """The roughness penalty of S."""
        own = MonotoneSpline(self.top).bends
        return np.pad(own, ((0, 0), (0, self.size - own.shape[1])))

    def at(self, scale: Scale) -> "PlaySpline":
        return PlaySpline(Play(self.widths).at(scale).widths, MonotoneSpline(self.top).at(scale).top)

    def _parts(self, params: Params) -> tuple[Float[Array, " knots"], Float[Array, " m"], Scalar]:
        """Slopes of the spline (N/Pa), weights of the play operators (1), and the offset (N)."""
        knots = len(MonotoneSpline.names)
        ratios = jnp.append(params[knots:-1], jnp.ones((), params.dtype))
        return params[:knots], _cumulative_weights(ratios), params[-1]

    def __call__(self, params: Params, pressure: Values) -> Values:
        return self.given(params, self.seen(jnp.ravel(pressure))).reshape(jnp.shape(pressure))

    def seen(self, pressure: Series) -> Float[Array, "samples ..."]:
        return Play(self.widths).seen(pressure)

    def given(self, params: Params, seen: Float[Array, "samples ..."]) -> Series:
        slopes, weights, offset = self._parts(params)
        return MonotoneSpline(self.top)(slopes, seen @ weights) + offset

    def inverse(self, params: Params, force: Values) -> Values:
        slopes, weights, offset = self._parts(params)
        seen = MonotoneSpline(self.top).inverse(slopes, jnp.ravel(force) - offset)
        return _operator_input(weights, Play(self.widths)._widths(params.dtype), seen).reshape(jnp.shape(force))

    def free(self, params: Params, scale: Scale) -> Params:
        knots = len(MonotoneSpline.names)
        slopes = MonotoneSpline(self.top).free(params[:knots], scale)
        return jnp.concatenate([slopes, jnp.log(params[knots:-1]), params[-1:] / scale.force])

    def bound(self, free: Params, scale: Scale) -> Params:
        knots = len(MonotoneSpline.names)
        slopes = MonotoneSpline(self.top).bound(free[:knots], scale)
        return jnp.concatenate([slopes, jnp.exp(free[knots:-1]), free[-1:] * scale.force])

    def initial(self, pressure: Series, force: Series, valid: Mask, scale: Scale) -> Params:
        slope, offset = Affine().initial(pressure, force, valid, scale)
        slopes = jnp.broadcast_to(slope, (len(MonotoneSpline.names),))
        return jnp.concatenate([slopes, jnp.ones(len(RATIO_NAMES), slopes.dtype), offset[None]])


def remembered(pressures: np.ndarray) -> np.ndarray:
    """The turning points (m, pads) of own pressures (n, pads) that a curve with hysteresis remembers, padded by NaN.

    A later excursion beyond a turning point wipes it out (wiping-out property of the Preisach model), so few remain.
    """
    turns = [_turns(column) for column in np.asarray(pressures).T]
    longest = max(map(len, turns), default=0)
    return np.stack([np.r_[np.full(longest - len(t), np.nan), t] for t in turns], 1)


def _turns(column: np.ndarray) -> list[float]:
    kept: list[float] = [0.0]  # at rest
    for value in column[np.isfinite(column)].tolist():
        kept.append(value)
        # A value that continues in the same direction makes the value before it no turning point.
        while len(kept) > 2 and (kept[-1] - kept[-2]) * (kept[-2] - kept[-3]) >= 0:
            del kept[-2]
        # An excursion at least as large as the one before closes that inner loop, which has no further effect.
        while len(kept) > 3 and abs(kept[-1] - kept[-2]) >= abs(kept[-2] - kept[-3]):
            del kept[-3:-1]
        # At rest all operators are at zero, so that an excursion farther to the other side wipes out the first one.
        if len(kept) == 3 and abs(kept[2]) >= abs(kept[1]):
            del kept[1]
    return kept
