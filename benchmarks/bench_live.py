"""Live over loopback: loss, latency from the last byte of a frame to its force map, memory growth, highest rate.

The skin is a process of its own that sends frames of 928 readings and 1,000 samples of the pads' pressures a second.
First a soak, which is recorded as well, and another at real-time priority where that is allowed; then a recording of as
many frames in a tenth of the time; then the highest rate of frames that is sustained, by doubling and bisection. A rate
at which frames are dropped is tried once more: a machine that stands still for a moment drops them at any rate.

Latency counts from when the bytes that end a frame were read; `since_due` from when the simulated device should have
sent it: the device's own lateness, and what the bytes waited to be read, are in it. `woken` is how late a process wakes
that does nothing but sleep from one hundredth of a second to the next, at the same time: no program on this machine can
promise less, at the same priority.
"""

import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import count
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np

import calib
import jaxeit as je
from calib.calibration.evaluation import Evaluation
from calib.live.loop import LiveControl, LiveSettings, run_live
from calib.live.results import FrameResult
from calib.record.device import Packets, SimulatedDevice, frame_packets
from calib.record.intake import NullSink, RecordSink
from calib.record.journal.records import unpack_frames
from calib.record.planning import plan_recording
from calib.record.priority import real_time, refusal
from calib.record.recorder import record_session, session_journal
from calib.runtime import set_up_live

from .harness import Question, Run, with_one_blas_thread
from .memory import growth, resident
from .rows import Row

RATE, PRESSURE_RATE = 100, 1000
REST = 0.5  # s; much shorter than a pause of the simulated skin
LOST = 1e-3  # of the frames may be dropped at a rate that is sustained
FASTEST = 6400  # Hz
CLOSE = 1.1  # the rate that is sustained and the one that is not are not farther apart


def calibration_of(run: Run) -> calib.Calibration:
    return calib.load_calibration(run.args.calibration) if run.args.calibration else made_up()


def long_runs(run: Run) -> Iterator[Row]:
    """The soaks, and the recording of as many frames in a tenth of the time."""
    calibration, seconds = calibration_of(run), 5.0 if run.smoke else 60 * run.args.minutes
    yield {"readings": calibration.recon.readings, "soak": soaked(calibration, seconds)}
    if refused := refusal():
        print(f"at ordinary priority, where others may come between: {refused}")
    else:
        yield {"soak_realtime": soaked(calibration, seconds, realtime=True)}
    yield {"tenfold": tenfold(calibration, max(seconds / 10, 3.0))}


def rates(run: Run) -> Iterator[Row]:
    """The highest rate that is sustained; a rate that fails is tried once more."""
    calibration, tried = calibration_of(run), []

    def sustains(rate: int) -> bool:
        for _ in range(2):
            tried.append(watched(calibration, rate, 3.0 if run.smoke else 15.0))
            print(tried[-1], flush=True)
            if tried[-1]["sustained"]:
                return True
        return False

    yield {"highest_hz": highest(sustains, RATE, 2 * RATE if run.smoke else FASTEST), "rates": tried}


def highest(sustains: Callable[[int], bool], low: int, most: int) -> int:
    """The highest rate that is sustained, 0 if not even `low`: by doubling up to `most`, then by bisection."""
    if not sustains(low):
        return 0
    high = 2 * low
    while high <= most and sustains(high):
        low, high = high, 2 * high
    while high <= most and high > CLOSE * low:
        middle = (low + high) // 2
        low, high = (middle, high) if sustains(middle) else (low, middle)
    return low


def made_up() -> calib.Calibration:
    """A linear curve for each pad; the image as `calibrate` makes it."""
    skin = je.load_skin("chest")
    recon = je.prepare(je.discretise(je.Scene(skin), je.Fidelity.draft()))
    pressure = np.tile(np.linspace(0, 4000, 64), (len(skin.pads), 1))
    noise = np.random.default_rng(0).normal(0, 0.05, 64)
    curves = calib.fit_curves(calib.Linear(), pressure, 5e-3 * pressure[0] + noise)
    masks = je.pad_masks(skin, recon)
    return calib.Calibration(skin, recon, masks, curves, nothing_pressed(len(skin.pads)), {}, simulated=True)


def nothing_pressed(pads: int) -> Evaluation:
    """Of a calibration without presses."""
    return Evaluation(
        position=np.zeros((0, 2)),
        estimated={},
        force=np.zeros(0),
        pressure=np.zeros((0, pads)),
        pad_force=np.zeros((0, pads)),
        image_sum=np.zeros(0),
        centre=np.zeros(2),
        held_out_by="",
    )


# --- processes beside the one that is measured


@contextmanager
def beside(target: Callable[..., None], *args: Any) -> Iterator[tuple[Any, Event]]:
    """A process of its own that runs ``target(*args, told, stop)``: its queue, and the event that ends it."""
    context = get_context("spawn")
    told, stop = context.Queue(), context.Event()
    process = context.Process(target=target, args=(*args, told, stop), daemon=True)
    process.start()
    try:
        yield told, stop
    finally:
        stop.set()
        process.join(10)


@contextmanager
def device(calibration: calib.Calibration, rates: tuple[int, int]) -> Iterator[tuple[int, dict[str, str]]]:
    """The simulated skin: when it began, ns, and where its streams are."""
    with beside(skin_process, rates, (calibration.recon.readings, len(calibration.skin.pads))) as (told, _):
        begin, urls = told.get(timeout=120)
        yield begin, dict(zip(("eit", "pressure"), urls, strict=True))


def skin_process(rates: tuple[int, int], channels: tuple[int, int], told: Any, stop: Event) -> None:
    """The device, until told to stop."""
    streams = zip((1, 2), rates, channels, strict=True)
    with SimulatedDevice([frames(*stream) for stream in streams]) as device:
        told.put((device.begin, device.urls))
        stop.wait()


def frames(number: int, rate: int, channels: int) -> Packets:
    """Noise; on the pads a press of 2 kPa, two seconds of every four: rest levels can be found in each pause."""
    rng = np.random.default_rng(number)
    pool = rng.normal(0, 1e-6, (64, channels)).astype("f4")
    pressed = pool + np.float32(2e-4 * rng.normal() if number == 1 else 2000.0)
    times = (n * 1_000_000_000 // rate for n in count())
    return frame_packets(number, times, ((pressed if n // (2 * rate) % 2 else pool)[n % 64] for n in count()))


@contextmanager
def sleeper(realtime: bool) -> Iterator[dict[str, float]]:
    """Filled on leaving: how late a process that only sleeps was woken in between."""
    found: dict[str, float] = {}
    with beside(sleeping, realtime) as (told, stop):
        told.get(timeout=120)
        try:
            yield found
        finally:
            stop.set()
            found |= percentiles("woken", told.get(timeout=10))


def sleeping(realtime: bool, told: Any, stop: Event) -> None:
    """Sleep to the next hundredth of a second until told to stop; then say how late each waking was, s."""
    told.put(None)
    late, due = [], time.monotonic()
    with real_time(realtime):
        while not stop.is_set():
            due = max(due + 0.01, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            late.append(time.monotonic() - due)
    told.put(np.array(late))


# --- what is seen


class Samples:
    """Rows of two numbers; all room is taken at the beginning, so that what grows is the memory of others."""

    def __init__(self, most: float) -> None:
        self._rows, self._used = np.full((int(most), 2), np.nan), 0

    @property
    def rows(self) -> np.ndarray:
        """(n, 2)."""
        return self._rows[: self._used]

    def add(self, first: float, second: float) -> None:
        self._rows[self._used] = first, second
        self._used += 1


def grown(memory: np.ndarray, rate: int) -> dict[str, float]:
    """By how much memory, rows of s and MB, grows in an hour of frames at the rate of the paper, MB, and the standard
    error of that; nothing where a run was too short to tell."""
    found, share = growth(memory), RATE / rate
    names = ("memory_mb_per_hour", "memory_mb_per_hour_error") if np.isfinite(found.error) else ()
    return {name: round(mb * share, 2) for name, mb in zip(names, found, strict=False)}


def percentiles(name: str, seconds: np.ndarray) -> dict[str, float]:
    """Median, 99th percentile and most, ms."""
    values = 1e3 * np.nanpercentile(seconds, [50, 99, 100])
    return {f"{name}_ms_{what}": round(float(v), 3) for what, v in zip(("p50", "p99", "max"), values, strict=True)}


class Watch:
    """What arrives on its way to a log, and the results: frames of each stream, latencies, memory once a second."""

    def __init__(self, log: RecordSink, rate: int, seconds: float, begin: int) -> None:
        self._log, self._rate, self._begin = log, rate, begin
        self.received, self._due = [0, 0], np.zeros((64, 2), np.int64)  # when the last frames came, and were due
        self._latency, self._memory = Samples(1.5 * rate * seconds + 1000), Samples(seconds + 60)
        self.last: FrameResult | None = None

    @property
    def size(self) -> int:
        """Bytes written."""
        return self._log.size

    def append(self, stream: int, flags: int, host: int, payload: bytes) -> None:
        """One record."""
        self._log.append(stream, flags, host, payload)
        if stream > 1:
            return
        ticks = unpack_frames([payload]).ticks if stream == 0 else None
        if ticks is not None:
            self._due[self.received[0] % len(self._due)] = host, ticks[0]
        self.received[stream] += 1

    def __call__(self, result: FrameResult) -> None:
        now = time.monotonic_ns()
        due = self._due[self._due[:, 0] == result.host, 1]  # of those read together the earliest counts
        late = ((now - self._begin) // 1000 - int(due.min())) % 2**32 / 1e6 if len(due) else np.nan
        self._latency.add(result.latency, late)
        if not len(self._memory.rows) or now / 1e9 - self._memory.rows[-1, 0] >= 1:
            self._memory.add(now / 1e9, resident())
        self.last = result

    def found(self) -> Row:
        """In ms, and MB."""
        latency, since_due = self._latency.rows.T
        return (
            percentiles("latency", latency) | percentiles("since_due", since_due) | grown(self._memory.rows, self._rate)
        )


# --- runs


def tenfold(calibration: calib.Calibration, seconds: float) -> Row:
    """A recording at ten times the rate of the paper: frames, those lost, and what memory did."""
    rates, memory = (10 * RATE, 10 * PRESSURE_RATE), Samples(10 * seconds + 1000)
    with device(calibration, rates) as (_, urls), tempfile.TemporaryDirectory() as folder:
        plan, sources = plan_recording(urls, calibration.skin)

        def note(line: str) -> None:
            memory.add(time.monotonic(), resident())

        summary = record_session(plan, sources, Path(folder) / "session.h5", seconds=seconds, progress=note)
    streams = summary.streams
    row: Row = {"rate_hz": rates[0], "seconds": seconds, "complete": summary.complete}
    row |= {"recorded": [one.frames for one in streams], "lost": [one.lost for one in streams]}
    return row | grown(memory.rows[:-1], rates[0])  # the last is told when the session is written


def soaked(calibration: calib.Calibration, seconds: float, realtime: bool = False) -> Row:
    """One run at the rate of the paper, recorded as well: all that arrived is in the session, in order."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        row = watched(calibration, RATE, seconds, path, realtime)
        with calib.open_session(path) as session:
            streams = [session.stream(name) for name in ("eit", "pressure")]
            row["recorded"] = [len(stream) for stream in streams]
            row["recorded_gaps"] = [int((np.diff(np.asarray(s.seq, np.int64)) != 1).sum()) for s in streams]
            row["complete"] = session.complete
    return row


def watched(
    calibration: calib.Calibration, rate: int, seconds: float, output: Path | None = None, realtime: bool = False
) -> Row:
    """One run: frames and what became of them, the latencies in ms, and what memory did."""
    show, settings = LiveControl(), LiveSettings(REST, realtime=realtime)
    journal = session_journal(output) if output else nullcontext(NullSink())
    with device(calibration, (rate, PRESSURE_RATE)) as (begin, urls), journal as sink, sleeper(realtime) as woken:
        watch, timer = Watch(sink, rate, seconds, begin), threading.Timer(seconds, show.stop.set)
        plan, sources = plan_recording(urls, calibration.skin)
        run_live(calibration, plan, sources, [watch], show, settings, log=watch, begun=timer.start)
        timer.cancel()
    assert watch.last is not None, "no frame came"
    frames, dropped = watch.received[0], watch.last.dropped
    enough = frames > 0.98 * rate * seconds  # else the simulated skin, not the host, was too slow
    row: Row = {"rate_hz": rate, "seconds": round(seconds, 1), "received": watch.received, "lost": show.lost}
    row |= {"dropped": dropped, "shown": watch.last.number}
    return row | {"sustained": show.lost + dropped <= max(1, LOST * frames) and enough} | watch.found() | woken


OPTIONS: Row = {
    "--minutes": {"type": float, "default": 10.0},
    "--calibration": {"help": "default: one made up for the chest skin, without correction by place"},
}
main = Question("live", __doc__, {"runs": long_runs, "rates": rates}, OPTIONS, prepare=set_up_live)

if __name__ == "__main__":
    with_one_blas_thread()
    main()
