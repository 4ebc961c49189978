"""Mean square errors of fitted loads, where shapes differ from a Gaussian by more than fits marginalise."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxeit as je
from benchmarks.bench_loads import INSIDE, TIP_SPREAD, shaped
from benchmarks.problems import pressed, uneven
from calib.calibration.localisation.load_windows import LOAD_FIDELITY
from jaxeit.contacts import prepare_loads
from jaxeit.contacts.loads.fits.shape_errors import Linearisation, inverse_of, mean_errors
from jaxeit.contacts.loads.pressure import MAX_LOADS, LoadForm, even_moments, shape_directions, spot, tilt_directions
from jaxeit.contacts.loads.sheet import Sensitivities
from tests.compiled import compiled

READINGS, FREE, SHAPES, TILTS = 12, 3, 6, 2
FACTORS = np.array([0.0, 1.0, 2.0, 4.0, 8.0])


def test_mean_errors_are_those_of_simulated_fits():
    """Frames of a linear problem whose shapes are drawn anew, fitted as if all factors were one."""
    rng = np.random.default_rng(4100)
    loads, shapes, tilts = (rng.normal(size=(READINGS, n)) for n in (FREE, SHAPES, TILTS))
    root = np.linalg.cholesky(np.eye(READINGS) + shapes @ shapes.T)
    white = np.linalg.solve(root, loads)
    believed = np.linalg.inv(white.T @ white + np.eye(FREE))
    free, elongation = np.array([True, False, True, True]), np.zeros((READINGS, 2))
    every = np.insert(loads, 1, 7.0, axis=1)  # of a parameter that is not fitted
    odd = np.array([0, 0, 1, 1, 0, 0, 1, 1])  # of one load, and the moments of next order
    stated, seen, left = [], [], []
    for _ in range(3000):
        true, factors = rng.normal(size=FREE), rng.choice(FACTORS, 2)[odd]
        bent = np.concatenate([shapes, tilts], 1) @ (factors * rng.normal(size=SHAPES + TILTS))
        y = loads @ true + bent + rng.normal(size=READINGS)
        found = believed @ white.T @ np.linalg.solve(root, y)
        end = Sensitivities(loads @ found, shapes, shapes, tilts, every, elongation, np.zeros((READINGS, 3)))
        mean, square = mean_errors(Linearisation(y, end, root, found, np.eye(FREE)), free, FACTORS)
        stated.append(square)
        seen.append(np.outer(true - found, true - found))
        left.append(np.outer(true - found - mean, true - found - mean))
    error, scale = np.mean(seen, 0), 1 / np.sqrt(np.diag(np.mean(seen, 0)))
    np.testing.assert_allclose(scale[:, None] * np.mean(stated, 0) * scale, scale[:, None] * error * scale, atol=0.1)
    assert (np.diag(error) > 2 * np.diag(believed)).all()
    assert np.trace(np.mean(left, 0)) < 0.9 * np.trace(error)


def test_without_larger_shapes_a_fit_at_rest_keeps_its_covariance():
    rng = np.random.default_rng(4101)
    loads, shapes = rng.normal(size=(READINGS, FREE)), rng.normal(size=(READINGS, SHAPES))
    root, y = np.linalg.cholesky(np.eye(READINGS) + shapes @ shapes.T), rng.normal(size=READINGS)
    white = np.linalg.solve(root, loads)
    believed = np.linalg.inv(white.T @ white + np.eye(FREE))
    found = believed @ white.T @ np.linalg.solve(root, y)
    tilts, elongation, law = (np.zeros((READINGS, n)) for n in (0, 2, 3))
    end = Sensitivities(loads @ found, shapes, shapes, tilts, loads, elongation, law)
    mean, stated = mean_errors(Linearisation(y, end, root, found, np.eye(FREE)), np.ones(FREE, bool), np.ones(1))
    np.testing.assert_allclose(stated, believed, atol=1e-12)
    np.testing.assert_allclose(mean, 0, atol=1e-12)


def test_an_inverse_leaves_out_what_nothing_tells():
    units = np.diag([1e-6, 1.0, 1e6])
    told, volume = inverse_of(units @ np.diag([2.0, 3.0, 0.0]) @ units)
    np.testing.assert_allclose(told, np.diag([0.5e12, 1 / 3, 0.0]))
    assert np.isfinite(volume)
    normal = np.array([[2.0, 1.0], [1.0, 3.0]])
    np.testing.assert_allclose(inverse_of(normal)[0], np.linalg.inv(normal))
    assert inverse_of(normal)[1] == pytest.approx(np.log(5.0))


def test_moments_of_next_order_change_nothing_that_the_others_change():
    """By quadrature, with the Gaussian's inverse as weight; neither force nor place changes."""
    axis = np.arange(0, 0.2, 5e-4) + 2.5e-4
    points, area = jnp.stack(jnp.meshgrid(axis, axis), -1), 5e-4**2
    one = jnp.array([0.1, 0.1, np.log(0.01), np.log(7.0), 0.0, 0.0])
    rows, forms = jnp.stack([one] * MAX_LOADS), jnp.array([LoadForm.ROUND] + [LoadForm.ABSENT] * (MAX_LOADS - 1))
    tilts = np.asarray(compiled(tilt_directions, rows, forms, points))
    assert not tilts[..., 2:].any()
    away = (np.asarray(points) - 0.1) / 0.01
    for moment in (np.ones(points.shape[:2]), *np.moveaxis(away, -1, 0)):
        np.testing.assert_allclose(np.einsum("xyd,xy->d", tilts, moment) * area / 7.0, 0, atol=1e-7)
    every = np.concatenate([tilts[..., :2], np.asarray(compiled(shape_directions, rows, forms, points))[..., :6]], -1)
    weight = area / 7.0 / np.asarray(compiled(spot, one, points))
    products = np.einsum("xyd,xye,xy->de", tilts[..., :2], every, weight)
    np.testing.assert_allclose(products, np.eye(2, 8), atol=1e-6)


def test_even_moments_are_equal_at_opposite_places():
    points = jnp.asarray(np.random.default_rng(4102).uniform(-0.02, 0.02, (9, 2)))
    row = jnp.array([0.0, 0.0, np.log(0.01), 2.0, 0.0, 0.0])
    forms = jnp.array([LoadForm.ROUND] + [LoadForm.ABSENT] * (MAX_LOADS - 1))
    found = np.asarray(
        compiled(shape_directions, jnp.stack([row] * MAX_LOADS), forms, jnp.concatenate([points, -points]))
    )
    one, other = found[:9, :6], found[9:, :6]
    np.testing.assert_allclose(
        other, np.where(even_moments(found.shape[1])[:6], 1, -1) * one, atol=1e-9 * np.abs(one).max()
    )


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["tilted", "ring"])
def test_ellipses_hold_tips_of_other_shapes_where_noise_is_low(shape):
    """80 dB, on four sheets known from untouched frames, on a mesh, a coat and a gain that the fit does not know."""
    model = je.discretise(je.Scene(je.load_skin("testbed")), LOAD_FIDELITY)
    inside = []
    for seed in range(4200, 4204):
        touches = list(shaped(np.random.default_rng(seed), shape, 10))
        places, loads = (np.stack([getattr(t, name) for t in touches]) for name in ("places", "loads"))
        found = pressed(uneven(seed), places, loads, spread=TIP_SPREAD)
        found = found._replace(noise=0.1 * found.noise)
        blank, frames = found.frames(np.random.default_rng(seed))
        noise = np.full(blank.size, found.noise)
        finder = je.prepare_contacts(model, noise=noise, untouched=blank)
        fitter = prepare_loads(model, noise=noise, untouched=blank)
        for touch, frame in zip(touches, frames, strict=True):
            one = fitter(frame, finder(frame)).one
            away = np.asarray(one.position[0]) - touch.truth[0]
            inside.append(away @ np.linalg.solve(np.asarray(one.position_covariance[0]), away) < INSIDE)
    assert 0.82 < np.mean(inside) <= 1
