"""Calibrations: made from sessions, evaluated, applied to frames, saved and loaded."""

from .application import apply
from .archives.opening import load_calibration
from .calibration import Calibration
from .evaluation import Evaluation
from .force_maps import ForceEstimate, force_map
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
from .recalibration.procedure import AbstractEvidence, KnownForces, OrdinaryUse, assess, recalibrate
from .recipe import Recipe, RecipeError

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
