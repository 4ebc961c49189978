"""Clocks and links against what their parameters say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

import jaxeit as je
from jaxeit.effects import Packets

EXACT = {"skew": 0.0, "offset": 0.0, "latency": 0.0, "jitter": 0.0}


def _packets(samples, interval, dtype=float):
    times = jnp.asarray(np.arange(samples) * interval, dtype)
    return Packets(times, times, jnp.zeros(samples, bool))


def _after(effect, packets, seed=0):
    return effect(packets, jax.random.key(seed))


def test_a_perfect_clock_and_link_change_nothing():
    packets = _packets(50, 0.01)
    for effect in (je.effects.ClockError(**EXACT), je.effects.DropOut(probability=0.0)):
        for now, then in zip(_after(effect, packets), packets, strict=True):
            np.testing.assert_array_equal(now, then)


def test_a_device_clock_runs_on_its_own():
    packets = _packets(300, 10.0)
    shown = _after(je.effects.ClockError(skew=-30e-6, offset=5.0, latency=2e-3, jitter=0.0), packets)
    slope, start = np.polyfit(packets.host, shown.device, 1)
    assert slope - 1 == pytest.approx(-30e-6, rel=1e-6)
    assert start == pytest.approx(5.0, abs=1e-9)
    np.testing.assert_allclose(shown.host - packets.host, 2e-3, atol=1e-9)


def test_jitter_is_exponential_and_one_sided():
    packets = _packets(4000, 1.0)  # far apart: no sample waits for another
    late = np.asarray(_after(je.effects.ClockError(latency=1e-3, jitter=5e-4), packets).host - packets.host)
    assert late.min() >= 1e-3 - 1e-9
    assert kstest(late - 1e-3, "expon", (0, 5e-4)).pvalue > 0.01


def test_samples_arrive_in_order():
    packets = _packets(2000, 1e-3)
    alone = je.effects.ClockError(jitter=0.02)
    host = np.asarray(_after(alone, packets).host)
    assert (np.diff(host) >= 0).all()
    assert (np.diff(host) == 0).any()  # some waited, and came together


def test_an_adapter_hands_over_at_its_own_times():
    packets = _packets(2000, 1e-3)
    late = {"latency": 1e-3, "jitter": 1e-4}
    sent, host = (np.asarray(_after(je.effects.ClockError(batch=b, **late), packets).host) for b in (0.0, 0.016))
    np.testing.assert_allclose(host / 0.016, np.round(host / 0.016), atol=1e-9)
    assert (host - sent).min() >= -1e-12
    assert (host - sent).max() < 0.016
    assert len(np.unique(host)) == pytest.approx(2000 / 16, abs=2)


def test_losses_add_up():
    packets = _packets(20000, 1.0)
    lost = _after(je.effects.DropOut(probability=0.1), packets).lost
    assert float(lost.mean()) == pytest.approx(0.1, rel=0.1)
    twice = _after(je.effects.DropOut(probability=0.1), packets._replace(lost=lost), seed=1).lost
    assert bool((twice | ~lost).all())
    assert float(twice.mean()) == pytest.approx(0.19, rel=0.1)


def test_float32_stays():
    shown = _after(je.effects.DropOut(), _after(je.effects.ClockError(batch=0.016), _packets(10, 1.0, np.float32)))
    assert shown.device.dtype == shown.host.dtype == jnp.float32
