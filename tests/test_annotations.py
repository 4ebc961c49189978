"""The check of annotations itself: it is in force, and it finds what it should."""

import jax.numpy as jnp
import jaxtyping
import pytest
from jaxtyping import Array, Float, TypeCheckError

import calib
import jaxeit as je
from tests.annotations import MOST_CHECKS, after_the_call, begin_test, checked_when_called

pytestmark = pytest.mark.skipif(jaxtyping.config.jaxtyping_disable, reason="the check is left out")


def half(values: Float[Array, " n"]) -> Float[Array, " n"]:
    if values.ndim != 1:
        raise ValueError("one axis")
    return values[::2]


@pytest.fixture
def checked():
    return checked_when_called(half, typechecker=after_the_call)


def test_a_result_that_is_not_as_annotated_is_found(checked):
    assert checked(jnp.ones(1)).shape == (1,)
    with pytest.raises(TypeCheckError, match="return value"):
        checked(jnp.ones(4))


def test_an_argument_that_is_not_as_annotated_is_found_unless_the_function_refuses_it(checked):
    with pytest.raises(TypeCheckError, match="Float"):
        checked(jnp.ones(1, int))
    with pytest.raises(ValueError, match="one axis"):
        checked(jnp.ones((2, 2)))


def test_a_loop_is_checked_a_few_times_and_each_test_anew(checked):
    for _ in range(MOST_CHECKS):
        checked(jnp.ones(1))
    assert checked(jnp.ones(4)).shape == (2,)
    begin_test()
    with pytest.raises(TypeCheckError, match="return value"):
        checked(jnp.ones(4))


def test_functions_and_dataclasses_of_the_packages_are_checked():
    for checked in (je.load_skin, je.Pixels.on, je.Pixels.__init__, calib.fit_curves):
        assert checked.__code__.co_filename.endswith("annotations.py"), checked
