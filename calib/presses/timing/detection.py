"""Detect presses in a force stream."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from jaxeit.registry import limited, require_limits

from ..corrections import sample_rate
from ..streams import PressError, robust_deviation, true_runs
from .times import PressTimes

Run = tuple[int, int]  # first sample of a run, and the first sample after it

MIN_SAMPLES = 10  # finite force samples: fewer have no noise level worth the name
NOISE_MULTIPLE = 8  # the default threshold over the noise
FORCE_FRACTION = 0.05  # the default threshold over the strongest force, so that knocks and drift stay below it
TOP_FRACTION = 0.8  # of the strongest force of a press: samples above it belong to the plateau or its edges


@dataclass(frozen=True)
class DetectionLimits:
    """What separates a press from noise and knocks; all lengths in seconds.

    | field         | meaning                                                                       |
    |---------------|-------------------------------------------------------------------------------|
    | smooth        | width of the median filter that removes spikes                                |
    | min_duration  | a shorter contact is rejected as a knock                                      |
    | min_hold      | a press with a shorter plateau is rejected, because it cannot be averaged     |
    | max_duration  | longest press; the rest level is what remains when anything shorter is removed |
    | max_missing   | tolerated fraction of missing samples within a press                          |
    | max_unsteady  | tolerated standard deviation during the hold, as a fraction of the hold level |
    """

    smooth: float = limited(0.05, least=0)
    min_duration: float = limited(0.2, least=0)
    min_hold: float = limited(1.0, least=0)
    max_duration: float = limited(15.0, above=0)
    max_missing: float = limited(0.1, least=0, most=1)
    max_unsteady: float = limited(0.1, least=0)

    def __post_init__(self) -> None:
        require_limits(self)


def noise_level(values: np.ndarray) -> float:
    """Standard deviation of white noise on a slowly varying signal: 1.4826 MAD of first differences / sqrt 2.

    The median ignores ramps and steps, which are a minority of the differences. The result is 0 for a signal
    that mostly repeats one value.
    """
    steps = np.diff(values[np.isfinite(values)])
    return robust_deviation(steps - np.median(steps)) / float(np.sqrt(2)) if len(steps) else 0.0


def rest_level(force: np.ndarray, width: int) -> np.ndarray:
    """Slowly varying level under a signal: an opening (erosion, then dilation) removes what is shorter than `width`.

    `width` counts samples. An opening follows the lowest noise; adding the median distance of the samples close
    above it removes that bias.
    """
    floor = ndimage.grey_opening(force, size=width, mode="nearest")
    floor = ndimage.uniform_filter1d(floor, width, mode="nearest")
    above = force - floor
    near = above <= np.median(above) if np.ptp(above) > 0 else np.ones(len(above), bool)
    return np.asarray(floor + np.median(above[near]))


def _hysteresis(signal: np.ndarray, low: float, high: float) -> np.ndarray:
    """Runs above `low` that somewhere exceed `high`."""
    runs = true_runs(signal > low)
    return runs[[bool((signal[a:b] > high).any()) for a, b in runs]] if len(runs) else runs


def _plateau(signal: np.ndarray, noise: float) -> tuple[int, int, float]:
    """Start, stop and level of the hold within one press. Early and late levels differ, because a hold may creep."""
    top = np.flatnonzero(signal >= TOP_FRACTION * np.quantile(signal, 0.98))
    first, last = top[0], top[-1] + 1
    third = max((last - first) // 3, 1)
    early, late = np.median(signal[first : first + third]), np.median(signal[last - third : last])
    start = first + np.argmax(signal[first:last] >= early - max(4 * noise, 0.01 * early))
    stop = last - np.argmax(signal[first:last][::-1] >= late - max(4 * noise, 0.01 * late))
    level = float(np.median(signal[start:stop])) if stop > start else float(late)
    return int(start), int(max(stop, start)), level


def _quantisation_step(force: np.ndarray) -> float:
    """Smallest step between distinct values: a lower bound of the noise of a signal that mostly repeats one value."""
    steps = np.diff(np.unique(force))
    return float(steps.min()) if len(steps) else 0.0


def _rejection_reason(
    limits: DetectionLimits, samples: int, run: Run, hold: Run, rate: float, missing: float, unsteady: float
) -> str:
    """The first reason to reject a press, or an empty text."""
    a, b = run
    seconds, held = (b - a) / rate, (hold[1] - hold[0]) / rate
    if a == 0:
        return "the record begins under load"
    if b == samples:
        return "the record ends before the release"
    if seconds < limits.min_duration:
        return f"a knock of {seconds:.2f} s, shorter than {limits.min_duration:g} s"
    if missing > limits.max_missing:
        return f"{100 * missing:.0f} % of its force samples are missing"
    if held < limits.min_hold:
        return f"held for {held:.2f} s, shorter than {limits.min_hold:g} s"
    if unsteady > limits.max_unsteady:
        return f"force unsteady during the hold ({100 * unsteady:.0f} % of its level)"
    return ""


def _preprocess(time: np.ndarray, force: np.ndarray, limits: DetectionLimits) -> tuple[np.ndarray, float, float]:
    """Force without gaps, spikes and rest level (N), its noise (N) and its sample rate (Hz)."""
    rate = sample_rate(time)
    good = np.isfinite(force)
    filled = np.interp(time, time[good], force[good])
    noise = max(noise_level(force), 0.5 * _quantisation_step(force[good]))
    smooth = ndimage.median_filter(filled, 2 * round(limits.smooth * rate / 2) + 1, mode="nearest")
    width = min(2 * round(limits.max_duration * rate / 2) + 1, 2 * (len(force) // 2) - 1)
    return smooth - rest_level(smooth, max(width, 1)), noise, rate


def _default_threshold(signal: np.ndarray, noise: float) -> float:
    return max(NOISE_MULTIPLE * noise, FORCE_FRACTION * float(np.quantile(signal, 0.995)))


def find_presses(
    time: np.ndarray,
    force: np.ndarray,
    *,
    threshold: float | None = None,
    limits: DetectionLimits | None = None,
) -> PressTimes:
    """Detect presses in a force stream, for sessions without a table of presses.

    A press is a run of force above the drifting rest level by more than half of `threshold`, with at least one
    sample above the whole of it (hysteresis).

    Args:
        time: (n,) ns.
        force: (n,) N, NaN where missing; pressing is positive.
        threshold: N. Default: 8 times the noise or 5 % of the strongest force, whichever is larger.
        limits: lengths and tolerances.

    Returns:
        `PressTimes`, empty if nothing was found. It includes damaged and cut-off presses, which are not accepted.

    Raises:
        PressError: for fewer than ten finite samples, or for times that do not increase.
    """
    limits = DetectionLimits() if limits is None else limits
    time, force = np.asarray(time), np.asarray(force, float)
    if force.ndim != 1 or time.shape != force.shape:
        raise PressError(f"force must be (time,) like its time stamps, not {force.shape} and {time.shape}.")
    back = np.flatnonzero(time[1:] <= time[:-1]) + 1
    if len(back):
        raise PressError(f"time does not increase at sample {back[0]}: sort the samples and drop equal times.")
    if np.isfinite(force).sum() < MIN_SAMPLES:
        raise PressError(f"{np.isfinite(force).sum()} finite force samples; presses are found in {MIN_SAMPLES} or more")
    signal, noise, rate = _preprocess(time, force, limits)
    high = _default_threshold(signal, noise) if threshold is None else threshold
    runs = _hysteresis(signal, high / 2, high)
    return _press_times([_measure_press(time, force, signal, (a, b), noise, rate, limits) for a, b in runs.tolist()])


def _measure_press(
    time: np.ndarray,
    force: np.ndarray,
    signal: np.ndarray,
    run: Run,
    noise: float,
    rate: float,
    limits: DetectionLimits,
) -> tuple[Any, ...]:
    """Four times, level and rejection reason of one press."""
    a, b = run
    start, stop, level = _plateau(signal[a:b], noise)
    hold = a + start, a + stop
    missing = float(np.mean(~np.isfinite(force[a:b])))
    unsteady = float(np.std(signal[hold[0] : hold[1]]) / level) if hold[1] > hold[0] else 0.0
    reason = _rejection_reason(limits, len(time), run, hold, rate, missing, unsteady)
    times = [int(time[min(i, len(time) - 1)]) for i in (a, *hold, b)]
    return (*times, level, reason)


def _press_times(rows: list[tuple[Any, ...]]) -> PressTimes:
    columns = list(zip(*rows, strict=True)) or [()] * 6
    press, hold0, hold1, release = (np.array(c, np.int64) for c in columns[:4])
    reason = tuple(columns[5])
    accepted = np.array([not r for r in reason], bool)
    return PressTimes(press, hold0, hold1, release, np.array(columns[4], float), accepted, reason)
