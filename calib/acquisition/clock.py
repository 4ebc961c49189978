"""Device time to host time, from when frames were taken (ticks) and when they arrived.

A frame arrives late, never early: by its latency and by whatever batched it on the way. So the line of
device against host time lies *under* the points, and the lower convex hull finds it, however large the
jitter (Zhang, Liu and Xia, INFOCOM 2002). What remains is the smallest latency, a constant: a device that
answers pings tells it, to half of the shortest round trip (`latency`). Lines of one minute, joined at
their middles, follow a clock whose rate drifts. Counters are unwrapped beside the host's clock, and a
device that sets its clock or restarts begins a new segment.

Host times are ns of a clock that is never set (`time.monotonic_ns`).
"""

from dataclasses import dataclass, field

import numpy as np

METHOD = "lower convex hull of receive time over device ticks, 60 s windows"
MAX_SKEW = 0.05  # a clock farther off than this is not counting what it is said to count
MAX_SEGMENTS = 1000
_SECOND = 10**9
_WINDOW, _HOP, _BLOCK = 60 * _SECOND, 30 * _SECOND, 10 * _SECOND
_SHORTEST = 3 * _SECOND  # shorter spans tell nothing about the rate
_TELLING = 10 * _SECOND  # by then a tick of another length shows
_EARLY = 10_000_000  # ns: frames that seem to come so long before they were sent show a step
_EARLY_AT_FIRST = 50_000_000  # while the jitter is not known
_LEAP = 60 * _SECOND  # ahead of the host from one frame to the next: no device is held up like that
_UNSURE = 0.01  # of the time elapsed, while the rate is not known
_REJOIN = _SECOND  # what a buffer may hold back across a new connection
_CENTURY = 3.2e18
_LATEST = _SECOND  # an answer that says more was given by another clock


def lower_hull(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of the lower convex hull of points with increasing `x` (repeated ones: the lowest counts)."""
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


def _whole(ns: np.ndarray) -> np.ndarray:
    """Rounded to int64, within a century: counters may hold nonsense."""
    return np.rint(np.clip(ns, -_CENTURY, _CENTURY)).astype(np.int64)


@dataclass(frozen=True)
class Line:
    """Delay beyond nominal device time: ``level`` (ns) at ``middle``, growing by ``skew`` per ns."""

    middle: float
    level: float
    skew: float

    def at(self, x: np.ndarray) -> np.ndarray:
        """Its value at `x` ns of nominal device time."""
        return self.level + self.skew * (x - self.middle)


def supporting_line(x: np.ndarray, y: np.ndarray, middle: float, usual: float = 0.0) -> Line:
    """The line under all points of a lower hull that is nearest to them at `middle`.

    `usual` is the skew to take where the points span too short a time to tell.
    """
    skew = usual
    if x[-1] - x[0] >= _SHORTEST:
        edge = int(np.clip(np.searchsorted(x, middle), 1, len(x) - 1))
        skew = float((y[edge] - y[edge - 1]) / (x[edge] - x[edge - 1]))
        skew = min(max(skew, -MAX_SKEW), MAX_SKEW)
    return Line(middle, float(np.min(y - skew * (x - middle))), skew)


Points = tuple[np.ndarray, np.ndarray]


@dataclass
class _Segment:
    """A stretch in which the device's clock ran on: points as nominal device time and delay, ns."""

    ticks: int  # the first, as unwrapped
    host: int  # when it arrived
    last_ticks: int
    last_host: int
    blocks: list[Points] = field(default_factory=list)  # lower hulls of ten seconds each
    waiting: list[Points] = field(default_factory=list)
    span: float = 0.0  # from the first point to the last
    lowest: float = 0.0
    line: Line | None = None
    line_due: float = _SECOND
    lateness: float = 0.0  # mean delay above the line

    def extend(self, x: np.ndarray, y: np.ndarray) -> None:
        """More points; `x` does not decrease."""
        if x[-1] // _BLOCK == self.span // _BLOCK:
            self._wait(x, y)
        else:
            cuts = np.searchsorted(x, np.arange(self.span // _BLOCK + 1, x[-1] // _BLOCK + 1) * _BLOCK)
            for part in zip(np.split(x, cuts), np.split(y, cuts), strict=True):
                self._wait(*part)
        self.lowest = min(self.lowest, float(y.min()))
        if self.span >= self.line_due:
            self._update(x, y)

    def _wait(self, x: np.ndarray, y: np.ndarray) -> None:
        """Points of one block."""
        if len(x):
            if x[0] // _BLOCK > self.span // _BLOCK:
                self._close_block()
            self.waiting.append((x, y))
            self.span = float(x[-1])

    def _update(self, x: np.ndarray, y: np.ndarray) -> None:
        self.line, self.line_due = self.latest(), self.span + _SECOND
        if self.line is not None:
            self.lateness += 0.2 * (float(np.mean(y - self.line.at(x))) - self.lateness)

    def _close_block(self) -> None:
        self.blocks.append(self._open_block())
        self.waiting = []

    def _open_block(self) -> Points:
        self.waiting = [lower_hull(*_joined(self.waiting))]
        return self.waiting[0]

    def all_blocks(self) -> list[Points]:
        """Lower hulls of ten seconds each, the last one not yet full."""
        return [*self.blocks, self._open_block()]

    def latest(self) -> Line | None:
        """The line of the last minute, from what has arrived so far; None while that tells little."""
        if self.span < _SHORTEST:
            return None
        recent, since = [self._open_block()], self.span - _WINDOW
        for block in reversed(self.blocks):
            if block[0][-1] < since:
                break
            recent.insert(0, block)
        x, y = lower_hull(*_joined(recent))
        return supporting_line(x, y, 0.5 * (x[0] + x[-1]))

    def early(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Which points lie so far under the line that the device's clock must have been set."""
        if self.line is None:
            return y < self.lowest - _EARLY_AT_FIRST - _UNSURE * x
        return y < self.line.at(x) - _EARLY - self.lateness


def _steps(values: np.ndarray, before) -> np.ndarray:
    """From each value to the next, the first from `before`; as np.diff without its overhead."""
    out = np.empty_like(values)
    out[1:] = values[1:] - values[:-1]
    with np.errstate(over="ignore"):  # counters wrap
        out[:1] = values[:1] - values.dtype.type(before)
    return out


def _joined(points: list[Points]) -> Points:
    return np.concatenate([x for x, _ in points]), np.concatenate([y for _, y in points])


class DeviceClock:
    """Follows the clock of one device while it counts; `timeline` says what was found.

    ``tick_s`` is the nominal length of a tick in s. `extend` takes frames in order; online, `host_ns` gives
    the time on the host's clock at which frames were taken (plus the smallest latency).
    """

    def __init__(self, tick_s: float):
        if not 0 < tick_s < 1e3:
            raise ValueError(f"clock: a tick of {tick_s} s; give its length in seconds, such as 1e-6")
        self.tick_ns = tick_s * 1e9
        self.samples = 0
        self.period: float | None = None  # usual device time from frame to frame, ns
        self._segments: list[_Segment] = []
        self._raw = np.uint64(0)

    @property
    def steps(self) -> int:
        """How often the device's clock was set or began anew."""
        return max(len(self._segments) - 1, 0)

    def extend(
        self, ticks: np.ndarray, bits: int, host: np.ndarray, rejoined: np.ndarray, restarted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """More frames, each (n,): counters of `bits` bits (u8), and when they arrived (int64 ns).

        ``rejoined`` marks the first frame of a new connection, ``restarted`` where sequence numbers
        began anew. Returns the unwrapped counters, int64, and which frames follow a step of the clock.
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
        if len(self._segments) == MAX_SEGMENTS:  # a clock like that is of no use: `valid` says so
            self._segments.pop()
        self._segments.append(_Segment(first, int(host), first, int(host)))
        self._segments[-1].extend(np.zeros(1), np.zeros(1))

    def _run_on(self, ticks, bits, host, rejoined, restarted) -> np.ndarray:
        """Take frames up to the next step of the clock; their unwrapped counters."""
        now = self._segments[-1]
        between = _steps(host, now.last_host)
        forward = _steps(ticks, self._raw).view(np.int64)
        if bits < 64:  # plus the whole turns that suit the host's clock
            forward += (1 << bits) * np.rint((between / self.tick_ns - forward) / (1 << bits)).astype(np.int64)
        unwrapped = now.last_ticks + np.cumsum(forward)
        x = (unwrapped - now.ticks) * self.tick_ns
        y = (host - now.host) - x
        lag = np.abs(between - forward * self.tick_ns)
        # A burst of frames that were held up comes early too, but evenly by the device's own clock.
        usual = self._usual(float(np.sort(forward)[len(forward) // 2]) * self.tick_ns)
        early = now.early(x, y) & (forward * self.tick_ns > usual + _EARLY)
        early |= forward * self.tick_ns > between + _LEAP
        step = restarted | (forward < 0) | (rejoined & (lag > _REJOIN)) | early
        good = int(np.argmax(step)) if step.any() else len(step)
        if good:
            self._raw = ticks[good - 1]
            now.last_ticks, now.last_host = int(unwrapped[good - 1]), int(host[good - 1])
            now.extend(x[:good], y[:good])
        return unwrapped[:good]

    def _usual(self, period: float) -> float:
        """The usual time from frame to frame, given that of the latest ones."""
        if period >= 0:
            self.period = period if self.period is None else self.period + 0.1 * (period - self.period)
        return self.period or 0.0

    def host_ns(self, unwrapped: np.ndarray) -> np.ndarray:
        """When frames of the present segment were taken, from what has arrived so far, int64 ns."""
        now = self._segments[-1]
        x = (unwrapped - now.ticks) * self.tick_ns
        line = now.line or Line(0.0, now.lowest, 0.0)
        return now.host + _whole(x + line.at(x))

    def timeline(self) -> "Timeline":
        """What all frames so far say about the clock."""
        return _timeline(self._segments, self.tick_ns, self.samples)


@dataclass(frozen=True, eq=False)
class Stretch:
    """One segment of a timeline: knots as ticks (unwrapped) and host time, both int, increasing."""

    ticks: np.ndarray
    host: np.ndarray
    skew: tuple[float, float]  # before the first knot and after the last
    tick_ns: float

    def host_ns(self, ticks: np.ndarray) -> np.ndarray:
        """Host time, int64 ns, of unwrapped `ticks`."""
        x = (np.asarray(ticks, np.int64) - int(self.ticks[0])) * self.tick_ns
        knots = (self.ticks - self.ticks[0]) * self.tick_ns
        delay = np.interp(x, knots, (self.host - self.host[0]) - knots)
        before, after = np.minimum(x, 0.0), np.maximum(x - knots[-1], 0.0)
        delay += self.skew[0] * before + self.skew[1] * after
        return int(self.host[0]) + _whole(x + delay)


@dataclass(frozen=True, eq=False)
class Timeline:
    """Device time to host time of a whole recording.

    ``stretches``, one per segment between steps; ``skew`` of the longest, host over device minus one;
    ``residual_p95`` (ns) of the earliest arrivals of every ten seconds above the line; ``valid`` is
    False where the device does not count ticks of the length it is said to, ``tick_s`` what it counts.
    """

    stretches: tuple[Stretch, ...]
    skew: float
    residual_p95: float
    valid: bool
    tick_s: float


@dataclass(frozen=True)
class Latency:
    """The smallest latency of frames, ns, known to half of the shortest round trip, ``rtt``."""

    ns: float
    rtt: float


NO_LATENCY = Latency(0.0, 0.0)  # none was measured


def latency(timeline: Timeline, bits: int, sent: np.ndarray, received: np.ndarray, ticks: np.ndarray) -> Latency:
    """What is left between a timeline and the host's clock, by pings and their answers.

    Args:
        bits: of the device's counter.
        sent, received: host times of pings and answers (n,) int64 ns; ``ticks`` (n,) u8: the counter in between.

    The answer with the shortest round trip was given at its middle, to half of it. No answers, or none that
    fits the timeline: `NO_LATENCY`.
    """
    best = NO_LATENCY
    middle = sent + (received - sent) // 2
    for stretch in timeline.stretches:
        late = stretch.host_ns(_unwrapped(stretch, bits, middle, ticks)) - middle
        for ns, rtt in zip(late, received - sent, strict=True):
            if rtt > 0 and -rtt <= ns < _LATEST and (not best.rtt or rtt < best.rtt):
                best = Latency(float(max(ns, 0)), float(rtt))
    return best


def _unwrapped(stretch: Stretch, bits: int, host: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Counters near `host` times, with the whole turns of a stretch; of 64 bits as they are."""
    if bits == 64:
        return (ticks % np.uint64(2**62)).astype(np.int64)
    raw = (ticks % np.uint64(1 << bits)).astype(np.int64)
    near = int(stretch.ticks[0]) + (host - int(stretch.host[0])) / stretch.tick_ns
    return raw + (1 << bits) * np.rint((near - raw) / (1 << bits)).astype(np.int64)


def _timeline(segments: list[_Segment], tick_ns: float, samples: int) -> Timeline:
    if not segments:
        return Timeline((), 0.0, 0.0, False, tick_ns / 1e9)
    longest = max(segments, key=lambda s: s.last_host - s.host)
    usual = _lines(longest, 0.0)[0].skew
    fitted = [_lines(segment, usual) for segment in segments]
    stretches = tuple(_stretch(s, lines, tick_ns) for s, lines in zip(segments, fitted, strict=True))
    early = np.concatenate([_earliest(s, t, tick_ns) for s, t in zip(segments, stretches, strict=True)])
    elapsed = longest.last_host - longest.host
    tick = elapsed / max(longest.last_ticks - longest.ticks, 1) if elapsed else tick_ns
    off = abs(tick / tick_ns - 1) > MAX_SKEW and elapsed > _TELLING
    valid = not off and len(segments) < MAX_SEGMENTS and len(segments) <= 1 + samples // 20
    return Timeline(stretches, usual, float(np.quantile(early, 0.95)), valid, tick / 1e9)


def _lines(segment: _Segment, usual: float) -> list[Line]:
    """Lines of one minute every half minute; one line if there is not more."""
    count = max(1, int((segment.span - _WINDOW) // _HOP) + 1)
    blocks = segment.all_blocks()
    begins = np.array([x[0] for x, _ in blocks])
    lines = []
    for start in np.arange(count) * _HOP:
        stop = start + _WINDOW if start < (count - 1) * _HOP else segment.span + 1
        near = blocks[slice(*np.searchsorted(begins, np.array([start, stop])))]
        if near:  # none in a long pause
            x, y = lower_hull(*_joined(near))
            lines.append(supporting_line(x, y, 0.5 * (x[0] + x[-1]), usual))
    return lines


def _stretch(segment: _Segment, lines: list[Line], tick_ns: float) -> Stretch:
    """Knots at the middles of the lines, rounded to whole ticks."""
    ticks = np.unique(np.rint([line.middle / tick_ns for line in lines]).astype(np.int64))
    x = ticks * tick_ns
    delay = np.interp(x, [line.middle for line in lines], [line.level for line in lines])
    if len(lines) == 1:
        delay = lines[0].at(x)
    host = segment.host + np.rint(x + delay).astype(np.int64)
    return Stretch(segment.ticks + ticks, host, (lines[0].skew, lines[-1].skew), tick_ns)


def _earliest(segment: _Segment, stretch: Stretch, tick_ns: float) -> np.ndarray:
    """How far the lowest point of each block lies from the timeline, ns."""
    out = []
    for x, y in segment.all_blocks():
        ticks = segment.ticks + np.rint(x / tick_ns).astype(np.int64)
        out.append(np.abs(np.min(segment.host + x + y - stretch.host_ns(ticks))))
    return np.array(out)
