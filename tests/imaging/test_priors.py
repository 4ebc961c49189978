"""Priors: their three forms are one matrix, and mean what they say."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je

PRIORS = {
    "Noser": je.Noser(),
    "Tikhonov": je.Tikhonov(),
    "Laplace": je.Laplace(),
    "Gaussian": je.GaussianSmooth(0.015),
    "Gaussian, sensitivity": je.GaussianSmooth(0.015, noser=True),
    "variation": je.TotalVariation(),
}
PRIORS |= {name: kind() for name, kind in je.imaging.PRIORS.items() if kind not in map(type, PRIORS.values())}


@pytest.fixture(scope="module")
def jac(model, pixels):
    return je.jacobian(model, basis=pixels)


@pytest.mark.parametrize("at", [None, 1.0])
@pytest.mark.parametrize("name", PRIORS)
def test_a_precision_is_one_matrix_whatever_is_asked(pixels, jac, name, at):
    rng = np.random.default_rng(0)
    at = None if at is None else jnp.asarray(rng.normal(size=400))
    precision = PRIORS[name].precision(jac, pixels.picture, at)
    r = np.asarray(precision.matrix())
    np.testing.assert_allclose(r, r.T, atol=1e-8 * np.abs(r).max())
    assert np.linalg.eigvalsh(r).min() > 0
    x = jnp.asarray(rng.normal(size=(400, 3)))
    scale = np.abs(r).max() * 10
    np.testing.assert_allclose(precision.times(x), r @ x, atol=1e-8 * scale)
    np.testing.assert_allclose(r @ precision.solve(x), x, atol=1e-7)
    np.testing.assert_allclose(precision.variance(), np.diag(np.linalg.inv(r)), rtol=1e-6)
    assert float(jnp.sum(precision.residual(x[:, 0]) ** 2)) == pytest.approx(float(x[:, 0] @ r @ x[:, 0]), rel=1e-8)


@pytest.mark.parametrize("name", ["Laplace", "variation"])
def test_differences_cost_nothing_where_an_image_is_flat(pixels, jac, name):
    r = PRIORS[name].precision(jac, pixels.picture).matrix()
    flat, rough = jnp.ones(400), jnp.asarray(np.random.default_rng(0).normal(size=400))
    assert float(flat @ r @ flat) < 1e-2 * float(rough @ r @ rough)


def test_variation_charges_a_jump_by_its_height_and_length(pixels, jac):
    """Away from flat parts x^T R x is the sum of |jump| times length, over the image's height."""
    picture = pixels.picture
    step = jnp.where(picture.centres[:, 0] < 0.1, 0.0, 3.0)
    r = je.TotalVariation(beta=1e-4, floor=1e-12).precision(jac, picture, step).matrix()
    assert float(step @ r @ step) == pytest.approx(3.0 * 3.0 * 0.2, rel=1e-3)


def test_neighbours_of_pixels_and_of_elements(model):
    grid = je.Pixels(4, 3).on(model).picture
    assert len(grid.edges) == 3 * 3 + 4 * 2
    upright = np.abs(np.diff(np.asarray(grid.centres)[grid.edges], axis=1))[:, 0, 0] > 0
    np.testing.assert_allclose(grid.edge_length[upright], 0.2 / 3)
    np.testing.assert_allclose(grid.edge_length[~upright], 0.2 / 4)
    mesh = je.Elements().on(model).picture
    triangles = np.asarray(model.triangles)
    shared = [len(set(triangles[a]) & set(triangles[b])) for a, b in np.asarray(mesh.edges)]
    assert set(shared) == {2}
    assert len(mesh.edges) == 3 * len(triangles) / 2 - len(_rim(triangles)) / 2


def _rim(triangles):
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    _, counts = np.unique(sides, axis=0, return_counts=True)
    return np.flatnonzero(counts == 1)


def test_bumps_are_what_a_round_contact_does(model):
    basis = je.Bumps(11, width=0.015).on(model)
    assert basis.shape == (11, 11)
    middle = 5 * 11 + 5
    field = np.asarray(basis.expand(jnp.zeros(121).at[middle].set(2.0)))
    square = ((np.asarray(model.centroids) - [0.1, 0.1]) ** 2).sum(1)
    near = square < (4 * 0.015) ** 2
    np.testing.assert_allclose(field[near], 2 * np.exp(-0.5 * square[near] / 0.015**2), rtol=1e-9)
    assert not field[~near].any()
    assert float(basis.areas[middle]) == pytest.approx(2 * np.pi * 0.015**2, rel=1e-2)
    # a column of the Jacobian is the reading's response to the bump, to first order
    j = np.asarray(je.jacobian(model, basis=basis))[:, middle]
    small = np.asarray(je.forward(model, model.background + 1e-6 * field / 2) - je.forward(model)) / 1e-6
    np.testing.assert_allclose(j, small, atol=1e-3 * np.abs(j).max())


@pytest.mark.parametrize("settings", [{"columns": 1}, {"rows": 501}, {"width": 0.0}, {"width": float("nan")}])
def test_bumps_that_cannot_be_are_refused(settings):
    with pytest.raises(ValueError, match="give "):
        je.Bumps(**settings)


@pytest.mark.parametrize(("wrong", "given"), [(lambda n: jnp.ones(n), "an array"), (lambda n: None, "NoneType")])
def test_a_prior_returns_a_precision(model, wrong, given):
    class Mine(je.AbstractPrior):
        def precision(self, jacobian, picture, at=None):
            return wrong(jacobian.shape[1])

    with pytest.raises(
        je.imaging.InverseError, match=rf"Mine\.precision returns {given}; return jaxeit\.imaging\.Diag"
    ):
        je.prepare(model, Mine(), basis=je.Pixels(5))
