"""Convert device time to host time, from the ticks when frames were taken and the times when they arrived.

A frame arrives late, never early: by its latency and by the buffers on its way. The line of host time over device
time therefore lies below all points, and their lower convex hull determines it, however large the jitter is (Zhang,
Liu and Xia, INFOCOM 2002). The smallest latency remains as a constant; for a device that answers pings it is known
to half of the shortest round trip (`smallest_latency`). Lines of one minute each, joined at their middles, follow a
clock whose rate drifts. Counters are unwrapped by means of the host's clock. A device that sets its clock, or
restarts, begins a new segment.

Host times are ns of a monotonic clock (`time.monotonic_ns`).
"""

from dataclasses import dataclass, field

import numpy as np

from ..session.units import SECOND

METHOD = "lower convex hull of receive time over device ticks, 60 s windows"
MAX_SKEW = 0.05  # a clock farther off than this does not count ticks of the stated length
MAX_SEGMENTS = 1000
FIT_WINDOW, FIT_STEP, HULL_BLOCK = 60 * SECOND, 30 * SECOND, 10 * SECOND
MIN_RATE_SPAN = 3 * SECOND  # shorter spans do not determine the rate
MIN_TICK_SPAN = 10 * SECOND  # longer spans reveal a tick that is wrong by `MAX_SKEW`, shorter ones one more wrong
EARLY_LIMIT = 10_000_000  # ns: a frame that seems to arrive this long before it was sent reveals a clock step
INITIAL_EARLY_LIMIT = 50_000_000  # ns, while the jitter is not known
MAX_LEAD = 60 * SECOND  # of device time over host time between two frames: no connection delays frames that long
INITIAL_RATE_ERROR = 0.01  # of the time elapsed, while the rate is not known
MAX_BUFFERED = SECOND  # delay that buffers may cause across a new connection
CENTURY = 3.2e18  # ns
MAX_LATENCY = SECOND  # a larger latency in an answer to a ping means that another clock gave the answer


def lower_hull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the lower convex hull of points with increasing `x`; of points with equal `x` the lowest counts."""
    if len(x) > 1 and (x[1:] <= x[:-1]).any():
        order = np.lexsort((y, x))
        x, y = x[order], y[order]
        first = np.concatenate([[True], x[1:] > x[:-1]])
        x, y = x[first], y[first]
    while len(x) > 2:
        run, rise = np.diff(x), np.diff(y)
        keep = np.ones(len(x), bool)
        # A point on or above the chord of its neighbours is no vertex, whatever else is removed.
        keep[1:-1] = rise[:-1] * run[1:] < rise[1:] * run[:-1]
        if keep.all():
            break
        x, y = x[keep], y[keep]
    return x, y


def _rounded(ns: np.ndarray) -> np.ndarray:
    """Round to int64, within a century, because damaged counters may hold any value."""
    return np.asarray(np.rint(np.clip(ns, -CENTURY, CENTURY)).astype(np.int64))


@dataclass(frozen=True)
class DelayLine:
    """Delay beyond nominal device time: ``level`` (ns) at ``middle`` (ns), growing by ``skew`` (ns per ns)."""

    middle: float
    level: float
    skew: float

    def at(self, x: np.ndarray) -> np.ndarray:
        """Delay in ns at `x` ns of nominal device time."""
        return self.level + self.skew * (x - self.middle)


def supporting_line(x: np.ndarray, y: np.ndarray, middle: float, usual_skew: float = 0.0) -> DelayLine:
    """The line below all points of a lower hull that is closest to them at `middle`.

    `usual_skew` is used where the points span too short a time to determine the skew.
    """
    skew = usual_skew
    if x[-1] - x[0] >= MIN_RATE_SPAN:
        edge = int(np.clip(np.searchsorted(x, middle), 1, len(x) - 1))
        skew = float((y[edge] - y[edge - 1]) / (x[edge] - x[edge - 1]))
        skew = min(max(skew, -MAX_SKEW), MAX_SKEW)
    return DelayLine(middle, float(np.min(y - skew * (x - middle))), skew)


Points = tuple[np.ndarray, np.ndarray]


@dataclass
class _PointSegment:
    """Points of a segment in which the device's clock ran without a step: nominal device time and delay, both ns."""

    ticks: int  # unwrapped ticks of the first point
    host: int  # arrival of the first point
    last_ticks: int
    last_host: int
    blocks: list[Points] = field(default_factory=list)  # lower hulls of ten seconds each
    waiting: list[Points] = field(default_factory=list)
    span: float = 0.0  # from the first point to the last
    lowest: float = 0.0
    line: DelayLine | None = None
    line_due: float = SECOND
    lateness: float = 0.0  # mean delay above the line

    def extend(self, x: np.ndarray, y: np.ndarray) -> None:
        """Add points; `x` must not decrease."""
        if x[-1] // HULL_BLOCK == self.span // HULL_BLOCK:
            self._wait(x, y)
        else:
            cuts = np.searchsorted(x, np.arange(self.span // HULL_BLOCK + 1, x[-1] // HULL_BLOCK + 1) * HULL_BLOCK)
            for part in zip(np.split(x, cuts), np.split(y, cuts), strict=True):
                self._wait(*part)
        self.lowest = min(self.lowest, float(y.min()))
        if self.span >= self.line_due:
            self._update(x, y)

    def _wait(self, x: np.ndarray, y: np.ndarray) -> None:
        """Add points of one block."""
        if len(x):
            if x[0] // HULL_BLOCK > self.span // HULL_BLOCK:
                self._close_block()
            self.waiting.append((x, y))
            self.span = float(x[-1])

    def _update(self, x: np.ndarray, y: np.ndarray) -> None:
        self.line, self.line_due = self.latest(), self.span + SECOND
        if self.line is not None:
            self.lateness += 0.2 * (float(np.mean(y - self.line.at(x))) - self.lateness)

    def _close_block(self) -> None:
        self.blocks.append(self._open_block())
        self.waiting = []

    def _open_block(self) -> Points:
        self.waiting = [lower_hull(*_joined(self.waiting))]
        return self.waiting[0]

    def all_blocks(self) -> list[Points]:
        """Lower hulls of ten seconds each; the last one may not be full."""
        return [*self.blocks, self._open_block()]

    def latest(self) -> DelayLine | None:
        """The line of the last minute of points so far; None while the rate is not determined."""
        if self.span < MIN_RATE_SPAN:
            return None
        recent, since = [self._open_block()], self.span - FIT_WINDOW
        for block in reversed(self.blocks):
            if block[0][-1] < since:
                break
            recent.insert(0, block)
        x, y = lower_hull(*_joined(recent))
        return supporting_line(x, y, 0.5 * (x[0] + x[-1]))

    def early(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Which points lie so far below the line that the device's clock must have been set."""
        if self.line is None:
            return y < self.lowest - INITIAL_EARLY_LIMIT - INITIAL_RATE_ERROR * x
        return y < self.line.at(x) - EARLY_LIMIT - self.lateness


def _differences(values: np.ndarray, before: int | np.uint64) -> np.ndarray:
    """Difference of each value from the previous one, for the first from `before`; np.diff has more overhead."""
    out = np.empty_like(values)
    out[1:] = values[1:] - values[:-1]
    with np.errstate(over="ignore"):  # counters wrap
        out[:1] = values[:1] - values.dtype.type(before)
    return out


def _joined(points: list[Points]) -> Points:
    return np.concatenate([x for x, _ in points]), np.concatenate([y for _, y in points])


class DeviceClock:
    """Follows the clock of one device during a recording; `fit` returns the result.

    ``tick_s`` is the nominal length of a tick in s. `extend` takes frames in order. During the recording, `host_ns`
    estimates when frames were taken, on the host's clock (plus the smallest latency).
    """

    def __init__(self, tick_s: float):
        if not 0 < tick_s < 1e3:
            raise ValueError(f"clock: a tick of {tick_s} s; give its length in seconds, such as 1e-6")
        self.tick_ns = tick_s * 1e9
        self.samples = 0
        self.period: float | None = None  # typical device time from frame to frame, ns
        self._segments: list[_PointSegment] = []
        self._raw = np.uint64(0)

    @property
    def steps(self) -> int:
        """Number of times that the device's clock was set or restarted."""
        return max(len(self._segments) - 1, 0)

    def extend(
        self, ticks: np.ndarray, bits: int, host: np.ndarray, rejoined: np.ndarray, restarted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Add frames, each array (n,): counters of `bits` bits (u8), and arrival times (int64 ns).

        ``rejoined`` marks the first frame of a new connection, ``restarted`` frames where the sequence numbers
        restarted. Returns the unwrapped counters (int64), and which frames follow a step of the clock.
        """
        unwrapped, steps = np.zeros(len(ticks), np.int64), np.zeros(len(ticks), bool)
        done = 0
        while done < len(ticks):
            rest = slice(done, None)
            if not self._segments or steps[done]:
                self._begin(ticks[done], host[done])
                unwrapped[done] = self._segments[-1].ticks
                done += 1
                continue
            found = self._run_on(ticks[rest], bits, host[rest], rejoined[rest], restarted[rest])
            unwrapped[done : done + len(found)] = found
            done += len(found)
            steps[done : done + 1] = True
        self.samples += len(ticks)
        return unwrapped, steps

    def _begin(self, ticks: np.uint64, host: np.int64) -> None:
        first = int(ticks) % 2**62
        self._raw = ticks
        if len(self._segments) == MAX_SEGMENTS:  # such a clock is useless, and `ClockFit.valid` is False
            self._segments.pop()
        self._segments.append(_PointSegment(first, int(host), first, int(host)))
        self._segments[-1].extend(np.zeros(1), np.zeros(1))

    def _run_on(
        self, ticks: np.ndarray, bits: int, host: np.ndarray, rejoined: np.ndarray, restarted: np.ndarray
    ) -> np.ndarray:
        """Add frames up to the next step of the clock; returns their unwrapped counters."""
        now = self._segments[-1]
        between = _differences(host, now.last_host)
        forward = _differences(ticks, self._raw).view(np.int64)
        if bits < 64:  # add the number of whole turns that fits the host's clock best
            forward += (1 << bits) * np.rint((between / self.tick_ns - forward) / (1 << bits)).astype(np.int64)
        unwrapped = now.last_ticks + np.cumsum(forward)
        x = (unwrapped - now.ticks) * self.tick_ns
        y = (host - now.host) - x
        lag = np.abs(between - forward * self.tick_ns)
        # Frames that were held up and then arrive in a burst seem early too, but evenly by the device's own clock.
        period = self._typical_period(float(np.sort(forward)[len(forward) // 2]) * self.tick_ns)
        early = now.early(x, y) & (forward * self.tick_ns > period + EARLY_LIMIT)
        early |= forward * self.tick_ns > between + MAX_LEAD
        step = restarted | (forward < 0) | (rejoined & (lag > MAX_BUFFERED)) | early
        good = int(np.argmax(step)) if step.any() else len(step)
        if good:
            self._raw = ticks[good - 1]
            now.last_ticks, now.last_host = int(unwrapped[good - 1]), int(host[good - 1])
            now.extend(x[:good], y[:good])
        return unwrapped[:good]

    def _typical_period(self, period: float) -> float:
        """Smooth the time from frame to frame, given the median of the latest frames."""
        if period >= 0:
            self.period = period if self.period is None else self.period + 0.1 * (period - self.period)
        return self.period or 0.0

    def host_ns(self, unwrapped: np.ndarray) -> np.ndarray:
        """Estimate when frames of the present segment were taken, from the points so far, int64 ns."""
        now = self._segments[-1]
        x = (unwrapped - now.ticks) * self.tick_ns
        line = now.line or DelayLine(0.0, now.lowest, 0.0)
        return now.host + _rounded(x + line.at(x))

    def fit(self) -> "ClockFit":
        """Fit the clock to all frames so far."""
        return _clock_fit(self._segments, self.tick_ns, self.samples)


@dataclass(frozen=True, eq=False)
class ClockSegment:
    """One segment of a clock fit: knots as unwrapped ticks and host time (ns), both int and increasing."""

    ticks: np.ndarray
    host: np.ndarray
    skew: tuple[float, float]  # before the first knot, and after the last one
    tick_ns: float

    def host_ns(self, ticks: np.ndarray) -> np.ndarray:
        """Host time (int64 ns) of unwrapped `ticks`."""
        x = (np.asarray(ticks, np.int64) - int(self.ticks[0])) * self.tick_ns
        knots = (self.ticks - self.ticks[0]) * self.tick_ns
        delay = np.interp(x, knots, (self.host - self.host[0]) - knots)
        before, after = np.minimum(x, 0.0), np.maximum(x - knots[-1], 0.0)
        delay += self.skew[0] * before + self.skew[1] * after
        return int(self.host[0]) + _rounded(x + delay)


@dataclass(frozen=True, eq=False)
class ClockFit:
    """Device time against host time over a whole recording.

    | field        | meaning                                                                                      |
    |--------------|----------------------------------------------------------------------------------------------|
    | segments     | one between two steps of the clock                                                           |
    | skew         | of the longest segment: host time over device time, minus one                                |
    | residual_p95 | 95 % quantile (ns) of the distance of the earliest arrival of every ten seconds to the line  |
    | valid        | False if the device does not count ticks of the stated length, or has too many steps         |
    | tick_s       | measured length of a tick (s)                                                                |
    """

    segments: tuple[ClockSegment, ...]
    skew: float
    residual_p95: float
    valid: bool
    tick_s: float


@dataclass(frozen=True)
class Latency:
    """Smallest latency of frames in ns, known to half of the shortest round trip ``rtt`` (ns)."""

    ns: float
    rtt: float


NO_LATENCY = Latency(0.0, 0.0)  # the latency was not measured


def smallest_latency(fit: ClockFit, bits: int, sent: np.ndarray, received: np.ndarray, ticks: np.ndarray) -> Latency:
    """Constant offset between a clock fit and the host's clock, from pings and their answers.

    Args:
        bits: width of the device's counter.
        sent, received: host times of pings and answers (n,) int64 ns.
        ticks: counter of the device at the answers (n,) u8.

    The answer with the shortest round trip was given at the middle of it, to half of the round trip. Returns
    `NO_LATENCY` without answers, or if none fits the clock fit.
    """
    best = NO_LATENCY
    middle = sent + (received - sent) // 2
    for segment in fit.segments:
        late = segment.host_ns(_unwrapped(segment, bits, middle, ticks)) - middle
        for ns, rtt in zip(late, received - sent, strict=True):
            if rtt > 0 and -rtt <= ns < MAX_LATENCY and (not best.rtt or rtt < best.rtt):
                best = Latency(float(max(ns, 0)), float(rtt))
    return best


def _unwrapped(segment: ClockSegment, bits: int, host: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Unwrap counters near the `host` times like those of a segment; counters of 64 bits need no unwrapping."""
    if bits == 64:
        return (ticks % np.uint64(2**62)).astype(np.int64)
    raw = (ticks % np.uint64(1 << bits)).astype(np.int64)
    near = int(segment.ticks[0]) + (host - int(segment.host[0])) / segment.tick_ns
    return raw + (1 << bits) * np.rint((near - raw) / (1 << bits)).astype(np.int64)


def _clock_fit(points: list[_PointSegment], tick_ns: float, samples: int) -> ClockFit:
    if not points:
        return ClockFit((), 0.0, 0.0, False, tick_ns / 1e9)
    longest = max(points, key=lambda s: s.last_host - s.host)
    usual_skew = _lines(longest, 0.0)[0].skew
    fitted = [_lines(segment, usual_skew) for segment in points]
    segments = tuple(_fitted_segment(s, lines, tick_ns) for s, lines in zip(points, fitted, strict=True))
    residuals = np.concatenate([_block_residuals(p, s, tick_ns) for p, s in zip(points, segments, strict=True)])
    elapsed = longest.last_host - longest.host
    tick = elapsed / max(longest.last_ticks - longest.ticks, 1) if elapsed else tick_ns
    runs = len(segments) < MAX_SEGMENTS and len(segments) <= 1 + samples // 20
    valid = runs and not is_wrong_tick(tick / tick_ns, elapsed)
    return ClockFit(segments, usual_skew, float(np.quantile(residuals, 0.95)), valid, tick / 1e9)


def is_wrong_tick(ratio: float, elapsed: float) -> bool:
    """Whether a tick of `ratio` times the stated length is wrong: more so than late frames in `elapsed` ns explain."""
    tolerance = MAX_SKEW if elapsed > MIN_TICK_SPAN else 2 * MAX_BUFFERED / max(elapsed, 1)
    return max(ratio, 1 / ratio) - 1 > max(tolerance, MAX_SKEW)


def _lines(segment: _PointSegment, usual_skew: float) -> list[DelayLine]:
    """Lines of one minute every half minute; a single line for a shorter segment."""
    count = max(1, int((segment.span - FIT_WINDOW) // FIT_STEP) + 1)
    blocks = segment.all_blocks()
    begins = np.array([x[0] for x, _ in blocks])
    lines = []
    for start in np.arange(count) * FIT_STEP:
        stop = start + FIT_WINDOW if start < (count - 1) * FIT_STEP else segment.span + 1
        near = blocks[slice(*np.searchsorted(begins, np.array([start, stop])))]
        if near:  # empty in a long pause
            x, y = lower_hull(*_joined(near))
            lines.append(supporting_line(x, y, 0.5 * (x[0] + x[-1]), usual_skew))
    return lines


def _fitted_segment(segment: _PointSegment, lines: list[DelayLine], tick_ns: float) -> ClockSegment:
    """Knots at the middles of the lines, rounded to whole ticks."""
    ticks = np.unique(np.rint([line.middle / tick_ns for line in lines]).astype(np.int64))
    x = ticks * tick_ns
    delay = np.interp(x, [line.middle for line in lines], [line.level for line in lines])
    if len(lines) == 1:
        delay = lines[0].at(x)
    host = segment.host + np.rint(x + delay).astype(np.int64)
    return ClockSegment(segment.ticks + ticks, host, (lines[0].skew, lines[-1].skew), tick_ns)


def _block_residuals(points: _PointSegment, segment: ClockSegment, tick_ns: float) -> np.ndarray:
    """Distance of the lowest point of each block from the fitted segment, ns."""
    out = []
    for x, y in points.all_blocks():
        ticks = points.ticks + np.rint(x / tick_ns).astype(np.int64)
        out.append(np.abs(np.min(points.host + x + y - segment.host_ns(ticks))))
    return np.array(out)
