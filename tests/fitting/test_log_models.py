"""Models of logs: honest standard errors and intervals of samples that err together, blocks, thinning, the choice."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from calib.fitting.curves import Affine, AffinePlay, fit_curves
from calib.fitting.logs import LogSeries, LogTracker, SmoothChannels, fit_series, series_of, ways_of
from calib.fitting.logs.noise import fit_log_noise, force_rate
from calib.fitting.logs.series import block_means
from calib.fitting.losses import Squared

from ..helpers import REAL_DATA

N = 1500
TRUE = np.array([2.0, 5.0])  # N per unit, N


def autocorrelated(seed):
    """A log whose errors of 0.5 N keep for about 15 samples."""
    rng = np.random.default_rng(seed)
    load = 2 + np.sin(np.arange(N) / 20 + rng.uniform(0, 6)) + 0.5 * np.sin(np.arange(N) / 77)
    error = signal.lfilter([1.0], [1.0, -0.93], rng.normal(size=N + 200))[200:] * np.sqrt(1 - 0.93**2)
    return np.arange(N) * 1e7, load[:, None], TRUE[0] * load + TRUE[1] + 0.5 * error


def fitted(log):
    series = series_of([log])
    return fit_series(series, series.complete, [Affine()], ways_of(1, 128), Squared())


@pytest.mark.slow
def test_standard_errors_and_intervals_of_autocorrelated_logs_are_honest():
    """Pulls of 40 logs have a standard deviation of one; as independent samples they would have four."""
    found = [fitted(autocorrelated(seed)) for seed in range(40)]
    curves = [one.model.curve for one in found]
    pulls = np.array([(np.asarray(c.parameters) - TRUE) / np.asarray(c.standard_errors) for c in curves])
    assert np.all(np.abs(pulls.mean(0)) < 3 / np.sqrt(40))
    assert np.all((pulls.std(0) > 0.7) & (pulls.std(0) < 1.4))
    logs = [autocorrelated(seed) for seed in range(40)]
    alone = fit_curves(Affine(), np.stack([s[:, 0] for _, s, _ in logs]), np.stack([f for *_, f in logs]))
    naive = (np.asarray(alone.parameters) - TRUE) / np.asarray(alone.standard_errors)
    assert np.all(naive.std(0) > 2)
    covered = []
    for one, other in zip(found, logs[1:] + logs[:1], strict=True):
        new = one.model.predict(other[0], other[1])
        covered.append(np.mean((other[2] > new.low) & (other[2] < new.high)))
    assert 0.85 < np.mean(covered) < 0.97


def test_noise_that_grows_with_the_rate_is_recovered_and_covered():
    """A force that goes between two levels, read 30 ms late or early: few samples move, and these err most."""
    covered = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        time = np.arange(6000) * 1e7
        level = np.where(np.arange(6000) // 150 % 2, 10.0, 0.0)
        force = np.convolve(np.pad(level, 20, "edge"), np.full(41, 1 / 41), "valid")
        rate = force_rate(time, force)
        late = np.repeat(rng.normal(0, 0.03, 40), 150)  # of each stretch
        residual = 0.05 * rng.normal(size=6000) + late * rate
        group, fitted = np.arange(6000) // 150, np.arange(6000) < 4500
        noise = fit_log_noise(np.where(fitted, residual, np.nan), time, force, np.zeros(6000), group, 20)
        half = noise.multiple * np.sqrt(noise.variance(time, force))
        moving = np.abs(rate) > 1
        covered.append([np.mean(np.abs(residual) <= half, where=~fitted & (moving == k)) for k in (False, True)])
        assert float(noise.floor) == pytest.approx(0.05, rel=0.15)
        assert float(noise.lag) == pytest.approx(0.03, rel=0.5)
    assert ((np.mean(covered, 0) > 0.88) & (np.mean(covered, 0) < 0.99)).all()


@pytest.mark.slow
def test_a_log_that_begins_under_load_holds_its_unknown_history_in_its_interval():
    """Cycles of a curve with hysteresis, cut at any sample: forces lie in the intervals, which narrow in a cycle."""
    curve, n = AffinePlay(np.array([0.2, 0.4, 0.8])), 2400
    rng = np.random.default_rng(0)
    load = 1 - np.cos(np.arange(n) / 40 + 0.3 * np.sin(np.arange(n) / 300))
    force = np.asarray(curve(jnp.array([1.0, 2.0, 3.0, 4.0, 0.0]), jnp.asarray(load))) + 0.02 * rng.normal(size=n)
    time = np.arange(n) * 1e7
    series = series_of([(time, load[:, None], force)])
    model = fit_series(series, series.complete, [curve], ways_of(1, 128), Squared()).model
    whole = model.predict(time, load[:, None])
    inside, width = [], []
    for start in (start for start in range(300, 1500, 37) if load[start] > 0.25):  # less counts as rest
        found = model.predict(time[start:], load[start:, None])
        first = slice(0, 60)
        inside.append(np.mean((force[start:] > found.low)[first] & (force[start:] < found.high)[first]))
        width.append(found.high - found.low)
        np.testing.assert_allclose(found.force[-400:], whole.force[start:][-400:], atol=1e-6)
        np.testing.assert_allclose(width[-1][-400:], (whole.high - whole.low)[-400:], atol=1e-6)
    assert np.mean(inside) > 0.88
    under_load = [w[:20].max() for w in width]
    assert max(under_load) > 3 * np.median(whole.high - whole.low)


@pytest.mark.slow
def test_a_soft_sensor_that_was_in_use_before_the_log_is_told_by_its_like():
    """Channels that creep by 30 % with 30 s, and loads at random: the interval holds what is unknown."""
    rng = np.random.default_rng(0)
    time = np.arange(0, 1800, 0.25)
    force = np.repeat(rng.uniform(0, 20, 180) * (rng.random(180) > 0.3), 40)
    creep = signal.lfilter([1 - np.exp(-0.25 / 30)], [1.0, -np.exp(-0.25 / 30)], force)
    values = (force + 0.3 * creep)[:, None] * [1.0, 0.5] + 0.02 * rng.normal(size=(len(time), 2))
    series = series_of([(time[:3600] * 1e9, values[:3600], force[:3600])])
    model = fit_series(series, series.complete, [Affine()], {"smooth": SmoothChannels((2,))}, Squared()).model
    rest, like, inside, without = [], [], [], []
    for start in range(3600, 7000, 80):
        rows = slice(start, start + 120)
        found = model.predict(time[rows] * 1e9, values[rows])
        at_rest = np.asarray(model.curve.predict(model.combination.signal(time[rows] * 1e9, values[rows])).force)
        rest.append(np.mean((at_rest - force[rows]) ** 2))
        like.append(np.mean((found.force - force[rows]) ** 2))
        inside.append(np.mean((force[rows] > found.low) & (force[rows] < found.high)))
        half = float(model.noise.multiple) * np.sqrt(model.noise.variance(time[rows] * 1e9, at_rest))
        without.append(np.mean(np.abs(at_rest - force[rows]) < half))
    assert np.sqrt(np.mean(like)) < 0.85 * np.sqrt(np.mean(rest))
    assert np.mean(inside) > 0.85 > np.mean(without) + 0.1


def test_blocks_are_parts_of_one_log_each_and_the_later_half_decides():
    long, short = (np.arange(n, dtype=float)[:, None] for n in (300, 100))
    logs = [(np.arange(len(v)) * 1e9, v, v[:, 0]) for v in (long, short)]
    series = series_of(logs)
    assert isinstance(series, LogSeries)
    block = series.blocks(series.complete, 20)
    assert np.unique(block).tolist() == list(range(20))
    assert np.all(np.diff(block) >= 0)
    assert set(block[series.log == 0]) == set(range(15))
    late = series.late(block)
    assert (late[:100].any(), late[200:300].all(), late[300:340].any(), late[360:].all()) == (False, True, False, True)
    assert series.first_half.sum() == 200
    assert np.all(np.diff(series.time) > 0)


def test_thinning_takes_means_of_complete_samples():
    time, values = np.arange(7.0), np.array([[1.0], [3.0], [5.0], [np.nan], [7.0], [9.0], [4.0]])
    force = np.array([1.0, np.nan, 2.0, 8.0, np.nan, np.nan, 6.0])
    t, v, f = block_means(time, values, force, 2)
    np.testing.assert_array_equal(t, [0.5, 2.5, 4.5, 6.0])
    np.testing.assert_array_equal(v[:, 0], [1.0, 5.0, 8.0, 4.0])
    np.testing.assert_array_equal(f, [1.0, 2.0, np.nan, 6.0])
    series = series_of([autocorrelated(0)], most=500)
    assert len(series.time) == 500


@pytest.mark.slow
@pytest.mark.parametrize("log", ["Circle_1bar", "Circle_5bar", "O-ring257_3bar"])
def test_two_halves_of_a_real_log_agree_within_their_errors(log):
    path = REAL_DATA / "pneumatic_actuator" / f"{log}.csv.gz"
    if not path.exists():
        pytest.skip(f"real recordings are not here: {path.name}")
    rows = np.genfromtxt(path)
    series = series_of([(rows[:, 0] * 1e6, rows[:, 5:6] * 1e5, rows[:, 6])])
    one, two = (
        fit_series(series, half, [AffinePlay()], ways_of(1, 128), Squared()).model.curve
        for half in (series.first_half, ~series.first_half)
    )
    apart = np.asarray(one.parameters) - np.asarray(two.parameters)
    error = np.hypot(np.asarray(one.standard_errors), np.asarray(two.standard_errors))
    assert np.sqrt(np.mean((apart / error) ** 2)) < 2.5


def assert_tracked(model, time, values, place=None):
    """One reading after the other gives what the log up to this reading gives."""
    tracker = LogTracker(model)
    for k in range(len(time)):
        found = tracker.step(float(time[k]), values[k], None if place is None else place[k])
        if k % 23 == 0 or k == len(time) - 1:
            whole = model.predict(time[: k + 1], values[: k + 1], None if place is None else place[: k + 1])
            for ours, theirs in zip(found, whole, strict=True):
                np.testing.assert_allclose(ours[0], theirs[-1], rtol=1e-9, atol=1e-9, err_msg=str(k))


def test_one_reading_after_the_other_gives_the_forces_of_the_whole_log():
    """Curves with hysteresis that begin under load, and lags with unknown histories, with readings missing."""
    rng, n = np.random.default_rng(0), 400
    time = np.cumsum(rng.uniform(0.5, 1.5, n)) * 1e8
    load = 1 - np.cos(np.arange(n) / 20 + 0.3 * np.sin(np.arange(n) / 70))
    curve = AffinePlay(np.array([0.2, 0.4, 0.8]))
    force = np.asarray(curve(jnp.array([1.0, 2.0, 3.0, 4.0, 0.0]), jnp.asarray(load))) + 0.02 * rng.normal(size=n)
    series = series_of([(time, load[:, None], force)])
    missing = np.where(np.isin(np.arange(n), [0, 1, 150, 151]), np.nan, load)[:, None]
    plain = fit_series(series, series.complete, [curve], ways_of(1, 128), Squared()).model
    assert_tracked(plain, time[45:], missing[45:])
    assert_tracked(plain, time, missing)
    values = np.stack([load, load**2], 1) + 0.01 * rng.normal(size=(n, 2))
    two = series_of([(time, values, force)])
    smooth = fit_series(two, two.complete, [curve], {"smooth": SmoothChannels((2,))}, Squared()).model
    assert_tracked(smooth, time[45:], np.where(np.isnan(missing[45:]), np.nan, values[45:]))


@pytest.mark.slow
def test_a_spike_of_one_reading_does_not_last_in_a_curve_with_hysteresis():
    n = 300
    time, load = np.arange(n) * 1e8, 1 - np.cos(np.arange(n) / 30)
    curve = AffinePlay(np.array([0.2, 0.4, 0.8]))
    force = np.asarray(curve(jnp.array([1.0, 2.0, 3.0, 4.0, 0.0]), jnp.asarray(load)))
    series = series_of([(time, load[:, None], force)])
    model = fit_series(series, series.complete, [curve], ways_of(1, 128), Squared()).model
    spoilt = load.copy()
    spoilt[100] += 1.5  # while the load falls
    sound, struck = (model.predict(time, one[:, None]).force for one in (load, spoilt))
    assert np.abs(struck - sound).max() < 0.05 * force.max()
    assert np.sqrt(np.mean((sound - force) ** 2)) < 0.01 * force.max()
