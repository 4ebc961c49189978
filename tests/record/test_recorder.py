"""Recording: the journal and what is made of it, and the recorder under every fault that could be arranged."""

import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from itertools import count
from typing import NamedTuple

import h5py
import numpy as np
import pytest

from benchmarks.memory import Growth, growth, resident
from calib.check import check_session
from calib.cli import main
from calib.record.device import SimulatedDevice
from calib.record.journal.conversion import convert_journal
from calib.record.journal.file import MAX_PAYLOAD, SYNC_INTERVAL, Journal, JournalError, JournalReader
from calib.record.journal.records import (
    END,
    EVENT,
    PLAN,
    PONG,
    RESTARTED,
    EventCode,
    pack_end,
    pack_event,
    pack_frame,
    pack_pong,
)
from calib.record.plan import STREAM_KINDS, PlanError, RecordingPlan, StreamPlan, plan_from_json
from calib.record.planning import plan_recording
from calib.record.recorder import StopRequest, record_session
from calib.record.sources import MAX_READ_BYTES, source_from_url
from calib.record.wire.encoding import encode_frame, encode_note
from calib.record.wire.messages import Frame, Pong
from calib.session import SessionError, Status, open_session

S = 1_000_000_000
SOAK = 600.0  # s
PATTERN = ((0, 1, 2, 3), (1, 2, 3, 4), (2, 3, 4, 5))
PLANNED = RecordingPlan(
    (StreamPlan("eit", 3, 100.0), StreamPlan("pressure", 2, 200.0, scale=0.5, offset=100.0)),
    "2026-01-01T00:00:00+00:00",
    7 * S,
    "an id",
    title="a test",
    skin_name="bench",
    pattern=PATTERN,
    current=1e-3,
)


def sample(stream, number, *, late=200_000, **changes):
    """Frame `number` of a stream of the plan: its record's stream, flags, time and payload."""
    rate = PLANNED.streams[stream].rate
    at = int(number * S / rate)
    values = np.full(PLANNED.streams[stream].channels, number % 1000, "<i2" if stream else "<f4")
    frame = Frame(stream, number, (5_000_000 + at // 1000) % 2**32, 32, values)
    return stream, changes.pop("flags", 0), 8 * S + at + late, pack_frame(frame._replace(**changes))


def journal(path, records, *, end=True, plan=PLANNED):
    """A journal with a plan and `records`."""
    with Journal(path) as out:
        out.append(PLAN, 0, 0, plan.to_json())
        for record in records:
            out.append(*record)
        if end:
            out.append(END, 0, 0, pack_end(True, ""))
    return path


def both(eit=40):
    """Frames of both streams as they come."""
    return [sample(*where) for n in range(eit) for where in ((0, n), (1, 2 * n), (1, 2 * n + 1))]


# --- the journal ---------------------------------------------------------------------------------


def test_records_come_back(tmp_path):
    records = both()
    found = [r[1:] for r in JournalReader(journal(tmp_path / "j", records))]
    assert found == [(PLAN, 0, 0, PLANNED.to_json()), *records, (END, 0, 0, pack_end(True, ""))]


def test_a_cut_at_every_byte_leaves_an_exact_prefix(tmp_path, hard):
    path = journal(tmp_path / "j", both(6))
    whole, raw = list(JournalReader(path)), path.read_bytes()
    ends = []  # of each record
    at = 20
    for entry in whole:
        at += 28 + len(entry.payload)
        ends.append(at)
    assert at == len(raw)
    cut = tmp_path / "cut"
    told = "exactly the records that are whole"
    hard("fault 2: journal cut off", f"at each of {len(raw):,} bytes", beyond=told)
    for size in range(20, len(raw) + 1):
        cut.write_bytes(raw[:size])
        scan = JournalReader(cut)
        kept = sum(end <= size for end in ends)
        assert list(scan) == whole[:kept]
        assert (scan.lost, scan.damaged) == (0, 0)
        assert scan.torn == size - (ends[kept - 1] if kept else 20)


def test_what_is_too_short_is_refused_in_words(tmp_path):
    raw = journal(tmp_path / "j", []).read_bytes()
    for size in range(20):
        (tmp_path / "cut").write_bytes(raw[:size])
        with pytest.raises(JournalError, match="is empty" if size == 0 else "does not begin"):
            JournalReader(tmp_path / "cut")
    with pytest.raises(JournalError, match="No such file"):
        JournalReader(tmp_path / "none")
    with pytest.raises(JournalError, match="is a folder"):
        JournalReader(tmp_path)


def spoilt(raw, rng):
    """A few bytes changed, a stretch overwritten by zeros or by another stretch, removed or doubled."""
    out, at = bytearray(raw), int(rng.integers(20, len(raw)))
    size = int(rng.integers(1, 200))
    kind = rng.integers(5)
    if kind == 0:
        for _ in range(int(rng.integers(1, 4))):
            out[int(rng.integers(20, len(raw)))] ^= int(rng.integers(1, 256))
    elif kind == 1:
        out[at : at + size] = bytes(min(size, len(raw) - at))
    elif kind == 2:
        other = int(rng.integers(0, len(raw) - size))
        out[at : at + size] = raw[other : other + min(size, len(raw) - at)]
    elif kind == 3:
        del out[at : at + size]
    else:
        out[at:at] = raw[at - min(size, at - 20) : at]
    return bytes(out)


def no_invention(tmp_path, count, seed):
    path = journal(tmp_path / "j", both(10))
    whole, raw, rng = list(JournalReader(path)), path.read_bytes(), np.random.default_rng(seed)
    known, kept = {*whole}, 0
    for _ in range(count):
        (tmp_path / "cut").write_bytes(spoilt(raw, rng))
        scan = JournalReader(tmp_path / "cut")
        found = list(scan)
        assert known.issuperset(found)
        numbers = [record.number for record in found]
        assert numbers == sorted({*numbers})
        assert scan.lost == (numbers[-1] + 1 - len(numbers) if numbers else 0)
        kept += len(found)
    return kept / count / len(whole)


def test_damage_never_invents_a_record(tmp_path):
    assert no_invention(tmp_path, 1500, 0) > 0.9


@pytest.mark.slow
def test_damage_never_invents_a_record_in_twenty_thousand_tries(tmp_path, hard):
    kept = no_invention(tmp_path, 20_000, 1)
    assert kept > 0.9
    told = f"no record invented, {100 * kept:.0f} % of them kept, those lost counted"
    hard("fault 2: journal damaged", "20,000 times: bytes, segments, pages", beyond=told)


def test_records_of_another_journal_are_not_taken_up(tmp_path):
    other = journal(tmp_path / "other", both(2)).read_bytes()
    mine = journal(tmp_path / "mine", [sample(0, 0), (1, 0, 0, other[20:]), sample(0, 1)])
    raw = bytearray(mine.read_bytes())
    raw[raw.rindex(other[20:60]) - 5] ^= 1  # the record around it is damaged
    mine.write_bytes(raw)
    scan = JournalReader(mine)
    assert [r.number for r in scan] == [0, 1, 3, 4]
    assert scan.lost == 1


def test_scanning_takes_bounded_memory_and_finds_markers_across_pieces(tmp_path):
    """A hole of ten megabytes, and one record of the largest size behind it."""
    large = os.urandom(MAX_PAYLOAD)
    path = journal(tmp_path / "j", [(0, 0, 1, b"7" * 1000)] * 3 + [(0, 0, 2, large)], end=False)
    raw = path.read_bytes()
    hole = raw.index(b"7" * 1000)
    path.write_bytes(raw[: hole - 24] + b"\xf7jx" * 3_333_333 + raw[len(raw) - MAX_PAYLOAD - 28 :])
    scan = JournalReader(path)
    assert [r.payload for r in scan] == [PLANNED.to_json(), large]
    assert (scan.lost, scan.torn) == (3, 0)


def test_a_journal_is_not_overwritten_nor_read_while_it_grows(tmp_path):
    with Journal(tmp_path / "j") as out:
        out.append(PLAN, 0, 0, b"")
        with pytest.raises(JournalError, match="still being recorded"):
            JournalReader(tmp_path / "j")
        with pytest.raises(JournalError, match="still being recorded; give another name"):
            Journal(tmp_path / "j")
    with pytest.raises(JournalError, match="jaxeit recover"):
        Journal(tmp_path / "j")
    with pytest.raises(JournalError, match="cannot be written"):
        Journal(tmp_path / "none" / "j")
    with Journal(tmp_path / "k") as out, pytest.raises(JournalError, match="keep below"):
        out.append(0, 0, 0, bytes(MAX_PAYLOAD + 1))


class History(NamedTuple):
    """What a journal and its syncs did, and when: records, sizes with each appended, sizes synced (s, bytes)."""

    raw: bytes
    records: list
    appended: np.ndarray
    synced: np.ndarray


@pytest.fixture
def history(tmp_path, monkeypatch):
    """A journal of a second and a half, of about a record a ms, and what of it was brought to the disk when."""
    name, synced, appended = "fdatasync" if hasattr(os, "fdatasync") else "fsync", [], []
    bring = getattr(os, name)

    def note(file):
        size = os.fstat(file).st_size
        bring(file)
        synced.append((time.monotonic(), size))

    monkeypatch.setattr(os, name, note)
    rng = np.random.default_rng(0)
    with Journal(tmp_path / "j") as out:
        for number in range(1000):
            out.append(0, 0, number, rng.bytes(int(rng.integers(20, 400))))
            appended.append((time.monotonic(), out.size))
            time.sleep(0.0015)
        while not synced or synced[-1][1] < out.size:
            time.sleep(0.01)
        quiet = len(synced)
        time.sleep(0.3)
        assert len(synced) == quiet  # nothing to bring
    raw = (tmp_path / "j").read_bytes()
    return History(raw, list(JournalReader(tmp_path / "j")), np.array(appended), np.array(synced))


def without_power(history, now, rng):
    """What a disk holds that loses power at a time: what was synced, and of later pages any, whole, empty or old."""
    synced = int(max(history.synced[history.synced[:, 0] <= now, 1], default=20))
    # On a busy machine a record may be synced before the test notes that it was appended.
    written = max(synced, int(history.appended[np.searchsorted(history.appended[:, 0], now) - 1, 1]))
    left = bytearray(history.raw[: int(rng.integers(synced, written + 1))])
    for page in range(synced // 4096 * 4096, len(left), 4096):
        part = slice(max(page, synced), min(page + 4096, len(left)))
        size, kind = part.stop - part.start, rng.integers(3)
        if kind:  # else it was brought in time
            old = int(rng.integers(0, len(history.raw) - 4096))
            left[part] = bytes(size) if kind == 1 else history.raw[old : old + size]
    return bytes(left), synced


def power_cuts(history, path, count):
    """Cut the power over and over: what was synced is there and nothing is invented; the oldest record lost, s."""
    rng, oldest = np.random.default_rng(1), 0.0
    for _ in range(count):
        now = rng.uniform(history.appended[1, 0], history.appended[-1, 0])
        left, synced = without_power(history, now, rng)
        path.write_bytes(left)
        found = list(JournalReader(path))
        assert {*history.records}.issuperset(found)
        assert [r.number for r in found] == sorted({r.number for r in found})
        must, there = int((history.appended[:, 1] <= synced).sum()), int((history.appended[:, 0] <= now).sum())
        assert found[:must] == history.records[:must]
        missing = sorted({*range(must, there)} - {r.number for r in found})
        oldest = max(oldest, now - history.appended[missing[0], 0]) if missing else oldest
    return oldest


def test_a_power_cut_costs_what_was_not_synced(history, tmp_path):
    assert SYNC_INTERVAL <= 0.1
    assert len(history.synced) >= 5
    assert power_cuts(history, tmp_path / "cut", 50) > 0


@pytest.mark.slow
def test_a_thousand_power_cuts_cost_what_was_not_synced(history, tmp_path, hard):
    oldest = power_cuts(history, tmp_path / "cut", 1000)
    told = f"no record invented, none lost that was synced; the last {1e3 * oldest:.0f} ms lost at most"
    hard("fault 2: power cut while recording", "1,000 cuts, any page not synced kept, empty or old", beyond=told)


FULL = """
import resource, signal, sys
from calib.record.journal.file import Journal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
try:
    with Journal(sys.argv[1]) as out:
        for number in range(1000):
            out.append(0, 0, number, bytes(100))
except ValueError as error:
    sys.exit(f"said: {error}")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs file size limits")
def test_a_full_disk_leaves_whole_records(tmp_path):
    command = [sys.executable, "-c", FULL, str(tmp_path / "j")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr.startswith("said: j: cannot be written")
    assert len(done.stderr.splitlines()) == 1
    scan = JournalReader(tmp_path / "j")
    assert [r.host for r in scan] == list(range((10_000 - 20) // 128))
    assert scan.torn == 0


# --- the plan ------------------------------------------------------------------------------------


def test_a_plan_comes_back_from_its_text():
    assert plan_from_json(PLANNED.to_json()) == PLANNED
    bare = replace(PLANNED, streams=PLANNED.streams[1:], pattern=None, offset=(0.5,), simulated=True, scene="s", seed=1)
    assert plan_from_json(bare.to_json()) == bare


@pytest.mark.parametrize(
    "text", [b"", b"[]", b"{}", b"\xff", b'{"format": 1, "version": 1}', b'{"format": "jaxeit-journal"}']
)
def test_what_is_no_plan_is_refused(text):
    with pytest.raises(JournalError, match="journal"):
        plan_from_json(text)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"title": 5}, "title: is a int"),
        ({"title": "a\0"}, "title: is a text that cannot be stored"),
        ({"title": "\ud800"}, "title: is a text that cannot be stored"),
        ({"skin_toml": "x" * 300_000}, "skin_toml: is a text that cannot be stored"),
        ({"epoch": "never"}, "never"),
        ({"host_epoch": 10**30}, "host_epoch 10+ or seed None: too large"),
        ({"seed": 2**62}, "too large; keep below 2.62"),
        ({"current": "1"}, "current: is a str"),
        ({"current": True}, "current: is a bool"),
        ({"current": float("nan")}, "current: is a float"),
        ({"current": 10**400}, "too large"),
        ({"pattern": [[0, 1, 2, 2**15]] * 3}, "pattern: names impossible electrodes"),
        ({"pattern": [[0, 1, 2]] * 3}, "pattern: names impossible electrodes"),
        ({"pattern": [[0.5, 1, 2, 3]] * 3}, "pattern: is a tuple"),
        ({"simulated": True}, "scene: a simulated recording does not say how"),
    ],
)
def test_a_plan_no_session_can_hold_is_refused(changes, words):
    table = json.loads(PLANNED.to_json()) | changes
    with pytest.raises(JournalError, match=rf"^journal: its description cannot be read \(.*{words}"):
        plan_from_json(json.dumps(table).encode())


def test_plans_must_be_sound():
    eit = PLANNED.streams[0]
    for streams, words in (((), "none"), ((eit, eit), "once"), ((replace(eit, channels=2),), "pattern of 3 rows")):
        with pytest.raises(PlanError, match=words):
            replace(PLANNED, streams=streams)
    with pytest.raises(PlanError, match="not known"):
        StreamPlan("smell", 1)
    with pytest.raises(PlanError, match=r"tick 0.0 s; give 1e-12 to 1e3 s"):
        replace(eit, tick=0.0)
    for field in ("rate", "scale", "offset", "tick"):
        with pytest.raises(PlanError, match=f"{field} nan; give a finite number"):
            replace(eit, **{field: float("nan")})
    with pytest.raises(PlanError, match="title: is a text that cannot be stored; use at most 262,144 bytes of Unicode"):
        replace(PLANNED, title="\udcff")  # as a name of a file may be
    with pytest.raises(PlanError, match="transport: is a text that cannot be stored"):
        replace(eit, transport="serial:///dev/\udcff")


# --- journal to session --------------------------------------------------------------------------


def finished(tmp_path, records, **how):
    """The session made of some records, and what was said about it."""
    path = journal(tmp_path / "s.h5.part", records, **how)
    summary = convert_journal(path, tmp_path / "s.h5", recovered=not how.get("end", True))
    return summary, open_session(tmp_path / "s.h5")


def test_a_session_is_made_of_the_journal(tmp_path):
    summary, session = finished(tmp_path, both(1200))
    with session as s:
        assert (s.complete, s.recovered, s.title, s.skin_name) == (True, False, "a test", "bench")
        assert s.pattern.tolist() == [list(row) for row in PATTERN]
        eit, pressure = s.stream("eit"), s.stream("pressure")
        np.testing.assert_array_equal(eit.read(), np.arange(1200)[:, None] % 1000 * np.ones(3))
        np.testing.assert_array_equal(pressure.read(), np.arange(2400)[:, None] % 1000 * np.full(2, 0.5) + 100)
        for stream in (eit, pressure):
            true = S + np.arange(len(stream)) * int(S / stream.nominal_rate) + 200_000
            assert np.abs(stream.time - true).max() < 2_000
            assert stream.seq.tolist() == list(range(len(stream)))
            np.testing.assert_array_equal(stream.time_host, true + 7 * S)
            np.testing.assert_array_equal(stream.time_device, 5_000_000 + (true - 200_000 - S) // 1000)
            assert not stream.status().any()
        clock = s.clocks["eit"]
        assert clock.valid
        assert (clock.tick_s, abs(clock.drift_ppm) < 1, clock.residual_p95_ns < 1000) == (1e-6, True, True)
    assert summary.complete
    assert [(x.frames, x.lost) for x in summary.streams] == [(1200, 0), (2400, 0)]
    assert "eit: 1,200 frames, 0 lost; clock" in summary.render()


def test_the_same_journal_gives_the_same_bytes(tmp_path):
    path = journal(tmp_path / "j", both())
    for name in ("a", "b"):
        convert_journal(path, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_gaps_steps_and_restarts_are_flagged(tmp_path):
    records = [sample(0, n) for n in range(500) if n not in (100, 101)]
    records += [sample(0, n, ticks=n * 10_000) for n in range(500, 800)]  # set back by five seconds
    records += [sample(0, n, seq=n - 800, flags=RESTARTED) for n in range(800, 801)]
    records += [sample(0, n, seq=n - 800) for n in range(801, 1000)]
    records.insert(50, (EVENT, 0, 9 * S, pack_event(EventCode.NOTE, "hello")))
    summary, session = finished(tmp_path, records)
    with session as s:
        status = s.stream("eit").status()
        assert np.flatnonzero(status & Status.gap_before).tolist() == [100]
        assert np.flatnonzero(status & Status.clock_step).tolist() == [498, 798]
        true = S + np.r_[0:100, 102:1000] * (S // 100) + 200_000
        assert np.abs(s.stream("eit").time - true).max() < 1_000_000
        assert [*zip(s.events.code.tolist(), s.events.label, strict=True)] == [(4, "hello"), (3, "eit"), (3, "eit")]
    assert (summary.streams[0].lost, summary.streams[0].steps) == (2, 2)


def test_lines_without_ticks_are_timed_by_arrival(tmp_path):
    values = np.array([1.5, np.nan])
    flags = int(Status.unchecked)
    records = [(*sample(1, n, seq=None, ticks=None, values=values, flags=flags)[:2], (8 + n // 2) * S, payload)
               for n in range(20) for payload in [sample(1, n, seq=None, ticks=None, values=values)[3]]]  # fmt: skip
    _, session = finished(tmp_path, records)
    with session as s:
        stream = s.stream("pressure")
        assert (stream.seq, stream.time_device, len(s.clocks), "eit" in s.streams) == (None, None, 0, False)
        np.testing.assert_array_equal(stream.time, [(1 + n // 2) * S + n % 2 for n in range(20)])
        np.testing.assert_array_equal(stream.read(), np.tile([100.75, np.nan], (20, 1)))
        assert (stream.status() == Status.unchecked | Status.nonfinite).all()


def test_a_wrong_length_of_tick_is_said_and_times_are_those_of_arrival(tmp_path):
    summary, session = finished(tmp_path, [sample(0, n, ticks=10 * n) for n in range(1500)])
    assert "rather 0.001" in summary.render()
    with session as s:
        np.testing.assert_array_equal(s.stream("eit").time, S + np.arange(1500) * (S // 100) + 200_000)
        assert not s.clocks


def test_a_counter_of_too_few_bits_is_said(tmp_path):
    summary, session = finished(tmp_path, [sample(0, n, ticks=10_000 * n % 2**16) for n in range(1500)])
    assert "its clock jumps" in summary.render()
    with session as s:
        np.testing.assert_array_equal(s.stream("eit").time, S + np.arange(1500) * (S // 100) + 200_000)


def test_a_missing_count_is_missing(tmp_path):
    values = np.array([-32768, 5], "<i2")
    _, session = finished(tmp_path, [sample(1, n, values=values) for n in range(5)])
    with session as s:
        np.testing.assert_array_equal(s.stream("pressure").read(), np.tile([np.nan, 102.5], (5, 1)))
        assert (s.stream("pressure").status() == Status.nonfinite).all()


def test_what_a_crash_left_is_marked(tmp_path):
    records = both()
    path = journal(tmp_path / "s.h5.part", records, end=False)
    raw = path.read_bytes()
    path.write_bytes(raw[:-10])
    summary = convert_journal(path, tmp_path / "s.h5", recovered=True)
    assert (summary.complete, summary.bytes_damaged > 0) == (False, True)
    assert "the recorder was killed" in summary.render()
    with open_session(tmp_path / "s.h5") as s:
        assert (s.complete, s.recovered) == (False, True)
        assert (len(s.stream("eit")), len(s.stream("pressure"))) == (40, 79)


def test_damage_in_the_middle_costs_what_it_touches(tmp_path):
    path = journal(tmp_path / "j", both(100))
    raw = bytearray(path.read_bytes())
    middle = raw.index(sample(0, 50)[3])
    raw[middle : middle + 60] = bytes(60)
    path.write_bytes(raw)
    summary = convert_journal(path, tmp_path / "s.h5")
    assert (summary.complete, summary.records_lost) == (False, 2)
    with open_session(tmp_path / "s.h5") as s:
        assert s.stream("eit").seq.tolist() == [n for n in range(100) if n != 50]
        assert np.flatnonzero(s.stream("eit").status() & Status.gap_before).tolist() == [50]
        assert np.flatnonzero(s.stream("pressure").status() & Status.gap_before).tolist() == [100]


def test_nothing_recorded_is_said(tmp_path):
    with pytest.raises(JournalError, match="no frame was recorded"):
        finished(tmp_path, [])
    with Journal(tmp_path / "k") as out:
        out.append(*sample(0, 1))
    with pytest.raises(JournalError, match="description is damaged"):
        convert_journal(tmp_path / "k", tmp_path / "s.h5")
    assert not (tmp_path / "s.h5").exists()


@pytest.mark.parametrize(
    ("said", "scene", "seed"),
    [
        ({"scene": "a scene", "seed": 3}, "a scene", 3),
        ({"scene": "a\0\ud800b" + "x" * 5000, "seed": 10**30}, "a??b" + "x" * 996, 0),
        ({"scene": [], "seed": -3.5}, "not stated by the device", 0),
    ],
)
def test_what_a_device_says_of_itself_never_costs_the_recording(tmp_path, said, scene, seed):
    about = (EVENT, 0, 8 * S, pack_event(EventCode.SIMULATED, json.dumps({"simulated": True} | said)))
    _, session = finished(tmp_path, [about, (EVENT, 0, 8 * S, pack_event(EventCode.NOTE, "\0\ud800")), *both()])
    with session as s:
        assert (s.simulated, s.scene, s.seed) == (True, scene, seed)
        assert s.events.label[0] == "??"
        assert len(s.stream("eit")) == 40


BAD_FRAME = bytearray(sample(0, 3)[3])
BAD_FRAME[0] |= 15


@pytest.mark.parametrize(
    ("record", "words"),
    [
        ((0, 0, 9 * S, b""), "is no frame of 3 readings"),
        ((1, 0, 9 * S, sample(0, 3)[3]), "is no frame of 2 readings"),
        ((0, 0, 9 * S, bytes(BAD_FRAME)), "is no frame of 3 readings"),
        ((0, 0, 2**62, sample(0, 3)[3]), "came at an impossible time, 4611686018427387904 ns"),
        ((EVENT, 0, 9 * S, b"[" * 50_000), "is no event: not JSON"),
        ((EVENT, 0, 9 * S, b"[4]"), "is no event: not a pair"),
        ((EVENT, 0, 9 * S, b'[99, "x"]'), "is no known event"),
        ((EVENT, 0, 9 * S, b'[5, "{"]'), "is no note of a simulation: not JSON"),
        ((END, 0, 9 * S, b"null"), "is no end: not a pair"),
        ((PONG, 0, 9 * S, b"1"), "is no answer to a ping"),
        ((PONG, 0, 9 * S, pack_pong(0, Pong(-(2**63), 1))), "came at an impossible time, -9223372036854775808 ns"),
    ],
)
def test_records_of_another_making_are_refused_by_number(tmp_path, record, words):
    """Their sums are right, so they are no damage."""
    with pytest.raises(JournalError, match=rf"^s\.h5\.part: record 61 {words}; use the jaxeit that wrote it$"):
        finished(tmp_path, [*both(20), record])
    assert os.listdir(tmp_path) == ["s.h5.part"]


def test_an_answer_of_an_unknown_stream_is_left_out(tmp_path):
    _, session = finished(tmp_path, [*both(), (PONG, 0, 9 * S, pack_pong(7, Pong(8 * S, 1)))])
    with session as s:
        assert {*s.clocks} == {"eit", "pressure"}


# --- what the session file says of clocks --------------------------------------------------------


def fewer_knots(clock):
    knots = clock["host_ns"][1:]
    del clock["host_ns"]
    clock.create_dataset("host_ns", data=knots, chunks=True, fletcher32=True)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (fewer_knots, r"^s\.h5: /clocks/eit: knots of unequal number; give one tick for each time"),
        (lambda g: g.move("host_ns", "other"), "host_ns: missing"),
        (lambda g: g.attrs.modify("drift_ppm", np.nan), "drift_ppm"),
        (lambda g: g.__setitem__("host_ns", h5py.SoftLink("/device")) if g.move("host_ns", "x") is None else 0, "soft"),
    ],
)
def test_unsound_clocks_are_refused(tmp_path, change, words):
    _, session = finished(tmp_path, both())
    session.close()
    with h5py.File(tmp_path / "s.h5", "r+", libver=("v110", "v110")) as file:
        change(file["clocks/eit"])
    with open_session(tmp_path / "s.h5") as s, pytest.raises(SessionError, match=words):
        _ = s.clocks


# --- recording -----------------------------------------------------------------------------------

RATES = {"eit": 100, "pressure": 1000}
READINGS = 928
POOL = np.random.default_rng(0).normal(size=(64, READINGS)).astype("<f4")


def endless(name, rate=None, about=None):
    """What a device sends for ever: values known from their numbers, ticks of its own clock; a note ten times a second.

    Args:
        about: what the notes say; None: no notes.
    """
    number, rate = STREAM_KINDS[name].number, rate or RATES[name]
    channels = READINGS if name == "eit" else 4
    for seq in count():
        if about is not None and seq % (rate // 10) == 0:
            yield int(seq * S / rate), encode_note(number, about)
        yield int(seq * S / rate), encode_frame(number, seq, seq * 1_000_000 // rate, POOL[seq % 64, :channels])


def expected(name, seq):
    return POOL[np.asarray(seq) % 64][:, : READINGS if name == "eit" else 4].astype(float)


RECORDER = """
import sys
import numpy as np
from calib.record.intake import StreamReceiver
from calib.record.plan import RecordingPlan
from calib.record.recorder import StopRequest, record_session
from calib.record.sources import Source, source_from_url
from calib.cli.signals import orderly_end
import resource, signal
eit, pressure, output, seconds, limit, counts = sys.argv[1:]
if counts:  # what is counted in a mapped file outlives the process
    decoded, taken = np.memmap(counts, "i8", "r+", shape=(2, 7))
    decode, take = Source.decode, StreamReceiver._take
    def counted_decode(self, *data):
        state, frames = decode(self, *data)
        decoded[self.plan.number] += len(frames)
        return state, frames
    def counted_take(self, frame, host):
        taken[frame.stream] += 1
        take(self, frame, host)
    Source.decode, StreamReceiver._take = counted_decode, counted_take
if int(limit):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), int(limit)))
sources = [source_from_url("eit", eit, 928), source_from_url("pressure", pressure, 4)]
pattern = tuple((0, 1, 2 + n % 9, 3 + n % 9) for n in range(928))
plan = RecordingPlan(tuple(s.plan for s in sources), "2026-01-01T00:00:00+00:00", 0, "id", pattern=pattern)
orders = StopRequest()
told = []
def progress(line):
    if "eit 0" not in line and "pressure 0" not in line and not told:
        told.append(print("recording", flush=True))
try:
    with orderly_end(orders, planned=bool(float(seconds))):
        done = record_session(
            plan, sources, output, seconds=float(seconds) or None, stop_request=orders, progress=progress
        )
        print(done.render())
except KeyboardInterrupt:
    sys.exit(130)
except ValueError as error:
    print(f"jaxeit: {error}", file=sys.stderr)
    sys.exit(2)
sys.exit(orders.status)
"""


@pytest.fixture(scope="module")
def device():
    """A skin of 928 readings at 100 Hz, and pressures at 1 kHz."""
    with SimulatedDevice([endless("eit"), endless("pressure")]) as found:
        yield found


def recorder(device, output, seconds=0.0, limit=0, counts=""):
    """The recorder at work in a process of its own; in the file ``counts`` it counts frames decoded and taken."""
    command = [sys.executable, "-c", RECORDER, *device.urls, str(output), str(seconds), str(limit), str(counts)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() in ("recording\n", ""), process.communicate(timeout=20)
    return process


def sound(session):
    """Every sample is what was sent under its number, none is missing."""
    for name, stream in session.streams.items():
        seq = stream.seq
        assert (np.diff(seq.astype(np.int64)) == 1).all()
        np.testing.assert_array_equal(stream.read(), expected(name, seq))
        assert not stream.status().any()
    return {name: len(stream) for name, stream in session.streams.items()}


class Killed(NamedTuple):
    """A recorder killed: frames left; frames it had begun to work on, or decoded, that are lost; ms before the kill
    that the last frame left had come."""

    frames: int
    taken: int
    decoded: int
    age: float


def killed(device, folder, number, seconds):
    """Kill a recorder after some time."""
    output, counts = folder / f"{number}.h5", folder / f"{number}.counts"
    np.zeros((2, 7), "i8").tofile(counts)
    process = recorder(device, output, counts=counts)
    time.sleep(seconds)
    process.kill()
    process.communicate(timeout=20)
    begin = time.monotonic_ns()
    summary = convert_journal(f"{output}.part", output, recovered=True)
    with open_session(output) as session:
        assert (session.complete, session.recovered) == (False, True)
        frames = sound(session)
        last = max(int(stream.time_host[-1]) for stream in session.streams.values())
    assert summary.bytes_damaged < 8192
    left = np.zeros(7, int)
    for name, kept in frames.items():
        left[STREAM_KINDS[name].number] = kept
    lost = np.fromfile(counts, "i8").reshape(2, 7) - left
    assert (lost >= 0).all()
    for name in frames:  # decoded at once is what one read brings, and the beginning that was there before
        assert (lost[0, STREAM_KINDS[name].number] - 1) * len(next(endless(name))[1]) <= MAX_READ_BYTES
    return Killed(frames["eit"], int(lost[1].max()), int(lost[0].max()), (begin - last) / 1e6)


def test_a_killed_recorder_leaves_a_session(device, tmp_path):
    rng = np.random.default_rng(0)
    for number in range(3):
        found = killed(device, tmp_path, number, rng.uniform(0, 0.5))
        assert found.frames > 0
        assert found.taken <= 1
        assert found.age < 2000  # what was there to the last


@pytest.mark.slow
def test_two_hundred_killed_recorders_leave_sessions(device, tmp_path, hard):
    rng, found = np.random.default_rng(1), []
    for number in range(200):
        found.append(killed(device, tmp_path, number, rng.uniform(0, 0.3)))
        assert found[-1].frames > 0
        assert found[-1].taken <= 1
        for path in tmp_path.iterdir():
            path.unlink()
    taken, decoded = max(kill.taken for kill in found), max(kill.decoded for kill in found)
    told = f"all opened, marked not complete; lost per stream: at most {taken} frame in work and {decoded} of "
    told += f"the same read of at most {MAX_READ_BYTES >> 10} KiB; the last kept frame arrived "
    told += f"{np.median([kill.age for kill in found]):.0f} ms before the kill (median)"
    hard("fault 1: kill -9 of the recorder", "200 kills at random moments", beyond=told)


def test_what_was_received_is_on_the_disk_when_the_recorder_is_killed(device, tmp_path):
    """At most one frame per stream: a record is written before the next frame is looked at."""
    path = tmp_path / "j"
    code = (
        "import os, sys; from calib.record.journal.file import Journal\n"
        "out = Journal(sys.argv[1])\n"
        "for n in range(500): out.append(0, 0, n, bytes(3700))\n"
        "os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(path)], timeout=60, check=False)
    assert [r.host for r in JournalReader(path)] == list(range(500))


def kills_while_finishing(folder, count):
    """Kill who makes a session over an older one: how often the new one was there; it is whole, or the old one is."""
    records = [sample(*where) for n in range(3000) for where in ((0, n), (1, 2 * n), (1, 2 * n + 1))]
    part, output = journal(folder / "s.h5.part", records), folder / "s.h5"
    code = (
        "import sys; from calib.record.journal.conversion import convert_journal\n"
        "print(1, flush=True); convert_journal(*sys.argv[1:])"
    )
    rng, new = np.random.default_rng(0), 0
    for _ in range(count):
        output.write_bytes(b"the old one")
        command = [sys.executable, "-c", code, str(part), str(output)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE)
        process.stdout.readline()
        time.sleep(rng.uniform(0, 0.4))
        process.kill()
        process.communicate(timeout=20)
        if output.read_bytes() == b"the old one":
            continue
        new += 1
        with open_session(output) as session:
            assert (len(session.stream("eit")), len(session.stream("pressure"))) == (3000, 6000)
    output.unlink()  # the last kill may have left the new one, and no recording is replaced
    convert_journal(part, output)
    with open_session(output) as session:
        np.testing.assert_array_equal(session.stream("eit").read()[:, 0], np.arange(3000) % 1000)
    return new


def test_a_kill_while_the_session_is_made_costs_nothing(tmp_path):
    assert kills_while_finishing(tmp_path, 3) < 3


@pytest.mark.slow
def test_a_hundred_kills_while_the_session_is_made_cost_nothing(tmp_path, hard):
    new = kills_while_finishing(tmp_path, 100)
    told = f"the old file {100 - new} times, the whole new one {new} times; written again from the journal"
    hard("fault 3: kill -9 while the session is made", "100 kills at random moments", beyond=told)


@pytest.mark.parametrize(
    ("name", "planned", "status"), [("SIGINT", False, 0), ("SIGINT", True, 130), ("SIGTERM", False, 143)]
)
def test_a_signal_ends_a_recording_in_order(device, tmp_path, name, planned, status, hard):
    output = tmp_path / "s.h5"
    process = recorder(device, output, 60.0 if planned else 0.0)
    process.send_signal(getattr(signal, name))
    out, err = process.communicate(timeout=30)
    assert (process.returncode, err) == (status, "")
    assert ("not complete" in out) == bool(status)
    assert os.listdir(tmp_path) == ["s.h5"]
    with open_session(output) as session:
        assert session.complete == (status == 0)
        assert not session.recovered
        assert sound(session)["eit"] > 0
    told = "a session; if it was to last longer: not complete, exit not 0; after a second signal: recovered"
    hard("fault 4: signals while recording", "SIGINT, SIGTERM, SIGINT twice", beyond=told)


def test_two_signals_end_it_at_once_and_it_can_be_recovered(device, tmp_path):
    process = recorder(device, tmp_path / "s.h5")
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.002)
    _, err = process.communicate(timeout=30)
    assert process.returncode in (0, 130)  # it may have been quicker than the second
    assert "Traceback" not in err
    if process.returncode == 130:
        assert main(["recover", str(tmp_path / "s.h5.part")]) == 0
    with open_session(tmp_path / "s.h5") as session:
        assert sound(session)["eit"] > 0


@pytest.mark.skipif(sys.platform == "win32", reason="needs file size limits")
def test_a_disk_that_fills_up_costs_nothing_recorded(device, tmp_path):
    process = recorder(device, tmp_path / "s.h5", limit=300_000)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert len(err.splitlines()) == 1
    assert "cannot be written (File too large)" in err
    if "recover" in err:
        assert main(["recover", str(tmp_path / "s.h5.part")]) == 0
    with open_session(tmp_path / "s.h5") as session:
        assert session.complete is False
        assert sound(session)["eit"] > 50


@pytest.mark.parametrize("call", ["write", "fdatasync"])
def test_a_disk_that_fails_ends_a_recording_in_order(device, tmp_path, monkeypatch, capsys, call, hard):
    """An input/output error after some records; the journal is whole, and what is written of it stays."""
    if not hasattr(os, call):
        pytest.skip(f"there is no {call} here")
    real, calls = getattr(os, call), count()

    def failing(file, *data):
        ours = part.exists() and os.path.samestat(os.fstat(file), part.stat())
        if ours and next(calls) >= (200 if call == "write" else 3):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return real(file, *data)

    part, output = tmp_path / "s.h5.part", tmp_path / "s.h5"
    monkeypatch.setattr(os, call, failing)
    url = f"--pressure={device.urls[1]}?channels=4"
    assert main(["record", url, "-o", str(output), "--seconds", "30"]) == 2
    err = capsys.readouterr().err
    assert "cannot be written (Input/output error)" in err
    assert str(output) in err
    assert len(err.splitlines()) == 1
    with open_session(output) as session:
        assert session.complete is False
        assert sound(session)["pressure"] > 100
    told = "one line, exit 2, every record written before is in the session"
    hard("fault 4: input/output error while recording", "of writing, of syncing", beyond=told)


def test_a_recording_of_some_seconds_by_the_command_line(device, tmp_path, capsys):
    output = tmp_path / "s.h5"
    urls = [f"--pressure={device.urls[1]}?channels=4", f"--barometer={device.urls[1]}?channels=4&id=2"]
    assert main(["record", *urls, "-o", str(output), "--seconds", "1"]) == 0
    assert "complete" in capsys.readouterr().out
    with open_session(output) as session:
        assert {*sound(session)} == {"pressure", "barometer"}
        assert len(session.stream("pressure")) >= 900
        assert (session.complete, session.recovered) == (True, False)
    assert main(["record", *urls, "-o", str(output), "--seconds", "1"]) == 2
    assert "not overwritten" in capsys.readouterr().err


def test_a_device_that_answers_pings_is_laid_on_the_clock_of_the_host(tmp_path):
    """In a process of this machine the truth is known: when frames were due."""
    with SimulatedDevice([endless("pressure", 500)]) as device:
        url = f"{device.urls[0]}?ping=0.05"
        plan, sources = plan_recording({"pressure": url + "&channels=4"}, None)
        summary = record_session(plan, sources, tmp_path / "s.h5", seconds=2.0)
        begin = device.begin
    (told,) = summary.streams
    assert "less a latency of" in summary.render()
    with open_session(tmp_path / "s.h5") as session:
        clock, stream = session.clocks["pressure"], session.stream("pressure")
        assert (clock.latency_ns, clock.rtt_ns) == (told.latency.ns, told.latency.rtt)
        assert 0 < clock.rtt_ns < S
        true = begin - plan.host_epoch + stream.time_device.astype(np.int64) * 1000
        shift = stream.time - true
        assert np.abs(np.median(shift)) < clock.rtt_ns / 2 + 2_000_000
        assert sound(session)["pressure"] > 0


def test_errors_of_the_command_line(device, tmp_path, capsys):
    output = str(tmp_path / "s.h5")
    cases = {
        "which streams": [],
        "name the skin": [f"--eit={device.urls[0]}"],
        "add channels=": [f"--pressure={device.urls[1]}"],
        "names no source": ["--force=ftp://x"],
        "nothing answers": ["--force=tcp://127.0.0.1:1", "--wait=0.3"],
        "with wrong length": [f"--force={device.urls[1]}?id=2", "--wait=0.5"],
        "none of stream 3": [f"--force={device.urls[1]}", "--wait=0.5"],
        "does not exist": [f"--force=replay://{tmp_path}/none.h5", "--wait=0.5"],
    }
    for words, arguments in cases.items():
        assert main(["record", *arguments, "-o", output]) == 2
        err = capsys.readouterr().err
        assert words in err
        assert len(err.splitlines()) == 1
        assert os.listdir(tmp_path) == []


def test_an_earlier_recording_is_not_lost_to_a_new_one(device, tmp_path, capsys):
    output = tmp_path / "s.h5"
    journal(tmp_path / "s.h5.part", both(), end=False)
    assert main(["record", f"--pressure={device.urls[1]}?channels=4", "-o", str(output)]) == 2
    assert "jaxeit recover" in capsys.readouterr().err
    assert main(["recover", str(output) + ".part"]) == 0
    assert "may then be deleted" in capsys.readouterr().out
    assert main(["recover", str(output) + ".part"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["recover", str(output)]) == 2
    assert "-o" in capsys.readouterr().err


@pytest.mark.parametrize("about", [None, {"simulated": True, "seed": 3}], ids=["silent", "notes"])
def test_streams_that_come_and_go_are_recorded_with_their_gaps(tmp_path, about):
    plan, sources = plan_recording({"pressure": "tcp://127.0.0.1:1?channels=4"}, None)
    orders, folder = StopRequest(), tmp_path / "s.h5"
    with SimulatedDevice([endless("pressure", 500, about)]) as device:
        sources = [source_from_url("pressure", device.urls[0], 4)]
        plan = replace(plan, streams=(sources[0].plan,))

        def disturb():
            for _ in range(2):
                time.sleep(0.5)
                device.unplug()
                time.sleep(0.2)
                device.plug()
            time.sleep(1.0)
            orders.stop_recording()

        thread = threading.Thread(target=disturb)
        thread.start()
        summary = record_session(plan, sources, folder, stop_request=orders)
        thread.join()
    with open_session(folder) as session:
        stream = session.stream("pressure")
        seq, status = stream.seq.astype(np.int64), stream.status()
        jumps = np.flatnonzero(np.diff(seq) != 1) + 1
        assert 1 <= len(jumps) <= 4
        assert (status[jumps] & Status.gap_before).all()
        assert np.isin(np.flatnonzero(status & Status.disconnected), jumps).all()
        assert summary.streams[0].lost == (np.diff(seq) - 1).sum() > 0
        assert not (status & Status.clock_step).any()
        true = seq * (S // 500)
        assert np.ptp(stream.time - true) < 20_000_000
        said = [] if about is None else [EventCode.SIMULATED]
        assert {*session.events.code.tolist()} == {EventCode.CONNECTED, EventCode.LOST, EventCode.FAULT, *said}
        assert session.simulated is (about is not None)
        assert not session.complete
        assert "frames were lost; check the link" in summary.render()


# --- devices that lie ----------------------------------------------------------------------------

LIE_RATE, LIE_SECONDS = 200, 1.5


def lying(name, seq=lambda n: n, ticks=lambda n: n * 1_000_000 // LIE_RATE, frames=10_000):
    """Frames of a device whose sequence numbers or ticks are not what they should be."""
    kind, channels = STREAM_KINDS[name], {"stage": 3, "pressure": 4, "eit": 550}.get(name, 1)
    rng = np.random.default_rng(0)
    for n in range(frames):
        values = rng.normal(size=channels).astype("<f4")
        yield int(n * S / LIE_RATE), encode_frame(kind.number, seq(n) % 2**32, ticks(n), values)


LIES = {
    "pressure": ("number constant", lying("pressure", seq=lambda n: 7), "do not count up"),
    "force": ("number falling", lying("force", seq=lambda n: -n), "do not count up"),
    "stage": ("number of 5 bits", lying("stage", seq=lambda n: n % 32), "do not count up"),
    "temperature": (
        "clock stopped",
        lying("temperature", seq=lambda n: 7, ticks=lambda n: 7),
        "its clock stands still",
    ),
    "barometer": ("ticks in ms as us", lying("barometer", ticks=lambda n: n * 1000 // LIE_RATE), r"rather 0\.00(1|09)"),
    "eit": ("dies before the end", lying("eit", frames=40), "no frame came in the last"),
}


@pytest.fixture(scope="module")
def lies(tmp_path_factory):
    """What is said of a recording of devices that lie, and the session."""
    path = tmp_path_factory.mktemp("lies") / "s.h5"
    with SimulatedDevice([packets for _, packets, _ in LIES.values()], wait_for=1) as device:
        urls = [f"--{name}={url}" for name, url in zip(LIES, device.urls, strict=True)]
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            status = main(["record", *urls, "--skin", "testbed", "--seconds", str(LIE_SECONDS), "-o", str(path)])
    return status, out.getvalue() + err.getvalue(), path


@pytest.mark.parametrize("name", LIES)
def test_a_device_that_lies_is_named_and_its_frames_are_kept(lies, name, hard):
    status, said, path = lies
    lie, _, words = LIES[name]
    assert status == 2, said
    assert "not complete" in said
    assert re.search(rf"{name}: .*{words}", said), said
    with open_session(path) as session:
        stream = session.stream(name)
        assert len(stream) >= 40  # more than a number of 5 bits counts; how many come in time depends on the machine
        assert 5e-3 * (len(stream) - 1) == pytest.approx(np.ptp(stream.time) / 1e9, rel=0.5)
        assert not session.complete
        faults = [label for code, label in zip(session.events.code, session.events.label, strict=True) if code == 6]
        assert any(re.search(words, label) for label in faults if label.startswith(name))
        found = [finding.what for finding in check_session(session).findings if finding.where == "/events"]
        assert found == faults
    told = next(label for label in faults if label.startswith(name) and re.search(words, label))
    hard(f"lie: device, {lie}", "`record`: exit 2; `check`: warning", beyond=told)


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="the system does not tell what memory is taken")
def test_ten_minutes_at_ten_times_the_rate_take_no_more_memory_and_are_accounted_for(tmp_path, hard):
    """Of 100 minutes of 100 frames of 928 readings and 1,000 pressures a second.

    What a busy machine cannot take is counted and flagged; bench_live says what is lost on a quiet one.
    """
    names, used = {"eit": 1000, "pressure": 10_000}, []
    with SimulatedDevice([endless(name, rate) for name, rate in names.items()]) as device:
        process = recorder(device, tmp_path / "s.h5", SOAK)
        end = time.monotonic() + SOAK - 5  # before it makes the session
        while time.monotonic() < end:
            used.append((time.monotonic(), resident(process.pid)))
            time.sleep(0.5)
        out, err = process.communicate(timeout=1200)
    assert (process.returncode, err) == (0, "")
    grown = Growth(*(share / 10 for share in growth(np.array(used))))  # in an hour of frames at 100 Hz
    assert grown.error < 0.5, "too restless a machine to tell"
    assert grown.slope - 2 * grown.error < 1.0
    frames, lost = {}, {}
    with open_session(tmp_path / "s.h5") as session:
        assert session.complete
        for name in names:
            stream = session.stream(name)
            ahead = np.diff(stream.seq.astype(np.int64))
            assert (ahead > 0).all()
            flagged = (stream.status()[1:] & Status.gap_before) != 0
            np.testing.assert_array_equal(flagged, ahead > 1)
            frames[name], lost[name] = len(stream), int((ahead - 1).sum())
            assert f"{name}: {frames[name]:,} frames, {lost[name]:,} lost" in out
            np.testing.assert_array_equal(stream.read(0, 1000), expected(name, stream.seq[:1000]))
    (tmp_path / "s.h5").unlink()  # gigabytes
    told = f"memory grows by {grown} of frames at 100 Hz; "
    told += f"{lost['eit']:,} of {frames['eit']:,} frames lost by the link, counted and flagged"
    hard("fault 19: ten times 100 Hz for ten minutes", "928 readings, 10,000 pressures a second", beyond=told)
