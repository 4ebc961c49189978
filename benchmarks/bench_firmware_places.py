"""What a correction by location gains in the header of `jaxeit export c`, by where the places of contacts come from.

Calibrations of the bundled session, simulated, with `--location edge`. Forces are held out by place, as `jaxeit
calibrate` reports them; those of a calibration whose fitted places the header replaces (`--place`) are of all presses.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import calib
import jaxeit as je
from calib.calibration.localisation.locators import CentroidLocator
from calib.runtime import set_up

from .harness import ROOT, Question, Run
from .rows import Row

SESSION = ROOT / "data" / "sessions" / "testbed_grid.h5"
ESTIMATORS = ("half", "quarter", "positive", "peak")


def places(run: Run) -> Iterator[Row]:
    """The error of the total force, a row for each source of places."""
    with calib.open_session(SESSION) as session:
        plain = calib.calibrate([session], recipe=calib.Recipe())
        yield {"rows": [row("none", "none", plain.evaluation)]}
        for name in run.sizes(ESTIMATORS, ESTIMATORS[:1]):
            locator = calib.calibration.ImageCentroid(je.metrics.ESTIMATORS.make(name))
            recipe = calib.Recipe(location=calib.PadEdge(), locator=locator)
            found = calib.calibrate([session], recipe=recipe)
            yield {"rows": [row(f"image-centroid, {name}", "the same", found.evaluation)]}
        if run.smoke:
            return
        fitted = calib.calibrate([session], recipe=calib.Recipe(location=calib.PadEdge()))
        yield {"rows": [row("fitted-contact", "not exported", fitted.evaluation)]}
        for name in ESTIMATORS:
            locator = CentroidLocator(je.metrics.ESTIMATORS.make(name))
            moved = calib.evaluate(replace(fitted, locator=locator), session)
            yield {"rows": [row("fitted-contact", f"--place {name}", moved)]}


def row(calibrated: str, header: str, found: calib.calibration.Evaluation) -> Row:
    """Sources of the places, and root mean square and largest of the errors of the total force, N."""
    error = found.total_force - found.force
    rmse, worst = float(np.sqrt(np.nanmean(error**2))), float(np.nanmax(np.abs(error)))
    return {"calibrated": calibrated, "header": header, "rmse_n": rmse, "worst_n": worst}


main = Question("firmware_places", __doc__, {"places": places}, prepare=set_up)

if __name__ == "__main__":
    main()
