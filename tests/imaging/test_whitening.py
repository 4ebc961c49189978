"""Pair sums: nothing of a frame is lost in them, and what a frame lacks is taken out exactly."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging.readings.whitening import whitened_readings

STD = np.geomspace(2e-6, 2e-5, 550)


@pytest.fixture(scope="module")
def parts(model, pixels):
    """Jacobian, and NOSER prior and strength as `prepare` takes them from all readings (for this noise)."""

    def of(weight):
        j = np.asarray(je.jacobian(model, basis=pixels))
        r = np.asarray(je.Noser().precision(jnp.asarray(np.linalg.cholesky(weight).T @ j), pixels.picture).values)
        return j, r, 0.1**2 * np.trace(weight @ j / r @ j.T) / len(j)

    return of


def covariance():
    """Noise with a part that all readings share, and one that neighbours share."""
    index = np.arange(550)
    alike = 0.5 * np.exp(-np.abs(index[:, None] - index) / 3) + 0.2 + 0.3 * np.eye(550)
    return STD[:, None] * alike * STD


def generalised(j, r, strength, weight):
    return np.linalg.solve(j.T @ weight @ j + strength * np.diag(r), j.T @ weight)


NOISES = {"deviations": (STD, np.diag(STD**-2.0)), "covariance": (covariance(), np.linalg.inv(covariance()))}


@pytest.fixture(scope="module", params=NOISES)
def noisy(request, model, pixels, parts):
    noise, weight = NOISES[request.param]
    return je.prepare(model, basis=pixels, noise=noise), *parts(weight), np.asarray(noise), weight


def test_readings_weigh_by_the_inverse_of_their_noise(noisy):
    recon, j, r, strength, _, weight = noisy
    expected = generalised(j, r, strength, weight)
    np.testing.assert_allclose(recon.matrix, expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.slow
def test_images_know_what_amplifiers_make_of_the_common_mode(model, pixels):
    """With readings that are no differences, and a NaN: the same image as by the Jacobian of all readings."""
    amplified = replace(model, effects=(je.effects.CommonMode(gain=8e-3),))
    recon = je.prepare(amplified, basis=pixels, noise=STD)
    j, weight = np.asarray(je.jacobian(amplified, basis=pixels)), np.diag(STD**-2.0)
    assert np.abs(j - je.jacobian(model, basis=pixels)).max() > 1e-3 * np.abs(j).max()
    r = np.asarray(je.Noser().precision(jnp.asarray(np.linalg.cholesky(weight).T @ j), pixels.picture).values)
    strength = 0.1**2 * np.trace(weight @ j / r @ j.T) / len(j)
    expected = generalised(j, r, strength, weight)
    np.testing.assert_allclose(recon.matrix, expected, atol=1e-8 * np.abs(expected).max())
    dv = 1e-4 * np.random.default_rng(0).normal(size=550)
    kept = np.setdiff1d(np.arange(550), [3, 77])
    gone = np.where(np.isin(np.arange(550), kept), dv, np.nan)
    expected = generalised(j, r, strength, remaining(STD, kept)) @ dv
    np.testing.assert_allclose(recon(gone), expected, atol=1e-7 * np.abs(expected).max())
    with pytest.raises(je.imaging.InverseError, match="hides the gain of CommonMode"):
        jax.jit(lambda gain: je.prepare(replace(model, effects=(je.effects.CommonMode(gain=gain),))).matrix)(8e-3)


@pytest.mark.parametrize("noise", NOISES)
def test_what_is_kept_of_a_frame_is_all_of_it_and_white(model, noise):
    """C^T C is the inverse covariance of the pair sums, and E the least inverse of C^T."""
    deviations, weight = NOISES[noise]
    found = whitened_readings(model, deviations, None)
    p = np.asarray(found.whitening.readings(jnp.eye(300)))
    gram = p.T @ weight @ p
    np.testing.assert_allclose(found.factor.T @ found.factor, gram, atol=1e-9 * np.abs(gram).max())
    exact = np.linalg.pinv(found.factor.T)
    np.testing.assert_allclose(found.compress, exact, atol=1e-9 * np.abs(exact).max())


def remaining(noise, kept):
    """The inverse of the noise of the readings kept, zero elsewhere."""
    cov = np.diag(noise**2) if noise.ndim == 1 else noise
    weight = np.zeros((550, 550))
    weight[np.ix_(kept, kept)] = np.linalg.inv(cov[np.ix_(kept, kept)])
    return weight


@pytest.mark.parametrize("gone", [[4], [0, 1, 2, 77, 300, 549], list(range(0, 550, 5))])
def test_readings_that_are_not_finite_leave_the_frame_exactly(noisy, gone):
    recon, j, r, strength, noise, _ = noisy
    dv = 1e-4 * np.random.default_rng(0).normal(size=(3, 550))
    broken = dv.copy()
    broken[1, gone] = np.resize([np.nan, np.inf, -np.inf], len(gone))
    images = np.asarray(recon(broken))
    kept = np.setdiff1d(np.arange(550), gone)
    expected = generalised(j, r, strength, remaining(noise, kept)) @ dv[1]
    np.testing.assert_allclose(images[1], expected, atol=1e-8 * np.abs(expected).max())
    others = np.asarray(recon(dv))
    np.testing.assert_allclose(images[[0, 2]], others[[0, 2]], atol=1e-12 * np.abs(others).max())
    flags = np.zeros(550, bool)
    flags[gone] = True
    fewer = recon.without(flags)
    np.testing.assert_allclose(fewer(broken[1]), expected, atol=1e-8 * np.abs(expected).max())
    assert not np.asarray(fewer.channels)[gone].any()
    variance = np.diag(np.linalg.inv(j.T @ remaining(noise, kept) @ j + strength * np.diag(r)))
    np.testing.assert_allclose(fewer.variance, variance, rtol=1e-6)
    # and once more, on top of that
    also = np.asarray(fewer(np.where(np.arange(550) == 11, np.nan, dv[1])))
    both = generalised(j, r, strength, remaining(noise, np.setdiff1d(kept, [11]))) @ dv[1]
    np.testing.assert_allclose(also, both, atol=1e-8 * np.abs(both).max())


def test_a_frame_without_any_reading_is_no_image_and_no_nan(noisy):
    assert not np.asarray(noisy[0](np.full(550, np.nan))).any()


def test_leaving_out_nothing_or_everything(noisy):
    recon = noisy[0]
    np.testing.assert_allclose(recon.without(np.zeros(550, bool)).matrix, recon.matrix, atol=1e-12)
    assert not recon.without(np.arange(550) < 3).whitening.weight[:3].any()
    with pytest.raises(je.imaging.InverseError, match="nothing to reconstruct"):
        recon.without(np.ones(550, bool))
    with pytest.raises(je.imaging.InverseError, match="550 readings"):
        recon.without(np.ones(3, bool))
    with pytest.raises(je.imaging.InverseError, match="channels is int64 of shape"):
        recon.without(np.arange(550))


def test_posterior_variance_is_that_of_the_formula(noisy):
    recon, j, r, strength, _, weight = noisy
    expected = np.diag(np.linalg.inv(j.T @ weight @ j + strength * np.diag(r)))
    np.testing.assert_allclose(recon.variance, expected, rtol=1e-6)


def test_intervals_cover_what_they_say(noisy):
    """Images drawn from the prior, readings with the noise: the errors have the stated variance."""
    recon, j, r, strength, noise, _ = noisy
    rng = np.random.default_rng(5)
    truth = rng.normal(size=(400, len(r))) / np.sqrt(strength * r)
    root = np.diag(noise) if noise.ndim == 1 else np.linalg.cholesky(noise)
    pull = (np.asarray(recon(truth @ j.T + rng.normal(size=(400, 550)) @ root.T)) - truth) / np.sqrt(recon.variance)
    assert abs(pull.mean()) < 0.01
    assert pull.std() == pytest.approx(1, abs=0.01)
    for width, share in ((1, 0.6827), (1.96, 0.95), (2.576, 0.99)):
        assert np.mean(np.abs(pull) < width) == pytest.approx(share, abs=0.01)


def test_without_noise_the_variance_is_not_known(model, pixels):
    assert np.isinf(je.prepare(model, basis=pixels).variance).all()


def test_gradients_pass_a_frame_with_gaps(noisy):
    recon = noisy[0]
    dv = jnp.where(jnp.arange(550) == 3, jnp.nan, 1e-4)
    slope = np.asarray(jax.grad(lambda dv: jnp.sum(recon(dv)))(dv))
    assert slope[3] == 0
    fewer = recon.without(np.arange(550) == 3).matrix.sum(0)
    np.testing.assert_allclose(slope, fewer, atol=1e-9 * np.abs(fewer).max())


@pytest.mark.parametrize(
    ("noise", "said"),
    [
        ("x", "noise is 'x'; give real numbers, V"),
        (["a"] * 550, "noise is list; give real numbers, V"),
        ([[1.0, 2.0], [3.0]], "noise is list; give real numbers, V"),
        (np.full(550, 1e-5 + 1e-6j), "noise is complex; give real numbers, V"),
    ],
)
def test_noise_that_is_no_number_is_refused_in_one_line(model, pixels, noise, said):
    for call in (lambda: je.prepare(model, basis=pixels, noise=noise), lambda: je.prepare_contacts(model, noise=noise)):
        with pytest.raises(je.imaging.InverseError, match=f"^{said}$"):
            call()
    with pytest.raises(je.imaging.InverseError, match=r"^the blank recording is complex; give real numbers, V$"):
        je.imaging.noise_covariance(np.ones((5, 3)) * 1j)
    with pytest.raises(je.imaging.InverseError, match=r"^prepare_contacts: noise is None; give the standard deviation"):
        je.prepare_contacts(model, noise=None)


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        (np.ones((550, 550)), "positive definite"),
        (np.full((550, 550), np.nan), "positive definite"),
        (np.ones((3, 3)), "550 readings"),
        (np.eye(550) + np.triu(np.full((550, 550), 1e-3), 1), "symmetric"),
    ],
)
def test_a_covariance_that_cannot_be_is_refused(model, pixels, noise, message):
    with pytest.raises(je.imaging.InverseError, match=message):
        je.prepare(model, basis=pixels, noise=noise)


def test_noise_covariance_is_usable_from_few_frames_and_right_from_many():
    rng = np.random.default_rng(2)
    true = covariance()[:40, :40]
    draw = rng.normal(size=(4000, 40)) @ np.linalg.cholesky(true).T
    few, many = (je.imaging.noise_covariance(draw[:n]) for n in (20, 4000))
    assert np.linalg.eigvalsh(few).min() > 0
    far = [np.linalg.norm(found - true) / np.linalg.norm(true) for found in (few, np.cov(draw[:20].T), many)]
    assert far[0] < far[1]
    assert far[2] < 0.08
    alone = je.imaging.noise_covariance(rng.normal(size=(50, 40)))  # nothing is shared: little is claimed
    assert np.abs(alone - np.diag(np.diag(alone))).max() < 0.15


@pytest.mark.parametrize(
    ("blank", "message"),
    [
        (np.ones((3, 4)), "four or more"),
        (np.full((9, 4), np.nan), "four or more"),
        (np.ones((9, 4)), "reading 0 does not change"),
    ],
)
def test_blanks_that_tell_nothing_are_refused(blank, message):
    with pytest.raises(je.imaging.InverseError, match=message):
        je.imaging.noise_covariance(blank)
