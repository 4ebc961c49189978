"""Compare the clocks of the streams with each other, because all streams record the same presses."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy import fft, ndimage

from ...presses.timing.onsets import OnsetDelay, onset_delays
from ...session.units import SECOND
from ..evidence import PressEvidence
from ..report import Finding, Severity
from .statistics import StreamStatistics

COMPARED_STREAMS = ("eit", "pressure")  # streams that rise with the force
CLOCKS_DISAGREE = "the clocks disagree: align the streams before the calibration"
ALLOWED_SHIFT = 0.3  # of the ramp, beyond which a shift of the whole rise is no property of the skin
MIN_ALLOWED_SHIFT = 0.05  # s
DELAY_SPREADS = 2.0  # of the delays over the presses: a clock is late by the same time in all of them
GRID_STEP, MAX_GRID = 0.05, 2**18  # s and samples of the time axis on which streams are correlated
SLOW = 30.0  # s: what is slower is drift
MAX_LAG = 60.0  # s
MIN_CHANGE_SHARE = 0.25  # of a change of the delays, by which the lags of the halves must differ
MIN_CORRELATION, MIN_GAIN = 0.7, 0.3  # of the streams when moved by the lag, and over that when they are not moved
CHANCE_SPREADS = 2.5  # of Fisher's z of two correlations over presses: less may be by chance
MIN_FISHER, MAX_FISHER = 3, 1 - 1e-9  # presses, at which z has no finite spread; correlation, of which z is finite


def beside(delay: float) -> str:
    """A delay, s, in words: "0.800 s before"."""
    return f"{abs(delay):.3f} s {'before' if delay < 0 else 'after'}"


def compare_clocks(
    statistics: Mapping[str, StreamStatistics], evidence: PressEvidence, findings: list[Finding]
) -> tuple[tuple[str, OnsetDelay], ...]:
    """Delays of the other streams after the force at the beginning of the presses; adds a finding for a wrong clock."""
    force = statistics.get("force")
    if force is None or evidence.force is None or force.dead.all():
        return ()
    presses, windows = evidence.compared()
    moving = [name for name in COMPARED_STREAMS if name in statistics and not statistics[name].dead.all()]
    streams = {name: statistics[name].stream for name in moving}
    onsets = onset_delays(force.stream, streams.values(), presses, windows)
    ramp = float(np.median(presses.t_hold0 - presses.t_press)) / SECOND
    starts = presses.t_press[presses.accepted]
    for name, onset in onsets.items():
        allowed = max(ALLOWED_SHIFT * ramp, MIN_ALLOWED_SHIFT) + 2 / streams[name].nominal_rate
        what = _clock_text(force, statistics[name], onset, allowed, ramp, starts)
        if what:
            findings.append(_disagreement(name, what))
    return tuple(sorted(onsets.items()))


def _clock_text(
    force: StreamStatistics,
    stats: StreamStatistics,
    onset: OnsetDelay,
    allowed: float,
    ramp: float,
    starts: np.ndarray,
) -> str:
    """How the clock of a stream disagrees with that of the force; empty if it does not."""
    if len(force.time) < 2 or len(stats.time) < 2 or not force.finite.any():
        return ""
    late = onset.presses and abs(onset.shift) > max(allowed, DELAY_SPREADS * onset.spread)
    whole = _lag(force, stats, -np.inf, np.inf, starts)
    # A tip that slides changes the readings late, and their activity with the force.
    late = late and (onset.shift < ramp / 2 or abs(whole.seconds - onset.delay) < 2 * allowed)
    # A stream that is late by more than a press rises with another press.
    if late and (not whole.clear or abs(whole.seconds - onset.delay) < 2 * allowed):
        return f"rises {beside(onset.delay)} the force; the ramp takes {ramp:.2f} s"
    if whole.clear:
        return f"comes {whole.text}"
    middle = float(force.time[0] + force.time[-1]) / 2
    first, second = _lag(force, stats, -np.inf, middle, starts), _lag(force, stats, middle, np.inf, starts)
    for name, half in (("first", first), ("second", second)):
        if half.clear and abs(half.seconds) > allowed:
            return f"comes, in the {name} half of the recording, {half.text}; a clock has jumped, or samples were lost"
    if abs(onset.change) > allowed and MIN_CHANGE_SHARE < (second.seconds - first.seconds) / onset.change < 1:
        sense = "grows" if onset.change > 0 else "falls"
        return (
            f"its delay after the force {sense} by {abs(onset.change):.3f} s from the first presses to the last ones: "
            "a clock runs at another rate, or has jumped"
        )
    return ""


class _Lag(NamedTuple):
    """The lag of a stream after the force: s, whether they resemble each other only when moved by it, and words."""

    seconds: float
    clear: bool
    text: str


def _lag(force: StreamStatistics, stats: StreamStatistics, start: float, stop: float, starts: np.ndarray) -> _Lag:
    """The lag of a stream after the force by their samples from ``start`` to ``stop`` (ns).

    ``starts`` are the times of the presses, ns.
    """
    here, there = ((t >= start) & (t <= stop) for t in (force.time, stats.time))
    if here.sum() < 2 or there.sum() < 2:
        return _Lag(0.0, False, "")
    values = np.nan_to_num(force.stream.read()[:, 0], nan=0.0)
    second = stats.time[there], np.nan_to_num(stats.activity)[there]
    lag, moved, unmoved = stream_lag((force.time[here], values[here]), second)
    alike = f"they correlate by {moved:.2f} when moved by as much, by {unmoved:.2f} as recorded"
    clear = moved > MIN_CORRELATION and moved - abs(unmoved) > MIN_GAIN
    starts = starts[(starts >= start) & (starts <= stop)]
    if clear and len(starts) and _of_whole_presses(lag, starts):
        clear = not _by_chance(moved, unmoved, len(starts))
    return _Lag(lag, clear, f"{beside(lag)} the force: {alike}")


def _of_whole_presses(lag: float, starts: np.ndarray) -> bool:
    """Whether a lag, s, moves most presses to the times of others, so that all rises agree with it and without it."""
    moved = starts + round(lag * SECOND)
    within = moved[(moved > starts[0] - SECOND) & (moved < starts[-1] + SECOND)]
    away = np.abs(within[:, None] - starts).min(1)
    return len(within) > 0 and bool(np.median(away) < MIN_ALLOWED_SHIFT * SECOND)


def _by_chance(moved: float, unmoved: float, presses: int) -> bool:
    """Whether so few presses, on places of uneven sensitivity, may correlate better with others than with their own."""
    if presses <= MIN_FISHER:
        return True
    spread = np.sqrt(2 / (presses - MIN_FISHER))  # of the difference of two correlations, by Fisher's z
    return bool(np.arctanh(min(moved, MAX_FISHER)) - np.arctanh(abs(unmoved)) < CHANCE_SPREADS * spread)


def stream_lag(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> tuple[float, float, float]:
    """Time (s) by which the second signal follows the first, and their correlations with and without that lag.

    Args:
        first, second: time stamps (n,) ns and values (n,) without NaN.
    """
    start, stop = (f(t[i] for t in (first[0], second[0])) for f, i in ((min, 0), (max, -1)))
    step = max(GRID_STEP, (stop - start) / SECOND / MAX_GRID)
    grid = start + np.arange(int((stop - start) / SECOND / step) + 1) * step * SECOND
    a, b = (_without_drift(np.interp(grid, time, values), step) for time, values in (first, second))
    size = np.linalg.norm(a) * np.linalg.norm(b)
    if not size > 0:
        return 0.0, 0.0, 0.0
    correlation = _correlate(b, a) / size
    lags = np.arange(1 - len(a), len(b)) * step
    within = np.abs(lags) <= MAX_LAG
    best = int(np.argmax(np.where(within, correlation, -np.inf)))
    return float(lags[best]), float(correlation[best]), float(correlation[len(a) - 1])


def _correlate(b: np.ndarray, a: np.ndarray) -> np.ndarray:
    """`scipy.signal.correlate` of all lags by Fourier transforms; to import scipy.signal takes longer than a check."""
    count = len(a) + len(b) - 1
    length = fft.next_fast_len(count, real=True)
    product = fft.rfft(b, length) * fft.rfft(a, length).conj()
    return np.asarray(np.roll(fft.irfft(product, length), len(a) - 1)[:count])


def _without_drift(values: np.ndarray, step: float) -> np.ndarray:
    width = int(SLOW / step)
    return np.asarray(values - ndimage.uniform_filter1d(values, width, mode="nearest"))


def _disagreement(name: str, what: str) -> Finding:
    return Finding(Severity.ERROR, f"/streams/{name}", what, CLOCKS_DISAGREE)
