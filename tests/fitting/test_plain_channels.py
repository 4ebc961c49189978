"""Arrays of plain channels: faults told, and one signal made of many."""

from functools import partial

import numpy as np
import pytest
from scipy import ndimage

import calib
from benchmarks import bench_real
from calib.calibration.logs.evaluation import LogEvaluation
from calib.fitting import AffinePlay, PlaySpline
from calib.fitting.curves import Affine, fit_curves
from calib.fitting.curves.fitted import predict_pads
from calib.fitting.logs import SmoothChannels, fit_log
from calib.fitting.logs.combination import first_order_lag
from calib.fitting.results import FitResult
from calib.presses.channel_faults import faults

from ..helpers import REAL_DATA


def test_every_fault_is_told_and_only_that():
    rng = np.random.default_rng(0)
    reference = np.sin(np.linspace(0, np.pi, 2000))
    values = np.rint(200 - 100 * reference[:, None] * np.ones(6) + rng.normal(0, 1, (2000, 6)))
    values[:, 1] = 77
    values[:, 2] = np.minimum(values[:, 2] + 100, 255)
    values[:, 3] = np.rint(rng.normal(150, 5, 2000))
    values[::100, 4] += 60
    values = np.column_stack([np.minimum(values, 255), np.full(2000, np.nan)])
    values[500:510, 0] = np.nan
    found = faults(values, reference)
    flags = {name: np.flatnonzero(flag).tolist() for name, flag in found._asdict().items()}
    assert flags == {"dead": [6], "stuck": [1], "saturated": [2], "silent": [3], "spiking": [4]}
    assert np.flatnonzero(found.any).tolist() == [1, 2, 3, 6]
    assert np.flatnonzero(found.uninformative).tolist() == [1, 3, 6]
    assert not faults(values).silent.any()


def test_recordings_that_are_not_there_are_named(tmp_path, capsys):
    (tmp_path / "eflesh").mkdir()
    with pytest.raises(SystemExit):
        bench_real.main([str(tmp_path)])
    assert f"{tmp_path} has no folder insole_plenum, pneumatic_actuator" in capsys.readouterr().err


def test_chance_allows_what_so_few_independent_parts_scatter():
    """Against draws: ten parts that an exact interval covers whole or not at all."""
    drawn = (np.random.default_rng(0).random((20_000, 10)) < 0.9).mean(1)
    least, most = bench_real.chance_band(10)
    assert (least, most) == (0.7, 1.0)
    assert np.mean(drawn < least) < 0.05 < np.mean(drawn < least + 0.1)
    assert bench_real.chance_band(0) == (0.0, 1.0)
    assert bench_real.effective_count(np.repeat(np.arange(10), 7)) == 10
    assert bench_real.effective_count(np.repeat([0, 1, 2], [50, 50, 1])) == 2
    sizes = np.array([60, 20, 20])  # the mean of unequal parts scatters as that of so many equal ones
    means = (np.random.default_rng(1).normal(0, 1, (20_000, 3)) * sizes).sum(1) / 100
    assert bench_real.effective_count(np.repeat([0, 1, 2], sizes)) == round(1 / means.var())


def test_a_third_of_the_force_is_beyond_chance_or_not():
    """Five rises and falls, whose large forces no interval holds; the others lie in all of theirs."""
    time = np.arange(1000) / 10
    force = 5 * (1 - np.cos(2 * np.pi * time / 20))
    low = np.where(force > 20 / 3, force + 1, force - 1)
    one = np.ones(1000)
    found = LogEvaluation("", time, force, force, one, low, force + 2, one > 0)
    rows = {row["third"]: row for row in bench_real.chance_rows(found)}
    assert [row["coverage"] for row in rows.values()] == [1, 1, 0]
    assert [row["beyond"] for row in rows.values()] == ["no", "no", "by blocks and cycles"]
    assert {row["cycles"] for row in rows.values()} == {5}
    assert all(5 < row["blocks"] <= 20 for row in rows.values())


def test_a_lag_follows_a_step_by_its_time_constant():
    time = np.cumsum(np.random.default_rng(0).uniform(0.05, 0.2, 200))
    step = np.where(np.arange(200) > 0, 1.0, 0.0)
    step[50] = np.nan
    out = first_order_lag(time, step, 2.0)
    assert np.isnan(out[50])
    np.testing.assert_allclose(np.delete(out, 50), np.delete(-np.expm1(-(time - time[0]) / 2.0), 50), atol=1e-12)


@pytest.mark.slow
def test_creep_is_learnt_and_the_second_half_predicted():
    """Bent channels that creep by 10 % over 5 s: a formula without memory leaves that."""
    rng = np.random.default_rng(2)
    time = np.arange(0, 120, 0.2)
    load = 10 * (1 + np.sin(time / 3)) * (1 + 0.5 * np.sin(time / 17))
    felt = load + 0.1 * first_order_lag(time, load, 5.0)
    signals = np.stack([felt, felt**1.2, 3 - 0.5 * felt + 0.02 * felt**2], 1) + rng.normal(0, 0.01, (600, 3))
    with_creep, without = (
        fit_log(Affine(), time * 1e9, signals, load, channels=SmoothChannels((2,), lags)) for lags in ((5.0,), ())
    )
    assert with_creep.held_out.rmse < 0.5 * without.held_out.rmse
    assert with_creep.held_out.rmse < 0.15
    assert "lags of 5 s" in with_creep.source


def _held_out(fit, force):
    """Root mean square errors (channels,) of ``fit(samples used)`` on each fifth of 20 stretches of time left out."""
    part = (np.arange(len(force)) * 20 // len(force)) % 5
    predicted = [np.where(part == k, fit(part != k), 0) for k in range(5)]
    return np.sqrt(np.mean((np.sum(predicted, 0) - force) ** 2, 1))


@pytest.mark.slow
@pytest.mark.skipif(
    not (REAL_DATA / "insole_plenum").exists(), reason="insole_plenum is not at hand; set JAXEIT_REAL_DATA"
)
def test_an_insole_in_a_chamber_is_fitted_but_for_a_taxel_or_two():
    """One in six wants a slope at zero or just below: until that was a fit like any other, 22 to 54 of 246 failed."""
    counts, pressure = bench_real.insole_counts(REAL_DATA)
    sound = ~faults(counts, pressure).any
    assert sound.sum() == 246
    rest, gauge = np.median(counts[:200], 0), np.median(pressure[:200])  # before the chamber is filled
    press = ndimage.median_filter(rest - counts, (9, 1))[::100][:, sound].T
    force = pressure[::100] - gauge

    def cubic(use):
        return np.array([np.polynomial.Polynomial.fit(one[use], force[use], 3)(one) for one in press])

    def fitted(law, use):
        found = fit_curves(law, press, force, mask=np.broadcast_to(use, press.shape))
        failed = np.asarray(found.result) != FitResult.SUCCESS
        assert failed.sum() <= 3
        return np.where(failed[:, None], np.nan, np.asarray(predict_pads(found, press).force))

    floor = _held_out(cubic, force)
    for law in (calib.fitting.MonotonePolynomial(), calib.fitting.MonotoneSpline(), AffinePlay(), PlaySpline()):
        errors = _held_out(partial(fitted, law), force)
        assert np.nanmedian(errors) < np.median(floor)
    assert np.mean(errors < floor) > 0.7
