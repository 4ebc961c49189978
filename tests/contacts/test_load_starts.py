"""Atoms from which fits of loads begin."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxeit.contacts.loads.starts import Starts
from jaxeit.effects import ContactPiezoresistance


def _starts(atoms):
    places = np.column_stack(
        [np.linspace(0.02, 0.18, len(atoms)), np.full(len(atoms), 0.1), np.full((len(atoms), 2), -4)]
    )
    return Starts(jnp.asarray(atoms), jnp.asarray(places), jnp.asarray(1e-2), ContactPiezoresistance())


@pytest.fixture(scope="module")
def atoms():
    return np.random.default_rng(2).normal(size=(6, 40))


def test_an_atom_that_the_slopes_explain_is_no_other_load(atoms):
    """What is left of it is rounding, whose quotient by itself may be any number."""
    rng, root = np.random.default_rng(3), np.tril(0.1 * np.random.default_rng(4).normal(size=(40, 40))) + np.eye(40)
    slopes = np.column_stack([atoms[:3].T @ rng.normal(size=(3, 3)), rng.normal(size=40)])
    starts, other = _starts(atoms), _starts(atoms[3:])
    for seed in range(20):
        left = np.random.default_rng([5, seed]).normal(size=40)
        fall, load = starts.best_atom(left, root, slopes)
        expected = other.best_atom(left, root, slopes)[0]
        assert fall == pytest.approx(expected)
        assert load[0, 0] >= 0.1  # the place of one of the last three
        assert np.isfinite(load).all()


def test_no_atom_at_all_changes_nothing(atoms):
    """All in the span of the slopes, or zero: no fall, and no NaN."""
    left = np.random.default_rng(6).normal(size=40)
    for starts, slopes in ((_starts(atoms), atoms.T), (_starts(0 * atoms), None)):
        fall, load = starts.best_atom(left, np.eye(40), slopes)
        assert fall == 0
        assert np.isfinite(load).all()


def test_other_atoms_are_found_as_before(atoms):
    fall, load = _starts(atoms).best_atom(3 * atoms[4], np.eye(40))
    assert fall == pytest.approx(9 * np.sum(atoms[4] ** 2))
    assert load[0, 3] == pytest.approx(-4 + np.log(3))
