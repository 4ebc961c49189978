"""Ways to choose the hyperparameter, each against its definition worked out with whole matrices."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging.hyperparameters import Spectrum
from jaxeit.imaging.methods import Problem
from jaxeit.imaging.readings.noise import noise_weight

STD = 2e-6


@pytest.fixture(scope="module")
def coarse(model):
    return je.Pixels(12).on(model)


@pytest.fixture(scope="module")
def jac(model, coarse):
    return np.asarray(je.jacobian(model, basis=coarse))


@pytest.fixture(scope="module")
def frames(coarse, jac):
    """Readings of two smooth contacts, with noise."""
    x, y = np.asarray(coarse.centres).T
    touch = [0.02 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.03**2) for a, b in ((0.06, 0.1), (0.15, 0.12))]
    return np.array(touch) @ jac.T + STD * np.random.default_rng(0).normal(size=(2, 550))


@pytest.fixture(scope="module")
def held(model):
    """An orthonormal basis of what 550 readings of 25 electrodes can hold: 275 directions."""
    rows = np.zeros((550, 25, 25))
    for row, (source, sink, plus, minus) in zip(rows, np.asarray(model.pattern), strict=True):
        row[[plus, minus], source] += [1, -1]
        row[[plus, minus], sink] -= [1, -1]
    u, s, _ = np.linalg.svd((rows + rows.transpose(0, 2, 1)).reshape(550, -1), full_matrices=False)
    assert np.count_nonzero(s > 1e-9 * s[0]) == 275
    return u[:, :275]


def chosen(model, coarse, how, channels=None):
    recon = je.prepare(model, basis=coarse, noise=np.full(550, STD), hyperparameter=how, channels=channels)
    return float(recon.provenance["hyperparameter"])


def image_matrix(jac, h):
    r = np.maximum(np.linalg.norm(jac, axis=0), 1e-3 * np.linalg.norm(jac, axis=0).max())
    strength = h**2 * np.trace(jac / r @ jac.T) / len(jac)
    return np.linalg.solve(jac.T @ jac + strength * np.diag(r), jac.T), r


def test_discrepancy_leaves_the_noise_and_no_more(model, coarse, jac, frames, held):
    h = chosen(model, coarse, je.imaging.Discrepancy(frames))

    def misfit(h):
        left = frames - frames @ image_matrix(jac, h)[0].T @ jac.T
        return np.mean((left @ held) ** 2) / STD**2

    assert misfit(h) <= 1 < misfit(1.1 * h)


def test_discrepancy_says_when_the_noise_cannot_be_right(model, coarse, frames):
    with pytest.raises(je.imaging.HyperparameterError, match="standard deviations from any image"):
        je.prepare(model, basis=coarse, noise=np.full(550, 1e-12), hyperparameter=je.imaging.Discrepancy(frames))
    with pytest.raises(je.imaging.InverseError, match=r"noise=\.\.\."):
        je.prepare(model, basis=coarse, hyperparameter=je.imaging.Discrepancy(frames))


def test_cross_validation_predicts_best(model, coarse, jac, frames, held):
    """The generalised form stands for leaving one number out; its choice is within a factor of the best one."""
    h = chosen(model, coarse, je.imaging.GeneralisedCrossValidation(frames))
    y = frames @ held

    def score(h):
        hat = held.T @ jac @ image_matrix(jac, h)[0] @ held
        return np.sum((y - y @ hat.T) ** 2) / np.trace(np.eye(275) - hat) ** 2

    assert score(h) <= 1.001 * min(score(k * h) for k in (0.5, 0.8, 1.25, 2))


@pytest.mark.slow
def test_the_noise_figure_is_what_simulated_noise_gives(model, coarse, jac):
    h = chosen(model, coarse, je.NoiseFigure(0.5))
    q, _ = image_matrix(jac, h)
    areas = np.asarray(coarse.areas)
    middle = np.argmin(((np.asarray(coarse.centres) - 0.1) ** 2).sum(1))
    noise = np.random.default_rng(1).normal(size=(4000, 550))
    image_snr = np.sqrt(areas @ (q @ jac[:, middle]) ** 2) / np.sqrt(np.mean(((noise @ q.T) ** 2) @ areas))
    data_snr = np.linalg.norm(jac[:, middle]) / np.sqrt(550)
    assert data_snr / image_snr == pytest.approx(0.5, rel=0.08)
    assert chosen(model, coarse, je.NoiseFigure(0.25)) > h
    with pytest.raises(je.imaging.HyperparameterError, match="none as low"):
        chosen(model, coarse, je.NoiseFigure(1e-9))


def test_a_deviation_in_siemens_gives_the_mean_of_the_posterior(model, coarse, jac, frames):
    """``C J^T (J C J^T + N)^-1 dv``, with C the covariance of the prior in S^2 and N that of the noise in V^2."""
    deviation, areas = 2e-4, np.asarray(coarse.areas)
    variance = 1 / image_matrix(jac, 1.0)[1]
    c = deviation**2 * variance / (areas @ variance / areas.sum())
    expected = c[:, None] * jac.T @ np.linalg.solve(jac * c @ jac.T + STD**2 * np.eye(550), frames[0])
    how = je.imaging.PriorDeviation(deviation)
    recon = je.prepare(model, basis=coarse, noise=np.full(550, STD), hyperparameter=how)
    np.testing.assert_allclose(recon(frames[0]), expected, rtol=1e-5, atol=1e-7 * np.abs(expected).max())
    with pytest.raises(je.imaging.HyperparameterError, match="give it in S"):
        chosen(model, coarse, je.imaging.PriorDeviation())
    with pytest.raises(je.imaging.InverseError, match=r"noise=\.\.\."):
        je.prepare(model, basis=coarse, hyperparameter=how)


def test_the_corner_of_the_l_curve_bends_most(model, coarse, jac, frames, held):
    h = chosen(model, coarse, je.imaging.LCurve(frames))

    def point(h):
        q, r = image_matrix(jac, h)
        x = frames @ q.T
        return np.log([np.sum(((frames - x @ jac.T) @ held) ** 2), np.sum(r * x**2)])

    def turn(h, step=1.15):
        before, at, after = (point(h * k) for k in (1 / step, 1, step))
        (ax, ay), (bx, by) = at - before, after - at
        return abs(np.arctan2(ax * by - ay * bx, ax * bx + ay * by)) / np.hypot(*(after - before))

    assert turn(h) > max(turn(3 * h), turn(h / 3))


def test_where_the_l_curve_stands_still_it_does_not_bend(coarse):
    """As in float32 at small values, where the image does not change any more: 0 / 0 would be chosen."""
    squares, y = jnp.array([100, 0], jnp.float32), jnp.array([[1, 1e-3]], jnp.float32)
    jacobian = jnp.zeros((2, coarse.size), jnp.float32)
    problem = Problem(jacobian, jnp.array(2.0), jnp.array(1.0), je.Noser(), coarse.picture)
    spectrum = Spectrum(squares, jnp.eye(2, dtype=jnp.float32), jacobian.T, problem)
    assert je.imaging.LCurve(y).choose(spectrum, lambda y: y) > 1e-3


@pytest.mark.parametrize(
    ("choice", "squares", "y", "said"),
    [
        (je.imaging.GeneralisedCrossValidation, [1.0, 0.0], [0.0, 1.0], r"end of the range, 1e\+02: .* show no touch"),
        (je.imaging.GeneralisedCrossValidation, [1.0, 0.0], [1.0, 0.0], r"end of the range, 0\.0001: .* hold no noise"),
        (je.imaging.LCurve, [1.0, 0.0], [1.0, 1e-9], "L-curve: the best hyperparameter is the end of the range"),
    ],
)
def test_an_end_of_the_range_is_no_choice(coarse, choice, squares, y, said):
    """Readings that no image explains ask for ever more of the prior, those without noise for ever less."""
    jacobian = jnp.zeros((2, coarse.size))
    problem = Problem(jacobian, jnp.array(2.0), jnp.array(1.0), je.Noser(), coarse.picture)
    spectrum = Spectrum(jnp.array(squares), jnp.eye(2), jacobian.T, problem)
    with pytest.raises(je.imaging.HyperparameterError, match=said):
        choice(jnp.array([y])).choose(spectrum, lambda y: y)


@pytest.mark.parametrize("noise", [je.imaging.MeasuredNoise(), je.imaging.EqualNoise, je.effects.Noise()])
def test_a_choice_of_noise_is_no_noise(noise):
    with pytest.raises(je.imaging.InverseError, match=r"noise is .*; give the standard deviation of each reading, V"):
        noise_weight(noise, 3, np.ones(3, bool))


@pytest.mark.parametrize("choice", [je.imaging.GeneralisedCrossValidation, je.imaging.LCurve, je.imaging.Discrepancy])
def test_frames_that_say_nothing_choose_nothing(model, coarse, frames, choice):
    """No change at all; a reading that is not finite, unless its channel is left out."""
    with pytest.raises(
        je.imaging.HyperparameterError, match="hold no change; give differences, at least one of a touch"
    ):
        chosen(model, coarse, choice(0 * frames))
    used = np.arange(550) != 7
    bad = np.where(used, frames, np.nan)
    with pytest.raises(je.imaging.HyperparameterError, match=r"frame 0 .* not finite; leave it out, or the channel by"):
        chosen(model, coarse, choice(bad))
    assert chosen(model, coarse, choice(bad), used) == chosen(model, coarse, choice(frames), used) > 1e-4


@pytest.mark.parametrize("bad", [0.0, -1.0, float("inf")])
def test_numbers_that_cannot_be_are_refused(model, coarse, bad):
    with pytest.raises(je.imaging.InverseError, match="above zero"):
        je.prepare(model, basis=coarse, hyperparameter=bad)


def test_it_has_no_unit(model, coarse, frames):
    """The same skin in other units of conductance chooses the same."""
    how = je.imaging.GeneralisedCrossValidation(frames)
    other = je.imaging.GeneralisedCrossValidation(1e3 * jnp.asarray(frames))
    one = je.prepare(model, basis=coarse, hyperparameter=how)
    two = je.prepare(model, basis=coarse, hyperparameter=other)
    assert one.provenance["hyperparameter"] == two.provenance["hyperparameter"]
