"""Delay of each stream after the force at the beginning of a press: a cross-check of the clocks."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ...session.units import SECOND
from ..corrections import TwoSided
from ..samples import remove_baseline
from ..streams import ReadableStream, index_ranges, robust_deviation
from .times import PressColumns
from .windows import PressWindows

RISE_FRACTIONS = (0.2, 0.5, 0.8)  # of the way from rest to hold: far from noise at either end
HALF_INDEX = RISE_FRACTIONS.index(0.5)
ITERATIONS = 4  # of the shift of a stream's windows by its delay
MIN_STEP = 10_000_000  # ns; a smaller change of the delay moves no window
MIN_COMPARED = 3  # presses at the beginning and at the end, whose delays are compared
CHANGE_SPREADS = 3.0  # of the delays within these presses: a smaller change is scatter


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
    | change  | growth of the delay from the first quarter of the presses to the last one; 0 if     | s    |
    |         | their scatter explains it                                                           |      |

    A clock shifts all parts of the rise equally. A curved response, friction and creep move its parts differently, and
    the start of the rise hardly at all, so that `shift` is what a clock alone may explain.
    """

    delay: float
    spread: float
    presses: int
    shift: float
    change: float


def crossing(time: np.ndarray, signal: np.ndarray, level: float) -> float:
    """Time (ns, interpolated) at which `signal` last rises through `level`; NaN if it does not stay above `level`."""
    below = np.flatnonzero(signal < level)
    if not len(below) or below[-1] + 1 >= len(signal):
        return float("nan")
    i = below[-1]
    part = (level - signal[i]) / (signal[i + 1] - signal[i])
    return float(time[i] + part * (time[i + 1] - time[i]))


def _rise_times(stream: ReadableStream, windows: PressWindows, i: int) -> list[float]:
    """Times (ns) of the rise through `RISE_FRACTIONS` of the way from rest to hold; NaN without samples of both."""
    time, values = remove_baseline(stream, windows, i, TwoSided(), ())
    values = values[:, np.isfinite(values).all(axis=0)]
    ends = [values[slice(*index_ranges(time, getattr(windows, name)[i]))] for name in ("rest_before", "hold")]
    if not all(map(len, ends)):
        return [float("nan")] * len(RISE_FRACTIONS)
    rests, holds = (part.mean(0) for part in ends)
    # Projection on the change by the press: a norm would fold where a stream is early and its rest is zero.
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
    reference = _force_rise_times(force, presses, windows)
    origin = reference - windows.centre("ramp")[np.flatnonzero(presses.accepted), None]
    shifted = windows.shifted(_median_delay(origin))
    return {s.name: _onset_delay(_delays(s, presses, shifted, reference)) for s in others}


def ramp_delay(force: ReadableStream, presses: PressColumns, windows: PressWindows) -> OnsetDelay:
    """Delay of the force after even ramps between the times that the list of presses states."""
    ramp = windows.ramp[np.flatnonzero(presses.accepted)]
    stated = ramp[:, :1] + np.diff(ramp, axis=1) * np.array(RISE_FRACTIONS)
    return _onset_delay(_force_rise_times(force, presses, windows) - stated)


def _force_rise_times(force: ReadableStream, presses: PressColumns, windows: PressWindows) -> np.ndarray:
    """Times (accepted presses, fractions) ns of the rises of the force."""
    middle = windows.centre("ramp")[np.flatnonzero(presses.accepted), None]
    return np.asarray(_delays(force, presses, windows, middle) + middle)


def _delays(stream: ReadableStream, presses: PressColumns, windows: PressWindows, origin: np.ndarray) -> np.ndarray:
    """Delays (accepted presses, fractions) ns of the rises of a stream after ``origin``.

    The windows follow the stream: the rest before the force holds the rise of an early stream, and the beginning of
    the hold that of a late one.
    """
    rows = np.flatnonzero(presses.accepted)

    def delays_at(step: int) -> np.ndarray:
        shifted = windows.shifted(step)
        times = np.array([_rise_times(stream, shifted, int(i)) for i in rows]).reshape(-1, len(RISE_FRACTIONS))
        return np.asarray(times - origin)

    delays = delays_at(0)
    if np.isnan(delays[:, HALF_INDEX]).mean() > 0.5:  # it rises later than the ramp ends, or not at all
        later = delays_at(round(float(np.median(np.diff(windows.ramp[rows], axis=1)))))
        delays = delays if np.isnan(later[:, HALF_INDEX]).mean() > 0.5 else later
    last = 0
    for _ in range(ITERATIONS):
        step = _median_delay(delays)
        if abs(step - last) < MIN_STEP:
            break
        delays, last = delays_at(step), step
    return delays


def _median_delay(delays: np.ndarray) -> int:
    """Median delay at half of the hold value, ns; 0 without any."""
    half = delays[:, HALF_INDEX]
    return round(float(np.nanmedian(half))) if np.isfinite(half).any() else 0


def _onset_delay(delays: np.ndarray) -> OnsetDelay:
    """Summary of delays (presses, fractions) in ns."""
    good = delays[np.isfinite(delays[:, HALF_INDEX])] / SECOND
    if not len(good):
        return OnsetDelay(float("nan"), float("nan"), 0, float("nan"), 0.0)
    half = good[:, HALF_INDEX]
    sign = np.sign(half)
    one_sign = ((np.sign(good) == sign[:, None]) | np.isnan(good)).all(axis=1)
    shift = np.where(one_sign, sign * np.nanmin(np.abs(good), axis=1), 0.0)
    return OnsetDelay(float(np.median(half)), _spread(half), len(good), float(np.median(shift)), _change(half))


def _spread(values: np.ndarray) -> float:
    return robust_deviation(values - np.median(values))


def _change(delay: np.ndarray) -> float:
    """How much the delay (presses,) grows from the first presses to the last ones; 0 if their scatter explains it."""
    count = max(len(delay) // 4, MIN_COMPARED)
    if len(delay) < 2 * count:
        return 0.0
    first, last = delay[:count], delay[-count:]
    change = float(np.median(last) - np.median(first))
    return change if abs(change) > CHANGE_SPREADS * max(_spread(first), _spread(last)) else 0.0
