"""Find the channels of a wide array that carry no information, before anything is fitted to them."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from .corrections import interpolate_missing

MIN_ARRAY_CHANNELS = 8  # with fewer channels, a user inspects each one by itself
STUCK_FRACTION = 0.99  # of the samples at one value
MIN_RANK_CORRELATION = 0.5  # with the reference; a channel below it does not follow the reference
SATURATED_FRACTION = 0.01  # of the samples at an end of the converter
SPIKE_WINDOW = 9  # samples whose median a sample is compared with
SPIKE_HEIGHT = 0.4  # of the range of a typical channel
SPIKE_FRACTION = 0.0005  # of the samples


class ChannelFaults(NamedTuple):
    """Faults of channels; each field flags (channels,).

    | field     | meaning                                                              |
    |-----------|----------------------------------------------------------------------|
    | dead      | no finite sample                                                     |
    | stuck     | 99 % of the samples have one value                                   |
    | saturated | 1 % of the samples or more at the least or largest value of all      |
    | silent    | does not follow the reference (rank correlation below 0.5)           |
    | spiking   | repeatedly jumps away from its neighbours in time and back           |
    """

    dead: Bool[np.ndarray, " channels"]
    stuck: Bool[np.ndarray, " channels"]
    saturated: Bool[np.ndarray, " channels"]
    silent: Bool[np.ndarray, " channels"]
    spiking: Bool[np.ndarray, " channels"]

    @property
    def uninformative(self) -> Bool[np.ndarray, " channels"]:
        """Channels that carry no information about the reference: dead, stuck or silent."""
        return np.asarray(self.dead | self.stuck | self.silent)

    @property
    def any(self) -> Bool[np.ndarray, " channels"]:
        """Channels that must not be fitted one by one. A robust fit tolerates spikes, so spiking is not included."""
        return np.asarray(self.uninformative | self.saturated)


def faults(values: Float[np.ndarray, "n channels"], reference: Float[np.ndarray, " n"] | None = None) -> ChannelFaults:
    """Find the faults of channels that should all follow one reference.

    Args:
        values: samples in the sensor's unit, NaN where missing.
        reference: for example the force on the array, or the pressure of the chamber around it; NaN where missing.
            None: channels are not compared with anything, and none is called silent.
    """
    values = np.asarray(values)
    finite = np.isfinite(values)
    count = np.maximum(finite.sum(0), 1)
    dead = ~finite.any(0)
    common = np.array([_most_frequent(v[f]) for v, f in zip(values.T, finite.T, strict=True)])
    stuck = ~dead & (common / count >= STUCK_FRACTION)
    idle = dead | stuck
    return ChannelFaults(
        dead,
        stuck,
        _saturated(values, count) & ~idle,
        _silent(values, reference, idle),
        _spiking(values, idle),
    )


def _most_frequent(column: np.ndarray) -> int:
    """Number of samples that have the most frequent value."""
    return int(np.unique(column, return_counts=True)[1].max(initial=0))


def _saturated(values: np.ndarray, count: np.ndarray) -> np.ndarray:
    lowest, highest = np.nanmin(values, initial=np.inf), np.nanmax(values, initial=-np.inf)
    at_end = np.maximum((values == lowest).sum(0), (values == highest).sum(0))
    return np.asarray(at_end / count >= SATURATED_FRACTION)


def _spiking(values: np.ndarray, idle: np.ndarray) -> np.ndarray:
    if idle.all():
        return np.zeros(len(idle), bool)
    filled = np.apply_along_axis(interpolate_missing, 0, values[:, ~idle])
    jump = np.abs(filled - scipy.ndimage.median_filter(filled, (SPIKE_WINDOW, 1), mode="nearest"))
    typical = np.median(np.ptp(filled, 0))
    out = np.zeros(len(idle), bool)
    out[~idle] = np.mean(jump > SPIKE_HEIGHT * typical, 0) > SPIKE_FRACTION
    return out


def _silent(values: np.ndarray, reference: np.ndarray | None, idle: np.ndarray) -> np.ndarray:
    if reference is None:
        return np.zeros(len(idle), bool)
    known = np.isfinite(reference)
    follows = [idle[i] or abs(rank_correlation(v[known], reference[known])) for i, v in enumerate(values.T)]
    return np.array(follows) < MIN_RANK_CORRELATION


def rank_correlation(column: np.ndarray, reference: np.ndarray) -> float:
    """Spearman's rank correlation over the finite samples of a channel; 0 if either is constant."""
    good = np.isfinite(column)
    a, b = column[good], reference[good]
    if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return 0.0
    return float(np.corrcoef(scipy.stats.rankdata(a), scipy.stats.rankdata(b))[0, 1])
