"""Whether electrodes sit where the model has them, by the evidence of an untouched frame."""

import jax
import numpy as np
import pytest
from scipy.stats import multivariate_normal

import jaxeit as je
from jaxeit.imaging import InverseError, find_misplacement
from jaxeit.imaging.absolute.background import COATING_STD
from jaxeit.imaging.absolute.misplacement import COAT_SPREAD, _beliefs

from ..helpers import square_model
from ..oracles.bench.mesh import make_mesh
from ..oracles.bench.session import coating
from ..oracles.bench.sheet import make_sheet, readings
from ..oracles.bench.skin import read_skin


def test_the_evidence_and_the_shifts_are_those_of_the_gaussian():
    """Against the density and the conditional mean of the dense covariance."""
    rng = np.random.default_rng(3)
    coat, slopes, true = rng.normal(size=(40, 6)), rng.normal(size=(40, 4)) * 300, rng.normal(size=4) * 2e-3
    y = slopes @ true + 0.1 * coat @ rng.normal(size=6) + 0.2 * rng.normal(size=40)
    gain = 30 * rng.normal(size=40)
    strengths, along = np.linalg.eigh(coat @ coat.T)
    seen, surprise = along.T @ np.column_stack([y, slopes, gain]), []
    for ratio in (0.1, 0.3):
        still = np.eye(40) + ratio**2 * coat @ coat.T + np.outer(gain, gain)
        for belief in _beliefs(ratio, strengths, seen):
            whole = belief.error**2 * still + belief.size**2 * slopes @ slopes.T
            usual = 0.5 * (np.log(ratio * belief.error / COATING_STD) / COAT_SPREAD) ** 2
            surprise.append(belief.surprise - usual + multivariate_normal.logpdf(y, np.zeros(40), whole))
            told = belief.size**2 * slopes.T @ np.linalg.inv(whole)
            np.testing.assert_allclose(belief.shift, told @ y, atol=1e-12)
            left = belief.size**2 * np.eye(4) - belief.size**2 * told @ slopes
            np.testing.assert_allclose(belief.variance, np.diag(left), atol=1e-15)
        assert 1e-3 < belief.size < 4e-3
        np.testing.assert_allclose(belief.shift, true, atol=3e-4)
    np.testing.assert_allclose(surprise, surprise[0], atol=1e-8)


def _untouched(seed, aside, coat):
    """A frame of the second simulator, whose bolts sit aside by so much, m, with a noise of 70 dB."""
    skin, own = read_skin(), np.random.default_rng([seed, 11])
    bolts = skin.bolts + aside * own.standard_normal(skin.bolts.shape)
    mesh = make_mesh(skin, bolts, 4e-3)
    sigma = coating(mesh.points[mesh.triangles].mean(1), coat, own) / skin.resistance
    frame = readings(make_sheet(mesh, sigma, skin.contact).untouched, skin.pattern, skin.current)
    noise = 3e-4 * np.sqrt(np.mean(frame**2))
    return frame + noise * own.standard_normal(frame.shape), np.full(frame.shape, noise)


@pytest.mark.slow
def test_misplaced_bolts_are_told_from_an_uneven_coat(model):
    """Frames of another program; readings that are missing are left out."""
    honest = find_misplacement(model, *_untouched(8101, 0.0, 0.4))
    assert float(honest.evidence) < 30
    frame, noise = _untouched(8102, 1e-3, 0.15)
    frame[[3, 77]] = np.nan
    aside = find_misplacement(model, frame, noise)
    assert float(aside.evidence) > 500
    assert 0.5e-3 < float(aside.size) < 2e-3
    assert aside.shift.shape == aside.standard_error.shape == (25, 2)
    assert 0 < float(aside.error) < float(aside.unshifted) / 5


def test_what_cannot_be_told_is_refused():
    model = square_model([(0.05, 0.05), (0.15, 0.05), (0.125, 0.15), (0.05, 0.125)], [[0, 1, 2, 3], [1, 2, 3, 0]], 8)
    frame = je.forward(model)
    with pytest.raises(InverseError, match=r"give the 2 readings"):
        find_misplacement(model, np.ones(3))
    with pytest.raises(InverseError, match="opposite sign"):
        find_misplacement(model, -frame)
    for noise in (np.ones(3), np.array([1.0, -1.0]), np.array([1.0, np.nan])):
        with pytest.raises(InverseError, match="noise is not one number of zero or more"):
            find_misplacement(model, frame, noise)
    with pytest.raises(InverseError, match="decides by looking at values"):
        jax.jit(lambda v0: find_misplacement(model, v0).size)(frame)
