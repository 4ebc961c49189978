"""Sums that XLA compiles as loops: equal to `jnp.sum` in every transformation, and kept from XLA's slow library."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.linalg.small_matrices import summed


@pytest.fixture(scope="module")
def terms():
    return jnp.asarray(np.random.default_rng(3).normal(size=(5, 3, 4)))


@pytest.mark.parametrize("axis", [0, 1, -1])
@pytest.mark.parametrize("transform", [jax.jit, jax.jacfwd, jax.jacrev, jax.vmap, lambda f: jax.jacfwd(jax.jacrev(f))])
def test_a_sum_by_loop_equals_jnp_sum_in_every_transformation(terms, axis, transform):
    ours, numpys = (transform(lambda t, total=total: total(t, axis) ** 2) for total in (summed, jnp.sum))
    given = terms if transform is not jax.vmap else jnp.stack([terms, 2 * terms])
    np.testing.assert_allclose(ours(given), numpys(given), rtol=1e-14)


@pytest.mark.parametrize("batch", [0, 1, 2, 3])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mapped_sum_keeps_the_place_of_the_batch(terms, axis, batch):
    stack = jnp.stack([terms, -3 * terms], batch)
    found = jax.vmap(lambda t: jax.grad(lambda t: jnp.sum(summed(t, axis) ** 2))(t), batch)(stack)
    exact = jax.vmap(lambda t: jax.grad(lambda t: jnp.sum(jnp.sum(t, axis) ** 2))(t), batch)(stack)
    np.testing.assert_allclose(found, exact, rtol=1e-14)


def test_a_sum_of_another_type_keeps_its_type(terms):
    assert summed(terms.astype(jnp.float32), 1).dtype == jnp.float32


def _compiled(function, *arguments):
    """The text of the program that a user's own jit, without options, makes of a function."""
    return jax.jit(function).lower(*arguments).compile().as_text()


@pytest.mark.slow  # with XLA's optimisations
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="the library is one for CPUs")
def test_no_sum_of_the_forward_model_goes_to_the_library_of_threads_in_a_users_own_jit(model):
    arrays, static = eqx.partition(model, eqx.is_array)
    if "ynn" not in _compiled(lambda t: jnp.sum(t, 1), jnp.ones((100, 100, 10))):
        pytest.skip("this XLA gives no sum to the library")
    assert "ynn" not in _compiled(lambda a, s: je.forward(eqx.combine(a, static), s), arrays, model.background)
