"""Compare the frames of the untouched skin through a recording, which are alike from the first press to the last.

A cable that is plugged in anew, a gain that is changed, or a scan that loses its place changes all frames from then on
at once. The check finds the two presses between which the frames at rest change for good, then the frame.
"""

from dataclasses import dataclass

import numpy as np

from ...presses.streams import index_ranges
from ...session.units import SECOND
from ..evidence import PressEvidence
from ..parts import MIN_ROWS, time_text
from ..report import ChannelTable, Finding, Severity, listed
from ..streams.statistics import StreamStatistics
from .grouping import common_electrodes, readings_of_electrodes
from .model import SkinModel

WHERE = "/streams/eit"
# Root mean square of the change over that of the frame. Drift and creep reach 0.001 from press to press.
MIN_CHANGE = 0.05
MIN_SUDDEN = 0.5  # of the change, between two presses; a slow change is drift
ALIKE = 0.98  # correlation of frames that differ by a factor only
MAX_UNNAMED = 0.95  # correlation of frames that differ a little, in no way that has a name
MIN_LOCAL = 0.2  # change of a reading over its size that counts as a change of this reading
TIE = 0.01  # difference of misfits to the model that tells nothing
LOST = 0.1  # of the readings of an electrode, that are left where it is lost
SLIGHT = 1.25  # factor up to which a change of gain is a warning


@dataclass(frozen=True, eq=False)
class RestChange:
    """Median frames of the untouched skin before and after a sudden change, and the time of that change.

    | field         | meaning                              | shape       | unit |
    |---------------|--------------------------------------|-------------|------|
    | before, after | median frames; NaN where not known   | (readings,) | V    |
    | time          | of the first frame after the change  |             | ns   |
    """

    before: np.ndarray
    after: np.ndarray
    time: int


def rest_change(evidence: PressEvidence, stats: StreamStatistics) -> RestChange | None:
    """The largest sudden change of the untouched frames, if it is larger than drift."""
    frames, times = _rests(evidence, stats)
    if len(frames) < 2 * MIN_ROWS:
        return None
    known = np.isfinite(frames).all(0)
    if not known.any():
        return None
    splits = range(MIN_ROWS, len(frames) - MIN_ROWS + 1)
    row = splits[int(np.argmin([_scatter(frames[:row, known]) + _scatter(frames[row:, known]) for row in splits]))]
    before, after, size = (
        np.median(frames[:row], axis=0),
        np.median(frames[row:], axis=0),
        _least_change(frames[:, known], row),
    )
    least = min(_rms(before[known]), _rms(after[known]))
    # A loose contact spoils single rests, which no median follows. The change may fall into a rest.
    low, high = max(row - 2, 0), min(row + 1, len(frames) - 1)
    steps = [_rms((frames[b] - frames[a])[known]) for a, b in ((row - 1, row), (low, row), (row - 1, high))]
    if size < MIN_CHANGE * least or max(steps) < MIN_SUDDEN * size:
        return None
    return RestChange(before, after, _first_after(stats, before, after, int(times[low]), int(times[high])))


def _scatter(frames: np.ndarray) -> float:
    """Sum of the distances of frames (rows, readings) from their median."""
    return float(np.sqrt(np.mean((frames - np.median(frames, axis=0)) ** 2, axis=1)).sum())


def _least_change(frames: np.ndarray, row: int) -> float:
    """Least distance of a frame of the shorter part, before a row or from it on, to the median of the longer part.

    A median of two frames would follow one of a loose contact.
    """
    short, long = (frames[:row], frames[row:]) if 2 * row < len(frames) else (frames[row:], frames[:row])
    return min(_rms(frame - np.median(long, axis=0)) for frame in short)


def _rests(evidence: PressEvidence, stats: StreamStatistics) -> tuple[np.ndarray, np.ndarray]:
    """Mean frames of the rests before the presses and after the last one, with a value, and their times in ns."""
    if evidence.rests is None or not len(evidence.rests):
        return np.empty((0, 0)), np.empty(0)
    _, windows = evidence.compared()
    ((a, b),) = index_ranges(stats.time, windows.rest_after[-1:])
    last = stats.stream.read(int(a), int(b)).mean(0) if b > a else np.full(evidence.rests.shape[1], np.nan)
    frames = np.concatenate([evidence.rests, last[None]])
    times = np.append(windows.centre("rest_before"), windows.centre("rest_after")[-1])
    good = np.isfinite(frames).any(1)
    return frames[good], times[good]


def _first_after(stats: StreamStatistics, before: np.ndarray, after: np.ndarray, start: int, stop: int) -> int:
    """Time (ns) of the first frame between two times that looks more like ``after``, by bisection."""
    step, middle = np.nan_to_num(after - before), np.nan_to_num(after + before) / 2
    low, high = (int(np.searchsorted(stats.time, t)) for t in (start, stop))
    while high - low > 1:
        at = (low + high) // 2
        frame = np.nan_to_num(stats.stream.read(at, at + 1)[0])
        low, high = (low, at) if (frame - middle) @ step > 0 else (at, high)
    return int(stats.time[min(high, len(stats.time) - 1)])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


# --- words --------------------------------------------------------------------------------------------


def rest_finding(change: RestChange, start: int, table: ChannelTable, model: SkinModel | None) -> Finding | None:
    """What has changed at a sudden change of the untouched frames, and in which part of the recording it is wrong.

    None for a small change that has no name, such as that of a sheet which is left under load.
    """
    known = np.isfinite(change.before) & np.isfinite(change.after)
    first = _first_is_wrong(change, known, table, model)
    wrong, right = (change.before, change.after) if first else (change.after, change.before)
    when = time_text(first, (change.time - start) / SECOND)
    explained = _explanation(wrong, right, known, table, model)
    if explained is None:
        return None
    what, remedy, severity = explained
    return Finding(severity, WHERE, f"the frames of the untouched skin differ {when}: {what}", remedy)


def _first_is_wrong(change: RestChange, known: np.ndarray, table: ChannelTable, model: SkinModel | None) -> bool:
    """Whether the frames before the change are worse: less like the model, or of readings that are lost."""
    if model is None:
        away = np.abs(change.after - change.before)[known]
        moved = away > MIN_LOCAL * np.fmax(np.abs(change.before), np.abs(change.after))[known]
        if moved.mean() > 0.5:
            return False
        return _rms(change.before[known][moved]) < LOST * _rms(change.after[known][moved])
    before, after = (model.misfit(frame, known, table) for frame in (change.before, change.after))
    shape, amplitude = (a - b for a, b in zip(before, after, strict=True))
    return bool(shape > 0 if abs(shape) > TIE else amplitude > TIE)


def _explanation(
    wrong: np.ndarray, right: np.ndarray, known: np.ndarray, table: ChannelTable, model: SkinModel | None
) -> tuple[str, str, Severity] | None:
    """What the wrong frame is, compared with the right one; what to do; and how severe it is."""
    a, b = wrong[known], right[known]
    gain, alike = float(a @ b / (b @ b)), float(a @ b / np.sqrt((a @ a) * (b @ b))) if a.any() and b.any() else 0.0
    size = abs(gain)
    if abs(alike) > ALIKE and (gain < 0 or abs(np.log(size)) > MIN_CHANGE / 2):
        sign = "every sign is reversed" if gain < 0 else ""
        off = abs(np.log(size)) > MIN_CHANGE / 2
        factor = f"the amplitude is {size:.4g} times that of the other frames" if off else ""
        severity = Severity.WARNING if not sign and 1 / SLIGHT < size < SLIGHT else Severity.ERROR
        remedy = "look for a change of the unit, the gain, the drive current or the wires at that time"
        return " and ".join(filter(None, (sign, factor))), remedy, severity
    sizes = np.abs(a), np.abs(b)
    if ((a >= 0).all() or (a <= 0).all()) and np.corrcoef(*sizes)[0, 1] > ALIKE:
        return "magnitudes without sign", "record the signed (in-phase) voltage, not its amplitude", Severity.ERROR
    local = _local_explanation(wrong, right, known, table)
    if local is not None and local[2] is Severity.ERROR:
        return local
    order = None if model is None else model.check(wrong, known & ~table.dead, table)
    if order is not None and order.claimed:
        return order.what, f"{order.remedy}, or use the other part only", Severity.ERROR
    if local is not None:
        return local
    if alike > MAX_UNNAMED:
        return None
    what = f"they correlate by {alike:.2f} with the other frames"
    return what, "look for wires, plugs or a scan that changed at that time; use one part only", Severity.WARNING


def _local_explanation(
    wrong: np.ndarray, right: np.ndarray, known: np.ndarray, table: ChannelTable
) -> tuple[str, str, Severity] | None:
    """A change of the readings of one or two electrodes alone; a load that stays on one is no error."""
    floor = 0.1 * _rms(right[known])
    moved = known & (np.abs(wrong - right) > MIN_LOCAL * np.fmax(np.fmax(np.abs(wrong), np.abs(right)), floor))
    large = known & (np.abs(right) > floor)
    electrodes = common_electrodes(moved & large, readings_of_electrodes(table), large)
    if not electrodes:
        return None
    left = _rms(wrong[moved]) / max(_rms(right[moved]), np.finfo(float).tiny)
    name = " and ".join(map(str, electrodes))
    how = "hold no voltage" if left < LOST else f"have {left:.2g} times the voltage"
    what = f"{int(moved.sum())} readings {how} ({listed(np.flatnonzero(moved))}), all with electrode {name}"
    severity = Severity.ERROR if left < LOST else Severity.WARNING
    return what, f"check electrode {name}: its terminal, wire and switch", severity
