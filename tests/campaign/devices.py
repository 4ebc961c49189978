"""Lies of devices: bytes on the wire, received and converted as `record` does, by a clock that the campaign turns."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np

from calib.record import intake
from calib.record.journal.file import Journal
from calib.record.journal.records import END, EVENT, PLAN, EventCode, pack_end, pack_event
from calib.record.plan import StreamPlan
from calib.record.sources import Link, Source
from calib.record.wire.encoding import encode_frame
from calib.session import open_session
from tests.record.test_recorder import PLANNED, S

from .honest import Honest
from .telling import Verdict, judged, same, tell

Random = np.random.Generator
KNOWN = ("/device: describes no skin: pads, numbering and signs are not checked without one",)
READINGS = 24
PLAN_OF_BOTH = replace(
    PLANNED,
    streams=(replace(PLANNED.streams[0], channels=READINGS), PLANNED.streams[1]),
    pattern=tuple((i, i + 1, i + 2, i + 3) for i in range(READINGS)),
)
SECONDS = 4.0
CLOSE = 5e6  # ns between the time of a frame and the time that is found


@dataclass(frozen=True)
class Sent:
    """What a device sends: number, ticks, values and true time (s) of each frame; its numbers on the wire."""

    plan: StreamPlan
    at: np.ndarray
    seq: np.ndarray
    ticks: np.ndarray
    values: np.ndarray
    bits: int = 32
    number: int = -1
    arrives: np.ndarray | None = None
    damage: float = 0.0  # fraction of the frames with a wrong bit


def honest_device(number: int, rng: Random) -> Sent:
    """Frames that count up, with ticks in us."""
    plan = PLAN_OF_BOTH.streams[number]
    at = np.arange(int(SECONDS * plan.rate)) / plan.rate
    noise = (0.1, 1.0)[number] * rng.normal(size=(len(at), plan.channels))
    values = 100 * np.sin(1.0 + np.arange(plan.channels) + 0.001 * at[:, None]) + noise
    values = values.astype("<i2" if number else "<f4")
    start = int(rng.integers(2**31))
    seq = start + np.arange(len(at))
    return Sent(plan, at, seq, 5_000_000 + (1e6 * at).astype(np.int64), values, 32, plan.number)


def nothing(s: Sent, rng: Random) -> Sent:
    """The truth, which must do no harm."""
    return s


# --- lies -------------------------------------------------------------------------------------------------------------


def numbers_stand(s: Sent, rng: Random) -> Sent:
    return replace(s, seq=np.full_like(s.seq, int(rng.integers(2**32))))


def numbers_fall(s: Sent, rng: Random) -> Sent:
    return replace(s, seq=s.seq[::-1])


def numbers_wrap(s: Sent, rng: Random) -> Sent:
    return replace(s, seq=s.seq % (1 << int(rng.integers(3, 16))))


def numbers_at_random(s: Sent, rng: Random) -> Sent:
    return replace(s, seq=rng.integers(0, 2**32, len(s.seq)))


def numbers_skip(s: Sent, rng: Random) -> Sent:
    """Every number is a multiple."""
    return replace(s, seq=s.seq * int(rng.integers(2, 10)))


def numbers_jump(s: Sent, rng: Random) -> Sent:
    at, jump = int(rng.integers(1, len(s.seq))), int(rng.integers(1, 2**31))
    return replace(s, seq=s.seq + np.where(np.arange(len(s.seq)) >= at, jump, 0))


def ticks_in_another_unit(s: Sent, rng: Random) -> Sent:
    factor = (1e-6, 1e-3, 1e-1, 10.0, 1e3)[int(rng.integers(5))]
    return replace(s, ticks=(s.ticks * factor).astype(np.int64), bits=64)


def ticks_stand(s: Sent, rng: Random) -> Sent:
    at = int(rng.integers(0, len(s.ticks) // 2))
    return replace(s, ticks=np.where(np.arange(len(s.ticks)) >= at, s.ticks[at], s.ticks))


def ticks_fall(s: Sent, rng: Random) -> Sent:
    return replace(s, ticks=s.ticks[::-1])


def ticks_at_random(s: Sent, rng: Random) -> Sent:
    return replace(s, ticks=rng.integers(0, 2**32, len(s.ticks)))


def ticks_jump(s: Sent, rng: Random) -> Sent:
    at, jump = int(rng.integers(1, len(s.ticks))), int(rng.integers(10**6, 2**31)) * (1, -1)[int(rng.integers(2))]
    return replace(s, ticks=s.ticks + np.where(np.arange(len(s.ticks)) >= at, jump, 0))


def ticks_wrap(s: Sent, rng: Random) -> Sent:
    """A counter of 16 or 24 bits in a field of 32."""
    return replace(s, ticks=s.ticks % (1 << int(rng.choice([16, 20, 24]))))


def ticks_of_32_bits_as_64(s: Sent, rng: Random) -> Sent:
    return replace(s, ticks=(s.ticks + 2**32 - 7_000_000) % 2**32, bits=64)


def another_type(s: Sent, rng: Random) -> Sent:
    """Counts where numbers were sent, or numbers where counts were."""
    kind = "<f4" if s.values.dtype.kind == "i" else "<i2"
    return replace(s, values=np.nan_to_num(s.values, posinf=0.0).clip(-30_000, 30_000).astype(kind))


def another_width(s: Sent, rng: Random) -> Sent:
    """A channel too few, or too many."""
    values = s.values[:, :-1] if rng.integers(2) else np.concatenate([s.values, s.values[:, :1]], 1)
    return replace(s, values=values)


def another_stream(s: Sent, rng: Random) -> Sent:
    return replace(s, number=int(rng.integers(256)))


def too_large(s: Sent, rng: Random) -> Sent:
    values = s.values.astype("<f4")
    values[:: int(rng.integers(2, 50))] = 10.0 ** rng.uniform(10, 38)
    return replace(s, values=values)


def not_numbers(s: Sent, rng: Random) -> Sent:
    values = s.values.astype("<f4")
    values[:: int(rng.integers(2, 9))] = (np.nan, np.inf)[int(rng.integers(2))]
    return replace(s, values=values)


def _only(s: Sent, kept: np.ndarray) -> Sent:
    arrives = None if s.arrives is None else s.arrives[kept]
    return replace(s, at=s.at[kept], seq=s.seq[kept], ticks=s.ticks[kept], values=s.values[kept], arrives=arrives)


def dies(s: Sent, rng: Random) -> Sent:
    return _only(s, s.at < rng.uniform(0.1, 0.8) * SECONDS)


def pauses(s: Sent, rng: Random) -> Sent:
    start = rng.uniform(0.1, 0.5) * SECONDS
    return _only(s, (s.at < start) | (s.at > start + 0.3 * SECONDS))


def loses(s: Sent, rng: Random) -> Sent:
    return _only(s, rng.random(len(s.at)) > rng.uniform(0.02, 0.9))


def repeats(s: Sent, rng: Random) -> Sent:
    """Frames are sent again."""
    return _only(s, np.sort(np.r_[np.arange(len(s.at)), rng.integers(0, len(s.at), len(s.at) // 3)]))


def disorders(s: Sent, rng: Random) -> Sent:
    """Frames overtake each other."""
    order = np.argsort(np.arange(len(s.at)) + rng.uniform(0, 6, len(s.at)), kind="stable")
    return replace(_only(s, order), arrives=s.at if s.arrives is None else s.arrives)


def values_stand(s: Sent, rng: Random) -> Sent:
    """The device sends its last values for ever, with numbers and ticks that go on."""
    at = int(rng.uniform(0.1, 0.6) * len(s.at))
    values = s.values.copy()
    values[at:] = values[at]
    return replace(s, values=values)


def in_bursts(s: Sent, rng: Random) -> Sent:
    """Frames are held back and come together; their ticks are right."""
    period = rng.uniform(0.02, 0.2)
    return replace(s, arrives=np.ceil(s.at / period) * period)


def damaged(s: Sent, rng: Random) -> Sent:
    return replace(s, damage=10 ** rng.uniform(-3, -0.3))


KINDS = (
    nothing, numbers_stand, numbers_fall, numbers_wrap, numbers_at_random, numbers_skip, numbers_jump,
    ticks_in_another_unit,
    ticks_stand, ticks_fall, ticks_at_random, ticks_jump, ticks_wrap, ticks_of_32_bits_as_64, another_type,
    another_width, another_stream, too_large, not_numbers, dies, pauses, loses, repeats, disorders, values_stand,
    in_bursts, damaged,
)  # fmt: skip


# --- receiving --------------------------------------------------------------------------------------------------------


class Clock:
    """The clock of the recorder, in ns, turned by the link."""

    def __init__(self) -> None:
        self.now = 8 * S

    def monotonic(self) -> float:
        """In s."""
        return self.now / S

    def monotonic_ns(self) -> int:
        """In ns."""
        return self.now


class WireLink(Link):
    """Gives each frame when it arrives; then stops the recording at its planned end."""

    def __init__(self, sent: Sent, clock: Clock, stop: threading.Event, spoil: Callable[[bytes], bytes]):
        self._packets, self._clock, self._stop, self._spoil = self._frames(sent), clock, stop, spoil

    def _frames(self, sent: Sent) -> Iterator[tuple[float, bytes]]:
        arrives = sent.at if sent.arrives is None else sent.arrives
        for at, seq, ticks, values in zip(arrives, sent.seq, sent.ticks, sent.values, strict=True):
            yield at, encode_frame(sent.number, int(seq), int(ticks), values, sent.bits)

    def open(self) -> None:
        """Nothing to open."""

    def close(self) -> None:
        """Nothing to close."""

    def read(self) -> bytes:
        """The next frame, at its time."""
        at, packet = next(self._packets, (SECONDS, b""))
        self._clock.now = max(self._clock.now, 8 * S + int(at * S) + 200_000)
        if not packet:
            self._stop.set()
        return self._spoil(packet)


def received(sent: dict[int, Sent], path: Path, liar: int, spoil: Callable[[bytes], bytes]) -> None:
    """A journal of these devices, as the recorder leaves it if it is killed just before the conversion."""
    with Journal(path) as journal:
        journal.append(PLAN, 0, 0, PLAN_OF_BOTH.to_json())
        for number, device in sent.items():
            clock, stop = Clock(), threading.Event()
            link = WireLink(device, clock, stop, spoil if number == liar else bytes)
            source = Source(replace(PLAN_OF_BOTH.streams[number]), "wire://")
            with (
                patch.object(Source, "link", lambda _, link=link: link),
                patch.object(
                    intake, "time", SimpleNamespace(monotonic=clock.monotonic, monotonic_ns=clock.monotonic_ns)
                ),
            ):
                receiver = intake.StreamReceiver(number, source, journal)
                receiver.run(stop)
                for text in receiver.shortfalls(clock.monotonic()):
                    journal.append(EVENT, 0, clock.now, pack_event(EventCode.FAULT, text))
                if not receiver.counters.frames:
                    text = intake.explain_silence(receiver)
                    journal.append(EVENT, 0, clock.now, pack_event(EventCode.FAULT, text[:200]))
        journal.append(END, 0, 0, pack_end(True, ""))


def lie(rng: Random, honest: Honest, folder: Path) -> tuple[str, Verdict]:
    """Two devices of which one lies, sometimes in two ways: `recover` or `check` says so, or nothing is changed."""
    true = {number: honest_device(number, rng) for number in (0, 1)}
    liar = int(rng.integers(2))
    kinds = [KINDS[i] for i in rng.choice(len(KINDS), 1 + (rng.random() < 0.3), replace=False)]
    sent = true[liar]
    for kind in kinds:
        sent = kind(sent, rng)

    def spoil(packet: bytes) -> bytes:
        data = bytearray(packet)
        if data and rng.random() < sent.damage:
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        return bytes(data)

    name = f"{sent.plan.name}: {' and '.join(kind.__name__ for kind in kinds)}"
    path, out = folder / "s.h5.part", folder / "s.h5"
    received(true | {liar: sent}, path, liar, spoil)
    answer = tell("recover", path, "-o", out)
    if answer.refused:
        return name, Verdict("refused", answer.err)
    remarks = _remarks(answer.out, sent.plan.name)
    if remarks:
        return name, Verdict("said", remarks[0])
    verdict = judged(tell("check", out, "--json"), KNOWN, sent.plan.name)
    return name, verdict or _compared(true, out, answer.out)


def _remarks(text: str, stream: str) -> list[str]:
    """What `recover` says of a stream beside its frames and clock, or of the recording because of that stream."""
    lines = [line.strip() for line in text.splitlines() if f"{stream}: " in line]
    return [line for line in lines if "not complete" in line or "; " in line.replace("; clock", "")]


def _compared(true: dict[int, Sent], out: Path, said: str) -> Verdict:
    wrong = []
    with open_session(out) as session:
        for device in true.values():
            name = device.plan.name
            found = session.stream(name)
            time = np.asarray(found.time)
            late = time - S  # the first frame was taken at 8 s of a clock that read 7 s at the epoch
            nearest = np.clip(np.searchsorted(device.at * S, late - 0.5 * S / device.plan.rate), 0, len(device.at) - 1)
            if len(time) == len(device.at):  # times within `CLOSE` may be nearer to another frame
                nearest = np.arange(len(time))
            if np.abs(late - device.at[nearest] * S).max() > CLOSE:
                wrong.append(f"times of {name}")
            elif not same(found.read(), device.plan.in_si(device.values[nearest])):
                wrong.append(f"values of {name}")
            elif len(time) < len(device.at) and " 0 lost" in said and session.complete:
                wrong.append(f"number of frames of {name}")
    return Verdict("SILENT", f"no word, and {', '.join(wrong)} differ: {said[:300]}") if wrong else Verdict("harmless")
