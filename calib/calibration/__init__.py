"""Calibrations: made from sessions, evaluated, applied to frames, saved and loaded."""

from .calibration import Calibration, load_calibration
from .evaluation import Evaluation
from .force_maps import ForceEstimate, apply, force_map
from .localisation import LOCATORS, AbstractLocator, AbstractLocatorChoice, FittedContact, ImageCentroid, locate
from .procedure import calibrate, evaluate
from .recipe import Recipe, RecipeError

__all__ = [
    "LOCATORS",
    "AbstractLocator",
    "AbstractLocatorChoice",
    "Calibration",
    "Evaluation",
    "FittedContact",
    "ForceEstimate",
    "ImageCentroid",
    "Recipe",
    "RecipeError",
    "apply",
    "calibrate",
    "evaluate",
    "force_map",
    "load_calibration",
    "locate",
]
