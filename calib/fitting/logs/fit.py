"""Fit of one curve to a log without presses: fitted on the first part of its time, tried on the rest."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..cross_validation.scores import Score, score, valid_forces
from ..curves.base import AbstractCurve
from ..curves.fit import fit_curves
from ..curves.fitted import FittedCurve
from ..curves.samples import Numbers
from ..results import FitError
from .blend import BlendChannels
from .combination import AbstractCombination, one_channel

Channels = Callable[[np.ndarray, np.ndarray, np.ndarray, AbstractCurve], AbstractCombination]
"""Combines channels, from time (n,), signals (n, channels), force (n,) (NaN: not to be used) and the curve."""


def time_split(time: Numbers, fraction: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """Masks (n,) of the samples in the first `fraction` of the time span, and of the other samples.

    Example:
        first, rest = logs.time_split(time, 0.5)  # masks
    """
    at = np.asarray(time)
    first = (at - at[0]) < fraction * (at[-1] - at[0])
    return first, ~first


@dataclass(frozen=True, eq=False)
class LogFit:
    """A curve fitted to the first part of a log and tested on the rest.

    | field     | meaning                                                      | shape | unit      |
    |-----------|--------------------------------------------------------------|-------|-----------|
    | fitted    | the curve from signal to force                               |       |           |
    | signal    | the signal that the curve was fitted to                      | (n,)  | sensor's  |
    | predicted | force by the curve                                           | (n,)  | N         |
    | source    | the channels that the signal is made of, in words            |       |           |
    | missing   | number of samples without a force or without a signal        |       |           |
    | train     | `Score` on the samples that were fitted                      |       |           |
    | held_out  | `Score` on the samples of the rest                           |       |           |
    """

    fitted: FittedCurve
    signal: np.ndarray
    predicted: np.ndarray
    source: str
    missing: int
    train: Score
    held_out: Score


def fit_log(
    curve: AbstractCurve,
    time: Numbers,
    signals: Numbers,
    force: Numbers,
    *,
    fraction: float = 0.5,
    channels: Channels | None = None,
    **options: Any,
) -> LogFit:
    """Fit one curve to the first part of a log without presses, and score it on the rest too.

    Args:
      time: (n,); signals: (n,) or (n, channels), Pa or a sensor's own unit; force: (n,) N; NaN: missing.
      fraction: of the time span that is fitted; the rest is held out.
      channels: how to make one signal of several channels: `BlendChannels()` (default), `BestChannel()` or
        `SmoothChannels()`. It uses the fitted part alone.
      options: further arguments of `fit_curves`.

    Raises:
        FitError: if no sample of the fitted part is complete.
    """
    values, forces = np.asarray(signals, float), np.asarray(force, float)
    values = values[:, None] if values.ndim == 1 else values
    first, rest = time_split(time, fraction)
    complete = np.isfinite(values).all(axis=1) & np.isfinite(forces)
    train = first & complete
    if not train.any():
        raise FitError(
            "no sample of the fitted part has both a force and a signal; record more, or choose a larger fraction."
        )
    combination = _combination(np.asarray(time), values, np.where(train, forces, np.nan), curve, channels)
    signal = combination.signal(np.asarray(time), values)
    fitted = fit_curves(curve, signal[None], forces, mask=train, **options)
    predicted = valid_forces(fitted, signal[None])[0]
    scores = [score(predicted[m], forces[m]) for m in (train, rest & complete)]
    return LogFit(fitted.pad(0), signal, predicted, combination.words, int((~complete).sum()), *scores)


def _combination(
    time: np.ndarray, signals: np.ndarray, force: np.ndarray, curve: AbstractCurve, channels: Channels | None
) -> AbstractCombination:
    """One signal of all channels; `force` is NaN outside the fitted part."""
    if signals.shape[1] == 1:
        return one_channel(0)
    choose = BlendChannels() if channels is None else channels
    return choose(time, signals, force, curve)
