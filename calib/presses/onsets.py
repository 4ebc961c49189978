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

RISE_FRACTION = 0.5  # of the way from rest to hold: the steepest part of a ramp, and far from noise at either end


@dataclass(frozen=True)
class OnsetDelay:
    """Delay of a stream after the force: median and MAD-based spread over presses (s), and number of presses used."""

    delay: float
    spread: float
    presses: int


def crossing(time: np.ndarray, signal: np.ndarray, level: float) -> float:
    """Time (ns, interpolated) at which `signal` last rises through `level`; NaN if it does not stay above `level`."""
    below = np.flatnonzero(signal < level)
    if not len(below) or below[-1] + 1 >= len(signal):
        return float("nan")
    i = below[-1]
    part = (level - signal[i]) / (signal[i + 1] - signal[i])
    return float(time[i] + part * (time[i + 1] - time[i]))


def _magnitude(values: np.ndarray) -> np.ndarray:
    """Reduce many channels to one signal: the norm over the channels that are finite throughout."""
    good = np.isfinite(values).all(axis=0)
    return np.asarray(np.linalg.norm(values[:, good], axis=1))


def _rise_time(stream: ReadableStream, windows: PressWindows, i: int) -> float:
    """Time (ns) from the contact to the rise through `RISE_FRACTION` of the way from rest to hold."""
    time, values = remove_baseline(stream, windows, i, TwoSided(), ())
    signal = _magnitude(values)
    rest, hold = (
        float(signal[slice(*index_ranges(time, getattr(windows, name)[i]))].mean()) for name in ("rest_before", "hold")
    )
    stop = np.searchsorted(time, windows.hold[i, 0])
    return float(crossing(time[:stop], signal[:stop], rest + RISE_FRACTION * (hold - rest)) - windows.ramp[i, 0])


def onset_delays(
    force: ReadableStream,
    others: Iterable[ReadableStream],
    presses: PressColumns,
    windows: PressWindows,
) -> dict[str, OnsetDelay]:
    """Delay of each stream after the force at half of the hold value, by name of the stream.

    The delay checks clocks and is no clock itself: a curved response shifts the crossing too (a stream that follows
    force**0.7 reaches half its value sooner), so a delay well below the ramp time does not prove a wrong clock.
    """
    rows = np.flatnonzero(presses.accepted)

    def rise_times(stream: ReadableStream) -> np.ndarray:
        return np.array([_rise_time(stream, windows, int(i)) for i in rows])

    reference = rise_times(force)
    return {stream.name: _onset_delay(rise_times(stream) - reference) for stream in others}


def _onset_delay(delay: np.ndarray) -> OnsetDelay:
    good = delay[np.isfinite(delay)] / SECOND
    if not len(good):
        return OnsetDelay(float("nan"), float("nan"), 0)
    middle = float(np.median(good))
    return OnsetDelay(middle, float(MAD_TO_SIGMA * np.median(np.abs(good - middle))), len(good))
