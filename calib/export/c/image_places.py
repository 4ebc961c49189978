"""A calibration whose places come from the image instead of fits to each frame, and what that changes."""

from dataclasses import replace

import numpy as np

import jaxeit as je
from jaxeit.messages.kinds import require_kind

from ...calibration import Calibration, force_map
from ...calibration.localisation.locators import CentroidLocator
from ..errors import ExportError


def with_image_places(calibration: Calibration, estimator: je.metrics.AbstractEstimator) -> Calibration:
    """The calibration with the place of a contact by this estimator of its image.

    Raises:
        ExportError: for what is no estimator, or a calibration without correction by location.
    """
    give = "an object, such as je.LevelCentroid(0.5)"
    require_kind(estimator, je.metrics.AbstractEstimator, ExportError, "an estimator", give, "place")
    if calibration.field is None:
        raise ExportError("place: the calibration has no correction by location; export without --place")
    return replace(calibration, locator=CentroidLocator(estimator))


def consequences(calibration: Calibration, exported: Calibration) -> list[str]:
    """What the places of an exported calibration change in the forces of presses that the calibration keeps."""
    probes = calibration.probes
    if probes is None:
        return []
    own, theirs, plain = (
        np.asarray(force_map(which, probes.dv, probes.pressure).force, float).sum(1)
        for which in (calibration, exported, replace(calibration, field=None, locator=None))
    )
    errors = [float(np.sqrt(np.mean((force - probes.force) ** 2))) for force in (own, theirs, plain)]
    change = float(np.abs(theirs - own).max())
    return [
        f"Of {len(own)} presses of the calibration, chosen as far apart as they are, the total force differs by "
        f"{change:.2g} N at most from that with the places of the calibration.",
        f"RMSE of the total force over these presses: {errors[0]:.2g} N with the places of the calibration, "
        f"{errors[1]:.2g} N with those of the image, {errors[2]:.2g} N without correction by location.",
    ]
