"""Compare the clocks of the streams with each other, because all streams record the same presses."""

from collections.abc import Iterator, Mapping

import numpy as np
from scipy import ndimage, signal

from ...presses.onsets import OnsetDelay, onset_delays
from ...session import Stream
from ...session.units import SECOND
from ..evidence import PressEvidence
from ..report import Finding, Severity
from .statistics import StreamStatistics

ALLOWED_SHIFT = 0.3  # of the ramp, beyond which a shift of the whole rise is no property of the skin
MIN_ALLOWED_SHIFT = 0.05  # s
SPREADS = 2.0  # of the delays over the presses: a clock is late by the same time in all of them
GRID_STEP, MAX_GRID = 0.05, 2**18  # s and samples of the time axis on which streams are correlated
SLOW = 30.0  # s: what is slower is drift
MAX_LAG = 60.0  # s
MIN_CORRELATION, MIN_GAIN = 0.7, 0.3  # of the streams when moved by the lag, and over that when they are not moved


def beside(delay: float) -> str:
    """A delay, s, in words: "0.800 s before"."""
    return f"{abs(delay):.3f} s {'before' if delay < 0 else 'after'}"


def compare_clocks(
    streams: Mapping[str, Stream], evidence: PressEvidence, findings: list[Finding]
) -> tuple[tuple[str, OnsetDelay], ...]:
    """Delays of the other streams after the force at the beginning of the presses; adds a finding for a wrong clock."""
    if "force" not in streams:
        return ()
    presses, windows = evidence.compared()
    onsets = onset_delays(streams["force"], [s for n, s in streams.items() if n != "force"], presses, windows)
    ramp = float(np.median(presses.t_hold0 - presses.t_press)) / SECOND
    for name, onset in onsets.items():
        allowed = max(ALLOWED_SHIFT * ramp, MIN_ALLOWED_SHIFT) + 2 / streams[name].nominal_rate
        if onset.presses and abs(onset.shift) > max(allowed, SPREADS * onset.spread):
            what = f"rises {beside(onset.delay)} the force; the ramp takes {ramp:.2f} s"
            findings.append(_disagreement(name, what))
    return tuple(sorted(onsets.items()))


def lag_findings(statistics: Mapping[str, StreamStatistics], known: list[Finding]) -> Iterator[Finding]:
    """Findings for streams that resemble the force only when shifted by seconds, except streams known to be late."""
    force = statistics.get("force")
    if force is None or len(force.time) < 2 or not force.finite.any():
        return
    values = np.nan_to_num(force.stream.read()[:, 0], nan=0.0)
    late = {f.where for f in known if "the force; the ramp takes" in f.what}
    for name in ("eit", "pressure"):
        stats = statistics.get(name)
        if stats is None or f"/streams/{name}" in late or len(stats.time) < 2:
            continue
        lag, moved, unmoved = stream_lag((force.time, values), (stats.time, np.nan_to_num(stats.activity)))
        if moved > MIN_CORRELATION and moved - abs(unmoved) > MIN_GAIN:
            what = (
                f"comes {beside(lag)} the force: they correlate by {moved:.2f} when moved by as much, "
                f"by {unmoved:.2f} as recorded"
            )
            yield _disagreement(name, what)


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
    correlation = signal.correlate(b, a, method="fft") / size
    lags = np.arange(1 - len(a), len(b)) * step
    within = np.abs(lags) <= MAX_LAG
    best = int(np.argmax(np.where(within, correlation, -np.inf)))
    return float(lags[best]), float(correlation[best]), float(correlation[len(a) - 1])


def _without_drift(values: np.ndarray, step: float) -> np.ndarray:
    width = int(SLOW / step)
    return np.asarray(values - ndimage.uniform_filter1d(values, width, mode="nearest"))


def _disagreement(name: str, what: str) -> Finding:
    remedy = "the clocks disagree: align the streams before the calibration"
    return Finding(Severity.ERROR, f"/streams/{name}", what, remedy)
