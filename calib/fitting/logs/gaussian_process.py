"""One signal of many channels by a Gaussian process over their principal components.

The force is a linear function plus a smooth one (squared exponential, a length for each input). The inputs are the
first principal components of the channels, and the differences of the first component from its first-order lags of some
seconds, for the creep of soft material. Lengths, variances, noise and the number of components are those of
largest evidence (Rasmussen and Williams 2006, 5.4), from the fitted samples alone.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.linalg import lapack
from scipy.optimize import minimize

from jaxeit.registry import limited, require_limits

from ..curves.base import AbstractCurve
from .combination import AbstractCombination, SmoothSignal, kernel, lag_inputs

# Samples that the hyperparameters are fitted to, evenly spread over the log; each step costs their cube.
MAX_SAMPLES = 400
# Samples that the force is interpolated from, evenly spread over the log; the fit costs their cube.
MAX_CENTRES = 2000
# Steps of the minimiser; the evidence is flat near its maximum.
MAX_STEPS = 60
# Likewise from hyperparameters of a fit to more samples.
MAX_REFINING_STEPS = 10
# Noise variance that keeps the kernel matrix positive definite in float64 where samples repeat.
JITTER = 1e-8


class _Hyperparameters(NamedTuple):
    """Log evidence, number of components, and hyperparameters (unused components have a length too)."""

    evidence: float
    directions: int
    hyper: np.ndarray


@dataclass(frozen=True)
class SmoothChannels:
    """Make one signal in N of all channels by a Gaussian process, creep included; for `fit_log`.

    | meaning                                               | default   | unit |
    |-------------------------------------------------------|-----------|------|
    | directions: numbers of principal components tried     | 2 to 6    |      |
    | lags: time constants of the creep; none: no creep     | 3, 30     | s    |
    | start: hyperparameters to start from; None: of order 1|           |      |
    | max_steps: of the minimiser                           | 60        |      |
    | coordinates: last columns that are no channels, but   | 0         |      |
    |   coordinates of the place, each an input of its own  |           |      |

    Example:
        creeping = logs.fit_log(
            calib.Affine(), time, channels, force, channels=logs.SmoothChannels((2,), lags=(3.0,))
        )
    """

    directions: tuple[int, ...] = (2, 3, 4, 5, 6)
    lags: tuple[float, ...] = limited((3.0, 30.0), above=0, empty=True)
    start: np.ndarray | None = None
    max_steps: int = limited(MAX_STEPS, least=1)
    coordinates: int = limited(0, least=0)

    def __post_init__(self) -> None:
        require_limits(self)

    def __call__(
        self, time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve | None
    ) -> SmoothSignal:
        """The combination, from the samples (n, channels) at times (n,) ns whose force (n,) N is finite."""
        del curve
        known = np.isfinite(force)
        channels = signals.shape[1] - self.coordinates
        possible = [k + self.coordinates for k in self.directions if k <= channels] or [signals.shape[1]]
        axes = self._axes(signals[known], max(possible))
        inputs = lag_inputs(time, signals, axes, np.array(self.lags))[known]
        rows = _evenly_spaced(len(inputs), MAX_SAMPLES)
        size = float(np.std(force[known]))
        maxima = [self._maximise_evidence(inputs[rows], force[known][rows] / size, k) for k in possible]
        best = max(maxima, key=lambda maximum: maximum.evidence)
        used = len(self.lags) + best.directions
        hyper = np.r_[best.hyper[:used], best.hyper[-3:]]
        centres = _evenly_spaced(len(inputs), MAX_CENTRES)
        weights = _kernel_weights(hyper, inputs[centres, :used], force[known][centres] / size) * size
        return SmoothSignal(axes[: best.directions], np.array(self.lags, float), hyper, inputs[centres, :used], weights)

    def near(self, found: AbstractCombination) -> "SmoothChannels":
        """The way to fit to a part of the samples that `found` was fitted to: the same components, fewer steps."""
        assert isinstance(found, SmoothSignal)
        directions = (len(found.axes) - self.coordinates,)
        return replace(self, directions=directions, start=found.hyper, max_steps=MAX_REFINING_STEPS)

    def _axes(self, signals: np.ndarray, directions: int) -> np.ndarray:
        """Inputs (directions, columns): the first component, which has the lags, coordinates, further components."""
        if not self.coordinates:
            return _components(signals, directions)
        own = _components(signals[:, : -self.coordinates], directions - self.coordinates)
        wide = np.pad(own, ((0, 0), (0, self.coordinates)))
        return np.concatenate([wide[:1], np.eye(signals.shape[1])[-self.coordinates :], wide[1:]])

    def _maximise_evidence(self, inputs: np.ndarray, force: np.ndarray, directions: int) -> _Hyperparameters:
        """The hyperparameters of largest evidence; unused components are zero, so that all share a compiled program."""
        kept = inputs * (np.arange(inputs.shape[1]) < len(self.lags) + directions)
        start = np.r_[np.zeros(kept.shape[1]), 0.0, -1.0, np.log(0.03**2)] if self.start is None else self.start
        bounds = [(-7, 7)] * kept.shape[1] + [(-12, 12)] * 2 + [(-16, 2)]
        options = {"maxiter": self.max_steps}
        solution = minimize(
            _cost_and_gradient, start, (kept, force), jac=True, method="L-BFGS-B", bounds=bounds, options=options
        )
        return _Hyperparameters(-float(solution.fun), directions, solution.x)


def _components(signals: np.ndarray, directions: int) -> np.ndarray:
    """Principal components (d, channels) about zero, divided by the largest value of the signals along each."""
    axes = np.linalg.svd(signals, full_matrices=False)[2][:directions]
    size = np.abs(signals @ axes.T).max(0)
    return np.asarray(axes / np.where(size > 0, size, 1)[:, None])


def _evenly_spaced(n: int, most: int) -> np.ndarray:
    """At most `most` of the numbers 0 to n - 1, evenly spaced."""
    return np.linspace(0, n - 1, min(n, most)).astype(int)


def _kernel_weights(hyper: np.ndarray, inputs: np.ndarray, force: np.ndarray) -> np.ndarray:
    matrix = kernel(hyper, inputs, inputs)
    matrix[np.diag_indices(len(inputs))] += np.exp(hyper[-1]) + JITTER
    return np.asarray(linalg.cho_solve(linalg.cho_factor(matrix, lower=True, overwrite_a=True), force))


def _cost_and_gradient(hyper: np.ndarray, inputs: np.ndarray, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Minus log evidence, up to a constant, and its gradient; in closed form, because it is computed hundreds of times.

    With K the covariance of y, a = K^-1 y and W = K^-1 - a a', the derivative is the sum of W dK / 2 (5.9).
    """
    noise, a = np.exp(hyper[-1]), inputs / np.exp(hyper[:-3])
    smooth = kernel(hyper, inputs, inputs)
    plane = np.exp(hyper[-3]) * (1 + inputs @ inputs.T)
    matrix = smooth.copy()
    matrix[np.diag_indices(len(y))] += noise + JITTER
    low, failed = lapack.dpotrf(matrix, lower=1)
    if failed:
        return 1e10, np.zeros(len(hyper))
    along = lapack.dpotrs(low, y, lower=1)[0]
    inverse = np.tril(lapack.dpotri(low, lower=1)[0])
    weight = inverse + np.tril(inverse, -1).T - np.outer(along, along)
    bend = weight * (smooth - plane)
    lengths = bend.sum(1) @ a**2 - np.einsum("nd,nd->d", a, bend @ a)
    slope = np.r_[lengths, (weight * plane).sum() / 2, bend.sum() / 2, noise * np.trace(weight) / 2]
    cost = y @ along / 2 + np.log(np.diag(low)).sum()
    return (float(cost), slope) if np.isfinite(cost) and np.isfinite(slope).all() else (1e10, np.zeros(len(hyper)))
