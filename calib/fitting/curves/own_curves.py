"""What a curve of a user's own must keep: one finite force for each pressure, which rises, and the same of its inverse.

The curves of this package keep it by construction and are not checked. Without this check a curve that is NaN or falls
would look like a pad that does not respond.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..results import FitError
from .base import AbstractCurve
from .problem import CurveProblem

CHECK_POINTS = 33
MAX_FALL = 1e-3  # of the largest force; more than rounding in float32


class StartValues(NamedTuple):
    """A curve with the parameters of its start, at rising pressures over the range of a pad's samples.

    | field    | meaning                                  | shape        | unit          |
    |----------|------------------------------------------|--------------|---------------|
    | params   | parameters of the start                  | (pads, k)    | `curve.units` |
    | pressure | rising; not finite without samples       | (pads, n)    | Pa            |
    | force    | of `AbstractCurve.__call__`              | (pads, n)    | N             |
    | back     | `AbstractCurve.inverse` of these forces  | (pads, n)    | Pa            |
    """

    params: Float[Array, "*pads k"]
    pressure: Float[Array, "*pads n"]
    force: Float[Array, "*pads n"]
    back: Float[Array, "*pads n"]


def is_own(curve: AbstractCurve) -> bool:
    """Whether the class of a curve comes from outside this package."""
    return type(curve).__module__.rpartition(".")[0] != __package__


def evaluate_start(problem: CurveProblem, limits: Float[Array, "2"]) -> StartValues:
    """Try the curve of a problem at pressures between two limits, Pa; `FitError` for results of another shape; pure."""
    curve = problem.curve
    params = curve.bound(problem.start, problem.scale)
    pressure = jnp.linspace(limits[0], limits[1], CHECK_POINTS)
    force = _require_shape(curve, "__call__", curve(params, pressure), pressure)
    back = _require_shape(curve, "inverse", curve.inverse(params, force), force)
    return StartValues(params, pressure, force, back)


def _require_shape(curve: AbstractCurve, method: str, found: Any, given: Array) -> Array:
    shape = getattr(found, "shape", None)
    if shape != given.shape:
        what = f"of shape {shape}" if shape is not None else f"of type {type(found).__name__}"
        name = f"{type(curve).__name__}.{method}"
        raise FitError(
            f"{name} returns a result {what} for an array of shape {given.shape}; return one number for each"
        )
    return found  # type: ignore[no-any-return]


def require_rising(curve: AbstractCurve, values: StartValues) -> None:
    """Refuse a curve that is not finite, or that falls, at the start of its fit to a pad; pads count from 0.

    Raises:
        FitError: names the class, its method and the pad.
    """
    name = type(curve).__name__
    for pad, (params, pressure, force, back) in enumerate(zip(*map(np.asarray, values), strict=True)):
        if not np.isfinite(pressure).all():
            continue
        at = f"with {_parameter_text(curve, params)}, the start of its fit to pad {pad}"
        if (bad := ~np.isfinite(force)).any():
            what = f"returns {force[bad][0]} N at {pressure[bad][0]:g} Pa,"
            raise FitError(f"{name}.__call__ {what} {at}; return a finite force for each finite pressure")
        first = int(np.argmin(np.diff(force)))
        if force[first + 1] - force[first] < -MAX_FALL * np.abs(force).max():
            ends = (f"{force[k]:g} N at {pressure[k]:g} Pa" for k in (first, first + 1))
            what = f"falls from {' to '.join(ends)},"
            raise FitError(f"{name}.__call__ {what} {at}; a curve must rise, whatever the samples")
        if (bad := ~np.isfinite(back)).any():
            what = f"returns {back[bad][0]} Pa at {force[bad][0]:g} N, the force at {pressure[bad][0]:g} Pa,"
            raise FitError(f"{name}.inverse {what} {at}; return the pressure of each force of the curve")


def _parameter_text(curve: AbstractCurve, params: np.ndarray) -> str:
    """Names and values of parameters."""
    parts = zip(curve.names, params, curve.units, strict=True)
    return ", ".join(f"{name} = {value:g} {unit}" for name, value, unit in parts)
