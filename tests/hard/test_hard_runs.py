"""Runs of a day: what a rounding error or a byte per step would add up to."""

import tracemalloc

import numpy as np
import pytest
from scipy import signal

from calib.presses.corrections import LowPass, TwoSided, window_means

RATE, DAY = 182.0, 86_400.0


# --- filters ----------------------------------------------------------------------------------------------------------


def day(hours, seed=0):
    """Times (ns) and a pad's pressure: an offset of an atmosphere, slow weather, breathing, and noise."""
    time = np.round(np.arange(int(hours * 3600 * RATE)) / RATE * 1e9).astype(np.int64)
    t = time / 1e9
    noise = np.random.default_rng(seed).normal(0, 2.0, len(t))
    return time, 101_325 + 300 * np.sin(2 * np.pi * t / DAY) + 50 * np.sin(2 * np.pi * 0.25 * t) + noise


def low_passed(hours, hard):
    time, values = day(hours)
    low = LowPass(0.5, order=8, causal=True)
    sections = low.sections(1e9 / float(np.median(np.diff(time))))
    wide = values.astype(np.longdouble)
    start = signal.sosfilt_zi(sections) * values[0]
    exact = signal.sosfilt(sections.astype(np.longdouble), wide, zi=start.astype(np.longdouble))[0]
    errors = {}
    for dtype in (np.float64, np.float32):
        out = low.apply(time, values.astype(dtype)[:, None])[:, 0]
        errors[dtype] = float(np.abs(out - exact).max() / values.max())
    assert errors[np.float64] < 1e-10
    assert errors[np.float32] < 1e-6  # of the samples' own rounding, which averages out
    b, a = signal.butter(8, 0.5, fs=RATE)
    with np.errstate(all="ignore"):
        direct = signal.lfilter(b, a, values, zi=signal.lfilter_zi(b, a) * values[0])[0]
    naive = float(np.abs(direct - exact).max() / values.max())
    assert not naive < 1e-3
    hard(
        "causal low-pass over long runs",
        f"{hours:g} h at 182 Hz, order 8 at 0.5 Hz, on an offset of 1e5 Pa",
        float64=errors[np.float64],
        float32=errors[np.float32],
        naive=naive,
        beyond="second-order sections in double precision, whatever the samples are stored in",
    )


def test_the_low_pass_of_half_an_hour(hard):
    low_passed(0.5, hard)


@pytest.mark.slow
def test_the_low_pass_of_a_day(hard):
    low_passed(24, hard)


@pytest.mark.parametrize("hours", [0.5, pytest.param(24, marks=pytest.mark.slow)])
def test_means_and_baselines_of_a_day(hours, hard):
    time, values = day(hours)
    exact = values.astype(np.longdouble).mean()
    errors = {}
    for dtype in (np.float64, np.float32):
        found = window_means(values.astype(dtype)[:, None], np.array([[0, len(values)]]))
        errors[dtype] = float(abs(found.mean[0, 0] - exact) / exact)
    assert errors[np.float64] < 1e-13
    assert errors[np.float32] < 1e-6
    naive = float(abs(np.cumsum(values.astype(np.float32), dtype=np.float32)[-1] / len(values) - exact) / exact)
    assert naive > 1e-4
    at = time[[len(time) // 2]].astype(float)
    w0, w1 = TwoSided().weights(at, time[:1].astype(float), time[-1:].astype(float))
    assert w0 + w1 == 1
    assert float(w1[0]) == pytest.approx((int(at[0]) - int(time[0])) / (int(time[-1]) - int(time[0])), rel=1e-15)
    hard(
        "means over long runs",
        f"{hours:g} h at 182 Hz, on an offset of 1e5 Pa",
        float64=errors[np.float64],
        float32=errors[np.float32],
        naive=naive,
        beyond="a mean with its standard error from blocks",
    )


def test_memory_does_not_grow_with_the_number_of_blocks():
    """A recording is filtered block by block: the twentieth takes what the second took."""
    low, peaks = LowPass(20.0, causal=True), []
    time, values = day(0.02)
    low.apply(time, values[:, None])
    tracemalloc.start()
    try:
        for _ in range(20):
            tracemalloc.reset_peak()
            low.apply(time, values[:, None])
            peaks.append(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()
    assert max(peaks[2:]) < 1.1 * peaks[1]
    assert peaks[1] < 20 * values.nbytes
