"""Cut a session into presses on one clock.

All times are int64 nanoseconds since the session's epoch, all windows are half open. A press is

    t_press    contact begins          ramp     [t_press,   t_hold0)
    t_hold0    full load is reached    hold     [t_hold0,   t_hold1)
    t_hold1    unloading begins        release  [t_hold1,   t_release)
    t_release  contact ends

Functions take anything with these columns plus `accepted` and `reason`: a session's `PressTable`, or the
`Timeline` that `find_presses` reads off a force stream. A press that cannot be used is kept, with
`accepted` false and the reason in words.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol, TypeVar

import numpy as np
from scipy import ndimage

from calib.corrections import (
    AbstractBaseline,
    AbstractCorrection,
    Estimate,
    TwoSided,
    correct,
    sample_rate,
    window_estimate,
)

SECOND = 1_000_000_000
MAD_TO_SIGMA = 1.4826


class PressError(ValueError):
    """Streams in which presses cannot be looked for."""


class Readable(Protocol):
    """What a stream must offer; `calib.session.Stream` does, and so does `ArrayStream`."""

    @property
    def name(self) -> str: ...
    @property
    def channels(self) -> int: ...
    @property
    def time(self) -> np.ndarray: ...
    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray: ...


@dataclass(frozen=True, eq=False)
class ArrayStream:
    """A stream held in memory: `time` (n,) ns, `values` (n, channels) SI, NaN where missing."""

    name: str
    time: np.ndarray
    values: np.ndarray

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or len(self.time) != len(self.values):
            raise PressError(
                f"{self.name}: values must be (time, channels) with one row per time stamp, "
                f"not {self.values.shape} for {len(self.time)} time stamps."
            )

    @property
    def channels(self) -> int:
        return self.values.shape[1]

    def read(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        return self.values[start:stop]


@dataclass(frozen=True, eq=False)
class Timeline:
    """When presses happened, without where: the time columns of a `PressTable`, one entry per press.

    | field                                | meaning                          | unit |
    |--------------------------------------|----------------------------------|------|
    | t_press, t_hold0, t_hold1, t_release | see the module's text            | ns   |
    | level                                | median force over the hold       | N    |
    | accepted, reason                     | usable, and if not why           |      |
    """

    t_press: np.ndarray
    t_hold0: np.ndarray
    t_hold1: np.ndarray
    t_release: np.ndarray
    level: np.ndarray
    accepted: np.ndarray
    reason: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.t_press)


class Presses(Protocol):
    """Columns that cutting needs."""

    @property
    def t_press(self) -> np.ndarray: ...
    @property
    def t_hold0(self) -> np.ndarray: ...
    @property
    def t_hold1(self) -> np.ndarray: ...
    @property
    def t_release(self) -> np.ndarray: ...
    @property
    def accepted(self) -> np.ndarray: ...
    @property
    def reason(self) -> tuple[str, ...]: ...
    def __len__(self) -> int: ...


P = TypeVar("P", bound=Presses)


def reject(presses: P, reasons: Sequence[str]) -> P:
    """The same presses, with those that are given a reason no longer accepted; an earlier reason is kept."""
    why = tuple(old or new for old, new in zip(presses.reason, reasons, strict=True))
    accepted = presses.accepted & np.array([not r for r in reasons], bool)
    return replace(presses, accepted=accepted, reason=why)  # type: ignore[type-var]


# --- finding presses in a force stream -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finder:
    """How presses are told from noise; all lengths in seconds.

    | field         | meaning                                                                     |
    |---------------|-----------------------------------------------------------------------------|
    | smooth        | median filter against spikes                                                |
    | min_duration  | anything shorter is a knock                                                 |
    | min_hold      | a shorter plateau cannot be averaged                                        |
    | max_duration  | the longest press; the rest level is what lies below anything that long     |
    | max_missing   | tolerated fraction of missing samples within a press                        |
    | max_unsteady  | tolerated standard deviation during the hold, as a fraction of its level     |
    """

    smooth: float = 0.05
    min_duration: float = 0.2
    min_hold: float = 1.0
    max_duration: float = 15.0
    max_missing: float = 0.1
    max_unsteady: float = 0.1


def noise_level(values: np.ndarray) -> float:
    """Standard deviation of white noise on a slowly moving signal: 1.4826 MAD of first differences / sqrt 2.

    Ramps and steps are a minority of the differences and do not count. 0 for a signal that mostly repeats itself.
    """
    steps = np.diff(values[np.isfinite(values)])
    if not len(steps):
        return 0.0
    return float(MAD_TO_SIGMA * np.median(np.abs(steps - np.median(steps))) / np.sqrt(2))


def rest_level(force: np.ndarray, width: int) -> np.ndarray:
    """Slow level under a signal: opening (erosion, then dilation) removes whatever is shorter than `width` samples.

    An opening runs along the lowest noise; the median distance of samples close above it puts that back.
    """
    floor = ndimage.grey_opening(force, size=width, mode="nearest")
    floor = ndimage.uniform_filter1d(floor, width, mode="nearest")
    above = force - floor
    near = above <= np.median(above) if np.ptp(above) > 0 else np.ones(len(above), bool)
    return floor + np.median(above[near])


def _runs(flag: np.ndarray) -> np.ndarray:
    """(runs, 2) half-open index ranges where `flag` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flag, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def _hysteresis(signal: np.ndarray, low: float, high: float) -> np.ndarray:
    """Runs above `low` that somewhere exceed `high`."""
    runs = _runs(signal > low)
    return runs[[bool((signal[a:b] > high).any()) for a, b in runs]] if len(runs) else runs


def _plateau(signal: np.ndarray, noise: float) -> tuple[int, int, float]:
    """Start, stop and level of the hold within one press; early and late levels apart, since a hold may creep."""
    top = np.flatnonzero(signal >= 0.8 * np.quantile(signal, 0.98))
    first, last = top[0], top[-1] + 1
    third = max((last - first) // 3, 1)
    early, late = np.median(signal[first : first + third]), np.median(signal[last - third : last])
    start = first + np.argmax(signal[first:last] >= early - max(4 * noise, 0.01 * early))
    stop = last - np.argmax(signal[first:last][::-1] >= late - max(4 * noise, 0.01 * late))
    level = float(np.median(signal[start:stop])) if stop > start else float(late)
    return int(start), int(max(stop, start)), level


def _quantised(force: np.ndarray) -> float:
    """Smallest step between distinct values: what stands in for noise when there seems to be none."""
    steps = np.diff(np.unique(force))
    return float(steps.min()) if len(steps) else 0.0


def _why_not(finder: Finder, n: int, run, hold, rate, missing, unsteady) -> str:
    """The first reason to reject a press, or an empty text."""
    a, b = run
    seconds, held = (b - a) / rate, (hold[1] - hold[0]) / rate
    if a == 0:
        return "the record begins under load"
    if b == n:
        return "the record ends before the release"
    if seconds < finder.min_duration:
        return f"a knock of {seconds:.2f} s, shorter than {finder.min_duration:g} s"
    if missing > finder.max_missing:
        return f"{100 * missing:.0f} % of its force samples are missing"
    if held < finder.min_hold:
        return f"held for {held:.2f} s, shorter than {finder.min_hold:g} s"
    if unsteady > finder.max_unsteady:
        return f"force unsteady during the hold ({100 * unsteady:.0f} % of its level)"
    return ""


def _condition(time: np.ndarray, force: np.ndarray, finder: Finder):
    """Finite, spike-free force above its rest level, its noise, and its rate."""
    rate = sample_rate(time)
    good = np.isfinite(force)
    filled = np.interp(time, time[good], force[good])
    noise = max(noise_level(force), 0.5 * _quantised(force[good]))
    smooth = ndimage.median_filter(filled, 2 * round(finder.smooth * rate / 2) + 1, mode="nearest")
    width = min(2 * round(finder.max_duration * rate / 2) + 1, 2 * (len(force) // 2) - 1)
    return smooth - rest_level(smooth, max(width, 1)), noise, rate


def _auto_threshold(signal: np.ndarray, noise: float) -> float:
    """Above noise by far, and above 5 % of the strongest force: knocks and drift stay below."""
    return max(8 * noise, 0.05 * float(np.quantile(signal, 0.995)))


def find_presses(
    time: np.ndarray,
    force: np.ndarray,
    *,
    threshold: float | None = None,
    finder: Finder | None = None,
) -> Timeline:
    """Presses in a force stream alone, for sessions that come without a table.

    Contact is force above the drifting rest level by more than half of `threshold`, in a run that somewhere
    exceeds all of it (hysteresis). Left out, the threshold is 8 times the noise or 5 % of the strongest force.

    Args:
      time: (n,) ns. force: (n,) N, NaN where missing; pressing is positive.
      threshold: N. finder: lengths and tolerances.

    Returns: a `Timeline`, empty if nothing was found. Damaged and cut-off presses are in it, not accepted.
    Raises: `PressError` for fewer than ten samples or no finite one, or times that do not increase.
    """
    finder = Finder() if finder is None else finder
    time, force = np.asarray(time), np.asarray(force, float)
    if force.ndim != 1 or time.shape != force.shape:
        raise PressError(f"force must be (time,) like its time stamps, not {force.shape} and {time.shape}.")
    back = np.flatnonzero(time[1:] <= time[:-1]) + 1
    if len(back):
        raise PressError(f"time does not increase at sample {back[0]}: sort the samples and drop equal times.")
    if np.isfinite(force).sum() < 10:
        raise PressError("fewer than ten finite force samples: there is nothing to find presses in.")
    signal, noise, rate = _condition(time, force, finder)
    limit = _auto_threshold(signal, noise) if threshold is None else threshold
    runs = _hysteresis(signal, limit / 2, limit)
    return _timeline([_describe(time, force, signal, run, noise, rate, finder) for run in runs])


def _describe(time, force, signal, run, noise, rate, finder):
    """One row of a timeline: four times, level, reason."""
    a, b = run
    start, stop, level = _plateau(signal[a:b], noise)
    hold = a + start, a + stop
    missing = float(np.mean(~np.isfinite(force[a:b])))
    unsteady = float(np.std(signal[hold[0] : hold[1]]) / level) if hold[1] > hold[0] else 0.0
    reason = _why_not(finder, len(time), run, hold, rate, missing, unsteady)
    times = [int(time[min(i, len(time) - 1)]) for i in (a, *hold, b)]
    return (*times, level, reason)


def _timeline(rows: list[tuple]) -> Timeline:
    columns = list(zip(*rows, strict=True)) or [()] * 6
    press, hold0, hold1, release = (np.array(c, np.int64) for c in columns[:4])
    reason = tuple(columns[5])
    accepted = np.array([not r for r in reason], bool)
    return Timeline(press, hold0, hold1, release, np.array(columns[4], float), accepted, reason)


def locate(presses: Presses, stage: Readable) -> np.ndarray:
    """Median stage position (presses, channels) in m over each hold; NaN where the stage has no sample."""
    hold = np.stack([presses.t_hold0, presses.t_hold1], axis=1)
    rows = [stage.read(int(a), int(b)) for a, b in index_ranges(stage.time, hold)]
    with np.errstate(all="ignore"):
        return np.stack([np.median(r, axis=0) if len(r) else np.full(r.shape[1], np.nan) for r in rows])


# --- windows ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Windows:
    """Half-open time windows (presses, 2) ns, one row per press; `hold` is the last part of the hold."""

    rest_before: np.ndarray
    ramp: np.ndarray
    hold: np.ndarray
    release: np.ndarray
    rest_after: np.ndarray

    def centre(self, name: str) -> np.ndarray:
        """Middle of a window, (presses,) ns as float."""
        return getattr(self, name).astype(float).mean(axis=1)


@dataclass(frozen=True)
class Cutting:
    """Lengths of windows in seconds.

    | field    | meaning                                                                                   |
    |----------|-------------------------------------------------------------------------------------------|
    | hold     | averaged at the end of the hold, when the pad has relaxed                                 |
    | rest     | averaged before and after                                                                 |
    | recovery | how long after the release the rest window ends (or at the next press, if that is sooner) |
    | guard    | kept clear before a contact and at the end of the hold                                    |
    """

    hold: float = 1.0
    rest: float = 0.5
    recovery: float = 1.5
    guard: float = 0.05


def _ns(seconds: float) -> int:
    return round(seconds * SECOND)


def press_windows(presses: Presses, cutting: Cutting | None = None, end: int | None = None) -> Windows:
    """Windows of every press, accepted or not. Rest windows never reach into a neighbouring press,
    nor beyond `end` (ns), where the recording stops."""
    c = Cutting() if cutting is None else cutting
    guard = _ns(c.guard)
    press, hold0, hold1, release = (
        np.asarray(t, np.int64) for t in (presses.t_press, presses.t_hold0, presses.t_hold1, presses.t_release)
    )
    previous = np.concatenate([[np.iinfo(np.int64).min // 2], release[:-1]])
    last = np.iinfo(np.int64).max // 2 if end is None else end + guard
    following = np.concatenate([press[1:], [last]])
    before = press - guard
    after = np.minimum(release + _ns(c.recovery), following - guard)
    held = np.maximum(hold1 - guard, hold0)
    return Windows(
        rest_before=np.stack([np.clip(before - _ns(c.rest), previous, before), before], 1),
        ramp=np.stack([press, hold0], 1),
        hold=np.stack([np.maximum(held - _ns(c.hold), hold0), held], 1),
        release=np.stack([hold1, release], 1),
        rest_after=np.stack([np.clip(after - _ns(c.rest), np.minimum(release, after), after), after], 1),
    )


def recording_end(streams: Iterable[Readable]) -> int:
    """Time in ns at which the first of the streams has ended."""
    return min(int(stream.time[-1]) + 1 for stream in streams)


def index_ranges(time: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """(windows, 2) half-open index ranges of a stream's time stamps within time windows."""
    return np.searchsorted(time, windows, side="left")


def _said(window: np.ndarray) -> str:
    return f"between {window[0] / SECOND:.3f} s and {window[1] / SECOND:.3f} s"


_NOUNS = {"eit": "EIT frame"}


def check_overlap(presses: P, windows: Windows, streams: Iterable[Readable], baseline=None) -> P:
    """Reject presses for which a stream has no sample in the hold, or in a rest window that the baseline uses."""
    needed = ["rest_before", "hold"]
    both = TwoSided() if baseline is None else baseline
    if np.any(both.weights(np.array([0.5]), np.array([0.0]), np.array([1.0]))[1] != 0):
        needed.append("rest_after")
    for stream in streams:
        noun = _NOUNS.get(stream.name, f"{stream.name} sample")
        for name in needed:
            times = getattr(windows, name)
            empty = np.diff(index_ranges(stream.time, times), axis=1)[:, 0] == 0
            presses = reject(presses, [f"no {noun} {_said(w)}" if e else "" for w, e in zip(times, empty, strict=True)])
    return presses


# --- means and samples of presses ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PressMeans:
    """One stream's hold means, baseline removed; rows are presses.

    | field    | meaning                                            | shape              | unit       |
    |----------|----------------------------------------------------|--------------------|------------|
    | change   | hold mean less baseline; standard errors; counts   | (presses, channels) | stream's  |
    | baseline | baseline at the middle of the hold                 | (presses, channels) | stream's  |
    | rest     | mean of the rest window before                     | (presses, channels) | stream's  |
    """

    change: Estimate
    baseline: np.ndarray
    rest: np.ndarray

    def missing(self) -> np.ndarray:
        """(channels,) presses in which a channel has no value."""
        return np.isnan(self.change.mean).sum(axis=0)


# Filters are started this far outside the outermost window, so that their edges stay outside.
_MARGIN = SECOND // 2


def _span(time: np.ndarray, windows: Windows, i: int) -> tuple[int, int]:
    start, stop = windows.rest_before[i, 0] - _MARGIN, windows.rest_after[i, 1] + _MARGIN
    return tuple(int(k) for k in np.searchsorted(time, [start, stop]))  # type: ignore[return-value]


def _read_press(stream: Readable, windows: Windows, i: int, corrections) -> tuple[np.ndarray, np.ndarray]:
    """Time stamps and corrected values around one press: all that is ever held in memory."""
    a, b = _span(stream.time, windows, i)
    time = stream.time[a:b]
    return time, correct(corrections, time, stream.read(a, b), stream.name)


_AVERAGED = ("hold", "rest_before", "rest_after")


def _three_estimates(stream: Readable, windows: Windows, i: int, corrections) -> Estimate:
    """Means of one press over the three averaged windows, in the order of `_AVERAGED`."""
    time, values = _read_press(stream, windows, i, corrections)
    times = np.stack([getattr(windows, name)[i] for name in _AVERAGED])
    return window_estimate(values, index_ranges(time, times))


def press_means(
    stream: Readable,
    windows: Windows,
    *,
    baseline: AbstractBaseline | None = None,
    corrections: Sequence[AbstractCorrection] = (),
) -> PressMeans:
    """Hold means of every press with the baseline off. The stream is read press by press, never as a whole.

    Args:
      baseline: `TwoSided()` by default.
      corrections: applied to each press's stretch, half a second longer than its windows on both sides.
    Returns: rows for all presses; NaN where a channel has no finite sample in a window that is needed.
    """
    rule = TwoSided() if baseline is None else baseline
    parts = [_three_estimates(stream, windows, i, corrections) for i in range(len(windows.hold))]
    held, before, after = (_column(parts, k, stream.channels) for k in range(3))
    centres = tuple(windows.centre(name) for name in _AVERAGED)
    change = rule.remove(held, before, after, centres)
    return PressMeans(change, held.mean - change.mean, before.mean)


def _column(parts: list[Estimate], k: int, width: int) -> Estimate:
    """The k-th window of every press."""
    return Estimate(
        *(np.array([getattr(p, f.name)[k] for p in parts]).reshape(len(parts), width) for f in fields(Estimate))
    )


def resample(time: np.ndarray, values: np.ndarray, at: np.ndarray, max_gap: float = 3.0) -> np.ndarray:
    """Linear interpolation of (n, channels) at times `at`; NaN outside, and across gaps of missing samples.

    `max_gap`: the longest distance bridged, in median sample periods.
    """
    limit = max_gap * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    columns = [_resample_one(time, v, at, limit) for v in values.T]
    return np.stack(columns, axis=1) if columns else np.empty((len(at), 0))


def _resample_one(time, column, at, limit):
    good = np.isfinite(column)
    if good.sum() < 2:
        return np.full(len(at), np.nan)
    t = time[good]
    right = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    inside = (at >= t[0]) & (at <= t[-1]) & (t[right] - t[right - 1] <= limit)
    return np.where(inside, np.interp(at - t[0], t - t[0], column[good]), np.nan)


@dataclass(frozen=True, eq=False)
class PressSamples:
    """Ramp, hold and release of all accepted presses, sample by sample, for curve fitting.

    | field    | meaning                                  | shape     | unit |
    |----------|------------------------------------------|-----------|------|
    | time     | the force stream's own                   | (n,)      | ns   |
    | pressure | interpolated to `time`, baseline removed | (n, pads) | Pa   |
    | force    | baseline removed                         | (n,)      | N    |
    | press    | row of the press table                   | (n,)      |      |
    | phase    | 0 ramp, 1 hold, 2 release                | (n,)      |      |
    """

    time: np.ndarray
    pressure: np.ndarray
    force: np.ndarray
    press: np.ndarray
    phase: np.ndarray


def _off_baseline(stream: Readable, windows: Windows, i: int, rule, corrections):
    """Time stamps and values of one press with the baseline taken off every sample."""
    time, values = _read_press(stream, windows, i, corrections)
    rests = np.stack([windows.rest_before[i], windows.rest_after[i]])
    before, after = window_estimate(values, index_ranges(time, rests)).mean
    w0, w1 = rule.weights(time.astype(float), *rests.astype(float).mean(axis=1))
    off = np.where(w0[:, None] == 0, 0.0, w0[:, None] * before)
    off = off + np.where(w1[:, None] == 0, 0.0, w1[:, None] * after)
    return time, values - off


def _one_press(force: Readable, pressure: Readable, windows: Windows, i: int, rule, corrections):
    t, f = _off_baseline(force, windows, i, rule, corrections)
    start, stop = np.searchsorted(t, [windows.ramp[i, 0], windows.release[i, 1]])
    t, f = t[start:stop], f[start:stop, 0]
    tp, p = _off_baseline(pressure, windows, i, rule, corrections)
    phase = np.searchsorted([windows.ramp[i, 1], windows.release[i, 0]], t, side="right")
    return t, resample(tp, p, t), f, np.full(len(t), i), phase


def press_samples(
    force: Readable,
    pressure: Readable,
    presses: Presses,
    windows: Windows,
    *,
    baseline: AbstractBaseline | None = None,
    corrections: Sequence[AbstractCorrection] = (),
) -> PressSamples:
    """Pairs of pressure and force over whole presses; pressure is interpolated to the force stream's times.

    Of a force stream of several columns the first is taken. Missing samples are NaN in either.
    """
    rule = TwoSided() if baseline is None else baseline
    rows = [_one_press(force, pressure, windows, int(i), rule, corrections) for i in np.flatnonzero(presses.accepted)]
    if not rows:
        none = np.empty(0, int)
        return PressSamples(none, np.empty((0, pressure.channels)), np.empty(0), none, none)
    return PressSamples(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def dominant_pad(pressure: np.ndarray, share: float = 0.9) -> np.ndarray:
    """(presses,) pad that carries at least `share` of the positive pressure change (presses, pads), else -1.

    A press across a pad's edge loads two pads, and says little of either one's curve.
    """
    positive = np.maximum(np.nan_to_num(pressure), 0.0)
    total = positive.sum(axis=1)
    best = positive.argmax(axis=1)
    part = positive[np.arange(len(best)), best] / np.where(total > 0, total, np.inf)
    return np.where(part >= share, best, -1)


# --- do the clocks agree? --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Onset:
    """How much later than the force a stream rises: median and MAD-based spread over presses (s), presses used."""

    delay: float
    spread: float
    presses: int


def crossing(time: np.ndarray, signal: np.ndarray, level: float) -> float:
    """Time (ns, interpolated) at which `signal` first rises through `level` for good; NaN if it never does."""
    below = np.flatnonzero(signal < level)
    if not len(below) or below[-1] + 1 >= len(signal):
        return float("nan")
    i = below[-1]
    part = (level - signal[i]) / (signal[i + 1] - signal[i])
    return float(time[i] + part * (time[i + 1] - time[i]))


def _magnitude(values: np.ndarray) -> np.ndarray:
    """One signal from many channels: the norm over channels that are finite throughout."""
    good = np.isfinite(values).all(axis=0)
    return np.linalg.norm(values[:, good], axis=1)


def _rise(stream: Readable, windows: Windows, i: int, fraction: float, corrections) -> float:
    """Time of the rise through `fraction` of the way from rest to hold, relative to the contact."""
    time, values = _off_baseline(stream, windows, i, TwoSided(), corrections)
    signal = _magnitude(values)
    rest, hold = (
        float(signal[slice(*index_ranges(time, getattr(windows, name)[i]))].mean()) for name in ("rest_before", "hold")
    )
    stop = np.searchsorted(time, windows.hold[i, 0])
    return crossing(time[:stop], signal[:stop], rest + fraction * (hold - rest)) - windows.ramp[i, 0]


def onset_delays(
    force: Readable,
    others: Iterable[Readable],
    presses: Presses,
    windows: Windows,
    *,
    fraction: float = 0.5,
    corrections: Mapping[str, Sequence[AbstractCorrection]] | None = None,
) -> dict[str, Onset]:
    """How much later than the force each stream rises through `fraction` of its hold value: for the report only.

    A cross-check of clocks, not a clock: a curved response shifts the crossing too (a stream going as force**0.7
    crosses half its value sooner), so a delay well below the ramp time is not evidence of a wrong clock.
    """
    given = {} if corrections is None else corrections
    rows = np.flatnonzero(presses.accepted)

    def rises(stream):
        c = given.get(stream.name, ())
        return np.array([_rise(stream, windows, int(i), fraction, c) for i in rows])

    base = rises(force)
    return {s.name: _onset(rises(s) - base) for s in others}


def _onset(delay: np.ndarray) -> Onset:
    good = delay[np.isfinite(delay)] / SECOND
    if not len(good):
        return Onset(float("nan"), float("nan"), 0)
    middle = float(np.median(good))
    return Onset(middle, float(MAD_TO_SIGMA * np.median(np.abs(good - middle))), len(good))
