"""Device time to host time, against truth."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial import ConvexHull

from calib.record.clock import MAX_SEGMENTS, NO_LATENCY, DeviceClock, lower_hull, smallest_latency

MS, S = 1_000_000, 1_000_000_000
FLOOR = 200_000  # ns, the smallest latency of all cases below: what no method can see


@dataclass
class Case:
    """A device that takes frames at true host times, and when they arrive."""

    true: np.ndarray
    ticks: np.ndarray
    host: np.ndarray
    bits: int = 32

    def __len__(self):
        return len(self.true)


def case(rate=100, seconds=60, skew=50e-6, jitter=16 * MS, batch=0, drift=0.0, bits=32, start=1_000_000, seed=0):
    """Frames at `rate`; the device's clock of microseconds is slow by `skew`, which grows by `drift` per s."""
    rng = np.random.default_rng(seed)
    true = np.arange(int(rate * seconds)) * (S / rate)
    device = true * (1 - skew) - 0.5 * drift * true**2 / S
    late = FLOOR + rng.uniform(0, jitter, len(true)) if jitter else np.full(len(true), float(FLOOR))
    host = np.maximum.accumulate(true + late)
    if batch:
        host = FLOOR + np.ceil(true / batch) * batch
    ticks = np.rint(device / 1000).astype("u8") + np.uint64(start)
    return Case(true, ticks & np.uint64(2**bits - 1), np.rint(host).astype(np.int64) + 5 * S, bits)


def follow(case, size=64, restarted=(), rejoined=()):
    """Feed a case in pieces; the clock, unwrapped ticks, steps, and the time stated online."""
    clock, parts = DeviceClock(1e-6), []
    marks = [np.isin(np.arange(len(case)), at) for at in (rejoined, restarted)]
    for i in range(0, len(case), size):
        part = slice(i, i + size)
        found = clock.extend(case.ticks[part], case.bits, case.host[part], *(m[part] for m in marks))
        parts.append((*found, clock.host_ns(found[0])))
    return clock, *(np.concatenate(p) for p in zip(*parts, strict=True))


def aligned(clock, unwrapped, steps):
    """Host time of every frame by the fitted clock."""
    edges = [0, *np.flatnonzero(steps), len(unwrapped)]
    segments = clock.fit().segments
    assert len(segments) == len(edges) - 1
    return np.concatenate([s.host_ns(unwrapped[a:b]) for s, a, b in zip(segments, edges[:-1], edges[1:], strict=True)])


def error(case, host):
    """Of times against truth without the smallest latency, which no method can see, ns."""
    return np.abs(host - 5 * S - FLOOR - case.true)


CASES = {
    "jitter": ({}, 0.15 * MS),
    "jitter, ten minutes": ({"seconds": 600}, 0.1 * MS),
    "batches": ({"batch": 16 * MS, "rate": 130, "seconds": 600, "skew": 200e-6}, 0.5 * MS),
    "a drifting rate": ({"seconds": 600, "skew": 200e-6, "drift": 1e-7}, 0.2 * MS),
    "a poor oscillator": ({"skew": -0.02}, 0.2 * MS),
    "no jitter": ({"jitter": 0}, 3_000),
    "two seconds": ({"seconds": 2}, 0.5 * MS),
    "slow": ({"rate": 10}, 0.8 * MS),
    "a wrap": ({"start": 2**32 - 20_000_000}, 0.15 * MS),
    "64 bits": ({"start": 2**64 - 20_000_000, "bits": 64}, 0.15 * MS),
}


FAULTS = {"batches": "frames held back in batches", "jitter": "jitter of arrival", "a wrap": "counter of 32 bits wraps"}
SEVERITY = {
    "batches": "batches of 16 ms, clock off by 200 ppm, ten minutes",
    "jitter": "16 ms, clock off by 50 ppm, one minute",
    "a wrap": "16 ms of jitter, clock off by 50 ppm",
}


@pytest.mark.parametrize("name", CASES)
def test_times_agree_with_truth(name, hard):
    changes, bound = CASES[name]
    known = case(**changes)
    clock, unwrapped, steps, online = follow(known)
    assert not steps.any()
    assert (np.diff(unwrapped) > 0).all()
    host = aligned(clock, unwrapped, steps)
    p95 = np.quantile(error(known, host), 0.95)
    assert p95 < bound
    assert error(known, host).max() < 2 * MS
    assert np.quantile(error(known, online)[-len(known) // 2 :], 0.95) < 2 * MS
    found = clock.fit()
    assert found.valid
    assert found.tick_s == pytest.approx(1e-6, rel=0.03)
    if known.true[-1] > 30 * S and "drift" not in changes:
        assert found.skew == pytest.approx(changes.get("skew", 50e-6) / (1 - changes.get("skew", 50e-6)), abs=2e-5)
    if name in FAULTS:
        hard(f"fault 11: {FAULTS[name]}", SEVERITY[name], beyond=f"aligned to {p95 / 1000:.2g} µs (95 %)")


def test_least_squares_would_not_do():
    """What the hull is for: the mean delay wanders with the load of the host, the smallest does not."""
    known = case(seconds=60)
    hiccups = np.random.default_rng(1).random(len(known)) < 0.1
    known.host[len(known) // 2 :] += np.where(hiccups, 30 * MS, 0)[len(known) // 2 :]
    known.host = np.maximum.accumulate(known.host)
    clock, unwrapped, steps, _ = follow(known)
    assert error(known, aligned(clock, unwrapped, steps)).max() < 2 * MS
    line = np.polyval(np.polyfit(known.true, known.host - 5 * S - FLOOR, 1), known.true)
    assert np.abs(line - known.true).max() > 5 * MS


@given(st.lists(st.integers(0, 30), min_size=1, max_size=40), st.integers(0, 2**32 - 1))
def test_the_hull_is_that_of_qhull(x, seed):
    x = np.sort(np.array(x, float))
    y = np.random.default_rng(seed).integers(-9, 10, len(x)).astype(float)
    got = lower_hull(x, y)
    assert (np.interp(x, *got) <= y).all()
    if np.ptp(x) > 0 and np.ptp(y) > 0 and np.linalg.matrix_rank(np.stack([x - x[0], y - y[0]])) == 2:
        vertices = np.stack([x, y], 1)[ConvexHull(np.stack([x, y], 1)).vertices]
        assert {*zip(*got, strict=True)} <= {tuple(v) for v in vertices}


@settings(max_examples=5, deadline=None)
@given(st.integers(2, 700), st.integers(2, 700))
def test_how_frames_are_grouped_changes_nothing(one, other):
    known = case(rate=50, seconds=75)
    first, second = (follow(known, size) for size in (one, other))
    np.testing.assert_array_equal(first[1], second[1])
    np.testing.assert_array_equal(aligned(*first[:3]), aligned(*second[:3]))


def test_online_and_finished_times_agree():
    known = case(rate=50, seconds=240)
    clock, unwrapped, steps, online = follow(known, size=3)
    late = known.true > 60 * S
    assert np.quantile(np.abs(online - aligned(clock, unwrapped, steps))[late], 0.95) < 0.3 * MS


STEPS = {
    "an hour ahead": 3600 * S,
    "an hour back": -3600 * S,
    "a tenth of a second ahead": S // 10,
    "a second back": -S,
}


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("name", STEPS)
def test_a_step_of_the_clock_is_seen_and_its_times_are_right(name, bits, hard):
    known = case(seconds=120, bits=bits, start=2**33)
    half = len(known) // 2
    jump = np.array(STEPS[name] // 1000).astype("u8")  # modulo, as a counter
    known.ticks[half:] = (known.ticks[half:] + jump) & np.uint64(2**bits - 1)
    clock, unwrapped, steps, _ = follow(known)
    assert np.flatnonzero(steps).tolist() == [half]
    assert clock.steps == 1
    err = error(known, aligned(clock, unwrapped, steps))
    assert np.quantile(err, 0.95) < MS
    assert err.max() < 2 * MS
    told = "flagged, at the frame; aligned to 1 ms (95 %) before and after"
    hard("fault 11: the device's clock is set", ", ".join(STEPS), beyond=told)


def test_a_restart_with_short_segments_borrows_the_rate():
    known = case(seconds=60)
    at = [5500, 5600, 5900]
    for start in at:
        known.ticks[start:] = known.ticks[start:] - known.ticks[start]
    clock, unwrapped, steps, _ = follow(known, restarted=at)
    assert np.flatnonzero(steps).tolist() == at
    assert error(known, aligned(clock, unwrapped, steps)).max() < 2 * MS


def test_a_pause_of_hours_does_not_lose_count():
    """Four turns of the counter while unplugged."""
    known = case(rate=1, seconds=24_000, jitter=MS)
    keep = (known.true < 2000 * S) | (known.true > 20_000 * S)
    known = Case(known.true[keep], known.ticks[keep], known.host[keep])
    clock, unwrapped, steps, _ = follow(known, rejoined=[2000])
    assert not steps.any()
    assert error(known, aligned(clock, unwrapped, steps)).max() < 2 * MS


def test_a_device_that_restarted_while_unplugged_is_noticed():
    known = case(seconds=120)
    half = len(known) // 2
    known.host[half:] += 300 * S  # five minutes away, of which it ran ten milliseconds
    clock, _, steps, _ = follow(known, rejoined=[half])
    assert np.flatnonzero(steps).tolist() == [half]
    assert clock.steps == 1


def test_a_stalled_link_is_no_step():
    known = case(seconds=60)
    stall = (known.true > 20 * S) & (known.true < 25 * S)
    known.host[stall] = known.host[stall][-1]
    clock, unwrapped, steps, _ = follow(known)
    assert not steps.any()
    assert error(known, aligned(clock, unwrapped, steps)).max() < MS


@pytest.mark.parametrize("rate", [10, 100, 1000])
def test_frames_held_up_before_the_connection_are_no_steps(rate):
    """Seven seconds of them come at once, all late, and then the others as they are taken."""
    known = case(rate=rate, seconds=60, jitter=MS)
    known.host[known.true < 7 * S] = known.host[known.true < 7 * S][-1]
    clock, unwrapped, steps, _ = follow(known)
    assert not steps.any()
    assert error(known, aligned(clock, unwrapped, steps)).max() < 2 * MS
    assert clock.period == pytest.approx(S / rate, rel=1e-3)


@pytest.mark.parametrize("ratio", [1000, 1e-3, 0])
def test_ticks_of_another_length_are_found_out(ratio):
    known = case(seconds=20)
    known.ticks = (known.ticks * ratio).astype("u8")
    clock, *_ = follow(known)
    found = clock.fit()
    assert not found.valid
    assert clock.steps < MAX_SEGMENTS
    if ratio == 1e-3:
        assert found.tick_s == pytest.approx(1e-3, rel=0.05)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([32, 64]))
def test_nonsense_does_no_harm(seed, bits):
    rng = np.random.default_rng(seed)
    ticks = rng.integers(0, 2**64, 400, "u8") & np.uint64(2**bits - 1)
    known = Case(np.zeros(400), ticks, np.cumsum(rng.integers(0, S, 400)), bits)
    clock, unwrapped, steps, _ = follow(known)
    assert (unwrapped[np.flatnonzero(steps)] >= 0).all()
    assert not clock.fit().valid


def pings(case, late, count=50, seed=1):
    """Pings over a whole case, up to 5 ms on their way there, `late` to 5 ms back, and what is counted in between."""
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(len(case), count, replace=False))
    at = case.true[rows].astype(np.int64) + 5 * S
    sent, received = at - rng.integers(MS // 10, 5 * MS, count), at + late + rng.integers(0, 5 * MS, count)
    return sent, received, case.ticks[rows]


@pytest.mark.parametrize("name", ["jitter", "a wrap", "64 bits", "batches"])
def test_pings_tell_the_smallest_latency(name, hard):
    """Of 3 ms, beyond what no frame says; to half of the shortest round trip."""
    known = case(**CASES[name][0])
    known.host += 3 * MS - FLOOR
    clock, *_ = follow(known)
    found = smallest_latency(clock.fit(), known.bits, *pings(known, MS // 10))
    assert found.rtt < 3 * MS
    assert abs(found.ns - 3 * MS) < found.rtt / 2 + CASES[name][1]
    told = f"known to {abs(found.ns - 3 * MS) / MS:.1f} ms, stated uncertainty {found.rtt / 2 / MS:.1f} ms"
    if name == "jitter":
        hard("fault 11: latency of 3 ms of every frame", "pings of up to 10 ms", beyond=told)


def test_without_answers_that_fit_no_latency_is_taken_off():
    known = case()
    timeline = follow(known)[0].fit()
    sent, received, ticks = pings(known, MS)
    nothing = np.zeros(0, np.int64)
    assert smallest_latency(timeline, 32, nothing, nothing, nothing.astype("u8")) == NO_LATENCY
    assert (
        smallest_latency(timeline, 32, sent, received, ticks + np.uint64(100_000_000)) == NO_LATENCY
    )  # of another clock
    assert smallest_latency(timeline, 32, received, sent, ticks) == NO_LATENCY


@pytest.mark.parametrize("tick", [0, -1e-6, np.nan, 1e4])
def test_a_tick_must_have_a_length(tick):
    with pytest.raises(ValueError, match="tick"):
        DeviceClock(tick)
