"""Fits against SciPy, closed forms, a cluster sandwich written out, and many simulated sessions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import linalg, optimize

from calib.fitting.cross_validation.scores import assign_folds, mae, percent_full_scale, rmse, score
from calib.fitting.cross_validation.selection import Option, simplest
from calib.fitting.curves import Affine, AffinePlay, Linear, MonotoneSpline, PowerLaw, fit_curve, fit_curves
from calib.fitting.curves.fit import default_solver, fit_samples
from calib.fitting.curves.fitted import predict_pads
from calib.fitting.curves.problem import design_effect
from calib.fitting.curves.samples import Samples, make_samples
from calib.fitting.logs import BestChannel, fit_log, time_split
from calib.fitting.losses import Cauchy, Huber, SoftL1, Squared
from calib.fitting.results import FitError, FitResult

from ..helpers import REAL_DATA, spread_stacks

N, PRESSES = 240, 12
GROUPS = np.repeat(np.arange(PRESSES), N // PRESSES)


def pads(seed=0, count=3, outliers=True):
    """(pads, n) pressure and force of power-law pads with noise, and a tenth of gross outliers."""
    rng = np.random.default_rng(seed)
    pressure = rng.uniform(50.0, 4000.0, (count, N))
    force = 4e-3 * 2000 * (pressure / 2000) ** 1.2 + rng.normal(0, 0.2, (count, N))
    if outliers:
        force[:, ::10] += rng.uniform(3, 15, (count, N // 10))
    return pressure, force


@pytest.fixture(scope="module")
def fitted_power():
    pressure, force = pads()
    return pressure, force, fit_curves(PowerLaw(2000.0), pressure, force)


# --- against independent minimisers -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("loss", "name", "width"),
    [
        (SoftL1(), "soft_l1", 1.287),
        pytest.param(Huber(), "huber", 1.345, marks=pytest.mark.slow),
        pytest.param(Cauchy(), "cauchy", 2.385, marks=pytest.mark.slow),
    ],
)
def test_robust_fit_is_scipys_at_the_same_scale(loss, name, width):
    pressure, force = (a[0] for a in pads())
    got = fit_curve(Affine(), pressure, force, loss=loss)
    assert got.result == FitResult.SUCCESS

    def residual(x):
        return (force - x[0] * pressure - x[1]) / float(got.scale)

    best = optimize.least_squares(
        residual, [4e-3, 0.0], loss=name, f_scale=width, x_scale=[1e-3, 1.0], xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    np.testing.assert_allclose(got.parameters, best.x, rtol=1e-5, atol=1e-6)
    mad = 1.4826 * np.median(np.abs(force - got.curve(got.parameters, jnp.asarray(pressure))))
    np.testing.assert_allclose(got.scale, mad, rtol=2e-2)


def test_power_law_is_scipys(fitted_power):
    pressure, force, got = fitted_power
    for i in range(3):

        def residual(x, i=i):
            return (force[i] - x[0] * 2000 * (pressure[i] / 2000) ** x[1]) / float(got.scale[i])

        best = optimize.least_squares(
            residual, [4e-3, 1.0], loss="soft_l1", f_scale=1.287, x_scale=[1e-3, 1.0], xtol=1e-15, ftol=1e-15
        )
        np.testing.assert_allclose(got.parameters[i], best.x, rtol=1e-5)
        assert np.abs(got.parameters[i] - np.array([4e-3, 1.2])).max() < 0.05


def test_squared_loss_is_the_closed_form_with_its_covariance():
    pressure, force = (a[0] for a in pads(outliers=False))
    got = fit_curve(Affine(), pressure, force, loss=Squared())
    x = np.stack([pressure, np.ones(N)], 1)
    beta, rss = np.linalg.lstsq(x, force, rcond=None)[:2]
    np.testing.assert_allclose(got.parameters, beta, rtol=1e-9)
    np.testing.assert_allclose(got.covariance, rss[0] / (N - 2) * np.linalg.inv(x.T @ x), rtol=1e-7)
    np.testing.assert_allclose(got.residual_rms, np.sqrt(rss[0] / (N - 2)), rtol=1e-9)
    np.testing.assert_allclose(got.pressure_range, [pressure.min(), pressure.max()])
    assert (int(got.n), int(got.rank), int(got.n_groups)) == (N, 2, 0)


@pytest.mark.slow
def test_grouped_covariance_is_cr2_written_out():
    pressure, force = (a[0] for a in pads(outliers=False))
    force = force + np.repeat(np.random.default_rng(1).normal(0, 1, PRESSES), N // PRESSES)
    got = fit_curve(Affine(), pressure, force, groups=GROUPS, loss=Squared())
    x = np.stack([pressure, np.ones(N)], 1)
    bread = np.linalg.inv(x.T @ x)
    e, hat = force - x @ bread @ x.T @ force, x @ bread @ x.T
    meat = np.zeros((2, 2))
    for g in range(PRESSES):
        own = g == GROUPS
        adjust = linalg.inv(linalg.sqrtm(np.eye(own.sum()) - hat[np.ix_(own, own)]))
        u = x[own].T @ adjust.real @ e[own]
        meat += np.outer(u, u)
    np.testing.assert_allclose(got.covariance, bread @ meat @ bread, rtol=1e-6)
    assert int(got.n_groups) == PRESSES


def test_weights_are_those_of_weighted_least_squares():
    pressure, force = (a[0] for a in pads(outliers=False))
    sigma = np.where(np.arange(N) % 2, 0.1, 3.0)
    got = fit_curve(Affine(), pressure, force, sigma=sigma, loss=Squared())
    slope, offset = np.polyfit(pressure, force, 1, w=1 / sigma)
    np.testing.assert_allclose(got.parameters, [slope, offset], rtol=1e-8)


SLOPES = np.array([4e-3, 2e-3, 3e-3, 6e-3, 8e-3])


def on_a_loop(noise: float, width: float):
    """Pressure up and down twice, and the force of a bent spline with noise, more on the way up than down."""
    pressure = 2000 * (1 - np.cos(np.linspace(0, 4 * np.pi, N)))
    side = width * np.sign(np.gradient(pressure)) + noise * np.random.default_rng(5).normal(size=N)
    force = MonotoneSpline(4000.0)(jnp.asarray(SLOPES), jnp.asarray(pressure))
    return pressure, np.asarray(force) + side


@pytest.mark.slow
@pytest.mark.parametrize("groups", [None, GROUPS], ids=["blocks", "presses"])
def test_a_spline_is_as_bent_as_the_samples_that_err_for_themselves_can_tell(groups):
    """The rounds written out, by normal equations: a bend counts against as many samples as err together."""
    pressure, force = on_a_loop(0.1, 0.5)
    fit = fit_curve(MonotoneSpline(4000.0), pressure, force, groups=groups, loss=Squared())
    slope = np.median((force / np.maximum(pressure, 1))[pressure > 0.2 * np.quantile(pressure, 0.75)])
    spline = jax.jacfwd(lambda p: MonotoneSpline(4000.0)(p, jnp.asarray(pressure)))
    design = slope * np.asarray(spline(jnp.ones(5)))
    bends = np.diff(np.eye(5), 2, axis=0) / 0.5
    block = np.arange(N) // (N // 20) if groups is None else groups
    multiple = np.linalg.lstsq(design, force, rcond=None)[0]
    free = multiple
    for _ in range(3):
        left = force - design @ multiple
        effect = np.sum(np.bincount(block, left) ** 2) / np.sum(left**2)
        weight = effect * (1.4826 * np.median(np.abs(left))) ** 2
        multiple = np.linalg.solve(design.T @ design + weight * bends.T @ bends, design.T @ force)
    np.testing.assert_allclose(fit.parameters, slope * multiple, rtol=1e-6)
    assert np.ptp(np.diff(multiple)) < 0.9 * np.ptp(np.diff(free))


def test_where_each_sample_errs_for_itself_bends_are_left_to_the_samples():
    pressure, force = on_a_loop(0.1, 0.0)
    fit = fit_curve(MonotoneSpline(4000.0), pressure, force, loss=Squared())
    design = np.asarray(jax.jacfwd(lambda p: MonotoneSpline(4000.0)(p, jnp.asarray(pressure)))(jnp.ones(5)))
    plain = np.linalg.lstsq(design, force, rcond=None)[0]
    assert (np.abs(fit.parameters - plain) < 0.1 * fit.standard_errors).all()
    exact = fit_curve(MonotoneSpline(4000.0), *on_a_loop(0.0, 0.0))
    np.testing.assert_allclose(exact.parameters, SLOPES, rtol=1e-6)


def test_a_dead_zone_on_a_loop_is_no_contradiction():
    """The bends that are expected there would have the first slope below zero; the samples would not."""
    pressure, _ = on_a_loop(0.0, 0.0)
    side, noise = np.sign(np.gradient(pressure)), np.random.default_rng(1).normal(0, 0.05, N)
    force = [
        5e-3 * np.maximum(pressure - toe, 0) + width * side + noise
        for toe in (400, 800, 1200, 1600)
        for width in (0.3, 1.0, 2.0, 3.0)
    ]
    fits = fit_curves(MonotoneSpline(), np.tile(pressure, (16, 1)), force)
    assert (fits.result == FitResult.SUCCESS).all()
    assert (fits.parameters[:, 0] < 1e-7).any()


def test_samples_without_residuals_err_each_for_itself():
    samples = jax.tree.map(lambda leaf: leaf[0], make_samples(np.ones((1, 40)), np.zeros((1, 40)))[0])
    together = np.repeat([1.0, -1.0], 20)
    assert design_effect(jnp.zeros(40), samples, 0) == 1
    assert design_effect(jnp.asarray(together), samples, 0) == 2  # blocks of two
    assert design_effect(jnp.asarray(np.tile([1.0, -1.0], 20)), samples, 0) == 1


@pytest.mark.slow
def test_losses_are_what_they_are_called():
    r = np.linspace(-6, 6, 25) + 0.01  # not on Huber's corner
    s = (r / 2.0) ** 2
    rho = {
        Squared: s,
        Huber: np.where(s <= 1, s, 2 * np.sqrt(s) - 1),
        SoftL1: 2 * (np.sqrt(1 + s) - 1),
        Cauchy: np.log1p(s),
    }
    for kind, value in rho.items():
        loss = kind(2.0)
        np.testing.assert_allclose(loss.transform(jnp.asarray(r)) ** 2, 4 * value, rtol=1e-10)
        h = 1e-5
        slope = (loss.transform(jnp.asarray(r + h)) ** 2 - loss.transform(jnp.asarray(r - h)) ** 2) / (4 * h)
        np.testing.assert_allclose(loss.psi(jnp.asarray(r)), slope, atol=1e-6)
        assert loss.psi(jnp.zeros(1))[0] == 0
        assert loss.dpsi(jnp.zeros(1))[0] == pytest.approx(1)


# --- honesty ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("grouped", [False, True])
def test_pulls_have_mean_zero_and_deviation_one(grouped):
    trials, presses, each = 500, 30, 8
    rng = np.random.default_rng(7)
    top = rng.uniform(1000, 4000, (trials, presses, 1))
    pressure = (top * np.linspace(0.1, 1.0, each)).reshape(trials, -1)
    truth = np.array([4e-3, 1.2])
    force = truth[0] * 2000 * (pressure / 2000) ** truth[1]
    if grouped:
        gain = 1 + rng.normal(0, 0.03, (trials, presses, 1)) * np.ones(each)
        force = force * gain.reshape(trials, -1)
    force = force + rng.normal(0, 0.1, force.shape)
    groups = np.repeat(np.arange(presses), each) if grouped else None
    fits = fit_curves(PowerLaw(2000.0), pressure, force, groups=groups)
    assert (np.asarray(fits.result) == FitResult.SUCCESS).all()
    pulls = (np.asarray(fits.parameters) - truth) / np.asarray(fits.standard_errors)
    np.testing.assert_allclose(pulls.mean(axis=0), 0, atol=4 / np.sqrt(trials))
    # 4 standard errors of a deviation, and 4 % for the t-like tails of a variance from 30 presses
    np.testing.assert_allclose(pulls.std(axis=0), 1, atol=4 / np.sqrt(2 * trials) + 0.04 * grouped)


def test_scale_is_the_noise_and_an_outlier_of_any_size_hardly_moves_the_fit(fitted_power):
    pressure, force, got = fitted_power
    # a tenth of outliers puts the median at the 5/9 quantile of the good ones: 0.227
    np.testing.assert_allclose(got.scale, 0.227, rtol=0.25)
    worse = force.copy()
    worse[:, ::10] *= 1e4
    moved = fit_curves(PowerLaw(2000.0), pressure, worse)
    np.testing.assert_allclose(moved.parameters, got.parameters, rtol=0.01)


def test_a_bad_pad_is_reported_and_its_neighbours_are_bit_identical(fitted_power):
    pressure, force, good = fitted_power
    for damage in (np.nan, np.inf, 0.0, -1e30, 1e30):
        bad = pressure.copy()
        bad[1] = damage
        got = fit_curves(PowerLaw(2000.0), bad, force)
        assert got.result[1] != FitResult.SUCCESS
        for mine, theirs in zip(jax.tree.leaves(got), jax.tree.leaves(good), strict=True):
            assert np.array_equal(mine[0], theirs[0])
            assert np.array_equal(mine[2], theirs[2])
    assert np.isnan(fit_curves(PowerLaw(2000.0), pressure * np.nan, force).parameters).all()


def test_missing_samples_are_dropped_and_counted(fitted_power):
    pressure, force, _ = fitted_power
    holes = pressure.copy()
    holes[:, 5:25] = np.nan
    got = fit_curves(PowerLaw(2000.0), holes, force)
    mask = (np.arange(N) < 5) | (np.arange(N) >= 25)
    same = fit_curves(PowerLaw(2000.0), pressure, force, mask=mask)
    np.testing.assert_array_equal(got.parameters, same.parameters)
    assert got.n_missing.tolist() == [20] * 3
    assert got.n.tolist() == same.n.tolist() == [N - 20] * 3
    vouched = fit_curves(PowerLaw(2000.0), holes, force, mask=np.ones(N, bool))
    assert vouched.result.tolist() == [FitResult.NOT_FINITE] * 3
    assert np.isnan(vouched.parameters).all()


def test_hopeless_samples_each_get_their_own_result():
    pressure, force = pads(outliers=False)
    pressure[1, 2:] = np.nan
    force[2] = -force[2]
    got = fit_curves(PowerLaw(2000.0), pressure, force)
    assert got.result.tolist() == [FitResult.SUCCESS, FitResult.TOO_FEW, FitResult.NO_RESPONSE]
    assert "does not rise" in got.pad(2).message()
    assert np.isnan(got.parameters[1]).all()
    assert np.isnan(got.covariance[1:]).all()
    one_level = np.full((3, N), 2000.0)
    assert fit_curves(PowerLaw(2000.0), one_level, force).result[0] != FitResult.SUCCESS
    few = fit_curves(PowerLaw(2000.0), pressure, force, groups=GROUPS // 6, mask=np.isfinite(pressure))
    assert few.result[0] == FitResult.TOO_FEW


@pytest.mark.slow
def test_out_of_steps_says_so():
    pressure, force = pads()
    got = fit_curves(PowerLaw(2000.0), pressure, force, max_steps=1)
    assert got.result.tolist() == [FitResult.MAX_STEPS] * 3
    assert "max_steps" in got.pad(0).message()
    assert all(result.message for result in FitResult)


def test_every_loss_and_exact_data_is_fitted():
    pressure = np.linspace(10, 4000, N)
    got = fit_curve(Affine(), pressure, 3e-3 * pressure - 1.0)
    assert got.result == FitResult.SUCCESS
    np.testing.assert_allclose(got.parameters, [3e-3, -1.0], rtol=1e-6)


@pytest.mark.slow
def test_float32_agrees_with_float64_and_stays_float32(fitted_power):
    pressure, force, good = fitted_power
    got = fit_curves(PowerLaw(2000.0), pressure.astype("f4"), force.astype("f4"))
    assert got.parameters.dtype == got.covariance.dtype == jnp.float32
    assert (np.asarray(got.result) == 0).all()
    np.testing.assert_allclose(got.parameters, good.parameters, rtol=2e-4)
    np.testing.assert_allclose(got.standard_errors, good.standard_errors, rtol=1e-2)


def test_float64_with_64_bit_numbers_off_is_refused():
    with jax.enable_x64(False), pytest.raises(FitError, match="64"):
        fit_curves(Linear(), np.ones((1, 9)), np.ones(9), dtype=np.float64)


def test_wrong_shapes_and_weights_are_refused_in_one_line():
    p, f = np.ones((2, 9)), np.ones(9)
    for call, text in [
        (lambda: fit_curves(Linear(), p[0], f), "pads, samples"),
        (lambda: fit_curves(Linear(), p, f[:4]), "forces has shape"),
        (lambda: fit_curves(Linear(), p, f, groups=f[:3]), "groups has shape"),
        (lambda: fit_curves(Linear(), p, f, sigma=0.0), "above zero"),
        (lambda: fit_curves(Linear(), p.astype(str), f), "must be numbers"),
        (lambda: fit_curves(Linear(), np.ma.masked_equal(p, 1), f), "pressures is a masked array"),
        (lambda: fit_curve(Linear(), p, f), "pressure and force"),
    ]:
        with pytest.raises(FitError, match=text):
            call()


@pytest.mark.slow
def test_the_pure_fit_has_gradients():
    pressure, force = (a[:1, :60] for a in pads())
    samples, _ = make_samples(pressure, force)
    samples = jax.tree.map(lambda leaf: leaf[0], samples)

    @jax.jit
    def slope(shift):
        moved = eqx.tree_at(lambda s: s.force, samples, samples.force * (1 + shift))
        fit = fit_samples(Linear(), moved, Squared(), default_solver(jnp.float64), n_groups=0, iterations=1)
        return fit.parameters[0]

    # the slope is proportional to the force, so its derivative is itself
    np.testing.assert_allclose(jax.jit(jax.jacfwd(slope))(0.0), slope(0.0), rtol=1e-6)


# --- predictions ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("curve", [PowerLaw(2000.0), MonotoneSpline(), AffinePlay()], ids=lambda c: type(c).__name__)
@pytest.mark.parametrize("n_groups", [0, 225])
def test_many_pads_mapped_wait_for_no_thread(curve, n_groups):
    """See `jaxeit.linalg.lapack`."""
    kinds = (float, float, float, bool, int)
    many = jax.eval_shape(lambda: Samples(*(jnp.zeros((100_000, 900), kind) for kind in kinds)))
    solver = default_solver(jnp.float64)
    program = jax.vmap(lambda samples: fit_samples(curve, samples, SoftL1(), solver, n_groups=n_groups))
    assert not spread_stacks(jax.jit(program).lower(many).as_text())


def test_prediction_error_is_the_delta_method_and_extrapolation_is_flagged():
    pressure, force = (a[0] for a in pads(outliers=False))
    got = fit_curve(Affine(), pressure, force, loss=Squared())
    at = np.array([[100.0, 2000.0], [3900.0, 9000.0]])
    out = got.predict(at)
    variance = [[np.array([p, 1.0]) @ got.covariance @ np.array([p, 1.0]) for p in row] for row in at]
    np.testing.assert_allclose(out.standard_error, np.sqrt(variance), rtol=1e-8)
    np.testing.assert_allclose(out.force, got.parameters[0] * at + got.parameters[1], rtol=1e-12)
    assert out.valid.tolist() == [[True, True], [True, False]]
    assert not got.predict(jnp.nan).valid
    assert got.predict(9000.0, tolerance=2.0).valid


def test_batch_predictions_are_each_pads_own(fitted_power):
    pressure, _, fits = fitted_power
    out = predict_pads(fits, pressure)
    for i in range(3):
        own = fits.pad(i).predict(pressure[i])
        np.testing.assert_allclose(out.force[i], own.force, rtol=1e-12)
        np.testing.assert_allclose(out.standard_error[i], own.standard_error, rtol=1e-9)
    assert out.valid.all()


# --- held-out scores --------------------------------------------------------------------------------------------------


def test_folds_keep_groups_whole_and_are_always_alike():
    labels = np.array(["a", "b", "c", "d", "e", "f", "g"])[GROUPS % 7]
    fold = assign_folds(labels, 3)
    assert all(len(set(fold[labels == g])) == 1 for g in labels)
    assert sorted(np.unique(fold).tolist()) == [0, 1, 2]
    assert np.ptp([len(set(labels[fold == k])) for k in range(3)]) <= 1
    np.testing.assert_array_equal(fold, assign_folds(labels, 3))
    with pytest.raises(FitError, match="folds"):
        assign_folds([1, 1, 2], 3)


def test_metrics_by_hand_and_with_nothing_to_compare():
    assert rmse([1.0, 2.0, np.nan], [0.0, 4.0, 1.0]) == pytest.approx(np.sqrt(2.5))
    assert mae([1.0, 2.0], [0.0, 4.0]) == 1.5
    assert percent_full_scale(0.5, 20.0) == 2.5
    assert np.isnan(rmse([np.nan], [1.0]))
    assert np.isnan(percent_full_scale(0.5, 0.0))
    out = score([1.0, 2.0], [0.0, 4.0])
    assert (out.largest, out.n, out.percent_full_scale) == (2.0, 2, pytest.approx(100 * np.sqrt(2.5) / 4))


def test_time_split_splits_time_not_samples():
    first, rest = time_split(np.array([0, 1, 2, 3, 100]))
    assert first.tolist() == [True, True, True, True, False]
    assert (first ^ rest).all()


def simulated_log(n=400):
    rng = np.random.default_rng(8)
    load = 10 * (1 + np.sin(np.arange(n) / 15)) * np.linspace(0.6, 1.0, n)
    gains = np.array([5.0, -80.0, 0.0])
    signals = load[:, None] * gains + rng.normal(0, [20.0, 8.0, 5.0], (n, 3))
    force = load.copy()
    force[::7] = np.nan
    return np.arange(n) * 0.1, signals, force


@pytest.mark.slow
def test_log_is_fitted_on_its_first_half_only_and_missing_forces_are_counted():
    time, signals, force = simulated_log()
    best = fit_log(Linear(), time, signals, force, channels=BestChannel())
    blend = fit_log(Affine(), time, signals, force)
    assert best.source == "channel 1"
    assert best.missing == blend.missing == np.isnan(force).sum()
    assert best.train.n + best.held_out.n == np.isfinite(force).sum()
    for fit in (best, blend):
        assert fit.fitted.result == FitResult.SUCCESS
        assert fit.held_out.rmse < 0.2
        assert fit.held_out.rmse == pytest.approx(rmse(fit.predicted[200:], force[200:]))
    lied = np.where(np.arange(400) >= 200, 3 * force, force)
    np.testing.assert_array_equal(fit_log(Affine(), time, signals, lied).predicted, blend.predicted)
    with pytest.raises(FitError, match="no sample"):
        fit_log(Linear(), time, signals, force * np.nan)


def real(*parts):
    path = REAL_DATA.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"real recordings are not here: {path.name}")
    return path


@pytest.mark.slow
@pytest.mark.parametrize("log", ["Circle_1bar", "Circle_5bar", "O-ring257_3bar", "Stadium_1bar"])
def test_pneumatic_logs_are_predicted_within_their_friction(log):
    rows = np.genfromtxt(real("pneumatic_actuator", f"{log}.csv.gz"))
    fit = fit_log(Affine(), rows[:, 0], rows[:, 5] * 1e5, rows[:, 6])
    assert fit.fitted.result == FitResult.SUCCESS
    # friction hysteresis is what is left: force at one pressure depends on the direction
    assert fit.held_out.percent_full_scale < 4
    assert fit.held_out.rmse < 0.35 * np.std(rows[:, 6])


@pytest.mark.slow
def test_eflesh_is_fitted_without_its_missing_rows():
    folder = real("eflesh", "20250401_014340_probe")
    states = np.genfromtxt(folder / "states.csv", delimiter=",")
    sensor = np.genfromtxt(folder / "sensor_post_baselines.csv", delimiter=",")
    channels = np.stack([np.interp(states[:, 0], sensor[:, 0], c) for c in sensor[:, 1:].T], 1)
    force = np.where(states[:, 4] == -1, np.nan, states[:, 4] * 9.80665e-3)
    fit = fit_log(Affine(), states[:, 0], channels, force)
    assert fit.missing == 1740
    assert fit.held_out.rmse < 0.5
    assert fit_log(Affine(), states[:, 0], channels, force, channels=BestChannel()).held_out.rmse < 1.0


# --- choosing among candidates ---------------------------------------------------------------------------------------


def test_the_simplest_of_those_that_are_as_good_is_chosen_and_said():
    """Mean squares 9, 4.2, 4 +- 0.6 and one fit that failed: the second is within a standard error of the least."""
    squares = {"plain": [9.0, 9.0, 9.0], "bent": [4.2, 4.2, 4.2], "free": [3.0, 4.0, 5.0], "failed": [0.1, np.nan, 0.1]}
    tried = [Option(name, name, size) for size, name in ((9, "free"), (1, "plain"), (2, "failed"), (4, "bent"))]
    chosen, why, table = simplest("curve", tried, lambda name: np.array(squares[name]), "places")
    assert chosen == "bent"
    assert [(one.name, one.chosen) for one in table] == [
        ("plain", False), ("failed", False), ("bent", True), ("free", False),
    ]  # fmt: skip
    assert table[0].rmse == 3.0
    assert table[1].rmse is None
    spread = 1 / np.sqrt(3)
    np.testing.assert_allclose(table[2][3:6], np.sqrt([4.2, 4.2 - spread, 4.2 + spread]))  # of the difference
    np.testing.assert_allclose(table[3][3:6], [2.0, 2.0, 2.0])  # the best differs from itself by nothing
    assert why.startswith(
        "bent, the simplest within one standard error of the paired difference from the best (free); held-out RMSE"
    )
    assert "failed not determined" in why
    squares["bent"] = [4.7, 4.7, 4.7]
    assert simplest("curve", tried, lambda name: np.array(squares[name]), "places")[0] == "free"


@pytest.mark.slow
def test_where_there_is_no_choice_nothing_is_scored():
    assert simplest("curve", [Option(1, "one", 1)], lambda _: pytest.fail("scored"), "places") == (1, "", ())
