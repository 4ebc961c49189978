"""Fields of the gain over a pad where little is known of a press, or nothing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calib.calibration.localisation.locators import LOCATORS, ImageCentroid
from calib.fitting.fields import (
    FittedField,
    PadEdge,
    Places,
    RadialBasis,
    fit_field,
    geometry_of,
    log_gain,
    single_places,
)
from calib.fitting.fields.evidence import ProjectedPresses, _shape_posterior, project_out_levels
from calib.fitting.fields.fit import _supported_box
from calib.fitting.fields.fitted import pad_features
from calib.fitting.fields.geometry import distance, nearest_points
from calib.fitting.results import FitResult

FEATURES = eqx.filter_jit(pad_features)
ONE = np.array([[0.03, 0.05]])


@pytest.fixture(scope="module")
def geometry(skin):
    return geometry_of(skin)


def test_a_place_on_a_wall_has_a_slope_of_zero():
    np.testing.assert_array_equal(jax.grad(distance)(jnp.ones(2), jnp.ones(2)), 0)


@pytest.mark.parametrize("field", [PadEdge(), RadialBasis()])
def test_a_contact_that_is_not_there_changes_nothing(geometry, field):
    one = single_places(ONE, 4)
    none = Places(jnp.full((1, 1, 2), jnp.nan), jnp.zeros((1, 1, 4)), jnp.full((1, 1), jnp.nan), jnp.zeros((1, 1)))
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b], 1), one, none)
    alone = FEATURES(field, geometry, one)
    np.testing.assert_allclose(FEATURES(field, geometry, both), alone, rtol=1e-12)
    np.testing.assert_array_equal(FEATURES(field, geometry, none), 0 * alone)


def test_a_side_of_no_length_is_its_corner():
    np.testing.assert_array_equal(nearest_points(jnp.ones(2), jnp.zeros((1, 2)), jnp.zeros((1, 2))), 0)


def test_a_contact_that_is_not_known_has_an_uncertainty_and_no_gain(geometry):
    """Of presses that scatter about the field more than about nothing, too."""
    none, size = jnp.zeros(()), len(PadEdge().shapes()[0])
    box = jnp.broadcast_to(jnp.array([[0.0, 0.0], [0.2, 0.2]]), (4, 2, 2))
    # Noise, spread, evidence, effective coefficients, n, result, scale of errors.
    rest = (none + 2, none + 1, none, none, none, jnp.zeros((), jnp.int32), none + 1)
    fitted = FittedField(PadEdge(), geometry, jnp.ones(size), jnp.eye(size), box, jnp.zeros((4, size)), *rest)
    gain = log_gain(fitted, single_places(np.full((1, 2), np.nan), 4))
    assert not np.asarray(gain.mean).any()
    assert not np.asarray(gain.variance).any()


def test_a_pad_that_no_press_tells_of_is_bounded_by_the_reach_alone(geometry):
    """The press pins its own pad to where it was; the three others it says nothing of."""
    reach = jnp.array([[0.01, 0.01], [0.19, 0.19]])
    box = np.asarray(_supported_box(RadialBasis(), geometry, single_places(ONE, 4), jnp.array([[1.0, 0, 0, 0]]), reach))
    corners = np.stack([geometry.start.min(1), geometry.start.max(1)], 1)
    np.testing.assert_allclose(box[0], np.repeat(ONE, 2, 0))
    np.testing.assert_allclose(box[1:], np.clip(corners[1:], *reach))


def test_one_wall_tells_of_the_others():
    low, high = PadEdge().supported(jnp.array([-0.5, 0.1]), jnp.array([0.2, 0.8]))
    np.testing.assert_array_equal([low, high], [[-0.8, -0.8], [0.8, 0.8]])


def test_what_a_field_would_go_on_to_is_part_of_its_uncertainty_beyond_what_was_pressed(geometry):
    """The square of what lies between level and going on; nothing else where the coefficients are known exactly."""
    size, zero = len(PadEdge().shapes()[0]), jnp.zeros(())
    box = jnp.broadcast_to(jnp.array([[0.03, 0.03], [0.06, 0.06]]), (4, 2, 2))
    # Noise, spread, evidence, effective coefficients, n, result, scale of errors.
    rest = (zero, zero + 1, zero, zero, zero, jnp.zeros((), jnp.int32), zero + 1)
    known = FittedField(
        PadEdge(), geometry, jnp.arange(1.0, size + 1), jnp.zeros((size, size)), box, jnp.zeros((4, size)), *rest
    )
    places = single_places(np.array([[0.045, 0.045], [0.005, 0.045]]), 4)
    there = FEATURES(PadEdge(), geometry, places) @ known.coefficients
    gain = log_gain(known, places)
    np.testing.assert_allclose(gain.variance[:, 0], [0, float((there - gain.mean)[1, 0]) ** 2], atol=1e-12)
    assert gain.variance[1, 0] > 1e-3


def test_a_pad_without_presses_leaves_the_others_their_levels():
    rng = np.random.default_rng(0)
    z, y, weight = (jnp.asarray(a) for a in (rng.normal(size=(9, 2)), rng.normal(size=9), np.ones(9)))
    share = jnp.asarray(np.eye(2)[np.arange(9) % 2])
    with_a_third = project_out_levels(z, y, jnp.pad(share, ((0, 0), (0, 1))), weight)
    for mine, theirs in zip(with_a_third, project_out_levels(z, y, share, weight), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-9)


def test_features_that_are_alike_leave_evidence_in_single_precision():
    """Rounding leaves eigenvalues below zero, ten million times which is less than minus one."""
    rng = np.random.default_rng(1)
    z = (rng.normal(size=(20, 2)) @ rng.normal(size=(2, 6))).astype("f4")
    white = ProjectedPresses(jnp.asarray(z), jnp.asarray(rng.normal(size=20), "f4"), jnp.asarray(18, "f4"))
    assert np.linalg.eigvalsh(z.T @ z).min() < -1e-7
    assert np.isfinite(_shape_posterior(white, jnp.ones(6, "f4")).evidence).all()


@pytest.mark.slow
def test_presses_of_unknown_shares_are_left_out_and_a_fit_that_fails_corrects_nothing(geometry):
    rng = np.random.default_rng(2)
    place = rng.uniform(0.012, 0.188, (60, 2))
    share = np.eye(4)[(place[:, 0] > 0.1) + 2 * (place[:, 1] > 0.1)]
    log_ratio, reach = 0.1 * rng.normal(size=60), jnp.array([[0.01, 0.01], [0.19, 0.19]])
    fit = eqx.filter_jit(lambda ratio, share: fit_field(PadEdge(), geometry, places, ratio, share, jnp.ones(60), reach))
    places, first = single_places(place, 4), np.arange(60) < 1
    without = fit(jnp.asarray(np.where(first, np.nan, log_ratio)), jnp.asarray(share))
    unknown = fit(jnp.asarray(log_ratio), jnp.asarray(np.where(first[:, None], np.nan, share)))
    assert without.result == unknown.result == FitResult.SUCCESS
    np.testing.assert_array_equal(unknown.coefficients, without.coefficients)
    failed = fit(jnp.asarray(1e200 * log_ratio), jnp.asarray(share))
    assert failed.result == FitResult.NOT_FINITE
    assert not np.asarray(log_gain(failed, places).mean).any()


def test_an_estimator_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(ValueError, match=r"no estimator 'best'; give one of .peak., .*.half., .quarter."):
        LOCATORS.make("image-centroid:estimator=best")
    with pytest.raises(ValueError, match=r"ImageCentroid: 'half' is not an estimator; give an object, such as "):
        ImageCentroid("half")
