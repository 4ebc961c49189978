"""Contacts followed through time, by frames and pad forces together."""

from .belief.layer import GainField, LearnedLayer
from .compilation import compile_tracker
from .model_error import fit_model_error, press_evidence
from .settings import TrackerSettings
from .smoothing import Smoother, TimedTracks
from .tracker import Tracker, prepare_tracker
from .tracks import Track, Tracking

__all__ = [
    "GainField",
    "LearnedLayer",
    "Smoother",
    "TimedTracks",
    "Track",
    "Tracker",
    "TrackerSettings",
    "Tracking",
    "compile_tracker",
    "fit_model_error",
    "prepare_tracker",
    "press_evidence",
]
