"""Noise measured before the presses: a channel that hardly moves is not trusted without end."""

import numpy as np
import pytest

from jaxeit.imaging import CorrelatedNoise, InverseError, MeasuredNoise, noise_covariance


@pytest.fixture(scope="module")
def quiet():
    """V, five channels that share a part of their noise."""
    rng = np.random.default_rng(5)
    frames = 1e-5 * (rng.normal(size=(400, 5)) + 0.7 * rng.normal(size=(400, 1)))
    return frames - frames.mean(0)


def test_a_channel_that_hardly_moves_has_a_tenth_of_the_median_in_both(quiet):
    """One of 1e-9 V had a weight a million times that which `MeasuredNoise` gives it."""
    quiet = quiet * np.array([1, 1, 1, 1, 1e-4])
    deviations = MeasuredNoise().measured(quiet)
    covariance = CorrelatedNoise().measured(quiet)
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)), deviations, rtol=2e-3)
    assert deviations[4] == pytest.approx(0.1 * np.median(deviations), rel=0.2)
    scale, known = np.sqrt(np.diagonal(covariance)), noise_covariance(quiet)
    known /= np.sqrt(np.outer(np.diagonal(known), np.diagonal(known)))
    np.testing.assert_allclose(covariance / np.outer(scale, scale), known, rtol=1e-9)


@pytest.mark.parametrize("noise", [MeasuredNoise(), CorrelatedNoise()])
def test_indices_of_channels_are_no_flags(noise, quiet):
    with pytest.raises(InverseError, match=r"channels is int64 of shape \(5,\); give booleans"):
        noise.measured(quiet, np.arange(5))


def test_other_channels_keep_their_covariance(quiet):
    channels = np.array([True, True, False, True, True])
    still = np.where(np.arange(5) == 3, 0.0, quiet)
    covariance = CorrelatedNoise().measured(still, channels)
    moving = [0, 1, 4]
    np.testing.assert_array_equal(covariance[np.ix_(moving, moving)], noise_covariance(quiet[:, moving]))
    assert covariance[3, 3] == pytest.approx(
        (0.1 * np.median(MeasuredNoise().measured(still, channels)[moving])) ** 2, rel=0.3
    )
    assert not covariance[3, moving].any()
    assert covariance[2, 2] == 1
