"""The compiled programs of the fit of loads: whitened readings, slopes, and bounded Gauss-Newton steps."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from ..._compile import verb
from ...least_squares import ImplicitStep, normal_equations
from ...least_squares.searches import HalfSquares
from ...linalg import lapack
from ..fit import SOLVER
from .pressure import LOAD_PARAMETERS, MAX_LOADS, Form, Forms, Parameters
from .sheet import Unknowns

if TYPE_CHECKING:
    from .fitter import LoadFitter

STEPS = 16  # of a fit at most


class Problem(NamedTuple):
    """A frame (r,) that loads of some forms are to explain, up to errors of covariance `root` `root`'."""

    fitter: "LoadFitter"
    y: Float[Array, " r"]
    forms: Forms
    root: Float[Array, "r r"]


@verb
def white(fitter: "LoadFitter", dv: Float[Array, " readings"]) -> Float[Array, " r"]:
    return fitter.compress @ fitter.whitening.sums(dv)


@verb
def unknowns_of(fitter: "LoadFitter", loads: Parameters, forms: Forms) -> Unknowns:
    return fitter.sheet.unknowns(loads, forms)


@verb
def fit_loads(
    fitter: "LoadFitter",
    y: Float[Array, " r"],
    start: Parameters,
    forms: Forms,
    root: Float[Array, "r r"],
    bounds: tuple[Parameters, Parameters],
    fall: Float[Array, ""],
) -> tuple[Parameters, Float[Array, ""], Float[Array, "m m"]]:
    """Loads, square and normal matrix; see `Fit`."""
    problem = Problem(fitter, y, forms, root)
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
    left = problem.y - problem.fitter.sheet.response(flat.reshape(MAX_LOADS, LOAD_PARAMETERS), problem.forms)
    return jnp.append(lapack.solve_triangular(problem.root, left, lower=True), unusual(flat, problem))


def _quadratic(flat: Float[Array, " m"], problem: Problem) -> HalfSquares:
    """The sum of squares near some loads; the sheet knows its slopes."""
    sheet, loads = problem.fitter.sheet, flat.reshape(MAX_LOADS, LOAD_PARAMETERS)
    at = sheet.linearised(loads, problem.forms)
    both = jnp.concatenate([(problem.y - at.value)[:, None], -sheet.slopes(at, loads, problem.forms)], 1)
    both = lapack.solve_triangular(problem.root, both, lower=True)
    surprise, by_loads = before(problem, loads)
    return normal_equations(jnp.append(both[:, 0], surprise), jnp.concatenate([both[:, 1:], by_loads]))


def unusual(flat: Float[Array, " m"], problem: Problem) -> Float[Array, " s"]:
    """What is unusual of loads, in standard deviations.

    Log width and log force, of the first load and of the others less those of the first; half lengths of an edge.
    """
    fitter, loads = problem.fitter, flat.reshape(MAX_LOADS, LOAD_PARAMETERS)
    there = problem.forms[:, None] > Form.ABSENT
    first = (loads[0, 2:4] - fitter.usual) / fitter.spread
    others = jnp.where(there, (loads[:, 2:4] - loads[0, 2:4]) / fitter.difference, 0)[1:]
    length = jnp.where(problem.forms[:, None] == Form.LONG, loads[:, 4:] / fitter.length, 0)
    return jnp.concatenate([first, others.ravel(), length.ravel()])
