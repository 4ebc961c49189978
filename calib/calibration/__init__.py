"""Calibrations: made from sessions, evaluated, applied to frames, saved and loaded.

Example:
    import jax
    import numpy as np

    import calib
    import jaxeit as je
    from calib import calibration

    jax.config.update("jax_enable_x64", True)

    mine = calib.load_calibration("calibration.h5")
    print(mine.provenance["created_utc"], mine.recipe.to_toml(), mine.curves.parameters)
    with calib.open_session("other.h5") as session:
        frames, pressures = session.stream("eit").read(), session.stream("pressure").read()
        at = np.arange(len(frames)) * len(pressures) // len(frames)  # both streams begin together
    rest = slice(0, 20)  # frames without contact
    dv, dp = frames - frames[rest].mean(0), pressures[at] - pressures[rest].mean(0)  # V, Pa
    found = calib.force_map(mine, dv, dp)
    strongest = found.force.sum(1).argmax()
    print(found.force[strongest], found.standard_error[strongest], found.position[strongest])  # N, N, m
"""

from .application.force_maps import ForceEstimate, force_map
from .application.map_files import apply
from .archives.opening import load_calibration
from .calibration import Calibration
from .evaluation import Evaluation
from .layer import learn_layer
from .localisation.locators import (
    LOCATORS,
    AbstractLocator,
    AbstractLocatorChoice,
    FittedContact,
    ImageCentroid,
    locate,
)
from .logs.calibration import LogCalibration
from .logs.procedure import apply_log, calibrate_logs, evaluate_log
from .logs.recalibration import assess_log, recalibrate_log
from .procedure import calibrate, evaluate
from .recalibration.changes import Recalibration
from .recalibration.evidence import AbstractEvidence, KnownForces, OrdinaryUse
from .recalibration.procedure import assess, recalibrate
from .recipes.recipe import Recipe, RecipeError

__all__ = [
    "LOCATORS",
    "AbstractEvidence",
    "AbstractLocator",
    "AbstractLocatorChoice",
    "Calibration",
    "Evaluation",
    "FittedContact",
    "ForceEstimate",
    "ImageCentroid",
    "KnownForces",
    "LogCalibration",
    "OrdinaryUse",
    "Recalibration",
    "Recipe",
    "RecipeError",
    "apply",
    "apply_log",
    "assess",
    "assess_log",
    "calibrate",
    "calibrate_logs",
    "evaluate",
    "evaluate_log",
    "force_map",
    "learn_layer",
    "load_calibration",
    "locate",
    "recalibrate",
    "recalibrate_log",
]
