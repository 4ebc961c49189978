"""The compiled programs of the fit of loads: whitened readings, slopes, and bounded Gauss-Newton steps."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from ...._compile import verb
from ....imaging.readings.whitening import Whitening
from ....least_squares import ImplicitStep, normal_equations
from ....least_squares.searches import HalfSquares
from ....linalg import lapack
from ...fit import SOLVER
from ..belief import LoadBelief
from ..pressure import LOAD_PARAMETERS, MAX_LOADS, Forms, LoadForm, Parameters
from ..sheet import PressedSheet, Sensitivities

MAX_STEPS = 16  # of a fit at most


class LoadProblem(NamedTuple):
    """A frame (r,) that loads of some forms are to explain, up to errors of covariance `root` `root`'."""

    belief: LoadBelief
    y: Float[Array, " r"]
    forms: Forms
    root: Float[Array, "r r"]


@verb
def whiten_frame(
    whitening: Whitening, compress: Float[Array, "r k"], dv: Float[Array, " readings"]
) -> Float[Array, " r"]:
    return compress @ whitening.sums(dv)


@verb
def sensitivities_of(sheet: PressedSheet, loads: Parameters, forms: Forms) -> Sensitivities:
    return sheet.sensitivities(loads, forms)


@verb
def fit_loads(
    problem: LoadProblem, start: Parameters, bounds: tuple[Parameters, Parameters], fall_atol: Float[Array, ""]
) -> tuple[Parameters, Float[Array, ""], Float[Array, "m m"]]:
    """Loads, square and normal matrix; see `Fit`."""
    found: optx.Solution[Array, Any] = optx.least_squares(
        _residual,
        replace(SOLVER, fall_rtol=0.0, fall_atol=fall_atol),
        start.ravel(),
        problem,
        {"lower": bounds[0].ravel(), "upper": bounds[1].ravel(), "quadratic": _quadratic},
        max_steps=MAX_STEPS,
        adjoint=ImplicitStep(),
        throw=False,
    )
    return found.value.reshape(start.shape), found.state.square, found.state.quadratic.hessian.matrix


@verb
def linearise_prior(problem: LoadProblem, loads: Parameters) -> tuple[Float[Array, " s"], Float[Array, "s m"]]:
    """`prior_residual` of loads, and its slopes in their parameters."""
    return prior_residual(loads.ravel(), problem), jax.jacfwd(prior_residual)(loads.ravel(), problem)


def _residual(flat: Float[Array, " m"], problem: LoadProblem) -> Float[Array, " n"]:
    residual = problem.y - problem.belief.sheet.response(flat.reshape(MAX_LOADS, LOAD_PARAMETERS), problem.forms)
    return jnp.append(lapack.solve_triangular(problem.root, residual, lower=True), prior_residual(flat, problem))


def _quadratic(flat: Float[Array, " m"], problem: LoadProblem) -> HalfSquares:
    """The sum of squares near some loads; the sheet knows its slopes."""
    sheet, loads = problem.belief.sheet, flat.reshape(MAX_LOADS, LOAD_PARAMETERS)
    at = sheet.linearise(loads, problem.forms)
    columns = jnp.concatenate([(problem.y - at.value)[:, None], -sheet.slopes(at, loads, problem.forms)], 1)
    columns = lapack.solve_triangular(problem.root, columns, lower=True)
    residual, slopes = linearise_prior(problem, loads)
    return normal_equations(jnp.append(columns[:, 0], residual), jnp.concatenate([columns[:, 1:], slopes]))


def prior_residual(flat: Float[Array, " m"], problem: LoadProblem) -> Float[Array, " s"]:
    """Difference of loads from what is usual, in standard deviations.

    Log width and log force, of the first load and of the others less those of the first; half lengths of an edge.
    """
    belief, loads = problem.belief, flat.reshape(MAX_LOADS, LOAD_PARAMETERS)
    present = problem.forms[:, None] > LoadForm.ABSENT
    first = (loads[0, 2:4] - belief.prior_mean) / belief.prior_std
    others = jnp.where(present, (loads[:, 2:4] - loads[0, 2:4]) / belief.difference_std, 0)[1:]
    half_lengths = jnp.where(problem.forms[:, None] == LoadForm.LONG, loads[:, 4:] / belief.length_std, 0)
    return jnp.concatenate([first, others.ravel(), half_lengths.ravel()])
