"""Gaussian fields made of bumps against their covariance."""

import numpy as np

from jaxeit.model.gaussian_field import field_modes


def test_a_field_has_its_size_and_length():
    points = np.random.default_rng(2).uniform(0.05, 0.15, (60, 2))
    corners = np.array([[0.0, 0.0], [0.2, 0.2]])
    modes = field_modes(np.concatenate([points, corners]), 0.015)[:60]
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    np.testing.assert_allclose(modes @ modes.T, np.exp(-(distance**2) / (2 * 0.015**2)), atol=0.12)
