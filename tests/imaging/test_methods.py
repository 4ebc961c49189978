"""Methods of reconstruction against slow ones from NumPy and SciPy, on the testbed's own Jacobian."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

import jaxeit as je
from jaxeit.imaging.reconstruction import IterativeReconstructor

from ..helpers import compiled

STD = 1e-5
METHODS = {
    "one step": (je.Noser(), je.OneStep()),
    "one step, Laplace": (je.Laplace(), je.OneStep()),
    "one step, Gaussian": (je.GaussianSmooth(0.015), je.OneStep()),
    "truncated": (je.Noser(), je.TruncatedSvd()),
    "back projection": (je.Noser(), je.imaging.BackProjection()),
    "GREIT": (je.Noser(), je.Greit()),
    "not negative": (je.Noser(), je.NonNegative()),
    "total variation": (je.TotalVariation(), je.Reweighted(4)),
    "sparse": (je.Noser(), je.SparseBayes()),
}
NAMED = {type(method) for _, method in METHODS.values()}
METHODS |= {name: (je.Noser(), kind()) for name, kind in je.imaging.METHODS.items() if kind not in NAMED}


@pytest.fixture(scope="module")
def jac(model, pixels):
    return np.asarray(je.jacobian(model, basis=pixels))


@pytest.fixture(scope="module")
def frame(model, pixels):
    """A touch at (0.07, 0.12) through the whole forward model, with noise."""
    square = jnp.sum((model.centroids - jnp.array([0.07, 0.12])) ** 2, -1)
    sigma = model.background * (1 + 0.3 * jnp.exp(-0.5 * square / 0.012**2))
    dv = np.asarray(je.forward(model, sigma) - je.forward(model))
    return dv + STD * 0.1 * np.random.default_rng(0).normal(size=dv.shape)


@pytest.fixture(scope="module")
def coarse(model):
    return je.Pixels(12).on(model)


def prepared(model, pixels, name, **settings):
    prior, method = METHODS[name]
    return je.prepare(model, prior, method, pixels, noise=np.full(550, STD), **settings)


mapped = compiled(lambda recon, frames: jax.vmap(recon)(frames))  # one program for all linear methods


@pytest.mark.parametrize("name", METHODS)
def test_every_method_finds_a_touch_alone_in_batches_and_with_gaps(model, coarse, frame, name):
    recon = prepared(model, coarse, name)
    frames = np.stack([frame, 0 * frame, -frame, np.where(np.arange(550) % 50 == 7, np.nan, frame)])
    images = np.asarray(
        mapped(recon, frames) if isinstance(recon, je.Reconstructor) else jax.jit(jax.vmap(recon))(frames)
    )
    assert images.shape == (4, 144)
    assert np.isfinite(images).all()
    largest = np.abs(images[0]).max()
    assert np.abs(images[1]).max() < 1e-9 * largest  # nothing from nothing
    for image in images[[0, 3]]:
        error = je.localisation_error(je.LevelCentroid(0.5)(image, recon), jnp.array([0.07, 0.12]))
        assert float(error) < (0.06 if name == "back projection" else 0.009)  # it is only a blur
    assert float(je.metrics.image_sum(images[0], recon.areas)) > 0
    for image, alone in zip(images, frames, strict=True):
        np.testing.assert_allclose(recon(alone), image, atol=1e-6 * largest)


def test_iterative_methods_are_told_from_linear_ones(model, coarse):
    assert isinstance(prepared(model, coarse, "not negative"), IterativeReconstructor)
    assert isinstance(prepared(model, coarse, "GREIT"), je.Reconstructor)


def test_truncation_keeps_the_singular_values_above_the_line(model, pixels, jac):
    r = np.asarray(je.Noser().precision(jnp.asarray(jac), pixels.picture).values)
    u, s, vt = np.linalg.svd(jac / np.sqrt(r), full_matrices=False)
    kept = s**2 > 0.1**2 * (s**2).sum() / len(jac)
    expected = (vt[kept].T / s[kept]) @ u[:, kept].T / np.sqrt(r)[:, None]
    found = je.prepare(model, method=je.TruncatedSvd(), basis=pixels).matrix
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def test_back_projection_is_the_mean_of_the_readings_by_sensitivity(model, pixels, jac):
    power = (jac**2).sum(0)
    expected = jac.T / (power + 1e-3 * power.max())[:, None]
    found = je.prepare(model, method=je.imaging.BackProjection(), basis=pixels).matrix
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_greit_solves_its_normal_equations_over_all_readings(model, pixels, jac):
    centres, areas = np.asarray(pixels.centres), np.asarray(pixels.areas)
    distance = np.linalg.norm(centres[:, None] - centres, axis=-1)
    contacts = np.exp(-0.5 * (distance / 0.012) ** 2)
    disc = 1 / (1 + np.exp((distance - 0.02) / 0.004))
    desired = disc * (areas @ contacts) / (areas @ disc)
    y = jac @ contacts
    small = y @ y.T + 0.1**2 * (y**2).sum() / len(y) * np.eye(len(y))
    expected = np.linalg.solve(small, y @ desired.T).T
    found = je.prepare(model, method=je.Greit(), basis=pixels).matrix
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def test_the_image_that_may_not_be_negative_is_that_of_nnls(model, pixels, jac, frame):
    r = np.asarray(je.Noser().precision(jnp.asarray(jac), pixels.picture).values)
    strength = 0.1**2 * np.trace(jac / r @ jac.T) / len(jac)
    stacked = np.concatenate([jac, np.diag(np.sqrt(strength * r))])
    expected = nnls(stacked, np.concatenate([frame, np.zeros(len(r))]))[0]
    found = np.asarray(je.prepare(model, method=je.NonNegative(40), basis=pixels)(frame))
    assert (found >= 0).all()
    assert np.count_nonzero(expected) < 200  # the constraint is at work
    np.testing.assert_allclose(found, expected, atol=1e-4 * expected.max())


@pytest.mark.slow
def test_total_variation_keeps_edges_and_flat_parts(model, pixels, jac):
    """A block is told from its blurred image: less variation, nearer to the truth."""
    x, y = np.asarray(pixels.centres).T
    block = 0.2 * ((np.abs(x - 0.08) < 0.03) & (np.abs(y - 0.11) < 0.03))
    dv = jac @ block
    images = {}
    for name, prior, method in (("l2", je.Laplace(), je.OneStep()), ("tv", je.TotalVariation(), je.Reweighted(12))):
        images[name] = np.asarray(je.prepare(model, prior, method, pixels, hyperparameter=0.03)(dv))
    edges = np.asarray(pixels.picture.edges)
    variation = {k: np.abs(np.diff(v[edges], axis=1)).sum() for k, v in images.items()}
    error = {k: np.linalg.norm(v - block) / np.linalg.norm(block) for k, v in images.items()}
    assert variation["tv"] < 0.8 * variation["l2"]
    assert error["tv"] < 0.6 * error["l2"]


@pytest.mark.slow
def test_total_variation_ends_where_its_own_weights_stand_still(model, coarse, frame):
    """A fixed point: one step more changes nothing."""
    few, more = (
        np.asarray(je.prepare(model, je.TotalVariation(0.1), je.Reweighted(n), coarse)(frame)) for n in (60, 61)
    )
    np.testing.assert_allclose(more, few, atol=2e-3 * np.abs(few).max())


def test_sparse_bayes_finds_the_few_pixels_there_are(model, pixels, jac):
    truth = np.zeros(400)
    truth[[110, 273]] = [0.3, 0.2]
    dv = jac @ truth
    dv = dv + 1e-4 * np.abs(dv).max() * np.random.default_rng(1).normal(size=550)
    recon = je.prepare(model, je.Tikhonov(), je.SparseBayes(300), pixels, hyperparameter=0.01)
    found = np.asarray(recon(dv))
    assert set(np.argsort(np.abs(found))[-2:]) == {110, 273}
    np.testing.assert_allclose(found[[110, 273]], [0.3, 0.2], rtol=0.1)


def test_sparse_bayes_needs_variances(model, pixels):
    with pytest.raises(ValueError, match="diagonal prior"):
        je.prepare(model, je.Laplace(), je.SparseBayes(), pixels)
