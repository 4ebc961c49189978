"""The conductivity of an uneven sheet, found from an untouched frame."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging.absolute.background import coat_precision, even_coat, fit_background, fitted_sheet
from jaxeit.imaging.inputs import InverseError

from ..helpers import require_identical, square_model


@pytest.fixture(scope="module")
def uneven(skin):
    """Another mesh, with an uneven coating."""
    return je.discretise(
        je.Scene(skin, (je.effects.CoatingNonUniformity(0.15, 0.03, seed=3),)), je.Fidelity(edge_length=0.04)
    )


@pytest.fixture(scope="module")
def untouched(uneven):
    return np.asarray(je.forward(uneven))


def _log(model, sigma):
    """Logarithm of the conductivity, less its mean."""
    log, areas = np.log(np.asarray(sigma)), np.asarray(model.areas)
    return log - np.average(log, weights=areas)


def _near(places, others):
    return np.argmin(np.linalg.norm(np.asarray(places)[:, None] - np.asarray(others), axis=-1), axis=1)


@pytest.fixture(scope="module")
def truth(model, uneven):
    return _log(uneven, je.conductivity(uneven))[_near(model.centroids, uneven.centroids)]


@pytest.mark.slow
def test_the_field_is_found_whatever_the_gain_and_without_a_reading(model, untouched, truth):
    untouched = np.where(np.arange(550) == 7, np.nan, untouched)
    found = [_log(model, fit_background(model, gain * untouched, columns=15)) for gain in (1.0, 3.0)]
    assert np.std(found[0] - truth) < 0.3 * np.std(truth)
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)


@pytest.mark.slow
def test_a_fitted_sheet_states_its_error(model):
    """Coats of the prior, and readings that err by 1 %: intervals of 90 % hold the logarithm of the conductivity."""
    _, physics = even_coat("v0", model, je.forward(model), je.Pixels(20).on(model))
    precision = np.asarray(coat_precision(physics.image, 0.03).matrix())
    held = []
    for seed in range(3):
        rng = np.random.default_rng([31, seed])
        x = 0.15 * np.linalg.solve(np.linalg.cholesky(precision).T, rng.normal(size=len(precision)))
        v0 = physics.voltages(jnp.asarray(x))
        found = fitted_sheet(model, v0 * (1 + 0.01 * rng.normal(size=len(v0))))
        error = np.log(np.asarray(found.sigma / physics.sigma(jnp.asarray(x))))
        deviation = np.linalg.norm(found.errors, axis=1)
        assert 0.01 < np.median(deviation) < 0.05
        held.append(np.average(np.abs(error) < 1.645 * deviation, weights=np.asarray(model.areas)))
    assert 0.83 < np.mean(held) < 0.95


@pytest.mark.slow
def test_a_touch_is_seen_through_the_field(model, uneven, untouched):
    """The place of a faint touch: wrong by much where the sheet is taken for even."""
    place = np.array([0.062, 0.091])
    bump = jnp.exp(-0.5 * jnp.sum((uneven.centroids - place) ** 2, -1) / 0.012**2)
    dv = np.asarray(je.forward(uneven, je.conductivity(uneven) * (1 + 0.1 * bump))) - untouched
    error = {}
    for name, frame in (("even", None), ("known", untouched)):
        finder = je.prepare_contacts(
            model, je.contacts.ContactSettings(most=1, columns=31), noise=np.full(550, 1e-5), untouched=frame
        )
        error[name] = float(jnp.linalg.norm(finder(dv).position[0] - place))
    assert error["known"] < 5e-4
    assert error["known"] < 0.5 * error["even"]


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (lambda v: v[1:], {}, "550 readings"),
        (lambda v: v * np.nan, {}, "no reading"),
        (lambda v: -v, {}, "polarity"),
        pytest.param(
            lambda v: v * np.where(np.arange(len(v)) % 2, 3.0, 1.0), {}, "no coating explains", marks=pytest.mark.slow
        ),
        (lambda v: v, {"std": 0.0}, "std is 0.0"),
    ],
)
def test_what_no_field_explains_is_refused(model, untouched, change, settings, message):
    with pytest.raises(InverseError, match=message):
        fit_background(model, change(untouched), **({"columns": 15} | settings))


@pytest.mark.slow
def test_works_under_jit_and_its_gradients_agree_with_differences():
    """With respect to the frame, the prior's size and length, and the conductivity of the model."""
    points = [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.15), (0.1, 0.1), (0.1, 0.0)]
    tiny = square_model(points, je.skin.adjacent(6), 4)
    uneven = tiny.background * jnp.exp(0.15 * jnp.asarray(np.random.default_rng(0).normal(size=len(tiny.areas))))
    basis = je.Pixels(4).on(tiny)

    def fitted(v0, std, length, background):
        model = eqx.tree_at(lambda m: m.background, tiny, background)
        return fit_background(model, v0, std=std, length=length, basis=basis, tolerance=1e-12)

    given = je.forward(tiny, uneven), jnp.asarray(0.15), jnp.asarray(0.03), tiny.background
    np.testing.assert_allclose(jax.jit(fitted)(*given), fitted(*given), rtol=1e-9)
    program = jax.jit(lambda *given: jnp.cos(jnp.arange(32.0)) @ jnp.log(fitted(*given)))
    gradient = jax.jit(jax.grad(program, (0, 1, 2, 3)))(*given)
    for k, (value, slope) in enumerate(zip(given, gradient, strict=True)):
        along = value * jnp.asarray(np.random.default_rng(1).normal(size=value.shape))
        up, down = ([*given[:k], value + step * along, *given[k + 1 :]] for step in (1e-4, -1e-4))
        change = float(program(*up) - program(*down)) / 2e-4
        assert float(jnp.vdot(slope, along)) == pytest.approx(change, rel=1e-4)


def test_an_image_is_prepared_from_the_frame_of_the_untouched_sheet(model, untouched):
    fitted = je.prepare(model, basis=je.Pixels(10), sigma=je.fit_background(model, untouched))
    by_frame = je.prepare(model, basis=je.Pixels(10), untouched=untouched)
    require_identical(by_frame.matrix, fitted.matrix)
    assert not np.allclose(by_frame.matrix, je.prepare(model, basis=je.Pixels(10)).matrix, rtol=0.01)
    with pytest.raises(je.imaging.InverseError, match="give one of them"):
        je.prepare(model, untouched=untouched, sigma=model.background)
    with pytest.raises(je.imaging.InverseError, match="no coating explains"):
        je.Imaging().prepare(model, untouched=np.asarray(untouched)[::-1])
