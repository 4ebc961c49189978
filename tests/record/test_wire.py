"""The wire: bytes to frames, however cut, damaged or invented."""

import json
import re
import shutil
import subprocess
import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from calib.record.wire.decoding import DecoderCounts, DecoderState, decode, decode_lines
from calib.record.wire.encoding import (
    encode_frame,
    encode_note,
    encode_ping,
    encode_pong,
    encode_read,
    parse_requests,
    select_readings,
)
from calib.record.wire.framing import cobs_decode, cobs_encode, crc16
from calib.record.wire.messages import MAX_FRAME_BYTES, Layout, Pong, WireError
from calib.record.wire.sequence import REORDER_WINDOW, SequencePlace, SequenceState, place_frame

LAYOUTS = {1: Layout(1, 5, limit=1e3), 2: Layout(2, 2, scale=1e-3, limit=1e3)}
LINES = {1: Layout(1, 2, limit=1e3)}


def fed(decoder, layouts, data, cuts=()):
    """Decode `data` cut at `cuts`."""
    state, frames = DecoderState(), []
    edges = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    for start, stop in pairwise(edges):
        state, found = decoder(layouts, state, data[start:stop])
        frames += found
    return state, frames


def plain(frame):
    return (*frame[:4], frame.values.tobytes(), *frame[5:])


def some(count, seed=0):
    """Frames of both streams in turn, as sent and as they should arrive."""
    rng, sent = np.random.default_rng(seed), []
    for number in range(count):
        stream = 1 + number % 2
        values = rng.normal(size=LAYOUTS[stream].channels) * 100
        values = values.astype("f4") if stream == 1 else values.astype("i2")
        sent.append((stream, number // 2, int(rng.integers(2**32)), values))
    return sent, b"".join(encode_frame(*frame) for frame in sent)


# --- stuffing and checksum -----------------------------------------------------------------------


def test_crc_is_the_one_that_is_named():
    assert crc16(b"123456789") == 0x29B1


@pytest.mark.parametrize(
    ("raw", "stuffed"),
    [
        (b"\0", b"\x01\x01"),
        (b"\0\0", b"\x01\x01\x01"),
        (b"\x11\x22\0\x33", b"\x03\x11\x22\x02\x33"),
        (b"\x11\0\0\0", b"\x02\x11\x01\x01\x01"),
        (bytes(range(1, 254)), b"\xfe" + bytes(range(1, 254))),
        (b"\0" + bytes(range(1, 255)), b"\x01\xff" + bytes(range(1, 255)) + b"\x01"),
        (bytes(range(1, 256)), b"\xff" + bytes(range(1, 255)) + b"\x02\xff"),
    ],
)
def test_cobs_as_published(raw, stuffed):
    assert cobs_encode(raw) == stuffed
    assert cobs_decode(stuffed) == raw


def test_cobs_also_without_the_optional_last_byte():
    assert cobs_decode(b"\xff" + bytes(range(1, 255))) == bytes(range(1, 255))


@given(st.binary(max_size=2000) | st.integers(0, 1100).map(lambda n: b"\x05" * n))
def test_cobs_comes_back(raw):
    stuffed = cobs_encode(raw)
    assert 0 not in stuffed
    assert len(stuffed) <= len(raw) + len(raw) // 254 + 1
    assert cobs_decode(stuffed) == raw


# --- binary frames -------------------------------------------------------------------------------


@given(st.integers(0, 40), st.lists(st.integers(0, 2**20), max_size=30), st.integers(0, 9))
def test_frames_come_back_however_cut(count, cuts, seed):
    sent, data = some(count, seed)
    state, frames = fed(decode, LAYOUTS, data, cuts)
    assert [plain(f) for f in frames] == [(*f[:3], 32, f[3].tobytes(), True, False) for f in sent]
    assert state.counts == DecoderCounts(good=count)


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("dtype", ["f4", "i2"])
def test_all_kinds_of_frame(bits, dtype):
    values = np.array([1, -2, 3, 0, 250], dtype)
    _, (frame,) = decode(LAYOUTS, DecoderState(), encode_frame(1, 2**32 - 1, 2**bits - 1, values, bits))
    assert (frame.seq, frame.ticks, frame.bits) == (2**32 - 1, 2**bits - 1, bits)
    assert frame.values.dtype == dtype
    np.testing.assert_array_equal(frame.values, values)


@settings(max_examples=200)
@given(st.integers(2, 30), st.data())
def test_damage_costs_only_the_frames_it_touches(count, data):
    sent, raw = some(count)
    at = data.draw(st.integers(0, len(raw) - 1))
    new = data.draw(st.integers(0, 255).filter(lambda b: b != raw[at]))
    cuts = data.draw(st.lists(st.integers(0, len(raw)), max_size=5))
    _, frames = fed(decode, LAYOUTS, raw[:at] + bytes([new]) + raw[at + 1 :], cuts)
    keys = [f[:3] for f in sent]
    assert {f[:3] for f in frames} <= set(keys)
    assert count - 2 <= len(frames) < count
    assert sum(f.resync for f in frames) <= 1


def test_joining_in_mid_frame_is_no_damage():
    _, data = some(10)
    state, frames = fed(decode, LAYOUTS, data[7:])
    assert (len(frames), state.counts.dropped) == (9, {})
    assert not any(f.resync for f in frames)


def test_what_is_dropped_is_counted_by_reason():
    good = encode_frame(1, 0, 0, np.zeros(5, "f4"))
    future = bytearray(b"\x20" + bytes(29))
    cases = {
        "framing": b"\x09abc\0",
        "checksum": good[:8] + bytes([good[8] ^ 1 or 2]) + good[9:],
        "version": cobs_encode(bytes(future) + crc16(bytes(future)).to_bytes(2, "little")) + b"\0",
        "length": encode_frame(1, 0, 0, np.zeros(4, "f4")),
        "range": encode_frame(1, 0, 0, np.array([0, 0, 0, 0, 1e9], "f4")),
        "overlong": b"a" * (MAX_FRAME_BYTES + 1) + b"\0",
    }
    for reason, data in cases.items():
        state, frames = fed(decode, LAYOUTS, good + data + good)
        assert state.counts.dropped == {reason: 1}
        assert [f.resync for f in frames] == [False, True]
    state, frames = fed(decode, LAYOUTS, good + encode_frame(9, 0, 0, np.zeros(500, "f4")) + good)
    assert (state.counts.other, state.counts.dropped, frames[1].resync) == (1, {}, False)


def test_missing_values_are_no_reason_to_drop_a_frame():
    values = np.array([np.nan, np.inf, -np.inf, 1, 2], "f4")
    _, (frame,) = decode(LAYOUTS, DecoderState(), encode_frame(1, 0, 0, values))
    np.testing.assert_array_equal(frame.values, values)


@pytest.mark.parametrize(
    ("decoder", "rest"), [(decode, b"\0" + encode_frame(1, 3, 4, np.zeros(2, "f4"))), (decode_lines, b"\n1,2\n1,2\n")]
)
def test_memory_is_bounded_whatever_is_sent(decoder, rest):
    state, piece = DecoderState(), b"7" * 4096
    for _ in range(100):
        state, frames = decoder(LINES, state, piece)
        assert len(state.tail) <= MAX_FRAME_BYTES
        assert not frames
    assert decoder(LINES, state, rest)[1]


def random_bytes(layouts, millions):
    rng, state, found = np.random.default_rng(3), DecoderState(), []
    for _ in range(4 * millions):
        state, frames = decode(layouts, state, rng.bytes(250_000))
        found += frames
    return state.counts, found


def test_random_bytes_make_no_frame():
    """One piece in 65,536 passes the CRC by chance; length, version and range refuse it."""
    counts, found = random_bytes(LAYOUTS, 2)
    assert not found
    assert sum(counts.dropped.values()) > 5000


@given(st.integers(1, 40), st.sampled_from(["f4", "i2"]), st.sampled_from([32, 64]), st.data())
def test_a_part_of_a_scan_comes_back_in_its_place(channels, dtype, bits, data):
    """Readings that were not asked for are missing, whatever part it is; the rest is as in the whole frame."""
    asked_for = np.array(data.draw(st.lists(st.booleans(), min_size=channels, max_size=channels)))
    values = np.arange(1, channels + 1).astype(dtype)
    packet = encode_frame(1, 7, 9, values, bits)
    rest, found, _ = parse_requests(b"", b"junk\0" + encode_read(1, asked_for) + b"begun")
    assert rest == b"begun"
    part = select_readings(packet, found[1])
    (frame,) = decode({1: Layout(1, channels)}, DecoderState(), part)[1]
    missing = np.nan if dtype == "f4" else np.iinfo("i2").min
    np.testing.assert_array_equal(frame.values, np.where(asked_for, values, missing).astype(dtype))
    assert (frame.seq, frame.ticks, frame.bits) == (7, 9, bits)
    if asked_for.sum() * values.itemsize + channels // 8 + 2 < values.nbytes:
        assert len(part) < len(packet)
    assert decode({1: Layout(1, channels + 8)}, DecoderState(joining=False), part)[0].counts.length == 1


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**64 - 1), st.integers(0, 255))
def test_a_ping_is_answered_with_what_it_held(sent, ticks, stream):
    _, _, ((number, echo),) = parse_requests(b"", b"junk\0" + encode_ping(stream, sent))
    assert (number, echo) == (stream, sent)
    start = DecoderState(joining=False)
    state, frames = decode({stream: Layout(stream, 1)}, start, encode_pong(number, echo, ticks))
    assert (state.pong, frames, state.counts.dropped) == (Pong(sent, ticks), [], {})
    other, _ = decode({(stream + 1) % 256: Layout((stream + 1) % 256, 1)}, start, encode_pong(number, echo, ticks))
    assert (other.pong, other.counts.other) == (None, 1)


def test_what_is_no_frame_is_not_cut():
    note = encode_note(1, {"simulated": True})
    for packet in (note, b"abc\0", b"\0", encode_frame(1, 0, 0, np.zeros(20, "f4"))):
        assert select_readings(packet, np.ones(8, bool)) == packet


def test_a_note_is_no_sample_and_is_kept():
    packets = encode_note(2, {"seed": 1}) + encode_frame(2, 0, 0, np.zeros(4, "f4")) + encode_note(1, {"other": 1})
    state, found = decode({2: Layout(2, 4)}, DecoderState(), packets)
    assert (json.loads(state.note), len(found)) == ({"seed": 1}, 1)
    assert (state.counts.good, state.counts.other, state.counts.dropped) == (1, 1, {})
    for text in (b"[1]", b"{", b"\xff", b"[" * 50_000):
        body = b"\x18\x02" + text
        bad = cobs_encode(body + crc16(body).to_bytes(2, "little")) + b"\0"
        after, _ = decode({2: Layout(2, 4)}, state, bad)
        assert (after.note, after.counts.framing) == (state.note, 1)
    with pytest.raises(WireError, match="keep below"):
        encode_note(1, {"scene": "x" * 70_000})


@pytest.mark.slow
def test_a_hundred_million_random_bytes_make_no_frame(hard):
    counts, found = random_bytes(LAYOUTS, 100)
    assert not found
    pieces, chance = sum(counts.dropped.values()), sum(counts.dropped.values()) - counts.framing - counts.checksum
    assert pieces > 250_000
    told = f"no frame; of {pieces:,} pieces {chance} fit the CRC by chance, refused by version, stream or length"
    hard("fault 8: random bytes", "1e8", beyond=told)


@pytest.mark.slow
def test_a_claim_of_four_gigabytes_takes_no_memory(hard):
    """As many bytes, all of one piece that never ends."""
    state, _ = decode(LINES, DecoderState(), encode_frame(1, 2, 3, np.zeros(2, "f4")))
    piece = b"\xff" * (1 << 20)
    tracemalloc.start()
    for _ in range(4096):
        state, _ = decode(LINES, state, piece)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20
    _, (frame,) = decode(LINES, state, b"\0" + encode_frame(1, 3, 4, np.zeros(2, "f4")))
    assert frame.resync
    told = f"dropped and counted, the next frame is read; {peak / 1e6:.1f} MB of memory"
    hard("fault 9: a frame of 4 GiB", "all of it sent", beyond=told)


def corrupted(count, rate, seed):
    """How many of `count` frames arrive unharmed and how many wrong, at a rate of wrong bytes."""
    rng, state = np.random.default_rng(seed), DecoderState()
    layouts, good, wrong = {1: Layout(1, 4, limit=1e3)}, 0, 0
    for start in range(0, count, 2000):
        values = rng.normal(size=(2000, 4)).astype("f4")
        raw = b"".join(encode_frame(1, start + i, start + i, row) for i, row in enumerate(values))
        data = np.frombuffer(raw, "u1").copy()
        at = rng.random(len(data)) < rate
        data[at] = rng.integers(0, 256, at.sum())
        state, frames = decode(layouts, state, data.tobytes())
        for frame in frames:
            number = frame.seq - start
            same = 0 <= number < 2000 and frame.ticks == frame.seq and (frame.values == values[number]).all()
            good, wrong = good + bool(same), wrong + (not same)
    return good, wrong, state.counts


def test_frames_with_wrong_bytes_are_not_accepted():
    good, wrong, counts = corrupted(20_000, 0.002, 0)
    assert wrong == 0
    assert 17_000 < good < 20_000
    assert sum(counts.dropped.values()) > 500


@pytest.mark.slow
def test_a_million_frames_with_wrong_bytes(hard):
    """Those that are accepted and wrong stay below the odds of the CRC, one in 65,536 of the damaged."""
    good, wrong, counts = corrupted(1_000_000, 0.002, 1)
    assert wrong <= 5
    assert 850_000 < good < 1_000_000
    assert sum(counts.dropped.values()) > 25_000
    told = f"{good:,} kept, {wrong} accepted by a chance of the CRC, the others counted as damaged"
    hard("fault 8: wrong bytes", "0.2 % of those of 1e6 frames", beyond=told)


@pytest.mark.parametrize("changes", [{"stream": 256}, {"channels": 0}, {"channels": 10**9}, {"scale": 0}, {"limit": 0}])
def test_layouts_must_be_sound(changes):
    with pytest.raises(WireError, match="layout"):
        replace(LAYOUTS[1], **changes)


@pytest.mark.parametrize("values", [np.zeros(3), np.zeros((2, 2), "f4"), np.zeros(0, "f4"), np.zeros(16_001, "i2")])
def test_what_cannot_be_sent_is_refused(values):
    with pytest.raises(WireError, match="frame"):
        encode_frame(1, 0, 0, values)


# --- lines of text -------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 10**6), max_size=8))
def test_lines_come_back_however_cut(cuts):
    text = b"half a line\n1.5,-2\n7;1;2\r\n 3 8\t1e1,nan\n\nhello\n1,2,3,4,5\n1,1e9\n9,9,"
    state, frames = fed(decode_lines, LINES, text, cuts)
    assert [(f.seq, f.ticks) for f in frames] == [(None, None), (None, 7), (3, 8)]
    np.testing.assert_array_equal([f.values for f in frames], [[1.5, -2], [1, 2], [10, np.nan]])
    assert not any(f.checked for f in frames)
    assert state.counts == DecoderCounts(good=3, framing=1, length=1, range=1)


def test_lines_of_several_streams_are_refused():
    with pytest.raises(WireError, match="one layout"):
        decode_lines(LAYOUTS, DecoderState(), b"1,2\n")


# --- order ---------------------------------------------------------------------------------------


def placed(numbers):
    order, out = SequenceState(), []
    for number in numbers:
        order, place, lost = place_frame(order, number % 2**32)
        out.append((place, lost))
    return out


def test_frames_are_placed_by_their_numbers():
    assert placed([5, 6, 6, 9, 7, 10]) == [
        (SequencePlace.NEXT, 0),
        (SequencePlace.NEXT, 0),
        (SequencePlace.REPEATED, 0),
        (SequencePlace.GAP, 2),
        (SequencePlace.LATE, 0),
        (SequencePlace.NEXT, 0),
    ]


def test_numbers_wrap():
    assert [p for p, _ in placed([-2, -1, 0, 1])] == [SequencePlace.NEXT] * 4


def test_a_restart_is_believed_once_two_frames_agree():
    assert placed([1000, 0, 1, 2]) == [
        (SequencePlace.NEXT, 0),
        (SequencePlace.SUSPECT, 0),
        (SequencePlace.RESTART, 1),
        (SequencePlace.NEXT, 0),
    ]
    assert [p for p, _ in placed([1000, 3_000_000_000, 1001])] == [
        SequencePlace.NEXT,
        SequencePlace.SUSPECT,
        SequencePlace.NEXT,
    ]


@pytest.mark.parametrize("numbers", [[7] * 4, [9, 8, 7, 6], [30, 31, 0, 1], [65534, 65535, 0, 1]])
def test_frames_that_a_device_took_later_are_new_whatever_their_numbers_say(numbers):
    order, places = SequenceState(), []
    for number in numbers:
        order, place, lost = place_frame(order, number, newer=True)
        places.append(place)
        assert lost == 0
    assert all(place.kept for place in places)
    assert SequencePlace.MISCOUNTED in places


@given(st.permutations(range(100, 100 + REORDER_WINDOW)), st.integers(0, 3))
def test_reordered_and_repeated_frames_are_kept_once_in_order(numbers, repeats):
    order, kept, lost = SequenceState(), [], 0
    for number in [n for n in [99, *numbers, 200] for _ in range(1 + repeats)]:
        order, place, missing = place_frame(order, number)
        kept += [number] * place.kept
        lost += missing
    assert kept == sorted(set(kept))
    assert len(kept) + lost == 102


# --- the reference for firmware writers ----------------------------------------------------------


@pytest.fixture(scope="module")
def reference(root):
    return (root / "docs" / "wire-format.md").read_text()


def test_the_example_is_what_is_sent_and_read(reference):
    raw, sent = (bytes.fromhex(re.search(rf"^{word} +(.*)$", reference, re.MULTILINE)[1]) for word in ("raw", "sent"))
    values = np.array([0, 1.5, -2, np.nan], "f4")
    assert encode_frame(2, 7, 1_000_000, values) == sent == cobs_encode(raw) + b"\0"
    _, (frame,) = decode({2: Layout(2, 4)}, DecoderState(), sent)
    assert (frame.stream, frame.seq, frame.ticks) == (2, 7, 1_000_000)
    np.testing.assert_array_equal(frame.values, values)


def output_of(code, folder):
    """What a program in C prints."""
    (folder / "f.c").write_text(code)
    subprocess.run(["cc", "-Wall", "-Werror", "-o", folder / "f", folder / "f.c"], check=True, timeout=60)
    return subprocess.run([folder / "f"], capture_output=True, check=True, timeout=60).stdout


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_part_of_a_scan_in_c_is_the_same(reference, tmp_path):
    _, code = re.findall(r"```c\n(.*?)```", reference, re.DOTALL)
    main = """
    #include <stdio.h>
    int main(void) {
        uint8_t which[] = {0xa5, 0x01}, out[100];
        float values[12];
        for (int i = 0; i < 12; i++) values[i] = (float)i;
        fwrite(out, 1, part(which, values, 12, out), stdout);
        return 0;
    }
    """
    sent = output_of("#include <stddef.h>\n#include <stdint.h>\n#include <string.h>\n" + code + main, tmp_path)
    readings = np.isin(np.arange(12), [0, 2, 5, 7, 8])
    ours = cobs_decode(select_readings(encode_frame(1, 0, 0, np.arange(12, dtype="f4")), readings)[:-1])
    assert ours[10:-2] == sent


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_program_in_c_sends_the_same(reference, tmp_path):
    code = re.search(r"```c\n(.*?)```", reference, re.DOTALL)[1]
    main = """
    #include <stdio.h>
    int main(void) {
        static float values[928];
        static uint8_t raw[4000], out[4100];
        for (int k = 0; k < 40; k++) {
            for (int i = 0; i < 928; i++) values[i] = (i % 37 < k) ? 0.0f : 1.0f / (float)(1 + i + k);
            uint32_t ticks = (uint32_t)k * 100000000u;
            fwrite(out, 1, frame(1, (uint32_t)k, ticks, values, (size_t)(928 - k), raw, out), stdout);
        }
        return 0;
    }
    """
    sent = output_of(code + main, tmp_path)
    index = np.arange(928)
    for k, packet in enumerate(sent.split(b"\0")[:-1]):
        values = np.where(index % 37 < k, 0, np.float32(1) / (1 + index + k).astype("f4")).astype("f4")
        _, (frame,) = decode({1: Layout(1, 928 - k)}, DecoderState(), packet + b"\0")
        assert (frame.seq, frame.ticks) == (k, k * 100_000_000 % 2**32)
        np.testing.assert_array_equal(frame.values, values[: 928 - k])
    assert k == 39
