"""Curves that rise from zero and need no formula: a rising cubic, and a spline of positive slopes."""

import abc
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

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
    start_slope,
)


class _RisingFromZero(AbstractCurve):
    """A rising curve on pressures from 0 to `top` (Pa), continued as straight lines below and above; zero at zero.

    `top` is a setting, not a parameter. By default the fit takes the 98 % quantile of the pressure.
    """

    top: Scalar | None = limited(None, above=0, converter=optional_array)

    units: ClassVar[tuple[str, ...]] = ()

    def at(self, scale: Scale) -> "_RisingFromZero":
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


class MonotonePolynomial(_RisingFromZero):
    """F = sum of c_j B_j(P / top), a rising cubic: B_j are the Bernstein polynomials of degree 3, c_0 = 0, c_j rise.

    | parameter    | meaning                                   | shape | unit | bound |
    |--------------|-------------------------------------------|-------|------|-------|
    | rise 1, 2, 3 | c_j - c_(j-1); a straight line if equal   | ()    | N    | > 0   |

    Example:
        cubic = fitting.fit_curve(calib.fitting.MonotonePolynomial(), pressures[0], forces[0])
        print(cubic.parameters)  # N
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

    def initial(self, pressure: Series, force: Series, valid: Mask, scale: Scale) -> Params:
        slope = start_slope(pressure, force, valid, scale)
        return jnp.broadcast_to(slope * self._top(slope.dtype) / 3, (3,))


# Expected second difference of the slopes, as a fraction of the slope at the start: the slope at a knot is expected to
# differ from the mean of its neighbours by a quarter of a typical slope.
EXPECTED_BEND = 0.5


class MonotoneSpline(PositiveSlopes, _RisingFromZero):
    """A quadratic I-spline: the slope is linear between five knots from 0 to `top`, and positive at each.

    | parameter     | meaning                       | shape | unit | bound |
    |---------------|-------------------------------|-------|------|-------|
    | slope 0 .. 4  | at the knots, evenly spaced   | ()    | N/Pa | > 0   |

    A penalty keeps the curve smooth where samples are few (P-spline; Eilers and Marx 1996, Statist. Sci. 11): second
    differences of the slopes, divided by the slope at the start, have the expected size 0.5.
    """

    name: ClassVar[str] = "spline"

    names: ClassVar[tuple[str, ...]] = tuple(f"slope {j}" for j in range(5))
    units: ClassVar[tuple[str, ...]] = ("N/Pa",) * 5

    @property
    def bends(self) -> Float[np.ndarray, "m parameters"]:
        """Second differences of the slopes, over their expected size."""
        return np.diff(np.eye(self.size), 2, axis=0) / EXPECTED_BEND

    def _unit(self, params: Params, z: Values) -> Values:
        pieces = len(params) - 1
        slopes = params * self._top(params.dtype) / pieces
        starts = jnp.arange(pieces, dtype=z.dtype)
        along = jnp.clip(z[..., None] * pieces - starts, 0, 1)  # part of each piece that lies below z
        return jnp.sum(slopes[:-1] * along + 0.5 * jnp.diff(slopes) * along**2, -1)

    def _ends(self, params: Params) -> tuple[Scalar, Scalar]:
        top = self._top(params.dtype)
        return params[0] * top, params[-1] * top
