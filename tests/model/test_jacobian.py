"""The Jacobian against the adjoint identity, differences and JAX's own transformations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.model.bases import BasisError
from jaxeit.model.forward_model import fields
from jaxeit.model.sheet_conductivity import coefficients

from ..helpers import square_model

POINTS = [(0.06, 0.06), (0.14, 0.10), (0.10, 0.14), (0.06, 0.12)]
PATTERN = [[0, 1, 2, 3], [0, 2, 1, 3], [2, 3, 0, 1], [0, 1, 0, 1]]


@pytest.fixture(scope="module", params=[1, 2])
def small(request):
    return square_model(POINTS, PATTERN, 10, order=request.param)


def _uneven(model):
    return model.background * (1 + 0.5 * jax.random.uniform(jax.random.key(1), model.areas.shape))


def _adjoint(model, sigma):
    """dV/dsigma_e = -I times the integral over e of grad u_drive . grad u_sense, by hand."""
    x = np.asarray(fields(model, coefficients(model, sigma)).potential)
    u, slopes = x[np.asarray(model.system.dofs)], np.asarray(model.system.slopes)
    stiffness = slopes @ slopes.transpose(0, 2, 1)
    drive_plus, drive_minus, sense_plus, sense_minus = np.asarray(model.pattern).T
    drive = u[..., drive_plus] - u[..., drive_minus]
    sense = u[..., sense_plus] - u[..., sense_minus]
    return -float(model.current) * np.einsum("eim,eij,ejm->me", drive, stiffness, sense)


def test_agrees_with_the_adjoint_identity(small):
    sigma = _uneven(small)
    found, adjoint = np.asarray(je.jacobian(small, sigma)), _adjoint(small, sigma)
    np.testing.assert_allclose(found, adjoint, atol=1e-10 * np.abs(adjoint).max())


def test_agrees_with_forward_and_reverse_mode(small):
    sigma = _uneven(small)
    found = np.asarray(je.jacobian(small, sigma))
    reverse = jax.jacrev(lambda s: je.forward(small, s))(sigma)
    np.testing.assert_allclose(found, reverse, atol=1e-12 * np.abs(found).max())
    tangent = jax.random.normal(jax.random.key(2), sigma.shape)
    _, forward = jax.jvp(lambda s: je.forward(small, s), (sigma,), (tangent,))
    np.testing.assert_allclose(found @ tangent, forward, rtol=1e-10)


def test_agrees_with_central_differences(small):
    sigma = _uneven(small)
    step = 1e-5 * jnp.sin(jnp.arange(sigma.size))
    difference = (je.forward(small, sigma + step) - je.forward(small, sigma - step)) / 2
    np.testing.assert_allclose(je.jacobian(small, sigma) @ step, difference, rtol=1e-8)


def test_second_derivatives(small):
    sigma = _uneven(small)
    direction = jnp.cos(jnp.arange(sigma.size)) * sigma

    def along(t):
        return je.forward(small, sigma + t * direction)

    first = jax.jacfwd(along)
    h = 1e-4
    np.testing.assert_allclose(jax.jacfwd(first)(0.0), (first(h) - first(-h)) / (2 * h), rtol=1e-5)


def test_sensitivities_sum_to_minus_the_voltage(model):
    """Euler: readings are homogeneous in (sigma, contact); four-terminal ones hardly feel contact."""
    j, v = je.jacobian(model), je.forward(model)
    total = np.asarray(j @ model.background)
    assert np.abs(total + v).max() < 1e-3 * np.abs(v).max()


def test_projection_onto_pixels_is_the_chain_rule(model, pixels):
    whole = np.asarray(je.jacobian(model))
    table = np.zeros((whole.shape[1], pixels.size))
    np.add.at(table, (np.asarray(pixels.element), np.asarray(pixels.coefficient)[:, None]), pixels.weight)
    found = np.asarray(je.jacobian(model, basis=pixels))
    np.testing.assert_allclose(found, whole @ table, atol=1e-12 * np.abs(found).max())


def test_under_jit(small):
    image = je.Pixels(5).on(small)
    jitted = eqx.filter_jit(lambda m: je.jacobian(m, basis=image))(small)
    np.testing.assert_allclose(jitted, je.jacobian(small, basis=image), rtol=1e-9)
    with pytest.raises(BasisError, match="outside"):
        eqx.filter_jit(lambda m: je.jacobian(m, basis=je.Pixels(5)))(small)


def test_rank_is_that_of_the_electrodes(model):
    """550 readings of 25 electrodes hold at most L(L-1)/2 independent numbers."""
    values = np.linalg.svd(np.asarray(je.jacobian(model)), compute_uv=False)
    assert (values > 1e-10 * values[0]).sum() <= 25 * 24 // 2


def test_a_basis_is_given_by_name(small):
    with pytest.raises(ValueError, match=r"sigma is a basis, Pixels; give it by name, as in jaxeit.jacobian\("):
        je.jacobian(small, je.Pixels(20))
    with pytest.raises(ValueError, match=r"'pixels' is not a basis; give an object, such as basis=Pixels\(40\)"):
        je.jacobian(small, basis="pixels")


def test_a_new_conductivity_compiles_nothing(small, compilations):
    je.jacobian(small, small.background)
    je.forward(small, small.background)
    sigma = jax.jit(lambda s: 3 * s)(small.background)
    assert compilations  # that one
    compilations.clear()
    je.jacobian(small, sigma)
    je.forward(small, sigma)
    assert not compilations


@pytest.mark.slow
def test_factors_in_single_precision_give_a_jacobian_of_the_models_precision():
    single = je.Fidelity.draft(solver=je.linalg.Single(je.linalg.NestedDissection()))
    scene, basis = je.Scene(je.load_skin("testbed")), je.Pixels(8)
    found = je.jacobian(je.discretise(scene, single), basis=basis)
    expected = je.jacobian(je.discretise(scene, je.Fidelity.draft()), basis=basis)
    assert found.dtype == expected.dtype == np.float64
    np.testing.assert_allclose(found, expected, atol=1e-4 * float(jnp.abs(expected).max()))
