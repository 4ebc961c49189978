"""A round tank of 60 mm with 16 electrodes, and a conductive rod in it, whose place every file must give."""

import numpy as np

import jaxeit as je
from calib.tanks import difference_image

COUNT, RADIUS, CURRENT = 16, 0.03, 5.5e-5
PLACE = np.array([0.012, 0.008])


def sees_the_rod(tank, tolerance=0.005):
    found = difference_image(tank, basis=je.Pixels(24))
    place = np.asarray(found.recon.centres)[np.argmax(found.change)]
    np.testing.assert_allclose(place, PLACE, atol=tolerance)
    assert found.correlation > 0.98
    return found
