"""Record sessions: one thread per stream moves bytes from its link into the journal.

The threads compute nothing: a frame is decoded, placed by its sequence number and written. The session file is made
from the journal when the recording ends. After a crash of the recorder, `convert_journal` makes it later.
"""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from .intake import FrameCallback, RecordSink, StreamReceiver, explain_silence
from .journal.conversion import Progress, convert_journal
from .journal.file import Journal, JournalError, JournalReader
from .journal.records import END, EVENT, PLAN, PONG, EventCode, pack_end, pack_event
from .plan import RecordingPlan
from .sources import Source
from .summary import RecordingSummary

PLAN_INTERVAL = 30.0  # s between copies of the plan in the journal
PROGRESS_INTERVAL = 0.2  # s


class RecordError(ValueError):
    """A recording did not begin, or was not completed."""


class Recorder:
    """Receives all streams of a recording, one thread each, while its context is entered.

    At the end the journal is told which streams hold less than their devices sent.

    ``failure`` is the error that stopped the recording, or None. The threads call ``on_frame`` with every frame that is
    kept (number of the stream, frame, host ns); it must return at once.
    """

    def __init__(
        self,
        plan: RecordingPlan,
        sources: Sequence[Source],
        journal: RecordSink,
        on_frame: FrameCallback | None = None,
    ):
        self._plan, self._journal = plan, journal
        self.receivers = [StreamReceiver(number, source, journal, on_frame) for number, source in enumerate(sources)]
        self.stop = threading.Event()
        self.failure: Exception | None = None
        self._threads = [threading.Thread(target=self._run, args=(i,), daemon=True) for i in self.receivers]
        self._plan_written = 0.0

    def __enter__(self) -> "Recorder":
        self.write_plan()
        self.write_plan()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        stopped = time.monotonic()
        self.stop.set()
        for thread in self._threads:
            thread.join()
        with suppress(JournalError):  # the recording has failed already, and says why
            for text in chain.from_iterable(receiver.shortfalls(stopped) for receiver in self.receivers):
                self._journal.append(EVENT, 0, time.monotonic_ns(), pack_event(EventCode.FAULT, text))

    def _run(self, receiver: StreamReceiver) -> None:
        try:
            receiver.run(self.stop)
        except Exception as error:  # any error must end the recording in order
            self.failure = self.failure or error
            self.stop.set()

    def write_plan(self) -> None:
        """Write the plan; it is repeated at intervals, because one copy may be damaged."""
        self._journal.append(PLAN, 0, time.monotonic_ns(), self._plan.to_json())
        self._plan_written = time.monotonic()

    def wait(self, seconds: float) -> None:
        """Wait at most `seconds` while the threads work; returns early when they stop."""
        self.stop.wait(seconds)
        if time.monotonic() - self._plan_written > PLAN_INTERVAL and not self.stop.is_set():
            self.write_plan()

    @property
    def silent_receivers(self) -> list[StreamReceiver]:
        """Receivers that have not kept a frame yet."""
        return [receiver for receiver in self.receivers if not receiver.counters.frames]

    @property
    def ended(self) -> bool:
        """Whether all sources have ended."""
        return all(receiver.ended for receiver in self.receivers)

    def render(self, elapsed: float) -> str:
        """One line about the progress of all streams."""
        parts = [_receiver_status(receiver) for receiver in self.receivers]
        return f"{elapsed:.0f} s  " + "  ".join(parts) + f"  {self._journal.size / 1e6:.1f} MB"


def _receiver_status(receiver: StreamReceiver) -> str:
    counters = receiver.counters
    text = f"{receiver.source.plan.name} {counters.frames:,}"
    text += f" ({counters.lost:,} lost)" if counters.lost else ""
    text += f" ({counters.rejected:,} rejected)" if counters.rejected else ""
    text += f" ({counters.miscounted:,} miscounted)" if counters.miscounted else ""
    text += f" ({sum(counters.dropped.values()):,} damaged)" if counters.dropped else ""
    return text if counters.connected or receiver.ended else f"{text} [{counters.problem or 'connecting'}]"


@dataclass
class StopRequest:
    """Lets another thread, or a signal handler, stop a recording.

    ``stop`` is the event, ``why`` what cut the recording short, and ``status`` the exit status of the program.
    """

    stop: threading.Event = field(default_factory=threading.Event)
    why: str = ""
    status: int = 0

    def stop_recording(self, why: str = "", status: int = 0) -> None:
        """Stop the recording; ``why`` says what cut it short, if it did not end as planned."""
        self.why, self.status = self.why or why, self.status or status
        self.stop.set()


def journal_path(output: str | Path) -> Path:
    """Path of the journal of a recording that is to become `output`."""
    return Path(output).with_name(Path(output).name + ".part")


def record_session(
    plan: RecordingPlan,
    sources: Sequence[Source],
    output: str | Path,
    *,
    seconds: float | None = None,
    wait: float = 10.0,
    stop_request: StopRequest | None = None,
    progress: Callable[[str], object] = lambda line: None,
    finishing: Progress = lambda size: None,
    on_frame: FrameCallback | None = None,
) -> RecordingSummary:
    """Record until the time is over, a stop is requested or all sources end, then write the session.

    Args:
        seconds: duration of the recording, counted from when every stream has begun; None: without limit.
        wait: time in s within which every stream must begin.
        stop_request: lets others stop the recording.
        progress: called with a line of text a few times a second.
        finishing: called with the size of each frame (bytes) while the session is written.
        on_frame: see `Recorder`.

    Raises:
        RecordError: if a stream did not begin, or nothing was recorded; no file is left then. Also if a write
            failed: the message says whether `output` or the journal beside it holds the recording.
        JournalError: if the journal of an unfinished recording exists beside `output`.
    """
    stop_request = StopRequest() if stop_request is None else stop_request
    journal_file = _new_journal_path(output)
    with Journal(journal_file) as journal:
        recorder = Recorder(plan, sources, journal, on_frame)
        failure = _run_until_stopped(recorder, stop_request, seconds, wait, progress)
        why = str(failure or stop_request.why)
        failure = _append_end(journal, why) or failure
    if isinstance(failure, RecordError) or len(recorder.silent_receivers) == len(recorder.receivers):
        journal_file.unlink()
        raise failure if isinstance(failure, RecordError) else RecordError(f"nothing was recorded ({why or 'stopped'})")
    progress("writing the session")
    return _write_session(journal_file, output, failure, finishing)


def _new_journal_path(output: str | Path) -> Path:
    """Path of the journal; raises `RecordError` if `output` exists."""
    if Path(output).exists():
        raise RecordError(f"{output}: exists already, and recordings are not overwritten; choose another name")
    return journal_path(output)


def _write_session(
    journal_file: Path, output: str | Path, failure: Exception | None, progress: Progress
) -> RecordingSummary:
    """Convert the journal to a session; raises `RecordError` if this fails, or with the `failure` of the recording."""
    try:
        summary = convert_journal(journal_file, output, progress=progress)
    except (ValueError, OSError) as error:
        todo = f"the recording is kept: jaxeit recover {journal_file}"
        raise RecordError(f"{failure or error}; {todo}") from error
    journal_file.unlink()
    if failure is not None:
        raise RecordError(f"{failure}; what was recorded before is in {output}") from failure
    return summary


@contextmanager
def session_journal(output: str | Path, tell: Callable[[str], object] = lambda line: None) -> Iterator[Journal]:
    """A journal for a caller that runs its own `Recorder`; at the end of the context it becomes the session `output`.

    If an exception leaves the context, the session states it as the reason why the recording was cut short. Without
    any frame no file is left.

    Raises:
        RecordError, JournalError: as `record_session`.
    """
    journal_file = _new_journal_path(output)
    failure: BaseException | None = None
    with Journal(journal_file) as journal:
        try:
            yield journal
        except BaseException as error:
            failure = error
        ended = _append_end(journal, "" if failure is None else str(failure) or type(failure).__name__)
    if not any(record.stream < PONG for record in JournalReader(journal_file)):
        journal_file.unlink()
    else:
        tell(_write_session(journal_file, output, ended, lambda size: None).render())
    if failure is not None:
        raise failure


def _append_end(journal: Journal, why: str) -> JournalError | None:
    try:
        journal.append(END, 0, time.monotonic_ns(), pack_end(not why, why))
    except JournalError as error:
        return error
    return None


def _run_until_stopped(
    recorder: Recorder,
    stop_request: StopRequest,
    seconds: float | None,
    wait: float,
    progress: Callable[[str], object],
) -> Exception | None:
    """Run to the end of the recording; returns the error that cut it short, or None."""
    begin, started = time.monotonic(), None
    try:
        with recorder:
            while not recorder.stop.is_set() and not stop_request.stop.is_set() and not recorder.ended:
                recorder.wait(PROGRESS_INTERVAL)
                now = time.monotonic()
                started = now if started is None and not recorder.silent_receivers else started
                progress(recorder.render(now - begin))
                if started is None and now - begin > wait:
                    return RecordError("; ".join(map(explain_silence, recorder.silent_receivers)))
                if started is not None and seconds is not None and now - started >= seconds:
                    break
    except JournalError as error:
        return error
    return recorder.failure
