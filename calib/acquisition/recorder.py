"""The recorder: one thread per stream that only moves bytes, from its link into the journal.

Nothing here computes: a frame is decoded, placed by its sequence number and written. The session file is
made from the journal when the recording ends; if the recorder does not live to see that, `finish` does it later.
"""

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from calib.session import Status

from .entries import END, EVENT, PLAN, PONG, RESTARTED, Code, pack_end, pack_event, pack_frame, pack_pong
from .finish import Progress, Summary, finish
from .journal import Journal, JournalError, Scan
from .plan import Plan
from .sources import Link, Source
from .wire import Counts, Frame, Order, Place, State, encode_ping, follow

RETRY = 0.25  # s between attempts to connect
PERIODS = 3  # of silence after which a link is opened again,
PATIENCE = 0.5  # s, but not sooner: TCP itself repeats what was lost after 0.2 s
FIRST = 5.0  # s for the first frame of a connection, and while the rate is not known
_TELLING = 20  # frames that tell it
_DESCRIBE = 30.0  # s between copies of the plan
_TURN = 0.2

Tap = Callable[[int, Frame, int], None]


class Log(Protocol):
    """Where records go: a `Journal`, or `Nowhere`."""

    @property
    def size(self) -> int:
        """Bytes written."""

    def append(self, stream: int, flags: int, host: int, payload: bytes) -> None:
        """Write one record."""


class Nowhere:
    """Forgets everything: for those who only look."""

    size = 0

    def append(self, stream: int, flags: int, host: int, payload: bytes) -> None:
        """Forget one record."""


class RecordError(ValueError):
    """A recording that did not begin."""


@dataclass
class Tally:
    """What one stream has come to; written by its thread, read by others."""

    connected: bool = False
    problem: str = ""
    frames: int = 0
    lost: int = 0
    repeated: int = 0
    connections: int = 0
    simulated: bool = False
    earlier: Counts = field(default_factory=Counts)  # of links before the present one
    present: Counts = field(default_factory=Counts)

    @property
    def dropped(self) -> dict[str, int]:
        """Pieces that were no frame, by reason."""
        return (self.earlier + self.present).dropped


class Intake:
    """One stream: its link, opened again and again, what it sends, and where that goes."""

    def __init__(self, number: int, source: Source, journal: Log, tap: Tap | None = None):
        self.number, self.source, self.tally = number, source, Tally()
        self._journal, self._tap, self._order = journal, tap, Order()
        self._rejoined = False
        self._link: Link | None = None
        self._noted = ""
        self.ended = False

    def send(self, data: bytes) -> None:
        """To the device, if it is there and takes it; called by another thread."""
        link = self._link
        if link is not None and self.tally.connected:
            with suppress(OSError):
                link.write(data)

    def run(self, stop: threading.Event) -> None:
        """Until `stop` is set or the source has no more; raises JournalError when writing fails."""
        self._link = link = self.source.link()
        try:
            while not stop.is_set() and not self.ended:
                self._connect(link, stop)
        finally:
            link.close()
            self.tally.connected = False

    def _connect(self, link: Link, stop: threading.Event) -> None:
        try:
            link.open()
        except OSError as error:
            self.tally.problem = _words(error)
            stop.wait(RETRY)
            return
        self.tally.connected, self.tally.connections = True, self.tally.connections + 1
        self._note(Code.CONNECTED, f"{self.source.plan.name}: connected")
        try:
            self._listen(link, stop)
        except EOFError:
            self.ended = True
        except OSError as error:
            self.tally.problem = _words(error)
            self._note(Code.LOST, f"{self.source.plan.name}: {self.tally.problem}")
        finally:
            link.close()
            self.tally.connected = False
            self.tally.earlier, self.tally.present = self.tally.earlier + self.tally.present, Counts()
            self._rejoined = self.tally.frames > 0
        if not self.ended:
            stop.wait(RETRY)

    def _listen(self, link: Link, stop: threading.Event) -> None:
        state, heard = State(), time.monotonic()
        began, count, patience = heard, 0, max(FIRST, self._patience(0.0, 0))
        pinged = heard
        while not stop.is_set():
            if self.source.ping and time.monotonic() - pinged >= self.source.ping:
                pinged = time.monotonic()
                self.send(encode_ping(self.source.plan.number, time.monotonic_ns()))
            data = link.read()
            host, now = time.monotonic_ns(), time.monotonic()
            if data:
                state, frames = self.source.decode(state, data)
                self.tally.present = state.counts
                if state.note != self._noted:
                    self._heed(state.note)
                if state.pong is not None:
                    self._journal.append(PONG, 0, host, pack_pong(self.number, state.pong))
                    state = state._replace(pong=None)
                for frame in frames:
                    self._take(frame, host)
                if frames:
                    heard, count = now, count + len(frames)
                    patience = self._patience(now - began, count)
            if link.steady and now - heard > patience:
                raise TimeoutError(
                    f"silent for {now - heard:.1f} s" if not data else f"no frame for {now - heard:.1f} s"
                )

    def _patience(self, elapsed: float, count: int) -> float:
        """How long to wait for the next frame, s, by the stated rate or by that of the frames so far."""
        rate = self.source.plan.rate
        if not rate and count < _TELLING:
            return FIRST
        return max(PERIODS * (1 / rate if rate else elapsed / count), PATIENCE)

    def _take(self, frame: Frame, host: int) -> None:
        flags = 0 if frame.checked else int(Status.unchecked)
        flags |= int(Status.crc_resync) if frame.resync else 0
        if frame.seq is not None:
            self._order, place, lost = follow(self._order, frame.seq)
            if not place.kept:
                self.tally.repeated += place is not Place.SUSPECT
                return
            self.tally.lost += lost
            flags |= int(Status.gap_before) if lost or place is Place.RESTART else 0
            flags |= RESTARTED if place is Place.RESTART else 0
        if self._rejoined:
            flags |= int(Status.disconnected | Status.gap_before)
            self._rejoined = False
        self._journal.append(self.number, flags, host, pack_frame(frame))
        self.tally.frames += 1
        if self._tap is not None:
            self._tap(self.number, frame, host)

    def _heed(self, note: str) -> None:
        """What the device says: whether its values are simulated, once, as it may say so ever again."""
        self._noted = note
        if json.loads(note).get("simulated"):
            self.tally.simulated = True
            self._journal.append(EVENT, 0, time.monotonic_ns(), pack_event(Code.SIMULATED, note))

    def _note(self, code: Code, text: str) -> None:
        self._journal.append(EVENT, 0, time.monotonic_ns(), pack_event(code, text[:200]))


def _words(error: OSError) -> str:
    return " ".join(str(error.strerror or error).split()) or type(error).__name__


class Recorder:
    """All streams of a recording at work; a context manager that stops its threads at the end.

    ``failure`` is what stopped it, if something did; ``tap`` is called by the threads with every frame kept
    (number of the stream, frame, host ns) and must return at once.
    """

    def __init__(self, plan: Plan, sources: Sequence[Source], journal: Log, tap: Tap | None = None):
        self._plan, self._journal = plan, journal
        self.intakes = [Intake(number, source, journal, tap) for number, source in enumerate(sources)]
        self.stop = threading.Event()
        self.failure: Exception | None = None
        self._threads = [threading.Thread(target=self._run, args=(i,), daemon=True) for i in self.intakes]
        self._described = 0.0

    def __enter__(self) -> "Recorder":
        self.describe()
        self.describe()
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop.set()
        for thread in self._threads:
            thread.join()

    def _run(self, intake: Intake) -> None:
        try:
            intake.run(self.stop)
        except Exception as error:  # whatever it is, the recording ends in order
            self.failure = self.failure or error
            self.stop.set()

    def describe(self) -> None:
        """Write the plan; it is repeated now and then, should one copy be damaged."""
        self._journal.append(PLAN, 0, time.monotonic_ns(), self._plan.to_json())
        self._described = time.monotonic()

    def attend(self, seconds: float) -> None:
        """Wait, at most `seconds`, while the threads work."""
        self.stop.wait(seconds)
        if time.monotonic() - self._described > _DESCRIBE and not self.stop.is_set():
            self.describe()

    @property
    def silent(self) -> list[Intake]:
        """Streams of which nothing has been kept yet."""
        return [intake for intake in self.intakes if not intake.tally.frames]

    @property
    def ended(self) -> bool:
        """Whether no source has anything more."""
        return all(intake.ended for intake in self.intakes)

    def render(self, elapsed: float) -> str:
        """One line: how it is going."""
        parts = [_progress(intake) for intake in self.intakes]
        return f"{elapsed:.0f} s  " + "  ".join(parts) + f"  {self._journal.size / 1e6:.1f} MB"


def _progress(intake: Intake) -> str:
    tally = intake.tally
    text = f"{intake.source.plan.name} {tally.frames:,}"
    text += f" ({tally.lost:,} lost)" if tally.lost else ""
    text += f" ({sum(tally.dropped.values()):,} damaged)" if tally.dropped else ""
    return text if tally.connected or intake.ended else f"{text} [{tally.problem or 'connecting'}]"


@dataclass
class Orders:
    """What someone else may ask of a running recording: to stop, and whether that was meant to be."""

    stop: threading.Event = field(default_factory=threading.Event)
    why: str = ""
    status: int = 0  # with which the program is then to exit

    def give(self, why: str = "", status: int = 0) -> None:
        """Stop; ``why`` if the recording is then not what was planned."""
        self.why, self.status = self.why or why, self.status or status
        self.stop.set()


def part_of(output: str | Path) -> Path:
    """The journal of a recording that is to become `output`."""
    return Path(output).with_name(Path(output).name + ".part")


def record(
    plan: Plan,
    sources: Sequence[Source],
    output: str | Path,
    *,
    seconds: float | None = None,
    wait: float = 10.0,
    orders: Orders | None = None,
    progress: Callable[[str], object] = lambda line: None,
    finishing: Progress = lambda size: None,
    tap: Tap | None = None,
) -> Summary:
    """Record until told to stop, then write the session.

    Args:
        seconds: how long, from when every stream has begun; None: until told, or until all sources end.
        wait: s that every stream has to begin.
        orders: through which to stop it.
        progress: told a line a few times a second.
        finishing: told the bytes of each frame while the session is written.

    Raises:
        RecordError: if a stream did not begin, or nothing was recorded: nothing is left. If writing failed:
            what had been recorded is in `output`, or in the journal beside it, as is said.
        JournalError: if an unfinished recording waits beside `output`.
    """
    orders = Orders() if orders is None else orders
    part = _begun(output)
    with Journal(part) as journal:
        recorder = Recorder(plan, sources, journal, tap)
        failure = _attend(recorder, orders, seconds, wait, progress)
        why = str(failure or orders.why)
        failure = _end(journal, why) or failure
    if isinstance(failure, RecordError) or len(recorder.silent) == len(recorder.intakes):
        part.unlink()
        raise failure if isinstance(failure, RecordError) else RecordError(f"nothing was recorded ({why or 'stopped'})")
    progress("writing the session")
    return _concluded(part, output, failure, finishing)


def _begun(output: str | Path) -> Path:
    """The journal's name, if there is room for a session."""
    if Path(output).exists():
        raise RecordError(f"{output}: exists already, and recordings are not overwritten; choose another name")
    return part_of(output)


def _concluded(part: Path, output: str | Path, failure: Exception | None, progress: Progress) -> Summary:
    """Make the session of the journal; raises RecordError also for what cut the recording short."""
    try:
        summary = finish(part, output, progress=progress)
    except (ValueError, OSError) as error:
        todo = f"the recording is kept: jaxeit recover {part}"
        raise RecordError(f"{failure or error}; {todo}") from error
    part.unlink()
    if failure is not None:
        raise RecordError(f"{failure}; what had been recorded is in {output}") from failure
    return summary


@contextmanager
def kept(output: str | Path, tell: Callable[[str], object] = lambda line: None) -> Iterator[Journal]:
    """A journal for whoever runs a `Recorder` himself; on leaving it becomes the session `output`.

    An exception that passes is told in the session as what cut it short; without a single frame nothing is left.

    Raises:
        RecordError, JournalError: as `record`.
    """
    part = _begun(output)
    failure: BaseException | None = None
    with Journal(part) as journal:
        try:
            yield journal
        except BaseException as error:
            failure = error
        ended = _end(journal, "" if failure is None else str(failure) or type(failure).__name__)
    if not any(record.stream < PONG for record in Scan(part)):
        part.unlink()
    else:
        tell(_concluded(part, output, ended, lambda size: None).render())
    if failure is not None:
        raise failure


def _end(journal: Journal, why: str) -> JournalError | None:
    try:
        journal.append(END, 0, time.monotonic_ns(), pack_end(not why, why))
    except JournalError as error:
        return error
    return None


def _attend(recorder: Recorder, orders: Orders, seconds: float | None, wait: float, progress) -> Exception | None:
    """Run to the end of the recording; what cut it short, if something did."""
    begin, started = time.monotonic(), None
    try:
        with recorder:
            while not recorder.stop.is_set() and not orders.stop.is_set() and not recorder.ended:
                recorder.attend(_TURN)
                now = time.monotonic()
                started = now if started is None and not recorder.silent else started
                progress(recorder.render(now - begin))
                if started is None and now - begin > wait:
                    return RecordError("; ".join(map(silence, recorder.silent)))
                if started is not None and seconds is not None and now - started >= seconds:
                    break
    except JournalError as error:
        return error
    return recorder.failure


def silence(intake: Intake) -> str:
    """Why nothing came of a stream, and what to do."""
    name, url, tally = intake.source.plan.name, intake.source.url, intake.tally
    if not tally.connections:
        return f"{name}: nothing answers at {url} ({tally.problem}); is the device on, and the address right?"
    counts = tally.earlier + tally.present
    if counts.dropped:
        reasons = ", ".join(f"{n} with wrong {reason}" for reason, n in counts.dropped.items())
        expected = f"{intake.source.plan.channels} values, format {intake.source.format}"
        return f"{name}: what {url} sends are no frames of {expected} ({reasons}); see docs/wire-format.md"
    if counts.other:
        number = intake.source.plan.number
        return f"{name}: {url} sends frames of other streams, none of stream {number}; give id="
    return f"{name}: {url} sends nothing; is the device running?"
