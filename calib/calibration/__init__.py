"""Calibrations: made from sessions, evaluated, applied to frames, saved and loaded."""

from .calibration import Calibration
from .evaluation import Evaluation
from .files import load_calibration
from .force_maps import ForceEstimate, apply, force_map
from .localisation import LOCATORS, AbstractLocator, AbstractLocatorChoice, FittedContact, ImageCentroid, locate
from .log_calibration import LogCalibration
from .log_recalibrating import assess_log, recalibrate_log
from .logs import apply_log, calibrate_logs, evaluate_log
from .procedure import calibrate, evaluate
from .recalibrating import AbstractEvidence, KnownForces, OrdinaryUse, assess, recalibrate
from .recalibration import Recalibration
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
    "load_calibration",
    "locate",
    "recalibrate",
    "recalibrate_log",
]
