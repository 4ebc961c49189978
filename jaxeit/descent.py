"""Least squares for a few parameters within bounds, in fixed shapes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .lapack import cho_factor, cho_solve

_ENOUGH = 1e-3  # fall of the square, in units of the noise, that is not worth another step
STEPS = 20  # at most
TRIAL = 4  # steps after which a descent must have shown that it leads somewhere


class Fit(NamedTuple):
    """Parameters fitted.

    | meaning                                        | shape  |
    |------------------------------------------------|--------|
    | flat: all parameters                           | (m,)   |
    | square: what is left of ``|y|^2``              | ()     |
    | normal: J^T J                                  | (m, m) |
    | downhill: J^T times what is left               | (m,)   |
    | damping                                        | ()     |
    | promised: the fall expected of the last step   | ()     |
    | steps taken                                    | ()     |
    | done: the last step promised next to nothing   | ()     |
    """

    flat: Float[Array, " m"]
    square: Float[Array, ""]
    normal: Float[Array, "m m"]
    downhill: Float[Array, " m"]
    damping: Float[Array, ""]
    promised: Float[Array, ""]
    steps: Int[Array, ""]
    done: Bool[Array, ""]


def scale_of(squares):
    """One over the root of the normal matrix's diagonal, which vanishes where the strength does."""
    return jax.lax.rsqrt(jnp.maximum(squares, 1e-12 * jnp.max(squares) + 1e-30))


def ridge(like):
    """What keeps a Cholesky factor of a normal matrix of unit diagonal from failing, in the precision of ``like``."""
    return 1e3 * jnp.finfo(like.dtype).eps


def descend(linear, y, flat, low, high, hope=jnp.inf, steps=STEPS) -> Fit:
    """Levenberg-Marquardt within the bounds; a parameter pushed against its bound rests there.

    Args:
        linear: parameters to readings and their slopes.
        hope: given up when the square is still above this after a few steps.
        steps: at most.
    """
    return resume(linear, y, begun(linear, y, flat), low, high, hope, steps)


def resume(linear, y, fit: Fit, low, high, hope=jnp.inf, steps=STEPS, ahead=0.0) -> Fit:
    """A descent from where it was left; else as `descend`.

    Args:
        ahead: falls as the last step promised that may still bring the square below ``hope``.
    """

    def going(fit):
        hoped = (fit.steps < TRIAL) | (fit.square - ahead * fit.promised < hope)
        return (fit.steps < steps) & ~fit.done & hoped

    return jax.lax.while_loop(going, lambda fit: _better(linear, y, fit, low, high), fit)


def begun(linear, y, flat) -> Fit:
    """A descent without a step."""
    return _at(linear, y, flat, jnp.asarray(1e-2, y.dtype))


def _at(linear, y, flat, damping) -> Fit:
    value, j = linear(flat)
    left = y - value
    none = jnp.zeros((), y.dtype)
    return Fit(flat, left @ left, j.T @ j, j.T @ left, damping, none, jnp.asarray(0), jnp.asarray(False))


def _better(linear, y, fit: Fit, low, high) -> Fit:
    free = ~((fit.flat <= low) & (fit.downhill < 0) | (fit.flat >= high) & (fit.downhill > 0))
    step, expected = _damped(fit.normal, jnp.where(free, fit.downhill, 0), free, fit.damping)
    trial = _at(linear, y, jnp.clip(fit.flat + step, low, high), 0.2 * fit.damping)
    taken = trial.square < fit.square
    best = jax.tree.map(lambda a, b: jnp.where(taken, a, b), trial, fit._replace(damping=5 * fit.damping))
    done = fit.done | (expected < _ENOUGH + 1e-4 * fit.square)
    return best._replace(promised=expected, steps=fit.steps + 1, done=done)


def _damped(normal, downhill, free, damping):
    """One damped step of the free parameters, and the fall of the square that the linear model expects of it."""
    scale = scale_of(jnp.diagonal(normal))
    scaled = normal * scale[:, None] * scale
    small = jnp.where(free[:, None] & free, scaled, 0) + jnp.diag(jnp.where(free, damping + ridge(damping), 1))
    step = scale * cho_solve(cho_factor(small), scale * downhill)
    return step, step @ downhill
