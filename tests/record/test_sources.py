"""Links to devices, and the simulated device they are tried on."""

import contextlib
import json
import os
import socket
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from calib.record.device import SimulatedDevice, frame_packets, recording_packets
from calib.record.intake import MIN_TIMEOUT, StreamReceiver
from calib.record.journal.records import EVENT, RESTARTED, EventCode, pack_frame, unpack_event
from calib.record.sources import (
    POLL_INTERVAL,
    ReplayLink,
    SerialLink,
    SourceError,
    TcpLink,
    session_packets,
    source_from_url,
)
from calib.record.wire.decoding import DecoderState, decode
from calib.record.wire.encoding import encode_frame, encode_read
from calib.session import Status, open_session

S = 1_000_000_000
with contextlib.suppress(ImportError):  # Windows has no pseudo-terminals
    import tty
posix = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")


class Kept:
    """A journal in memory."""

    def __init__(self):
        self.records, self.notes = [], []

    def append(self, stream, flags, host, payload):
        if stream == EVENT:
            self.notes.append(unpack_event(payload))
        else:
            self.records.append((stream, flags, host, payload))

    @property
    def seq(self):
        return [int.from_bytes(payload[4:8], "little") for *_, payload in self.records]

    @property
    def flags(self):
        return np.array([flags for _, flags, *_ in self.records])


class Running:
    """An intake at work in a thread."""

    def __init__(self, url, name="pressure", channels=4):
        self.kept, self.stop = Kept(), threading.Event()
        self.intake = StreamReceiver(0, source_from_url(name, url, channels), self.kept)
        self.thread = threading.Thread(target=self.intake.run, args=(self.stop,), daemon=True)

    def __enter__(self):
        self.thread.start()
        return self

    def __exit__(self, *error):
        self.stop.set()
        self.thread.join(5)
        assert not self.thread.is_alive()

    @property
    def counters(self):
        return self.intake.counters


def until(condition, seconds=10.0):
    """Wait for something to come true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.005)


def ramp(count, rate=200, channels=4, stream=2):
    """Frames whose values are their numbers."""
    values = (np.full(channels, n, "f4") for n in range(count))
    return frame_packets(stream, (n * S // rate for n in range(count)), values)


def frames(number, count=1, **changes):
    return b"".join(encode_frame(2, n, n * 5000, np.full(4, n, "f4"), **changes) for n in range(number, number + count))


class Peer:
    """A listener that a test speaks through by hand."""

    def __init__(self):
        self.server = socket.create_server(("127.0.0.1", 0))
        self.server.settimeout(10)
        self.url = f"tcp://127.0.0.1:{self.server.getsockname()[1]}"
        self.clients = []

    def __enter__(self):
        return self

    def __exit__(self, *error):
        for client in self.clients:
            client.close()
        self.server.close()

    def accept(self):
        self.clients.append(self.server.accept()[0])
        return self.clients[-1]


# --- links ---------------------------------------------------------------------------------------


def drained(link, count, layouts, seconds=10.0):
    """Frames read from a link until there are `count`."""
    state, found, end = DecoderState(), [], time.monotonic() + seconds
    link.open()
    try:
        while len(found) < count:
            assert time.monotonic() < end
            state, new = decode(layouts, state, link.read())
            found += new
    finally:
        link.close()
    return found


@pytest.mark.parametrize("port", [0, pytest.param(None, marks=posix)])
def test_a_device_is_heard_over_tcp_and_over_a_terminal(port):
    """What a terminal holds when it is opened is thrown away: that was before our time."""
    with SimulatedDevice([ramp(10**6)], [port], wait_for=1) as device:
        plan = source_from_url("pressure", device.urls[0], 4)
        found = drained(plan.link(), 50, {2: plan.plan.layout})
    first = found[0].seq
    assert first == 0 or port is None
    assert [frame.seq for frame in found] == list(range(first, first + len(found)))
    assert all((frame.values == frame.seq).all() for frame in found)
    assert device.sent[0] >= len(found)


def test_pyserial_over_a_socket():
    """pyserial, too, throws away what came before it was ready."""
    with SimulatedDevice([ramp(10**6)], wait_for=1) as device:
        plan = source_from_url("pressure", device.urls[0].replace("tcp", "socket"), 4)
        link = plan.link()
        assert isinstance(link, SerialLink)
        found = drained(link, 20, {2: plan.plan.layout})
    assert [f.seq for f in found] == list(range(found[0].seq, found[0].seq + len(found)))
    assert all((f.values == f.seq).all() for f in found)


def test_a_loop_gives_back_what_is_written():
    link = source_from_url("pressure", "loop://", 4).link()
    link.open()
    assert link.read() == b""
    link.write(b"hello")
    got = b""
    while len(got) < 5:
        got += link.read()
    link.close()
    link.close()
    assert got == b"hello"


def test_a_recorded_session_is_replayed(bundled):
    path = next(p for p in bundled if "presses" in p.name)
    with open_session(path) as session:
        stream = session.stream("pressure")
        values, times = stream.read(0, 400), stream.time
    plan = source_from_url("pressure", f"replay://{path}?speed=20", values.shape[1])
    begin = time.monotonic()
    found = drained(plan.link(), 400, {2: plan.plan.layout})
    assert time.monotonic() - begin > 0.9 * (times[399] - times[0]) / S / 20
    np.testing.assert_array_equal([f.values for f in found[:400]], values.astype("f4"))
    assert [f.ticks for f in found[:400]] == [int(t) // 1000 % 2**32 for t in times[:400]]


def test_a_replay_ends(bundled):
    link = source_from_url("force", f"replay://{bundled[0]}?speed=1e9", 1).link()
    assert isinstance(link, ReplayLink)
    link.open()
    state, count = DecoderState(), 0
    with contextlib.suppress(EOFError):
        while True:
            state, found = decode({3: source_from_url("force", "loop://", 1).plan.layout}, state, link.read())
            count += len(found)
    with open_session(bundled[0]) as session:
        assert count == len(session.stream("force"))
    assert json.loads(state.note)["simulated"] is True
    assert state.counts.dropped == {}


def test_several_streams_of_a_session_on_one_line(bundled):
    with SimulatedDevice([recording_packets(bundled[0], ["pressure", "force"])], speed=1e9, wait_for=1) as device:
        with Running(device.urls[0], "force", 1) as run:
            until(lambda: run.counters.frames > 2000)
        assert run.kept.seq == list(range(run.counters.frames))
        assert run.counters.dropped == {}
        assert (run.intake.counters.earlier + run.counters.present).other > 0


def test_a_session_played_twice_goes_on_counting(bundled):
    with open_session(bundled[1]) as session:
        count = len(session.stream("force"))
    state, raw = DecoderState(), b"".join(packet for _, packet in session_packets(bundled[1], "force", rounds=2))
    _, found = decode({3: source_from_url("force", "loop://", 1).plan.layout}, state, raw)
    assert [frame.seq for frame in found] == list(range(2 * count))
    ticks = np.diff([frame.ticks for frame in found])
    assert ticks.min() > 0
    assert ticks[count - 1] < 10 * ticks.min()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ftp://host", "names no source"),
        ("host:80", "names no source"),
        ("tcp://host", "lacks host or port"),
        ("tcp://:80", "lacks host or port"),
        ("tcp://host:99999", "port .* from 1 to 65535"),
        ("tcp://host:0", "port .* from 1 to 65535"),
        ("tcp://host:http", "port .* from 1 to 65535"),
        ("serial://", "names no port"),
        ("replay://", "names no file"),
        ("tcp://host:1?speed=x", "not a number"),
        ("tcp://host:1?scale=nan", "scale=nan .* not a finite number"),
        ("tcp://host:1?tick=inf", "tick=inf .* not a finite number"),
        ("serial:///dev/x?baud=nan", "baud=nan .* not a finite number"),
        ("tcp://host:1?rate=0", "rate=0 .* Hz, above zero"),
        ("tcp://host:1?rate=-5", "rate=-5 .* Hz, above zero"),
        ("tcp://host:1?colour=red", "colour= .* use one of"),
        ("tcp://host:1?format=xml", "xml"),
        ("serial:///dev/x?baud=0", "baud"),
        ("tcp://host:1?ping=-1", "ping"),
    ],
)
def test_urls_that_name_no_source_are_refused(url, words):
    with pytest.raises(SourceError, match=words):
        source_from_url("force", url, 1)


def test_options_of_a_url():
    url = "serial://COM3?baud=9600&ping=2&rate=50&tick=1e-3&scale=2&offset=1&id=9&channels=6&format=csv"
    found = source_from_url("force", url, 1)
    plan = found.plan
    assert (plan.rate, plan.tick, plan.scale, plan.offset, plan.number, plan.channels) == (50, 1e-3, 2, 1, 9, 6)
    assert (found.baud, found.format, found.ping, plan.transport) == (9600, "csv", 2.0, "serial://COM3")


@pytest.mark.parametrize("url", ["tcp://127.0.0.1:1", "serial:///dev/nonesuch", "socket://127.0.0.1:1"])
def test_a_device_that_is_not_there_is_an_os_error(url):
    with pytest.raises(OSError, match=r"."):
        source_from_url("force", url, 1).link().open()


@posix
def test_a_port_is_ours_alone():
    with SimulatedDevice([ramp(1)], [None]) as device:
        one, other = (source_from_url("pressure", device.urls[0], 4).link() for _ in range(2))
        one.open()
        with pytest.raises(OSError, match="lock"):
            other.open()
        one.close()


def gathered(url, condition, channels=4):
    """What a device sends until a condition on the frames so far holds."""
    with Running(url, channels=channels) as run:
        until(lambda: condition(run))
    return run


def test_a_device_that_plays_a_simulated_session_says_so_whenever_one_joins(bundled):
    with SimulatedDevice([recording_packets(bundled[1], ["pressure"])], speed=5.0) as device:
        for _ in range(2):
            run = gathered(device.urls[0], lambda run: run.counters.simulated)
            ((_, text),) = [note for note in run.kept.notes if note[0] is EventCode.SIMULATED]
            assert bundled[1].name in json.loads(text)["scene"]
            time.sleep(0.3)


@pytest.mark.parametrize("port", [0, pytest.param(None, marks=posix)])
def test_a_device_sends_only_the_readings_that_it_is_asked_for(port):
    """And all of them again when it is asked no more."""
    wanted = np.array([True, False, False, True])
    with SimulatedDevice([ramp(10**6)], [port]) as device, Running(device.urls[0]) as run:

        def values():
            return [np.frombuffer(payload[16:], "<f4") for *_, payload in run.kept.records[-1:]]

        until(lambda: run.counters.frames > 5)
        assert np.isfinite(values()).all()
        run.intake.send(encode_read(2, wanted))
        until(lambda: np.array_equal(np.isfinite(values()[0]), wanted))
        assert len({*values()[0][wanted]}) == 1
        until(lambda: np.isfinite(values()).all())
    seq = np.array(run.kept.seq)
    assert (np.diff(seq) == 1).all()
    assert run.counters.dropped == {}


def test_nothing_is_sent_to_who_is_not_there():
    intake = StreamReceiver(0, source_from_url("pressure", "tcp://127.0.0.1:1", 4), Kept())
    intake.send(b"x")
    for url in ("tcp://127.0.0.1:1", "serial:///dev/none"):
        with pytest.raises(OSError, match="not connected"):
            source_from_url("pressure", url, 4).link().write(b"x")
    with pytest.raises(OSError, match="ReplayLink cannot send to the device"):
        ReplayLink("none.h5", intake.source.plan).write(b"x")


def test_a_port_of_no_kind_is_an_os_error():
    with pytest.raises(OSError, match="none://x: invalid URL"):
        SerialLink("none://x").open()


@posix
def test_a_port_closed_by_another_is_an_os_error():
    with SimulatedDevice([ramp(1)], [None]) as device:
        link = source_from_url("pressure", device.urls[0], 4).link()
        link.open()
        ours, link._port.fd = link._port.fd, None  # as pyserial leaves it, in the midst of a read
        with pytest.raises(OSError, match="the port was closed"):
            link.read()
        link._port.fd = ours
        link.close()


# --- faults on the line --------------------------------------------------------------------------


def slowest_return(rounds):
    """Unplug and plug a device over and over: nothing is invented, the gaps are flagged; the longest wait, s."""
    with SimulatedDevice([ramp(10**6, rate=500)]) as device, Running(device.urls[0]) as run:
        slowest = 0.0
        for _ in range(rounds):
            count = run.counters.frames
            until(lambda count=count: run.counters.frames > count + 20)
            device.unplug()
            until(lambda: not run.counters.connected)
            device.plug()
            begin = time.monotonic()
            count = run.counters.frames
            until(lambda count=count: run.counters.frames > count)
            slowest = max(slowest, time.monotonic() - begin)
    seq, flags = np.array(run.kept.seq), run.kept.flags
    jumps = np.flatnonzero(np.diff(seq) != 1) + 1
    assert (np.diff(seq) > 0).all()
    assert run.counters.lost == (np.diff(seq) - 1).sum()
    assert (flags[jumps] & Status.gap_before).all()
    assert (flags & Status.disconnected).astype(bool).sum() == run.counters.connections - 1 >= rounds
    assert len([text for _, text in run.kept.notes if "connected" in text]) == run.counters.connections
    return slowest


def test_a_device_that_comes_back_is_heard_within_two_seconds():
    assert slowest_return(6) < 2


@pytest.mark.slow
def test_a_device_that_comes_back_fifty_times(hard):
    slowest = slowest_return(50)
    assert slowest < 2
    told = f"received again within {slowest:.1f} s, gaps flagged and counted to the frame"
    hard("fault 8: TCP device unplugged and plugged", "50 times", beyond=told)


def slowest_return_of_a_port(port, rounds):
    """Unplug and plug a serial device that begins anew each time, at a port of a fixed name; the longest wait, s."""
    slowest = 0.0
    with Running(f"serial://{port}") as run:
        for _ in range(rounds):
            with SimulatedDevice([ramp(10**6, rate=500)], [None]) as device:
                port.symlink_to(device.urls[0].removeprefix("serial://"))
                begin, count = time.monotonic(), run.counters.frames
                until(lambda count=count: run.counters.frames > count)
                slowest = max(slowest, time.monotonic() - begin)
                until(lambda count=count: run.counters.frames > count + 20)
            until(lambda: not run.counters.connected)
            port.unlink()
    first = np.flatnonzero(run.kept.flags & Status.disconnected)
    assert len(first) == run.counters.connections - 1 >= rounds - 1
    assert (run.kept.flags[first] & Status.gap_before).all()
    runs = np.split(np.array(run.kept.seq), first)
    assert all((np.diff(seq) == 1).all() for seq in runs)
    return slowest


@posix
def test_a_serial_port_may_be_unplugged(tmp_path):
    assert slowest_return_of_a_port(tmp_path / "tty", 3) < 2


@posix
@pytest.mark.slow
def test_a_serial_port_may_be_unplugged_fifty_times(tmp_path, hard):
    slowest = slowest_return_of_a_port(tmp_path / "tty", 50)
    assert slowest < 2
    told = f"received again within {slowest:.1f} s, flagged where frames are missing"
    hard("fault 8: serial device unplugged and plugged", "50 times, restarted each time", beyond=told)


@posix
def test_ten_million_random_bytes_on_a_serial_line_make_no_frame(hard):
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    rng = np.random.default_rng(0)

    def babble():
        for _ in range(1000):
            left = memoryview(rng.bytes(10_000))
            while left:
                left = left[os.write(ours, left) :]

    link, state, heard = source_from_url("pressure", f"serial://{os.ttyname(theirs)}", 4).link(), DecoderState(), 0
    link.open()
    thread = threading.Thread(target=babble)
    thread.start()
    while heard < 10_000_000:
        data = link.read()
        heard += len(data)
        state, found = decode({2: source_from_url("pressure", "loop://", 4).plan.layout}, state, data)
        assert not found
    thread.join()
    link.close()
    os.close(ours)
    os.close(theirs)
    pieces = sum(state.counts.dropped.values())
    assert pieces > 10_000
    hard("fault 8: random bytes on a serial line", "1e7", beyond=f"no frame; {pieces:,} pieces counted as damaged")


def test_a_reset_in_mid_frame_costs_that_frame(hard):
    with Peer() as peer, Running(peer.url) as run:
        client = peer.accept()
        client.sendall(frames(0, 5) + frames(5)[:9])
        until(lambda: run.counters.frames == 5)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        client.close()
        peer.accept().sendall(frames(6, 3))
        until(lambda: run.counters.frames == 8)
    assert run.kept.seq == [0, 1, 2, 3, 4, 6, 7, 8]
    assert run.kept.flags.tolist() == [0] * 5 + [Status.disconnected | Status.gap_before] + [0] * 2
    assert (run.counters.lost, run.counters.dropped) == (1, {})
    hard("fault 9: reset in mid-frame", "TCP", beyond="that frame, counted as lost; the next is flagged")


def test_a_slow_drip_is_cut_off(hard):
    """Bytes that never become a frame: three periods (or half a second) after the last frame."""
    with Peer() as peer, Running(peer.url + "?rate=100") as run:
        client = peer.accept()
        client.sendall(frames(0, 5))
        begin = time.monotonic()
        with contextlib.suppress(OSError):
            while time.monotonic() - begin < 5:
                client.sendall(b"\x42")
                time.sleep(0.02)
        assert MIN_TIMEOUT < time.monotonic() - begin < MIN_TIMEOUT + 1.5
        peer.accept().sendall(frames(9))
        until(lambda: run.counters.frames == 6)
    assert any("no frame" in text for _, text in run.kept.notes)
    told = f"opened again after three periods, but not before {MIN_TIMEOUT} s: TCP repeats lost packets after 0.2 s"
    hard("fault 9: bytes that never become a frame", "50 a second", beyond=told)


def test_a_slow_stream_is_waited_for():
    slow, unknown, quick = (
        StreamReceiver(0, source_from_url("force", f"tcp://h:1{q}", 1), Kept()) for q in ("?rate=0.1", "", "?rate=50")
    )
    assert (slow._timeout(0.0, 0), quick._timeout(0.0, 0)) == (30.0, MIN_TIMEOUT)
    assert (unknown._timeout(1.0, 3), unknown._timeout(40.0, 40)) == (5.0, 3.0)


def test_a_claim_of_four_gigabytes_is_only_bytes():
    with Peer() as peer, Running(peer.url) as run:
        client = peer.accept()
        client.sendall(frames(0) + b"\xff\xff\xff\xff" + b"x" * 3_000_000 + b"\0" + frames(1, 2))
        until(lambda: run.counters.frames == 3)
    assert run.counters.dropped == {"overlong": 1}
    assert run.kept.flags.tolist() == [0, Status.crc_resync, 0]


def test_repeated_and_reordered_frames_are_kept_once_in_order(hard):
    with Peer() as peer, Running(peer.url) as run:
        order = [0, 1, 1, 2, 5, 4, 3, 6, 6, 6, 7, 2, 8]
        peer.accept().sendall(b"".join(frames(n) for n in order))
        until(lambda: run.counters.frames == 7)
    assert run.kept.seq == [0, 1, 2, 5, 6, 7, 8]
    assert np.flatnonzero(run.kept.flags & Status.gap_before).tolist() == [3]
    assert (run.counters.lost, run.counters.rejected) == (2, 6)
    told = "kept once, in order; a frame that arrives after a later one is counted as lost, and flagged"
    hard("fault 9: frames repeated and reordered", "up to 64 behind", beyond=told)


def test_garbage_between_frames_is_skipped_and_flagged():
    rng = np.random.default_rng(0)
    with Peer() as peer, Running(peer.url) as run:
        client = peer.accept()
        client.sendall(frames(0))
        for n in range(1, 50):
            client.sendall(rng.bytes(500) + b"\0" + frames(n))
        until(lambda: run.counters.frames == 50)
    assert run.kept.seq == list(range(50))
    assert (run.kept.flags[1:] == Status.crc_resync).all()
    values = [np.frombuffer(payload[16:], "<f4") for *_, payload in run.kept.records]
    np.testing.assert_array_equal(values, np.arange(50)[:, None] * np.ones(4))


def test_a_restarted_device_is_noticed():
    with Peer() as peer, Running(peer.url) as run:
        peer.accept().sendall(frames(100, 5) + frames(0, 5))
        until(lambda: run.counters.frames == 9)
    assert run.kept.seq == [100, 101, 102, 103, 104, 1, 2, 3, 4]
    assert run.kept.flags[5] == RESTARTED | Status.gap_before


def test_lines_of_text_are_flagged():
    with Peer() as peer, Running(peer.url + "?format=csv", "force", 1) as run:
        peer.accept().sendall(b"3\n1.5\n2.5\nhello\n3.5\n")
        until(lambda: run.counters.frames == 3)
    assert run.kept.flags.tolist() == [Status.unchecked] * 2 + [Status.unchecked | Status.crc_resync]


def test_a_slow_listener_of_the_device_loses_whole_frames():
    big = [np.full(928, n, "f4") for n in range(10)]
    many = ((n * S // 10_000, encode_frame(1, n, n, big[n % 10])) for n in range(2500))
    with SimulatedDevice([many], wait_for=1) as device:
        link = source_from_url("eit", device.urls[0], 928).link()
        assert isinstance(link, TcpLink)
        link.open()
        assert device.done.wait(20)
        state, found = DecoderState(), []
        while data := link.read():
            state, new = decode({1: source_from_url("eit", device.urls[0], 928).plan.layout}, state, data)
            found += new
        link.close()
    assert 100 < len(found) < 2500
    assert state.counts.dropped == {}


def test_waiting_costs_no_time_of_the_processor():
    with Peer() as peer, Running(peer.url):
        peer.accept()
        before = time.process_time()
        time.sleep(1.0)
        assert time.process_time() - before < 0.2
    assert POLL_INTERVAL >= 0.05


def test_values_are_written_as_they_came():
    frame = decode({2: source_from_url("pressure", "loop://", 4).plan.layout}, DecoderState(), frames(7))[1][0]
    counts = replace(source_from_url("pressure", "loop://", 4).plan, scale=1e-3)
    assert counts.layout.scale == 1e-3
    assert pack_frame(frame)[16:] == np.full(4, 7, "<f4").tobytes()
