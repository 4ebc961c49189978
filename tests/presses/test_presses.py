"""Presses on synthetic trapezoids whose times are known."""

import numpy as np
import pytest

from calib.presses.corrections import LowPass, PreOnly, TwoSided
from calib.presses.means import dominant_pad, hold_positions, press_means
from calib.presses.pooled import PooledPresses, PressData
from calib.presses.samples import press_samples
from calib.presses.streams import ArrayStream, PressError, index_ranges, resample
from calib.presses.timing.detection import DetectionLimits, find_presses, noise_level
from calib.presses.timing.onsets import crossing, onset_delays
from calib.presses.timing.times import PressTimes, reject
from calib.presses.timing.windows import WindowLengths, press_windows, reject_without_samples
from calib.session.units import SECOND
from tests.helpers import stand_in

RAMP, HOLD, RELEASE, REST = 1.0, 2.0, 1.0, 2.5


def clock(seconds, rate=200.0):
    return np.round(np.arange(round(seconds * rate)) / rate * SECOND).astype(np.int64)


def edges(n, first=1.5):
    """(n, 4) s: contact, hold, unloading, end."""
    start = first + np.arange(n) * (RAMP + HOLD + RELEASE + REST)
    return start[:, None] + np.cumsum([0.0, RAMP, HOLD, RELEASE])


def trapezoids(time, times, level):
    """Load with straight ramps; level may be one per press."""
    t = time / SECOND
    rows = [np.interp(t, e, [0, h, h, 0]) for e, h in zip(times, np.broadcast_to(level, len(times)), strict=True)]
    return np.sum(rows, axis=0)


def timeline(times):
    columns = [np.round(c * SECOND).astype(np.int64) for c in times.T]
    n = len(times)
    return PressTimes(*columns, np.full(n, np.nan), np.ones(n, bool), ("",) * n)


@pytest.mark.parametrize(("noise", "drift"), [(0.0, 0.0), (0.02, 0.0), (0.05, 0.05), (0.05, -0.05)])
def test_finds_every_trapezoid_under_noise_and_drift(noise, drift):
    times, levels = edges(7), np.array([20, 5, 10, 20, 3, 15, 20.0])
    time = clock(48.0)
    force = trapezoids(time, times, levels) + drift * time / SECOND + 1.3
    force += noise * np.random.default_rng(0).normal(size=len(time))
    found = find_presses(time, force)
    assert len(found) == 7
    assert found.accepted.all()
    got = np.stack([found.t_press, found.t_hold0, found.t_hold1, found.t_release], 1) / SECOND
    # the threshold is 1 N, and 3 N take a second
    np.testing.assert_allclose(got, times, atol=0.25)
    np.testing.assert_allclose(got[levels >= 10], times[levels >= 10], atol=0.09)
    np.testing.assert_allclose(found.level, levels, atol=0.3)  # less than the drift of a press


def test_spikes_and_missing_samples_are_no_presses():
    time = clock(22.0)
    force = trapezoids(time, edges(3), 20.0) + 0.02 * np.random.default_rng(1).normal(size=len(time))
    force[[50, 1200, 2500]] = 500.0
    force[600:620] = np.nan
    found = find_presses(time, force)
    assert len(found) == 3
    assert found.accepted.all()


def test_damaged_presses_are_kept_with_a_reason():
    time, times = clock(44.0), edges(7)
    force = trapezoids(time, times, 20.0) + 0.02 * np.random.default_rng(2).normal(size=len(time))
    t = time / SECOND
    force[(t > times[1, 1] + 0.3) & (t < times[1, 3])] = 0.0  # let go after 0.3 s
    force[(t > times[2, 0]) & (t < times[2, 2])] = np.nan
    middle = (t > times[3, 1]) & (t < times[3, 2])
    force[middle] += 6 * np.sin(2 * np.pi * t[middle])
    force[(t > times[5, 0]) & (t < times[5, 3])] = 0.0
    force[(t > times[5, 0]) & (t < times[5, 0] + 0.12)] = 10.0  # a knock
    found = find_presses(time, force, limits=DetectionLimits(min_duration=0.2))
    assert found.accepted.tolist() == [True, False, False, False, True, False, False]
    said = ("", "held for", "missing", "unsteady", "", "knock", "record ends before the release")
    for reason, text in zip(found.reason, said, strict=True):
        assert text in reason
        assert bool(reason) == bool(text)
    cut = find_presses(time[500:], force[500:])
    assert "begins under load" in cut.reason[0]


def test_noise_alone_has_no_press_and_nothing_is_refused():
    noise = np.random.default_rng(3).normal(size=4000)
    assert len(find_presses(clock(20.0), noise)) == 0
    assert len(find_presses(clock(20.0), np.full(4000, 2.0))) == 0
    with pytest.raises(PressError, match="finite"):
        find_presses(clock(20.0), np.full(4000, np.nan))
    with pytest.raises(PressError, match="time stamps"):
        find_presses(clock(20.0), np.zeros((4000, 3)))


def test_noise_level_is_the_standard_deviation_of_white_noise_on_ramps():
    time = clock(60.0)
    signal = trapezoids(time, edges(8), 20.0)
    noisy = signal + 0.3 * np.random.default_rng(4).normal(size=len(time))
    assert noise_level(noisy) == pytest.approx(0.3, rel=0.03)


def test_windows_are_where_they_should_be_and_never_in_a_neighbour():
    presses = timeline(edges(3))
    w = press_windows(presses, WindowLengths(hold=1.0, rest=0.5, recovery=1.5, guard=0.05))
    first = {name: getattr(w, name)[0] / SECOND for name in ("rest_before", "ramp", "hold", "rest_after")}
    np.testing.assert_allclose(first["rest_before"], [0.95, 1.45])
    np.testing.assert_allclose(first["ramp"], [1.5, 2.5])
    np.testing.assert_allclose(first["hold"], [3.45, 4.45])
    np.testing.assert_allclose(first["rest_after"], [6.5, 7.0])
    crowded = press_windows(presses, WindowLengths(rest=9.0, recovery=9.0))
    assert (crowded.rest_before[1:, 0] >= presses.t_release[:-1]).all()
    assert (crowded.rest_after[:-1, 1] <= presses.t_press[1:]).all()
    assert (crowded.rest_after[:, 0] >= presses.t_release).all()
    np.testing.assert_allclose(w.centre("hold")[0] / SECOND, 3.95)


def test_index_ranges_are_half_open():
    time = np.arange(10) * 100
    np.testing.assert_array_equal(index_ranges(time, np.array([[100, 300], [150, 151]])), [[1, 3], [2, 2]])


def test_means_are_exact_on_drifting_streams():
    times = edges(4)
    time, presses = clock(30.0), timeline(times)
    shape = trapezoids(time, times, [20, 10, 5, 15])
    gains, drift = np.array([3.0, -2.0]), np.array([0.4, 7.0])
    stream = ArrayStream("pressure", time, shape[:, None] * gains + drift * time[:, None] / SECOND + 5)
    windows = press_windows(presses)
    means = press_means(stream, windows)
    expected = np.array([20, 10, 5, 15.0])[:, None] * gains
    np.testing.assert_allclose(means.change.mean, expected, atol=0.03)
    one = press_means(stream, windows, baseline=PreOnly()).change.mean
    wait = (windows.centre("hold") - windows.centre("rest_before"))[:, None] / SECOND
    np.testing.assert_allclose(one, expected + drift * wait, atol=1e-2)
    smooth = press_means(stream, windows, corrections=[LowPass(50.0)])
    np.testing.assert_allclose(smooth.change.mean, means.change.mean, atol=1e-6)
    assert (means.change.count == 200).all()


def test_a_missing_channel_or_window_is_nan_there_and_nowhere_else():
    times = edges(3)
    time, presses = clock(24.0), timeline(times)
    values = np.repeat(trapezoids(time, times, 10.0)[:, None], 3, axis=1)
    values[:, 1] = np.nan
    windows = press_windows(presses)
    a, b = index_ranges(time, windows.rest_after)[1]
    values[a:b, 2] = np.nan
    means = press_means(ArrayStream("eit", time, values), windows)
    assert means.missing().tolist() == [0, 3, 1]
    assert np.isnan(means.change.mean[1, 2])
    np.testing.assert_allclose(means.change.mean[:, 0], 10.0, rtol=1e-6)
    only = press_means(ArrayStream("eit", time, values), windows, baseline=PreOnly())
    assert only.missing().tolist() == [0, 3, 0]
    none = press_means(ArrayStream("eit", time, values), press_windows(timeline(edges(0))))
    assert none.change.mean.shape == (0, 3)


def test_standard_errors_cover_the_truth():
    times = edges(60)
    time, presses = clock(400.0, 100.0), timeline(times)
    truth = trapezoids(time, times, 10.0)[:, None]
    noisy = truth + np.random.default_rng(5).normal(size=(len(time), 8))
    change = press_means(ArrayStream("eit", time, noisy), press_windows(presses)).change
    pulls = (change.mean - 10.0) / change.standard_error
    assert abs(pulls.mean()) < 4 / np.sqrt(pulls.size)
    assert 0.9 < pulls.std() < 1.25


def test_press_without_frames_is_rejected_by_name():
    times = edges(3)
    time, presses = clock(24.0), timeline(times)
    windows = press_windows(presses)
    kept = (time < windows.hold[1, 0]) | (time >= windows.hold[1, 1])
    kept &= time < windows.rest_after[2, 0]
    eit = ArrayStream("eit", time[kept], np.zeros((kept.sum(), 2)))
    checked = reject_without_samples(presses, windows, [eit])
    assert checked.accepted.tolist() == [True, False, False]
    low, high = windows.hold[1] / SECOND
    assert checked.reason[1] == f"no EIT frame between {low:.3f} s and {high:.3f} s"
    assert reject_without_samples(presses, windows, [eit], PreOnly()).accepted.tolist() == [True, False, True]
    assert reject(checked, ["x", "y", ""]).reason[:2] == ("x", checked.reason[1])


def test_samples_pair_streams_of_different_rates_on_the_force_clock():
    times = edges(3)
    presses, windows = timeline(times), press_windows(timeline(times))
    tf, tp = clock(24.0, 80.0), clock(24.0, 200.0) + 1234567
    force = ArrayStream("force", tf, trapezoids(tf, times, 20.0)[:, None] + 0.7)
    p = trapezoids(tp, times, 20.0)[:, None] * [150.0, 50.0] + 3.0 * tp[:, None] / SECOND
    p[(tp > windows.hold[2, 0]) & (tp < windows.hold[2, 0] + SECOND // 5), 1] = np.nan
    presses = reject(presses, ["", "no", ""])
    out = press_samples(force, ArrayStream("pressure", tp, p), presses, windows)
    assert set(out.press) == {0, 2}
    assert np.isin(out.time, tf).all()
    np.testing.assert_allclose(out.pressure[:, 0], 150.0 * out.force, atol=8.0)
    hole = np.isnan(out.pressure[:, 1])
    assert 14 <= hole.sum() <= 18
    assert set(out.press[hole]) == {2}
    assert set(out.phase[hole]) == {1}
    assert [np.sum(out.phase[out.press == 0] == k) for k in range(3)] == pytest.approx([80, 160, 80], abs=1)
    nothing = press_samples(force, ArrayStream("pressure", tp, p), reject(presses, ["a"] * 3), windows)
    assert nothing.pressure.shape == (0, 2)


def test_resample_interpolates_but_not_across_gaps():
    time = np.arange(0, 1000, 10)
    values = np.stack([2.0 * time, 2.0 * time], 1)
    values[40:50, 1] = np.nan
    out = resample(time, values, np.array([-5, 15, 445, 985, 995]))
    np.testing.assert_allclose(out[:, 0], [np.nan, 30, 890, 1970, np.nan])
    np.testing.assert_allclose(out[:, 1], [np.nan, 30, np.nan, 1970, np.nan])


def test_onset_delay_of_a_late_stream_is_found():
    times = edges(6)
    time, presses = clock(44.0, 400.0), timeline(times)
    rng = np.random.default_rng(6)
    force = trapezoids(time, times, 20.0)[:, None] + 0.02 * rng.normal(size=(len(time), 1))
    late = trapezoids(time - 30_000_000, times, 1.0)[:, None] * rng.normal(size=20)
    late += 0.002 * rng.normal(size=late.shape)
    streams = [ArrayStream("eit", time, late), ArrayStream("same", time, force)]
    onsets = onset_delays(ArrayStream("force", time, force), streams, presses, press_windows(presses))
    assert onsets["eit"].delay == pytest.approx(0.030, abs=0.003)
    assert onsets["same"].delay == 0.0
    assert onsets["eit"].presses == 6
    assert onsets["eit"].spread < 0.005
    assert onsets["eit"].shift == pytest.approx(0.030, abs=0.005)


def test_a_stream_of_noise_has_no_delay_and_warns_of_nothing():
    """Windows that follow noise come to where there is no sample."""
    times = edges(3)
    time, presses = clock(24.0), timeline(times)
    force = ArrayStream("force", time, trapezoids(time, times, 5.0)[:, None])
    few = ArrayStream("pressure", time[::1000], np.random.default_rng(0).normal(size=(5, 1)))
    found = onset_delays(force, [few], presses, press_windows(presses))["pressure"]
    assert found.presses == 0
    assert np.isnan(found.delay)


def test_a_curved_response_is_delayed_but_not_shifted():
    """What follows the square of the force rises late at its half, but begins and ends its rise with the force."""
    times = edges(6)
    time, presses = clock(200.0, 400.0), timeline(times)
    force = trapezoids(time, times, 20.0)[:, None]
    squared = ArrayStream("pressure", time, force**2)
    found = onset_delays(ArrayStream("force", time, force), [squared], presses, press_windows(presses))["pressure"]
    ramp = float(np.median(presses.t_hold0 - presses.t_press)) / 1e9
    assert found.delay == pytest.approx((np.sqrt(0.5) - 0.5) * ramp, abs=0.01)
    assert found.shift == pytest.approx((np.sqrt(0.8) - 0.8) * ramp, abs=0.01)


def test_crossing_is_interpolated_and_final():
    assert crossing(np.array([0, 10, 20, 30]), np.array([0.0, 3.0, 1.0, 5.0]), 2.0) == 22.5
    assert np.isnan(crossing(np.array([0, 10]), np.array([0.0, 1.0]), 2.0))


def test_dominant_pad_and_position():
    pressure = np.array([[100.0, 1.0], [60.0, 40.0], [-5.0, 30.0], [0.0, 0.0], [np.nan, 50.0]])
    assert dominant_pad(pressure).tolist() == [0, -1, 1, -1, 1]
    times = edges(2)
    time = clock(14.0, 50.0)
    xyz = np.where(time[:, None] < 8 * SECOND, [0.03, 0.05, 0.0], [0.1, 0.2, 0.0])
    stage = ArrayStream("stage", time, xyz)
    np.testing.assert_allclose(hold_positions(timeline(times), stage), [[0.03, 0.05, 0.0], [0.1, 0.2, 0.0]])
    assert hold_positions(timeline(times[:0]), stage).shape == (0, 3)
    assert TwoSided().weights(0.5, 0.0, 1.0) == (0.5, 0.5)


def test_noise_at_rest_is_zero_where_no_rest_tells_it(monkeypatch):
    """Of slow streams, no rest holds two samples; a pad may never hold a finite one."""
    pooled = stand_in(PooledPresses, recordings=(None,), data=stand_in(PressData, pressure=np.zeros((5, 2))))
    rests = [np.empty((0, 2))]
    monkeypatch.setattr("calib.presses.pooled._rest_residuals", lambda recording, name: rests)
    np.testing.assert_array_equal(pooled.sensor_noise, [0.0, 0.0])
    rests += [size * np.array([[1.0, np.nan], [-1.0, np.nan]]) for size in (2.0, 3.0, 9.0)]
    np.testing.assert_allclose(pooled.sensor_noise, [3.0, 0.0])
