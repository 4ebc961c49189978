"""Runs of a day: what a rounding error or a byte per step would add up to."""

import tracemalloc
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from calib.fitting.fields import geometry_of
from calib.fitting.recursive import Estimate, RecursiveLeastSquares, SensitivityTracker
from calib.presses.corrections import LowPass, TwoSided, window_means

from ..fitting.test_online import touches

MU = 0.999
TRUE = np.array([1.0, -2.0, 0.5])
RATE, DAY = 182.0, 86_400.0


# --- recursive least squares ------------------------------------------------------------------------------------------


def sample(i, dtype):
    """Features, target and use of update `i`, the same in every precision: exact multiples of 2^-10.

    Of a hundred thousand updates 30,000 excite all coefficients, 20,000 the first alone, and the rest are idle.
    """
    bits = [(i * jnp.uint32(c) + jnp.uint32(7 * c % 2**32)) ^ (i * jnp.uint32(d) >> jnp.uint32(13)) for c, d in _MIX]
    phi = jnp.stack([(b >> jnp.uint32(21)).astype(dtype) / 1024 - 1 for b in bits[:3]])
    noise = ((bits[3] >> jnp.uint32(21)).astype(dtype) / 1024 - 1) / 8
    phase = i % 100_000
    phi = jnp.where(phase < 30_000, phi, phi * jnp.array([1, 0, 0], dtype))
    return phi, phi @ jnp.asarray(TRUE, dtype) + noise, phase < 50_000


_MIX = [(2654435761, 40503), (2246822519, 3266489), (3266489917, 668265), (374761393, 1274126)]


@partial(jax.jit, static_argnums=(0, 1, 2))
def long_run(step, count, dtype):
    """The state after `count` updates, and the largest trace on the way."""

    def one(carry, i):
        state, largest = carry
        state = step(state, *sample(i, dtype))
        return (state, jnp.maximum(largest, jnp.trace(state.covariance))), None

    start = Estimate(jnp.zeros(3, dtype), jnp.eye(3, dtype=dtype))
    (state, largest), _ = jax.lax.scan(one, (start, jnp.zeros((), dtype)), jnp.arange(count, dtype=jnp.uint32))
    return state, largest


def ours(state, phi, target, use):
    return RecursiveLeastSquares(MU, 1.0).update(state, phi, target, use)


def textbook(state, phi, target, use):
    """Every update forgets, whatever it says, and nothing holds the covariance."""
    theta, p = state
    phi, target = jnp.where(use, phi, 0), jnp.where(use, target, 0)
    gain = p @ phi / (MU + phi @ p @ phi)
    return Estimate(theta + gain * (target - phi @ theta), (p - jnp.outer(gain, phi @ p)) / MU)


def batch(count):
    """Weighted least squares over the last samples, in long double: what is older weighs less than 1e-18."""
    first = max(0, count - 100_000)
    at = jnp.arange(first, count, dtype=jnp.uint32)
    phi, target, use = (np.asarray(a) for a in jax.vmap(lambda i: sample(i, jnp.float64))(at))
    phi, target = phi[use].astype(np.longdouble), target[use].astype(np.longdouble)
    weight = np.longdouble(MU) ** np.arange(len(target) - 1, -1, -1)
    normal, right = (phi.T * weight) @ phi, (phi.T * weight) @ target
    return np.linalg.solve(normal.astype(float), right.astype(float))


def followed(count, hard):
    exact, errors = batch(count), {}
    for dtype in (jnp.float64, jnp.float32):
        state, largest = long_run(ours, count, dtype)
        assert largest <= 3.001
        assert np.linalg.eigvalsh(np.asarray(state.covariance, float)).min() > 0
        np.testing.assert_array_equal(state.covariance, np.asarray(state.covariance).T)
        errors[dtype] = float(np.abs(state.theta - exact).max() / 2)
    assert errors[jnp.float64] < 1e-10
    assert errors[jnp.float32] < 1e-4
    _, wound_up = long_run(textbook, count, jnp.float32)
    assert not wound_up < 1e6
    hard(
        "online calibration over long runs",
        f"{count:,} updates, half of them idle, a fifth of one coefficient only",
        float64=errors[jnp.float64],
        float32=errors[jnp.float32],
        naive=wound_up,
        beyond="a frame without information changes nothing; the covariance stays bounded (naive: its growth)",
    )


def test_a_hundred_thousand_updates(hard):
    followed(130_000, hard)


@pytest.mark.slow
def test_ten_million_updates(hard):
    followed(10_030_000, hard)


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


@pytest.mark.slow
def test_pads_that_pull_and_images_of_nothing_teach_nothing(skin):
    """A second contact, which the drift of a third pad below zero would hide; an image below or at zero."""
    tracker = SensitivityTracker(geometry_of(skin), image_gain=2e4)
    frames, _, _ = touches(tracker, np.zeros(5), 3)
    pulled = frames.pad_force.at[1].set(jnp.array([10.0, 5.0, -6.0, 0.0])).at[4].set(0)
    image_sum = frames.image_sum * jnp.array([1.0, 1.0, -1.0, 0.0, 1.0])
    odd = frames._replace(pad_force=pulled, image_sum=image_sum, standard_error=frames.standard_error.at[4].set(0))
    features, targets, use = tracker.samples(odd)
    assert use.tolist() == [True, False, False, False, False]
    assert np.isfinite(features).all()
    assert np.isfinite(targets).all()
    rounded = Estimate(tracker.start().theta, -1e-20 * jnp.eye(len(tracker.start().theta)))
    assert not np.asarray(tracker.forces(rounded, odd.image_sum, odd.places)[1]).any()
