"""Conductivities far apart, near zero or none, and the choice of ground, against exact arithmetic."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.model.forward_model import transfer
from jaxeit.model.sheet_conductivity import coefficients

from ..hard_sheet import (
    MESH,
    PAIRS,
    by_inverse,
    by_penalty,
    by_schur_and_pinv,
    exact,
    found,
    grounded,
    paired,
    sheet_model,
    unknown_of,
    worst,
)

CONTACTS = (1.0,) * 4
X, Y = MESH.centroids.T
FLAT = np.random.default_rng(0).integers(1, 33, 64) / 16.0
TEAR = (X > 3) & (X < 5) & (Y < 3)  # with the middle of the sheet in it, and none of the electrodes
ACROSS = (X > 3) & (X < 5)  # from rim to rim, two electrodes on either side


def _powers(decades):
    """Conductivities of 10^decades, rounded to powers of two, so that both precisions have them exactly."""
    return 2.0 ** np.round(np.asarray(decades) / np.log10(2))


def _random(decades):
    return _powers(np.random.default_rng(1).uniform(-decades, decades, 64))


def _smooth(decades):
    return _powers(decades * np.sin(2 * np.pi * X / 8) * np.cos(np.pi * Y / 4))


def _errors(sigma, contacts=CONTACTS):
    """Of each reading, in both precisions; the worse of the two direct solvers."""
    right = exact(sigma, contacts)
    return [
        max(worst(found(sheet_model(solver, dtype), sigma, contacts), right) for solver in (je.linalg.Dense(), SPARSE))
        for dtype in ("float64", "float32")
    ]


SPARSE = je.linalg.NestedDissection()


@pytest.mark.parametrize("field", [_random, _smooth])
def test_contrast_of_twelve_decades(field, hard):
    """Every reading, although some are 1e-11 of others; in float32 to two digits, where the textbook has none."""
    for decades, bound in ((3, (1e-11, 1e-3)), (6, (1e-9, 0.2))):
        double, single = _errors(field(decades))
        assert double < bound[0]
        assert single < bound[1]
        hard(
            f"contrast 1e±{decades}, {field.__name__[1:]}",
            "each element of its own, of each reading" if field is _random else "one wave, of each reading",
            float64=double,
            float32=single,
            naive=worst(by_schur_and_pinv(field(decades), CONTACTS), exact(field(decades), CONTACTS)),
            beyond="an error of about rounding times the ratio of conductivities that a current must cross",
        )


def test_the_textbook_is_lost_in_contrast():
    sigma = _random(6)
    right = exact(sigma, CONTACTS)
    assert worst(by_schur_and_pinv(sigma, CONTACTS), right) > 0.99
    assert worst(by_inverse(sigma, CONTACTS, np.float32), right) > 0.99
    assert worst(by_penalty(sigma, CONTACTS), right) > 50 * _errors(sigma)[0]


@pytest.mark.parametrize("decades", [-3, -6, -12, -18])
def test_a_tear_in_the_middle_costs_nothing(decades, hard):
    """However little it conducts: the ground is elsewhere, where a fixed one in it would see all through the tear."""
    sigma = np.where(TEAR, _powers(decades), 1.0) * FLAT
    double, single = _errors(sigma)
    assert double < 1e-10
    assert single < 0.01
    inside = int(np.argmin(np.linalg.norm(MESH.nodes - [4.0, 2.0], axis=1)))
    fixed = grounded(sheet_model(SPARSE), inside)
    error = worst(found(fixed, sigma, CONTACTS), exact(sigma, CONTACTS))
    if decades <= -12:
        assert not error < 1e-2
    hard(
        "conductivity near zero in a tear of the sheet",
        "1e-18 of the rest, of each reading",
        float64=double,
        float32=single,
        naive=error,
        beyond="no limit found; zero all around a place, or a negative value: no reading is finite",
    )


def test_between_halves_that_hardly_touch_digits_are_lost_and_told(hard):
    """Rounding of a row of the matrix over the conductance that is left of it; the textbook's is no better."""
    for decades in (-3, -6, -9, -12):
        sigma = np.where(ACROSS, _powers(decades), 1.0) * FLAT
        right = exact(sigma, CONTACTS)
        double = worst(found(sheet_model(SPARSE), sigma, CONTACTS), right)
        assert double < 1e-14 * 10.0 ** (-1.5 * decades)
        assert 0.1 * double < _told(sigma, right) < 10 * double
        hard(
            "conductivity near zero across the whole sheet",
            "1e-12 of the rest, of each reading",
            float64=double,
            naive=worst(by_inverse(sigma, CONTACTS), right),
            beyond="`rounding` estimates the error of each reading; below rounding no reading is finite",
        )


def _told(sigma, right, dtype="float64"):
    """The largest error that `rounding` tells of, relative to the reading; of all that `paired` has, in its order."""
    model = sheet_model(SPARSE, dtype)
    every = jnp.asarray([[*drive, *sense] for drive in PAIRS for sense in PAIRS])
    model = eqx.tree_at(lambda m: m.pattern, model, every)
    told = je.model.rounding(model, jnp.asarray(sigma, dtype))
    return float((np.asarray(told, float) / np.abs(right.ravel())).max())


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_what_contrast_costs_is_told(dtype, hard):
    """The worst reading's error: seldom too little of it, and then not by ten times."""
    ratios = []
    for sigma in (_smooth(3), _smooth(6), _random(3), np.where(TEAR, 2.0**-60, 1.0) * FLAT):
        right = exact(sigma, CONTACTS)
        ratios.append(_told(sigma, right, dtype) / worst(found(sheet_model(SPARSE, dtype), sigma, CONTACTS), right))
    assert min(ratios) > 0.1
    assert max(ratios) < 100
    hard(
        "what rounding has done to a reading",
        "contrast up to 1e18, in either precision",
        beyond="`rounding` estimates the error in V: from a tenth to a hundred times the largest error",
    )


def test_iterations_end_where_their_precision_does():
    """In float32 after steps in which float64 has not come to its own end."""
    few = je.linalg.ConjugateGradient(max_steps=34)
    right = exact(FLAT, CONTACTS)
    assert worst(found(sheet_model(few, "float32"), FLAT, CONTACTS), right) < 1e-4
    assert np.isnan(found(sheet_model(few), FLAT, CONTACTS)).all()


@pytest.mark.parametrize("decades", [-300, -30, 30, 300])
def test_units_do_not_matter(decades, hard):
    """A sheet of any conductivity under contacts of as many times the resistance: the same problem."""
    scale = float(_powers(decades))

    def error(dtype):
        read = found(sheet_model(SPARSE, dtype), scale * FLAT, (1 / scale,) * 4)
        return worst(read, exact(FLAT, CONTACTS) / scale)

    double, single = error("float64"), error("float32") if abs(decades) < 38 else None
    assert double < 1e-12
    assert single is None or single < 3e-5
    hard(
        "sheet conductivity as a whole",
        "1e-300 to 1e300 S (float32: 1e-30 to 1e30 S)",
        float64=double,
        float32=single,
        naive=worst(by_inverse(scale * FLAT, CONTACTS), exact(scale * FLAT, CONTACTS)) if decades == -30 else None,
        beyond="what the precision cannot hold is not finite",
    )


@pytest.mark.parametrize("value", [-1e-3, -1.0, np.nan, np.inf])
def test_what_is_no_conductivity_gives_no_reading(value):
    """Slightly negative, the matrix is still positive definite: the textbook reads on."""
    sigma = np.where(np.arange(64) == 20, value, FLAT)
    for dtype in ("float64", "float32"):
        assert np.isnan(found(sheet_model(SPARSE, dtype), sigma, CONTACTS)).all()
    if value == -1e-3:
        assert np.isfinite(by_inverse(sigma, CONTACTS)).all()


def test_any_ground_gives_the_same_readings(hard):
    """Of all nodes that are under no electrode, on a sheet of four decades."""
    model, sigma = sheet_model(SPARSE), _random(2)
    theta = coefficients(model, jnp.asarray(sigma))
    free = [n for n in range(len(MESH.nodes)) if unknown_of(model, n) in np.asarray(model.system.ground)]
    one = grounded(model, free[0])
    zs = [np.asarray(transfer(grounded(one, node), theta)) for node in free]
    right = exact(sigma, CONTACTS)
    errors = [worst(paired(z), right) for z in zs]
    assert max(errors) < 1e-10
    assert max(np.abs(z - zs[0]).max() for z in zs) > 1  # the matrix itself does depend on it
    hard(
        "choice of ground",
        f"each of {len(free)} nodes, contrast 1e±2, of each reading",
        float64=max(errors),
        naive=worst(by_schur_and_pinv(sigma, CONTACTS), right),
        beyond="a node under an electrode: an error that names it",
    )


@pytest.mark.slow
def test_a_ground_amid_the_sheet_costs_fewer_digits(model):
    """At the rim, where the matrix may have its largest entries, a ground sees twice the resistance and more."""
    single = jax.tree.map(lambda a: a.astype(jnp.float32) if eqx.is_inexact_array(a) else a, model)
    anywhere = eqx.tree_at(lambda m: m.system.ground_weight, single, jnp.ones_like(single.system.ground_weight))
    right = np.asarray(je.forward(model))
    amid, other = (np.linalg.norm(np.asarray(je.forward(m), float) - right) for m in (single, anywhere))
    assert amid < 0.7 * other


def test_small_changes_in_float32_are_linearised(hard):
    """A change of 1e-4 in a corner: the derivative has four digits where the difference of readings has one."""
    bump = np.where((X > 6) & (Y > 2), 2.0**-13, 0.0)
    right = exact(1 + bump, CONTACTS) - exact(np.ones(64), CONTACTS)
    model = sheet_model(SPARSE, "float32")
    theta = coefficients(model, jnp.ones(64, jnp.float32))
    theta = theta._replace(contact=jnp.ones(4, jnp.float32))
    along = theta._replace(sigma=jnp.asarray(bump, jnp.float32), contact=jnp.zeros(4, jnp.float32))
    _, slope = jax.jvp(lambda t: transfer(model, t), (theta,), (along,))
    linear = np.abs(paired(np.asarray(slope, float)) - right).max() / np.abs(right).max()
    subtracted = found(model, 1 + bump, CONTACTS) - found(model, np.ones(64), CONTACTS)
    naive = np.abs(subtracted - right).max() / np.abs(right).max()
    assert linear < 5e-4
    assert naive > 10 * linear
    hard(
        "float32: a change of 1e-4 in conductivity",
        "by its derivative; naive: by the difference of two readings",
        float32=linear,
        naive=naive,
        beyond="the second-order term that a derivative neglects, 1e-4 here",
    )
