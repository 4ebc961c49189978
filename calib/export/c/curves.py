"""Pressure-force curves as C: a table of coefficients for each pad, and the function that reads its row.

A curve that can be exported has one entry in `FORMULAS`, by its name.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...fitting.curves import CURVES, FittedCurve
from ...fitting.curves.elementary import ZERO_LOAD
from ...presses.pooled import REST_FRACTION
from ..errors import ExportError


class CurveInC(NamedTuple):
    """Curves of all pads in C.

    | meaning                                                                            | shape     |
    |------------------------------------------------------------------------------------|-----------|
    | formula: what the curve is, for a comment                                          |           |
    | coefficients ``a`` of each pad                                                     | (pads, n) |
    | body: statements that return the force at ``pressure`` from ``a``                  |           |
    """

    formula: str
    coefficients: np.ndarray
    body: tuple[str, ...]


def _linear(fitted: FittedCurve) -> CurveInC:
    return CurveInC("F = a0 P", _parameters(fitted), ("return a[0] * pressure;",))


def _affine(fitted: FittedCurve) -> CurveInC:
    """With the ramp from 0 at rest to 1, as `calib.fitting.pads` has for curves that are not zero at rest."""
    full = REST_FRACTION * np.asarray(fitted.pressure_range, float)[:, 1:]
    body = ("return (a[0] * pressure + a[1]) * fminf(fmaxf(pressure / a[2], 0.0f), 1.0f);",)
    formula = "F = (a0 P + a1) clip(P / a2, 0, 1): a pad at rest bears no force"
    return CurveInC(formula, np.hstack([_parameters(fitted), full]), body)


def _power(fitted: FittedCurve) -> CurveInC:
    secant, exponent = _parameters(fitted).T
    reference = _setting(fitted, "reference")
    body = (
        f"if (!(pressure > {ZERO_LOAD:g}f * a[2]))",
        "    return 0.0f;",
        "return a[0] * powf(pressure / a[2], a[1]);",
    )
    return CurveInC("F = a0 (P / a2)^a1", np.stack([secant * reference, exponent, reference], 1), body)


def _polynomial(fitted: FittedCurve) -> CurveInC:
    """Powers of z instead of Bernstein polynomials: three multiply-adds."""
    c1, c2, c3 = np.cumsum(_parameters(fitted), 1).T
    powers = np.stack([3 * c1, 3 * c2 - 6 * c1, 3 * c1 - 3 * c2 + c3], 1)
    last = 3 * _parameters(fitted)[:, 2]
    top = _setting(fitted, "top")
    body = (
        "const float z = pressure / a[4], inside = fminf(fmaxf(z, 0.0f), 1.0f);",
        "const float force = inside * (a[0] + inside * (a[1] + inside * a[2]));",
        "return force + a[0] * fminf(z, 0.0f) + a[3] * fmaxf(z - 1.0f, 0.0f);",
    )
    formula = "F = a0 z + a1 z^2 + a2 z^3, z = P / a4; straight below 0 and, with the slope a3, above 1"
    return CurveInC(formula, np.column_stack([powers, last, top]), body)


def _spline(fitted: FittedCurve) -> CurveInC:
    slopes = _parameters(fitted)
    pieces, top = slopes.shape[1] - 1, _setting(fitted, "top")
    body = (
        f"const float z = {pieces}.0f * pressure / a[{pieces + 1}];",
        f"float force = a[0] * fminf(z, 0.0f) + a[{pieces}] * fmaxf(z - {pieces}.0f, 0.0f);",
        f"for (uint32_t i = 0; i < {pieces}; i++) {{",
        "    const float along = fminf(fmaxf(z - (float)i, 0.0f), 1.0f);",
        "    force += along * (a[i] + 0.5f * (a[i + 1] - a[i]) * along);",
        "}",
        "return force;",
    )
    formula = f"slope a0 .. a{pieces}, N a piece, linear between the ends of {pieces} pieces from 0 to a{pieces + 1} Pa"
    return CurveInC(formula, np.column_stack([slopes * top[:, None] / pieces, top]), body)


FORMULAS: dict[str, Callable[[FittedCurve], CurveInC]] = {
    "linear": _linear,
    "affine": _affine,
    "power": _power,
    "polynomial": _polynomial,
    "spline": _spline,
}


def curve_in_c(fitted: FittedCurve) -> CurveInC:
    """The fitted curves of all pads in C.

    Raises:
        ExportError: if the curve has memory, or no formula in C.
    """
    name = CURVES.name_of(fitted.curve)
    if name not in FORMULAS:
        why = "it remembers the pressures before" if fitted.curve.path else "it has no formula in C"
        raise ExportError(
            f"curve {name!r}: cannot be exported, because {why}; calibrate with one of {', '.join(FORMULAS)}"
        )
    return FORMULAS[name](fitted)


def _parameters(fitted: FittedCurve) -> np.ndarray:
    return np.asarray(fitted.parameters, float)


def _setting(fitted: FittedCurve, name: str) -> np.ndarray:
    """A setting of the curve for each pad, (pads,)."""
    return np.broadcast_to(np.asarray(getattr(fitted.curve, name), float), fitted.parameters.shape[:1])
