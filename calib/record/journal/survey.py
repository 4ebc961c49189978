"""First reading of a journal: number and type of the frames of each stream, and how the clock of its device ran."""

from dataclasses import dataclass, field

import numpy as np

from ...session import Status
from ..clock import METHOD, NO_LATENCY, ClockFit, DeviceClock, Latency, is_wrong_tick, smallest_latency
from ..plan import StreamPlan
from ..summary import ARRIVAL_CLOCK, StreamSummary
from ..wire.messages import Pong
from .file import Record
from .records import MISCOUNTED, RESTARTED, FrameBatch, check_frame, layout_key, unpack_frames

MAX_BATCH_FRAMES = 512
MAX_PONGS = 100_000  # answers to pings that are kept of each stream


@dataclass
class StreamBlock:
    """Frames of one stream with equal layout, which are collected and then processed together."""

    payloads: list[bytes] = field(default_factory=list)
    host: list[int] = field(default_factory=list)
    flags: list[int] = field(default_factory=list)

    def accepts(self, payload: bytes) -> bool:
        """Whether the frame can be added: the block is not full, and its frames have the same layout."""
        if not self.payloads:
            return True
        return len(self.payloads) < MAX_BATCH_FRAMES and layout_key(self.payloads[0]) == layout_key(payload)

    def add(self, record: Record, more_flags: int = 0) -> None:
        """Add a frame."""
        self.payloads.append(record.payload)
        self.host.append(record.host)
        self.flags.append(record.flags | more_flags)


TOGETHER = 1_000_000  # ns: frames that come nearer to each other than that came at once
MIN_TOGETHER = 0.5  # of the frames, from which on they come in bursts
MAX_PERIOD_OF_BURSTS = 5.0  # ms between frames: bursts of faster frames move times by less


class UnpackedBlock:
    """A block of frames as arrays: values (n, channels), and (n,) times, flags, missing frames, ticks and steps."""

    def __init__(self, block: StreamBlock, tracker: "SequenceAndClock"):
        frames = unpack_frames(block.payloads)
        self.values, self.seq, self.bits = frames.values, frames.seq, frames.bits
        self.host, self.flags = np.array(block.host, np.int64), np.array(block.flags)
        self.missing = tracker.missing(frames.seq, self.flags)
        self.ticks, self.steps = tracker.ticks(frames, self.host, self.flags)

    def __len__(self) -> int:
        return len(self.host)


class SequenceAndClock:
    """Follows sequence numbers and clock of one stream block by block, with equal results in both readings."""

    def __init__(self, plan: StreamPlan):
        self.clock = DeviceClock(plan.tick)
        self._last: np.ndarray = np.empty(0, np.uint32)

    def ticks(self, frames: FrameBatch, host: np.ndarray, flags: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """Unwrapped ticks (n,), or None if the device sends none; and which frames follow a step of the clock."""
        if frames.ticks is None:
            return None, np.zeros(len(host), bool)
        rejoined, restarted = (flags & Status.disconnected) != 0, (flags & RESTARTED) != 0
        return self.clock.extend(frames.ticks, frames.bits, host, rejoined, restarted)

    def missing(self, seq: np.ndarray | None, flags: np.ndarray) -> np.ndarray:
        """Number of frames missing before each frame, from the sequence numbers; 0 where these do not count up."""
        if seq is None:
            return np.zeros(len(flags), np.int64)
        before = self._last if len(self._last) else seq[:1] - np.uint32(1)
        self._last = seq[-1:]
        jumps = (np.diff(seq, prepend=before) - np.uint32(1)).astype(np.int64)
        return np.where(flags & (RESTARTED | MISCOUNTED), 0, jumps)


@dataclass
class StreamSurvey:
    """Result of the first reading for one stream."""

    plan: StreamPlan
    tracker: SequenceAndClock
    block: StreamBlock = field(default_factory=StreamBlock)
    frames: int = 0
    lost: int = 0
    types: set[str] = field(default_factory=set)
    numbered: bool = True
    ticking: bool = True
    first: int = 0
    last: int = 0
    together: int = 0  # frames that came at once with the one before
    bits: int = 32
    pongs: list[tuple[int, int, int]] = field(default_factory=list)  # sent, received, ticks

    def add_pong(self, pong: Pong, host: int) -> None:
        """Add an answer to a ping."""
        if len(self.pongs) < MAX_PONGS:
            self.pongs.append((pong.sent, host, pong.ticks))

    def add(self, record: Record) -> None:
        """Add a frame; raises `JournalError` if it does not fit the plan."""
        check_frame(record.payload, self.plan.channels)
        if not self.block.accepts(record.payload):
            self.flush()
        self.block.add(record)

    def flush(self) -> None:
        """Process the frames that wait in the block."""
        block, self.block = self.block, StreamBlock()
        if not block.payloads:
            return
        batch = UnpackedBlock(block, self.tracker)
        self.first = block.host[0] if not self.frames else self.first
        self.together += int((np.diff(batch.host, prepend=self.last or batch.host[0]) < TOGETHER).sum())
        self.last = block.host[-1]
        self.frames += len(batch)
        self.lost += int(batch.missing.sum())
        self.types.add(batch.values.dtype.str[1:])
        self.numbered &= batch.seq is not None and not (batch.flags & MISCOUNTED).any()
        self.bits = batch.bits
        self.ticking &= batch.ticks is not None

    @property
    def rate(self) -> float:
        """Rate in Hz, as planned or else as measured."""
        if self.plan.rate:
            return self.plan.rate
        period = self.tracker.clock.period
        if self.clock_fit() is None or not period:
            period = (self.last - self.first) / max(self.frames - 1, 1)
        return float(f"{1e9 / period:.4g}") if period > 0 else 1.0

    def clock_fit(self) -> ClockFit | None:
        """Fit of the device's clock; None if the time stamps of the stream are times of arrival."""
        if not self.ticking or not self.frames:
            return None
        fit = self.tracker.clock.fit()
        return fit if fit.valid else None

    def latency(self, fit: ClockFit | None) -> Latency:
        """Smallest latency, from the answers to pings."""
        if fit is None or not self.pongs:
            return NO_LATENCY
        sent, received, ticks = zip(*self.pongs, strict=True)
        return smallest_latency(fit, self.bits, np.array(sent), np.array(received), np.array(ticks, np.uint64))

    def summary(self, fit: ClockFit | None) -> StreamSummary:
        """Summary of the stream, given the fit of its clock."""
        if fit is not None:
            steps, drift, rest = self.tracker.clock.steps, 1e6 * fit.skew, fit.residual_p95 / 1e6
            latency = self.latency(fit)
            note = self.burst_note()
            return StreamSummary(self.plan.name, self.frames, self.lost, steps, drift, rest, METHOD, note, latency)
        return StreamSummary(self.plan.name, self.frames, self.lost, 0, 0.0, 0.0, ARRIVAL_CLOCK, self.clock_note())

    def burst_note(self) -> str:
        """By how much times may be off because the device holds frames back; an empty text where that is little.

        The earliest frame of a burst came as late as up to a period of the frames after it was taken.
        """
        period = (self.tracker.clock.period or 0.0) / 1e6
        if self.together < MIN_TOGETHER * self.frames or period < MAX_PERIOD_OF_BURSTS:
            return ""
        return f"its frames come in bursts, so that times may be off by {period:.3g} ms: let it send each at once"

    def clock_note(self) -> str:
        """What is wrong with the device's clock if its time stamps cannot be used, or an empty text."""
        if not self.ticking or not self.frames or self.clock_fit() is not None:
            return ""
        period, elapsed = self.tracker.clock.period, (self.last - self.first) / max(self.frames - 1, 1)
        if not period:
            return "its clock stands still: check the device; times are of arrival"
        tick = self.plan.tick * elapsed / period
        if not is_wrong_tick(tick / self.plan.tick, elapsed * self.frames):
            jumps = self.tracker.clock.steps
            return f"its clock jumps {jumps:,} times: let it count 32 or 64 bits; times are of arrival"
        return f"its ticks are not of {self.plan.tick:g} s (rather {tick:.2g}): give tick=; times are of arrival"
