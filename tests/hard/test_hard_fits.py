"""Fits of samples that say little, or nothing, or lies: a right number, or none and the reason."""

from datetime import UTC, datetime

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

import calib
from calib.fitting.curves import (
    CURVES,
    Affine,
    AffinePlay,
    Linear,
    MonotonePolynomial,
    MonotoneSpline,
    Play,
    PowerLaw,
    fit_curves,
)
from calib.fitting.curves.base import scale_of
from calib.fitting.curves.covariance import cluster_covariance, independent_covariance, thin_svd
from calib.fitting.curves.fit import fill_gaps
from calib.fitting.curves.problem import residual_scale, residuals
from calib.fitting.curves.samples import make_samples
from calib.fitting.losses import Cauchy, Huber, SoftL1, Squared
from calib.fitting.results import FitError, FitResult
from calib.presses import PressError, find_presses
from calib.presses.corrections import CorrectionError, LowPass, sample_rate
from calib.session import PressTable, SessionError, SessionFacts, SessionWriter, StreamFacts

N = 96
SLOPE, NOISE = 4e-3, 0.05  # N/Pa, N


def line(seed=0):
    """Pressure and force of a pad that is a line, with noise."""
    rng = np.random.default_rng(seed)
    pressure = rng.uniform(50, 4000, N)
    return pressure, SLOPE * pressure + rng.normal(0, NOISE, N)


P, F = line()
ONE = np.where(np.arange(N) == 7, 1.0, np.nan)
TWO = np.where(np.arange(N) % 2, 1000.0, 3000.0)
HOPELESS = {  # pressure, force, results that may be told
    "dead pad": (np.zeros(N), F, {FitResult.NO_RESPONSE}),
    "no load": (P, np.zeros(N), {FitResult.NO_RESPONSE}),
    "nothing at all": (np.zeros(N), np.zeros(N), {FitResult.NO_RESPONSE}),
    "stuck sensor": (np.full(N, 2000.0), F, {FitResult.NO_RESPONSE}),
    "identical samples": (np.full(N, 2000.0), np.full(N, 8.0), {FitResult.NO_RESPONSE}),
    "one sample": (P * ONE, F * ONE, {FitResult.TOO_FEW}),
    "no sample": (P * np.nan, F, {FitResult.NOT_FINITE}),
    "all infinite": (P, np.full(N, np.inf), {FitResult.NOT_FINITE}),
    "upside down": (P, -F, {FitResult.NO_RESPONSE}),
}
SOUND = {"as it should be": (P, F), "a billionth": (1e-6 * P, 1e-9 * F), "a billionfold": (1e6 * P, 1e9 * F)}


PADS = len(SOUND) + len(HOPELESS)


def fitted(curve, rows, dtype="f8", **options):
    """Fits of these rows, and of copies of the last one up to a number of pads for which it is compiled already."""
    rows = [*rows, *[rows[-1]] * (PADS - len(rows))]
    pressure, force = (np.array([row[i] for row in rows], dtype) for i in (0, 1))
    return fit_curves(curve, pressure, force, **options)


def straightness(fits, pad, row):
    """Largest error of a curve fitted to a line, over the largest force."""
    at = np.linspace(np.nanmin(row[0]), np.nanmax(row[0]), 50)
    true = at * np.nanmedian(row[1] / row[0])
    got = fits.pad(pad).curve(fits.parameters[pad], jnp.asarray(at, fits.scale.dtype))
    return float(np.abs(np.asarray(got) - true).max() / true.max())


SOME = [("linear", "f8"), ("power", "f8")]
ALL = [(name, dtype) for name in CURVES for dtype in ("f8", "f4")]
KINDS = [pytest.param(*kind, marks=[] if kind in SOME else pytest.mark.slow) for kind in ALL]


@pytest.mark.parametrize(("name", "dtype"), KINDS)
def test_hopeless_samples_are_told_and_sound_ones_beside_them_fitted(name, dtype, hard):
    rows = [*SOUND.values(), *(row[:2] for row in HOPELESS.values())]
    fits = fitted(CURVES[name](), rows, dtype)
    for pad, (_, _, may) in enumerate(HOPELESS.values(), len(SOUND)):
        one = fits.pad(pad)
        assert FitResult(int(one.result)) in may
        assert np.isnan(one.covariance).all()
        assert not np.isinf(one.pressure_range).any()
        assert not one.predict(np.array([0.0, 2000.0])).valid.any()
        assert ": " in one.message()
    error = max(straightness(fits, pad, row) for pad, row in enumerate(SOUND.values()))
    assert error < 0.02
    assert (np.asarray(fits.result[: len(SOUND)]) == FitResult.SUCCESS).all()
    alone = fitted(CURVES[name](), [*SOUND.values(), *[(P, F)] * len(HOPELESS)], dtype)
    for mine, theirs in zip(jax.tree.leaves(fits), jax.tree.leaves(alone), strict=True):
        assert np.array_equal(mine[: len(SOUND)], theirs[: len(SOUND)])
    hard(
        "pads without a response beside good ones",
        "no sample, one, identical ones, dead, stuck, upside down; forces of 1e-9 to 1e9",
        **{"float64" if dtype == "f8" else "float32": error},
        beyond="that pad: result code with reason, covariance NaN, predictions not valid; other pads: the same bits",
    )


def test_a_slope_that_no_number_holds_is_told():
    fits = fitted(Linear(), [(1e-200 * P, 1e200 * F), (P, F)])
    assert fits.result.tolist()[:2] == [FitResult.NOT_FINITE, FitResult.SUCCESS]
    assert np.isnan(fits.parameters[0]).all()


# --- outliers ---------------------------------------------------------------------------------------------------------


def lied(share, seed=5):
    """A line, of which a share of samples read 3 to 40 N too much."""
    pressure, force = line(seed)
    rng = np.random.default_rng(seed)
    wrong = rng.permutation(N)[: int(share * N)]
    force[wrong] += rng.uniform(3, 40, len(wrong))
    return pressure, force


@pytest.mark.slow
def test_outliers_up_to_a_half(hard):
    """One-sided, the hardest: at a half nobody can tell which half is right."""
    shares = (0.0, 0.2, 0.3, 0.45, 0.5)
    rows = [lied(share) for share in shares]
    by = {kind: fitted(Linear(), rows, loss=kind()) for kind in (Cauchy, SoftL1, Squared)}
    errors = {kind: [abs(float(s) / SLOPE - 1) for s in fits.parameters[:, 0]] for kind, fits in by.items()}
    assert max(errors[Cauchy][:4]) < 0.01
    assert max(errors[SoftL1][:3]) < 0.02
    assert errors[Squared][1] > 0.2
    # past the edge the scatter that is stated tells: hundreds of times the noise
    assert np.asarray(by[Cauchy].scale)[4] > 100 * NOISE
    assert np.asarray(by[Cauchy].scale)[:4].max() < 5 * NOISE
    hard(
        "outliers all to one side",
        "45 % of the samples (Cauchy; 30 % with the default loss)",
        float64=max(errors[Cauchy][:4]),
        naive=errors[Squared][3],
        beyond="with half of the samples outliers, the curve follows either half; `scale` is that of the outliers",
    )


# --- forces near zero, bounds, what cannot be told --------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["f8", pytest.param("f4", marks=pytest.mark.slow)])
def test_a_power_law_through_forces_near_zero(dtype, hard):
    """The logarithms that the textbook fits know no zero and no negative force; here a fifth of them are."""
    rng = np.random.default_rng(3)
    pressure = np.concatenate([[0.0, 1e-12, -5.0], 4000 * rng.uniform(0, 1, N - 3) ** 6])
    clean = SLOPE * 2000 * (np.maximum(pressure, 0) / 2000) ** 1.5
    force = clean + rng.normal(0, NOISE, N)
    assert (force <= 0).sum() >= N // 6
    fits = fitted(PowerLaw(), [(pressure, clean), (pressure, force)], dtype)
    assert (np.asarray(fits.result)[:2] == FitResult.SUCCESS).all()
    assert np.isfinite(np.asarray(fits.covariance)[:2]).all()
    exponents = np.asarray(fits.parameters)[:2, 1]
    error = abs(exponents[0] / 1.5 - 1)
    assert error < (1e-6 if dtype == "f8" else 1e-3)
    assert abs(exponents[1] - 1.5) < 4 * float(fits.pad(1).standard_errors[1])
    assert abs(exponents[1] / 1.5 - 1) < 0.05
    kept = (pressure > 0) & (force > 0)
    naive = abs(np.polyfit(np.log(pressure[kept]), np.log(force[kept]), 1)[0] / 1.5 - 1)
    assert naive > 0.3
    hard(
        "power law through forces near zero",
        "a sixth of the forces zero or below; pressures from -5 to 1e-12 and 4e3 Pa",
        **{"float64" if dtype == "f8" else "float32": error},
        naive=naive,
        beyond="parameters with their standard errors",
    )


def test_a_curve_that_runs_to_its_bound_says_so():
    """A pad that stops rising: a monotone curve would need a slope of zero, which its logarithm never reaches."""
    pressure, _ = line()
    rows = [(pressure, SLOPE * np.minimum(pressure, 2000)), (pressure, SLOPE * np.maximum(pressure - 2000, 0)), (P, F)]
    rows.insert(2, (TWO, SLOPE * TWO))
    fits = fitted(MonotonePolynomial(), rows)
    told = [FitResult.AT_BOUND, FitResult.AT_BOUND, FitResult.SINGULAR, FitResult.SUCCESS]
    assert fits.result.tolist()[:4] == told
    assert "fewer parameters" in fits.pad(0).message()
    assert "more load levels" in fits.pad(2).message()
    assert np.isfinite(fits.parameters).all()


@pytest.mark.parametrize("dtype", ["f8", pytest.param("f4", marks=pytest.mark.slow)])
def test_a_slope_that_the_samples_want_just_below_zero_is_fitted_as_next_to_nothing(dtype):
    """As taxels of an insole do at small loads: the rest is as if that slope were zero."""
    pressure, _ = line()
    z = pressure / 4000
    force = 12 * (z**2 - 0.02 * z) + np.random.default_rng(1).normal(0, NOISE, N)
    fits = fitted(MonotonePolynomial(4000.0), [(pressure, force)], dtype, loss=Squared())
    one = fits.pad(0)
    assert one.result == FitResult.SUCCESS
    bernstein = np.stack([3 * z * (1 - z) ** 2, 3 * z**2 * (1 - z), z**3], 1) @ np.tri(3)
    best, wanted = nnls(bernstein, force)[0], np.linalg.lstsq(bernstein, force, rcond=None)[0]
    assert wanted[0] < 0 == best[0]
    np.testing.assert_allclose(one.parameters, best, atol=1e-4)
    assert np.isfinite(one.covariance).all()
    assert abs(wanted[0]) < 6 * float(one.standard_errors[0]) < 1
    assert one.predict(np.array([100.0, 3000.0])).valid.all()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["f8", "f4"])
@pytest.mark.parametrize("kind", [MonotoneSpline, Play, AffinePlay])
def test_other_curves_at_their_bounds(kind, dtype):
    pressure = 4000 * np.abs(np.sin(np.arange(N) / 11))
    rows = [(pressure, SLOPE * np.minimum(pressure, 2000)), (pressure, SLOPE * np.maximum(pressure - 2000, 0)), (P, F)]
    for result in fitted(kind(), rows, dtype).result.tolist()[:2]:
        assert result in (FitResult.SUCCESS, FitResult.AT_BOUND, FitResult.SINGULAR)


@pytest.mark.slow
def test_gain_and_offset_cannot_be_told_from_one_level():
    """Two levels settle a line; one level, however often pressed, does not."""
    level = 2000 + np.random.default_rng(0).normal(0, 1e-9, N)
    rows = [(TWO, SLOPE * TWO - 1.0), (level, SLOPE * level - 1.0), (np.full(N, 2000.0), np.full(N, 7.0))]
    fits = fitted(Affine(), rows)
    assert fits.result[0] == FitResult.SUCCESS
    np.testing.assert_allclose(fits.parameters[0], [SLOPE, -1.0], rtol=1e-9)
    for pad in (1, 2):
        assert fits.result[pad] in (FitResult.SINGULAR, FitResult.NO_RESPONSE)
        assert "more load levels" in fits.pad(pad).message()


# --- derivatives ------------------------------------------------------------------------------------------------------

FIXED = {
    "linear": (Linear(), [4e-3]),
    "affine": (Affine(), [4e-3, -2.0]),
    "softening": (PowerLaw(2000.0), [4e-3, 0.3]),
    "stiffening": (PowerLaw(2000.0), [4e-3, 2.7]),
    "polynomial": (MonotonePolynomial(4000.0), [2.0, 5.0, 12.0]),
    "polynomial at its bound": (MonotonePolynomial(4000.0), [0.0, 5.0, 0.0]),
    "spline": (MonotoneSpline(4000.0), [4e-3, 0.0, 3e-3, 6e-3, 0.0]),
    "play": (Play([150.0, 400.0, 900.0]), [3e-3, 4e-3, 5e-3, 8e-3]),
    "hysteresis": (AffinePlay([75.0, 150.0, 300.0]), [9e-3, 0.0, 4e-3, 3e-3, -2.0]),
}
KINKS = np.array([0.0, -0.0, 1e-300, -1e-300, 75, 150, 300, 400, 800, 900, 1000, 2000, 3000, 4000, 1e9, -1e9, 0, 0])


QUICK = [("softening", "f4"), ("polynomial at its bound", "f8"), ("spline", "f8")]
SLOPES = [(name, dtype) for name in FIXED for dtype in ("f8", "f4")]


@pytest.mark.parametrize(
    ("name", "dtype"), [pytest.param(*case, marks=[] if case in QUICK else pytest.mark.slow) for case in SLOPES]
)
def test_first_and_second_derivatives_are_finite_at_every_kink(name, dtype):
    curve, params = FIXED[name]
    at, p = jnp.asarray(KINKS, dtype), jnp.asarray(params, dtype)

    @jax.jit
    def derivatives(p, at):
        def total(params, pressure):
            return jnp.sum(curve(params, pressure))

        return jax.grad(total, (0, 1))(p, at), jax.hessian(total)(p, at), jax.jacfwd(jax.grad(total, 1), 0)(p, at)

    for part in jax.tree.leaves(derivatives(p, at)):
        assert part.dtype == dtype
        assert np.isfinite(part).all()


@pytest.mark.parametrize("dtype", ["f8", "f4"])
@pytest.mark.parametrize("loss", [Cauchy(), Huber(), SoftL1(), Squared()], ids=lambda loss: type(loss).__name__)
def test_losses_have_slopes_at_nothing_and_far_away(loss, dtype):
    width = float(getattr(loss, "width", 1.0))
    left = jnp.asarray([0.0, 1e-30, 1e-3 * width, width, -width, 1e8, -1e8], dtype)
    for derive in (jax.grad, lambda f: jax.grad(jax.grad(f))):
        slopes = jax.jit(jax.vmap(derive(lambda r: loss.transform(r))))(left)
        assert np.isfinite(slopes).all()


def test_samples_that_only_fill_up_have_no_slope():
    """Not forwards and not backwards, as solvers with iterations inside go."""
    samples = jax.tree.map(lambda leaf: leaf[0], make_samples([[1000.0, 2000.0]], [[4.0, 8.0]], length=64)[0])
    scale = scale_of(samples.pressure, samples.force, samples.valid)
    slope = jax.grad(lambda free: jnp.sum(residuals(free, Linear(), samples, scale, 1.0)))(jnp.zeros(1))
    assert len(samples.valid) > 2
    assert np.isfinite(slope).all()


def test_the_scatter_of_exact_samples_is_above_zero_and_of_others_theirs():
    def scatter(force):
        samples = jax.tree.map(lambda leaf: leaf[0], make_samples([[1.0, 2.0, 4.0]], [force], length=64)[0])
        return residual_scale(
            jnp.zeros(1), Linear(), samples, scale_of(*[jnp.asarray([1.0, 2.0, 4.0])] * 2, jnp.ones(3) > 0)
        )

    assert 0 < scatter([1.0, 2.0, 4.0]) < 1e-5
    assert float(scatter([2.0, 1.0, 5.0])) == pytest.approx(1.4826, rel=1e-4)


def test_a_pressure_is_held_through_a_gap():
    there = jnp.array([False, True, False, True])
    np.testing.assert_array_equal(fill_gaps(jnp.array([np.nan, 1, np.nan, 3]), there), [0, 1, 1, 3])


def test_presses_that_alone_decide_or_are_outweighed_by_outliers_are_too_few():
    even, alone, ones = jnp.full((8, 1), 8**-0.5), jnp.eye(8)[:, :1], jnp.ones(8)
    for left, dpsi, enough in ((even, ones, True), (alone, ones, False), (even, ones.at[4:].set(-1), False)):
        assert bool(cluster_covariance(left, ones, dpsi, jnp.arange(8), 8)[1]) == enough


def test_the_covariance_of_independent_samples_is_hubers():
    """Written out, for one parameter; the last sample is not one."""
    dpsi, valid = jnp.array([1.0, 1, 1, 1, 1, 1, 0, 0, 0]), jnp.arange(9) < 8
    mean, scatter = 0.75, 0.1875
    expected = ((1 + scatter / (8 * mean**2)) / mean) ** 2 * 8 / 7
    weight = valid.astype(float)
    found = independent_covariance(weight[:, None] * 8**-0.5, weight, dpsi, valid)
    np.testing.assert_allclose(found, [[expected]], rtol=1e-12)


@pytest.mark.slow
def test_a_slope_from_one_press_among_many_is_told():
    """All presses at one level but one, which alone decides the slope: no scatter says how well."""
    level = np.where(np.arange(N) < N // 8, 3000.0, 1000.0)
    fits = fit_curves(Affine(), level[None], SLOPE * level[None] + F - SLOPE * P, groups=np.arange(N) // (N // 8))
    assert fits.result.tolist() == [FitResult.SINGULAR]
    assert np.isnan(fits.covariance).all()


def test_columns_that_are_almost_alike_are_told_apart():
    """To rounding: done once, Gram-Schmidt leaves them at an angle of rounding over their difference."""
    x = np.linspace(0, 1, 50)
    matrix = jnp.asarray(np.stack([np.ones(50), 1 + 1e-9 * x, 1 + 1e-9 * x**2], 1))
    left, singular, right = thin_svd(matrix)
    np.testing.assert_allclose(left.T @ left, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(left * singular @ right, matrix, rtol=1e-14)
    empty = matrix.at[:, 1].set(0)
    left, singular, right = thin_svd(empty)
    np.testing.assert_allclose(left * singular @ right, empty, atol=1e-14)


def test_a_textbook_power_law_has_none():
    def textbook(b, p):
        return 4e-3 * 2000 * jnp.maximum(p / 2000, 0) ** b

    assert not np.isfinite(jax.grad(textbook, 1)(0.3, 0.0))
    assert np.isfinite(jax.grad(lambda p: PowerLaw(2000.0)(jnp.array([4e-3, 0.3]), p))(0.0))


# --- clocks -----------------------------------------------------------------------------------------------------------


def test_clocks_that_repeat_or_jump_back_are_refused_or_not_filtered_across():
    time = np.arange(400) * 10_000_000
    wave = np.sin(np.arange(400) / 10.0)
    back, twice = time.copy(), np.repeat(time[:200], 2)
    back[200:] -= 3_600_000_000_000
    for bad, at in ((back, 200), (twice, 1)):
        with pytest.raises(PressError, match=f"does not increase at sample {at}: sort"):
            find_presses(bad, wave)
    most = time.copy()
    most[1:350] = time[0]
    for wrong in (most, time[::-1]):
        with pytest.raises(CorrectionError, match="repeat or go back"):
            sample_rate(wrong)
    step = np.repeat([0.0, 1.0], 200)[:, None]
    np.testing.assert_allclose(LowPass(20.0).apply(back, step), step, atol=1e-12)


# --- sessions of next to nothing --------------------------------------------------------------------------------------


def session_of(path, skin, presses):
    """A session with the skin's streams and this many presses, of 20 N on the first pad."""
    count, rate = int(4e9 * max(presses, 1)), 20_000_000
    time = np.arange(0, count, rate)
    start = 4_000_000_000 * np.arange(presses) + 1_000_000_000
    held = ((time[:, None] >= start) & (time[:, None] < start + 2_000_000_000)).any(1)
    rng = np.random.default_rng(0)
    ends = np.full(presses, 0.05)
    table = PressTable(
        *(ends, ends, ends * 0.4, ends * 400),
        *(start, start + 100_000_000, start + 1_900_000_000, start + 2_000_000_000),
        *(np.zeros(presses, int), np.ones(presses, bool), ("",) * presses),
    )
    about = {"title": "", "skin_name": skin.name, "skin_toml": skin.toml, "epoch": datetime(2025, 1, 1, tzinfo=UTC)}
    with SessionWriter(path, SessionFacts(**about, pattern=skin.protocol.pattern, current=1e-3)) as writer:
        for name, variable, units, gain in (
            ("eit", "voltage", "V", np.full(550, 1e-3)),
            ("pressure", "pressure", "Pa", np.array([2000.0, 0, 0, 0])),
            ("force", "force", "N", np.array([20.0])),
        ):
            writer.add_stream(name, StreamFacts(variable, units=units, channels=len(gain), rate_hz=50))
            writer.append(name, time, held[:, None] * gain + 1e-6 * rng.normal(size=(len(time), len(gain))))
        writer.set_presses(table)
    return path


@pytest.mark.parametrize(("presses", "said"), [(0, "no stage stream"), (1, "pad 1 .*press")])
def test_a_session_of_no_press_or_one_is_one_clear_line(presses, said, skin, tmp_path):
    path = session_of(tmp_path / "few.h5", skin, presses)
    with calib.open_session(path) as session, pytest.raises(ValueError, match=said) as caught:
        calib.calibrate([session])
    assert isinstance(caught.value, SessionError | FitError)
    assert "\n" not in str(caught.value)
