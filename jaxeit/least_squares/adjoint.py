"""Derivatives of a least-squares solution, by the implicit function theorem."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Int

from .._compile import full_precision
from .levenberg_marquardt import quadratic_at
from .searches import Parameters, Scalar, free_parameters, normal_inverse

# Conjugate gradients at most; with the normal matrix as preconditioner five to twenty suffice.
MAX_ITERATIONS = 100
BOUNDS = {"lower": -jnp.inf, "upper": jnp.inf}

# Where conjugate gradients stand: solution, residual, direction, square of the residual as preconditioned, steps.
Gradients = tuple[Parameters, Parameters, Parameters, Scalar, Int[Array, ""] | int]


class ImplicitStep(optx.AbstractAdjoint):
    """Derivatives of a solution that is at rest: ``dx = -H^-1 d(gradient)``, H the second derivative of the objective.

    As `optimistix.ImplicitAdjoint`, but H, of some hundreds of parameters, is never formed: the linear system is solved
    by conjugate gradients, preconditioned by the normal matrix. Parameters that rest on their bounds stay there.
    """

    def apply(
        self, primal_fn: Callable[..., Any], rewrite_fn: Callable[..., Any], inputs: Any, tags: frozenset[object]
    ) -> tuple[Parameters, Any]:
        """See `optimistix.AbstractAdjoint`."""
        loop = partial(eqxi.while_loop, kind="lax")
        root, rest = primal_fn((*_without_derivatives(inputs), loop))
        return _attached(root, rewrite_fn, inputs), _without_derivatives(rest)


def _without_derivatives(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, tree)


@eqx.filter_custom_jvp
def _attached(root: Parameters, gradient_of: Callable[..., Parameters], inputs: Any) -> Parameters:
    """The root, whose derivatives are those of a point where the gradient vanishes."""
    return root


@full_precision
def _attached_jvp(
    primals: tuple[Parameters, Callable[..., Parameters], Any], tangents: tuple[Any, Any, Any]
) -> tuple[Parameters, Parameters]:
    root, gradient_of, inputs = primals
    root = _attached(root, gradient_of, inputs)
    unmoved = jax.tree.map(lambda tangent: tangent is None, tangents[2], is_leaf=lambda leaf: leaf is None)
    still, moving = eqx.partition(inputs, unmoved)
    along = jax.jvp(lambda moving: gradient_of(root, None, eqx.combine(moving, still)), (moving,), (tangents[2],))[1]
    return root, -_inverse_hessian(gradient_of, root, inputs, along)


_attached.def_jvp(_attached_jvp)


def _inverse_hessian(
    gradient_of: Callable[..., Parameters], root: Parameters, inputs: Any, right: Parameters
) -> Parameters:
    """``H^-1 right`` among the parameters that are free, zero for the others."""
    fn, _, _, args, options, *_ = inputs
    near = quadratic_at(fn, root, args, options)[0]
    low, high = (jnp.broadcast_to(options.get(side, bound), root.shape) for side, bound in BOUNDS.items())
    free = free_parameters(root, near.grad, low, high)
    times = jax.linearize(lambda at: gradient_of(at, None, inputs), root)[1]
    near_inverse = normal_inverse(near.hessian.matrix, free)
    return conjugate_gradients(
        lambda v: jnp.where(free, times(jnp.where(free, v, 0)), v),
        jnp.where(free, right, 0),
        lambda v: jnp.where(free, near_inverse(v), v),
    )


def conjugate_gradients(
    times: Callable[[Parameters], Parameters], right: Parameters, near_inverse: Callable[[Parameters], Parameters]
) -> Parameters:
    """x with ``times(x) = right`` for a positive definite ``times``, of which ``near_inverse`` is about the inverse.

    NaN where `MAX_ITERATIONS` leave a residual that is not small: a derivative that is wrong must not be handed out.
    Has derivatives in both directions, as `jax.scipy.sparse.linalg.cg` in a compiled function has not.
    """
    eps = float(jnp.finfo(right.dtype).eps)
    tolerance, tolerable = eps**1.5, eps**0.5  # of the square of the residual, as ``near_inverse`` measures it

    def solve(times: Callable[[Parameters], Parameters], right: Parameters) -> Parameters:
        def unfinished(state: Gradients) -> Bool[Array, ""]:
            _, _, _, square, step = state
            going: Bool[Array, ""] = (square > tolerance * first) & (step < MAX_ITERATIONS)
            return going

        def again(state: Gradients) -> Gradients:
            x, left, along, square, step = state
            seen = times(along)
            length = square / (along @ seen)
            x, left = x + length * along, left - length * seen
            preconditioned = near_inverse(left)
            new = left @ preconditioned
            return x, left, preconditioned + new / square * along, new, step + 1

        start = near_inverse(right)
        first = right @ start
        begin: Gradients = (jnp.zeros_like(right), right, start, first, 0)
        x, _, _, square, _ = jax.lax.while_loop(unfinished, again, begin)
        return jnp.where(square <= tolerable * first, x, jnp.nan)

    found: Parameters = jax.lax.custom_linear_solve(times, right, solve, symmetric=True, transpose_solve=solve)
    return found
