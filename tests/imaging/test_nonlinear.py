"""Gauss-Newton through the full forward map."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from jaxeit.imaging.absolute import one_frame

from ..helpers import skin_of, spread_stacks, square_model

PENALTIES = {
    "variation": lambda picture: je.imaging.IsotropicVariation(),
    "Laplace": lambda picture: je.imaging.Quadratic(je.Laplace().precision(jnp.ones((1, picture.size)), picture), 3.0),
}


@pytest.fixture(scope="module")
def coarse(model):
    return je.Pixels(12).on(model)


@pytest.fixture(scope="module")
def physics(model, coarse):
    return je.imaging.LogConductivity(model, coarse, model.background[0])


def block(places):
    """A square twice as conductive as the sheet."""
    return 2.0 ** np.all(np.abs(np.asarray(places) - [0.08, 0.12]) < 0.03, -1)


@pytest.fixture(scope="module")
def readings(skin):
    """Of the block, on a finer mesh than the one that images it."""
    fine = je.discretise(je.Scene(skin), je.Fidelity.draft(edge_length=0.04))
    return np.asarray(je.forward(fine, fine.background * block(fine.centroids)))


@pytest.mark.slow
def test_slopes_are_those_of_the_voltages(physics):
    rng = np.random.default_rng(0)
    x, step = (jnp.asarray(rng.normal(size=144)) for _ in range(2))
    _, along = jax.jvp(physics.voltages, (x,), (step,))
    np.testing.assert_allclose(physics.slopes(x) @ step, along, atol=1e-9 * np.abs(along).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", PENALTIES)
def test_the_matrix_gives_the_gradient_of_the_penalty(coarse, name):
    penalty = PENALTIES[name](coarse.picture)
    x = jnp.asarray(np.random.default_rng(1).normal(size=144))
    slope = jax.grad(lambda x: penalty.value(coarse.picture, x))(x)
    np.testing.assert_allclose(penalty.matrix(coarse.picture, x) @ x, slope, rtol=1e-8, atol=1e-9)


def test_variation_does_not_ask_which_way_an_edge_runs(coarse):
    """A straight edge costs its height times its length, on end or aslant; over the side of the sheet, 0.2 m."""
    picture = coarse.picture
    cost = {}
    for angle in (0.0, 0.5, np.pi / 4, np.pi / 2):
        along = (picture.centres - 0.1) @ jnp.array([np.cos(angle), np.sin(angle)])
        ramp = jnp.clip(along / 0.06, -1, 1)
        cost[angle] = float(je.imaging.IsotropicVariation(0.2, 1e-6, 0.0).value(picture, ramp))
    length = [0.2, 0.2 / np.cos(0.5), 0.2 * np.sqrt(2) - 0.06, 0.2]  # mean over the ramp's width: corners cut it
    np.testing.assert_allclose(list(cost.values()), 2 * np.array(length), rtol=0.07)


@pytest.mark.slow
def test_variation_means_the_same_in_tanks_of_any_size():
    """The same image and readings relative to their errors, in a tank of a tenth of the size and conductivity."""
    found = []
    for size, sigma in ((0.2, 1.0), (0.02, 0.1)):
        points = size * np.array([(0.25, 0.25), (0.75, 0.25), (0.75, 0.75), (0.25, 0.75), (0.5, 0.5), (0.5, 0.0)])
        square = je.Rectangle(size, size)
        electrodes = [je.PointElectrode((float(x), float(y))) for x, y in points]
        skin = skin_of(square, electrodes, je.skin.adjacent(6), sheet_resistance=1 / sigma)
        model = je.discretise(je.Scene(skin), je.Fidelity(), mesh=je.meshing.structured(square, 8, 8))
        physics = je.imaging.LogConductivity(model, je.Pixels(6).on(model), model.background[0])
        readings = physics.voltages(jnp.where(physics.image.centres[:, 0] > size / 2, 1.0, 0.0))
        std = jnp.full(len(readings), 1e-3 * float(jnp.max(jnp.abs(readings))))
        found.append(je.gauss_newton(physics, je.imaging.IsotropicVariation(weight=0.5), readings, std))
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)
    assert np.ptp(found[0]) > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("missing", [0, 60])
def test_a_block_is_found_in_absolute_readings(physics, coarse, readings, missing):
    """Twice the conductivity is far from linear: its height comes out right, which one linear step misses."""
    readings = readings.copy()
    readings[np.random.default_rng(2).permutation(550)[:missing]] = np.nan
    std = np.full(550, 3e-3 * np.nanstd(readings))
    found = np.exp(
        je.gauss_newton(physics, je.imaging.IsotropicVariation(weight=8.0), jnp.asarray(readings), jnp.asarray(std))
    )
    truth = block(coarse.centres)
    assert np.isfinite(found).all()
    assert (found > 0).all()
    assert np.corrcoef(found, truth)[0, 1] > 0.85
    assert found[truth > 1].mean() == pytest.approx(2, abs=0.3)
    assert found[truth == 1].mean() == pytest.approx(1, abs=0.05)


@pytest.mark.slow
def test_what_fits_already_is_left_alone(physics):
    readings = physics.voltages(jnp.zeros(144))
    found = je.gauss_newton(physics, je.imaging.IsotropicVariation(), readings, jnp.full(550, 1e-6))
    assert np.abs(found).max() < 1e-6


@pytest.fixture(scope="module")
def tiny():
    """Six electrodes, 32 triangles, 16 pixels."""
    points = [(0.05, 0.05), (0.15, 0.05), (0.15, 0.15), (0.05, 0.15), (0.1, 0.1), (0.1, 0.0)]
    model = square_model(points, je.skin.adjacent(6), 4)
    return je.imaging.LogConductivity(model, je.Pixels(4).on(model), model.background[0])


@pytest.mark.slow
def test_readings_not_finite_or_of_unknown_noise_are_left_out(tiny):
    readings = tiny.voltages(0.1 * jnp.cos(jnp.arange(16.0)))
    std = jnp.full(len(readings), 1e-3 * float(jnp.std(readings)))
    images = [
        je.gauss_newton(tiny, je.imaging.IsotropicVariation(weight=0.2), *given, steps=2)
        for given in ((readings.at[2].set(jnp.nan), std), (readings.at[2].set(1e9), std.at[2].set(jnp.nan)))
    ]
    assert np.isfinite(images[0]).all()
    np.testing.assert_array_equal(images[1], images[0])


@pytest.mark.slow
def test_a_step_that_overshoots_is_halved(tiny):
    """A whole one would multiply the voltages by exp(18) here, where exp(3) is right."""
    readings = tiny.voltages(jnp.full(16, -3.0))
    std = jnp.full(len(readings), 1e-3 * float(jnp.std(readings)))
    found = je.gauss_newton(tiny, je.imaging.IsotropicVariation(weight=2e-4, ridge=1e-6), readings, std)
    np.testing.assert_allclose(found, -3, atol=0.05)


def _tiny_penalty(tiny):
    picture = tiny.image.picture
    return je.imaging.Quadratic(je.Laplace(floor=0.1).precision(jnp.ones((1, picture.size)), picture), 20.0)


def test_optimistix_ends_where_gauss_newton_does(tiny):
    readings = tiny.voltages(0.8 * jnp.cos(jnp.arange(16.0)))
    std, penalty = jnp.full(len(readings), 1e-3 * float(jnp.std(readings))), _tiny_penalty(tiny)
    for given in (readings, readings.at[2].set(jnp.nan)):
        found = je.imaging.least_squares_image(tiny, penalty, given, std)
        again = je.gauss_newton(tiny, penalty, given, std, steps=30, tolerance=1e-12)
        np.testing.assert_allclose(found, again, atol=1e-4)
        assert np.abs(found).max() > 0.3


@pytest.mark.slow
def test_such_an_image_has_derivatives(tiny):
    readings = tiny.voltages(0.8 * jnp.cos(jnp.arange(16.0)))
    std, penalty = jnp.full(len(readings), 1e-3 * float(jnp.std(readings))), _tiny_penalty(tiny)
    along = jnp.asarray(np.random.default_rng(0).normal(size=len(readings))) * std

    def image(given):
        return je.imaging.least_squares_image(tiny, penalty, given, std)

    _, slope = jax.jvp(image, (readings,), (along,))
    change = (image(readings + 0.01 * along) - image(readings - 0.01 * along)) / 0.02
    np.testing.assert_allclose(slope, change, atol=1e-4 * np.abs(change).max())
    back = jax.grad(lambda given: jnp.sum(image(given) ** 2))(readings) @ along
    assert float(back) == pytest.approx(float(2 * image(readings) @ slope), rel=1e-4)


IMAGES = {
    "gauss_newton": lambda *given: je.gauss_newton(*given, steps=40, tolerance=1e-12),
    "least_squares_image": je.imaging.least_squares_image,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("what", ["readings", "conductivity", "hyperparameter"])
def test_gradients_of_an_image_agree_with_differences(tiny, name, what):
    """Under jit."""
    readings = tiny.voltages(0.8 * jnp.cos(jnp.arange(16.0)))
    readings = readings + 0.05 * jnp.std(readings) * jnp.sin(jnp.arange(len(readings)))
    std = jnp.full(len(readings), 1e-2 * float(jnp.std(readings)))
    precision, one = _tiny_penalty(tiny).precision, jnp.ones(())
    start = {"readings": readings, "conductivity": one, "hyperparameter": one}

    def total(value):
        given = start | {what: value}
        physics = eqx.tree_at(lambda p: p.background, tiny, tiny.background * given["conductivity"])
        penalty = je.imaging.Quadratic(precision, 20.0 * given["hyperparameter"])
        return IMAGES[name](physics, penalty, given["readings"], std) @ jnp.cos(jnp.arange(16.0))

    value = start[what]
    along = value * jnp.asarray(np.random.default_rng(0).normal(size=value.shape))
    program, step = jax.jit(total), 1e-4
    change = float(program(value + step * along) - program(value - step * along)) / (2 * step)
    assert float(jnp.vdot(jax.jit(jax.grad(total))(value), along)) == pytest.approx(change, rel=1e-4)


def test_many_images_mapped_wait_for_no_thread(tiny):
    """See `jaxeit.linalg.lapack`; the Gauss-Newton steps of optimistix too."""
    readings = tiny.voltages(jnp.zeros(16))
    std, penalty = jnp.ones(len(readings)), _tiny_penalty(tiny)
    program = jax.vmap(lambda given: je.imaging.least_squares_image(tiny, penalty, given, std))
    many = jax.ShapeDtypeStruct((100_000, len(readings)), readings.dtype)
    assert not spread_stacks(jax.jit(program).lower(many).as_text())


def test_an_image_that_did_not_converge_is_not_given(tiny):
    readings = tiny.voltages(0.8 * jnp.cos(jnp.arange(16.0)))
    found = je.imaging.least_squares_image(tiny, _tiny_penalty(tiny), readings, jnp.full(len(readings), 1e-6), steps=1)
    assert np.isnan(found).all()


def test_an_image_after_its_last_step_says_so(tiny):
    """The image itself is that of `gauss_newton`: the best of the steps that were allowed."""
    readings = tiny.voltages(0.8 * jnp.cos(jnp.arange(16.0)))
    given = tiny, _tiny_penalty(tiny), readings, jnp.full(len(readings), 1e-3 * float(jnp.std(readings)))
    short, whole = (je.imaging.gauss_newton_fit(*given, steps=steps) for steps in (1, 30))
    assert (bool(short.converged), bool(whole.converged)) == (False, True)
    np.testing.assert_array_equal(je.gauss_newton(*given, steps=1), short.image)
    assert np.isfinite(short.image).all()
    assert np.abs(short.image - whole.image).max() > 1e-3


@pytest.mark.parametrize("fit", [je.gauss_newton, je.imaging.least_squares_image])
def test_errors_of_zero_are_refused_or_leave_a_reading_out(tiny, fit):
    """A weight without end made the image zero throughout."""
    readings, penalty = tiny.voltages(0.8 * jnp.cos(jnp.arange(16.0))), _tiny_penalty(tiny)
    std = jnp.full(len(readings), 1e-2 * float(jnp.std(readings)))
    for bad in (0.0, -1.0):
        with pytest.raises(
            je.imaging.InverseError, match=rf"std of reading 3 is {bad:g} V; give a standard error above"
        ):
            fit(tiny, penalty, readings, std.at[3].set(bad))
    hidden = jax.jit(lambda std: fit(tiny, penalty, readings, std))(std.at[3].set(0.0))
    np.testing.assert_allclose(hidden, fit(tiny, penalty, readings, std.at[3].set(jnp.nan)), atol=1e-9)
    assert np.abs(hidden).max() > 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": 0}, "steps is 0; give a whole number above zero"),
        ({"steps": True}, "steps is True"),
        ({"tolerance": -1.0}, "tolerance is -1.0; give a number of zero or more"),
        ({"tolerance": float("nan")}, "tolerance is nan"),
    ],
)
def test_steps_and_tolerances_that_no_fit_has_are_refused(tiny, settings, message):
    readings = tiny.voltages(jnp.zeros(16))
    with pytest.raises(je.imaging.InverseError, match=message):
        je.gauss_newton(tiny, _tiny_penalty(tiny), readings, jnp.ones(len(readings)), **settings)


@pytest.mark.parametrize("fit", [je.gauss_newton, je.imaging.least_squares_image])
def test_readings_of_another_protocol_are_refused(tiny, fit):
    with pytest.raises(je.imaging.InverseError, match=r"readings has shape \(3,\); give the"):
        fit(tiny, _tiny_penalty(tiny), jnp.ones(3), jnp.ones(3))
    readings = tiny.voltages(jnp.zeros(16))
    with pytest.raises(je.imaging.InverseError, match="steps is 0"):
        fit(tiny, _tiny_penalty(tiny), readings, jnp.ones(len(readings)), steps=0)


def test_absolute_images_and_coats_tell_whether_they_converged(tiny, monkeypatch):
    readings = tiny.voltages(0.8 * jnp.cos(jnp.arange(16.0)))
    shown = je.imaging.absolute_image(tiny.model, readings, je.Pixels(4))
    assert shown.converged
    monkeypatch.setattr(one_frame, "gauss_newton_fit", partial(je.imaging.gauss_newton_fit, steps=1))
    assert not je.imaging.absolute_image(tiny.model, readings, je.Pixels(4), error=1e-4).converged
    classes = je.imaging.segment(tiny.model, tiny.voltages(jnp.zeros(16)), readings, je.Pixels(4), borders=None)
    assert not classes.converged
    assert not classes.borders_converged
    with pytest.raises(je.imaging.InverseError, match="tolerance is -1"):
        je.fit_background(tiny.model, readings, columns=4, tolerance=-1.0)
