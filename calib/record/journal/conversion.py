"""Convert the journal of a recording to a session file, in two readings and bounded memory.

The first reading finds the number and type of the frames, and how the clock of each device ran (`survey`); the second
writes them. The session appears whole or not at all; the caller removes the journal.
"""

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...session import ClockTable, SessionFacts, SessionWriter, Status, StreamFacts
from ..clock import METHOD, ClockFit
from ..plan import RecordingPlan, plan_from_json
from ..summary import ARRIVAL_CLOCK, RecordingSummary
from .file import JournalError, JournalReader, Record
from .records import (
    END,
    EVENT,
    MISCOUNTED,
    PLAN,
    PONG,
    RESTARTED,
    EventCode,
    check_time,
    storable_text,
    unpack_end,
    unpack_event,
    unpack_pong,
)
from .survey import SequenceAndClock, StreamBlock, StreamSurvey, UnpackedBlock

MAX_EVENTS = 100_000
SIMULATED_LABEL = "the device reports that its values are simulated"

Progress = Callable[[int], object]


def convert_journal(
    journal: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    recovered: bool = False,
    progress: Progress = lambda size: None,
) -> RecordingSummary:
    """Convert a `journal` to the session file `output`.

    Args:
        recovered: whether a crash prevented the recorder from doing this.
        progress: called with the size (bytes) of each record, in each of the two readings.

    Raises:
        JournalError: if nothing was recorded, or the file is no journal.
        SessionError: if the session cannot be written.

    Example:
        from calib.record import convert_journal

        # what `jaxeit recover` does
        print(convert_journal("crashed.h5.part", "rescued.h5", recovered=True).render())
    """
    reader = JournalReader(journal)
    plan = _plan(reader)
    surveys, end, faults, plan = _survey_streams(reader, plan, progress)
    if not any(survey.frames for survey in surveys.values()):
        raise JournalError(f"{reader.path.name}: no frame was recorded; delete the file and record again")
    fits = {number: survey.clock_fit() for number, survey in surveys.items()}
    complete = end is not None and end[0] and not reader.lost and not faults
    facts = _session_facts(plan, complete, recovered)
    _write(SessionWriter(output, facts), reader, plan, surveys, fits, progress)
    return RecordingSummary(
        Path(output),
        tuple(survey.summary(fits[number]) for number, survey in surveys.items()),
        complete,
        (*_incomplete_reasons(end, reader), *faults),
        reader.lost,
        reader.damaged + reader.torn,
    )


def _incomplete_reasons(end: tuple[bool, str] | None, reader: JournalReader) -> Iterator[str]:
    if end is None:
        yield "the recorder was killed"
    elif end[1]:
        yield end[1]
    if reader.lost:
        yield "records are damaged"


def _plan(reader: JournalReader) -> RecordingPlan:
    """The first undamaged copy of the plan."""
    for record in reader:
        if record.stream == PLAN:
            return plan_from_json(record.payload)
    raise JournalError(f"{reader.path.name}: its description is damaged in all copies; record again")


def _survey_streams(
    reader: JournalReader, plan: RecordingPlan, progress: Progress
) -> tuple[dict[int, StreamSurvey], tuple[bool, str] | None, list[str], RecordingPlan]:
    """First reading: survey of each stream, end of the recording, faults, and the plan with the notes of devices."""
    end, faults = None, list[str]()
    surveys = {number: StreamSurvey(stream, SequenceAndClock(stream)) for number, stream in enumerate(plan.streams)}
    for record in reader:
        progress(len(record.payload))
        try:
            check_time(record.host)
            if record.stream in surveys:
                surveys[record.stream].add(record)
            elif record.stream == PONG:
                number, pong = unpack_pong(record.payload)
                if number in surveys:
                    surveys[number].add_pong(pong, record.host)
            elif record.stream == EVENT:
                code, label = unpack_event(record.payload)
                plan = _with_simulation(plan, code, label)
                faults += [label] * (code is EventCode.FAULT)
            elif record.stream == END:
                end = unpack_end(record.payload)
        except JournalError as error:  # the checksum holds: another version wrote the record
            todo = "use the jaxeit that wrote it"
            raise JournalError(f"{reader.path.name}: record {record.number:,} {error}; {todo}") from error
    for survey in surveys.values():
        survey.flush()
    return surveys, end, faults, plan


def _with_simulation(plan: RecordingPlan, code: EventCode, label: str) -> RecordingPlan:
    """The plan of a simulated recording, if the event is a note of a device that its values are simulated."""
    if code is not EventCode.SIMULATED or plan.simulated:
        return plan
    try:
        note = json.loads(label)
    except (ValueError, RecursionError) as error:
        raise JournalError("is no note of a simulation: not JSON") from error
    scene, seed = (note.get("scene"), note.get("seed")) if isinstance(note, dict) else (None, None)
    known = isinstance(seed, int) and abs(seed) < 2**62
    scene = storable_text(scene or "not stated by the device")
    return replace(plan, simulated=True, scene=scene, seed=seed if known else 0)


class _StreamWriter:
    """Second reading of one stream: writes its frames with aligned time stamps."""

    def __init__(self, writer: SessionWriter, survey: StreamSurvey, fit: ClockFit | None, host_epoch: int):
        self._writer, self._survey, self._fit, self._epoch = writer, survey, fit, host_epoch
        self._latency = round(survey.latency(fit).ns)
        self.name = survey.plan.name
        self._tracker, self._block = SequenceAndClock(survey.plan), StreamBlock()
        self._segment, self._last = 0, -(2**62)
        self.steps: list[int] = []
        self._declare()

    def _declare(self) -> None:
        survey, plan = self._survey, self._survey.plan
        counts = survey.types == {"i2"}
        self._writer.add_stream(
            plan.name,
            StreamFacts(
                plan.kind.variable,
                units=plan.kind.units,
                channels=plan.channels,
                rate_hz=survey.rate,
                dtype="i2" if counts else "f8" if "f8" in survey.types else "f4",
                scale_factor=plan.scale if counts else None,
                add_offset=plan.offset if counts else None,
                clock=METHOD if self._fit is not None else ARRIVAL_CLOCK,
                transport=plan.transport,
            ),
        )

    def add(self, record: Record, broken: bool) -> None:
        """Add a frame; `broken` says whether records of the journal are missing before it."""
        if not self._block.accepts(record.payload):
            self.flush()
        self._block.add(record, int(Status.gap_before) if broken else 0)

    def flush(self) -> None:
        """Write the frames that wait in the block."""
        block, self._block = self._block, StreamBlock()
        if not block.payloads:
            return
        batch = UnpackedBlock(block, self._tracker)
        times, flags = batch.host, batch.flags & ~(RESTARTED | MISCOUNTED)
        flags |= np.where(batch.missing > 0, int(Status.gap_before), 0)
        if self._fit is not None and batch.ticks is not None:
            times = self._aligned_times(batch.ticks, batch.steps)
            flags |= np.where(batch.steps, int(Status.clock_step), 0)
        times = self._strictly_increasing(times - self._epoch)
        if self._fit is not None:
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

    def _aligned_times(self, ticks: np.ndarray, steps: np.ndarray) -> np.ndarray:
        assert self._fit is not None
        number = self._segment + np.cumsum(steps)
        self._segment = int(number[-1])
        out = np.zeros(len(ticks), np.int64)
        for segment in np.unique(number):
            out[number == segment] = self._fit.segments[segment].host_ns(ticks[number == segment])
        return out - self._latency

    def _strictly_increasing(self, times: np.ndarray) -> np.ndarray:
        """Move times so that they are at least 1 ns apart: frames may arrive together, and clocks may be set back."""
        index = np.arange(len(times))
        times = np.maximum.accumulate(np.maximum(times - index, self._last + 1)) + index
        self._last = int(times[-1])
        return times


def _session_facts(plan: RecordingPlan, complete: bool, recovered: bool) -> SessionFacts:
    return SessionFacts(
        title=plan.title,
        skin_name=plan.skin_name,
        skin_toml=plan.skin_toml,
        pattern=plan.pattern,
        mixing=plan.mixing_matrix(),
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


def _write(
    writer: SessionWriter,
    reader: JournalReader,
    plan: RecordingPlan,
    surveys: dict[int, StreamSurvey],
    fits: dict[int, ClockFit | None],
    progress: Progress,
) -> None:
    with writer:
        streams = {
            number: _StreamWriter(writer, survey, fits[number], plan.host_epoch)
            for number, survey in surveys.items()
            if survey.frames
        }
        events = _write_records(writer, reader, plan, streams, progress)
        for number, stream in streams.items():
            stream.flush()
            _write_clock(writer, plan, surveys[number], fits[number])
        events += [(time, EventCode.CLOCK_STEP, stream.name) for stream in streams.values() for time in stream.steps]
        end = max(survey.last for survey in surveys.values()) - plan.host_epoch
        notes = [f"{survey.plan.name}: {note}" for survey in surveys.values() if (note := survey.clock_note())]
        events += [(end, EventCode.FAULT, storable_text(note)) for note in notes]
        if events:
            times, codes, labels = zip(*sorted(events), strict=True)
            writer.add_events(times, [int(code) for code in codes], labels)


Event = tuple[int, EventCode, str]  # time (ns since the epoch), code, label


def _write_records(
    writer: SessionWriter,
    reader: JournalReader,
    plan: RecordingPlan,
    streams: dict[int, _StreamWriter],
    progress: Progress,
) -> list[Event]:
    """Write all frames to their streams; returns the events."""
    lost, broken = 0, set[int]()
    events: list[Event] = []
    for record in reader:
        progress(len(record.payload))
        if reader.lost > lost:
            lost, broken = reader.lost, {*streams}
        if record.stream in streams:
            streams[record.stream].add(record, record.stream in broken)
            broken.discard(record.stream)
        elif record.stream == EVENT and len(events) < MAX_EVENTS:
            code, label = unpack_event(record.payload)
            # The label of a simulation holds the scene, which is an attribute of the file already.
            label = SIMULATED_LABEL if code is EventCode.SIMULATED else storable_text(label)
            events.append((record.host - plan.host_epoch, code, label))
    return events


def _write_clock(writer: SessionWriter, plan: RecordingPlan, survey: StreamSurvey, fit: ClockFit | None) -> None:
    if fit is None:
        return
    stream, latency = survey.plan, survey.latency(fit)
    host = np.concatenate([s.host for s in fit.segments]) - plan.host_epoch - round(latency.ns)
    ticks = np.concatenate([s.ticks for s in fit.segments])
    table = ClockTable(
        host_ns=host,
        device_ticks=np.maximum(ticks, 0).astype(np.uint64),
        tick_s=stream.tick,
        offset_ns=float(host[0] - ticks[0] * stream.tick * 1e9),
        drift_ppm=1e6 * fit.skew,
        residual_p95_ns=fit.residual_p95,
        valid=True,
        method=METHOD,
        latency_ns=latency.ns,
        rtt_ns=latency.rtt,
    )
    writer.set_clock(stream.name, table)
