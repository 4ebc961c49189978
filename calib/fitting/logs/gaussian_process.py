"""One signal of many channels by a Gaussian process over their principal components.

The force is a linear function plus a smooth one (squared exponential, a length for each input). The inputs are the
first principal components of the channels, and the differences of the first component from its first-order lags of some
seconds, for the creep of soft material. Lengths, variances, noise and the number of components are those of
largest evidence (Rasmussen and Williams 2006, 5.4), from the fitted samples alone.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize

from jaxeit.linalg.lapack import cho_solve, cholesky, solve_triangular

from ..curves.base import AbstractCurve

Hyper = Float[Array, " hyperparameters"]

# Samples that the hyperparameters are fitted to, evenly spread over the log; each step costs their cube.
MAX_SAMPLES = 400
# Steps of the minimiser; the evidence is flat near its maximum.
MAX_STEPS = 60
# Noise variance that keeps the kernel matrix positive definite in float64 where samples repeat.
JITTER = 1e-8


class _Found(NamedTuple):
    """Log evidence, number of components, hyperparameters, inputs (n, inputs), and the force (N) that is one unit."""

    evidence: float
    directions: int
    hyper: np.ndarray
    inputs: np.ndarray
    size: float


@dataclass(frozen=True)
class SmoothChannels:
    """Make one signal in N of all channels by a Gaussian process, creep included; for `fit_log`.

    | meaning                                               | default   | unit |
    |-------------------------------------------------------|-----------|------|
    | directions: numbers of principal components tried     | 2 to 6    |      |
    | lags: time constants of the creep; none: no creep     | 3, 30     | s    |
    """

    directions: tuple[int, ...] = (2, 3, 4, 5, 6)
    lags: tuple[float, ...] = (3.0, 30.0)

    def __call__(
        self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve | None
    ) -> tuple[np.ndarray, str]:
        """Signal (n,) N at all times (ns), from the samples (n, channels) whose force (n,) is finite."""
        del curve
        train = np.isfinite(force)
        inputs = _inputs(np.asarray(time, float) / 1e9, signals, train, max(self.directions), self.lags)
        tried = [self._tried(inputs, force, train, k) for k in self.directions if k <= signals.shape[1]]
        best = max(tried, key=lambda found: found.evidence)
        whole = np.isfinite(best.inputs).all(1)
        out = np.full(len(force), np.nan)
        out[whole] = _predicted(best, best.inputs[train], force[train], best.inputs[whole])
        lags = f", lags of {' and '.join(f'{lag:g}' for lag in self.lags)} s" if self.lags else ""
        return out, f"{signals.shape[1]} channels along {best.directions} directions{lags}"

    def _tried(self, inputs: np.ndarray, force: np.ndarray, train: np.ndarray, directions: int) -> _Found:
        """The hyperparameters of largest evidence; unused directions are zero, so that all share a compiled program."""
        kept = inputs * (np.arange(inputs.shape[1]) < len(self.lags) + directions)
        rows = np.flatnonzero(train)[_evenly(int(train.sum()), MAX_SAMPLES)]
        size = float(np.std(force[train]))
        cost = partial(_cost_and_slope, jnp.asarray(kept[rows]), jnp.asarray(force[rows] / size))
        start = np.r_[np.zeros(kept.shape[1]), 0.0, -1.0, np.log(0.03**2)]
        found = minimize(lambda h: tuple(np.asarray(part, float) for part in cost(h)), start, jac=True,
                         method="L-BFGS-B", bounds=[(-7, 7)] * kept.shape[1] + [(-12, 12)] * 2 + [(-16, 2)],
                         options={"maxiter": MAX_STEPS})  # fmt: skip
        return _Found(-float(found.fun), directions, found.x, kept, size)


def _evenly(n: int, most: int) -> np.ndarray:
    """At most `most` of the numbers 0 to n - 1, evenly spaced."""
    return np.linspace(0, n - 1, min(n, most)).astype(int)


def _inputs(
    time: np.ndarray, signals: np.ndarray, train: np.ndarray, directions: int, lags: tuple[float, ...]
) -> np.ndarray:
    """Differences of the first principal component from its lags, then all components, (n, inputs) of order one."""
    axes = np.linalg.svd(signals[train], full_matrices=False)[2][:directions]
    along = signals @ axes.T
    along = along / np.abs(along[train]).max(0)
    return np.column_stack([*(along[:, 0] - lagged(time, along[:, 0], lag) for lag in lags), along])


def lagged(time: np.ndarray, signal: np.ndarray, lag: float) -> np.ndarray:
    """First-order lag of a signal (n,) by `lag`, in the unit of time; missing samples do not change its state."""
    out, state, before = np.empty(len(signal)), np.nan, time[0]
    for k, (now, value) in enumerate(zip(time, signal, strict=True)):
        if np.isfinite(value):
            state = value if np.isnan(state) else state + (value - state) * -np.expm1((before - now) / lag)
            before = now
        out[k] = state
    return np.where(np.isfinite(signal), out, np.nan)


def _kernel(hyper: Hyper, p: Float[Array, "n d"], q: Float[Array, "m d"]) -> Float[Array, "n m"]:
    lengths, plane, bend = jnp.exp(hyper[:-3]), jnp.exp(hyper[-3]), jnp.exp(hyper[-2])
    a, b = p / lengths, q / lengths
    square = jnp.sum(a**2, 1)[:, None] + jnp.sum(b**2, 1) - 2 * a @ b.T
    return plane * (1 + p @ q.T) + bend * jnp.exp(-0.5 * jnp.maximum(square, 0))


def _factor(hyper: Hyper, inputs: Float[Array, "n d"]) -> Float[Array, "n n"]:
    noise = jnp.exp(hyper[-1]) + JITTER
    return cholesky(_kernel(hyper, inputs, inputs) + noise * jnp.eye(len(inputs), dtype=inputs.dtype), lower=True)


def _cost(hyper: Hyper, inputs: Float[Array, "n d"], y: Float[Array, " n"]) -> Float[Array, ""]:
    """Minus log evidence, up to a constant."""
    low = _factor(hyper, inputs)
    half = solve_triangular(low, y, lower=True)
    return 0.5 * half @ half + jnp.sum(jnp.log(jnp.diagonal(low)))


@jax.jit
def _cost_and_slope(inputs: Float[Array, "n d"], y: Float[Array, " n"], hyper: Hyper) -> tuple[Array, Array]:
    cost, slope = jax.value_and_grad(_cost)(hyper, inputs, y)
    sound = jnp.isfinite(cost) & jnp.all(jnp.isfinite(slope))
    return jnp.where(sound, cost, 1e10), jnp.where(sound, slope, 0)


@jax.jit
def _weights(hyper: Hyper, inputs: Float[Array, "n d"], y: Float[Array, " n"]) -> Float[Array, " n"]:
    return cho_solve((_factor(hyper, inputs), True), y)


def _predicted(found: _Found, inputs: np.ndarray, force: np.ndarray, at: np.ndarray) -> np.ndarray:
    hyper, train = jnp.asarray(found.hyper), jnp.asarray(inputs)
    weights = _weights(hyper, train, jnp.asarray(force / found.size))
    return np.asarray(_kernel(hyper, jnp.asarray(at), train) @ weights) * found.size
