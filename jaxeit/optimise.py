"""The solver that least-squares problems of a few hundred unknowns of order one are given to, an `optimistix` one."""

from collections.abc import Callable

import jax
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree

from .lapack import cho_factor, cho_solve


class TypedTrustRegion(optx.AbstractSearch):
    """`optimistix.ClassicalTrustRegion` whose step size has the type of the parameters.

    Optimistix starts it in the default type, so that nothing could be fitted in float32 with 64-bit numbers on.
    """

    inner: optx.ClassicalTrustRegion = optx.ClassicalTrustRegion()

    def init(self, y, f_info_struct):
        state = self.inner.init(y, f_info_struct)
        return jax.tree.map(lambda leaf: leaf.astype(y.dtype), state)

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        return self.inner.step(first_step, y, y_eval, f_info, f_eval_info, state)


class Cholesky(lx.Cholesky):
    """`lineax.Cholesky` of a positive operator, by our factors, which are safe under `jax.vmap`."""

    def init(self, operator, options):
        return cho_factor(operator.as_matrix())[0], None

    def compute(self, state, vector, options):
        flat, unflatten = ravel_pytree(vector)
        return unflatten(cho_solve((state[0], False), flat)), lx.RESULTS.successful, {}


def _silent(**_):
    """Print nothing."""


class LevenbergMarquardt(optx.AbstractGaussNewton):
    """Levenberg-Marquardt for `optimistix.least_squares`, where unknowns are of order one: there normal equations by
    Cholesky are safe and quick.

    Ends where a step changes unknowns and sum by less than ``atol + rtol`` of themselves.
    """

    rtol: float
    atol: float
    norm: Callable = optx.max_norm
    descent: optx.DampedNewtonDescent = optx.DampedNewtonDescent(linear_solver=lx.Normal(Cholesky()))
    search: TypedTrustRegion = TypedTrustRegion()
    verbose: Callable = _silent
