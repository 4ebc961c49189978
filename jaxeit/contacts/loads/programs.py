"""The compiled programs of the fit of loads: whitened readings, slopes, and bounded Gauss-Newton steps."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from ..._compile import verb
from ...imaging.noise import Whitening
from ...least_squares import ImplicitStep, normal_equations
from ...least_squares.searches import HalfSquares
from ...linalg import lapack
from ..fit import SOLVER
from .belief import LoadBelief
from .pressure import LOAD_PARAMETERS, MAX_LOADS, Form, Forms, Parameters
from .sheet import PressedSheet, Unknowns

STEPS = 16  # of a fit at most


class Problem(NamedTuple):
    """A frame (r,) that loads of some forms are to explain, up to errors of covariance `root` `root`'."""

    belief: LoadBelief
    y: Float[Array, " r"]
    forms: Forms
    root: Float[Array, "r r"]


@verb
def white(whitening: Whitening, compress: Float[Array, "r k"], dv: Float[Array, " readings"]) -> Float[Array, " r"]:
    return compress @ whitening.sums(dv)


@verb
def unknowns_of(sheet: PressedSheet, loads: Parameters, forms: Forms) -> Unknowns:
    return sheet.unknowns(loads, forms)


@verb
def fit_loads(
    problem: Problem, start: Parameters, bounds: tuple[Parameters, Parameters], fall: Float[Array, ""]
) -> tuple[Parameters, Float[Array, ""], Float[Array, "m m"]]:
    """Loads, square and normal matrix; see `Fit`."""
    found: optx.Solution[Array, Any] = optx.least_squares(
        _residual,
        replace(SOLVER, fall_rtol=0.0, fall_atol=fall),
        start.ravel(),
        problem,
        {"lower": bounds[0].ravel(), "upper": bounds[1].ravel(), "quadratic": _quadratic},
        max_steps=STEPS,
        adjoint=ImplicitStep(),
        throw=False,
    )
    return found.value.reshape(start.shape), found.state.square, found.state.quadratic.hessian.matrix


@verb
def before(problem: Problem, loads: Parameters) -> tuple[Float[Array, " s"], Float[Array, "s m"]]:
    """What is unusual of loads, and its slopes in their parameters; see `unusual`."""
    return unusual(loads.ravel(), problem), jax.jacfwd(unusual)(loads.ravel(), problem)


def _residual(flat: Float[Array, " m"], problem: Problem) -> Float[Array, " n"]:
    left = problem.y - problem.belief.sheet.response(flat.reshape(MAX_LOADS, LOAD_PARAMETERS), problem.forms)
    return jnp.append(lapack.solve_triangular(problem.root, left, lower=True), unusual(flat, problem))


def _quadratic(flat: Float[Array, " m"], problem: Problem) -> HalfSquares:
    """The sum of squares near some loads; the sheet knows its slopes."""
    sheet, loads = problem.belief.sheet, flat.reshape(MAX_LOADS, LOAD_PARAMETERS)
    at = sheet.linearised(loads, problem.forms)
    both = jnp.concatenate([(problem.y - at.value)[:, None], -sheet.slopes(at, loads, problem.forms)], 1)
    both = lapack.solve_triangular(problem.root, both, lower=True)
    surprise, by_loads = before(problem, loads)
    return normal_equations(jnp.append(both[:, 0], surprise), jnp.concatenate([both[:, 1:], by_loads]))


def unusual(flat: Float[Array, " m"], problem: Problem) -> Float[Array, " s"]:
    """What is unusual of loads, in standard deviations.

    Log width and log force, of the first load and of the others less those of the first; half lengths of an edge.
    """
    belief, loads = problem.belief, flat.reshape(MAX_LOADS, LOAD_PARAMETERS)
    there = problem.forms[:, None] > Form.ABSENT
    first = (loads[0, 2:4] - belief.usual) / belief.spread
    others = jnp.where(there, (loads[:, 2:4] - loads[0, 2:4]) / belief.difference, 0)[1:]
    length = jnp.where(problem.forms[:, None] == Form.LONG, loads[:, 4:] / belief.length, 0)
    return jnp.concatenate([first, others.ravel(), length.ravel()])
