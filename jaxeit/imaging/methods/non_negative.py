"""Images that are nowhere negative."""

from functools import partial

import jax
from jaxtyping import Array, Float

from ... import least_squares  # imported on first use, since optimistix takes a tenth of a second
from ..._compile import sequential_on_cpu
from ...registry import limited
from ..priors import Diagonal
from .base import AbstractIterativeMethod, Problem


class NonNegative(AbstractIterativeMethod):
    """`OneStep` under the constraint x >= 0: a touch only adds conductivity.

    The pixels above zero are found by `DualNewton` where the prior is diagonal: at hyperparameters from 0.1 in 5 to 20
    steps, of which all but the first are cheap. Where that has not ended, below about 0.03, and with any other prior
    they are found by `InteriorPoint`, whatever the hyperparameter. The image is then linear in these pixels.

    ``steps`` is the largest number of steps of each. Frames under `jax.vmap` are done one after the other on a CPU, so
    that each takes only the steps that it needs.
    """

    steps: int = limited(40, least=1, static=True)

    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        j, precision = problem.jacobian, problem.precision()
        square = problem.strength(precision.solve(j.T))
        if isinstance(precision, Diagonal):
            diagonal = least_squares.DiagonalProblem(j, square * precision.values, y)
            find = sequential_on_cpu(partial(least_squares.non_negative.positive_by_newton, steps=self.steps))
            return diagonal.solution(find(jax.lax.stop_gradient(diagonal)))
        dense = least_squares.DenseProblem(j.T @ j + square * precision.matrix(), j.T @ y)
        find_dense = sequential_on_cpu(partial(least_squares.non_negative.positive_by_interior_point, steps=self.steps))
        return dense.solution(find_dense(jax.lax.stop_gradient(dense)))
