"""Models of logs: honest standard errors and intervals of samples that err together, blocks, thinning, the choice."""

import numpy as np
import pytest
from scipy import signal

from calib.fitting.curves import Affine, AffinePlay, fit_curves
from calib.fitting.logs import LogSeries, fit_series, series_of, ways_of
from calib.fitting.logs.series import thinned
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
    t, v, f = thinned(time, values, force, 2)
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
