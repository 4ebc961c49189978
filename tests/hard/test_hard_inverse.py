"""Images at the edges of what can be computed: each beside the naive form, which fails there."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.optimize import nnls

import jaxeit as je
from jaxeit.imaging.hyperparameters import spectrum
from jaxeit.imaging.inputs import InverseError
from jaxeit.imaging.methods import Problem
from jaxeit.imaging.preparation import check_range
from jaxeit.model.bases import Picture

from ..helpers import require_identical, square_model

SIDE = 6
EPS = {"float64": float(np.finfo(np.float64).eps), "float32": float(np.finfo(np.float32).eps)}
PRIORS = {"Noser": je.Noser(), "Laplace": je.Laplace(), "Gaussian": je.GaussianSmooth(0.03)}
EXTENDED = np.finfo(np.longdouble).eps < 1e-18
extended = pytest.mark.skipif(not EXTENDED, reason="the oracle needs a long double of more than 53 bits")


def _picture(dtype):
    number = np.arange(SIDE**2).reshape(SIDE, SIDE)
    pairs = [(number[:, :-1], number[:, 1:]), (number[:-1], number[1:])]
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in pairs])
    x, y = np.meshgrid(*2 * [(np.arange(SIDE) + 0.5) * 0.2 / SIDE])
    areas, sides = np.full(SIDE**2, (0.2 / SIDE) ** 2), np.full(len(edges), 0.2 / SIDE)
    centres, areas, sides = (jnp.asarray(a, dtype) for a in (np.stack([x.ravel(), y.ravel()], 1), areas, sides))
    return Picture(centres, areas, jnp.asarray(edges, jnp.int32), sides, (SIDE, SIDE), (0.0, 0.2, 0.0, 0.2))


def _problem(j, hyperparameter, prior=PRIORS["Noser"], dtype="float64", readings=40.0):
    numbers = (jnp.asarray(a, dtype) for a in (j, readings, hyperparameter))
    return Problem(*numbers, prior, _picture(dtype))


def _spread(rows, least=1e-13, rank=None):
    """A Jacobian whose singular values fall from 1 to ``least`` as the testbed's do, the others zero to rounding."""
    rng = np.random.default_rng(rows)
    rank = rank or min(rows, SIDE**2)
    u, v = (np.linalg.qr(rng.normal(size=(n, n)))[0][:, :rank] for n in (rows, SIDE**2))
    s = np.geomspace(1, least, rank)
    return (u * s) @ v.T, (u, s, v)


_imaged = jax.jit(lambda method, problem, y: method.image(problem, y))


def _error(found, exact):
    """Largest error over the largest value; not a number: without bound."""
    error = float(np.abs(np.asarray(found, np.longdouble) - exact).max() / np.abs(exact).max())
    return error if np.isfinite(error) else np.inf


# --- the oracle, in long double ----------------------------------------------------------------------------------


def _root(matrix):
    """Lower Cholesky factor."""
    a, n = np.array(matrix, np.longdouble), len(matrix)
    for k in range(n):
        a[k:, k] /= np.sqrt(a[k, k])
        a[k + 1 :, k + 1 :] -= np.outer(a[k + 1 :, k], a[k + 1 :, k])
    return np.tril(a)


def _least_squares(a, y):
    """By Householder's reflections."""
    a, y = np.array(a, np.longdouble), np.array(y, np.longdouble)
    n = a.shape[1]
    for k in range(n):
        v = a[k:, k].copy()
        v[0] += np.copysign(np.sqrt(v @ v), v[0])
        v /= np.sqrt(v @ v)
        a[k:, k:] -= 2 * np.outer(v, v @ a[k:, k:])
        y[k:] -= 2 * v * (v @ y[k:])
    x = np.zeros(n, np.longdouble)
    for k in reversed(range(n)):
        x[k] = (y[k] - a[k, k + 1 :] @ x[k + 1 :]) / a[k, k]
    return x


def _whitened(problem):
    """``J Gamma^-1`` and ``Gamma^-1``."""
    precision, j = problem.precision(), np.array(problem.jacobian, np.longdouble)
    if isinstance(problem.prior, je.GaussianSmooth):
        back = _root(precision.values)
    else:
        lower = _root(precision.matrix())
        back = np.stack([_least_squares(lower.T, unit) for unit in np.eye(len(lower))], 1)
    return j @ back, back


def _damped(b, hyperparameter, y):
    level = hyperparameter * np.sqrt((b**2).sum() / 40)
    return _least_squares(np.concatenate([b, level * np.eye(b.shape[1])]), np.append(y, np.zeros(b.shape[1])))


def naive(problem, y):
    """The formula as it stands."""
    j, r = (np.asarray(a, float) for a in (problem.jacobian, problem.precision().matrix()))
    strength = float(problem.hyperparameter) ** 2 * np.trace(j @ np.linalg.solve(r, j.T)) / 40
    return np.linalg.inv(j.T @ j + strength * r) @ j.T @ y


# --- lambda ------------------------------------------------------------------------------------------------------


BELOW = "an error that names the range; provenance['rank'] counts the directions that the image follows"


@extended
@pytest.mark.parametrize("rows", [20, 50])
@pytest.mark.parametrize("name", PRIORS)
def test_lambda_to_zero_costs_digits_one_by_one(hard, name, rows):
    """Rounding is amplified by 1 / lambda; by squares, as in the formula as it stands, by 1 / lambda^2.

    Squares serve only where they keep three quarters of the digits.
    """
    j, y = _spread(rows)[0], np.random.default_rng(1).normal(size=rows)
    worst = dict.fromkeys([*EPS, "naive"], 0.0)
    for h in 10.0 ** -np.arange(1, 12):
        problem = _problem(j, h, PRIORS[name])
        b, back = _whitened(problem)
        exact = back @ _damped(b, h, y)
        worst["naive"] = max(worst["naive"], _error(naive(problem, y), exact))
        for dtype, eps in EPS.items():
            if h >= 8e3 * eps:
                found = _imaged(je.OneStep(), _problem(j, h, PRIORS[name], dtype), jnp.asarray(y, dtype))
                error = _error(found, exact)
                assert error < max(100 * eps / h, eps**0.75), (dtype, h)
                worst[dtype] = max(worst[dtype], error)
    assert worst["naive"] > 1
    hard(
        "hyperparameter to zero",
        "1e-1 to 1e-11, float32 to 1e-3; singular values to 1e-13",
        **worst,
        beyond=BELOW,
    )


@extended
@pytest.mark.parametrize("rows", [20, 50])
def test_what_is_left_uncertain_at_small_lambda(rows):
    """(J^T J + l^2 R)^-1 in long double; 1 / l^2 times a difference of ones loses it where pixels are few."""
    j, h = _spread(rows, 1e-4)[0], 1e-5
    b, back = _whitened(_problem(j, h))
    inner = _root(b.T @ b + h**2 * (b**2).sum() / 40 * np.eye(SIDE**2))
    exact = np.sum(np.stack([_least_squares(inner, column) for column in back], 1) ** 2, 0)
    found = np.asarray(je.OneStep().variance(_problem(j, h)), float)
    np.testing.assert_allclose(found, exact.astype(float), rtol=1e-5)


@extended
def test_greit_to_zero(hard):
    j, y = _spread(20)[0], np.random.default_rng(1).normal(size=20)
    picture, worst = _picture("float64"), 0.0
    centres = np.asarray(picture.centres, np.longdouble)
    distance = np.sqrt(((centres[:, None] - centres) ** 2).sum(-1))
    contacts = np.exp(-0.5 * (distance / np.longdouble(0.012)) ** 2)
    disc = 1 / (1 + np.exp((distance - np.longdouble(0.02)) / np.longdouble(0.004)))
    desired = disc * contacts.sum(0) / disc.sum(0)
    trained = j @ contacts
    for h in 10.0 ** -np.arange(1, 12):
        exact = desired @ _damped(trained, h, y)
        error = _error(_imaged(je.Greit(), _problem(j, h), jnp.asarray(y)), exact)
        assert error < 1e3 * EPS["float64"] / h
        worst = max(worst, error)
    hard("hyperparameter to zero", "GREIT to 1e-11", float64=worst, beyond=BELOW)


def truncated_by_squares(j, level, y):
    """The eigenvectors of J J^T with eigenvalues above level^2."""
    squares, vectors = np.linalg.eigh(j @ j.T)
    kept = squares > level**2
    return j.T @ ((vectors[:, kept] / squares[kept]) @ (vectors[:, kept].T @ y))


def test_truncation_to_zero_is_the_pseudo_inverse_of_what_is_not_rounding(hard):
    j, (u, s, v) = _spread(20, 1e-6, rank=9)
    y = np.random.default_rng(1).normal(size=20)
    exact, worst, spoilt = (v / s) @ (u.T @ y), 0.0, 0.0
    for h in (1e-7, 1e-9, 2e-12, 1e-16):
        found = _imaged(je.TruncatedSvd(), _problem(j, h, je.Tikhonov()), jnp.asarray(y))
        worst = max(worst, _error(found, exact))
        spoilt = max(spoilt, _error(truncated_by_squares(j, h * np.sqrt((s**2).sum() / 40), y), exact))
    assert worst < 1e-8
    assert spoilt > 1
    told = "the pseudo-inverse on all singular values above rounding"
    hard("truncated SVD to zero", "rank 9 of 20, threshold 1e-16", float64=worst, naive=spoilt, beyond=told)


@extended
@pytest.mark.parametrize("rows", [20, 50])
@pytest.mark.parametrize("dtype", EPS)
def test_lambda_to_infinity_is_back_projection_through_the_prior(hard, dtype, rows):
    j, y = _spread(rows, 1e-2)[0], np.random.default_rng(1).normal(size=rows)
    error = 0.0
    for h in (1e1, 1e2, 1e3, 1e4):
        problem = _problem(j, h, dtype=dtype)
        b, back = _whitened(_problem(j, h))
        exact = back @ _damped(b, h, y)
        found = _imaged(je.OneStep(), problem, jnp.asarray(y, dtype))
        error = max(error, _error(found, exact))
        assert error < 10 * h * EPS[dtype]
    assert _error(exact, j.T @ y / (b**2).sum() * 40 / h**2 / np.asarray(problem.precision().values)) < 1e-5
    assert not np.asarray(_imaged(je.TruncatedSvd(), problem, jnp.asarray(y, dtype))).any()
    assert np.abs(_imaged(je.Greit(), problem, jnp.asarray(y, dtype))).max() < 1e-4
    said = "the image of back projection through the prior, fading to zero; above 1e4 an error"
    hard("hyperparameter to infinity", "1e1 to 1e4", **{dtype: error}, beyond=said)


@pytest.mark.parametrize("h", [0.0, -1.0, 1e-13, 2e4, 1e300, float("inf"), float("nan")])
def test_a_lambda_without_digits_is_refused(model, pixels, h):
    with pytest.raises(InverseError, match=r"above zero, for OneStep in float64 from 1.8e-12 to 1e\+04"):
        je.prepare(model, basis=pixels, hyperparameter=h)


def test_what_is_refused_follows_precision_and_method():
    check_range(1e-6, je.OneStep(), np.dtype("float64"))
    for h, method, dtype in ((1e-4, je.OneStep(), "float32"), (1e-7, je.NonNegative(), "float64")):
        with pytest.raises(InverseError, match=f"{type(method).__name__} in {dtype}"):
            check_range(h, method, np.dtype(dtype))


@pytest.mark.parametrize("dtype", EPS)
def test_no_square_is_negative(dtype):
    """Fifty readings of 36 pixels: fourteen eigenvalues are zero, which rounding leaves on either side."""
    j = np.random.default_rng(7).normal(size=(50, SIDE**2))
    found = spectrum(_problem(j, 0.1, dtype=dtype))
    assert float(found.squares.min()) == 0
    assert np.linalg.eigvalsh(j.astype(dtype) @ j.T.astype(dtype)).min() < 0


# --- rank --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recon(model, pixels):
    return je.prepare(model, basis=pixels)


@pytest.fixture(scope="module")
def jac(model, pixels):
    return np.asarray(je.jacobian(model, basis=pixels))


def test_the_rank_is_told_and_never_above_what_four_terminals_hold(model, pixels, recon, jac):
    """L (L - 3) / 2 numbers of 550 readings; of which the image follows tr(J Q)."""
    assert np.linalg.matrix_rank(jac, 1e-10 * np.linalg.norm(jac, 2)) <= 275
    followed, held = recon.provenance["rank"].split(" of ")
    assert int(held) == 25 * 22 // 2
    assert float(followed) == pytest.approx(np.trace(jac @ np.asarray(recon.matrix)), rel=5e-3)
    sharp = je.prepare(model, basis=pixels, hyperparameter=1e-9)
    assert float(sharp.provenance["rank"].split()[0]) > 2 * float(followed)
    assert np.isfinite(sharp.matrix).all()


# --- pixels that nothing sees, channels that say nothing ---------------------------------------------------------

METHODS = {
    "one step": je.OneStep(),
    "truncated": je.TruncatedSvd(),
    "back projection": je.imaging.BackProjection(),
    "GREIT": je.Greit(),
    "not negative": je.NonNegative(),
    "reweighted": je.Reweighted(),
    "sparse": je.SparseBayes(),
}


@pytest.mark.parametrize("name", METHODS)
def test_pixels_that_no_reading_sees_stay_dark_and_harm_none(hard, name):
    """Under a bolt, in a corner: columns of zeros.  NOSER without its floor divides by them."""
    rng = np.random.default_rng(2)
    j, y = rng.normal(size=(20, SIDE**2)), rng.normal(size=20)
    j[:, 7], j[:, 8] = 0, 1e-9 * j[:, 8]
    r = np.linalg.norm(j, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        unfloored = j.T / r[:, None] @ np.linalg.solve(j / r @ j.T + np.eye(20), y)
    assert not np.isfinite(unfloored).all()
    for dtype in EPS:
        image = np.asarray(_imaged(METHODS[name], _problem(j, 0.1, dtype=dtype), jnp.asarray(y, dtype)))
        assert np.isfinite(image).all()
        if name != "GREIT":  # its desired images are discs, which reach into their neighbours
            assert np.abs(image[[7, 8]]).max() < 1e-4 * np.abs(image).max()
    said = "the pixel stays at zero"
    hard("pixels without sensitivity", "columns 0 and 1e-9", float64=0, float32=0, naive=np.nan, beyond=said)


TO_THE_END = {
    "not negative": (je.NonNegative(), je.Noser()),
    "interior point": (je.NonNegative(100), je.Laplace()),
    "variation": (je.Reweighted(), je.TotalVariation()),
    "sparse": (je.SparseBayes(100), je.Noser()),
}


@pytest.mark.parametrize("name", TO_THE_END)
def test_nothing_makes_no_image_and_what_fits_exactly_one(name):
    """Readings of zero; and those of one pixel without noise, in many more steps than it takes."""
    method, prior = TO_THE_END[name]
    j = np.random.default_rng(5).normal(size=(20, SIDE**2))
    for dtype in EPS:
        problem = _problem(j, 0.1, prior, dtype)
        nothing, image = (
            np.asarray(_imaged(method, problem, y)) for y in (jnp.zeros(20, dtype), problem.jacobian[:, 14])
        )
        assert np.isfinite(image).all()
        assert np.argmax(image) == 14
        assert np.abs(nothing).max() <= (1e-6 if name == "interior point" else 0) * image.max()
        if isinstance(method, je.NonNegative):
            assert image.min() >= 0


def test_what_may_not_be_negative_is_not_before_its_end_either():
    rng = np.random.default_rng(8)
    problem = _problem(rng.normal(size=(20, SIDE**2)), 0.1)
    assert np.asarray(_imaged(je.NonNegative(1), problem, jnp.asarray(rng.normal(size=20)))).min() == 0


def _by_nnls(problem, y):
    """By an active-set method."""
    precision = problem.precision()
    root = np.sqrt(problem.strength(precision.solve(problem.jacobian.T)) * precision.values)
    return nnls(np.concatenate([problem.jacobian, np.diag(root)]), np.append(y, np.zeros(SIDE**2)))[0]


def _by_whole_steps(problem, y):
    """Forty steps of Newton's method, which end after a few or never."""
    j, precision = np.asarray(problem.jacobian), problem.precision()
    weight = np.asarray(problem.strength(precision.solve(problem.jacobian.T)) * precision.values)
    above = np.ones(SIDE**2, bool)
    for _ in range(40):
        left = np.linalg.solve(np.eye(len(j)) + j * (above / weight) @ j.T, y)
        above = j.T @ left > 0
    return np.maximum(j.T @ left / weight, 0)


def test_what_may_not_be_negative_ends_at_any_lambda(hard):
    """Newton's method alone takes hundreds of steps at 1e-3, with a line search; without one it goes in circles."""
    j, ys = _spread(20, 1e-3)[0], np.random.default_rng(0).normal(size=(3, 20))
    cases = [(_problem(j, h), y) for h in np.logspace(-5, 2, 8) for y in ys]
    single = [(_problem(j, h, dtype="float32"), y) for h in (0.02, 1, 100) for y in ys]

    def error(problem, y):
        return _error(_imaged(je.NonNegative(), problem, jnp.asarray(y, problem.jacobian.dtype)), _by_nnls(problem, y))

    worst, worst32 = max(error(*case) for case in cases), max(error(*case) for case in single)
    whole = max(_error(_by_whole_steps(*case), _by_nnls(*case)) for case in cases)
    assert worst < 1e-5
    assert worst32 < 1e-2
    assert whole > 1
    reached, said = "lambda 1e-5 to 100 (float32: 0.02)", "below 5e-7 (float32: 1e-2) an error that names the range"
    hard("images that may not be negative", reached, float64=worst, float32=worst32, naive=whole, beyond=said)


def test_a_sheet_around_a_hole_has_a_noise_figure():
    """In whose middle no reading sees anything: the nearest place on the sheet is taken."""
    hole = np.isin(np.arange(SIDE**2), [14, 15, 20, 21])
    problem = _problem(np.random.default_rng(7).normal(size=(20, SIDE**2)) * ~hole, 1, je.Tikhonov())
    problem = replace(problem, picture=replace(problem.picture, areas=jnp.where(hole, 0, problem.picture.areas)))
    assert 1e-4 < je.NoiseFigure(1).choose(spectrum(problem), lambda frames: frames) < 100


@pytest.mark.parametrize("prior", [je.Tikhonov(), je.GaussianSmooth(0.03)])
def test_pixels_beside_the_sheet_have_a_prior_too(prior):
    rng, inside = np.random.default_rng(6), np.arange(SIDE**2) < 30
    problem = _problem(rng.normal(size=(20, SIDE**2)) * inside, 0.1, prior)
    problem = replace(problem, picture=replace(problem.picture, areas=jnp.where(inside, problem.picture.areas, 0)))
    assert np.isfinite(_imaged(je.OneStep(), problem, jnp.asarray(rng.normal(size=20)))).all()


@pytest.mark.parametrize("prior", [je.Laplace(), je.TotalVariation()])
def test_pixels_without_neighbours_have_a_prior_too(prior):
    picture = _picture("float64")
    picture = replace(picture, edges=picture.edges[:0], edge_length=picture.edge_length[:0])
    np.testing.assert_allclose(prior.precision(jnp.zeros((1, SIDE**2)), picture).solve(jnp.ones(SIDE**2)), 1e3)


@pytest.mark.parametrize("greit", [je.Greit(), je.Greit(radius=1e-3, edge=1e-5)])
def test_pixels_beside_the_sheet_teach_greit_nothing(greit):
    """The image of the others is as if they were not; a disc that does not reach the sheet is no image."""
    rng, inside = np.random.default_rng(6), np.arange(SIDE**2) < 30
    whole = _problem(rng.normal(size=(20, SIDE**2)) * inside, 0.1)
    whole = replace(whole, picture=replace(whole.picture, areas=jnp.where(inside, whole.picture.areas, 0)))
    part = replace(whole.picture, centres=whole.picture.centres[inside], areas=whole.picture.areas[inside])
    part, y = replace(whole, jacobian=whole.jacobian[:, inside], picture=part), jnp.asarray(rng.normal(size=20))
    image = np.asarray(_imaged(greit, whole, y))
    assert np.isfinite(image).all()
    assert _error(image[inside], np.asarray(_imaged(greit, part, y))) < 1e-12


@pytest.mark.parametrize(
    ("dtype", "unit"), [("float64", 1e60), ("float64", 1e-60), ("float32", 1e8), ("float32", 1e-8)]
)
@pytest.mark.parametrize("name", METHODS)
def test_units_do_not_matter(hard, name, dtype, unit):
    """Readings of another unit, Jacobian with them: the same image.  And an image grows with its readings."""
    rng = np.random.default_rng(3)
    j, y = rng.normal(size=(20, SIDE**2)), rng.normal(size=20)
    one = np.asarray(_imaged(METHODS[name], _problem(j, 0.1), jnp.asarray(y)))
    other = _imaged(METHODS[name], _problem(unit * j, 0.1, dtype=dtype), jnp.asarray(unit * y, dtype))
    grown = _imaged(METHODS[name], _problem(j, 0.1, dtype=dtype), jnp.asarray(unit * y, dtype))
    error = max(_error(other, one), _error(np.asarray(grown, float) / unit, one))
    assert error < (1e-9 if dtype == "float64" else 2e-2)
    said = "the same image"
    hard("units of the readings", "times 1e-60 to 1e60, float32 1e-8 to 1e8", **{dtype: error}, beyond=said)


@pytest.mark.slow
def test_a_baseline_of_zero_divides_nothing(hard, model, pixels, recon, jac):
    """Four-terminal baselines run through zero: dv / v0 makes the noise of those readings all there is."""
    v0 = np.asarray(je.forward(model))
    assert np.abs(v0).min() < 2e-3 * np.abs(v0).max()
    place = jnp.array([0.03, 0.1])
    square, there = (jnp.sum((at - place) ** 2, -1) for at in (model.centroids, pixels.centres))
    clean = np.asarray(je.forward(model, model.background * (1 + 0.3 * jnp.exp(-0.5 * square / 0.012**2)))) - v0
    dv = clean + 1e-3 * np.std(clean) * np.random.default_rng(0).normal(size=550)

    def normalised(baseline):
        with np.errstate(divide="ignore", invalid="ignore"):
            j, y = jac / baseline[:, None], dv / baseline
            r = np.linalg.norm(j, axis=0)
            small = j / r @ j.T + 0.1**2 * (j**2 / r).sum() / 550 * np.eye(550)
            return j.T / r[:, None] @ np.linalg.solve(small, y)

    touched_zero = np.where(np.arange(550) == np.argmin(np.abs(v0)), 0.0, v0)  # as noise, or a converter, may have it
    assert not np.isfinite(normalised(touched_zero)).any()
    images = recon(dv), jnp.asarray(normalised(v0))
    away, lost = (float(je.localisation_error(je.LevelCentroid(0.5)(x, recon), place)) for x in images)
    truth = jnp.exp(-0.5 * there / 0.012**2)
    unlike, spoilt = (1 - float(je.metrics.image_correlation(x, truth, pixels.areas)) for x in images)
    assert away < 3e-3 < 9e-3 < lost
    assert unlike < 0.15 < 0.3 < spoilt
    said = "nothing: readings are weighed by their noise, never by v0. Errors are one minus the image's correlation"
    hard("four-terminal baseline of zero", "|v0| to 0; noise 60 dB", float64=unlike, naive=spoilt, beyond=said)


# --- frames with gaps, by the one program of a recording of four ------------------------------------------------


def _kept(jac, pixels, kept, dv, hyperparameter=0.1):
    """The image of these readings alone; prior and strength of all."""
    r = np.asarray(je.Noser().precision(jnp.asarray(jac), pixels.picture).values)
    strength = hyperparameter**2 * (jac**2 / r).sum() / len(jac)
    j = jac[kept]
    return j.T / r[:, None] @ np.linalg.solve(j / r @ j.T + strength * np.eye(len(j)), dv[kept])


BAD = np.array([np.nan, np.inf, -np.inf])


def test_any_gaps_at_any_scale(recon, jac, pixels):
    matrix, on_host = np.asarray(recon.matrix), recon.on_host()

    @settings(max_examples=10, derandomize=True, database=None, deadline=None)
    @given(st.integers(0, 2**31), st.integers(1, 549), st.integers(-100, 100))
    def holds(seed, dead, scale):
        rng = np.random.default_rng(seed)
        dv, gone = rng.normal(size=550), rng.permutation(550)[:dead]
        broken = dv.copy()
        broken[gone] = rng.choice(BAD, dead)
        exact = _kept(jac, pixels, np.setdiff1d(np.arange(550), gone), dv)
        for apply in (recon, on_host):
            assert _error(np.asarray(apply(10.0**scale * broken)) / 10.0**scale, exact) < 1e-7
        with np.errstate(invalid="ignore"):
            assert not np.isfinite(matrix @ broken).any()  # by the matrix one gap poisons every pixel

    holds()


@pytest.mark.parametrize("left", [0, 1, 3, 30, 549])
def test_all_channels_dead_but_few(hard, recon, jac, pixels, left):
    rng = np.random.default_rng(left)
    dv, kept = rng.normal(size=550), np.sort(rng.permutation(550)[:left])
    broken = np.where(np.isin(np.arange(550), kept), dv, np.nan)
    images = [np.asarray(apply(broken)) for apply in (recon, recon.on_host())]
    if not left:
        assert not np.any(images)
        return
    exact = _kept(jac, pixels, kept, dv)
    error, zeroed = (
        max(_error(image, exact) for image in images),
        _error(np.asarray(recon.matrix) @ np.nan_to_num(broken), exact),
    )
    assert error < 1e-8
    assert zeroed > 100 * error
    said = "the image of the remaining readings; none remains: zero. Digits are lost as 1 / hyperparameter^2"
    hard("channels not finite", "1 to 549 of 550 dead", float64=error, naive=zeroed, beyond=said)


@pytest.mark.parametrize("hyperparameter", [1e-2, 1e-5])
def test_what_is_applied_in_single_precision_is_mended_in_double(hard, model, jac, pixels, hyperparameter):
    rng = np.random.default_rng(0)
    used = np.sort(rng.permutation(550)[:40])  # each tells what no other does
    channels, lost, dv = np.isin(np.arange(550), used), used[:12], rng.normal(size=550)
    recon = je.prepare(model, basis=pixels, channels=channels, hyperparameter=hyperparameter)
    broken = np.where(np.isin(np.arange(550), lost), np.nan, dv)
    exact = _kept(jac[used], pixels, np.arange(12, 40), dv[used], hyperparameter)
    error, rounded = (_error(apply(broken), exact) for apply in (recon.on_host("float32"), recon.astype("float32")))
    assert error < 1e-6
    assert rounded > 30 * error
    hard(
        "channels not finite, applied in float32",
        "12 of 40 readings that tell of different things, hyperparameter 1e-2 to 1e-5",
        float32=error,
        naive=rounded,
        beyond="`on_host`: the image of the remaining readings; naive: all of the reconstructor in float32",
    )


@pytest.mark.slow
def test_gaps_do_not_stop_a_batch_or_its_gradient(recon):
    """Frames with gaps beside whole ones under vmap and grad: both branches run, no NaN comes of the one not taken."""
    dv = np.random.default_rng(0).normal(size=(4, 550))
    dv[1, 3], dv[2, 100:], dv[3] = np.nan, np.inf, np.nan
    images, slopes = jax.vmap(jax.value_and_grad(lambda dv: jnp.sum(recon(dv) ** 2)))(jnp.asarray(dv))
    assert np.isfinite(images).all()
    assert np.isfinite(slopes).all()
    assert not np.asarray(slopes)[~np.isfinite(dv)].any()
    whole = jax.grad(lambda dv: jnp.sum(recon(dv) ** 2))(jnp.asarray(dv[0]))
    assert _error(slopes[0], np.asarray(whole)) < 1e-9


# --- noise -------------------------------------------------------------------------------------------------------

STD = np.geomspace(1e-6, 1e-5, 550)


@pytest.fixture(scope="module")
def weighed(model, pixels):
    return je.prepare(model, basis=pixels, noise=STD)


@pytest.mark.parametrize("unit", [1e-30, 1e30])
def test_noise_of_any_unit_gives_the_same_image(hard, model, pixels, weighed, unit):
    scaled = je.prepare(model, basis=pixels, noise=unit * STD)
    error = _error(scaled.matrix, np.asarray(weighed.matrix))
    assert error < 1e-9
    np.testing.assert_allclose(np.asarray(scaled.variance) / unit**2, np.asarray(weighed.variance), rtol=1e-6)
    said = "the same image; in float32 an error where 1 / noise^2 overflows"
    hard("unit of the noise", "1e-30 to 1e30 V", float64=error, beyond=said)


@pytest.mark.parametrize("noise", [1e-30, 1e-200])
def test_noise_that_float32_cannot_weigh_is_refused(noise):
    model = square_model(
        [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.15)], je.skin.adjacent(4), 4, dtype="float32"
    )
    with np.errstate(over="ignore"), pytest.raises(InverseError, match="beyond float32"):
        je.prepare(model, noise=np.full(len(model.pattern), noise))


def test_covariances_wildly_scaled_and_singular(hard, model, pixels, weighed):
    """Units of rows may differ by 1e60; what cannot be inverted is refused, and so told apart."""
    wild = np.random.default_rng(0).permutation(np.geomspace(1e-30, 1e30, 550))
    recon = je.prepare(model, basis=pixels, noise=wild[:, None] * (0.5 + 0.5 * np.eye(550)) * wild)
    assert np.isfinite(recon.matrix).all()
    assert int(recon.provenance["rank"].split(" of ")[1]) < 60  # it is told that few readings say it all
    shared = 1e-12 * np.ones((550, 550))
    with pytest.raises(InverseError, match="positive definite"):
        je.prepare(model, basis=pixels, noise=shared)
    nearly = shared + np.diag(np.full(550, 1e-24))
    matrix = np.asarray(je.prepare(model, basis=pixels, noise=nearly).matrix)
    common = np.abs(matrix @ np.ones(550)).max() / np.abs(matrix).max()
    assert np.isfinite(matrix).all()
    assert common < 1e-3
    said = "an error where it is singular; provenance['rank'] where few readings hold all information"
    hard("noise covariance singular or wildly scaled", "condition 5e14; units 1e-30 to 1e30", beyond=said)


@pytest.mark.parametrize("covariance", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_channels_left_out_may_have_any_noise_and_any_reading(model, pixels, covariance):
    """Beside a gap, and beside many."""
    channels, noise = np.ones(550, bool), STD.copy()
    channels[[3, 77]] = False
    dv = np.random.default_rng(0).normal(size=(2, 550))
    dv[0, 11] = dv[1, ::9] = np.nan
    images = []
    for value, reading in ((1e-6, 0.0), (0.0, np.nan), (np.nan, np.inf)):
        noise[~channels], dv[:, ~channels] = value, reading
        given = np.diag(noise**2) if covariance else noise
        images.append(np.asarray(je.prepare(model, basis=pixels, noise=given, channels=channels)(dv)))
    assert np.isfinite(images[0]).all()
    require_identical(images, [images[0]] * 3)


@pytest.mark.parametrize("bad", [0.0, -1e-6, np.nan, np.inf])
def test_a_noise_that_is_none_is_refused_by_the_number_of_its_reading(model, pixels, bad):
    with pytest.raises(InverseError, match="the noise of reading 7 is"):
        je.prepare(model, basis=pixels, noise=np.where(np.arange(550) == 7, bad, STD))


@pytest.mark.parametrize("second", [[1.0, 1, -1, -1], [1 + 1e-3, 1, -1, -1], [0.0, 1, 0, -1]])
def test_a_covariance_of_frames_that_share_next_to_nothing(second):
    """Then the formula for the weight of the diagonal divides by next to nothing: the weight is one, not 1e6."""
    blank = np.array([[1, 0, -1, 0] if second[0] == 0 else [1, -1, 1, -1], second], float).T
    np.testing.assert_allclose(je.imaging.noise_covariance(blank), np.diag(np.var(blank, 0, ddof=1)), rtol=1e-12)


def test_one_channel_too_quiet_is_told(model, pixels):
    """A stuck converter is a reading of next to no noise, by the formula worth more than all others: the rank says."""
    noise = np.full(550, 1e-6)
    noise[17] = 1e-14
    recon = je.prepare(model, basis=pixels, noise=noise)
    assert recon.provenance["rank"] == "1 of 1"
    assert np.isfinite(recon.matrix).all()
