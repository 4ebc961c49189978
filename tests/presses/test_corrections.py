"""Low-pass and baselines against the formulas they are named after."""

import numpy as np
import pytest
from scipy import signal

from calib.presses.corrections import (
    CorrectionError,
    LowPass,
    PreOnly,
    TwoSided,
    WindowMeans,
    correct,
    interpolate_missing,
    window_means,
)
from calib.presses.table import Processing

RATE = 182.0


def clock(n, rate=RATE):
    return np.round(np.arange(n) / rate * 1e9).astype(np.int64)


def gain(filter_, frequency, rate=RATE):
    """Amplitude after over before of a sine, away from the ends."""
    time = clock(4000, rate)
    wave = np.exp(2j * np.pi * frequency * time / 1e9)
    out = filter_.apply(time, np.stack([wave.real, wave.imag], 1))[1000:3000]
    return np.abs(out[:, 0] + 1j * out[:, 1]).mean()


@pytest.mark.parametrize("cutoff", [20.0, 50.0])
def test_zero_phase_halves_at_the_cutoff_and_causal_loses_3_db(cutoff):
    assert gain(LowPass(cutoff), cutoff) == pytest.approx(0.5, abs=2e-3)
    assert gain(LowPass(cutoff, causal=True), cutoff) == pytest.approx(np.sqrt(0.5), abs=2e-3)
    assert gain(LowPass(cutoff), 1.0) == pytest.approx(1.0, abs=1e-3)


def test_zero_phase_has_no_delay_and_causal_has_one():
    time = clock(2000)
    pulse = np.exp(-(((time / 1e9 - 5.0) / 0.05) ** 2))[:, None]
    peak = [np.argmax(f.apply(time, pulse)) for f in (LowPass(20.0), LowPass(20.0, causal=True))]
    assert peak[0] == np.argmax(pulse)
    assert peak[1] > peak[0]


def test_causal_starts_at_rest_and_sees_no_future():
    values = np.random.default_rng(0).normal(size=(400, 1)) + 7.0
    time = clock(400)
    low = LowPass(20.0, causal=True)
    np.testing.assert_allclose(low.apply(time, np.full((400, 1), 7.0)), 7.0, rtol=1e-12)
    np.testing.assert_array_equal(low.apply(time[:200], values[:200]), low.apply(time, values)[:200])


def test_the_papers_filter_on_a_100_hz_stream_is_refused_with_a_remedy():
    with pytest.raises(CorrectionError, match=r"eit: .*50 Hz.*100 Hz.*cutoff below 50 Hz"):
        LowPass(50.0).apply(clock(500, 100.0), np.zeros((500, 2)), "eit")
    with pytest.raises(CorrectionError, match="cutoff is -1; give more than 0"):
        LowPass(-1.0)


@pytest.mark.parametrize("causal", [False, True])
def test_missing_samples_do_not_spread(causal):
    time = clock(1000)
    wave = np.sin(2 * np.pi * 1.0 * time / 1e9)
    holes = np.stack([wave, wave, np.full(1000, np.nan)], 1)
    holes[300:303, 1] = np.nan
    holes[0, 1] = np.inf
    low = LowPass(20.0, causal=causal)
    out = low.apply(time, holes)
    assert np.isfinite(out[:, 0]).all()
    assert np.flatnonzero(np.isnan(out[:, 1])).tolist() == [0, 300, 301, 302]
    assert np.isnan(out[:, 2]).all()
    np.testing.assert_array_equal(out[:, 0], low.apply(time, holes[:, :1])[:, 0])
    # the causal filter starts from the second sample, which the wave's slope puts 0.035 higher
    assert np.nanmax(np.abs(out[:, 0] - out[:, 1])) < 0.04


def test_a_gap_in_time_is_not_filtered_across():
    time = clock(400)
    time[200:] += 10**10
    step = np.repeat([0.0, 1.0], 200)[:, None]
    np.testing.assert_allclose(LowPass(20.0).apply(time, step), step, atol=1e-12)


def test_corrections_fold_in_order_and_leave_the_input_alone():
    time, values = clock(500), np.random.default_rng(1).normal(size=(500, 2))
    before = values.copy()
    out = correct([LowPass(20.0), LowPass(40.0)], time, values)
    np.testing.assert_array_equal(out, LowPass(40.0).apply(time, LowPass(20.0).apply(time, values)))
    np.testing.assert_array_equal(values, before)


def test_bridge_interpolates_and_holds_the_ends():
    column = np.array([np.nan, 1.0, np.nan, np.nan, 4.0, np.nan])
    np.testing.assert_allclose(interpolate_missing(column), [1, 1, 2, 3, 4, 4])


def test_baselines_are_exact_on_a_drift_and_on_a_constant():
    def estimate(x, se):
        return WindowMeans(np.array([[x]]), np.array([[se]]), np.array([[9]]))

    times = tuple(np.array([t]) for t in (4.0, 0.0, 10.0))  # hold, before, after
    line = [estimate(2 + 0.3 * t + extra, se) for t, extra, se in ((4, 7, 0.3), (0, 0, 0.1), (10, 0, 0.2))]
    two, pre = TwoSided().remove(*line, times), PreOnly().remove(*line, times)
    assert two.mean[0, 0] == pytest.approx(7.0, rel=1e-14)
    assert pre.mean[0, 0] == pytest.approx(7.0 + 0.3 * 4, rel=1e-14)
    assert two.standard_error[0, 0] == pytest.approx(np.sqrt(0.09 + 0.36 * 0.01 + 0.16 * 0.04))
    assert pre.standard_error[0, 0] == pytest.approx(np.sqrt(0.09 + 0.01))
    gone = estimate(np.nan, np.nan)
    assert np.isnan(TwoSided().remove(line[0], line[1], gone, times).mean).all()
    assert np.isfinite(PreOnly().remove(line[0], line[1], gone, times).mean).all()


def test_window_means_counts_and_reports_a_dead_channel():
    values = np.arange(24.0).reshape(12, 2)
    values[3, 0] = np.nan
    values[:, 1] = np.nan
    out = window_means(values, np.array([[0, 6], [6, 12], [12, 12]]))
    np.testing.assert_allclose(out.mean[:, 0], [np.mean([0, 2, 4, 8, 10]), 17.0, np.nan])
    np.testing.assert_array_equal(out.count, [[5, 0], [6, 0], [0, 0]])
    assert np.isnan(out.mean[:, 1]).all()
    assert np.isnan(out.standard_error[:, 1]).all()


@pytest.mark.parametrize("smooth", [False, True])
def test_standard_error_of_a_window_is_honest_for_white_and_filtered_noise(smooth):
    noise = np.random.default_rng(2).normal(size=(200, 600))
    if smooth:
        noise = signal.sosfiltfilt(signal.butter(2, 0.4, output="sos"), noise, axis=0)
    out = window_means(noise, np.array([[0, 200]]))
    pulls = out.mean[0] / out.standard_error[0]
    # Student's t with 7 degrees of freedom has variance 7/5
    assert np.var(pulls) == pytest.approx(7 / 5, rel=0.25)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"corrections": 50.0}, r"corrections: float is not a tuple; give a tuple of corrections, such as \(calib"),
        ({"corrections": (50.0,)}, "corrections: float is not a correction"),
        ({"baseline": "pre"}, "baseline: 'pre' is not a baseline; give one, such as calib.presses.TwoSided"),
        ({"windows": 1.0}, r"windows: float is not lengths of windows; give calib.presses.WindowLengths\(\)"),
    ],
)
def test_how_presses_are_processed_is_told_by_objects(wrong, said):
    with pytest.raises(CorrectionError, match=said):
        Processing(**wrong)
