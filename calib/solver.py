"""Least squares of a robust loss within lower bounds, for the few parameters of a curve; an `optimistix` solver.

The residuals are those that `AbstractLoss.transform` made, whose squares are the loss. Gauss and Newton's matrix of
them overrates the curvature of every outlier and ends in a dozen steps what Newton's ends in a few: `options` may hold
the `curvature` to correct it with, one number per residual (Triggs et al. 2000, Bundle adjustment, 4.3).

`options` may also hold `lower` bounds: a parameter pushed against its bound rests there, and the others go on
(Bertsekas 1982, SIAM J. Control Optim. 20). And `slack`, a number that the tolerances are multiplied with.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxeit.lapack import cho_factor, cho_solve

_DAMPING = 1e-3  # at first, of the normal matrix scaled to a diagonal of one
_LEAST, _LESS, _MORE = 1e-9, 0.1, 10.0  # damping at least; its change after a step that led down, or up
_CURVED = 0.01  # of Gauss and Newton's curvature is left to a residual at least


class _State(NamedTuple):
    """Of the parameters last taken: half their gradient, downwards, and the normal matrix; and what comes next.

    | meaning                                    | shape  |
    |--------------------------------------------|--------|
    | trial: parameters to be looked at next     | (k,)   |
    | square: sum of the squares                 | ()     |
    | normal: J^T C J                            | (k, k) |
    | downhill: -J^T r                           | (k,)   |
    | damping                                    | ()     |
    | done: the step to the trial is next to nothing | () |
    """

    trial: Float[Array, " k"]
    square: Float[Array, ""]
    normal: Float[Array, "k k"]
    downhill: Float[Array, " k"]
    damping: Float[Array, ""]
    done: Bool[Array, ""]


class BoundedNewton(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt with the loss's own curvature, within `lower` bounds; see the module.

    Ends with a step that is hardly damped changes no parameter by more than ``atol + rtol`` of itself, or promises a
    fall of the sum that rounding would swallow.
    """

    rtol: float
    atol: float
    norm: Callable = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Nothing is known yet: the first step looks at `y` itself."""
        k = y.size
        return _State(
            trial=y,
            square=jnp.full((), jnp.inf, y.dtype),
            normal=jnp.eye(k, dtype=y.dtype),
            downhill=jnp.zeros(k, y.dtype),
            damping=jnp.full((), _DAMPING, y.dtype),
            done=jnp.array(False),
        )

    def step(self, fn, y, args, options, state: _State, tags):
        """Look at the trial, take it if it leads down, and propose the next."""
        lower = options.get("lower", jnp.full_like(y, -jnp.inf))
        residual, push, aux = jax.linearize(lambda at: fn(at, args), state.trial, has_aux=True)
        slopes = jax.vmap(push)(jnp.eye(y.size, dtype=y.dtype))
        bent = options["curvature"](residual) if "curvature" in options else jnp.ones_like(residual)
        square = residual @ residual
        seen = (square, (slopes * jnp.maximum(bent, _CURVED)) @ slopes.T, -slopes @ residual)

        taken = square < state.square
        y = jnp.where(taken, state.trial, y)
        known = (state.square, state.normal, state.downhill)
        square, normal, downhill = (jnp.where(taken, new, old) for new, old in zip(seen, known, strict=True))
        change = jnp.where(taken, jnp.where(jnp.isinf(state.square), 1.0, _LESS), _MORE)
        damping = jnp.maximum(state.damping * change, _LEAST).astype(y.dtype)

        free = (y > lower) | (downhill > 0)
        step = _damped(normal, downhill, free, damping)
        hit = y + step < lower  # these go to their bound, and the others as is best then
        part = jnp.where(hit, lower - y, 0)
        rest = _damped(normal, downhill - normal @ part, free & ~hit, damping)
        trial = jnp.maximum(y + part + rest, lower)
        moved = self.norm((trial - y) / (self.atol + self.rtol * jnp.abs(y)))
        slack = options.get("slack", 1.0)
        small = (moved < slack) | (step @ downhill < slack * 4 * jnp.finfo(y.dtype).eps * square)
        done = small & (damping <= 1) & jnp.isfinite(square)
        return jnp.where(done, trial, y), _State(trial, square, normal, downhill, damping, done), aux

    def terminate(self, fn, y, args, options, state: _State, tags):
        """Whether the next step would be next to nothing."""
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        """As it is."""
        return y, aux, {}


def _damped(normal, downhill, free, damping):
    """Marquardt's step of the parameters that are `free`; the others stay."""
    size = jax.lax.rsqrt(jnp.maximum(jnp.diagonal(normal), jnp.finfo(normal.dtype).tiny))
    scaled = jnp.where(free[:, None] & free, normal * size[:, None] * size, 0)
    scaled = scaled + jnp.diag(jnp.where(free, damping, 1))
    return jnp.where(free, size * cho_solve(cho_factor(scaled), jnp.where(free, size * downhill, 0)), 0)
