"""Summary of a recording: what became of each stream, and whether the recording is complete."""

from dataclasses import dataclass
from pathlib import Path

from .clock import NO_LATENCY, Latency

ARRIVAL_CLOCK = "time of arrival"  # the `clock` of streams whose device time cannot be used


@dataclass(frozen=True)
class StreamSummary:
    """Frames that were kept and lost of one stream, and the alignment of its clock.

    | field       | meaning                                                           | unit |
    |-------------|-------------------------------------------------------------------|------|
    | name        | of the stream                                                     |      |
    | frames      | number of frames in the session                                   |      |
    | lost        | number of missing frames, by sequence numbers                     |      |
    | steps       | number of times that the device's clock was set or restarted      |      |
    | drift_ppm   | how much slower than nominal the device counts                    | ppm  |
    | residual_ms | 95 % quantile of the residuals of the clock fit                   | ms   |
    | clock       | method by which time stamps were made                             |      |
    | note        | what the operator should correct, or an empty text                |      |
    | latency     | smallest latency, which was subtracted from the time stamps       |      |
    """

    name: str
    frames: int
    lost: int
    steps: int
    drift_ppm: float
    residual_ms: float
    clock: str
    note: str = ""
    latency: Latency = NO_LATENCY

    def render(self) -> str:
        """The summary as one line of text."""
        text = f"{self.name}: {self.frames:,} frames, {self.lost:,} lost"
        if self.clock != ARRIVAL_CLOCK:
            text += f"; clock {self.drift_ppm:+.1f} ppm, aligned to {self.residual_ms:.3f} ms"
        if self.latency.rtt:
            text += f", less a latency of {self.latency.ns / 1e6:.3f} ± {self.latency.rtt / 2e6:.3f} ms"
        text += f", {self.steps} clock step{'s' * (self.steps != 1)}" if self.steps else ""
        return text + (f"; {self.note}" if self.note else "")


@dataclass(frozen=True)
class RecordingSummary:
    """Summary of a recording and the session made of it.

    ``complete`` is true if the recording ended as planned, every device sent until its end, and no record is missing;
    otherwise ``reasons`` says why not. ``path`` is that of the session, ``streams`` has a summary of each stream;
    ``records_lost`` and ``bytes_damaged`` count what the journal lacks.
    """

    path: Path
    streams: tuple[StreamSummary, ...]
    complete: bool
    reasons: tuple[str, ...]
    records_lost: int
    bytes_damaged: int

    def render(self) -> str:
        """A line of text for each stream, and one for the whole."""
        lines = ["  " + stream.render() for stream in self.streams]
        lost = sum(stream.lost for stream in self.streams)
        but_for = f", but for {lost:,} lost frame{'s' * (lost != 1)}" if lost else ""
        state = f"complete{but_for}" if self.complete else "not complete"
        if len(self.reasons) == 1:
            state += f" ({self.reasons[0]})"
        if self.records_lost or self.bytes_damaged:
            state += f"; {self.records_lost:,} records lost to {self.bytes_damaged:,} damaged bytes"
        several = [f"  {reason}" for reason in self.reasons] if len(self.reasons) > 1 else []
        return "\n".join([*lines, f"{self.path}: {state}", *several])
