"""Readings of a scene at one fidelity, untouched and touched, and their extrapolation to the reference.

Richardson's extrapolation from two meshes of quadratic elements in float64.  Its order is three for the readings of a
uniform sheet (quadratic elements, polygons for discs) and two for the difference that a touch makes, since the
conductivity is constant on each element.  The uncertainty of both is the distance by which an extrapolation of order
two moves the finer solution (Roache 1994).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model.discretisation import Model, discretise
from ..model.fidelity import Fidelity
from ..model.forward_model import forward
from ..model.scene import Scene
from ..model.sheet_conductivity import CoatedSheet, conductivity
from .recommendation import Reference
from .settings import Touch
from .timing import Program, clocked, compiled

# Degree-5 quadrature on the triangle (Strang and Fix): barycentric points and weights.
_A, _B = (6 + np.sqrt(15)) / 21, (6 - np.sqrt(15)) / 21
QUADRATURE_POINTS = np.array(
    [[1 / 3] * 3]
    + [np.roll([1 - 2 * _A, _A, _A], k) for k in range(3)]
    + [np.roll([1 - 2 * _B, _B, _B], k) for k in range(3)]
)
QUADRATURE_WEIGHTS = np.array([9 / 40] + 3 * [(155 + np.sqrt(15)) / 1200] + 3 * [(155 - np.sqrt(15)) / 1200])


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of one scene at one fidelity.

    | meaning                                          | shape               | unit |
    |--------------------------------------------------|---------------------|------|
    | fidelity, unknowns of its linear system          |                     |      |
    | voltages of the untouched sheet                  | (readings,)         | V    |
    | differences that each touch makes                | (touches, readings) | V    |
    """

    fidelity: Fidelity
    unknowns: int
    voltages: Float[np.ndarray, " readings"]
    differences: Float[np.ndarray, "touches readings"]


@dataclass(frozen=True, eq=False)
class Solution:
    """A model of the scene with its conductivities, its readings, and the compiled program that gave them."""

    model: Model
    setup: float
    program: Program
    untouched: Array
    touched: tuple[Array | CoatedSheet, ...]
    readings: Readings


def solved(scene: Scene, fidelity: Fidelity, touches: Sequence[Touch]) -> Solution:
    """Discretise the scene and solve it untouched and for each touch."""
    setup, model = clocked(lambda: jax.block_until_ready(discretise(scene, fidelity)))
    untouched = conductivity(model)
    sheets = tuple(touched(model, untouched, touch) for touch in touches)
    program = compiled(forward, model, sheets[0])
    # The touched sheets are then `CoatedSheet`s and the untouched one an array, which needs a program of its own.
    coated = isinstance(sheets[0], CoatedSheet)
    v0 = np.asarray(forward(model, untouched) if coated else program.run(untouched))
    dv = np.stack([np.asarray(program.run(sigma)) for sigma in sheets]) - v0
    return Solution(model, setup, program, untouched, sheets, Readings(fidelity, model.system.unknowns, v0, dv))


def touched(model: Model, untouched: Array, touch: Touch) -> Array | CoatedSheet:
    """Conductivity of the touched sheet: by the scene's response to pressure, or raised directly without one."""
    shape = bump(model, touch)
    pressed = conductivity(model, jnp.asarray(touch.pressure * shape, model.dtype))
    if isinstance(pressed, CoatedSheet) or bool(jnp.any(pressed != untouched)):
        return pressed
    return untouched * jnp.asarray(1 + touch.rise * shape, model.dtype)


def bump(model: Model, touch: Touch) -> Float[np.ndarray, " elements"]:
    """Means over the elements of the touch's bump of height one, equal on all meshes up to fourth order."""
    corners = np.asarray(model.chart, np.float64)[np.asarray(model.triangles)]
    places = np.einsum("qc,ecd->eqd", QUADRATURE_POINTS, corners)
    return np.asarray(gaussian(places, touch) @ QUADRATURE_WEIGHTS)


def gaussian(places: Float[np.ndarray, "... 2"], touch: Touch) -> Float[np.ndarray, "..."]:
    """The touch's bump of height one at places in the sheet's flat coordinates, m."""
    square = np.sum((places - np.asarray(touch.position)) ** 2, -1)
    return np.asarray(np.exp(-0.5 * square / touch.width**2))


def extrapolated(coarse: Readings, fine: Readings) -> Reference:
    """Richardson's extrapolation of the readings at two fidelities of one family."""
    ratio = coarse.fidelity.edge_length / fine.fidelity.edge_length
    voltages = _limit(coarse.voltages, fine.voltages, ratio**3)
    differences = _limit(coarse.differences, fine.differences, ratio**2)
    cautious = _limit(coarse.voltages, fine.voltages, ratio**2)
    return Reference(
        fidelities=(coarse.fidelity, fine.fidelity),
        unknowns=(coarse.unknowns, fine.unknowns),
        voltages=voltages,
        differences=differences,
        voltage_uncertainty=relative_error(fine.voltages, cautious),
        difference_uncertainty=relative_error(fine.differences, differences),
    )


def _limit(coarse: Float[np.ndarray, "..."], fine: Float[np.ndarray, "..."], fall: float) -> Float[np.ndarray, "..."]:
    """The value at zero error, for an error that falls by the factor ``fall`` from coarse to fine."""
    return np.asarray(fine + (fine - coarse) / (fall - 1))


def relative_error(found: Float[np.ndarray, "..."], wanted: Float[np.ndarray, "..."]) -> float:
    """Root of the sum of squared errors, over the root of the sum of squared wanted values."""
    return float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted))
