"""Effects of the electronics, each against the same recursion sample by sample, or against what it is defined by."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import welch

import jaxeit as je
from jaxeit import effects as fx
from jaxeit.effects.readout import POLE_RATIO, POLES

from ..histories import after, block_key

PATTERN = je.skin.adjacent(6)  # 18 readings
FRAMES = np.random.default_rng(5).normal(scale=0.02, size=(600, len(PATTERN))) + 0.1
CUTS = (200, 400)
MUX = je.effects.MuxSettling(settle=0.4e-6)
CERTAIN = [
    MUX,
    je.effects.GainError(),
    je.effects.LoadCellError(),
    je.effects.AdcRanges(),
    je.effects.Quantisation(step=0.01),
]
FAMILY = [kind() for kind in je.effects.EFFECTS.values() if issubclass(kind, fx.AbstractReadoutEffect)]


def _names(effect):
    return type(effect).__name__


@pytest.mark.parametrize(
    "effect",
    [
        je.effects.IntermittentElectrode(rate=0.0),
        je.effects.MuxSettling(time_constant=0.0),
        je.effects.BaselineDrift(rate=0.0),
        je.effects.GainError(std=0.0),
        je.effects.LoadCellError(nonlinearity=0.0),
        je.effects.MultiplicativeNoise(std=0.0),
        je.effects.Noise(std=0.0),
        je.effects.PinkNoise(amplitude=0.0),
        je.effects.Quantisation(step=1e-13),
        je.effects.AdcRanges(bits=46, headroom=8.0),
    ],
    ids=_names,
)
def test_without_its_cause_the_reading_is_ideal(effect):
    np.testing.assert_allclose(after(effect, FRAMES, pattern=PATTERN), FRAMES, rtol=0, atol=1e-12)


@pytest.mark.parametrize("effect", CERTAIN, ids=_names)
def test_blocks_make_the_whole(effect):
    whole = after(effect, FRAMES)
    assert np.abs(whole - FRAMES).max() > 1e-7  # it does something
    np.testing.assert_allclose(after(effect, FRAMES, cuts=CUTS), whole, rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("effect", FAMILY, ids=_names)
def test_float32_stays(effect):
    single = after(effect, FRAMES[:200].astype(np.float32), pattern=PATTERN)
    double = after(effect, FRAMES[:200], pattern=PATTERN)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, double, rtol=1e-4, atol=4e-4)  # the same draws; a rounding may fall otherwise


def test_readings_are_taken_at_the_times_of_the_protocol(skin):
    nominal = skin.protocol.reading_time * jnp.arange(skin.protocol.readings, dtype=float)
    when = jnp.full(nominal.shape, 0.5)
    np.testing.assert_allclose(je.effects.ScanSkew()(when, nominal), 0.5 + nominal)
    assert float(nominal[-1]) == pytest.approx(5.49e-3)  # 25 x 22 readings of 10 us
    np.testing.assert_array_equal(je.effects.ScanSkew(stretch=0.0)(when, nominal), 0.5)


def test_the_multiplexer_goes_from_reading_to_reading_across_frames():
    effect = je.effects.MuxSettling(time_constant=2e-6, settle=1e-6)
    left, before, expected = np.exp(-0.5), FRAMES[0, -1], []
    for value in FRAMES.ravel():
        before = value + (before - value) * left
        expected.append(before)
    np.testing.assert_allclose(np.ravel(after(effect, FRAMES, cuts=CUTS)), expected, rtol=1e-12)


def test_gains_differ_between_channels_and_not_in_time():
    shown = after(je.effects.GainError(std=0.01, seed=2), np.full((3, 20000), 2.0), cuts=(1,))
    assert (shown[0] / 2 - 1).std() == pytest.approx(0.01, rel=0.03)
    np.testing.assert_array_equal(shown, shown[[0, 0, 0]])
    other = after(je.effects.GainError(std=0.01, seed=3), np.full((1, 20000), 2.0))
    assert abs(np.corrcoef(shown[0], other[0])[0, 1]) < 0.03


def test_a_load_cell_is_right_at_its_ends_and_bowed_between():
    force = np.linspace(-50, 50, 101)[:, None]
    error = (after(je.effects.LoadCellError(nonlinearity=1e-3, full_scale=50.0), force) - force)[:, 0]
    np.testing.assert_allclose(error[[0, 50, 100]], 0, atol=1e-12)
    assert error.max() == error[75] == pytest.approx(0.05)
    np.testing.assert_allclose(error, -error[::-1], atol=1e-12)


def test_multiplicative_noise_is_in_proportion():
    series = np.tile([0.0, 1.0, -20.0], (20000, 1))
    relative = after(je.effects.MultiplicativeNoise(std=0.02), series) - series
    np.testing.assert_allclose(relative.std(0), [0, 0.02, 0.4], rtol=0.02)
    assert abs(np.corrcoef(relative[:, 1], relative[:, 2])[0, 1]) < 0.03


def test_pink_noise_is_its_filters_of_white_noise_from_block_to_block():
    amplitude, still = 0.3, np.zeros((600, 2))
    white = np.concatenate(
        [jax.random.normal(block_key(n), (len(part), 2), jnp.float32) for n, part in enumerate(np.split(still, CUTS))]
    )
    state, expected = np.zeros((len(POLES), 2)), []
    for w in white:
        state = np.exp(-POLES)[:, None] * state + w
        expected.append(np.log(POLE_RATIO) * np.sqrt(POLES / np.pi) @ state)
    shown = after(je.effects.PinkNoise(amplitude=amplitude), still, cuts=CUTS)
    np.testing.assert_allclose(shown, amplitude * np.array(expected), rtol=1e-10, atol=1e-12)


def test_pink_noise_has_the_spectrum_it_says():
    """The response of the filters over five decades, and the spectrum of what comes out, in V^2/Hz."""
    f = np.geomspace(1e-5, 0.5, 2000)
    z = np.exp(-2j * np.pi * f)[:, None]
    response = (np.log(POLE_RATIO) * np.sqrt(POLES / np.pi) / (1 - np.exp(-POLES) / z)).sum(1)
    assert np.abs(2 * np.abs(response) ** 2 * f - 1).max() < 0.1
    rate, amplitude = 180.0, 1e-4
    shown = after(je.effects.PinkNoise(amplitude=amplitude), np.zeros((2**15, 16)), interval=1 / rate)
    f, density = welch(shown, rate, nperseg=4096, axis=0)
    ratio = (density.mean(1) * f)[4:-1] / amplitude**2
    bands = [ratio[(f[4:-1] >= low) & (f[4:-1] < 3 * low)].mean() for low in (0.2, 0.6, 2, 6, 20)]
    np.testing.assert_allclose(bands, 1, atol=0.1)


def test_converters_choose_a_range_for_each_channel():
    effect = je.effects.AdcRanges(bits=10, full_scale=1.0, gains=(1.0, 10.0, 100.0), headroom=2.0)
    rest = np.array([0.6, 0.4, -0.04, 0.004, 0.0])
    series = np.concatenate([rest[None], rest + np.random.default_rng(1).uniform(-2, 2, (500, 5)) * np.abs(rest)])
    expected = np.empty_like(series)
    for channel, first in enumerate(rest):
        gain = max([g for g in (1, 10, 100) if abs(first) * 2 * g <= 1], default=1)
        step = 2 / 2**10 / gain
        for frame, value in enumerate(series[:, channel]):
            expected[frame, channel] = min(max(np.round(value / step), -512), 511) * step
    np.testing.assert_allclose(after(effect, series, cuts=(167, 334)), expected, rtol=1e-12)
    assert expected[:, 0].max() == pytest.approx(1 - 2 / 2**10)  # the first channel clips


def test_a_converter_adds_the_noise_of_its_step():
    spread = np.random.default_rng(2).uniform(-0.9, 0.9, (4000, 2))
    spread[0] = 1.0
    for bits in (12, 14):
        error = (after(je.effects.AdcRanges(bits=bits, full_scale=1.0, headroom=1.0), spread) - spread)[1:]
        assert error.std() == pytest.approx(2 / 2**bits / 12**0.5, rel=0.03)


def _open_frames(effect, frames, interval, cuts=()):
    """Whether the electrode was open, frame by frame: a reading that drives through it is 0."""
    row = [[int(effect.electrode), 9, 7, 8]]
    return after(effect, np.ones((frames, 1)), interval=interval, pattern=row, cuts=cuts)[:, 0] == 0


def test_a_loose_electrode_is_a_telegraph():
    """Against the matrix exponential of the two rates, at an interval comparable with the gaps."""
    rate, duration, interval = 4.0, 0.1, 0.05
    effect = je.effects.IntermittentElectrode(electrode=3, rate=rate, duration=duration)
    is_open = _open_frames(effect, 40000, interval, cuts=(10000, 20000, 30000))
    share = rate / (rate + 1 / duration)
    assert is_open.mean() == pytest.approx(share, rel=0.05)
    step = expm(interval * np.array([[-rate, rate], [1 / duration, -1 / duration]]))
    before, now = is_open[:-1], is_open[1:]
    assert now[~before].mean() == pytest.approx(step[0, 1], rel=0.05)
    assert now[before].mean() == pytest.approx(step[1, 1], rel=0.05)


def test_a_loose_electrode_stays_open_over_the_end_of_a_block():
    always = je.effects.IntermittentElectrode(rate=1e6, duration=1e6)
    assert _open_frames(always, 100, 0.01, cuts=(50,)).all()
    # Once open it stays: the state at the end of the first block is what the second begins with.
    once = je.effects.IntermittentElectrode(rate=3.0, duration=1e9)
    is_open = _open_frames(once, 400, 0.01, cuts=(100, 200, 300))
    assert not is_open[0]
    assert (np.diff(is_open.astype(int)) >= 0).all()
    assert is_open[-1]


def test_a_loose_electrode_loses_its_readings_only():
    effect = je.effects.IntermittentElectrode(electrode=2, rate=1e9, duration=1e9, floating=0.01)
    shown = after(effect, FRAMES, pattern=PATTERN)
    drives, senses = (PATTERN[:, :2] == 2).any(1), (PATTERN[:, 2:] == 2).any(1)
    np.testing.assert_array_equal(shown[:, ~drives & ~senses], FRAMES[:, ~drives & ~senses])
    np.testing.assert_array_equal(shown[:, drives], 0)
    assert shown[:, senses].std() == pytest.approx(0.01, rel=0.1)
    plus, minus = shown[:, PATTERN[:, 2] == 2], shown[:, PATTERN[:, 3] == 2]
    np.testing.assert_array_equal(plus, -minus)  # one potential, seen from both sides
    assert (~drives & ~senses).sum() == 6
