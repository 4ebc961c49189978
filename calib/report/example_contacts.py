"""Contacts of the presses that a report shows, each with the ellipse that holds it with 90 %."""

from dataclasses import dataclass

import numpy as np

import jaxeit as je

from ..calibration.calibration import Calibration
from ..calibration.localisation.ellipses import INSIDE_90, placement_covariance
from ..calibration.localisation.locators import CentroidLocator, ContactLocator
from ..calibration.localisation.press_images import REPORTED_ESTIMATORS

ELLIPSE_MAGNIFICATION = 5  # times that ellipses are drawn larger, since they would hardly be seen
SMALL = 0.02  # half axis over the longer side of the sheet, below which ellipses are drawn larger
IMAGE_ESTIMATOR = "quarter"  # of `REPORTED_ESTIMATORS`, where the calibration has no locator


@dataclass(frozen=True, eq=False)
class ExampleContacts:
    """Places of one contact a press.

    | field      | meaning                                                               | shape     | unit |
    |------------|-----------------------------------------------------------------------|-----------|------|
    | estimator  | a name in the evaluation's ``estimated``                              |           |      |
    | position   | of the contact; NaN where none was found                              | (n, 2)    | m    |
    | covariance | of the position: the fit's, and the mean square error over the presses | (n, 2, 2) | m^2  |
    """

    estimator: str
    position: np.ndarray
    covariance: np.ndarray

    def magnification(self, skin: je.Skin) -> int:
        """Times that ellipses are drawn larger than they are: `ELLIPSE_MAGNIFICATION`, or 1 where they can be seen."""
        known = self.covariance[np.isfinite(self.position).all(1)]
        if not len(known) or not np.isfinite(known).all():
            return 1
        low, high = np.array(skin.domain.bounds)
        return ELLIPSE_MAGNIFICATION if half_axes(known).max() < SMALL * (high - low).max() else 1


def half_axes(covariance: np.ndarray) -> np.ndarray:
    """Half axes (..., 2) of the ellipse that holds 90 %, the longer first, in the root of the covariance's unit."""
    return np.asarray(INSIDE_90 * np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[..., ::-1], 0.0)))


def example_contacts(calibration: Calibration, image: np.ndarray) -> ExampleContacts:
    """Contacts of the calibration's examples, by its locator, or else by a centroid of their images (n, pixels) S."""
    shown, locator = calibration.examples, calibration.locator
    assert shown is not None
    if isinstance(locator, ContactLocator):
        found = locator.single().contacts_of(np.asarray(shown.dv, calibration.recon.dtype))
        present, position = np.asarray(found.present)[:, 0], np.asarray(found.position)[:, 0]
        covariance = np.asarray(found.covariance)[:, 0, :2, :2] + placement_covariance(calibration)
        return ExampleContacts("fitted", np.where(present[:, None], position, np.nan), covariance)
    if isinstance(locator, CentroidLocator):
        name, estimator = "fitted", locator.estimator
    else:
        name, estimator = IMAGE_ESTIMATOR, REPORTED_ESTIMATORS[IMAGE_ESTIMATOR]
    position = np.asarray(estimator(image, calibration.recon))
    covariance = placement_covariance(calibration, name)
    return ExampleContacts(name, position, np.broadcast_to(covariance, (len(position), 2, 2)))
