"""Pressure and force of whole presses, sample by sample."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .corrections import AbstractBaseline, AbstractCorrection, TwoSided, masked_product
from .means import read_press
from .streams import ReadableStream, ReadAhead, finite_mean, index_ranges, resample
from .timing.times import PressColumns
from .timing.windows import PressWindows


@dataclass(frozen=True, eq=False)
class PressSamples:
    """Ramp, hold and release of all accepted presses, sample by sample, for curve fitting.

    | field    | meaning                                       | shape     | unit |
    |----------|-----------------------------------------------|-----------|------|
    | time     | time stamps of the force stream               | (n,)      | ns   |
    | pressure | interpolated to `time`, baseline removed      | (n, pads) | Pa   |
    | force    | baseline removed                              | (n,)      | N    |
    | press    | row of the press table                        | (n,)      |      |
    | phase    | 0 ramp, 1 hold, 2 release                     | (n,)      |      |
    """

    time: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    press: np.ndarray
    phase: np.ndarray


def remove_baseline(
    stream: ReadableStream,
    windows: PressWindows,
    i: int,
    rule: AbstractBaseline,
    corrections: Sequence[AbstractCorrection],
) -> tuple[np.ndarray, np.ndarray]:
    """Time stamps (n,) ns and values (n, channels) of press `i`, with the baseline subtracted from every sample."""
    time, values = read_press(stream, windows, i, corrections)
    rests = np.stack([windows.rest_before[i], windows.rest_after[i]])
    before, after = (finite_mean(values[a:b]) for a, b in index_ranges(time, rests))
    w0, w1 = rule.weights(time.astype(float), *rests.astype(float).mean(axis=1))
    return time, values - (masked_product(w0[:, None], before) + masked_product(w1[:, None], after))


def _press_rows(
    force: ReadableStream,
    pressure: ReadableStream,
    windows: PressWindows,
    i: int,
    rule: AbstractBaseline,
    corrections: Sequence[AbstractCorrection],
) -> tuple[np.ndarray, ...]:
    t, f = remove_baseline(force, windows, i, rule, corrections)
    start, stop = np.searchsorted(t, [windows.ramp[i, 0], windows.release[i, 1]])
    t, f = t[start:stop], f[start:stop, 0]
    tp, p = remove_baseline(pressure, windows, i, rule, corrections)
    phase = np.searchsorted([windows.ramp[i, 1], windows.release[i, 0]], t, side="right")
    return t, resample(tp, p, t), f, np.full(len(t), i), phase


def press_samples(
    force: ReadableStream,
    pressure: ReadableStream,
    presses: PressColumns,
    windows: PressWindows,
    *,
    baseline: AbstractBaseline | None = None,
    corrections: Sequence[AbstractCorrection] = (),
) -> PressSamples:
    """Pair pressure with force over whole presses; pressure is interpolated to the time stamps of the force stream.

    Only the first column of the force stream is used. A missing sample of either stream is NaN.
    """
    rule = TwoSided() if baseline is None else baseline
    force_ahead, pressure_ahead = ReadAhead(force), ReadAhead(pressure)
    accepted = np.flatnonzero(presses.accepted)
    rows = [_press_rows(force_ahead, pressure_ahead, windows, int(i), rule, corrections) for i in accepted]
    if not rows:
        empty = np.empty(0, int)
        return PressSamples(empty, np.empty((0, pressure.channels)), np.empty(0), empty, empty)
    return PressSamples(*(np.concatenate(column) for column in zip(*rows, strict=True)))
