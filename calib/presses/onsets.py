"""Delay of each stream after the force at the beginning of a press: a cross-check of the clocks."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..session.units import SECOND
from .corrections import TwoSided
from .samples import remove_baseline
from .streams import MAD_TO_SIGMA, ReadableStream, index_ranges
from .times import PressColumns
from .windows import PressWindows

RISE_FRACTIONS = (0.2, 0.5, 0.8)  # of the way from rest to hold: far from noise at either end
HALF = RISE_FRACTIONS.index(0.5)
EARLY_ROUNDS = 4  # the rest before the force holds the rise of an early stream: its windows move by the delay found


@dataclass(frozen=True)
class OnsetDelay:
    """Delay of a stream after the force.

    | field   | meaning                                                                             | unit |
    |---------|-------------------------------------------------------------------------------------|------|
    | delay   | at half of the hold value, median over presses                                      | s    |
    | spread  | of that delay over presses, from the median absolute deviation                      | s    |
    | presses | number of presses used                                                              |      |
    | shift   | part of the delay that all of `RISE_FRACTIONS` share: the least of their delays, or | s    |
    |         | 0 if their signs differ                                                             |      |

    A clock moves the whole rise alike. A curved response, friction and creep move its parts differently, and the start
    of the rise hardly at all, so that `shift` is what a clock alone may explain.
    """

    delay: float
    spread: float
    presses: int
    shift: float


def crossing(time: np.ndarray, signal: np.ndarray, level: float) -> float:
    """Time (ns, interpolated) at which `signal` last rises through `level`; NaN if it does not stay above `level`."""
    below = np.flatnonzero(signal < level)
    if not len(below) or below[-1] + 1 >= len(signal):
        return float("nan")
    i = below[-1]
    part = (level - signal[i]) / (signal[i + 1] - signal[i])
    return float(time[i] + part * (time[i + 1] - time[i]))


def _rise_times(stream: ReadableStream, windows: PressWindows, i: int) -> list[float]:
    """Times (ns) of the rise through `RISE_FRACTIONS` of the way from rest to hold."""
    time, values = remove_baseline(stream, windows, i, TwoSided(), ())
    values = values[:, np.isfinite(values).all(axis=0)]
    rests, holds = (values[slice(*index_ranges(time, getattr(windows, n)[i]))].mean(0) for n in ("rest_before", "hold"))
    # Along the change that the press makes: a norm would fold where a stream is early and its rest is none.
    signal = values @ (holds - rests)
    rest, hold = rests @ (holds - rests), holds @ (holds - rests)
    stop = np.searchsorted(time, windows.hold[i, 0])
    levels = [rest + fraction * (hold - rest) for fraction in RISE_FRACTIONS]
    return [crossing(time[:stop], signal[:stop], level) for level in levels]


def onset_delays(
    force: ReadableStream,
    others: Iterable[ReadableStream],
    presses: PressColumns,
    windows: PressWindows,
) -> dict[str, OnsetDelay]:
    """Delay of each stream after the force, by name of the stream.

    The delay checks clocks and is no clock itself: a curved response shifts the crossing too (a stream that follows
    force**0.7 reaches half its value sooner), which `OnsetDelay.shift` leaves out as far as it can be told.
    """
    rows = np.flatnonzero(presses.accepted)

    def rise_times(stream: ReadableStream, seen: PressWindows) -> np.ndarray:
        return np.array([_rise_times(stream, seen, int(i)) for i in rows]).reshape(-1, len(RISE_FRACTIONS))

    reference, found = rise_times(force, windows), {}
    for stream in others:
        delays = rise_times(stream, windows) - reference
        for _ in range(EARLY_ROUNDS):
            early = float(np.nanmedian(delays[:, HALF])) if np.isfinite(delays[:, HALF]).any() else 0.0
            if early >= 0:
                break
            delays = rise_times(stream, windows.moved(round(early))) - reference
        found[stream.name] = _onset_delay(delays)
    return found


def _onset_delay(delays: np.ndarray) -> OnsetDelay:
    """Summary of delays (presses, fractions) in ns."""
    good = delays[np.isfinite(delays[:, HALF])] / SECOND
    if not len(good):
        return OnsetDelay(float("nan"), float("nan"), 0, float("nan"))
    middle = float(np.median(good[:, HALF]))
    spread = float(MAD_TO_SIGMA * np.median(np.abs(good[:, HALF] - middle)))
    sign = np.sign(good[:, HALF])
    one_sign = ((np.sign(good) == sign[:, None]) | np.isnan(good)).all(axis=1)
    shift = np.where(one_sign, sign * np.nanmin(np.abs(good), axis=1), 0.0)
    return OnsetDelay(middle, spread, len(good), float(np.median(shift)))
