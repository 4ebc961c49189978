"""Arrays of many plain channels: which of them say nothing, before anything is fitted to them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage, stats

_STUCK = 0.99  # of the samples at one value
_SILENT = 0.5  # rank correlation with the reference below which a channel does not follow it
_AT_END = 0.01  # of the samples at the converter's end
_AROUND = 9  # samples whose median a sample is compared with
_SPIKE = 0.4  # of the range of a typical channel
_MANY = 0.0005  # of the samples that are spikes


class Faults(NamedTuple):
    """What is wrong with channels; each flags (channels,).

    | flag      | meaning                                                             |
    |-----------|---------------------------------------------------------------------|
    | stuck     | 99 % of the samples are one value                                   |
    | saturated | 1 % of the samples or more at the least or largest value of all     |
    | silent    | does not follow the reference (rank correlation below 0.5)          |
    | spiking   | leaps away from its neighbours in time, and back, again and again   |
    """

    stuck: Bool[np.ndarray, " channels"]
    saturated: Bool[np.ndarray, " channels"]
    silent: Bool[np.ndarray, " channels"]
    spiking: Bool[np.ndarray, " channels"]

    @property
    def any(self) -> Bool[np.ndarray, " channels"]:
        """Not to be fitted: spikes alone a robust fit can bear."""
        return self.stuck | self.saturated | self.silent


def faults(values: Float[np.ndarray, "n channels"], reference: Float[np.ndarray, " n"]) -> Faults:
    """`Faults` of channels that should all follow a reference, such as the pressure of the chamber they are in."""
    values = np.asarray(values)
    common = np.array([np.unique(v, return_counts=True)[1].max() for v in values.T]) / len(values)
    stuck = common >= _STUCK
    ends = np.max([np.mean(values == values.min(), 0), np.mean(values == values.max(), 0)], 0)
    leap = np.abs(values - ndimage.median_filter(values, (_AROUND, 1), mode="nearest"))
    typical = np.median(np.ptp(values, 0)[~stuck]) if not stuck.all() else 0.0
    spiking = np.mean(leap > _SPIKE * typical, 0) > _MANY
    ranks = stats.rankdata(reference)
    follows = np.array(
        [0.0 if s else np.corrcoef(stats.rankdata(v), ranks)[0, 1] for v, s in zip(values.T, stuck, strict=True)]
    )
    return Faults(stuck, (ends >= _AT_END) & ~stuck, (np.abs(follows) < _SILENT) & ~stuck, spiking & ~stuck)
