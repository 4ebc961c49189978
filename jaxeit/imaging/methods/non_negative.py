"""Images that are nowhere negative."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._compile import sequential_on_cpu
from ...linalg.lapack import cho_factor, cho_solve
from ..priors import Diagonal
from .base import AbstractIterativeMethod, Problem

# Where Newton's method for `NonNegative` stands: steps, what is left of the data (k,), the pixels above zero (basis,)
# now and before, length of the last step.
_NewtonState = tuple[
    Int[Array, ""] | int, Float[Array, " k"], Bool[Array, " basis"], Bool[Array, " basis"], Float[Array, ""]
]


class NonNegative(AbstractIterativeMethod):
    """`OneStep` under the constraint x >= 0: a touch only adds conductivity.

    With a diagonal prior by Newton's method in the data space: what is left of the data, ``a = y - J x``, is the
    minimum of ``|a|^2 / 2 - y a + sum (J^T a)_+^2 / (2 l^2 R)``, and ``x = (J^T a)_+ / (l^2 R)``; pieces of a parabola,
    so that it ends exactly, after 5 to 20 steps at hyperparameters from 0.1, of which all but the first are cheap.
    Where it has not ended, below about 0.03, and with another prior throughout, by a primal-dual interior-point method
    (Nocedal and Wright 2006, section 16.6), each of whose steps divides the duality gap by about ten, whatever the
    hyperparameter.

    ``steps`` is the most of the former and the number of the latter.
    """

    steps: int = eqx.field(static=True, default=40)

    def image(self, problem: Problem, y: Float[Array, " k"]) -> Float[Array, " basis"]:
        j, precision = problem.jacobian, problem.precision()
        square = problem.strength(precision.solve(j.T))
        if isinstance(precision, Diagonal):
            weight = square * precision.values
            above = _pixels_above_zero(self.steps)(*jax.lax.stop_gradient((j, weight, y)))
            return _positive_part(above, j, weight, y)
        return _interior(j.T @ j + square * precision.matrix(), j.T @ y, self.steps)[0]


def _positive_part(
    above: Bool[Array, " basis"], j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]
) -> Float[Array, " basis"]:
    """argmin of ``|J x - y|^2 + x^T diag(weight) x`` over these pixels, the others zero, without what is negative."""
    return jnp.maximum(j.T @ _left_by_many(above, j, weight, y) / weight, 0) * above


def _pixels_above_zero(steps: int) -> Callable[[Array, Array, Array], Array]:
    """A function of j, weight, y: the pixels above zero in argmin over x >= 0 of ``|J x - y|^2 + x^T diag(weight) x``.

    Of many frames one after the other, so that each pays only for the way it takes.
    """

    @sequential_on_cpu
    def found(
        j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]
    ) -> Bool[Array, " basis"]:
        def going(state: _NewtonState) -> Bool[Array, ""]:
            step, _, above, before, length = state
            return (step < steps) & _moves(above, before, length)

        def again(state: _NewtonState) -> _NewtonState:
            step, a, above, *_ = state
            towards = _left(above, j, weight, y) - a
            length = _step_length(a, towards, y, j.T @ a, j.T @ towards, weight)
            a = a + length * towards
            return step + 1, a, j.T @ a > 0, above, length

        everywhere, none = jnp.ones(j.shape[1], bool), jnp.zeros(j.shape[1], bool)
        start: _NewtonState = (0, jnp.zeros_like(y), everywhere, none, jnp.ones((), y.dtype))
        _, _, above, before, length = jax.lax.while_loop(going, again, start)
        otherwise = partial(_by_interior, steps=steps)
        pixels: Array = jax.lax.cond(_moves(above, before, length), otherwise, lambda *_: above, j, weight, y)
        return pixels

    return found


def _moves(above: Bool[Array, " basis"], before: Bool[Array, " basis"], length: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether Newton's method has not ended: a whole step to the same pixels is the last."""
    return (length < 1) | jnp.any(above != before)


def _by_interior(
    j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"], steps: int
) -> Bool[Array, " basis"]:
    """The same pixels by the interior-point method."""
    j, weight = jax.lax.optimization_barrier((j, weight))  # XLA takes minutes to multiply constants
    return _interior(j.T @ j + jnp.diag(weight), j.T @ y, steps)[1]


def _interior(
    hessian: Float[Array, "basis basis"], b: Float[Array, " basis"], steps: int
) -> tuple[Float[Array, " basis"], Bool[Array, " basis"]]:
    """argmin over x >= 0 of ``x^T H x / 2 - b x``, and where it is above zero."""
    top, curved = jnp.max(jnp.abs(b)), jnp.mean(jnp.diagonal(hessian))
    top = jnp.where(top > 0, top, 1)  # all below is of the size of one, whatever the units
    start = jnp.ones_like(b), jnp.ones_like(b)
    x, z = jax.lax.fori_loop(0, steps, lambda _, state: _inwards(hessian / curved, b / top, *state), start)
    return x * (top / curved), x > z


def _left(
    above: Bool[Array, " basis"], j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]
) -> Float[Array, " k"]:
    """``y - J x`` if x were free in these pixels and zero elsewhere; solved among the pixels if they are few."""
    size = min(len(above), len(j) // 2)

    def few(j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]) -> Float[Array, " k"]:
        at, there = jnp.flatnonzero(above, size=size, fill_value=0), jnp.arange(size) < jnp.sum(above)
        part = jnp.where(there, j[:, at], 0)
        small = part.T @ part + jnp.diag(jnp.where(there, weight[at], 1))
        return y - part @ cho_solve(cho_factor(small), part.T @ y)

    many = partial(_left_by_many, above)
    left: Array = jax.lax.cond(jnp.sum(above) <= size, few, many, j, weight, y)
    return left


def _left_by_many(
    above: Bool[Array, " basis"], j: Float[Array, "k basis"], weight: Float[Array, " basis"], y: Float[Array, " k"]
) -> Float[Array, " k"]:
    """`_left` among the data."""
    return cho_solve(cho_factor(jnp.eye(len(j), dtype=j.dtype) + (j * (above / weight)) @ j.T), y)


def _step_length(
    a: Float[Array, " k"],
    towards: Float[Array, " k"],
    y: Float[Array, " k"],
    here: Float[Array, " basis"],
    ahead: Float[Array, " basis"],
    weight: Float[Array, " basis"],
) -> Float[Array, ""]:
    """The best of 1, 1/2, 1/4 ... of a step, for the function of `NonNegative`."""
    length = 0.5 ** jnp.arange(12, dtype=a.dtype)
    moved = a + length[:, None] * towards
    image = jnp.maximum(here + length[:, None] * ahead, 0)
    return length[jnp.argmin(0.5 * jnp.sum(moved**2, 1) - moved @ y + 0.5 * jnp.sum(image**2 / weight, 1))]


def _inwards(
    hessian: Float[Array, "basis basis"],
    b: Float[Array, " basis"],
    x: Float[Array, " basis"],
    z: Float[Array, " basis"],
) -> tuple[Float[Array, " basis"], Float[Array, " basis"]]:
    """One step towards ``H x - b = z``, ``x z = 0``, staying inside x, z > 0."""
    target = jnp.maximum(0.1 * jnp.mean(x * z), jnp.finfo(x.dtype).eps ** 2)  # to zero, z / x would lose its sense
    dx = cho_solve(cho_factor(hessian + jnp.diag(z / x)), b - hessian @ x + target / x)
    dz = (target - z * dx) / x - z
    x_step, z_step = (jnp.min(jnp.where(d < 0, -0.99 * v / jnp.where(d < 0, d, 1), 1)) for v, d in ((x, dx), (z, dz)))
    return x + jnp.minimum(x_step, 1) * dx, z + jnp.minimum(z_step, 1) * dz
