"""Corrections by location as C: the place of the contact by the image, and the log-gain of each pad at that place.

A field that can be exported has one entry in `FORMULAS`, by its name. The formula is that of the field itself, so that
the gain differs from that of Python by rounding alone.
"""

from collections.abc import Callable
from typing import NamedTuple, cast

import numpy as np

import jaxeit as je

from ...calibration import Calibration
from ...calibration.localisation.locators import CentroidLocator
from ...fitting.fields import FIELDS, FittedField, PadEdge, PadEdgeSpline
from ...fitting.fields.pad_edge import KNOTS_PER_OCTAVE
from ...fitting.fields.tensor_products import BOX_HALF_WIDTH
from ..errors import ExportError

Statements = Callable[[FittedField], tuple[str, ...]]


class FieldInC(NamedTuple):
    """Log-gains of all pads in C.

    | meaning                                                                             | shape     |
    |-------------------------------------------------------------------------------------|-----------|
    | formula: what the field is, for a comment                                           |           |
    | coefficients ``b`` of each pad; the last one is the level that is taken off         | (pads, n) |
    | body: statements that return the log-gain of ``pad`` at ``x``, ``y``, m, from ``b`` |           |
    | operations: of a pad, about                                                         |           |
    """

    formula: str
    coefficients: np.ndarray
    body: tuple[str, ...]
    operations: int


class LocationInC(NamedTuple):
    """A correction by location in C.

    | meaning                                                                     | shape            | unit   |
    |-----------------------------------------------------------------------------|------------------|--------|
    | estimator of the place, by its name and settings                            |                  |        |
    | weight: expression in C for the weight of pixel ``p`` in its mean           |                  |        |
    | field                                                                       |                  |        |
    | pixel: centre and area of each pixel                                        | (pixels, 3)      | m, m^2 |
    | side: ends of the sides of each pad; those of length zero repeat a corner   | (pads, sides, 4) | m      |
    | reach: corners of the box in which the field of each pad is known           | (pads, 4)        | m      |
    | box: lowest corner of each pad plus the highest, and their difference       | (pads, 4)        | m      |
    | rim: ends of the sides of the rim of the sheet                              | (rim, 4)         | m      |
    """

    estimator: str
    weight: str
    field: FieldInC
    pixel: np.ndarray
    side: np.ndarray
    reach: np.ndarray
    box: np.ndarray
    rim: np.ndarray

    @property
    def operations(self) -> int:
        """Multiply-adds of a frame, about: place, nearest points of the pads, and fields."""
        pads, sides = len(self.side), int(self.side.shape[1])
        return 4 * len(self.pixel) + pads * (15 * sides + self.field.operations)


def location_in_c(calibration: Calibration) -> LocationInC:
    """The correction by location of a calibration in C.

    Raises:
        ExportError: if the place is not that of an image, or the field or the estimator has no formula in C.
    """
    fitted, locator = calibration.field, calibration.locator
    assert fitted is not None
    if not isinstance(locator, CentroidLocator):
        raise ExportError(
            "location: contacts are fitted to each frame, which is not exported; calibrate with --locator "
            "image-centroid, or add --place half, which takes the place from the image and says what that changes, or "
            "--without-location (docs/firmware.md)"
        )
    name = FIELDS.name_of(fitted.field)
    if name not in FORMULAS:
        raise ExportError(
            f"location {name!r}: has no formula in C; calibrate with one of {', '.join(FORMULAS)}, or export with "
            "--without-location: the gain is then 1 at every place"
        )
    start, end = (np.asarray(part, float) for part in (fitted.geometry.start, fitted.geometry.end))
    low, high = start.min(1), start.max(1)
    recon = calibration.recon
    return LocationInC(
        estimator=je.metrics.ESTIMATORS.text(locator.estimator),
        weight=_weight(locator.estimator),
        field=FORMULAS[name](fitted),
        pixel=np.column_stack([np.asarray(recon.centres, float), np.asarray(recon.areas, float)]),
        side=np.concatenate([start, end], -1),
        reach=np.asarray(fitted.reach, float).reshape(len(start), 4),
        box=np.hstack([low + high, high - low]),
        rim=np.asarray(fitted.geometry.rim, float).reshape(-1, 4),
    )


def _weight(estimator: je.metrics.AbstractEstimator) -> str:
    """The weight of pixel ``p`` with the value ``value``; ``top`` is the largest value, ``total`` the sum so far."""
    kind = type(estimator)  # a class derived from one of these has another formula
    if kind is je.metrics.Peak:
        return "top > 0.0f && value == top && total == 0.0f ? 1.0f : 0.0f"
    if kind is je.metrics.LevelCentroid:
        level = _literal(float(cast(je.metrics.LevelCentroid, estimator).level))
        return f"top > 0.0f && value >= {level} * top ? skin_pixel[p][2] : 0.0f"
    if kind is je.metrics.PositiveCentroid:
        return "value > 0.0f ? value * skin_pixel[p][2] : 0.0f"
    name = je.metrics.ESTIMATORS.text(estimator)
    raise ExportError(f"place {name!r}: has no formula in C; give --place half, peak, quarter or positive")


def _literal(value: float) -> str:
    """A number of single precision in C."""
    text = f"{value:.9g}"
    return f"{text}f" if set(text) & set(".e") else f"{text}.0f"


def _constant(fitted: FittedField) -> FieldInC:
    body = ("(void)x;", "(void)y;", "return -b[1];")
    return FieldInC("the same everywhere", _by_pad(fitted, 1), body, 1)


def _edge(fitted: FittedField) -> FieldInC:
    """Without the size of `edge-size`: an image does not tell the width, and such a feature counts as its mean."""
    edge = cast(PadEdge, fitted.field)
    bumps, pairs = edge.bumps, edge.pairs
    corners = (
        f"for (uint32_t k = 0; k < {pairs}; k++)",
        f"    log_gain += b[{2 * bumps} + k] * skin_bspline(rim[0] - (float)k) * skin_bspline(rim[1] - (float)k);",
    )
    body = _walls(edge, 2 * bumps + pairs, "log2f(1.0f + sqrtf({}) / {})", corners if pairs else ())
    return FieldInC(_edge_formula(edge), _by_pad(fitted, 2 * bumps + pairs), body, _edge_operations(fitted, 24 * bumps))


def _edge_spline(fitted: FittedField) -> FieldInC:
    """Products of principal functions of two distances become those of all pairs of bumps."""
    edge = cast(PadEdgeSpline, fitted.field)
    bumps, pairs, functions = edge.bumps, edge.pairs, edge.principal()
    paired = functions[:, :pairs]
    sizes = [bumps, bumps, pairs**2, pairs**2]
    *parts, level = np.split(_by_pad(fitted, sum(sizes)), np.cumsum(sizes), 1)
    single = [part @ functions.T for part in parts[:2]]
    double = [
        np.einsum("bi,pij,cj->pbc", paired, part.reshape(-1, pairs, pairs), paired).reshape(len(part), -1)
        for part in (parts[2:] if pairs else ())
    ]
    coefficients = np.hstack([*single, *double, level])
    corners = (
        f"for (uint32_t k = 0; k < {bumps}; k++)",
        f"    for (uint32_t m = 0; m < {bumps}; m++) {{",
        f"        const float *both = b + {2 * bumps} + {bumps} * k + m;",
        "        log_gain += both[0] * skin_bspline(rim[0] - (float)k) * skin_bspline(rim[1] - (float)m);",
        f"        log_gain += both[{bumps**2}] * skin_bspline(own[0] - (float)k) * skin_bspline(own[1] - (float)m);",
        "    }",
    )
    place = f"1.0f + {_literal(KNOTS_PER_OCTAVE)} * log2f(1.0f + sqrtf({{}}) / {{}})"
    body = _walls(edge, coefficients.shape[1] - 1, place, corners if pairs else ())
    return FieldInC(_edge_formula(edge), coefficients, body, _edge_operations(fitted, 24 * bumps + 36 * bumps**2))


def _edge_formula(edge: PadEdge) -> str:
    return f"B-splines of the distance to the sides of the pad and to the rim, over octaves of {float(edge.width):g} m"


def _edge_operations(fitted: FittedField, corners: int) -> int:
    bumps = cast(PadEdge, fitted.field).bumps
    return (15 + 8 * bumps) * fitted.geometry.start.shape[1] + 15 * len(fitted.geometry.rim) + corners


def _walls(edge: PadEdge, level: int, place: str, corners: tuple[str, ...]) -> tuple[str, ...]:
    """The log of the gain in C: of bumps of the distances to all sides of the pad and to the rim, and `corners`.

    Args:
        level: number of the coefficient of the level.
        place: number of the bump at a distance, from its square and the width of the field.
        corners: statements with the numbers ``own`` and ``rim`` of the two nearest sides of the pad and of the rim.
    """
    bumps, width = edge.bumps, _literal(float(edge.width))
    nearest = (
        "    {0}[1] = fminf({0}[1], fmaxf({0}[0], square));",
        "    {0}[0] = fminf({0}[0], square);",
    )
    return (
        f"float log_gain = -b[{level}], own[2] = {{INFINITY, INFINITY}}, rim[2] = {{INFINITY, INFINITY}};",
        "for (uint32_t s = 0; s < SKIN_SIDES; s++) {",
        "    const float *side = skin_side[pad][s];",
        "    const float square = skin_square(side, x, y, 0);",
        "    if (side[0] == side[2] && side[1] == side[3])",
        "        continue;",
        *(line.format("own") for line in nearest),
        f"    for (uint32_t k = 0; k < {bumps}; k++)",
        f"        log_gain += b[k] * skin_bspline({place.format('square', width)} - (float)k);",
        "}",
        "for (uint32_t s = 0; s < SKIN_RIM; s++) {",
        "    const float square = skin_square(skin_rim[s], x, y, 0);",
        *(line.format("rim") for line in nearest),
        "}",
        "for (uint32_t i = 0; i < 2; i++) {",
        f"    own[i] = {place.format('own[i]', width)};",
        f"    rim[i] = {place.format('rim[i]', width)};",
        "}",
        f"for (uint32_t k = 0; k < {bumps}; k++)",
        f"    log_gain += b[{bumps} + k] * skin_bspline(rim[0] - (float)k);",
        *corners,
        "return log_gain;",
    )


def _product(formula: str, one: str, statements: Statements = lambda fitted: ()) -> Callable[[FittedField], FieldInC]:
    """A field of products of one function along each axis.

    Args:
        one: expression in C for function ``i`` at the coordinate ``u``, -1 to 1 over the pad.
        statements: what stands before it, from the field.
    """

    def field_in_c(fitted: FittedField) -> FieldInC:
        total = fitted.field.shapes().shape[1]
        count = round(total**0.5)
        body = (
            f"float along[2][{count}], log_gain = -b[{total}];",
            "for (uint32_t axis = 0; axis < 2; axis++) {",
            "    const float u = (2.0f * (axis ? y : x) - skin_box[pad][axis]) / skin_box[pad][2 + axis];",
            f"    for (uint32_t i = 0; i < {count}; i++) {{",
            *(f"        {line}" for line in statements(fitted)),
            f"        along[axis][i] = {one};",
            "    }",
            "}",
            f"for (uint32_t i = 0; i < {count}; i++)",
            f"    for (uint32_t j = 0; j < {count}; j++)",
            f"        log_gain += b[{count} * i + j] * along[0][i] * along[1][j];",
            "return log_gain;",
        )
        return FieldInC(f"{count} x {count} {formula}", _by_pad(fitted, total), body, 2 * total + 20 * count)

    return field_in_c


def _nodes(beside: int) -> Statements:
    """The distance ``z`` in pitches from node ``i`` of a grid over the pad with so many nodes beside it."""

    def statements(fitted: FittedField) -> tuple[str, ...]:
        intervals = round(fitted.field.shapes().shape[1] ** 0.5) - 1 - 2 * beside
        return (f"const float z = (u + 1.0f) * {_literal(intervals / 2)} - (float)i + {beside}.0f;",)

    return statements


_HALF, _STEP, _SCALE = BOX_HALF_WIDTH, np.pi / (2 * BOX_HALF_WIDTH), BOX_HALF_WIDTH**-0.5

FORMULAS: dict[str, Callable[[FittedField], FieldInC]] = {
    "constant": _constant,
    "edge": _edge,
    "edge-size": _edge,
    "edge-spline": _edge_spline,
    "bilinear": _product("nodes over the pad, bilinear", "fmaxf(1.0f - fabsf(z), 0.0f)", _nodes(0)),
    "rbf": _product("Gaussian bumps over the pad", "expf(-0.5f * z * z)", _nodes(0)),
    "spline": _product("cubic B-splines over the pad", "skin_bspline(z)", _nodes(1)),
    "gp": _product(
        "sine waves over the pad",
        f"sinf((u + {_literal(_HALF)}) * (float)(i + 1) * {_literal(_STEP)}) * {_literal(_SCALE)}",
    ),
}


def _by_pad(fitted: FittedField, count: int) -> np.ndarray:
    """The first so many coefficients of each pad, and the level that its presses take off: (pads, count + 1)."""
    pads, shared = fitted.geometry.pads, fitted.field.shared
    used = count if shared else pads * count
    coefficients = np.asarray(fitted.coefficients, float)[:used]
    level = np.asarray(fitted.centre, float)[:, :used] @ coefficients
    return np.column_stack([np.broadcast_to(coefficients.reshape(-1, count), (pads, count)), level])
