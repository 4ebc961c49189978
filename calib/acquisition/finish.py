"""From the journal to the session file, in two readings and bounded memory.

The first reading learns how many frames there are, of what type, and how each device's clock ran; the
second writes them. The file appears whole or not at all; the journal is left to the caller.
"""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calib.session import ClockTable, SessionWriter, Status

from .clock import METHOD, NO_LATENCY, DeviceClock, Latency, Timeline, latency
from .entries import (
    END,
    EVENT,
    PLAN,
    PONG,
    RESTARTED,
    Code,
    Frames,
    alike,
    check_frame,
    check_time,
    storable,
    unpack_end,
    unpack_event,
    unpack_frames,
    unpack_pong,
)
from .journal import JournalError, Record, Scan
from .plan import Plan, StreamPlan, plan_from_json
from .wire import Pong

_ROWS = 512
_MAX_EVENTS = 100_000  # and answers to pings of each stream
_HOST = "time of arrival"
_SIMULATED = "the device says that its values are simulated"


@dataclass(frozen=True)
class StreamSummary:
    """What became of one stream: frames kept, frames known to be missing, and its clock."""

    name: str
    frames: int
    lost: int
    steps: int
    drift_ppm: float
    residual_ms: float
    clock: str  # how its times were made
    note: str = ""
    latency: Latency = NO_LATENCY

    def render(self) -> str:
        """One line."""
        text = f"{self.name}: {self.frames:,} frames, {self.lost:,} lost"
        if self.clock != _HOST:
            text += f"; clock {self.drift_ppm:+.1f} ppm, aligned to {self.residual_ms:.3f} ms"
        if self.latency.rtt:
            text += f", less a latency of {self.latency.ns / 1e6:.3f} ± {self.latency.rtt / 2e6:.3f} ms"
        text += f", {self.steps} clock step{'s' * (self.steps != 1)}" if self.steps else ""
        return text + (f"; {self.note}" if self.note else "")


@dataclass(frozen=True)
class Summary:
    """What a session was made of; ``complete`` if the recording ended as planned and nothing is damaged."""

    path: Path
    streams: tuple[StreamSummary, ...]
    complete: bool
    why: str
    records_lost: int
    bytes_damaged: int

    def render(self) -> str:
        """A line per stream, and one for the whole."""
        lines = ["  " + stream.render() for stream in self.streams]
        state = "complete" if self.complete else f"not complete ({self.why})"
        if self.records_lost or self.bytes_damaged:
            state += f"; {self.records_lost:,} records lost to {self.bytes_damaged:,} damaged bytes"
        return "\n".join([*lines, f"{self.path}: {state}"])


@dataclass
class _Block:
    """Frames of one stream, all sent alike, that wait to be worked on together."""

    payloads: list[bytes] = field(default_factory=list)
    host: list[int] = field(default_factory=list)
    flags: list[int] = field(default_factory=list)

    def takes(self, payload: bytes) -> bool:
        """Whether there is room for one more frame."""
        return not self.payloads or (len(self.payloads) < _ROWS and alike(self.payloads[0]) == alike(payload))

    def add(self, record: Record, more_flags: int = 0) -> None:
        """One more frame."""
        self.payloads.append(record.payload)
        self.host.append(record.host)
        self.flags.append(record.flags | more_flags)


class _Batch:
    """A block unpacked, with what its sequence numbers and ticks say about it, (n,) each."""

    def __init__(self, block: _Block, follower: "_Follower"):
        frames = unpack_frames(block.payloads)
        self.values, self.seq, self.bits = frames.values, frames.seq, frames.bits
        self.host, self.flags = np.array(block.host, np.int64), np.array(block.flags)
        self.missing = follower.missing(frames.seq, self.flags)
        self.ticks, self.steps = follower.ticks(frames, self.host, self.flags)

    def __len__(self) -> int:
        return len(self.host)


class _Follower:
    """Sequence numbers and clock of one stream, block by block; the same in both readings."""

    def __init__(self, plan: StreamPlan):
        self.clock = DeviceClock(plan.tick)
        self._last: np.ndarray = np.empty(0, np.uint32)

    def ticks(self, frames: Frames, host: np.ndarray, flags: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """Unwrapped ticks, None if there are none, and where the clock made a step."""
        if frames.ticks is None:
            return None, np.zeros(len(host), bool)
        rejoined, restarted = (flags & Status.disconnected) != 0, (flags & RESTARTED) != 0
        return self.clock.extend(frames.ticks, frames.bits, host, rejoined, restarted)

    def missing(self, seq: np.ndarray | None, flags: np.ndarray) -> np.ndarray:
        """How many frames are missing before each, by sequence numbers; 0 where a device began anew."""
        if seq is None:
            return np.zeros(len(flags), np.int64)
        before = self._last if len(self._last) else seq[:1] - np.uint32(1)
        self._last = seq[-1:]
        jumps = (np.diff(seq, prepend=before) - np.uint32(1)).astype(np.int64)
        return np.where(flags & RESTARTED, 0, jumps)


@dataclass
class _Survey:
    """What the first reading finds out about one stream."""

    plan: StreamPlan
    follower: _Follower
    block: _Block = field(default_factory=_Block)
    frames: int = 0
    lost: int = 0
    types: set[str] = field(default_factory=set)
    numbered: bool = True
    ticking: bool = True
    first: int = 0
    last: int = 0
    bits: int = 32
    pongs: list[tuple[int, int, int]] = field(default_factory=list)  # sent, received, ticks

    def hear(self, pong: Pong, host: int) -> None:
        """One answer to a ping."""
        if len(self.pongs) < _MAX_EVENTS:
            self.pongs.append((pong.sent, host, pong.ticks))

    def add(self, record: Record) -> None:
        """One frame."""
        check_frame(record.payload, self.plan.channels)
        if not self.block.takes(record.payload):
            self.flush()
        self.block.add(record)

    def flush(self) -> None:
        """Take in what waits."""
        block, self.block = self.block, _Block()
        if not block.payloads:
            return
        batch = _Batch(block, self.follower)
        self.first = block.host[0] if not self.frames else self.first
        self.last = block.host[-1]
        self.frames += len(batch)
        self.lost += int(batch.missing.sum())
        self.types.add(batch.values.dtype.str[1:])
        self.numbered &= batch.seq is not None
        self.bits = batch.bits
        self.ticking &= batch.ticks is not None

    @property
    def rate(self) -> float:
        """As planned, or as measured, Hz."""
        if self.plan.rate:
            return self.plan.rate
        period = self.follower.clock.period
        if self.timeline() is None or not period:
            period = (self.last - self.first) / max(self.frames - 1, 1)
        return float(f"{1e9 / period:.4g}") if period > 0 else 1.0

    def timeline(self) -> Timeline | None:
        """How its device's clock ran; None if its times are those of arrival."""
        if not self.ticking or not self.frames:
            return None
        found = self.follower.clock.timeline()
        return found if found.valid else None

    def latency(self, found: Timeline | None) -> Latency:
        """By what the device answered."""
        if found is None or not self.pongs:
            return NO_LATENCY
        sent, received, ticks = zip(*self.pongs, strict=True)
        return latency(found, self.bits, np.array(sent), np.array(received), np.array(ticks, np.uint64))

    def summary(self, found: Timeline | None) -> StreamSummary:
        """In figures."""
        if found is not None:
            steps, drift, rest = self.follower.clock.steps, 1e6 * found.skew, found.residual_p95 / 1e6
            late = self.latency(found)
            return StreamSummary(self.plan.name, self.frames, self.lost, steps, drift, rest, METHOD, latency=late)
        note = ""
        if self.ticking and self.frames:
            ratio = self.follower.clock.timeline().tick_s
            note = f"its ticks are not of {self.plan.tick:g} s (rather {ratio:.3g}): give tick=; times are of arrival"
        return StreamSummary(self.plan.name, self.frames, self.lost, 0, 0.0, 0.0, _HOST, note)


Progress = Callable[[int], object]


def finish(
    journal: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    recovered: bool = False,
    progress: Progress = lambda size: None,
) -> Summary:
    """Write the session that `journal` holds as `output`.

    Args:
        recovered: whether the recorder was not there to do it.
        progress: called with the number of bytes of each frame worked on, over two readings.

    Raises:
        JournalError: if nothing was recorded, or the file is no journal.
        SessionError: if the session cannot be written.
    """
    scan = Scan(journal)
    plan = _plan(scan)
    surveys, end, plan = _survey(scan, plan, progress)
    if not any(survey.frames for survey in surveys.values()):
        raise JournalError(f"{scan.path.name}: no frame was recorded; there is nothing to make a session of")
    timelines = {number: survey.timeline() for number, survey in surveys.items()}
    complete = end is not None and end[0] and not scan.lost
    _write(scan, plan, surveys, timelines, Path(output), complete, recovered, progress)
    return Summary(
        Path(output),
        tuple(survey.summary(timelines[number]) for number, survey in surveys.items()),
        complete,
        _why(end, scan),
        scan.lost,
        scan.damaged + scan.torn,
    )


def _why(end: tuple[bool, str] | None, scan: Scan) -> str:
    if end is None:
        return "the recorder was killed"
    return end[1] or ("records are damaged" if scan.lost else "")


def _plan(scan: Scan) -> Plan:
    """The first description that is whole: there are several."""
    for record in scan:
        if record.stream == PLAN:
            return plan_from_json(record.payload)
    raise JournalError(f"{scan.path.name}: its description is damaged; what it held cannot be told")


def _survey(scan: Scan, plan: Plan, progress: Progress) -> tuple[dict[int, _Survey], tuple[bool, str] | None, Plan]:
    """What each stream holds, how the recording ended, and the plan with what the devices said."""
    end = None
    surveys = {number: _Survey(stream, _Follower(stream)) for number, stream in enumerate(plan.streams)}
    for record in scan:
        progress(len(record.payload))
        try:
            check_time(record.host)
            if record.stream in surveys:
                surveys[record.stream].add(record)
            elif record.stream == PONG:
                number, pong = unpack_pong(record.payload)
                if number in surveys:
                    surveys[number].hear(pong, record.host)
            elif record.stream == EVENT:
                plan = _as_said(plan, *unpack_event(record.payload))
            elif record.stream == END:
                end = unpack_end(record.payload)
        except JournalError as error:  # its sum is right: no damage, but not of this program's making
            todo = "use the jaxeit that wrote it"
            raise JournalError(f"{scan.path.name}: record {record.number:,} {error}; {todo}") from error
    for survey in surveys.values():
        survey.flush()
    return surveys, end, plan


def _as_said(plan: Plan, code: Code, label: str) -> Plan:
    """A plan of what is simulated, if a device said that its values are."""
    if code is not Code.SIMULATED or plan.simulated:
        return plan
    try:
        said = json.loads(label)
    except (ValueError, RecursionError) as error:
        raise JournalError("says in what is not JSON that values are simulated") from error
    scene, seed = (said.get("scene"), said.get("seed")) if isinstance(said, dict) else (None, None)
    known = isinstance(seed, int) and abs(seed) < 2**62
    return replace(plan, simulated=True, scene=storable(scene or "not told by the device"), seed=seed if known else 0)


class _StreamWriter:
    """The second reading of one stream."""

    def __init__(self, writer: SessionWriter, survey: _Survey, found: Timeline | None, host_epoch: int):
        self._writer, self._survey, self._found, self._epoch = writer, survey, found, host_epoch
        self._late = round(survey.latency(found).ns)
        self.name = survey.plan.name
        self._follower, self._block = _Follower(survey.plan), _Block()
        self._stretch, self._last = 0, -(2**62)
        self.steps: list[int] = []
        self._declare()

    def _declare(self) -> None:
        survey, plan = self._survey, self._survey.plan
        counts = survey.types == {"i2"}
        self._writer.add_stream(
            plan.name,
            plan.kind.variable,
            units=plan.kind.units,
            channels=plan.channels,
            rate_hz=survey.rate,
            dtype="i2" if counts else "f8" if "f8" in survey.types else "f4",
            scale_factor=plan.scale if counts else None,
            add_offset=plan.offset if counts else None,
            clock=METHOD if self._found is not None else _HOST,
            transport=plan.transport,
        )

    def add(self, record: Record, broken: bool) -> None:
        """One frame; `broken` if records of the journal are missing before it."""
        if not self._block.takes(record.payload):
            self.flush()
        self._block.add(record, int(Status.gap_before) if broken else 0)

    def flush(self) -> None:
        """Write what waits."""
        block, self._block = self._block, _Block()
        if not block.payloads:
            return
        batch = _Batch(block, self._follower)
        times, flags = batch.host, batch.flags & ~RESTARTED
        flags |= np.where(batch.missing > 0, int(Status.gap_before), 0)
        if self._found is not None and batch.ticks is not None:
            times = self._aligned(batch.ticks, batch.steps)
            flags |= np.where(batch.steps, int(Status.clock_step), 0)
        times = self._increasing(times - self._epoch)
        if self._found is not None:
            self.steps += times[batch.steps].tolist()
        self._writer.append(
            self.name,
            times,
            self._survey.plan.in_si(batch.values),
            flags.astype(np.uint16),
            time_host=batch.host,
            time_device=batch.ticks if self._survey.ticking else None,
            seq=batch.seq if self._survey.numbered else None,
        )

    def _aligned(self, ticks: np.ndarray, steps: np.ndarray) -> np.ndarray:
        assert self._found is not None
        number = self._stretch + np.cumsum(steps)
        self._stretch = int(number[-1])
        out = np.zeros(len(ticks), np.int64)
        for stretch in np.unique(number):
            out[number == stretch] = self._found.stretches[stretch].host_ns(ticks[number == stretch])
        return out - self._late

    def _increasing(self, times: np.ndarray) -> np.ndarray:
        """At least 1 ns apart: frames may arrive together, and clocks may be set back."""
        index = np.arange(len(times))
        times = np.maximum.accumulate(np.maximum(times - index, self._last + 1)) + index
        self._last = int(times[-1])
        return times


def _write(scan, plan, surveys, timelines, output, complete, recovered, progress) -> None:
    writer = SessionWriter(
        output,
        title=plan.title,
        skin_name=plan.skin_name,
        skin_toml=plan.skin_toml,
        pattern=plan.pattern,
        current=plan.current,
        frequency=plan.frequency,
        offset=plan.offset,
        epoch=plan.moment,
        simulated=plan.simulated,
        scene=plan.scene,
        seed=plan.seed,
        license=plan.license,
        session_id=plan.session_id,
        creator=plan.creator,
        complete=complete,
        recovered=recovered,
    )
    with writer:
        streams = {
            number: _StreamWriter(writer, survey, timelines[number], plan.host_epoch)
            for number, survey in surveys.items()
            if survey.frames
        }
        events = _write_records(writer, scan, plan, streams, progress)
        for number, stream in streams.items():
            stream.flush()
            _write_clock(writer, plan, surveys[number], timelines[number])
        events += [(time, Code.CLOCK_STEP, stream.name) for stream in streams.values() for time in stream.steps]
        if events:
            times, codes, labels = zip(*sorted(events), strict=True)
            writer.add_events(times, [int(code) for code in codes], labels)


Event = tuple[int, Code, str]  # when, ns since the epoch; what; in words


def _write_records(
    writer, scan: Scan, plan: Plan, streams: dict[int, _StreamWriter], progress: Progress
) -> list[Event]:
    """Frames to their streams; the events between them."""
    lost, broken = 0, set[int]()
    events: list[Event] = []
    for record in scan:
        progress(len(record.payload))
        if scan.lost > lost:
            lost, broken = scan.lost, {*streams}
        if record.stream in streams:
            streams[record.stream].add(record, record.stream in broken)
            broken.discard(record.stream)
        elif record.stream == EVENT and len(events) < _MAX_EVENTS:
            code, label = unpack_event(record.payload)
            label = _SIMULATED if code is Code.SIMULATED else storable(label)  # the scene is told once, for the file
            events.append((record.host - plan.host_epoch, code, label))
    return events


def _write_clock(writer: SessionWriter, plan: Plan, survey: _Survey, found: Timeline | None) -> None:
    if found is None:
        return
    stream, late = survey.plan, survey.latency(found)
    host = np.concatenate([s.host for s in found.stretches]) - plan.host_epoch - round(late.ns)
    ticks = np.concatenate([s.ticks for s in found.stretches])
    table = ClockTable(
        host_ns=host,
        device_ticks=np.maximum(ticks, 0).astype(np.uint64),
        tick_s=stream.tick,
        offset_ns=float(host[0] - ticks[0] * stream.tick * 1e9),
        drift_ppm=1e6 * found.skew,
        residual_p95_ns=found.residual_p95,
        valid=True,
        method=METHOD,
        latency_ns=late.ns,
        rtt_ns=late.rtt,
    )
    writer.set_clock(stream.name, table)
