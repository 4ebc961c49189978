"""Noise of the readings of a log, which grows with force and with the rate at which the force changes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..intervals import COVERAGE, MIN_GROUPS, NORMAL_MULTIPLE, fit_variance_components, student_factor

STRETCH_COVERAGE = 0.75  # share of the stretches of time in which the interval covers the readings
# s before and after a sample, over which the rate of its force is taken. It is as long as the lags of sensors are: a
# longer one spreads the error of a sudden change over readings that do not have it.
RATE_WINDOW = 0.05


class LogNoise(eqx.Module):
    """Deviation of new readings: s(F) = sqrt(floor^2 + (fraction F)^2 + (lag dF/dt)^2).

    The lag stands for all that errs with the rate: clocks that differ, filters, creep that the curve does not know.

    | field    | meaning                                                  | shape | unit |
    |----------|----------------------------------------------------------|-------|------|
    | floor    | standard deviation without force, at rest                | ()    | N    |
    | fraction | standard deviation per force                             | ()    | 1    |
    | lag      | standard deviation per rate of the force                 | ()    | s    |
    | multiple | half the interval, in standard deviations; see below     | ()    | 1    |

    The interval covers 90 % of the readings in three of four stretches of time, and is wider where the log has few
    cycles of load: these tell little of how much the next one differs (Student's distribution).
    """

    floor: Float[Array, ""]
    fraction: Float[Array, ""]
    lag: Float[Array, ""]
    multiple: Float[Array, ""]

    def variance(self, time: np.ndarray, force: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Variance (N^2) of new readings about predicted forces (N) at times (ns)."""
        terms = _variance_terms(force, force_rate(time, force))
        return np.asarray(terms @ np.square([float(self.floor), float(self.fraction), float(self.lag)]))


def fit_log_noise(
    residual: Float[np.ndarray, " n"],
    time: np.ndarray,
    force: Float[np.ndarray, " n"],
    variance: Float[np.ndarray, " n"],
    group: np.ndarray,
    repetitions: int,
) -> LogNoise:
    """The noise of held-out residuals; floor, fraction and lag have the largest normal likelihood.

    Args:
        residual: measured minus predicted force, N; rows that are not finite are left out.
        time: of the samples, ns.
        force: predicted, N.
        variance: of the predicted force, by the model, N^2.
        group: stretch of time (n,) of each row. Rows of a group count as one, because they err together.
        repetitions: cycles of load, or places, that the residuals are of. The fewer they are, the less is known of how
            much the next one differs: the interval is wider, as that of Student's distribution.

    Example:
        residual = force - fit.predicted
        stretch = np.arange(2000) // 100  # of a second
        noise = logs.fit_log_noise(residual, time, fit.predicted, np.zeros(2000), stretch, repetitions=5)
        print(noise.floor, noise.fraction, noise.lag)  # N, 1, s
    """
    terms = _variance_terms(force, force_rate(time, force))
    finite = np.isfinite(residual) & np.isfinite(terms).all(1) & np.isfinite(variance)
    residual, terms, variance = residual[finite], terms[finite], variance[finite]
    _, group, count = np.unique(group[finite], return_inverse=True, return_counts=True)
    sizes = fit_variance_components(residual, variance, 1 / count[group], terms)
    deviation = np.sqrt(np.maximum(variance + terms @ sizes**2, np.finfo(float).tiny))
    floor, fraction, lag = map(jnp.asarray, sizes)
    factor = student_factor(repetitions)
    return LogNoise(floor, fraction, lag, jnp.asarray(factor * _interval_multiple(np.abs(residual) / deviation, group)))


def _interval_multiple(pull: Float[np.ndarray, " n"], group: np.ndarray) -> float:
    """The multiple that covers 90 % of the readings in three of four stretches of time.

    One that covers 90 % of all readings is exceeded by whole stretches: sensors drift, so that what comes after a log
    is seldom as near to the model as the log is to itself.
    """
    stretches = np.unique(group)
    if len(stretches) < MIN_GROUPS:
        return NORMAL_MULTIPLE
    return float(np.quantile([np.quantile(pull[group == k], COVERAGE) for k in stretches], STRETCH_COVERAGE))


def force_rate(time: np.ndarray, force: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Rate of a force (N) at times (ns), N/s, over `RATE_WINDOW` before and after; NaN where the force is."""
    known = np.isfinite(force)
    if known.sum() < 2:
        return np.where(known, 0.0, np.nan)
    at, of, seconds = time[known] / 1e9, force[known], time / 1e9
    before, after = (np.clip(seconds + side * RATE_WINDOW, at[0], at[-1]) for side in (-1, 1))
    rate = (np.interp(after, at, of) - np.interp(before, at, of)) / np.maximum(after - before, 1e-9)
    return np.where(known, rate, np.nan)


def _variance_terms(force: np.ndarray, rate: np.ndarray) -> np.ndarray:
    return np.stack([np.ones(len(force)), force**2, rate**2], 1)
