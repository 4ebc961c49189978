"""Mean change of each stream over the hold of each press, with the baseline removed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from ..session.units import SECOND
from .corrections import AbstractBaseline, AbstractCorrection, TwoSided, WindowMeans, correct, window_means
from .streams import READ_AHEAD_BYTES, ReadableStream, index_ranges
from .timing.times import PressColumns
from .timing.windows import PressWindows

FILTER_MARGIN = SECOND // 2  # ns read beyond the outermost windows, so that edge effects of filters stay outside them
AVERAGED_WINDOWS = ("hold", "rest_before", "rest_after")


@dataclass(frozen=True, eq=False)
class PressMeans:
    """Hold means of one stream with the baseline removed; rows are presses.

    | field    | meaning                                                        | shape               | unit       |
    |----------|----------------------------------------------------------------|---------------------|------------|
    | change   | hold mean minus baseline, with standard errors and counts      | (presses, channels) | stream's   |
    | baseline | baseline at the middle of the hold                             | (presses, channels) | stream's   |
    | rest     | mean of the rest window before the press                       | (presses, channels) | stream's   |
    """

    change: WindowMeans
    baseline: np.ndarray
    rest: np.ndarray

    def missing(self) -> np.ndarray:
        """Number of presses (channels,) in which a channel has no value."""
        return np.asarray(np.isnan(self.change.mean).sum(axis=0))


def _spans(time: np.ndarray, windows: PressWindows) -> np.ndarray:
    """Half-open index ranges (presses, 2) of the samples around each press, with the margin of filters."""
    start, stop = windows.rest_before[:, 0] - FILTER_MARGIN, windows.rest_after[:, 1] + FILTER_MARGIN
    return index_ranges(time, np.stack([start, stop], 1))


def read_press(
    stream: ReadableStream, windows: PressWindows, i: int, corrections: Sequence[AbstractCorrection]
) -> tuple[np.ndarray, np.ndarray]:
    """Time stamps (n,) ns and corrected values (n, channels) around press `i`."""
    ((a, b),) = _spans(stream.time, windows.rows(slice(i, i + 1))).tolist()
    time = stream.time[a:b]
    return time, correct(corrections, time, stream.read(a, b), stream.name)


def _read_blocks(spans: np.ndarray, rows: int) -> Iterator[slice]:
    """Slices of presses of these index ranges (presses, 2), each slice within so many rows of the stream."""
    first = 0
    for i in range(1, len(spans) + 1):
        if i == len(spans) or spans[i, 0] < spans[first, 0] or spans[i, 1] - spans[first, 0] > rows:
            yield slice(first, i)
            first = i


def _press_window_means(
    stream: ReadableStream, windows: PressWindows, corrections: Sequence[AbstractCorrection]
) -> Iterator[WindowMeans]:
    """Means over the three averaged windows of each press, in the order of `AVERAGED_WINDOWS`, in parts of presses."""
    time, spans = stream.time, _spans(stream.time, windows)
    ranges = index_ranges(time, np.stack([getattr(windows, name) for name in AVERAGED_WINDOWS], 1))
    # A filter sees each press alone, so that no press changes the means of another one.
    rows = 0 if corrections else READ_AHEAD_BYTES // (8 * max(stream.channels, 1))
    for presses in _read_blocks(spans, rows):
        a, b = int(spans[presses, 0].min()), int(spans[presses, 1].max())
        values = correct(corrections, time[a:b], stream.read(a, b), stream.name)
        yield window_means(values, np.clip(ranges[presses].reshape(-1, 2) - a, 0, b - a))


def press_means(
    stream: ReadableStream,
    windows: PressWindows,
    *,
    baseline: AbstractBaseline | None = None,
    corrections: Sequence[AbstractCorrection] = (),
) -> PressMeans:
    """Average each press over its hold and remove the baseline. The stream is read in blocks, never as a whole.

    Args:
      baseline: `TwoSided()` by default.
      corrections: applied to each press separately, from half a second before its windows to half a second after.
    Returns: rows for all presses; NaN where a channel has no finite sample in a window that the baseline uses.
    """
    rule = TwoSided() if baseline is None else baseline
    parts = list(_press_window_means(stream, windows, corrections))
    hold, before, after = (_select_window(parts, k, stream.channels) for k in range(3))
    centres = tuple(windows.centre(name) for name in AVERAGED_WINDOWS)
    change = rule.remove(hold, before, after, centres)
    return PressMeans(change, hold.mean - change.mean, before.mean)


def _select_window(parts: list[WindowMeans], k: int, width: int) -> WindowMeans:
    """The k-th window of every press."""
    columns = ([getattr(part, f.name)[k :: len(AVERAGED_WINDOWS)] for part in parts] for f in fields(WindowMeans))
    return WindowMeans(*(np.concatenate([np.empty((0, width)), *column]) for column in columns))


def hold_positions(presses: PressColumns, stage: ReadableStream) -> np.ndarray:
    """Median stage position (presses, channels) in m over each hold; NaN where the stage has no sample in the hold."""
    hold = np.stack([presses.t_hold0, presses.t_hold1], axis=1)
    rows = [stage.read(int(a), int(b)) for a, b in index_ranges(stage.time, hold)]
    with np.errstate(all="ignore"):
        places = [np.median(r, axis=0) if len(r) else np.full(r.shape[1], np.nan) for r in rows]
    return np.array(places).reshape(len(rows), stage.channels)


DOMINANT_SHARE = 0.9  # of a press, with which a pad carries it alone


def dominant_pad(pressure: np.ndarray, share: float = DOMINANT_SHARE) -> np.ndarray:
    """Pad (presses,) that carries at least `share` of the positive pressure change (presses, pads); -1 without one."""
    positive = np.maximum(np.nan_to_num(pressure), 0.0)
    total = positive.sum(axis=1)
    best = positive.argmax(axis=1)
    part = positive[np.arange(len(best)), best] / np.where(total > 0, total, np.inf)
    return np.where(part >= share, best, -1)
